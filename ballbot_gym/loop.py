"""BallbotLoop: what `BallbotBatch` does, one ballbot after the other in plain Python.

A torch operation takes microseconds however small the batch is, so that for few environments a loop over floats is
faster. Episodes are those of `BallbotBatch`: the same `counter_rng` numbers for the same seeds. Motions agree to rounding,
because the loop always computes in float64, and `dtype` is only that of what it returns.
"""

from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import numpy as np

from ballbot_gym import counter_rng, dynamics
from ballbot_gym.batch import BatchState, BatchStep, seeds_of
from ballbot_gym.checks import check_num_envs
from ballbot_gym.engines import State
from ballbot_gym.env import BallbotEnv, fixed
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import DisturbanceState, Randomization
from ballbot_gym.tasks import Task

_NOMINAL = (1.0, 1.0, 1.0, 1.0, 1.0, 0.0)
"""What `Randomization.draw` draws where neither robot nor actuator varies."""


@fixed("task", "params", "randomization", "history", "num_envs", "dtype")
class BallbotLoop:
    """B ballbots that do one task, with `state`, `initial_state`, `step` and `robot` as of `BallbotBatch`.

    The fields of `BatchState` and `BatchStep` are NumPy arrays.
    """

    compiled = False

    def __init__(
        self,
        task: Task,
        num_envs: int,
        dtype: type[np.floating],
        params: BallbotParams | None = None,
        randomization: Randomization | None = None,
        history: int = 0,
    ):
        """Args: as of `BallbotBatch`; dtype: np.float32 or np.float64, of what is returned.

        Raises:
            ValueError: num_envs out of range.
        """
        self.num_envs, self.dtype = check_num_envs(num_envs), dtype
        self._singles = [_Single(task, params, randomization, history) for _ in range(self.num_envs)]
        first = self._singles[0]
        self.task, self.params, self.randomization = first.task, first.params, first.randomization
        self.history = first.history
        self._entropy = int(np.random.SeedSequence().generate_state(1)[0])
        self._started = False
        self._shown: tuple[np.ndarray, np.ndarray] | None = None  # x and c, until they change

    @property
    def state(self) -> BatchState | None:
        """Everything that the environments remember, in float64; None before the first reset."""
        if not self._started:
            return None
        return self._stacked([single.memory() for single in self._singles])

    @state.setter
    def state(self, state: BatchState | None) -> None:
        self._started, self._shown = state is not None, None
        if state is None:
            return
        columns = (part.T.tolist() for part in state)
        for single, memory in zip(self._singles, zip(*columns, strict=True), strict=True):
            single.remember(*memory)

    def x_and_c(self) -> tuple[np.ndarray, np.ndarray]:
        """(8, B) states and (nc, B) constants."""
        if self._shown is None:
            x = np.array([single._state for single in self._singles], self.dtype).T
            self._shown = x, np.array([single._constants for single in self._singles], self.dtype).T
        return self._shown

    def initial_state(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: np.ndarray | None = None,
        x: np.ndarray | None = None,
        c: np.ndarray | None = None,
    ) -> BatchState:
        """As `BallbotBatch.initial_state`, with NumPy arrays."""
        old = self.state
        given = [None] * self.num_envs if seed is None else seeds_of(seed, self.num_envs)
        seeds = seeds_of(self._entropy, self.num_envs) if old is None else old.seed.tolist()
        rows: list[tuple] = []
        for i, single in enumerate(self._singles):
            if not (old is None or mask is None or mask[i]):
                rows.append(single.memory())
                continue
            own = given[i]
            number: Any = seeds[i] if own is None else own
            episode = 0 if own is not None or old is None else single.episode + 1
            x_row, c_row = (None if part is None else tuple(part[:, i].tolist()) for part in (x, c))
            rows.append(single.start(number, episode, x_row, c_row))
        return self._stacked(rows)

    def observe(self, state: BatchState) -> np.ndarray:
        """(B, no) observations of a state, which becomes that of the loop."""
        self.state = state
        return np.array([single.observed() for single in self._singles], np.float32)

    def tilt(self, state: BatchState) -> np.ndarray:
        """(B,) rad, of a state."""
        return dynamics.tilt(tuple(cast(np.ndarray, state.x)))

    def step(self, actions: np.ndarray, waiting: np.ndarray | None, restart: bool) -> BatchStep:
        """Holds forces for one control step; see `vector._advance`.

        `final_observation` has the rows of ended episodes alone.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("step() before reset()")
        told: list[Any] = []
        final_x: list[State] = []
        begun: list[int] = []
        for i, (single, action) in enumerate(zip(self._singles, actions, strict=True)):
            if waiting is not None and waiting[i]:
                single.begin_next()
                begun.append(i)
                seen, info = single._shown(None, dynamics.tilt(single._state))
                step = seen, 0.0, False, False, info
            else:
                step = single.step(action)
            told.append(step)
            final_x.append(single._state)
            if restart and (step[2] or step[3]):
                single.begin_next()
                begun.append(i)
        ended = [step[2] or step[3] for step in told]
        final_observation = np.array([step[0] for step in told])
        final_states = np.array(final_x, self.dtype).T
        names = ("cost", "success", "failure", "violated", "clipped")
        info = {name: np.array([step[4][name] for step in told]) for name in (*names, "force", "tilt")}
        final_tilt = info["tilt"].astype(self.dtype)
        self._shown = None if begun or self._shown is None else (final_states, self._shown[1])
        observation, tilt = final_observation, final_tilt
        if restart and begun:
            observation, tilt = observation.copy(), tilt.copy()
            for i in begun:
                observation[i], tilt[i] = self._singles[i].observed(), dynamics.tilt(self._singles[i]._state)
        grips = self.params.grips
        fields: Any = {name: info[name] for name in names} | {
            "observation": observation,
            "reward": np.array([step[1] for step in told]),
            "terminated": np.array([step[2] for step in told]),
            "truncated": np.array([step[3] for step in told]),
            "final_observation": final_observation[ended],
            "final_x": final_states,
            "force": info["force"].astype(self.dtype).T,
            "final_tilt": final_tilt,
            "tilt": tilt,
            "grip": np.array([step[4]["grip"] if grips else () for step in told], self.dtype).T,
        }
        return BatchStep(**fields)

    def robot(self, i: int) -> BallbotParams:
        """The robot of env i in its running episode."""
        return self._singles[i].episode_params

    def _stacked(self, memories: list[tuple]) -> BatchState:
        """The envs' memories as arrays with the components first."""
        x, c, steps, episode, seed, *more = (list(column) for column in zip(*memories, strict=True))
        x, c, *more = (np.array(rows, np.float64).T for rows in (x, c, *more))
        steps, episode, seed = (np.array(column, np.int64) for column in (steps, episode, seed))
        fields: Any = (x, c, steps, episode, seed, *more)
        return BatchState(*fields)


