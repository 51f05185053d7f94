"""The window of render_mode="human", by PyBullet, and why none can open where none can.

It has its own physics client, so that drawing never changes a trajectory.
"""

import math
import os
import subprocess
import sys
import weakref
from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from ballbot_gym.engines import State
from ballbot_gym.engines.bullet_client import connect, has_pybullet, import_pybullet, load_robot, load_urdf
from ballbot_gym.params import BallbotParams
from ballbot_gym.picture import YAW
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.viewer import import_viser

_CAMERA = (4.0, math.degrees(YAW), -22.0)  # distance, m, yaw and pitch, deg
_OPEN_WINDOW = "import os, pybullet; pybullet.connect(pybullet.GUI); print('a window', flush=True); os._exit(0)"
_OPENING_SECONDS = 60.0


def check_render_mode(render_mode: str | None) -> None:
    """Raises a RuntimeError that says what to do if render_mode is "human" where neither window nor page can open."""
    if render_mode == "human" and (trouble := window_trouble()):
        try:
            import_viser()
        except ImportError as error:
            raise RuntimeError(
                f'render_mode="human" opens a window, and {trouble}; it shows a page instead where viser is installed: '
                f'{error}. Or take render_mode="rgb_array", which needs neither'
            ) from error


def usable_render_modes() -> list[str]:
    """The render modes of this machine, without "human" where it is plain that neither a window nor a page can open."""
    return ["rgb_array"] if _plain_trouble() and find_spec("viser") is None else ["human", "rgb_array"]


def window_trouble() -> str:
    """Why no window can open; "" where one can."""
    trouble = _plain_trouble()
    return trouble or (_trouble_of(os.environ.get("DISPLAY", "")) if sys.platform.startswith("linux") else "")


def _plain_trouble() -> str:
    """The same, where no window need be tried for it."""
    if not has_pybullet():
        return "PyBullet is not installed"
    needs_display = sys.platform.startswith("linux")
    return "DISPLAY is not set" if needs_display and not os.environ.get("DISPLAY", "") else ""


@cache
def _trouble_of(display: str) -> str:
    """The same on an X server. PyBullet ends its process where it cannot open a window, so another one tries it first."""
    command = [sys.executable, "-c", _OPEN_WINDOW]
    try:
        tried = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, timeout=_OPENING_SECONDS)
    except (OSError, subprocess.TimeoutExpired):
        opened = False
    else:
        opened = b"a window" in tried.stdout
    return "" if opened else f"PyBullet can open none on DISPLAY={display}"


class Window:
    """PyBullet's window, which shows a ballbot on a floor with 1 m squares. Its camera follows the ball."""

    def __init__(self, params: BallbotParams):
        """Opens the window.

        Raises:
            ImportError: PyBullet is missing or was built without NumPy.
            RuntimeError: no window can open.
        """
        if trouble := window_trouble():
            raise RuntimeError(f"no window can open: {trouble}")
        bullet = import_pybullet()
        self._client = connect(bullet, bullet.GUI)
        self._release = weakref.finalize(self, bullet.disconnect, self._client)
        self._bullet = bullet
        bullet.configureDebugVisualizer(bullet.COV_ENABLE_GUI, 0, physicsClientId=self._client)
        self._robot, self._joints = load_robot(bullet, self._client, params)
        self._markers: list[int] = []
        self._add_floor()

    def set_markers(self, markers: Sequence[Marker]) -> None:
        """Replaces the task's markers."""
        for body in self._markers:
            self._bullet.removeBody(body, physicsClientId=self._client)
        self._markers = [body for marker in markers for body in self._add_marker(marker)]

    def draw(self, x: State) -> None:
        """Shows state x."""
        bullet, client = self._bullet, self._client
        for i, joint in enumerate(self._joints):
            bullet.resetJointState(self._robot, joint, x[i], 0.0, physicsClientId=client)
        bullet.resetDebugVisualizerCamera(*_CAMERA, (x[0], x[1], 0.5), physicsClientId=client)

    def close(self) -> None:
        """Closes the window; may be called again."""
        self._release()

    def _add_floor(self) -> None:
        import pybullet_data

        bullet = self._bullet
        floor = load_urdf(bullet, self._client, Path(pybullet_data.getDataPath()) / "plane100.urdf")
        bullet.changeVisualShape(floor, -1, rgbaColor=(1, 1, 1, 1), physicsClientId=self._client)

    def _add_marker(self, marker: Marker) -> list[int]:
        x, y = marker.position
        if not marker.ring:
            return [self._cylinder((x, y, marker.height / 2), marker.radius, marker.height, marker.color)]
        count = max(24, int(2 * math.pi * marker.radius / 0.2))
        angles = [2 * math.pi * k / count for k in range(count)]
        return [
            self._cylinder(
                (x + marker.radius * math.cos(a), y + marker.radius * math.sin(a), marker.height / 2),
                0.025,
                marker.height,
                marker.color,
            )
            for a in angles
        ]

    def _cylinder(self, position: tuple, radius: float, height: float, color: tuple) -> int:
        bullet, client = self._bullet, self._client
        shape = bullet.createVisualShape(
            bullet.GEOM_CYLINDER, radius=radius, length=height, rgbaColor=color, physicsClientId=client
        )
        return bullet.createMultiBody(
            baseMass=0, baseVisualShapeIndex=shape, basePosition=position, physicsClientId=client
        )
