"""Curricula: what training may make easier than the task, as named settings that a run's record holds.

A curriculum changes training alone. What is evaluated is always the task itself. All of it is off by default.

- The goal's tolerances begin wider, and narrow by a factor whenever enough training episodes succeed.
- A field of the task that bounds what is drawn, as Turn's `max_speed`, begins at an easier value, and goes to the task's own
  by a step whenever enough training episodes succeed.
- A share of the episodes begins in states along optima, with the time that is left there. These optima are those of training
  episodes drawn for this purpose. No certified episode is among them. These
  episodes can begin shortly before the end of their optimum at first, and ever earlier as enough of them succeed (Florensa et
  al., "Reverse curriculum generation for reinforcement learning", 2017).
- A share of the episodes, also of those on optima, repeats starts from which recent ones failed or missed their goal. So what
  is hard is met more often, as the narrow band of speeds where Turn's best way switches (after Jiang et al., "Prioritized
  level replay", 2021).
- A curriculum is over when the goal and that field are the task's own and enough episodes succeed. From then on a failure can
  cost less, fewer starts are repeated, and schedules of the learner that waited go on.
- A share of the episodes is cut soon after its start, so that more of the samples are of starts.
- Rewards are shaped by a potential, minus the distance to the goal. Shaping by a potential moves no optimum (Ng et al.,
  "Policy invariance under reward transformations", 1999).

`CurriculumBatch` does this for any learner that steps a `BallbotBatch`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from ballbot_gym.batch import BallbotBatch, BatchStep
from ballbot_gym.ops import Vector
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_train.console import console
from ballbot_train.evaluation import fresh

_ARENAS = ("arena_radius", "arena_factor")  # the fields that bound the arena
_NO_ARENA = 1e4  # of either: farther than any episode goes
_OWN, _ON_OPTIMUM = 0, 1  # how an episode began
_NEEDS = {f"starts_{name}": "starts_on_optima" for name in ("seconds", "success", "reserve", "goal_factor")}
_NEEDS["retries_per_failure"] = "retries"
_KEPT_STARTS = 1024  # of the last episodes that went wrong


@dataclass(frozen=True)
class Curriculum:
    """What training makes easier. Evaluation is always the task itself.

    Raises:
        ValueError: a setting is out of its range.
    """

    goal_factor: float = 1.0
    """The goal's tolerances are so many times wider at the start of training; 1: off."""
    goal_step: float = 0.97
    """Factor by which they narrow whenever enough episodes succeed, until they are the task's own."""
    ramp: str = ""
    """Field of the task that begins at an easier value, as max_speed of turn; default, none."""
    ramp_start: float = 0.0
    """Value of that field at the start of training, in its unit."""
    ramp_step: float = 0.1
    """How much nearer the field comes to the task's own value whenever enough episodes succeed, in its unit."""
    success: float = 0.7
    """Share of the training episodes that is enough. Episodes that begin on optima do not count."""
    settled_success: float = 0.0
    """Share that is enough, once the goal and `ramp` are the task's own, for what comes after the curriculum: the settings
    that begin with last_, and the rest of the schedules that wait for it. 0: it comes at once."""
    episodes: int = 256
    """Number of ended training episodes after which that share is looked at; then they are counted anew."""
    starts_on_optima: float = 0.0
    """Share of the training episodes that begin in a state along an optimum, drawn from all values of the task; 0: off.
    They are states of optima that the run finds first."""
    optima: int = 64
    """Number of optima that the run finds for them, of about a second each."""
    starts_seconds: float = 0.0
    """How long before the end of their optimum these episodes begin at most, at the start of training, s; 0: anywhere."""
    starts_step: float = 0.1
    """How much longer that gets whenever enough of these episodes succeed, s."""
    starts_success: float = 0.0
    """Share of these episodes that has to succeed besides those that begin as the task's own do, before the goal narrows. It
    does not narrow either before they begin anywhere. 0: it does in any case."""
    starts_reserve: float = 0.0
    """Share of the goal's tolerances that these optima leave unused. Without one, slow optima touch the goal where no noise
    is allowed, and loops, which are safer, begin at higher speeds."""
    starts_goal_factor: float = 0.0
    """No more episodes begin on optima when the goal's tolerances have narrowed to so many times the task's own, and `ramp`
    has ended; 0: they do to the end. Where the goal is narrow, many such episodes begin too close before it for a policy that
    comes otherwise."""
    retries: float = 0.0
    """Share of the training episodes, of the task's own and of those on optima, that repeat the start of one of the last such
    episodes that failed or, on a task that ends at its goal, missed it; 0: off. They do not count for `success`."""
    retries_per_failure: float = 0.0
    """Once the curriculum is over, the share that repeats starts is at most so many times that of the task's own episodes
    that went wrong lately; 0: it is `retries` in any case."""
    last_failure_price: float = 0.0
    """Price of a failure, where living does not pay, once the curriculum is over; 0: as before. A high one teaches not to
    fail, and beside a low one cost is learnt too."""
    short_episodes: float = 0.0
    """Share of the training episodes that are cut after `short_seconds`; 0: off. So more of the samples are of the starts,
    where most of a good policy's regret arises."""
    short_seconds: float = 0.6
    """Duration of those episodes, s."""
    shaping: float = 0.0
    """Weight w of the potential −w · `goal_distance` by which rewards are shaped, 1/m, before they are scaled; 0: off."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("goal_factor", 1.0, 1e3),
            ("goal_step", 1e-3, 1 - 1e-6),
            ("ramp_start", 0.0, 1e6),
            ("ramp_step", 1e-9, 1e6),
            ("success", 0.0, 1.0),
            ("settled_success", 0.0, 1.0),
            ("episodes", 1, 10**9),
            ("starts_on_optima", 0.0, 1.0),
            ("optima", 1, 10**6),
            ("starts_seconds", 0.0, 1e6),
            ("starts_step", 1e-9, 1e6),
            ("starts_success", 0.0, 1.0),
            ("starts_reserve", 0.0, 1 - 1e-6),
            ("starts_goal_factor", 0.0, 1e3),
            ("retries", 0.0, 1.0),
            ("retries_per_failure", 0.0, 1e6),
            ("last_failure_price", 0.0, 1e9),
            ("short_episodes", 0.0, 1.0),
            ("short_seconds", 1e-3, 1e6),
            ("shaping", 0.0, 1e6),
        ):
            value = getattr(self, name)
            if not low <= value <= high:  # NaN is in no range
                raise ValueError(f"curriculum.{name} must be {low:g} to {high:g}, not {value}")

    @property
    def active(self) -> bool:
        """Whether it changes anything."""
        return (
            self.goal_factor > 1
            or self.ramp != ""
            or self.starts_on_optima > 0
            or self.retries > 0
            or self.short_episodes > 0
            or self.shaping > 0
        )

    def check(self, task: Task) -> None:
        """Raises a ValueError that says what of this the task does not have."""
        # a batch computes its substeps from control_dt in advance
        numbers = [f.name for f in fields(task) if isinstance(f.default, float) and f.name != "control_dt"]
        if self.ramp and self.ramp not in numbers:
            raise ValueError(f"{task.id} has no field {self.ramp!r} for curriculum.ramp; it has {', '.join(numbers)}")
        if self.ramp:
            try:
                replace(task, **{self.ramp: self.ramp_start})
            except ValueError as error:
                raise ValueError(f"curriculum.ramp_start {self.ramp_start:g} is out of range: {error}") from error
        for name, needed in _NEEDS.items():  # what would do nothing says so
            if getattr(self, name) and not getattr(self, needed):
                raise ValueError(f"curriculum.{name} needs curriculum.{needed} above 0; without it give 0")
        if self.starts_seconds and not task.first_exit:
            raise ValueError(f"{task.id} does not end at its goal, so curriculum.starts_seconds must be 0")
        if self.starts_on_optima and self.starts_goal_factor and self.starts_goal_factor >= self.goal_factor:
            raise ValueError(
                f"curriculum.starts_goal_factor must be less than curriculum.goal_factor {self.goal_factor:g}, "
                f"not {self.starts_goal_factor:g}"
            )
        if self.short_episodes and task.first_exit:
            raise ValueError(
                f"{task.id} pays at its goal for the time that is left, so curriculum.short_episodes must be 0"
            )
        if self.shaping and task.goal_distance((0.0,) * 8, (1.0,) * len(task.constant_names)) is None:
            raise ValueError(f"{task.id} has no goal_distance for curriculum.shaping; only tasks that define it have")


class Starts(NamedTuple):
    """n states along optima, as tensors."""

    x: torch.Tensor
    """(8, n) states."""
    c: torch.Tensor
    """(nc, n) constants of their episodes."""
    steps: torch.Tensor
    """(n,) int64, control steps that have passed of their episodes."""
    left: torch.Tensor
    """(n,) int64, control steps to the end of the optimum."""


@dataclass
class _Tally:
    """Episodes that ended."""

    ended: int = 0
    """Since they were last looked at."""
    succeeded: int = 0
    """Of these."""
    share: float = math.nan
    """Of successes, when they were last looked at."""

    def state(self) -> list[float]:
        return [self.ended, self.succeeded, self.share]


class CurriculumBatch(BallbotBatch):
    """A batch whose episodes and rewards are those of a curriculum, for training.

    It draws from torch's global generator. `task` is the task at its present difficulty.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        params: BallbotParams,
        curriculum: Curriculum,
        gamma: float,
        full: Task | None = None,
        pay: bool = True,
        failure_price: float = 0.0,
    ):
        """Makes the batch.

        Args:
            task: the task in training, perhaps with shorter episodes.
            num_envs: B.
            params: the robot.
            curriculum: what is easier.
            gamma: discount factor of the learner, for shaping.
            full: the task itself, whose optima are found; default, `task`.
            pay: whether living pays; else the reward is minus the running cost, and a failure costs its price at once.
            failure_price: of a failure, where living does not pay.

        Raises:
            ValueError: the task has not what the curriculum asks for.
        """
        curriculum.check(task)
        super().__init__(task, num_envs, compile=False, params=params)
        self.curriculum = curriculum
        self._own, self.gamma, self._pay, self._failure_price = task, gamma, pay, failure_price
        self._goal_factor = curriculum.goal_factor
        self._ramp = curriculum.ramp_start if curriculum.ramp else 0.0
        self._reach = curriculum.starts_seconds
        self._own_episodes, self._on_optima = _Tally(), _Tally()  # that ended, by how they began
        self._has_settled = not curriculum.settled_success  # whether enough episodes of the task itself have succeeded
        self._kind = torch.full((num_envs,), _OWN, dtype=torch.int8)
        self._again = torch.zeros(num_envs, dtype=torch.bool)  # whose start is repeated
        rows = 8 + len(task.constant_names) + 1
        self.last_potential = torch.zeros(num_envs)
        """(B,) potential of the states from which the last step was taken; 0 without shaping."""
        self._begun = torch.zeros(
            rows, num_envs
        )  # states, constants and passed steps at the starts of the running episodes
        self._hard = [torch.zeros(rows, 0)] * 2  # those of the last episodes of each kind that went wrong
        self._full = task if full is None else full
        self._starts: Starts | None = None
        self._set_difficulty()

    @property
    def difficulty(self) -> dict[str, float]:
        """How far the curriculum has come, by name."""
        curriculum, reached = self.curriculum, {}
        if curriculum.goal_factor > 1:
            reached["goal_factor"] = self._goal_factor
        if curriculum.ramp:
            reached[curriculum.ramp] = self._ramp
        if curriculum.starts_seconds:
            reached["starts_seconds"], reached["starts_success"] = self._reach, self._on_optima.share
        return reached | ({"success": self._own_episodes.share} if reached else {})

    def reset(self, *args: Any, mask: torch.Tensor | None = None, **given: Any) -> torch.Tensor:
        """As of `BallbotBatch`: these episodes begin as the task's own do."""
        observation = super().reset(*args, mask=mask, **given)
        begun = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask
        self._kind = torch.where(begun, _OWN, self._kind)
        self._again = self._again & ~begun
        self._begin(begun)
        return observation

    @torch.no_grad()
    def step(self, actions: torch.Tensor) -> BatchStep:
        """As of `BallbotBatch`, with the rewards and the next episodes of the curriculum. It carries no gradients."""
        before, task = self.state, self.task
        result = super().step(actions)
        assert before is not None  # else the step above raises
        reward = result.reward
        if not self._pay:
            survive = task.survival_reward * task.control_dt
            reward = reward - survive - self._present_failure_price * result.failure
            if task.first_exit:
                reward = reward - survive * (task.steps - before.steps - 1) * result.success
        if self.curriculum.shaping:
            start = self.last_potential = self._potential(before.x, before.c)
            end = self._potential(result.final_x, before.c)
            # An episode that terminates ends with a potential of 0, and a truncated one goes on.
            reward = reward + self.gamma * torch.where(result.terminated, 0.0, end) - start
        ended = result.terminated | result.truncated
        counted = ended & ~self._again
        self._count(counted & (self._kind == _OWN), result.success)
        if self.curriculum.starts_on_optima:
            self._count_starts(counted & (self._kind == _ON_OPTIMUM), result.success)
        if self.curriculum.retries:
            self._keep_hard(result)
        self._kind, self._again = torch.where(ended, _OWN, self._kind), self._again & ~ended
        began = self.state
        if self._some_start_on_optima:
            self._start_on_optima(ended)
        if self.curriculum.retries:
            self._retry(ended)
        if self.state is not began:  # some were moved
            assert self.state is not None
            result = result._replace(
                observation=torch.where(ended[:, None], self.observe(self.state), result.observation)
            )
        self._begin(ended)
        if self.curriculum.short_episodes:
            self._shorten(ended)
        return result._replace(reward=reward)

    def curriculum_state(self) -> dict[str, Any]:
        """What the batch remembers besides `state`: tensors and plain values."""
        return {
            "goal_factor": self._goal_factor,
            "ramp": self._ramp,
            "reach": self._reach,
            "settled": self._has_settled,
            "own_episodes": self._own_episodes.state(),
            "on_optima": self._on_optima.state(),
            "kind": self._kind,
            "again": self._again,
            "begun": self._begun,
            "hard": self._hard,
            "starts": None if self._starts is None else list(self._starts),
        }

    def load_curriculum_state(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""
        self._goal_factor, self._ramp, self._reach = state["goal_factor"], state["ramp"], state["reach"]
        self._has_settled = state["settled"]
        self._own_episodes, self._on_optima = _Tally(*state["own_episodes"]), _Tally(*state["on_optima"])
        self._kind, self._again = state["kind"], state["again"]
        self._begun, self._hard = state["begun"], list(state["hard"])
        self._starts = None if state["starts"] is None else Starts(*state["starts"])
        self._set_difficulty()

    def _potential(self, x: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        return -self.curriculum.shaping * self.task.goal_distance(x.unbind(0), c.unbind(0))

    def _count(self, ended: torch.Tensor, success: torch.Tensor) -> None:
        """Counts the episodes that ended, and makes the task harder if enough of them succeeded."""
        if not self._complete(self._own_episodes, ended, success):
            return
        if self._is_own:
            self._has_settled |= self._own_episodes.share >= self.curriculum.settled_success
        if self._enough(self._own_episodes) and (self._optima_succeed or not self._is_wide):
            self._harden()

    def _count_starts(self, ended: torch.Tensor, success: torch.Tensor) -> None:
        """Counts the ended episodes that began on optima, and lets them begin earlier if enough of them succeeded."""
        complete = self._complete(self._on_optima, ended, success)
        if complete and self._enough(self._on_optima) and 0 < self._reach < self._own.duration:
            self._reach = min(self._reach + self.curriculum.starts_step, self._own.duration)
            self._eligible = None

    @property
    def _optima_succeed(self) -> bool:
        """Whether enough of the episodes on optima succeed for a narrower goal."""
        enough = self.curriculum.starts_success
        if not self._some_start_on_optima or not enough:
            return True
        anywhere = not self._reach or self._reach >= min(self._longest, self._own.duration)
        return anywhere and self._on_optima.share >= enough

    @property
    def _some_start_on_optima(self) -> bool:
        """Whether a share of the episodes begins on optima at present."""
        ends = self._goal_factor <= self.curriculum.starts_goal_factor and not self._is_ramping
        return self.curriculum.starts_on_optima > 0 and not ends

    @property
    def _longest(self) -> float:
        """Duration of the longest optimum, s."""
        return math.inf if self._starts is None else float(self._starts.left.max()) * self.task.control_dt

    def _complete(self, tally: "_Tally", ended: torch.Tensor, success: torch.Tensor) -> bool:
        """Counts the episodes that ended. True where `episodes` are complete now; their share of successes is then new."""
        tally.ended += int(ended.sum())
        tally.succeeded += int((ended & success).sum())
        if tally.ended < self.curriculum.episodes:
            return False
        tally.share = tally.succeeded / tally.ended
        tally.ended = tally.succeeded = 0
        return True

    def _enough(self, tally: "_Tally") -> bool:
        """Whether enough of the episodes succeeded, when they were last looked at."""
        return tally.share >= self.curriculum.success

    @property
    def _present_failure_price(self) -> float:
        last = self.curriculum.last_failure_price
        return last if last and self.is_settled else self._failure_price

    @property
    def is_settled(self) -> bool:
        """Whether the curriculum is over: the goal and the field `ramp` are the task's own, and enough episodes succeed."""
        return self._is_own and self._has_settled

    @property
    def _is_own(self) -> bool:
        """Whether the goal and the field `ramp` are the task's own."""
        return not (self._is_wide or self._is_ramping)

    @property
    def _is_wide(self) -> bool:
        """Whether the goal is wider than the task's own."""
        return self._goal_factor > 1

    @property
    def _is_ramping(self) -> bool:
        """Whether the field `ramp` is not the task's own yet."""
        ramp = self.curriculum.ramp
        return bool(ramp) and self._ramp != getattr(self._own, ramp)

    def _harden(self) -> None:
        """Takes a step towards the task itself."""
        curriculum = self.curriculum
        own = getattr(self._own, curriculum.ramp) if curriculum.ramp else 0.0
        wide, easy = self._is_wide, self._is_ramping
        if wide:
            self._goal_factor = max(1.0, self._goal_factor * curriculum.goal_step)
        elif easy:
            away = own - self._ramp
            self._ramp = (
                own if abs(away) <= curriculum.ramp_step else self._ramp + math.copysign(curriculum.ramp_step, away)
            )
        if wide or easy:
            self._set_difficulty()

    def _set_difficulty(self) -> None:
        """Makes `task` what the curriculum has reached."""
        task = self._own
        if self.curriculum.ramp:
            task = replace(task, **{self.curriculum.ramp: self._ramp})
        vars(self)["task"] = widened(task, self._goal_factor)  # a batch computes nothing from goal and ramp in advance
        self._eligible: torch.Tensor | None = None

    def _start_on_optima(self, ended: torch.Tensor) -> None:
        """Moves a share of the episodes that have just begun into states along optima."""
        if self._starts is None:
            self._starts = optimal_starts(
                self._full, self.params, self.curriculum.optima, self._own.steps, self.curriculum.starts_reserve
            )
        if self._eligible is None:  # states outside of the goal, which may be wide
            inside = self.task.goal(
                self._starts.x.unbind(0), self.task.at(self._starts.c.unbind(0), self.task.duration)
            )
            reached = torch.stack([excess <= 0 for excess in inside]).all(0)
            near = torch.ones_like(reached)
            if self._reach:
                near = near & (self._starts.left <= max(1, round(self._reach / self.task.control_dt)))
            outside = (near & ~reached).nonzero()[:, 0]
            self._eligible = outside if len(outside) else near.nonzero()[:, 0]
        moved = ended & (torch.rand(self.num_envs) < self.curriculum.starts_on_optima)
        self._kind = torch.where(moved, _ON_OPTIMUM, self._kind)
        starts, count = self._starts, int(moved.sum())
        if not count:
            return
        lengths = (starts.steps + starts.left)[self._eligible]  # so that every optimum is met as often as any other
        chosen = self._eligible[torch.multinomial(1.0 / lengths, count, replacement=True)]
        self._move(moved, starts.x[:, chosen], starts.c[:, chosen], starts.steps[chosen])

    def _keep_hard(self, result: BatchStep) -> None:
        """Remembers the starts of the episodes that have just gone wrong."""
        wrong = result.failure
        if self.task.first_exit:
            wrong = wrong | (result.truncated & ~result.success)
        for kind in range(len(self._hard)):
            starts = self._begun[:, wrong & (self._kind == kind)]
            self._hard[kind] = torch.cat([self._hard[kind], starts], 1)[:, -_KEPT_STARTS:]

    def _retry(self, ended: torch.Tensor) -> None:
        """Moves a share of the episodes that have just begun to starts from which others of their kind went wrong."""
        drawn = ended & (torch.rand(self.num_envs) < self._retried_share)
        for kind, hard in enumerate(self._hard):
            again = drawn & (self._kind == kind)
            if not hard.shape[1]:
                continue
            self._again = self._again | again
            chosen = hard[:, torch.randint(hard.shape[1], (int(again.sum()),))]
            self._move(again, chosen[:8], chosen[8:-1], chosen[-1].long())

    @property
    def _retried_share(self) -> float:
        """The share of the episodes that repeats starts."""
        retries, most = self.curriculum.retries, self.curriculum.retries_per_failure
        wrong = 1 - self._own_episodes.share
        return min(retries, most * wrong) if most and self.is_settled and math.isfinite(wrong) else retries

    def _begin(self, begun: torch.Tensor) -> None:
        """Remembers the starts of the episodes that have just begun, if any may be repeated."""
        if not self.curriculum.retries:
            return
        assert self.state is not None
        starts = torch.cat([self.state.x, self.state.c, self.state.steps[None]]).float()
        self._begun = torch.where(begun, starts, self._begun)

    def _move(self, moved: torch.Tensor, x: torch.Tensor, c: torch.Tensor, passed: torch.Tensor) -> None:
        """Moves n of the B episodes to states (8, n), constants (nc, n) and counts (n,) of control steps that have passed."""
        if not moved.any():
            return
        assert self.state is not None
        states, constants, steps = self.state.x.clone(), self.state.c.clone(), self.state.steps.clone()
        states[:, moved], constants[:, moved], steps[moved] = x.to(states.dtype), c.to(constants.dtype), passed
        self.state = self.state._replace(x=states, c=constants, steps=steps)

    def _shorten(self, ended: torch.Tensor) -> None:
        """Cuts a share of the episodes that have just begun: their clocks start late, which no observation shows."""
        assert self.state is not None
        least = self.task.steps - max(1, round(self.curriculum.short_seconds / self.task.control_dt))
        short = ended & (torch.rand(self.num_envs) < self.curriculum.short_episodes)
        self.state = self.state._replace(steps=torch.where(short, self.state.steps.clamp(min=least), self.state.steps))


def widened(task: Task, factor: float) -> Task:
    """The task with tolerances of its goal that are `factor` times wider.

    Every goal function is a ratio of squares, less 1.
    """
    if factor == 1:
        return task
    kind = type(task)

    def goal(self: Any, x: Vector, c: Vector) -> tuple[Any, ...]:
        return tuple((excess + 1) / factor**2 - 1 for excess in kind.goal(self, x, c))

    wide: Any = type(kind.__name__, (kind,), {"goal": goal, "__module__": kind.__module__})
    return wide(**{field.name: getattr(task, field.name) for field in fields(task)})


def without_arena(task: Task) -> Task:
    """The task with an arena so large that no episode leaves it."""
    return replace(task, **{field.name: _NO_ARENA for field in fields(task) if field.name in _ARENAS})


def optimal_starts(task: Task, params: BallbotParams, count: int, steps: int, reserve: float = 0.0) -> Starts:
    """The states along the optima of `count` episodes drawn for training, before their ends and before control step `steps`.

    The optima leave the share `reserve` of the goal's tolerances unused.

    Raises:
        ValueError: no optimum was found.
    """
    from ballbot_baselines.optimum import Backoff, find_optimum  # it imports CasADi

    console.print(f"finding {count} optima on which training episodes begin")
    found, backoff = [], Backoff(goal=max(Backoff.goal, reserve))
    for x, c in zip(*fresh.draw(task, range(count), 0, "training"), strict=True):
        try:
            states = find_optimum(task, params, x, c, backoff).trajectory.x
        except PlanError:
            continue
        found.append((states, c))
    if not found:
        raise ValueError(f"{task.id}: no optimum was found on which episodes could begin")
    return _starts(found, steps)


def _starts(found: list[tuple[np.ndarray, np.ndarray]], steps: int) -> Starts:
    """Starts before control step `steps`, of pairs of states (n + 1, 8) at n control steps and in the end, and constants."""
    counts = [min(len(states) - 1, steps) for states, _ in found]
    x = np.concatenate([states[:n] for n, (states, _) in zip(counts, found, strict=True)])
    c = np.concatenate([np.tile(c, (n, 1)) for n, (_, c) in zip(counts, found, strict=True)])
    passed = np.concatenate([np.arange(n) for n in counts])
    left = np.concatenate([len(states) - 1 - np.arange(n) for n, (states, _) in zip(counts, found, strict=True)])
    return Starts(
        torch.from_numpy(x.T.copy()), torch.from_numpy(c.T.copy()), torch.from_numpy(passed), torch.from_numpy(left)
    )
