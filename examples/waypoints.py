"""Pass points one after the other at given times: an example of your own task, with a cost that depends on the time.

Run `ballbot optimize waypoints:waypoints`, or any other command, in the folder of this file; see docs/own.md.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_baselines import along_path
from ballbot_gym import BallbotTask, Marker, Reference, Robot, catmull_rom, ops, register_task


@register_task
@dataclass(frozen=True)
class Waypoints(BallbotTask):
    """From rest past three points, one every `interval`, and to rest at the last of them."""

    duration: float = 6.0
    interval: float = 1.5
    """Time from one point to the next, s."""
    width: float = 0.25
    """How long a distance from a point counts around its time, s."""

    id = "BallbotWaypoints-v0"
    observation_scale = (2.0, 2.0, 2.0, 2.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    constant_names = ("x1", "y1", "x2", "y2", "x3", "y3")
    constant_draws = 6
    state_draws = 2
    clock = True

    def draw_constants(self, z: tuple[Any, ...], params: Robot) -> tuple[Any, ...]:
        return tuple(ops.between(part, -1.5, 1.5) for part in z)

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Robot) -> tuple[Any, ...]:
        gamma, theta = (ops.between(part, -0.2, 0.2) for part in z)
        return (0.0 * gamma, 0.0 * gamma, gamma, theta, 0.0 * gamma, 0.0 * gamma, 0.0 * gamma, 0.0 * gamma)

    def _weights(self, c: ops.Vector) -> tuple[Any, ...]:
        """How much each point counts now, at most 1; the last one counts from its time on."""
        time = ops.components(c)[-1]
        first, second, third = ((time - i * self.interval) / self.width for i in (1, 2, 3))
        return ops.exp(-first * first), ops.exp(-second * second), 1 / (1 + ops.exp(-2 * third))

    def _ways(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        """From the ball to each point, m."""
        px, py, *_ = ops.components(x)
        x1, y1, x2, y2, x3, y3, _ = ops.components(c)
        return (x1 - px, y1 - py), (x2 - px, y2 - py), (x3 - px, y3 - py)

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        _, _, *motion = ops.components(x)
        first, second, third = (
            weight * ops.squared(*way) for weight, way in zip(self._weights(c), self._ways(x, c), strict=True)
        )
        return 20.0 * (first + second + third) + 0.1 * ops.squared(*motion) + 5e-4 * ops.squared(*ops.components(u))

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        *_, way = self._ways(x, c)
        _, _, _, _, vx, vy, *_ = ops.components(x)
        return ops.squared(*way) / 0.3**2 - 1, ops.squared(vx, vy) / 0.5**2 - 1

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        _, _, *motion = ops.components(x)
        first, second, third = self._ways(x, c)
        time = ops.components(c)[-1]
        one, two, three = (1 / (1 + ops.exp(20.0 * (i * self.interval - time))) for i in (1, 2, 3))  # what is past
        ahead = [a + one * (b - a) + two * (d - b) for a, b, d in zip(first, second, third, strict=True)]
        after = [b + one * (d - b) for b, d in zip(second, third, strict=True)]
        phase = 2 * math.pi * time / self.interval
        clock = (ops.sin(phase), ops.cos(phase), one, two, three)
        return ops.scaled((*ahead, *after, *motion, *clock), self.observation_scale, like=x)

    def _path(self, start: np.ndarray, c: np.ndarray) -> np.ndarray:
        """(steps+1, 2) a smooth curve through the points."""
        knots = np.array([0.0, *(self.interval * np.arange(1, 4)), self.duration + self.interval])
        time = self.control_dt * np.arange(self.steps + 1)
        curves = (catmull_rom(knots, np.array([begin, *c[i::2], c[4 + i]]), time) for i, begin in enumerate(start))
        return np.stack(tuple(curves), axis=1)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Robot) -> Reference:
        states, forces = along_path(params, self._path(x[:2], c), self.control_dt)
        return Reference(states[:-1], forces)

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Robot) -> list[np.ndarray]:
        return [self._path(x[:2], c)]

    def markers(self, c: np.ndarray) -> list[Marker]:
        return [Marker((float(c[2 * i]), float(c[2 * i + 1])), 0.1, 0.03, (0.85, 0.1, 0.15, 1.0)) for i in range(3)]
