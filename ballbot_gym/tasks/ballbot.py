"""BallbotTask: what the tasks of all ballbots share."""

import math
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, squared
from ballbot_gym.robot import cos_tilt
from ballbot_gym.tasks.base import Task


@dataclass(frozen=True)
class BallbotTask(Task):
    """A task of a ballbot: it fails where the robot falls or leaves the arena.

    x is a state (..., 8) in the order of `Ballbot.STATE`, u a force (..., 2) in N. With wheels x is (..., 11) and u is
    (..., 3); a task reads the first eight components, `ops.components(x)[:8]`.
    """

    max_tilt: float = math.radians(80)
    """Tilt beyond which the robot has fallen, rad."""
    heading_weight: float = field(default=0.0, repr=False)
    """Weight of 2 (1 − cos ψ), which is ψ² near 0, where ψ is the yaw of a robot with wheels, 1/s."""

    AT_REST: ClassVar[tuple[float, float, float, float]] = (0.1, math.radians(2), 0.1, 0.1)
    """Tolerances of a goal at rest: distance, m; tilt, rad; speed, m/s; lean rate, rad/s."""
    margin_names: ClassVar[tuple[str, ...]] = ("tilt",)
    NOT_THE_PROBLEM: ClassVar[frozenset[str]] = Task.NOT_THE_PROBLEM | {"arena_radius", "arena_factor"}
    MAY_BE_ZERO: ClassVar[frozenset[str]] = frozenset({"heading_weight"})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_tilt >= math.pi / 2:
            raise ValueError(f"max_tilt must be below 90°, not {math.degrees(self.max_tilt):.1f}°")

    @property
    def limit_names(self) -> tuple[str, ...]:
        return (*self.margin_names, "arena")

    @abstractmethod
    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        """The initial state as a function of `state_draws` uniform numbers z, in an episode with constants c.

        It may return the first eight components only. A robot with wheels then has a yaw of 0 and no spin at the start.
        """

    def start(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        """As `draw_state`, with all components that the robot has."""
        x = self.draw_state(z, c, params)
        if len(x) not in (8, params.state_size):
            raise ValueError(f"{type(self).__name__}.draw_state gives {len(x)} numbers; give the 8 of Ballbot.STATE")
        return (*x, *(0.0 * x[0],) * (params.state_size - len(x)))

    @abstractmethod
    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[np.ndarray]:
        """Ground paths from state x as initial guesses of optimizers, one per basin worth trying, the likeliest first.

        Each is (n+1, 2), m, one ball position per control step: n = `steps`, or less for first-exit tasks.
        """

    def heading_cost(self, x: Vector) -> Any:
        """Part of the cost rate, 1/s, by which tasks hold the heading of a robot that yaws."""
        yaw = ops.components(x)[8:9] if self.heading_weight else ()
        return self.heading_weight * 2 * (1 - ops.cos(yaw[0])) if yaw else 0.0

    def margins(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """What optimizers keep ≥ 0: the tilt limit, to which obstacles add theirs."""
        return (cos_tilt(x) - math.cos(self.max_tilt),)

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        """Centre x, y and radius of the circle that the ball must not leave, m. A task overrides it with a closer one."""
        return 0.0, 0.0, 100.0

    def limits(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Safe iff every entry ≥ 0: the margins, then the arena's, about the distance to its edge, m.

        The arena is not a margin: every optimum is far from its edge, so optimizers do not need this limit.
        """
        px, py, *_ = ops.components(x)
        x_centre, y_centre, radius = self.arena(c)
        return (*self.margins(x, c), (radius * radius - squared(px - x_centre, py - y_centre)) / (2 * radius))

    @classmethod
    def at_rest(cls, x: Vector, x_goal: Any = 0.0, y_goal: Any = 0.0) -> tuple[Any, ...]:
        """The `goal` of a task that ends at rest at a point, m.

        All numbers are ≤ 0 where nothing exceeds `AT_REST`: within 0.1 m of the point, below 0.1 m/s, 2° of tilt and
        0.1 rad/s of lean rate.
        """
        px, py, _, _, vx, vy, gamma_dot, theta_dot = ops.components(x)[:8]
        distance, lean, speed, lean_rate = cls.AT_REST
        return (
            squared(px - x_goal, py - y_goal) / distance**2 - 1,
            squared(vx, vy) / speed**2 - 1,
            (1 - cos_tilt(x)) / (1 - math.cos(lean)) - 1,
            squared(gamma_dot, theta_dot) / lean_rate**2 - 1,
        )
