"""Task: an optimal-control problem. Environments, experts, optimizers and the leaderboard all use this one definition."""

import math
import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, is_number, is_positive
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.symmetry import Mirror

MAX_STEPS = 1_000_000
"""Control steps in the longest episode that a task may have."""


@dataclass(frozen=True)
class Reference:
    """A steady motion that linear control tracks, one point per control step: x (n, 8) and u (n, 2).

    An open reference is tracked in time, and after its end its last point. A single point is an equilibrium. A closed
    reference repeats indefinitely, and a controller may start at any of its points.
    """

    x: np.ndarray
    u: np.ndarray
    closed: bool = False

    @property
    def is_point(self) -> bool:
        """Whether it is a single point."""
        return len(self.x) == 1


@dataclass(frozen=True)
class Task(ABC):
    """A finite-horizon optimal-control problem, and the rewards that follow from it.

    The reward of a step is (survival_reward − cost rate) · control_dt. A violated limit is a failure: it ends the episode and
    costs survival_reward for every remaining second. Reaching the goal of a first-exit task pays survival_reward for
    every remaining second at once, so that delaying the arrival never pays more than arriving. A first-exit task may pay
    `goal_reward` besides; an episode that does not reach the goal then costs as much more. However an episode ends,
    return + cost = `survival_pay`. So maximizing the return minimizes the cost, for any value of survival_reward.

    x is a state (..., n) and u what the actuators apply (..., m), as `STATE` and `ACTION` of the robot name them; c are the
    episode's constants (..., nc). Cost, margins, goal and observation are written with `ops`, so that NumPy, CasADi and torch
    evaluate the same lines; they are smooth in x and u.

    Where `clock` is True, cost, goal, margins and observation also depend on the episode's time: they find it, s, as
    the last entry of c, after the constants of `constant_names`, and `at` puts it there. All other methods get c without it.
    A step's cost is taken when the step begins, its goal and limits when it ends.

    A task is one file: it fills in the abstract methods, and `register_task` names it.
    """

    duration: float = 8.0
    """Longest episode, s."""
    control_dt: float = 0.02
    """How long each force is held, s."""
    survival_reward: float = 100.0
    """Reward for every second without failure, 1/s. Nearly every motion in the arena costs less per second."""

    id: ClassVar[str]
    """Gymnasium id."""
    ROBOT: ClassVar[str] = "paper"
    """Name of the task's default robot."""
    observation_scale: ClassVar[tuple[float, ...]]
    """What each observed quantity is divided by, in its unit."""
    constant_names: ClassVar[tuple[str, ...]] = ()
    """Names of the episode's constants c, in order."""
    margin_names: ClassVar[tuple[str, ...]] = ()
    """Names of the limits in `margins`, in order."""
    reward_threshold: ClassVar[float | None] = None
    """Mean return on the certified episodes, with default fields, at a mean regret of 10 %."""
    NOT_THE_PROBLEM: ClassVar[frozenset[str]] = frozenset({"survival_reward"})
    """Fields that do not change optima: they shape rewards, or bound a region that no optimum enters."""
    MAY_BE_ZERO: ClassVar[frozenset[str]] = frozenset()
    """Fields that may be 0. `problem` omits fields that are 0, so that it is the same as before they were introduced."""
    mirrors: ClassVar[tuple[Mirror, ...]] = ()
    """Its mirror images. Together with the identity they form a group."""
    frame: ClassVar[str | None] = None
    """Name in `symmetry.FRAMES` of a frame in which the task does not depend on place and direction, or None."""
    routed_frame: ClassVar[str | None] = None
    """Name in `symmetry.FRAMES` of a frame that takes the side on which each obstacle is passed as an input, or None."""
    fine_frame: ClassVar[str | None] = None
    """Name of the same frame with features that resolve small errors, if `frame` has none; or None."""
    constant_draws: ClassVar[int] = 0
    """Number of uniform numbers that `draw_constants` takes."""
    state_draws: ClassVar[int] = 0
    """Number of uniform numbers that `draw_state` takes."""
    first_exit: ClassVar[bool] = False
    """Whether reaching the goal ends the episode."""
    goal_reward: ClassVar[float] = 0.0
    """Paid once where a first-exit task reaches its goal, and the price of not reaching it: for costs that arriving ends, but
    that waiting does not raise."""
    pieces: ClassVar[bool] = False
    """Whether cost, margins or motion consist of smooth pieces, as with an angle that wraps. Optimizers then use the slopes
    of the piece that a state is in. They do not search over sequences of pieces: `guesses` or `search_cases` must do that."""
    counterpart: ClassVar[str] = ""
    """Id of an environment of another package that poses this very problem; see `ballbot_train.RegretWrapper`."""
    clock: ClassVar[bool] = False
    """Whether cost, goal, margins and observation depend on the episode's time."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if not isinstance(each.default, float):
                continue
            value = getattr(self, each.name)
            if not is_number(value):
                raise ValueError(f"{type(self).__name__}: {each.name} must be a number, not {value!r}")
            if not is_positive(value) and not (each.name in self.MAY_BE_ZERO and value == 0):
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

    @property
    def steps(self) -> int:
        """Control steps in the longest episode."""
        return round(self.duration / self.control_dt)

    @property
    def survival_pay(self) -> float:
        """Return plus cost of every episode: survival_reward · duration + goal_reward. It is also the price of failing at the
        start.
        """
        return self.survival_reward * self.duration + self.goal_reward

    @property
    def limit_names(self) -> tuple[str, ...]:
        """Names of the limits in `limits`, in order."""
        return self.margin_names

    def problem(self) -> str:
        """Text of the task's name and the fields that define its optima. It identifies the task of an optimum or a policy."""
        named = (f.name for f in fields(self) if f.name not in self.NOT_THE_PROBLEM)
        named = (name for name in named if name not in self.MAY_BE_ZERO or getattr(self, name))
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in named)})"

    def at(self, c: Vector, time: Any) -> Vector:
        """c (..., nc) as cost, goal, margins, arena and observe take it at an episode's time, s (...).

        That is c unchanged, unless the task has a `clock`: then the time follows the constants.
        """
        return ops.stack((*ops.components(c), time), like=c) if self.clock else c

    def draw_constants(self, z: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        """The constants (nc) as a function of `constant_draws` uniform numbers z in [0, 1); z may hold batches."""
        return ()

    @abstractmethod
    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        """The initial state (8) as a function of `state_draws` uniform numbers z, in an episode with constants c."""

    def start(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        """As `draw_state`, with all components that the robot has.

        Raises:
            ValueError: `draw_state` gives another number of components.
        """
        x = self.draw_state(z, c, params)
        if len(x) != params.state_size:
            names = ", ".join(each.name for each in params.STATE)
            raise ValueError(
                f"{type(self).__name__}.draw_state gives {len(x)} numbers; give the {params.state_size} of the robot's "
                f"state: {names}"
            )
        return x

    def sample(self, rng: np.random.Generator, params: Any) -> tuple[np.ndarray, np.ndarray]:
        """Draws an episode: initial state (8,) and constants (nc,)."""
        c = self.draw_constants(tuple(rng.random(self.constant_draws).tolist()), params)
        x = self.start(tuple(rng.random(self.state_draws).tolist()), c, params)
        return np.array(x, np.float64), np.array(c, np.float64)

    def episode_seed(self, index: int) -> tuple[int, ...]:
        """What seeds the draw of episode `index` of the certified set. The episodes of a task with a `counterpart` are those
        that both environments draw in `reset(seed=index)`.
        """
        if self.counterpart:
            return (index,)
        return zlib.crc32(self.id.encode()), index

    def counterpart_state(self, env: Any) -> tuple[np.ndarray, np.ndarray]:
        """State (n,) and constants (nc,) in which the `counterpart`, an unwrapped environment, is.

        Raises:
            NotImplementedError: the task has no counterpart.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method `counterpart_state`")

    def goal_distance(self, x: Vector, c: Vector) -> Any:
        """Approximate distance of a state from the goal, m, for learners that shape rewards; None if a task defines none."""
        return None

    def measures(self, x: np.ndarray, c: np.ndarray, params: Any) -> dict[str, float]:
        """Quantities that make an episode easy or hard, by name and unit, from its initial state (8,) and constants (nc,).

        Evaluation reports its results by ranges of each quantity. The default is the constants; a task overrides it if
        other quantities describe the difficulty better.
        """
        return dict(zip(self.constant_names, map(float, c), strict=True))

    def check_constants(self, c: np.ndarray, params: Any) -> None:
        """Raises a ValueError that names the first invalid constant."""

    def check_constant_names(self, named: dict[str, Any]) -> None:
        """Raises a ValueError that says which constants the task has, where others are given by name."""
        unknown = sorted(set(named) - set(self.constant_names), key=repr)
        if unknown:
            known = list(self.constant_names) or 'none: leave options["constants"] out'
            raise ValueError(f"{self.id} has no constants {unknown}; it has {known}")

    @abstractmethod
    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        """Cost rate, 1/s, ≥ 0: the episode costs its sum over control steps times control_dt."""

    @abstractmethod
    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Numbers that are all ≤ 0 in the goal: at the first such state if `first_exit`, else at the end of the episode."""

    def reference(self, x: np.ndarray, c: np.ndarray, params: Any) -> Reference:
        """The steady motion that linear control steers to from state x; default, the robot's rest."""
        return Reference(params.rest()[None], np.zeros((1, params.action_size)))

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[np.ndarray]:
        """Paths (n+1, 2), m, of a ballbot's ball along which optimizers start; tasks of other robots have `guesses` alone."""
        return []

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """States (n+1, n_x) and actions (n, n_u) from state x as initial guesses of optimizers, the likeliest first.

        They need not be motions of the robot; n = `steps`, or less for first-exit tasks. The default goes straight to the
        end of the reference, and stays there.
        """
        target = self.reference(x, c, params)
        share = np.minimum(np.linspace(0, 2, self.steps + 1), 1.0)[:, None]
        return [((1 - share) * x + share * target.x[-1], np.repeat(target.u[-1:], self.steps, axis=0))]

    def search_cases(self, episode: Any) -> list[Any] | None:
        """Solutions of the task's own search, which replaces the search from `guesses`: for motions that are smooth only
        case by case.

        Args:
            episode: the problem, a `ballbot_baselines.solvers.shooting.Shooting`.

        Returns:
            its `Solution`s, of which the best is taken; None if the task has no search of its own.
        """
        return None

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

    def seen(self, x: Vector, c: Vector, params: Any) -> Vector:
        """`observe`, followed by the robot's `outputs`, each divided by its `OUTPUT_SCALE`."""
        observed = self.observe(x, c)
        outputs = params.outputs(x)
        if not outputs:
            return observed
        more = (output / scale for output, scale in zip(outputs, params.OUTPUT_SCALE, strict=True))
        return ops.stack((*ops.components(observed), *more), like=x)

    def observation_size(self, params: Any) -> int:
        """Numbers that a robot observes."""
        return len(self.observation_scale) + len(params.OUTPUTS)

    def margins(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Numbers, named in `margin_names`, that optimizers keep ≥ 0, such as the distance to an obstacle."""
        return ()

    def limits(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Numbers, named in `limit_names`: a negative one is a failure.

        They are the margins, and limits that no optimum comes near, so that optimizers do not need them.
        """
        return self.margins(x, c)

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

    def goal_error(self, x: Vector, c: Vector) -> Any:
        """How far a state is from the goal, in units of the goal's tolerances: at most 1 in the goal.

        It is the largest error over its tolerance where each entry of `goal` is (error / tolerance)² − 1, as in all tasks of
        this package.
        """
        largest, *others = self.goal(x, c)
        for excess in others:
            largest = ops.maximum(largest, excess)
        return ops.sqrt(ops.clip(largest + 1.0, 0.0, math.inf))

    def is_goal(self, x: Vector, c: Vector) -> bool:
        """Whether one state is in the goal."""
        return all(excess <= 0 for excess in self.goal(x, c))
