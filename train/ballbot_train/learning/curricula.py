"""Training episodes that are easier than the task, or begin in more useful states. Evaluation always uses the task itself.

- `backwards`: for tasks that end at their goal, which chance does not find.
  - The goal's tolerances begin wider, and narrow by a factor whenever enough episodes succeed. Then a field of the task that
    bounds what is drawn, as Turn's `max_speed`, goes from an easier value to the task's own.
  - Half of the episodes begin in states along optima of training episodes, with the time that is left there: shortly before
    the end at first, and ever earlier as enough of them succeed (Florensa et al., "Reverse curriculum generation for
    reinforcement learning", 2017).
  - A share of the episodes repeats the starts of recent episodes that failed or missed the goal. So hard starts are frequent,
    such as the narrow band of speeds where Turn's best way switches (after Jiang et al., "Prioritized level replay", 2021).
  - Rewards are minus the cost, shaped by a potential, minus the distance to the goal. Shaping moves no optimum (Ng et al.,
    "Policy invariance under reward transformations", 1999). Living would pay for missing the goal.
  - It is over when goal and field are the task's own and enough episodes succeed. From then on a failure costs less, and
    fewer starts are repeated.
"""

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from ballbot_gym.ops import Vector
from ballbot_gym.robot import Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.vector.batch import BallbotBatch, BatchStep
from ballbot_train.evaluation import fresh
from ballbot_train.learning.state import load_state, state_of
from ballbot_train.work.console import console

FAILURE_PRICE = 60.0
"""Cost of a failure where the reward has no bonus for survival; it is due at once."""

_GOAL_FACTOR, _GOAL_STEP = 5.0, 0.97  # how much wider the goal begins, and the factor by which it narrows
_RAMPS = {"max_speed": (4.05, 0.2)}  # fields that bound what is drawn: where they begin, and the step to the task's own
_EPISODES = 256  # episodes after which their share of successes is checked and counting restarts
_SUCCESS = 0.75  # share of them that is enough for a step
_SETTLED_SUCCESS = 0.85  # of the task's own episodes, for the curriculum to be over
_ON_OPTIMA = 0.5  # share of the episodes that begins on optima, while the goal is wider or the field another
_OPTIMA = 200
_OPTIMA_SUCCESS = 0.6  # share of those episodes that has to succeed too before the goal narrows
_RESERVE = 0.4  # share of the goal's tolerances that optima leave unused: noise must be allowed where slow ones end
_REACH, _REACH_STEP = 0.1, 0.15  # s: how long before the end of their optimum they begin, and how much earlier then
_RETRIES, _RETRIES_PER_FAILURE = 0.4, 10.0  # share that repeats starts; later a multiple of the share that goes wrong
_SHAPING = 10.0  # 1/m
_EARLY_FAILURE_PRICE = 300.0  # while the curriculum lasts: it teaches not to fail; a low price teaches a low cost
_KEPT_STARTS = 1024  # of the last episodes that went wrong
_OWN, _ON_OPTIMUM = 0, 1  # how an episode began
_STATE = (
    *("_goal_factor", "_ramp", "_reach", "_has_settled", "_counts", "_shares"),
    *("_kind", "_again", "_begun", "_hard", "_starts"),
)


