"""Follow a point that moves along a figure eight: an example of your own task, with a cost that depends on the time.

Run `ballbot optimize figure_eight:figure_eight`, or any other command, in the folder of this file; see docs/own.md.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_baselines import along_path
from ballbot_gym import BallbotTask, Reference, Robot, ops, register_task


@register_task
@dataclass(frozen=True)
class FigureEight(BallbotTask):
    """Ride with a point that moves along an eight of a given half width, once round in `period`."""

    duration: float = 6.0
    period: float = 4.0
    """Time once round the eight, s."""

    id = "BallbotFigureEight-v0"
    observation_scale = (2.0, 2.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0, 1.0, 1.0, 2.0, 2.0, 1.0)
    constant_names = ("width",)
    constant_draws = 1
    state_draws = 4
    clock = True

    def draw_constants(self, z: tuple[Any, ...], params: Robot) -> tuple[Any, ...]:
        return (ops.between(z[0], 0.8, 1.5),)

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Robot) -> tuple[Any, ...]:
        px, py, gamma, theta = (
            ops.between(part, -size, size) for part, size in zip(z, (0.5, 0.5, 0.2, 0.2), strict=True)
        )
        return (px, py, gamma, theta, 0.0 * px, 0.0 * px, 0.0 * px, 0.0 * px)

    def _point(self, c: ops.Vector) -> tuple[Any, ...]:
        """Position and velocity of the point at a time, and its phase's sine and cosine: c has the time at its end."""
        width, time = ops.components(c)
        rate = 2 * math.pi / self.period
        sine, cosine = ops.sin(rate * time), ops.cos(rate * time)
        velocity = (width * rate * cosine, width * rate * (cosine * cosine - sine * sine))
        return (width * sine, width * sine * cosine), velocity, (sine, cosine)

    def _errors(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        """Position and velocity less the point's."""
        px, py, _, _, vx, vy, *_ = ops.components(x)
        (x_point, y_point), (vx_point, vy_point), _ = self._point(c)
        return (px - x_point, py - y_point), (vx - vx_point, vy - vy_point)

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        distance, slip = self._errors(x, c)
        *_, gamma_rate, theta_rate = ops.components(x)
        effort = 5e-4 * ops.squared(*ops.components(u))
        return (
            5.0 * ops.squared(*distance) + 0.5 * ops.squared(*slip) + 0.1 * ops.squared(gamma_rate, theta_rate) + effort
        )

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        distance, slip = self._errors(x, c)
        return ops.squared(*distance) / 0.3**2 - 1, ops.squared(*slip) / 1.0**2 - 1

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        _, _, *rest = ops.components(x)
        distance, slip = self._errors(x, c)
        _, _, phase = self._point(c)
        width, _ = ops.components(c)
        return ops.scaled((*distance, *rest, *phase, *slip, width), self.observation_scale, like=x)

    def _path(self, c: np.ndarray) -> np.ndarray:
        """(steps+1, 2) where the point is at every control step."""
        position, _, _ = self._point((c[0], self.control_dt * np.arange(self.steps + 1)))
        return np.stack(position, axis=1)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Robot) -> Reference:
        states, forces = along_path(params, self._path(c), self.control_dt)
        return Reference(states[:-1], forces)

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Robot) -> list[np.ndarray]:
        path = self._path(c)
        late = np.exp(-2.0 * self.control_dt * np.arange(len(path)))[:, None]
        return [path + late * (x[:2] - path[0])]
