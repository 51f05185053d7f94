"""Task: the one definition of an optimal-control problem that env, experts, optimizer and leaderboard use."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import dynamics
from ballbot_gym.ops import Vector
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks.marker import Marker


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
    """A finite-horizon optimal-control problem, from which the episode's reward is −cost.

    x is a state (..., 8), u a force (..., 2) in N, c the episode's constants (..., nc). Cost, margins, goal and observation
    are written with `ops`, so that NumPy, CasADi and torch evaluate the same lines; they are smooth in x and u.

    A task is one file: it fills in the abstract methods, and `TASKS` names it.
    """

    duration: float = 8.0
    """Longest episode, s."""
    control_dt: float = 0.02
    """How long each force is held, s."""
    max_tilt: float = math.radians(80)
    """Tilt beyond which the robot has fallen, rad."""
    failure_cost: float = 1000.0
    """Charged when a margin is violated: ten times what the dearest of thousands of drawn episodes costs at its optimum,
    and more than surviving costs LQR. It bounds what a policy that tries costs, not one that drives away for ever."""

    id: ClassVar[str]
    """Gymnasium id."""
    observation_scale: ClassVar[tuple[float, ...]]
    """What each observed quantity is divided by, in its unit."""
    constant_names: ClassVar[tuple[str, ...]] = ()
    """Names of the episode's constants c, in order."""
    margin_names: ClassVar[tuple[str, ...]] = ("tilt",)
    """What each of `margins` keeps, for messages."""
    constant_draws: ClassVar[int] = 0
    """Uniform numbers that `draw_constants` takes."""
    state_draws: ClassVar[int] = 0
    """Uniform numbers that `draw_state` takes."""
    first_exit: ClassVar[bool] = False
    """Whether reaching the goal ends the episode."""

    OBSERVATION_LIMIT: ClassVar[float] = 1e6
    """Bound of the observation space. What 350 N can reach within 8 s, 700 m away, stays below it in every task."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not 0 < value < math.inf:
                raise ValueError(f"{type(self).__name__}: {field.name} must be positive and finite, not {value}")
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

    def draw_constants(self, z: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        """The constants (nc) that `constant_draws` uniform numbers z in [0, 1) stand for; z may hold batches."""
        return ()

    @abstractmethod
    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        """The initial state (8) that `state_draws` uniform numbers z stand for, in an episode with constants c."""

    def sample(self, rng: np.random.Generator, params: BallbotParams) -> tuple[np.ndarray, np.ndarray]:
        """Draws an episode: initial state (8,) and constants (nc,)."""
        c = self.draw_constants(tuple(rng.random(self.constant_draws).tolist()), params)
        x = self.draw_state(tuple(rng.random(self.state_draws).tolist()), c, params)
        return np.array(x, np.float64), np.array(c, np.float64)

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

    @abstractmethod
    def observe(self, x: Vector, c: Vector) -> Vector:
        """Observation (..., no), each quantity divided by its `observation_scale`; no running statistics."""

    def margins(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        """Safe iff every entry ≥ 0. Every task has the tilt limit; obstacles add theirs."""
        return (dynamics.cos_tilt(x) - math.cos(self.max_tilt),)

    def markers(self, c: np.ndarray) -> list[Marker]:
        """What to draw besides the robot."""
        return []

    def is_safe(self, x: Vector, c: Vector) -> bool:
        """Whether one state violates no margin; a state that is not finite does."""
        return all(margin >= 0 for margin in self.margins(x, c))

    def is_goal(self, x: Vector, c: Vector) -> bool:
        """Whether one state is in the goal."""
        return all(excess <= 0 for excess in self.goal(x, c))