class CurriculumBatch(BallbotBatch):
    """A batch whose episodes and rewards are those of training.

    It draws from torch's global generator. `task` is the task at its present difficulty.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        params: Robot,
        gamma: float = 1.0,
        full: Task | None = None,
        backwards: bool = False,
        **world: Any,
    ):
        """Makes the batch.

        Args:
            task: the task in training, perhaps with shorter episodes.
            num_envs: B.
            params: the robot.
            gamma: discount factor of the learner, for shaping.
            full: the task itself, whose optima are found; default, `task`.
            backwards: whether training goes from the goal backwards.
            world: randomization and history, see `BallbotBatch`.

        Raises:
            ValueError: the task has not what this asks for.
        """
        distance = task.goal_distance((0.0,) * 8, (1.0,) * len(task.constant_names))
        if backwards and (not task.first_exit or distance is None):
            raise ValueError(f"{task.id} cannot be learned backwards: it needs first_exit and goal_distance")
        super().__init__(task, num_envs, compile=False, params=params, **world)
        self.gamma, self.own_task, self._full = gamma, task, task if full is None else full
        self.backwards = backwards
        self._goal_factor = _GOAL_FACTOR if backwards else 1.0
        ramps = {name: start for name, (start, _) in _RAMPS.items() if backwards and hasattr(task, name)}
        self._ramp = {name: min(start, getattr(task, name)) for name, start in ramps.items()}
        self._reach = _REACH
        # by how they began: the episodes that ended since they were last looked at and those of them that succeeded; and the
        # share of successes when they were
        self._counts, self._shares = {_OWN: (0, 0), _ON_OPTIMUM: (0, 0)}, {_OWN: math.nan, _ON_OPTIMUM: math.nan}
        self._has_settled = not backwards  # whether enough episodes of the task itself have succeeded
        self._kind = torch.full((num_envs,), _OWN, dtype=torch.int8)
        self._again = torch.zeros(num_envs, dtype=torch.bool)  # whose start is repeated
        # states, constants and passed steps: at the starts of the running episodes, at those of the last ones of each kind
        # that went wrong, and, with the steps that are left, along optima
        rows = 8 + len(task.constant_names) + 1
        self._begun, self._hard = torch.zeros(rows, num_envs), [torch.zeros(rows, 0)] * 2
        self._starts: torch.Tensor | None = None
        self._set_difficulty()

    @property
    def difficulty(self) -> dict[str, float]:
        """How far the curriculum has come, by name; empty without one."""
        if not self.backwards:
            return {}
        shares = {"starts_success": self._shares[_ON_OPTIMUM], "success": self._shares[_OWN]}
        return {"goal_factor": self._goal_factor, **self._ramp, "starts_seconds": self._reach, **shares}

    @property
    def is_settled(self) -> bool:
        """Whether the curriculum is over: the task is its own, and enough episodes succeed."""
        return not self._is_easier and self._has_settled

    def reset(self, *args: Any, mask: torch.Tensor | None = None, **given: Any) -> torch.Tensor:
        """Same as in `BallbotBatch`: these episodes begin as the task's own do."""
        observation = super().reset(*args, mask=mask, **given)
        begun = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask
        self._kind = torch.where(begun, _OWN, self._kind)
        self._again = self._again & ~begun
        self._begin(begun)
        return observation

    @torch.no_grad()
    def step(self, actions: torch.Tensor) -> BatchStep:
        """Same as in `BallbotBatch`, with the rewards and the next episodes of training. It carries no gradients."""
        before, task = self.state, self.task
        result = super().step(actions)
        assert before is not None  # else the step above raises
        survive = task.survival_reward * task.control_dt
        price = FAILURE_PRICE if self.is_settled else _EARLY_FAILURE_PRICE
        reward = result.reward - survive - price * result.failure
        if task.first_exit:
            reward = reward - survive * (task.steps - before.steps - 1) * result.success
        if self.backwards:
            start, end = (self._potential(x, before.c) for x in (before.x, result.final_x))
            # An episode that terminates ends with a potential of 0; a truncated one keeps its own.
            reward = reward + self.gamma * torch.where(result.terminated, 0.0, end) - start
        ended = result.terminated | result.truncated
        if self.backwards:
            result = self._go_backwards(result, ended)
        self._begin(ended)
        return result._replace(reward=reward)

    def curriculum_state(self) -> dict[str, Any]:
        """What the batch remembers besides `state`: tensors and plain values."""
        return state_of(self, _STATE)

    def load_curriculum_state(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""
        load_state(self, _STATE, state)
        self._set_difficulty()

    def _potential(self, x: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        return -_SHAPING * self.task.goal_distance(x.unbind(0), c.unbind(0))

    def _go_backwards(self, result: BatchStep, ended: torch.Tensor) -> BatchStep:
        """Counts what ended, makes the task harder, and chooses where the next episodes begin."""
        counted = ended & ~self._again
        if self._count(_OWN, counted, result.success):
            self._harden()
        if self._count(_ON_OPTIMUM, counted, result.success) and self._shares[_ON_OPTIMUM] >= _SUCCESS:
            self._reach = min(self._reach + _REACH_STEP, self.own_task.duration)  # they begin earlier from now on
            self._eligible = None
        self._keep_hard(result)
        self._kind, self._again = torch.where(ended, _OWN, self._kind), self._again & ~ended
        began = self.state
        if self._is_easier:
            self._start_on_optima(ended)
        self._retry(ended)
        if self.state is began:  # none were moved
            return result
        assert self.state is not None
        observation = torch.where(ended[:, None], self.observe(self.state), result.observation)
        return result._replace(observation=observation, measured=self.measurements(self.state))

    def _count(self, kind: int, ended: torch.Tensor, success: torch.Tensor) -> bool:
        """Counts the episodes of a kind that ended. True where there are enough to look at; their share is then new."""
        ended = ended & (self._kind == kind)
        before, won = self._counts[kind]
        count, won = before + int(ended.sum()), won + int((ended & success).sum())
        enough = count >= _EPISODES
        self._shares = self._shares | ({kind: won / count} if enough else {})
        self._counts = self._counts | {kind: (0, 0) if enough else (count, won)}
        return enough

    @property
    def _optima_succeed(self) -> bool:
        """Whether episodes begin anywhere on optima, and enough of them succeed for a narrower goal."""
        longest = math.inf if self._starts is None else float(self._starts[-1].max()) * self.task.control_dt
        return self._reach >= min(longest, self.own_task.duration) and self._shares[_ON_OPTIMUM] >= _OPTIMA_SUCCESS

    @property
    def _is_easier(self) -> bool:
        """Whether the goal is wider than the task's own, or a field of `_RAMPS` another."""
        return self._goal_factor > 1 or any(value != getattr(self.own_task, name) for name, value in self._ramp.items())

    def _harden(self) -> None:
        """Takes a step towards the task itself if enough of its episodes succeed: the goal first, then the fields."""
        share = self._shares[_OWN]
        if not self._is_easier:
            self._has_settled |= share >= _SETTLED_SUCCESS
        elif share >= _SUCCESS and self._goal_factor == 1:
            steps = {name: reached + _RAMPS[name][1] for name, reached in self._ramp.items()}
            self._ramp = {name: min(value, getattr(self.own_task, name)) for name, value in steps.items()}
        elif share >= _SUCCESS and self._optima_succeed:
            self._goal_factor = max(1.0, self._goal_factor * _GOAL_STEP)
        self._set_difficulty()

    def _set_difficulty(self) -> None:
        """Makes `task` what the curriculum has reached."""
        # a batch computes nothing from goal and ramp in advance
        vars(self)["task"] = _widened(replace(self.own_task, **self._ramp), self._goal_factor)
        self._eligible: torch.Tensor | None = None

    def _start_on_optima(self, ended: torch.Tensor) -> None:
        """Moves a share of the episodes that have just begun into states along optima."""
        if self._starts is None:
            self._starts = _optimal_starts(self._full, self.params, _OPTIMA, self.own_task.steps)
        if self._eligible is None:  # states outside of the goal, which may be wide
            x, c = self._starts[:8].unbind(0), self._starts[8:-2].unbind(0)
            inside = self.task.goal(x, self.task.at(c, self.task.duration))
            reached = torch.stack([excess <= 0 for excess in inside]).all(0)
            near = self._starts[-1] <= max(1, round(self._reach / self.task.control_dt))
            outside = (near & ~reached).nonzero()[:, 0]
            self._eligible = outside if len(outside) else near.nonzero()[:, 0]
        moved = ended & (torch.rand(self.num_envs) < _ON_OPTIMA)
        self._kind = torch.where(moved, _ON_OPTIMUM, self._kind)
        count = int(moved.sum())
        if not count:
            return
        lengths = self._starts[-2:, self._eligible].sum(0).float()  # so that every optimum is met as often as any other
        chosen = self._eligible[torch.multinomial(1.0 / lengths, count, replacement=True)]
        self._move(moved, self._starts[:-1, chosen])

    def _keep_hard(self, result: BatchStep) -> None:
        """Remembers the starts of the episodes that have just failed or missed the goal."""
        wrong = result.failure | (result.truncated & ~result.success)
        for kind in range(len(self._hard)):
            starts = self._begun[:, wrong & (self._kind == kind)]
            self._hard[kind] = torch.cat([self._hard[kind], starts], 1)[:, -_KEPT_STARTS:]

    def _retry(self, ended: torch.Tensor) -> None:
        """Moves a share of the episodes that have just begun to the starts of others of their kind that went wrong."""
        drawn = ended & (torch.rand(self.num_envs) < self._retried_share)
        for kind, hard in enumerate(self._hard):
            again = drawn & (self._kind == kind)
            if not hard.shape[1]:
                continue
            self._again = self._again | again
            self._move(again, hard[:, torch.randint(hard.shape[1], (int(again.sum()),))])

    @property
    def _retried_share(self) -> float:
        """The share of the episodes that repeats starts."""
        wrong = 1 - self._shares[_OWN]
        return min(_RETRIES, _RETRIES_PER_FAILURE * wrong) if self.is_settled and math.isfinite(wrong) else _RETRIES

    def _begin(self, begun: torch.Tensor) -> None:
        """Remembers the starts of the episodes that have just begun, if any may be repeated."""
        if not self.backwards:
            return
        assert self.state is not None
        starts = torch.cat([self.state.x, self.state.c, self.state.steps[None]]).float()
        self._begun = torch.where(begun, starts, self._begun)

    def _move(self, moved: torch.Tensor, starts: torch.Tensor) -> None:
        """Moves n of the B episodes to starts (8+nc+1, n): states, constants and control steps that have passed."""
        if not moved.any():
            return
        assert self.state is not None
        states, constants, steps = self.state.x.clone(), self.state.c.clone(), self.state.steps.clone()
        states[:, moved], constants[:, moved] = starts[:8].to(states.dtype), starts[8:-1].to(constants.dtype)
        steps[moved] = starts[-1].long()
        self.state = self.state._replace(x=states, c=constants, steps=steps)


def _widened(task: Task, factor: float) -> Task:
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


def _optimal_starts(task: Task, params: Robot, count: int, steps: int) -> torch.Tensor:
    """The states along the optima of `count` episodes drawn for training, before their ends and before control step `steps`.

    The optima leave the share `_RESERVE` of the goal's tolerances unused.

    Returns:
        (8+nc+2, n) float64: states, constants of their episodes, and control steps that have passed of these and that are
        left to the end of the optimum.

    Raises:
        ValueError: no optimum was found.
    """
    from ballbot_baselines import Backoff, find_optimum  # it imports CasADi

    console.print(f"finding {count} optima on which training episodes begin")
    found, backoff = [], Backoff(goal=_RESERVE)
    for x, c, _ in zip(*fresh.draw(task, range(count), 0, "training"), strict=True):
        try:
            states = find_optimum(task, params, x, c, backoff).trajectory.x
        except PlanError:
            continue
        n = min(len(states) - 1, steps)
        passed = np.arange(n)
        found.append(np.column_stack([states[:n], np.tile(c, (n, 1)), passed, len(states) - 1 - passed]))
    if not found:
        raise ValueError(f"{task.id}: no optimum was found on which episodes could begin")
    return torch.from_numpy(np.concatenate(found).T.copy())
