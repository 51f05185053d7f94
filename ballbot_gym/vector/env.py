"""BallbotVectorEnv: Gymnasium's vector interface to machine code, to a `BallbotBatch` in torch, or to NumPy."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ballbot_gym.checks import (
    check_finite,
    check_history,
    finite_array,
    fixed,
    real_array,
    reset_options,
)
from ballbot_gym.drawing import Drawing, Drawn
from ballbot_gym.env import TaskEnv, make_task, robot_of
from ballbot_gym.lazy import missing
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_gym.robot import PAPER, Randomization, Robot
from ballbot_gym.step import check_observation, observation_space
from ballbot_gym.tasks import Task
from ballbot_gym.vector.arrays import BallbotArrays
from ballbot_gym.vector.autoreset import _as_array, _gymnasium_reset, _gymnasium_step
from ballbot_gym.vector.native import BallbotNative
from ballbot_gym.vector.state import BatchState

if TYPE_CHECKING:
    import torch

    from ballbot_gym.vector.batch import BallbotBatch

_ENGINES = ("auto", "native", "torch", "numpy")
_DTYPES = ("float32", "float64")

_log = logging.getLogger(__name__)


@fixed("task", "params", "randomization", "history", "observation", "num_envs", "render_mode", "autoreset_mode")
@fixed("action_space", "observation_space", "single_action_space", "single_observation_space")
class BallbotVectorEnv(TaskEnv, gymnasium.vector.VectorEnv):
    """Many ballbots in one Gymnasium `VectorEnv`: `gymnasium.make_vec("BallbotStabilize-v0", num_envs=1024)`.

    Spaces, rewards, ends and `info` are those of `BallbotEnv(physics="rk4")`, in float32 by default. `autoreset_mode` is one
    of Gymnasium's:

    | mode | after the end of an episode |
    |---|---|
    | "SameStep" | the step that ends it starts the next; `infos["final_obs"]` and `infos["final_info"]` hold the end |
    | "NextStep" | the next step ignores the env's action, starts the next episode and rewards 0 |
    | "Disabled" | `reset(options={"reset_mask": mask})` must come before the next step |

    The episodes are the same in all three. The entries of `final_info` and the rows of `final_obs`, a float32 array (B, no),
    are valid only for the envs that the masks `_…` mark. Returned arrays never change later; `state`, `constants` and
    `violated` in `infos` may share memory and are read-only. Observations and states are in Fortran order, component by
    component, like those of Gymnasium's own batched CartPole, and actions in that order are not copied.

    `copy.deepcopy` and `pickle` make independent envs in the same state. The same actions then give bit-identical results.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        task: str | Task = "stabilize",
        render_mode: str | None = None,
        device: str | torch.device = "cpu",
        dtype: torch.dtype | str = "float32",
        compile: bool | str = "auto",
        params: Robot | None = None,
        randomization: Randomization | str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        physics: str = "rk4",
        max_episode_steps: int | None = None,
        engine: str = "auto",
        robot: str | Robot = PAPER,
        history: int = 0,
        observation: str = "state",
        **task_fields: Any,
    ):
        """Makes the environments. Arguments that are not listed are those of `BallbotBatch`.

        Args:
            render_mode: None or "rgb_array", which draws every env in turn.
            autoreset_mode: an `AutoresetMode`, or its value; default, SAME_STEP.
            physics: "rk4". Gymnasium's own vector envs run the others.
            max_episode_steps: control steps after which an episode is truncated, as by Gymnasium's `TimeLimit` in
                `gymnasium.make`. Unlike the task's `duration`, it changes neither rewards nor the goal.
            engine: "native" computes all envs at once in machine code, which is compiled within a second or two, once per
                task and machine. It needs CasADi and a C compiler, but not for the shipped tasks and robots if the
                installed wheel has their code. It gives no gradients, and does not support `Randomization`, history or
                sensors. "torch" computes the envs in torch; `compile` says whether this code is compiled. "numpy" needs
                nothing else, supports what "native" supports, and is the slowest. "auto" uses "native" on a CPU if it
                supports the arguments and compile is neither True nor False. Otherwise it uses "torch", or "numpy" if
                torch is not installed. All engines run the same episodes, to rounding. The attribute `batch` is a
                `BallbotNative`, a `BallbotBatch` or a `BallbotArrays`. "native" divides large batches among as many threads
                as torch has, if that is imported, or else $OMP_NUM_THREADS, or one for each core.

        Raises:
            ValueError: a render mode, autoreset mode, physics, number of steps or engine that is not listed, or as
                `BallbotBatch`.
            TypeError: a keyword that is no field of the task.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; known: None, 'rgb_array'")
        if engine not in _ENGINES:
            raise ValueError(f"unknown engine {engine!r}; known: {', '.join(map(repr, _ENGINES))}")
        params = robot_of(task, robot, params)
        task = make_task(task, params, **task_fields)
        if physics != "rk4":
            raise ValueError(
                f'these vector environments run physics="rk4", not {physics!r}; for "bullet" or "mujoco": '
                f'gymnasium.make_vec("{task.id}", num_envs={num_envs}, vectorization_mode="sync", physics=...), or "async"'
            )
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        world = randomization, history, observation
        self.batch = _made(engine, task, num_envs, device, dtype, compile, params, *world)
        self._dtype = np.dtype(str(dtype).removeprefix("torch.")).type
        self.task, self.params, self.randomization = self.batch.task, self.batch.params, self.batch.randomization
        self.history, self.observation = self.batch.history, self.batch.observation
        self.num_envs, self.render_mode = self.batch.num_envs, render_mode
        fps = round(1 / self.task.control_dt)
        self.metadata = {**self.metadata, "render_fps": fps, "autoreset_mode": self.autoreset_mode}
        self._ended = np.zeros(self.num_envs, np.bool_)  # envs that have ended and not restarted
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.params.action_size,), np.float32)
        self.single_observation_space = observation_space(self.task, self.params, self.history, self.observation)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.most_steps = self.batch.most_steps = _most_steps(max_episode_steps, self.task)
        self.batch.restarts = self.autoreset_mode is AutoresetMode.SAME_STEP

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: env i is seeded with seed + i, or with seed[i]. An env without a seed starts its next episode.
            options: may hold "reset_mask", (B,) bool NumPy array of the envs to reset; "state", (8,) or (B, 8) initial
                states; "constants", (nc,) or (B, nc), or a dict of some of them by name, each a number or (B,).

        Returns:
            Observations (B, no) of all envs, and infos of those reset.

        Raises:
            TypeError, ValueError: an unknown option, or a value of the wrong type, shape or range.
        """
        self._check_open()
        given_mask, x, constants = reset_options(options, "reset_mask", "state", "constants")
        mask = _reset_mask(given_mask, self.num_envs)
        if self.batch.state is None:
            mask = np.ones_like(mask)
        batch: Any = self.batch
        own, of_envs = batch._own, batch._own(mask)
        state = batch.initial_state(seed, of_envs)
        if x is not None or constants is not None:
            c = None if constants is None else own(self._constants(constants, state, mask))
            shape = self.num_envs, self.params.state_size
            x = None if x is None else own(finite_array(x, shape, "state", broadcast=True).T.copy())
            state = batch.initial_state(seed, of_envs, x, c)
        batch.state = state
        self._ended = self._ended & ~mask
        return _gymnasium_reset(batch, mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Holds forces for one control step; `autoreset_mode` says what happens to episodes that end.

        Args:
            actions: (B, 2) forces in units of the robot's force limit; clipped to [−1, 1]. With wheels (B, 3).

        Raises:
            ValueError: actions that are not of real, finite numbers or not of shape (B, 2).
            gymnasium.error.ResetNeeded: before `reset`, or in mode "Disabled" while an episode has ended.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        self._check_open()
        actions = real_array(actions, "actions", (self.num_envs, self.params.action_size))
        if actions.dtype != self._dtype:
            check_finite(actions)
            actions = actions.clip(-2.0, 2.0).astype(
                self._dtype
            )  # what is too large for float32 is clipped all the same
        waiting = self._ended if np.count_nonzero(self._ended) else None
        if waiting is not None and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"the episodes of envs {np.flatnonzero(waiting)[:8].tolist()} have ended; reset them with "
                'options={"reset_mask": mask}'
            )
        batch: Any = self.batch
        before = batch.state
        result = _gymnasium_step(batch, before, batch.advance(actions, waiting))
        if not batch.restarts:
            self._ended = result[2] | result[3]
        return result

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every env: of this object, or "episode_params", the robot of the running episode."""
        if name == "np_random_seed":
            return self.np_random_seed
        if name == "episode_params":
            varied, drawn = self.randomization.varies_robot, _as_array(self._state.drawn).T.tolist()
            return tuple(self.randomization.robot(self.params, tuple(row)) if varied else self.params for row in drawn)
        return (getattr(self, name),) * self.num_envs

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """As `get_attr`, or what `render` gives for every env: None each where there is no render mode."""
        if name == "render":
            return self.render() or (None,) * self.num_envs
        value = self.get_attr(name)
        return tuple(part(*args, **kwargs) if callable(part) else part for part in value)

    def set_attr(self, name: str, values: Any) -> None:
        """Not possible: all envs share one task and one robot.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(f"{name!r} cannot be set: make a new vector env instead")

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """The seed of each env; its episodes are a function of it and of their number."""
        return tuple(self._state.seed.tolist())

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image (height, width, 3), uint8, of each env."""
        self._check_open()
        if self.render_mode is None:
            gymnasium.logger.warn('render() without a render mode; make the envs with render_mode="rgb_array"')
            return None
        from ballbot_gym.drawing.picture import picture  # here, because most environments draw nothing

        states, constants = (np.array(part.T.tolist()) for part in (self._state.x, self._state.c))
        return tuple(
            picture(Drawing(self.params, (Drawn(x),), markers=tuple(self.task.markers(c))))
            for x, c in zip(states, constants, strict=True)
        )

    @property
    def _state(self) -> BatchState:
        """What the batch remembers, once there is something."""
        if self.batch.state is None:
            raise gymnasium.error.ResetNeeded("no state before reset()")
        return self.batch.state

    def _constants(self, constants: Any, drawn: BatchState, mask: np.ndarray) -> np.ndarray:
        """(nc, B) constants: those given to the envs of the mask, and drawn ones for the rest."""
        names, task = self.task.constant_names, self.task
        c = _as_array(drawn.c).astype(np.float64)
        if isinstance(constants, dict):
            task.check_constant_names(constants)
            for name, value in constants.items():
                values = finite_array(value, (self.num_envs,), f"constant {name!r}", broadcast=True)
                c[names.index(name), mask] = values[mask]
        else:
            c[:, mask] = finite_array(constants, (self.num_envs, len(names)), "constants", broadcast=True)[mask].T
        for distinct in np.unique(c[:, mask], axis=1).T:
            task.check_constants(distinct, self.params)
        return c


def _made(
    engine: str,
    task: Task,
    num_envs: int,
    device: str | torch.device,
    dtype: torch.dtype | str,
    compile: bool | str,
    params: Robot,
    randomization: Randomization | str | None,
    history: int,
    observation: str,
) -> BallbotBatch | BallbotArrays:
    """The batch. Torch, whose import takes a second, is imported only to be used. Arguments are those of `BallbotVectorEnv`.

    Raises:
        ModuleNotFoundError: torch is missing, and an argument asks for what torch alone computes.
        ValueError: as `BallbotVectorEnv`.
    """
    varied = Randomization.checked(randomization, params)
    history, observation = check_history(history), check_observation(observation, params, varied)
    plain = varied == Randomization() and not history and observation == "state"
    on_cpu, precision = str(device).partition(":")[0] == "cpu", str(dtype).removeprefix("torch.")
    installed, light = find_spec("torch") is not None, engine in ("native", "numpy")
    if light and not on_cpu:
        raise ValueError(f"engine={engine!r} runs on the CPU, not on {device}")
    if light and not plain:
        raise ValueError(f'engine="{engine}" does not support Randomization, history or sensors; take engine="torch"')
    if engine == "auto":
        light = plain and on_cpu and compile == "auto" and (precision in _DTYPES or not installed)
    if light and precision not in _DTYPES:
        raise ValueError(f"dtype must be 'float32' or 'float64', not {dtype!r}")
    real = np.float64 if precision == "float64" else np.float32
    if light and engine != "numpy":
        try:
            return BallbotNative(task, num_envs, real, params, _threads())
        except (ImportError, NoMachineCodeError) as error:
            if engine == "native":
                raise
            _log.warning("no machine code, so the envs are slower: %s", error)
    if engine == "numpy" or (light and not installed):
        return BallbotArrays(task, num_envs, real, params)
    if not installed:
        raise missing('engine="torch", device, compile, randomization, history or sensors', "torch", "train")
    from ballbot_gym.vector.batch import BallbotBatch

    world: Any = {"randomization": varied, "history": history, "observation": observation}
    return BallbotBatch(task, num_envs, device, dtype, compile, params, **world)


def _threads() -> int:
    """How many threads torch has, or would have."""
    if torch := sys.modules.get("torch"):
        return torch.get_num_threads()
    wanted = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(wanted) if wanted.isdigit() and int(wanted) else os.cpu_count() or 1


def _most_steps(max_episode_steps: int | None, task: Task) -> int:
    """Control steps in the longest episode; −1 stands for None, as for `gymnasium.make`."""
    if max_episode_steps is None or max_episode_steps == -1:
        return task.steps
    if isinstance(max_episode_steps, bool) or not isinstance(max_episode_steps, int) or max_episode_steps < 1:
        raise ValueError(f"max_episode_steps must be a positive whole number, not {max_episode_steps!r}")
    return min(max_episode_steps, task.steps)


def _reset_mask(mask: Any, num_envs: int) -> np.ndarray:
    """The option "reset_mask", checked as Gymnasium's vector envs do."""
    if mask is None:
        return np.ones(num_envs, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or np.ma.is_masked(mask):
        raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, not {mask!r}")
    if mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must have shape ({num_envs},), not {mask.shape}")
    if not mask.any():
        raise ValueError("options['reset_mask'] must be True somewhere")
    return mask.copy()
