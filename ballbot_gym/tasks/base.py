"""Task: the one definition of an optimal-control problem that env, experts, optimizer and leaderboard use."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import dynamics, ops
from ballbot_gym.ops import Vector, is_number, is_positive, squared
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.symmetry import Mirror

MAX_STEPS = 1_000_000
"""Control steps in the longest episode that a task may have."""


@dataclass(frozen=True)
class Reference:
    """A steady motion that linear control tracks, one point per control step: x (n, 8) and u (n, 2).

    An open reference is tracked in time, and after its end its last point. A single point is an equilibrium. A closed
    reference repeats for ever, and a controller may begin at any of its points.
    """

    x: np.ndarray
    u: np.ndarray
    closed: bool = False


@dataclass(frozen=True)
class Task(ABC):
    """A finite-horizon optimal-control problem, and the rewards that follow from it.

    Staying alive pays and motion costs: the reward of a step is (survival_reward − cost rate) · control_dt. Whoever violates
    a limit fails, which ends the episode and costs survival_reward for every second not lived. Whoever reaches the goal of
    a first-exit task is paid survival_reward for every remaining second at once, so that dawdling never pays more than
    arriving. For every episode, however it ends, return + cost = `survival_pay`. So the greatest return is the least cost,
    whatever survival_reward is.

    x is a state (..., 8), u a force (..., 2) in N, c the episode's constants (..., nc). With wheels x is (..., 11) and u is
    (..., 3); a task reads the first eight components, `ops.components(x)[:8]`. Cost, margins, goal and observation
    are written with `ops`, so that NumPy, CasADi and torch evaluate the same lines; they are smooth in x and u.

    Where `clock` is True, cost, goal, margins, arena and observation also depend on the episode's time: they find it, s, as
    the last entry of c, after the constants of `constant_names`, and `at` puts it there. All other methods get c without it.
    A step's cost is taken when the step begins, its goal and limits when it ends.

    A task is one file: it fills in the abstract methods, and `register_task` names it.
    """

    duration: float = 8.0
    """Longest episode, s."""
    control_dt: float = 0.02
    """How long each force is held, s."""
    max_tilt: float = math.radians(80)
    """Tilt beyond which the robot has fallen, rad."""
    survival_reward: float = 100.0
    """Paid for every second lived, 1/s: more than nearly every motion in the arena costs."""

    heading_weight: float = field(default=0.0, repr=False)
    """Of 2 (1 − cos ψ), which is ψ² near 0, of robots with wheels, which yaw, 1/s."""

    id: ClassVar[str]
    """Gymnasium id."""
    observation_scale: ClassVar[tuple[float, ...]]
    """What each observed quantity is divided by, in its unit."""
    constant_names: ClassVar[tuple[str, ...]] = ()
    """Names of the episode's constants c, in order."""
    margin_names: ClassVar[tuple[str, ...]] = ("tilt",)
    """What each of `margins` keeps."""
    reward_threshold: ClassVar[float | None] = None
    """Mean return on the certified episodes, with default fields, at a mean regret of 10 %."""
    NOT_THE_PROBLEM: ClassVar[frozenset[str]] = frozenset({"survival_reward", "arena_radius", "arena_factor"})
    """Fields that move no optimum: they shape rewards, or bound where no optimum goes."""
    mirrors: ClassVar[tuple[Mirror, ...]] = ()
    """Its mirror images; with no change they form a group."""
    frame: ClassVar[str | None] = None
    """Name in `symmetry.FRAMES` of a frame in which the task looks the same wherever it takes place, or None."""
    routed_frame: ClassVar[str | None] = None
    """Name in `symmetry.FRAMES` of a frame in which a route decides on which side obstacles are passed, or None."""
    fine_frame: ClassVar[str | None] = None
    """Name of the same frame with features that tell small errors apart, where `frame` has none; or None."""
    constant_draws: ClassVar[int] = 0
    """Uniform numbers that `draw_constants` takes."""
    state_draws: ClassVar[int] = 0
    """Uniform numbers that `draw_state` takes."""
    first_exit: ClassVar[bool] = False
    """Whether reaching the goal ends the episode."""
    clock: ClassVar[bool] = False
    """Whether cost, goal, margins, arena and observation depend on the episode's time."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if not isinstance(each.default, float):
                continue
            value = getattr(self, each.name)
            if not is_number(value):
                raise ValueError(f"{type(self).__name__}: {each.name} must be a number, not {value!r}")
            if not is_positive(value) and not (each.name == "heading_weight" and value == 0):
                raise ValueError(f"{type(self).__name__}: {each.name} must be positive and finite, not {value}")
            object.__setattr__(self, each.name, float(value))  # so that 8 and 8.0 are the same task
        if not 0.5 <= self.duration / self.control_dt <= MAX_STEPS:
            raise ValueError(
                f"duration {self.duration} s must be 1 to {MAX_STEPS:,} control steps of {self.control_dt} s"
            )
        if not math.isclose(self.steps * self.control_dt, self.duration, rel_tol=1e-9):
            raise ValueError(
                f"duration {self.duration} s is not a whole number of control steps of {self.control_dt} s"
            )
        if self.max_tilt >= math.pi / 2:
            raise ValueError(f"max_tilt must be below 90°, not {math.degrees(self.max_tilt):.1f}°")

    @property
    def steps(self) -> int:
        """Control steps in the longest episode."""
        return round(self.duration / self.control_dt)

    @property
    def survival_pay(self) -> float:
        """What return and cost of every episode add up to: survival_reward · duration. Failing at once costs as much."""
        return self.survival_reward * self.duration

    @property
    def limit_names(self) -> tuple[str, ...]:
        """What each of `limits` keeps."""
        return (*self.margin_names, "arena")

    def problem(self) -> str:
        """The task's name and the fields that define its optima: tells whether an optimum or a policy belongs to a task."""
        named = (f.name for f in fields(self) if f.name not in self.NOT_THE_PROBLEM)
        named = (name for name in named if name != "heading_weight" or self.heading_weight)  # as before there was one
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in named)})"

    def at(self, c: Vector, time: Any) -> Vector:
        """c (..., nc) as cost, goal, margins, arena and observe take it at an episode's time, s (...).

        That is c unchanged, unless the task has a `clock`: then the time follows the constants.
        """
        return ops.stack((*ops.components(c), time), like=c) if self.clock else c

    def draw_constants(self, z: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        """The constants (nc) that `constant_draws` uniform numbers z in [0, 1) stand for; z may hold batches."""
        return ()

    @abstractmethod
    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        """The initial state (8) that `state_draws` uniform numbers z stand for, in an episode with constants c."""

    def start(self, z: tuple[Any, ...], c: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        """As `draw_state`, with all components that the robot has: with wheels it neither turns nor spins at the start."""
        x = self.draw_state(z, c, params)
        if len(x) not in (8, params.state_size):
            raise ValueError(f"{type(self).__name__}.draw_state gives {len(x)} numbers; give the 8 of dynamics.STATE")
        return (*x, *(0.0 * x[0],) * (params.state_size - len(x)))

    def sample(self, rng: np.random.Generator, params: BallbotParams) -> tuple[np.ndarray, np.ndarray]:
        """Draws an episode: initial state (8,) and constants (nc,)."""
        c = self.draw_constants(tuple(rng.random(self.constant_draws).tolist()), params)
        x = self.start(tuple(rng.random(self.state_draws).tolist()), c, params)
        return np.array(x, np.float64), np.array(c, np.float64)

    def goal_distance(self, x: Vector, c: Vector) -> Any:
        """About how far a state is from the goal, m, for learners that shape rewards; None where a task defines none."""
        return None

    def measures(self, x: np.ndarray, c: np.ndarray, params: BallbotParams) -> dict[str, float]:
        """What makes an episode easy or hard, by name and unit, of its initial state (8,) and constants (nc,).

        Evaluation bins its results by each of these. The default is the constants; a task overrides it where derived
        quantities say more.
        """
        return dict(zip(self.constant_names, map(float, c), strict=True))

    def check_constants(self, c: np.ndarray, params: BallbotParams) -> None:
        """Raises a ValueError that names the constant that makes no sense."""

    @abstractmethod
    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        """Cost rate, 1/s, ≥ 0: the episode costs its sum over control steps times control_dt."""

    @abstractmethod
    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Success iff every entry ≤ 0: at the first such state if `first_exit`, else at the end of the episode."""

    @abstractmethod
    def reference(self, x: np.ndarray, c: np.ndarray, params: BallbotParams) -> Reference:
        """The steady motion that linear control steers to from state x."""

    @abstractmethod
    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: BallbotParams) -> list[np.ndarray]:
        """Ground paths from state x from which optimizers start, one per basin worth trying, the likeliest first.

        Each is (n+1, 2), m, one ball position per control step: n = `steps`, or less for first-exit tasks.
        """

    def passed_obstacles(self, c: np.ndarray) -> np.ndarray | None:
        """Obstacles passed along x, where `guess_paths` has one path for every choice of sides; None for other tasks.

        Returns:
            (n, 3) x, y and the distance that the ball's centre keeps, m.
        """
        return None

    def routed_path(self, x: np.ndarray, c: np.ndarray, sides: tuple[int, ...]) -> np.ndarray:
        """A guessed path (steps+1, 2) on chosen sides of the obstacles, of tasks with a `routed_frame`.

        Args:
            x: (8,) initial state.
            c: (nc,) constants.
            sides: of every obstacle of the observation, repeated ones included: 1 to pass on its left, −1 on its right.
        """
        raise NotImplementedError(f"{self.id} has no routes")

    def without_obstacles(self, c: np.ndarray) -> np.ndarray:
        """(nc,) constants of the same episode with those obstacles out of its way."""
        return c

    @abstractmethod
    def observe(self, x: Vector, c: Vector) -> Vector:
        """Observation (..., no), each quantity divided by its `observation_scale`; no running statistics."""

    def seen(self, x: Vector, c: Vector) -> Vector:
        """`observe`, and of a robot with wheels also cos ψ, sin ψ, ψ̇ and ω_z, these two divided by 5 rad/s."""
        observed = self.observe(x, c)
        more = ops.components(x)[8:]
        if not more:
            return observed
        psi, psi_dot, spin = more
        return ops.stack((*ops.components(observed), ops.cos(psi), ops.sin(psi), psi_dot / 5.0, spin / 5.0), like=x)

    def observation_size(self, params: BallbotParams) -> int:
        """Numbers that a robot observes."""
        return len(self.observation_scale) + (0 if params.wheels is None else 4)

    def heading_cost(self, x: Vector) -> Any:
        """Part of the cost rate, 1/s, by which tasks hold the heading of a robot that yaws."""
        yaw = ops.components(x)[8:9] if self.heading_weight else ()
        return self.heading_weight * 2 * (1 - ops.cos(yaw[0])) if yaw else 0.0

    def margins(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """What optimizers keep ≥ 0. Every task has the tilt limit; obstacles add theirs."""
        return (dynamics.cos_tilt(x) - math.cos(self.max_tilt),)

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        """Centre x, y and radius of the circle that the ball must not leave, m. A task overrides it with a closer one."""
        return 0.0, 0.0, 100.0

    def limits(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Safe iff every entry ≥ 0: the margins, then the arena's, about the distance to its edge, m.

        The arena is no margin, because it is far from every optimum: optimizers need not know it.
        """
        px, py, *_ = ops.components(x)
        x_centre, y_centre, radius = self.arena(c)
        return (*self.margins(x, c), (radius * radius - squared(px - x_centre, py - y_centre)) / (2 * radius))

    def violated(self, x: Vector, c: Vector) -> str:
        """The name of the first limit that one state violates, or "". A state that is not finite violates one."""
        names = zip(self.limit_names, self.limits(x, c), strict=True)
        return next((name for name, limit in names if not limit >= 0), "")

    def observation_signs(self, mirror: Mirror) -> tuple[int, ...]:
        """The sign that each observed quantity takes in the mirror, found by observing a state and its mirror image."""
        rng = np.random.default_rng(0)
        x, c = rng.uniform(0.1, 0.9, 8), rng.uniform(1.0, 2.0, len(self.constant_names))
        seen = self.observe(tuple(x), self.at(tuple(c), 0.5))
        mirrored = self.observe(tuple(x * mirror.state), self.at(tuple(c * (mirror.constants or 1)), 0.5))
        return tuple(1 if math.isclose(a, b, abs_tol=1e-12) else -1 for a, b in zip(seen, mirrored, strict=True))

    def markers(self, c: np.ndarray) -> list[Marker]:
        """What to draw besides the robot."""
        return []

    def is_goal(self, x: Vector, c: Vector) -> bool:
        """Whether one state is in the goal."""
        return all(excess <= 0 for excess in self.goal(x, c))
