"""BallbotArrays: vector environments without gradients, in NumPy.

They need neither torch nor a C compiler. Episodes are those of `BallbotBatch`: the same `seeding` numbers for the same seeds.
`native` computes the same in machine code, and shares what follows a step.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from ballbot_gym import ops, seeding
from ballbot_gym.checks import check_finite, check_num_envs, fixed
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.step import FLAGS, PAY, StepState, step
from ballbot_gym.tasks import Task
from ballbot_gym.vector.autoreset import Info, Step, _as_gymnasium, _info_of
from ballbot_gym.vector.state import BatchState

FLAG_ROWS = len(FLAGS) + 1
"""Rows of flags: those of `step.FLAGS`, and whether the episode is done."""

State = Any
"""A `BatchState` whose fields are NumPy arrays."""

Computed = tuple[np.ndarray, ...]
"""What a step computes: rows of the reported, observations, pay, flags, counts, constants, and observations at ends."""

_REWARD, _COST, _SURVIVE, _RUNNING, _GOAL = range(5)  # rows of what is paid
_TERMINATED, _TRUNCATED, _SUCCESS, _FAILURE, _CLIPPED, _DONE = range(FLAG_ROWS)


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
        self._all = np.arange(self.num_envs)
        self._seen_rows = task.observation_size(params)
        self._reported_rows = (
            params.state_size + len(params.MEASUREMENTS) + params.action_size + (4 if params.grips else 0)
        )
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
        c: np.ndarray | None = None,
    ) -> State:
        """As `BallbotBatch.initial_state`, with NumPy arrays."""
        old = self.state
        state: State = BatchState._make(part.copy() for part in old or self._unstarted)
        which = self._all if old is None or mask is None else np.flatnonzero(mask)
        state.episode[which] += old is not None
        if seed is not None:
            seeds = np.array([-1 if number is None else number for number in seeding.seeds_of(seed, self.num_envs)])
            seeded = which[seeds[which] >= 0]
            state.seed[seeded], state.episode[seeded] = seeds[seeded], 0
        if c is not None:
            state.c[:, which] = c[:, which]
        self._start(which, state, c is not None)
        state.steps[which] = 0
        return state

    def observe(self, state: State) -> np.ndarray:
        """(B, no) observations of a state."""
        return self._seen(state)[0].astype(np.float32, copy=False).T

    def measurements(self, state: State) -> dict[str, np.ndarray]:
        """(B,) what the robot measures in a state, by name."""
        return self.params.named_measurements(self._seen(state)[1])

    def step(self, actions: np.ndarray, waiting: np.ndarray | None = None) -> Step:
        """Holds forces for one control step; see `autoreset.step`."""
        old = self.state
        if old is None:
            raise gymnasium.error.ResetNeeded("step() before reset()")
        begins, restarts = self.restarts or waiting is not None, self.restarts
        (rows, seen, pay, flags, counts, c, last), bad = self._computed(old, actions, waiting)
        if bad:  # what was computed is forgotten
            check_finite(actions)
        violated, steps, episode = counts[0], counts[1], counts[2]  # to unpack it takes three times as long
        if not begins:
            episode, c = old.episode, old.c
        self._state = old._replace(x=rows[: self.params.state_size], c=c, steps=steps, episode=episode)
        observation = seen.astype(np.float32, copy=False).T
        ended = flags[5].nonzero()[0]
        now, end = self._info(self._state, rows, pay[1:5], flags[2:5], violated), None
        if restarts and ended.size:
            rows = rows[self._reported_rows :]
            end = self._info(old._replace(x=rows[: self.params.state_size]), rows, pay[5:], flags[6:], violated)
            last = last.take(ended, 0)
        return _as_gymnasium(observation, pay[0], flags[0], flags[1], now, end, last)

    def _info(self, state: State, rows: np.ndarray, pay: np.ndarray, flags: np.ndarray, violated: np.ndarray) -> Info:
        """An info of a state and of the rows that a step reports."""
        measured = self.params.state_size
        pulls = measured + len(self.params.MEASUREMENTS)
        grip = pulls + self.params.action_size
        force, (success, failure, clipped) = rows[pulls:grip], flags[:3]
        did = pay[0], pay[1:], force, success, failure, clipped, rows[grip : self._reported_rows]
        return _info_of(state, self.params.named_measurements(rows[measured:pulls]), violated, *did)

    def _start(self, which: np.ndarray, state: State, given: bool) -> None:
        """Starts episodes in some envs of a state, in place; their constants are drawn unless they are given."""
        x, c = self._drawn(state.seed[which], state.episode[which], state.c[:, which] if given else None)
        state.x[:, which], state.c[:, which] = x, c

    def _drawn(self, seed: np.ndarray, episode: np.ndarray, c: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """The states and constants with which episodes start; the constants are drawn unless they are given."""
        task, count = self.task, self.task.constant_draws
        z = seeding.uniforms(seeding.key(seed, episode, 0), count + task.state_draws, self.dtype)
        if c is None:
            c = self._rows(task.draw_constants(z[:count], self.params), len(seed))
        return self._rows(task.start(z[count:], tuple(c), self.params), len(seed)), c

    def _rows(self, parts: Sequence[Any], size: int) -> np.ndarray:
        """(n, B) array of n components. Some components may be single numbers."""
        rows = np.empty((len(parts), size), self.dtype)
        for row, part in zip(rows, parts, strict=True):
            row[:] = part
        return rows

    def _seen(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """(no, B) what all envs see, and their measurements, a row (B,) each."""
        x = tuple(state.x)
        now = self.task.at(tuple(state.c), state.steps.astype(self.dtype) * self.dtype(self.task.control_dt))
        seen = self._rows(ops.components(self.task.seen(x, now, self.params)), state.x.shape[1])
        return seen, self._rows(self.params.measurements(x), state.x.shape[1])

    def _advanced(self, old: State, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """One control step: rows of states, measurements, forces and grip; pay; flags; and violated limits."""
        task, params, size = self.task, self.params, self.num_envs
        x, c, a = tuple(old.x), tuple(old.c), tuple(actions.T)
        made = step(task, params, self.randomization, StepState(x, c, old.steps.astype(self.dtype)), a)
        did, end = made.outcome, made.state.x
        pay = np.empty((len(PAY), size))
        for row, name in zip(pay, PAY, strict=True):
            row[:] = getattr(did, name)
        flags = np.empty((FLAG_ROWS, size), bool)
        for row, part in zip(
            flags, (did.terminated, did.truncated, did.success, did.failure, made.clipped), strict=False
        ):
            row[:] = np.asarray(part) != 0
        flags[_TRUNCATED] |= ~flags[_TERMINATED] & (old.steps + 1 >= self.most_steps)
        flags[_DONE] = flags[_TERMINATED] | flags[_TRUNCATED]
        rows = self._rows((*end, *params.measurements(end), *made.force, *made.grip), size)
        return rows, pay, flags, np.asarray(did.violated, np.int64)

    def _computed(self, old: State, actions: np.ndarray, waiting: np.ndarray | None) -> tuple[Computed, bool]:
        """What a step from a state computes, and whether an action is not finite."""
        finite = bool(np.isfinite(actions).all())
        rows, pay, flags, violated = self._advanced(old, np.where(np.isfinite(actions), actions, 0))
        steps, episode, c = old.steps + 1, old.episode.copy(), old.c.copy()
        seen, _ = self._seen(old._replace(x=rows[: self.params.state_size], steps=steps))
        last = np.ascontiguousarray(seen.T, np.float32)
        if self.restarts:
            rows = np.concatenate((rows, rows))
            pay = np.concatenate((pay, pay[_COST:]))
            flags = np.concatenate((flags, flags[_SUCCESS : _CLIPPED + 1]))
        begins = np.zeros(self.num_envs, bool)
        if self.restarts:
            begins |= flags[_DONE]
            pay[_COST : _GOAL + 1, begins] = 0
            flags[_SUCCESS : _CLIPPED + 1, begins] = False
        if waiting is not None:
            begins |= waiting
            pay[: _GOAL + 1, waiting] = 0
            flags[: _DONE + 1, waiting] = False
            violated[waiting] = -1
        begun = np.flatnonzero(begins)
        if begun.size:
            states = self.params.state_size
            measured = states + len(self.params.MEASUREMENTS)
            rows[measured : self._reported_rows, begun] = 0
            steps[begun], episode[begun] = 0, episode[begun] + 1
            x, c[:, begun] = self._drawn(old.seed[begun], episode[begun], None)
            rows[:states, begun] = x
            started = old._replace(x=x, c=c[:, begun], steps=steps[begun])
            seen[:, begun], rows[states:measured, begun] = self._seen(started)
        return (rows, seen, pay, flags, np.array((violated, steps, episode)), c, last), not finite
