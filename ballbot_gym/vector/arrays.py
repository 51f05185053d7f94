"""BallbotArrays: what `BallbotNative` does, in NumPy, for machines without a C compiler and without torch.

It is several times slower, and the numbers are those of `BallbotNative` to rounding. Both share all that follows a step, so
`BallbotNative` is checked against it before it is used.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ballbot_gym import ops, seeding
from ballbot_gym.robot import Robot
from ballbot_gym.step import PAY, StepState, step
from ballbot_gym.tasks import Task
from ballbot_gym.vector.native import FLAG_ROWS, BallbotNative, Computed, State

_REWARD, _COST, _SURVIVE, _RUNNING, _GOAL = range(5)  # rows of what is paid
_TERMINATED, _TRUNCATED, _SUCCESS, _FAILURE, _CLIPPED, _DONE = range(FLAG_ROWS)


class BallbotArrays(BallbotNative):
    """A `BallbotNative` without machine code."""

    compiled = False

    def __init__(self, task: Task, num_envs: int, dtype: type[np.floating], params: Robot):
        """Makes the envs; the arguments are those of `BallbotNative`.

        Raises:
            ValueError: num_envs out of range.
        """
        super().__init__(task, num_envs, dtype, params, code=True)

    def _start(self, which: np.ndarray, state: State, given: bool) -> None:
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

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
