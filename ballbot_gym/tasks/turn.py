"""BallbotTurn-v0: a 90° turn through a gate at speed."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, between, scaled, squared
from ballbot_gym.robot import Ballbot, cos_tilt
from ballbot_gym.tasks.ballbot import BallbotTask
from ballbot_gym.tasks.base import Reference
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.paths import cubic

_START, _GATE = np.array([0.0, -1.0]), np.array([1.0, 0.0])  # m, the paper's turn
_LINEAR_SECONDS_PER_SPEED = 0.6  # s per m/s: with less LQR falls, with more it is slow (0.5 to 1.0 tried)

_SHAPING_SECONDS = 0.3  # s: how much a velocity error counts in the distance to the goal


@dataclass(frozen=True)
class Turn(BallbotTask):
    """Turn by 90°: from (0, −1) moving (0, v) through the gate at (1, 0) moving (v, 0), as in the paper's Fig. 4.

    Observation, float32 (9,):

    | number | quantity | divided by | unit |
    |---|---|---|---|
    | 0, 1 | ball position relative to the gate | 5 | m |
    | 2, 3 | lean γ, θ | 1 | rad |
    | 4, 5 | ball velocity minus the gate's velocity (v, 0) | 5 | m/s |
    | 6, 7 | lean rate γ̇, θ̇ | 5 | rad/s |
    | 8 | speed v | 5 | m/s |

    Action, float32 (2,) in [−1, 1]: force Fx, Fy on the ball, in units of 350 N.

    Constants, drawn uniformly, set by `reset(options={"constants": {"speed": 3.0}})`:

    | name | meaning | unit | range |
    |---|---|---|---|
    | speed | v at the start and at the gate | m/s | drawn from [`min_speed`, `max_speed`] = [2, 10]; set to any in (0, 12] |

    Cost rate: 5 + ½(γ² + θ² + γ̇² + θ̇²) + 2e-4 (Fx² + Fy²): time, lean and effort, as in the paper's problem 1.

    Ends: the episode ends with success, and without further cost, when the ball is within 0.2 m of the gate, its velocity
    is within 0.5 m/s of (v, 0), the tilt is below 10° and the lean rate below 1 rad/s. Tilt beyond `max_tilt` fails, and so
    does leaving the arena. After `duration` the episode is truncated.

    Discount: use 0.99 to 0.995, or treat time-outs as terminations. Arriving pays the survival reward of the remaining time
    at once, while a learner that bootstraps at time-outs values standing still as if it continued indefinitely. For such a
    learner, the certified turns have a value that is 36 to 363 higher than that of standing still with a discount of 0.99,
    17 to 283 higher with 0.995, and 211 to 366 lower with 0.998. If time-outs are terminations, turning has the higher value
    with each of these discounts, and a value that is 8 to 35 higher without discount.

    Survival reward: full force on both axes costs 49 /s, time 5 /s, leans at most 2 /s, and lean rates of 5 rad/s 25 /s. So
    nearly every step costs less than the survival reward of 100 /s.

    Arguments, each a keyword of `gymnasium.make`:

    | name | meaning | unit | default |
    |---|---|---|---|
    | time_weight | of time | 1/s | 5 |
    | lean_weight | of squared leans and lean rates | SI | 0.5 |
    | effort_weight | of Fx² + Fy² | 1/(N² s) | 2e-4 |
    | heading_weight | of 2 (1 − cos ψ), where a robot with wheels yaws by ψ | 1/s | 0 |
    | min_speed | smallest speed drawn | m/s | 2 |
    | max_speed | largest speed drawn | m/s | 10 |
    | duration | longest episode | s | 8 |
    | control_dt | how long each force is held | s | 0.02 |
    | max_tilt | tilt of a fall | rad | 80° |
    | survival_reward | paid for every second lived | 1/s | 100 |
    | arena_radius | how far from the gate the ball may go | m | 20 |
    """

    time_weight: float = 5.0
    lean_weight: float = 0.5
    effort_weight: float = 2e-4
    min_speed: float = 2.0
    max_speed: float = 10.0
    arena_radius: float = 20.0

    MAX_SPEED: ClassVar[float] = 12.0
    """Largest speed that an episode may have, m/s."""

    id = "BallbotTurn-v0"
    frame = "gate"
    fine_frame = "fine_gate"
    observation_scale = (5.0, 5.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0, 5.0)
    constant_names = ("speed",)
    constant_draws = 1
    first_exit = True
    reward_threshold = 780.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.min_speed <= self.max_speed <= self.MAX_SPEED:
            raise ValueError(
                f"Turn: min_speed {self.min_speed:g} and max_speed {self.max_speed:g} must be in order, "
                f"and at most {self.MAX_SPEED:g} m/s"
            )

    def draw_constants(self, z: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        return (between(z[0], self.min_speed, self.max_speed),)

    def measures(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> dict[str, float]:
        return {"speed, m/s": float(c[0])}

    def check_constants(self, c: np.ndarray, params: Ballbot) -> None:
        if not 0 < c[0] <= self.MAX_SPEED:
            raise ValueError(f"{self.id}: speed must be in (0, {self.MAX_SPEED:g}] m/s, not {c[0]:g}")

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        (speed,) = c
        zero = 0.0 * speed  # of the shape of a batch, if c is one
        return (zero + _START[0], zero + _START[1], zero, zero, zero, speed, zero, zero)

    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        _, _, gamma, theta, _, _, gamma_dot, theta_dot = ops.components(x)[:8]
        return (
            self.time_weight
            + self.lean_weight * squared(gamma, theta, gamma_dot, theta_dot)
            + self.effort_weight * squared(*ops.components(u))
            + self.heading_cost(x)
        )

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        return float(_GATE[0]), float(_GATE[1]), self.arena_radius

    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        px, py, _, _, vx, vy, gamma_dot, theta_dot = ops.components(x)[:8]
        (speed,) = ops.components(c)
        return (
            squared(px - _GATE[0], py - _GATE[1]) / 0.2**2 - 1,
            squared(vx - speed, vy) / 0.5**2 - 1,
            (1 - cos_tilt(x)) / (1 - math.cos(math.radians(10))) - 1,
            squared(gamma_dot, theta_dot) - 1,
        )

    def goal_distance(self, x: Vector, c: Vector) -> Any:
        """√(distance² + (0.3 s · velocity error)² + leans²) to passing the gate upright, m; 1 rad of lean counts as 1 m."""
        px, py, gamma, theta, vx, vy, *_ = ops.components(x)
        (speed,) = ops.components(c)
        off = _SHAPING_SECONDS * (vx - speed), _SHAPING_SECONDS * vy
        return ops.sqrt(squared(px - _GATE[0], py - _GATE[1], *off, gamma, theta))

    def reference(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> Reference:
        """The straight motion at (v, 0) that passes the gate after a time proportional to v."""
        steps = min(max(1, round(_LINEAR_SECONDS_PER_SPEED * c[0] / self.control_dt)), self.steps)
        to_go = self.control_dt * np.arange(-steps, 1)
        states = np.zeros((steps + 1, 8))
        states[:, 0] = _GATE[0] + c[0] * to_go
        states[:, 1] = _GATE[1]
        states[:, 4] = c[0]
        return Reference(states, np.zeros((steps + 1, 2)))

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> list[np.ndarray]:
        """Cubics to the gate, which at speed bulge into the direct turn, and into the loop of 270° on its left."""
        gate_velocity = np.array([c[0], 0.0])
        paths = []
        for seconds in (1.5, 3.0, 5.0):
            steps = round(min(seconds, self.duration) / self.control_dt)
            paths.append(cubic(x[:2], x[4:6], _GATE, gate_velocity, steps, self.control_dt))
        # past the gate's line, around to the left, and through the gate from behind
        reach = max(1.0, 0.08 * c[0] ** 2)  # m: about the radius of a turn at full force
        over = np.array([-reach, reach])
        steps = round(min(2.0, self.duration / 2) / self.control_dt)
        half = cubic(x[:2], x[4:6], over, np.array([-c[0], -c[0]]) / 2, steps, self.control_dt)
        back = cubic(over, np.array([-c[0], -c[0]]) / 2, _GATE, gate_velocity, steps, self.control_dt)
        paths.append(np.concatenate([half, back[1:]]))
        return paths

    def observe(self, x: Vector, c: Vector) -> Vector:
        px, py, gamma, theta, vx, vy, gamma_dot, theta_dot = ops.components(x)[:8]
        (speed,) = ops.components(c)
        parts = (px - _GATE[0], py - _GATE[1], gamma, theta, vx - speed, vy, gamma_dot, theta_dot, speed)
        return scaled(parts, self.observation_scale, like=x)

    def markers(self, c: np.ndarray) -> list[Marker]:
        color = (0.85, 0.1, 0.15, 1.0)
        return [Marker((_GATE[0], _GATE[1] + side), 0.04, 0.9, color) for side in (-0.35, 0.35)]
