"""BallbotStabilize-v0: come to rest at the origin from speed and lean."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, between, scaled, squared
from ballbot_gym.robot import Ballbot, tilt
from ballbot_gym.tasks.ballbot import BallbotTask
from ballbot_gym.tasks.base import Reference
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.paths import cubic, then_stay
from ballbot_gym.tasks.symmetry import HALF_TURN, MIRROR_X, MIRROR_Y

_GUESS_SECONDS = 2.5  # how long a guessed path takes to come to rest


@dataclass(frozen=True)
class Stabilize(BallbotTask):
    """Come to rest at the origin (the paper's Figs 2 and 3, from random states).

    Observation, float32 (8,):

    | number | quantity | divided by | unit |
    |---|---|---|---|
    | 0, 1 | ball position x, y | 5 | m |
    | 2, 3 | lean γ, θ | 1 | rad |
    | 4, 5 | ball velocity ẋ, ẏ | 5 | m/s |
    | 6, 7 | lean rate γ̇, θ̇ | 5 | rad/s |

    Action, float32 (2,) in [−1, 1]: force Fx, Fy on the ball, in units of 350 N.

    Start: |x|, |y| ≤ `start_position`, |ẋ|, |ẏ| ≤ `start_speed`, |γ|, |θ| ≤ `start_lean`, |γ̇|, |θ̇| ≤ `start_lean_rate`,
    uniform.

    Cost rate: x² + y² + ½(γ² + θ² + ẋ² + ẏ² + γ̇² + θ̇²) + 5e-4 (Fx² + Fy²). The ratios of the weights are the paper's.

    Ends: tilt beyond `max_tilt` fails, and so does leaving the arena.
    After `duration` the episode is truncated. It is a success if the robot is then within 0.1 m of the origin, slower than
    0.1 m/s, with a lean below 2° and a lean rate below 0.1 rad/s.

    Arguments, each a keyword of `gymnasium.make`:

    | name | meaning | unit | default |
    |---|---|---|---|
    | position_weight | of x² + y² | 1/(m² s) | 1 |
    | rest_weight | of squared leans, speeds and lean rates | SI | 0.5 |
    | effort_weight | of Fx² + Fy² | 1/(N² s) | 5e-4 |
    | heading_weight | of 2 (1 − cos ψ), where a robot with wheels yaws by ψ | 1/s | 0 |
    | start_position | how far x and y may be at the start | m | 2 |
    | start_speed | the same of ẋ and ẏ | m/s | 5 |
    | start_lean | the same of γ and θ | rad | 0.6 |
    | start_lean_rate | the same of γ̇ and θ̇ | rad/s | 1 |
    | duration | longest episode | s | 8 |
    | control_dt | how long each force is held | s | 0.02 |
    | max_tilt | tilt of a fall | rad | 80° |
    | survival_reward | paid for every second lived | 1/s | 100 |
    | arena_radius | how far from the origin the ball may go | m | 10 |
    """

    position_weight: float = 1.0
    rest_weight: float = 0.5
    effort_weight: float = 5e-4
    start_position: float = 2.0
    start_speed: float = 5.0
    start_lean: float = 0.6
    start_lean_rate: float = 1.0
    arena_radius: float = 10.0

    state_draws = 8
    id = "BallbotStabilize-v0"
    fine_frame = "fine_rest"
    mirrors = (MIRROR_X, MIRROR_Y, HALF_TURN)
    observation_scale = (5.0, 5.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0)
    reward_threshold = 771.5

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        limits = (self.start_position, self.start_lean, self.start_speed, self.start_lean_rate)
        return tuple(between(z[i], -limits[i // 2], limits[i // 2]) for i in range(8))

    def measures(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> dict[str, float]:
        """Distance, speeds and leans of the start."""
        px, py, gamma, theta, vx, vy, gamma_dot, theta_dot = map(float, x[:8])
        # across the ground, of the length sin(tilt): the direction in which the body leans
        lean_x, lean_y = math.sin(gamma) * math.cos(theta), math.sin(theta)
        length = math.hypot(lean_x, lean_y)
        return {
            "distance, m": math.hypot(px, py),
            "speed, m/s": math.hypot(vx, vy),
            "tilt, degrees": math.degrees(tilt(x)),
            "speed along the lean, m/s": (vx * lean_x + vy * lean_y) / length if length else 0.0,
            "tilt rate, rad/s": (lean_x * gamma_dot + lean_y * math.cos(gamma) * theta_dot) / length if length else 0.0,
        }

    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        px, py, *rest = ops.components(x)[:8]
        return (
            self.position_weight * squared(px, py)
            + self.rest_weight * squared(*rest)
            + self.effort_weight * squared(*ops.components(u))
            + self.heading_cost(x)
        )

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        return 0.0, 0.0, self.arena_radius

    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        return self.at_rest(x)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> Reference:
        return Reference(np.zeros((1, 8)), np.zeros((1, 2)))

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> list[np.ndarray]:
        rest = np.zeros(2)
        path = cubic(x[:2], x[4:6], rest, rest, round(_GUESS_SECONDS / self.control_dt), self.control_dt)
        return [then_stay(path, self.steps)]

    def observe(self, x: Vector, c: Vector) -> Vector:
        return scaled(ops.components(x)[:8], self.observation_scale, like=x)

    def markers(self, c: np.ndarray) -> list[Marker]:
        return [Marker((0.0, 0.0), 0.3, 0.01, (0.1, 0.6, 0.3, 1.0))]
