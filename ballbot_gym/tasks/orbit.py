"""BallbotOrbit-v0: ride a circle at a commanded speed."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, between, scaled, squared
from ballbot_gym.robot import Ballbot
from ballbot_gym.tasks.ballbot import BallbotTask
from ballbot_gym.tasks.base import Reference
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.symmetry import HALF_TURN, MIRROR_X, MIRROR_Y

_GUESS_SECONDS = 1.5  # how long a guessed path takes to reach its speed


@dataclass(frozen=True)
class Orbit(BallbotTask):
    """Ride a circle about the origin at a commanded speed, leaning 10° to 45° inwards (the paper's Fig. 5a).

    Observation, float32 (13,):

    | number | quantity | divided by | unit |
    |---|---|---|---|
    | 0, 1 | ball position x, y | 3 | m |
    | 2, 3 | lean γ, θ | 1 | rad |
    | 4, 5 | ball velocity ẋ, ẏ | 5 | m/s |
    | 6, 7 | lean rate γ̇, θ̇ | 5 | rad/s |
    | 8 | radius error (x² + y² − r²) / 2r | 1 | m |
    | 9, 10 | velocity error: ball velocity minus (v/r)(−y, x) | 5 | m/s |
    | 11 | radius r | 3 | m |
    | 12 | speed v | 5 | m/s |

    Action, float32 (2,) in [−1, 1]: force Fx, Fy on the ball, in units of 350 N.

    Constants, set by `reset(options={"constants": {"radius": 1.0, "speed": 4.0}})`:

    | name | meaning | unit | range |
    |---|---|---|---|
    | radius | r of the circle | m | drawn from [`min_radius`, `max_radius`] = [1, 3]; set to any > 0.8 |
    | speed | v along it, counter-clockwise if positive | m/s | drawn so that the steady tilt is uniform in [10°, 45°] |

    Start: at rest, upright, at a uniformly random bearing on the circle.

    Cost rate: 10 e_r² + 2 |e_v|² + 0.02 (γ̇² + θ̇²) + 2e-5 (Fx² + Fy²), with e_r and e_v the errors observed.

    Ends: tilt beyond `max_tilt` fails, and so does leaving the arena.
    After `duration` the episode is truncated. It is a success if the ball is then within 0.2 m of the circle and its
    velocity error is less than a fifth of v.

    Arguments, each a keyword of `gymnasium.make`:

    | name | meaning | unit | default |
    |---|---|---|---|
    | radius_weight | of e_r² | 1/(m² s) | 10 |
    | velocity_weight | of the squared velocity error | s/m² | 2 |
    | lean_rate_weight | of γ̇² + θ̇² | s | 0.02 |
    | effort_weight | of Fx² + Fy² | 1/(N² s) | 2e-5 |
    | heading_weight | of 2 (1 − cos ψ), where a robot with wheels yaws by ψ | 1/s | 0 |
    | min_radius | smallest radius drawn | m | 1 |
    | max_radius | largest radius drawn | m | 3 |
    | min_steady_tilt | smallest steady tilt drawn | rad | 10° |
    | max_steady_tilt | largest steady tilt drawn | rad | 45° |
    | duration | longest episode | s | 8 |
    | control_dt | how long each force is held | s | 0.02 |
    | max_tilt | tilt of a fall | rad | 80° |
    | survival_reward | paid for every second lived | 1/s | 100 |
    | arena_factor | how far from the origin the ball may go, above 1 | r | 2 |
    """

    radius_weight: float = 10.0
    velocity_weight: float = 2.0
    lean_rate_weight: float = 0.02
    effort_weight: float = 2e-5
    min_radius: float = 1.0
    max_radius: float = 3.0
    min_steady_tilt: float = math.radians(10)
    max_steady_tilt: float = math.radians(45)
    arena_factor: float = 2.0

    id = "BallbotOrbit-v0"
    mirrors = (
        replace(MIRROR_X, constants=(1, -1)),
        replace(MIRROR_Y, constants=(1, -1)),
        replace(HALF_TURN, constants=(1, 1)),
    )
    frame = "radial"
    observation_scale = (3.0, 3.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0, 1.0, 5.0, 5.0, 3.0, 5.0)
    constant_names = ("radius", "speed")
    constant_draws = 3
    reward_threshold = 782.9
    state_draws = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_radius > self.max_radius:
            raise ValueError(f"Orbit: min_radius {self.min_radius:g} exceeds max_radius {self.max_radius:g} m")
        if not self.min_steady_tilt <= self.max_steady_tilt < math.pi / 2:
            raise ValueError(
                f"Orbit: min_steady_tilt {self.min_steady_tilt:g} and max_steady_tilt {self.max_steady_tilt:g} rad must be "
                "in order, and below 90°"
            )
        if self.arena_factor <= 1:
            raise ValueError(
                f"Orbit: arena_factor must exceed 1, so that the circle lies inside, not {self.arena_factor}"
            )

    def draw_constants(self, z: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        radius = between(z[0], self.min_radius, self.max_radius)
        speed = params.steady_speed(radius, between(z[1], self.min_steady_tilt, self.max_steady_tilt))
        return radius, ops.where(z[2] < 0.5, -1.0, 1.0) * speed

    def measures(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> dict[str, float]:
        radius, speed = map(float, c)
        return {
            "radius, m": radius,
            "steady tilt, degrees": math.degrees(params.steady_tilt(radius, speed)),
            "speed, m/s": abs(speed),
            "direction, 1 is counter-clockwise": math.copysign(1.0, speed),
        }

    def check_constants(self, c: np.ndarray, params: Ballbot) -> None:
        smallest = params.pivot_inertia / params.first_moment
        if c[0] <= smallest:
            raise ValueError(f"{self.id}: radius must exceed {smallest:.3f} m, not {c[0]:g}")
        if c[1] == 0:
            raise ValueError(f"{self.id}: speed must not be 0")

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        radius, _ = c
        bearing, zero = 2 * math.pi * z[0], 0.0 * radius
        return (radius * ops.cos(bearing), radius * ops.sin(bearing), zero, zero, zero, zero, zero, zero)

    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        radius_error, vx_error, vy_error = self._errors(x, c)
        *_, gamma_dot, theta_dot = ops.components(x)[:8]
        return (
            self.radius_weight * squared(radius_error)
            + self.velocity_weight * squared(vx_error, vy_error)
            + self.lean_rate_weight * squared(gamma_dot, theta_dot)
            + self.effort_weight * squared(*ops.components(u))
            + self.heading_cost(x)
        )

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        radius, _ = ops.components(c)
        return 0.0, 0.0, self.arena_factor * radius

    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        radius_error, vx_error, vy_error = self._errors(x, c)
        _, speed = ops.components(c)
        return (squared(radius_error) / 0.2**2 - 1, squared(vx_error, vy_error) / (0.2 * speed) ** 2 - 1)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> Reference:
        """One round of the steady orbit, counted from the bearing of x."""
        rate = c[1] / c[0]
        steps = max(8, round(2 * math.pi / abs(rate) / self.control_dt))
        start = math.atan2(x[1], x[0])
        bearings = start + math.copysign(2 * math.pi, rate) * np.arange(steps) / steps
        states, forces = params.steady_orbit(c[0], c[1], bearings)
        return Reference(states, forces, closed=True)

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> list[np.ndarray]:
        """Along the circle, gathering speed."""
        t = self.control_dt * np.arange(self.steps + 1)
        progress = np.where(t < _GUESS_SECONDS, t**2 / (2 * _GUESS_SECONDS), t - _GUESS_SECONDS / 2)  # s
        bearing = math.atan2(x[1], x[0]) + c[1] / c[0] * progress
        return [c[0] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)]

    def observe(self, x: Vector, c: Vector) -> Vector:
        parts = (*ops.components(x)[:8], *self._errors(x, c), *ops.components(c))
        return scaled(parts, self.observation_scale, like=x)

    def markers(self, c: np.ndarray) -> list[Marker]:
        return [Marker((0.0, 0.0), float(c[0]), 0.03, (0.85, 0.1, 0.15, 1.0), ring=True)]

    def _errors(self, x: Vector, c: Vector) -> tuple[Any, Any, Any]:
        """Radius error, m, and velocity error, m/s: polynomials, so smooth at the origin too."""
        px, py, _, _, vx, vy, *_ = ops.components(x)
        radius, speed = ops.components(c)
        rate = speed / radius
        return (squared(px, py) - radius * radius) / (2 * radius), vx + rate * py, vy - rate * px
