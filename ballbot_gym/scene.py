"""Scene: draws states of the ballbot with PyBullet.

It has its own physics client, so that drawing never changes a trajectory.
"""

import math
import os
import subprocess
import sys
import weakref
from functools import cache
from pathlib import Path

import numpy as np

from ballbot_gym.engines import State
from ballbot_gym.engines.bullet_client import connect, has_pybullet, import_pybullet, load_robot, load_urdf
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.viewer import import_viser

CAMERA_YAW = -55.0
"""Direction in which pictures look, degrees from the y axis, positive to the left: from behind a robot that moves along x."""

_CAMERA = (4.0, CAMERA_YAW, -22.0)  # distance, m, yaw and pitch, deg


_NO_PICTURES = (
    'render_mode="rgb_array" draws with it. Without it, render_mode="human" shows the robot on a page in the browser, '
    "where viser is installed."
)
_OPEN_WINDOW = "import os, pybullet; pybullet.connect(pybullet.GUI); print('a window', flush=True); os._exit(0)"
_OPENING_SECONDS = 60.0


def check_render_mode(render_mode: str | None) -> None:
    """Raises an error that says what to do where a render mode cannot draw on this machine.

    Raises:
        ImportError: "rgb_array" without PyBullet.
        RuntimeError: "human" where neither a window nor a page can open.
    """
    if render_mode == "rgb_array":
        import_pybullet(_NO_PICTURES)
    elif render_mode == "human" and (trouble := window_trouble()):
        try:
            import_viser()
        except ImportError as error:
            modest = 'render_mode="rgb_array"' if has_pybullet() else "an environment without a render mode"
            raise RuntimeError(
                f'render_mode="human" opens a window, and {trouble}; it shows a page instead where viser is installed: '
                f"{error}. Or take {modest}, which needs neither"
            ) from error


def window_trouble() -> str:
    """Why no window can open; "" where one can."""
    if not has_pybullet():
        return "PyBullet is not installed"
    if not sys.platform.startswith("linux"):
        return ""
    return _trouble_of(os.environ.get("DISPLAY", ""))


@cache
def _trouble_of(display: str) -> str:
    """The same on an X server. PyBullet ends its process where it cannot open a window, so another one tries it first."""
    if not display:
        return "DISPLAY is not set"
    command = [sys.executable, "-c", _OPEN_WINDOW]
    try:
        tried = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, timeout=_OPENING_SECONDS)
    except (OSError, subprocess.TimeoutExpired):
        opened = False
    else:
        opened = b"a window" in tried.stdout
    return "" if opened else f"PyBullet can open none on DISPLAY={display}"


class Scene:
    """Draws the ballbot on a floor with 1 m squares, with PyBullet's software renderer or in its window.

    The camera follows the ball.
    """

    def __init__(self, params: BallbotParams, human: bool = False, width: int = 640, height: int = 480):
        """Args: human opens a window instead of drawing into arrays; width and height in pixels.

        Raises:
            ImportError: PyBullet is missing or was built without NumPy.
            RuntimeError: human where no window can open.
        """
        bullet = import_pybullet(_NO_PICTURES)
        if human and (trouble := window_trouble()):
            raise RuntimeError(f"no window can open: {trouble}")
        self._client = connect(bullet, bullet.GUI if human else bullet.DIRECT)
        self._release = weakref.finalize(self, bullet.disconnect, self._client)
        self._bullet, self._human, self._size = bullet, human, (width, height)
        if human:
            bullet.configureDebugVisualizer(bullet.COV_ENABLE_GUI, 0, physicsClientId=self._client)
        self._robot, self._joints = load_robot(bullet, self._client, params)
        self._params = params
        self._markers: list[int] = []
        self._add_floor()

    def set_markers(self, markers: list[Marker]) -> None:
        """Replaces the task's markers."""
        for body in self._markers:
            self._bullet.removeBody(body, physicsClientId=self._client)
        self._markers = [body for marker in markers for body in self._add_marker(marker)]

    def draw(self, x: State) -> np.ndarray | None:
        """Shows state x; returns (height, width, 3) uint8, or None in a window."""
        bullet, client = self._bullet, self._client
        for i, joint in enumerate(self._joints):
            bullet.resetJointState(self._robot, joint, x[i], 0.0, physicsClientId=client)
        target = (x[0], x[1], 0.5)
        if self._human:
            bullet.resetDebugVisualizerCamera(*_CAMERA, target, physicsClientId=client)
            return None
        width, height = self._size
        view = bullet.computeViewMatrixFromYawPitchRoll(target, *_CAMERA, 0, 2)
        projection = bullet.computeProjectionMatrixFOV(45, width / height, 0.1, 60)
        image = bullet.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(-4, -6, 12),
            lightDistance=20,
            shadow=1,
            renderer=bullet.ER_TINY_RENDERER,
            flags=bullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=client,
        )[2]
        return np.reshape(image, (height, width, 4))[:, :, :3].astype(np.uint8)

    def close(self) -> None:
        """Closes the window or releases the client; may be called again."""
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
