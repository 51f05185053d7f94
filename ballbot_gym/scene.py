"""Scene: draws states of the ballbot with PyBullet.

It has its own physics client, so that drawing never changes a trajectory.
"""

import math
import os
import sys
import weakref
from pathlib import Path

import numpy as np

from ballbot_gym.params import BallbotParams
from ballbot_gym.simulator import State, connect, import_pybullet, load_robot, load_urdf
from ballbot_gym.tasks.marker import Marker

CAMERA_YAW = -55.0
"""Direction in which pictures look, degrees from the y axis, positive to the left: from behind a robot that moves along x."""

_CAMERA = (4.0, CAMERA_YAW, -22.0)  # distance, m, yaw and pitch, deg


def no_display() -> bool:
    """Whether no window can open, because Linux has no X here."""
    return sys.platform.startswith("linux") and not os.environ.get("DISPLAY")


class Scene:
    """Draws the ballbot on a floor with 1 m squares, with PyBullet's software renderer or in its window.

    The camera follows the ball.
    """

    def __init__(self, params: BallbotParams, human: bool = False, width: int = 640, height: int = 480):
        """Args: human opens a window instead of drawing into arrays; width and height in pixels.

        Raises:
            ImportError: PyBullet is missing or was built without NumPy.
            RuntimeError: human without a display.
        """
        bullet = import_pybullet()
        if human and no_display():
            raise RuntimeError('render_mode="human" needs a display, and DISPLAY is not set; use "rgb_array"')
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