class _Single(BallbotEnv):
    """One environment of the loop: a `BallbotEnv` whose random numbers are those of `counter_rng`."""

    def __init__(self, task: Task, params: BallbotParams | None, randomization: Randomization | None, history: int):
        super().__init__(task, "rk4", params=params, randomization=randomization, history=history)
        self.seed, self.episode = 0, 0
        self._rng: Any = _Counter()
        self._np_random = self._rng

    def start(self, seed: int, episode: int, x: State | None = None, c: State | None = None) -> tuple:
        """The memory of an env that begins an episode: `remember` takes it. x and c are drawn where not given."""
        task, noise = self.task, self.randomization
        varied = noise.varies_episodes
        count = task.constant_draws + task.state_draws + noise.episode_draws * varied
        z = counter_rng.floats(counter_rng.key(seed, episode, 0), count)
        z_constants, z = z[: task.constant_draws], z[task.constant_draws :]
        c = task.draw_constants(z_constants, self.params) if c is None else c
        x = task.draw_state(z[: task.state_draws], c, self.params) if x is None else x
        drawn = noise.draw(z[task.state_draws :], task.control_dt) if varied else ()
        past = noise.delay_steps(task.control_dt)[1]
        actuator = (0.0,) * (2 + 2 * past) if noise.varies_actuator else ()
        own = len(task.observation_scale)
        return x, c, 0, episode, seed, drawn, actuator, (0.0,) * (self.history * (own + 2))

    def memory(self) -> tuple:
        """What the env remembers: a column of `BatchState`."""
        drawn, actuator, noise = (), (), self.randomization
        if self._disturbance is not None and noise.varies_episodes:
            drawn, force, past = self._disturbance.get_state()
            pairs = (force, *past) if noise.varies_actuator else ()
            actuator = tuple(part for pair in pairs for part in pair)
        past = () if self._past is None else tuple(self._past[len(self.task.observation_scale) :].tolist())
        return self._state, self._constants, self._taken, self.episode, self.seed, drawn, actuator, past

    def remember(
        self, x: Any, c: Any, taken: int, episode: int, seed: int, drawn: Any, actuator: Any, past: Any
    ) -> None:
        """Goes on from a `memory`."""
        self._use_code(start=episode > 0)
        self._set_constants(tuple(c))
        self._state = tuple(x)
        self.episode, self.seed = episode, seed
        self._steps_left, self._taken = self.task.steps - taken, taken
        if self._disturbance is not None:
            pairs = tuple(zip(actuator[::2], actuator[1::2], strict=True))
            if not pairs:
                self._disturbance.begin(tuple(drawn) or _NOMINAL)
            else:
                self._disturbance.set_state(DisturbanceState(tuple(drawn), pairs[0], pairs[1:]))
        self._restore_simulator()
        if self._past is not None:
            self._past[len(self.task.observation_scale) :] = past
            self._past[: len(self.task.observation_scale)] = self._observed()

    def observed(self) -> Any:
        """The present observation, with those of the past behind it."""
        return self._observed() if self._past is None else self._past.copy()

    def begin_next(self) -> None:
        """Begins the next episode."""
        self.remember(*self.start(self.seed, self.episode + 1))

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self._disturbance is not None:
            self._rng.seek(self, 0)
        return super().step(action)

    def _observed(self) -> tuple[float, ...]:
        """(no) observation, whose noise depends on the number of steps taken in the episode."""
        if self._disturbance is not None:
            self._rng.seek(self, Randomization.PUSH_DRAWS)
        return super()._observed()


class _Counter:
    """The uniform numbers of one control step in turn, as `numpy.random.Generator.random` gives them."""

    def seek(self, single: _Single, index: int) -> None:
        """Goes to a number of the step that begins now."""
        self._single, self._at = single, index

    def random(self, count: int) -> np.ndarray:
        """(count,) numbers."""
        single = self._single
        key = counter_rng.key(single.seed, single.episode, single._taken + 1)
        self._at += count
        return np.array(counter_rng.floats(key, self._at)[-count:])
