"""BallbotArrays: vector environments without gradients, in NumPy.

They need neither torch nor a C compiler. Episodes are those of `BallbotBatch`: the same `seeding` numbers for the same seeds.
`native` computes the same in machine code, and shares what follows a step.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from ballbot_gym import seeding
from ballbot_gym.checks import check_finite, check_num_envs, fixed
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.step import FLAGS, PAY, StepState, observe, start, start_draws, step
from ballbot_gym.tasks import Task
from ballbot_gym.vector.state import BatchState, BatchStep, _check_starts

State = Any
"""A `BatchState` whose fields are NumPy arrays."""


@fixed("task", "params", "randomization", "history", "num_envs", "dtype")
class BallbotArrays:
    """B ballbots that do one task, with the `state`, `initial_state`, `step` and `robot` of `BallbotBatch`.

    The fields of `BatchState` and `BatchStep` are NumPy arrays.
    """

    compiled = False

    def __init__(self, task: Task, num_envs: int, dtype: type[np.floating], params: Robot):
        """Makes the envs.

        Args:
            task, num_envs, params: same as in `BallbotBatch`.
            dtype: np.float32 or np.float64.

        Raises:
            ValueError: num_envs out of range.
        """
        self.num_envs, self.dtype, self.task, self.params = check_num_envs(num_envs), dtype, task, params
        self.randomization, self.history = Randomization(), 0
        self.observation = "state"
        self.most_steps, self.restarts = task.steps, True
        self._state: State = None
        size, nothing = self.num_envs, np.zeros((0, self.num_envs), dtype)
        x, c = (np.zeros((rows, size), dtype) for rows in (params.state_size, len(task.constant_names)))
        seeds = np.array(seeding.seeds_of(int(np.random.SeedSequence().generate_state(1)[0]), size))
        begun: Any = x, c, *np.zeros((2, size), np.int64), seeds, *(nothing,) * 4
        self._unstarted: State = BatchState(*begun)

    @property
    def state(self) -> State:
        """Everything that the environments remember; None before the first reset."""
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        """Takes a state; machine code reads its memory, so every array must be of the right shape.

        Raises:
            ValueError: it is not.
        """
        if state is not None:
            parts = []
            for name, part, own in zip(BatchState._fields, state, self._unstarted, strict=True):
                parts.append(np.ascontiguousarray(part, own.dtype))
                if parts[-1].shape != own.shape:
                    raise ValueError(f"{name} of a state must have shape {own.shape}, not {parts[-1].shape}")
            state = BatchState(*parts)
        self._state = state

    def initial_state(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: np.ndarray | None = None,
        x: np.ndarray | None = None,
        c: np.ndarray | None = None,
        drawn: np.ndarray | None = None,
    ) -> State:
        """As `BallbotBatch.initial_state`, with NumPy arrays. Nothing can be `drawn`."""
        if drawn is not None:
            raise ValueError("nothing is drawn in machine code; make a BallbotBatch")
        old = self.state
        state: State = BatchState._make(part.copy() for part in old or self._unstarted)
        mask = np.ones(self.num_envs, bool) if old is None or mask is None else mask
        which = np.flatnonzero(mask)
        state.episode[which] += old is not None
        if seed is not None:
            seeds = np.array([-1 if number is None else number for number in seeding.seeds_of(seed, self.num_envs)])
            seeded = which[seeds[which] >= 0]
            state.seed[seeded], state.episode[seeded] = seeds[seeded], 0
        if c is not None:
            state.c[:, which] = c[:, which]
        self._start(which, state, c is not None)
        state.steps[which] = 0
        if x is not None:
            state.x[:, which] = x[:, which]
            _check_starts(self.task, tuple(state.x), tuple(state.c), mask)
        return state

    def observe(self, state: State) -> np.ndarray:
        """(B, no) observations of a state."""
        return self._seen(state)[0].T

    def measurements(self, state: State) -> np.ndarray:
        """(nm, B) what the robot measures in a state, as its `MEASUREMENTS` name it."""
        return self._seen(state)[1]

    def step(self, actions: np.ndarray) -> BatchStep:
        """Holds forces for one control step, as `BallbotBatch.step`."""
        return self.advance(self._own(actions))

    def advance(self, actions: np.ndarray, waiting: np.ndarray | None = None) -> BatchStep:
        """As `BallbotBatch.advance`."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("step() before reset()")
        self._state, did = self._stepped(self._state, actions, waiting)
        return did

    def _own(self, values: Any) -> np.ndarray:
        """Numbers or truth values as the batch computes with them."""
        given = np.asarray(values)
        return given if given.dtype in (self.dtype, np.bool_) else given.astype(self.dtype)

    def _start(self, which: np.ndarray, state: State, given: bool) -> None:
        """Starts episodes in some envs of a state, in place; their constants are drawn unless they are given."""
        key = seeding.key(state.seed[which], state.episode[which], 0)
        z = seeding.uniforms(key, start_draws(self.task, self.randomization, False), self.dtype)
        c = tuple(state.c[:, which]) if given else None
        made = start(self.task, self.params, self.randomization, z, c=c)
        state.x[:, which], state.c[:, which] = (self._rows(part, len(which)) for part in (made.x, made.c))

    def _rows(self, parts: Sequence[Any], size: int) -> np.ndarray:
        """(n, B) array of n components. Some components may be single numbers."""
        rows = np.empty((len(parts), size), self.dtype)
        for row, part in zip(rows, parts, strict=True):
            row[:] = part
        return rows

    def _seen(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """(no, B) what all envs see, and their measurements, a row (B,) each."""
        now = self._step_state(state)
        seen = observe(self.task, self.params, self.randomization, now)
        return self._rows(seen, self.num_envs), self._rows(self.params.measurements(now.x), self.num_envs)

    def _step_state(self, state: State) -> StepState:
        return StepState(tuple(state.x), tuple(state.c), state.steps.astype(self.dtype))

    def _stepped(self, old: State, actions: np.ndarray, waiting: np.ndarray | None) -> tuple[State, BatchStep]:
        """The state after a step, and what the step did."""
        check_finite(actions)
        task, params, size = self.task, self.params, self.num_envs
        made = step(task, params, self.randomization, self._step_state(old), tuple(actions.T))
        did, end = made.outcome, self._rows(made.state.x, size)
        flags = np.empty((len(FLAGS), size), bool)
        for row, part in zip(
            flags, (did.terminated, did.truncated, did.success, did.failure, made.clipped), strict=True
        ):
            row[:] = np.asarray(part) != 0
        terminated, truncated, *_ = flags
        truncated |= ~terminated & (old.steps + 1 >= self.most_steps)
        new = old._replace(x=end, steps=old.steps + 1)
        last, last_measured = self._seen(new)
        seen, measured = last, last_measured
        begins = np.zeros(size, bool) if waiting is None else waiting
        if self.restarts:
            begins = begins | terminated | truncated
        begun = begins.nonzero()[0]
        if begun.size:
            new = BatchState._make(part.copy() for part in new)
            new.steps[begun], new.episode[begun] = 0, new.episode[begun] + 1
            self._start(begun, new, False)
            seen, measured = self._seen(new)
        pay = np.empty((len(PAY), size))
        for row, name in zip(pay, PAY, strict=True):
            row[:] = getattr(did, name)
        force, grip, violated = (
            self._rows(made.force, size),
            self._rows(made.grip, size),
            np.array(did.violated, np.int64),
        )
        if waiting is not None:
            for part in (pay, flags, force, grip):
                part[:, waiting] = 0
            violated[waiting] = -1
        return new, _batch_step(
            pay,
            flags,
            observation=seen.T,
            final_observation=last.T,
            final_x=end,
            violated=violated,
            force=force,
            grip=grip,
            measured=measured,
            final_measured=last_measured,
        )


def _batch_step(pay: np.ndarray, flags: np.ndarray, **parts: Any) -> BatchStep:
    """A step from rows of pay and flags, those of `step.PAY` and `step.FLAGS`, and from its other fields."""
    terminated, truncated, success, failure, clipped = flags
    ends: Any = {"terminated": terminated, "truncated": truncated, "success": success, "failure": failure}
    paid: Any = {"reward": pay[0], "cost": pay[1], "reward_parts": pay[2:]}
    return BatchStep(**paid, **ends, clipped=clipped, **parts)
