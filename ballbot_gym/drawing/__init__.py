"""What a picture of ballbots shows, as plain data that every renderer draws: robots, ghosts, markers, paths and forces.

A `Drawing` is one moment. Films, strips of pictures and live pages draw one after the other. Nothing here
depends on a graphics library.
"""

import math
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from ballbot_gym import lazy
from ballbot_gym.robot import Ballbot, Robot
from ballbot_gym.robot.shapes import DARK
from ballbot_gym.tasks.marker import Marker

BALL = DARK
"""Colour of the ball."""
BODY = "#d97706"
"""Colour of a body without a controller."""
FORCE = "#d91a8c"
"""Colour of the force's arrow."""
PUSH = "#1a9e5c"
"""Colour of a push's arrow."""
GOAL = "#1f6fb2"
"""Colour of the arrow to the goal of a drive."""
GHOST_OPACITY = 0.4
FORCE_SCALE = 1 / 400
"""Length of the force's arrow, m/N."""
PUSH_SCALE = 1 / 130
"""Length of a push's arrow, m/(N·s)."""
LEAST_FORCE = 2.0
"""N: smaller forces get no arrow."""
_SERVER = "websockets"


@dataclass(frozen=True)
class Drawn:
    """A robot: state x (n,), colour "#rrggbb", force u (2,), N, or None for no arrow, and opacity, less than 1 for ghosts.

    `push` (2,), N·s, is an impulse on the body's centre of mass, drawn as an arrow, or None. `label` is what a live page
    writes above it.
    """

    x: np.ndarray
    color: str = BODY
    u: np.ndarray | None = None
    alpha: float = 1.0
    push: np.ndarray | None = None
    label: str = ""


@dataclass(frozen=True)
class GroundPath:
    """A line on the floor through points (n, 2), m: the path of a robot, or a dashed ring. Its colour has the form of a
    robot's colour or of a marker's.
    """

    points: np.ndarray
    color: str | tuple[float, ...]
    dashed: bool = False


@dataclass(frozen=True)
class Drawing:
    """One moment. The robot that matters most is the last one. Of it a renderer's camera keeps `centre` in view."""

    params: Robot
    robots: tuple[Drawn, ...]
    paths: tuple[GroundPath, ...] = ()
    markers: tuple[Marker, ...] = ()

    @property
    def centre(self) -> np.ndarray:
        """(2,) where the last robot is, m; the origin if there is no robot."""
        return self.params.position(self.robots[-1].x) if self.robots else np.zeros(2)

    @property
    def lines(self) -> tuple[GroundPath, ...]:
        """The rings of markers, then the paths."""
        rings = (GroundPath(_ring(marker), marker.color, True) for marker in self.markers if marker.ring)
        return *rings, *self.paths

    @property
    def posts(self) -> tuple[Marker, ...]:
        """The other markers."""
        return tuple(marker for marker in self.markers if not marker.ring)

    def arrows(self, robot: Drawn) -> list[tuple[str, tuple[np.ndarray, np.ndarray]]]:
        """Colour, and start and end (3,), m, of the arrows of a ballbot's force and push, where there is one to draw.

        The force's arrow starts at the ball's centre, and the push's at the body's centre of mass. The forces of three wheels
        have no common direction, so they get no arrow.
        """
        if not isinstance(self.params, Ballbot):
            return []
        ball, axis = self.params.placed(robot.x)
        body = ball + self.params.com_height * axis
        drawn = ((FORCE, robot.u, FORCE_SCALE, LEAST_FORCE, ball), (PUSH, robot.push, PUSH_SCALE, 0.0, body))
        return [
            (color, (at, at + scale * np.array([*part, 0.0])))
            for color, part, scale, least, at in drawn
            if part is not None and len(part) == 2 and math.hypot(*part) > least
        ]


def can_view() -> bool:
    """Whether the library that serves the page in the browser is installed."""
    return find_spec(_SERVER) is not None


def need_viewer() -> None:
    """Raises an ImportError that says what to do where that library is missing."""
    lazy.need('the page of render_mode="human" and of `ballbot play`', _SERVER, extra="play")


def _ring(marker: Marker) -> np.ndarray:
    """(n, 2) points, m, of a marker's circle."""
    angles = np.linspace(0, 2 * math.pi, 97)
    return marker.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) + np.array(marker.position)
