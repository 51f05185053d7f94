"""BallbotWeave-v0: through a slalom of round obstacles, and to rest behind it."""

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, between, scaled, squared
from ballbot_gym.robot import Ballbot
from ballbot_gym.tasks.ballbot import BallbotTask
from ballbot_gym.tasks.base import Reference
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.paths import catmull_rom, then_stay
from ballbot_gym.tasks.symmetry import MIRROR_Y

MAX_OBSTACLES = 5

_FREE_STRETCH = 1.0  # m along x before, between and behind obstacles
_GUESS_SECONDS = 3.5  # how long a guessed path takes to the goal


@dataclass(frozen=True)
class Weave(BallbotTask):
    """Weave through 2 to 5 round obstacles and come to rest behind them (the paper's Fig. 5b).

    Observation, float32 (23,):

    | number | quantity | divided by | unit |
    |---|---|---|---|
    | 0, 1 | ball position relative to the goal | 5 | m |
    | 2, 3 | lean γ, θ | 1 | rad |
    | 4, 5 | ball velocity ẋ, ẏ | 5 | m/s |
    | 6, 7 | lean rate γ̇, θ̇ | 5 | rad/s |
    | 8 + 3i, 9 + 3i | centre of obstacle i relative to the ball, i = 0 … 4 | 5 | m |
    | 10 + 3i | its radius | 1 | m |

    Action, float32 (2,) in [−1, 1]: force Fx, Fy on the ball, in units of 350 N.

    Constants, set by `reset(options={"constants": {"goal_x": 8.0, ...}})`:

    | name | meaning | unit | range |
    |---|---|---|---|
    | goal_x, goal_y | where to rest | m | goal_x drawn from [6, 9], goal_y 0 |
    | obstacle{i}_x, _y | centre of obstacle i | m | at least 1 m from the next along x |
    | obstacle{i}_radius | | m | [0.25, 0.45]; set to any > 0 |

    Obstacles are numbered from start to goal, on alternating sides of the straight line; unused numbers repeat the last one.

    Start: at rest, upright, at (0, y) with |y| ≤ 0.3 m.

    Cost rate: that of Stabilize, relative to the goal.

    Ends: touching an obstacle with the ball, tilt beyond `max_tilt` or leaving the arena fails.
    After `duration` the episode is truncated. It is a success if the robot then rests at the goal, with the tolerances of
    Stabilize.

    Arguments, each a keyword of `gymnasium.make`:

    | name | meaning | unit | default |
    |---|---|---|---|
    | position_weight | of the squared distance to the goal | 1/(m² s) | 1 |
    | rest_weight | of squared leans, speeds and lean rates | SI | 0.5 |
    | effort_weight | of Fx² + Fy² | 1/(N² s) | 5e-4 |
    | heading_weight | of 2 (1 − cos ψ), where a robot with wheels yaws by ψ | 1/s | 0 |
    | ball_radius | of the robot, counted when it touches | m | 0.1 |
    | duration | longest episode | s | 8 |
    | control_dt | how long each force is held | s | 0.02 |
    | max_tilt | tilt of a fall | rad | 80° |
    | survival_reward | paid for every second lived | 1/s | 100 |
    | arena_radius | how far from the goal the ball may go | m | 12 |
    """

    position_weight: float = 1.0
    rest_weight: float = 0.5
    effort_weight: float = 5e-4
    ball_radius: float = 0.1
    arena_radius: float = 12.0

    id = "BallbotWeave-v0"
    frame = "slalom"
    fine_frame = "fine_slalom"
    routed_frame = "routed_slalom"
    mirrors = (replace(MIRROR_Y, constants=(1, -1) + (1, -1, 1) * MAX_OBSTACLES),)
    observation_scale = (5.0, 5.0, 1.0, 1.0, 5.0, 5.0, 5.0, 5.0) + (5.0, 5.0, 1.0) * MAX_OBSTACLES
    margin_names = ("tilt", *(f"obstacle {i}" for i in range(MAX_OBSTACLES)))
    constant_names = ("goal_x", "goal_y") + tuple(
        f"obstacle{i}_{what}" for i in range(MAX_OBSTACLES) for what in ("x", "y", "radius")
    )

    constant_draws = 4 + 3 * MAX_OBSTACLES
    state_draws = 1
    reward_threshold = 708.4

    def draw_constants(self, z: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        which, length, first_side, *shared = z
        stretch, offset, size = (shared[i : i + MAX_OBSTACLES] for i in (0, MAX_OBSTACLES, 2 * MAX_OBSTACLES))
        count = 2 + 0.0 * which + (which >= 0.25) + (which >= 0.5) + (which >= 0.75)  # of the dtype of a batch
        distance = between(length, 6.0, 9.0)
        # Free stretches before, between and behind obstacles: 1.2 m, and the rest of the way shared out at random.
        shares = [ops.where(i < count, 0.5 + stretch[i], 0.0) for i in range(MAX_OBSTACLES)]
        spare = (distance - _FREE_STRETCH * (count + 1)) / (sum(shares) + 0.5 + shared[-1])
        side = ops.where(first_side < 0.5, -1.0, 1.0)
        obstacles: list[tuple[Any, Any, Any]] = []
        x = 0.0 * distance
        for i in range(MAX_OBSTACLES):
            x = x + _FREE_STRETCH + spare * shares[i]
            radius = between(size[i], 0.25, 0.45)
            # Each bars the straight line, but reaches further across it on its own side: so weaving mostly pays.
            y = side * (-1) ** i * between(offset[i], 0.5, 0.95) * (radius + self.ball_radius)
            drawn = (x, y, radius)
            last = obstacles[-1] if obstacles else drawn
            obstacles.append(tuple(ops.where(i < count, new, old) for new, old in zip(drawn, last, strict=True)))
        return (distance, 0.0 * distance, *(value for obstacle in obstacles for value in obstacle))

    def measures(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> dict[str, float]:
        goal, obstacles = self.split_constants(c)
        free = [
            float(np.hypot(*(b - a)[:2]) - a[2] - b[2] - 2 * self.ball_radius) for a, b in itertools.pairwise(obstacles)
        ]
        return {
            "obstacles": float(len(obstacles)),
            "tightest gap, m": min(free, default=float(goal[0])),
            "goal's distance, m": float(np.hypot(*(goal - x[:2]))),
            "widest obstacle, m": float(obstacles[:, 2].max()),
            "start y, m": float(x[1]),
        }

    def check_constants(self, c: np.ndarray, params: Ballbot) -> None:
        goal, obstacles = self.split_constants(c)
        for i, (x, y, radius) in enumerate(obstacles):
            if radius <= 0:
                raise ValueError(f"{self.id}: obstacle{i}_radius must be positive, not {radius:g} m")
            if np.hypot(x - goal[0], y - goal[1]) <= radius + self.ball_radius:
                raise ValueError(f"{self.id}: the goal lies in obstacle {i}")

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Ballbot) -> tuple[Any, ...]:
        zero = 0.0 * z[0]
        return (zero, between(z[0], -0.3, 0.3), zero, zero, zero, zero, zero, zero)

    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        px, py, *rest = ops.components(x)[:8]
        x_goal, y_goal, *_ = ops.components(c)
        return (
            self.position_weight * squared(px - x_goal, py - y_goal)
            + self.rest_weight * squared(*rest)
            + self.effort_weight * squared(*ops.components(u))
            + self.heading_cost(x)
        )

    def margins(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        px, py, *_ = ops.components(x)
        clearances = []
        for ox, oy, reach in self._obstacles(c):
            # about the distance to contact, m, and smooth everywhere
            clearances.append((squared(px - ox, py - oy) - reach * reach) / (2 * reach))
        return (*super().margins(x, c), *clearances)

    def _obstacles(self, c: Vector) -> list[tuple[Any, Any, Any]]:
        """Centres x, y of all obstacles, and how near to these the ball's centre may come, m."""
        _, _, *numbers = ops.components(c)
        triples = zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True)
        return [(ox, oy, radius + self.ball_radius) for ox, oy, radius in triples]

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        x_goal, y_goal, *_ = ops.components(c)
        return x_goal, y_goal, self.arena_radius

    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        x_goal, y_goal, *_ = ops.components(c)
        return self.at_rest(x, x_goal, y_goal)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> Reference:
        """At rest at the goal: linear control does not consider obstacles."""
        rest = np.zeros((1, 8))
        rest[0, :2] = c[:2]
        return Reference(rest, np.zeros((1, 2)))

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Ballbot) -> list[np.ndarray]:
        """A path for every choice of sides, the shortest first: the best choice is mostly among the first three."""
        _, obstacles = self.split_constants(c)
        paths = [self.routed_path(x, c, sides) for sides in itertools.product((-1, 1), repeat=len(obstacles))]
        paths.sort(key=lambda path: np.hypot(*np.diff(path, axis=0).T).sum())
        return paths

    def routed_path(self, x: np.ndarray, c: np.ndarray, sides: tuple[int, ...]) -> np.ndarray:
        """From rest to rest, passing obstacle i on the left where sides[i] = 1, on the right where it is −1."""
        goal, obstacles = self.split_constants(c)
        clearance = obstacles[:, 2] + self.ball_radius + 0.1
        knots_x = np.concatenate([[x[0]], obstacles[:, 0], [goal[0]]])
        knots_y = np.concatenate([[x[1]], obstacles[:, 1] + np.array(sides[: len(obstacles)]) * clearance, [goal[1]]])
        s = np.minimum(self.control_dt * np.arange(self.steps + 1) / _GUESS_SECONDS, 1.0)
        along = x[0] + (goal[0] - x[0]) * s**3 * (10 - 15 * s + 6 * s**2)  # minimum jerk
        return then_stay(np.column_stack([along, catmull_rom(knots_x, knots_y, along)]), self.steps)

    def passed_obstacles(self, c: np.ndarray) -> np.ndarray:
        _, obstacles = self.split_constants(c)
        return obstacles + [0.0, 0.0, self.ball_radius]

    def without_obstacles(self, c: np.ndarray) -> np.ndarray:
        far = c.copy()
        far[3::3] = c[1] + 4 * self.arena_radius
        return far

    def observe(self, x: Vector, c: Vector) -> Vector:
        px, py, *rest = ops.components(x)[:8]
        x_goal, y_goal, *obstacles = ops.components(c)
        parts = [px - x_goal, py - y_goal, *rest]
        for i in range(MAX_OBSTACLES):
            ox, oy, radius = obstacles[3 * i : 3 * i + 3]
            parts += [ox - px, oy - py, radius]
        return scaled(tuple(parts), self.observation_scale, like=x)

    def markers(self, c: np.ndarray) -> list[Marker]:
        goal, obstacles = self.split_constants(c)
        posts = [Marker((x, y), radius, 0.25, (0.75, 0.1, 0.15, 1.0)) for x, y, radius in obstacles.tolist()]
        return [*posts, Marker((float(goal[0]), float(goal[1])), 0.3, 0.01, (0.1, 0.6, 0.3, 1.0))]

    @staticmethod
    def split_constants(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Goal (2,) and the distinct obstacles (n, 3): x, y, radius, m, in the order of their numbers."""
        obstacles = np.asarray(c[2:]).reshape(MAX_OBSTACLES, 3)
        distinct = [i for i in range(MAX_OBSTACLES) if i == 0 or not (obstacles[i] == obstacles[i - 1]).all()]
        return np.asarray(c[:2]), obstacles[distinct]
