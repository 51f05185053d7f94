"""Batches of ballbots in torch: `BallbotBatch`, tensors in and out and differentiable, and `BallbotVectorEnv`,
Gymnasium's interface over it with NumPy at the border.

Components come first: a batch of B states is a tensor (8, B), so that every operation runs over contiguous memory.

Random numbers are a hash of (the env's seed, the episode's number, the step, an index). So the same seed and actions give
the same results in every batch, wherever the env stands in it, and ended episodes are drawn anew without a loop. They are
not the numbers that `BallbotEnv` draws from NumPy's generator for the same seed.

"The same" means bit by bit among eager batches, and among compiled ones of two or more envs; eager, compiled, and a compiled
batch of one, whose sine is another library's, agree to rounding.
"""

import logging
import math
import shutil
import types
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ballbot_gym import dynamics
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.randomization import Randomization, actuate
from ballbot_gym.simulator import Scene
from ballbot_gym.tasks import Task

_log = logging.getLogger(__name__)

COMPILE_FROM = 1024
"""Batch size from which compile="auto" compiles: below, compiling for half a minute seldom pays."""

_FLAGS = ("terminated", "truncated", "success", "failure", "clipped")
"""The fields of `BatchStep` that are bools."""

_WORD = 0xFFFFFFFF  # hashes are 32-bit words kept in int64, whose products then never overflow


class BatchState(NamedTuple):
    """Everything that a batch of B environments remembers."""

    x: torch.Tensor
    """(8, B) states; order and units in `dynamics.STATE`."""
    c: torch.Tensor
    """(nc, B) constants of the running episodes."""
    steps: torch.Tensor
    """(B,) int64, control steps taken in the running episodes."""
    episode: torch.Tensor
    """(B,) int64, number of the running episode since the env was seeded."""
    seed: torch.Tensor
    """(B,) int64."""
    drawn: torch.Tensor
    """(6, B) what `Randomization.draw` drew for the running episodes; (0, B) where it is off."""
    actuator: torch.Tensor
    """(2 + 2d, B) N, the force last applied, then the last d commands; (0, B) where the actuator is ideal."""


class BatchStep(NamedTuple):
    """What one control step of B environments gave. Environments whose episode ended have started the next one."""

    observation: torch.Tensor
    """(B, no) observations; of ended episodes, the next one's first."""
    reward: torch.Tensor
    """(B,) −cost of the step."""
    terminated: torch.Tensor
    """(B,) bool."""
    truncated: torch.Tensor
    """(B,) bool."""
    final_observation: torch.Tensor
    """(B, no) observations after the step and before any reset."""
    final_x: torch.Tensor
    """(8, B) states after the step and before any reset."""
    success: torch.Tensor
    """(B,) bool: the episode ended in the goal."""
    failure: torch.Tensor
    """(B,) bool: the episode ended at a violated margin."""
    force: torch.Tensor
    """(2, B) N, what the actuator applied."""
    clipped: torch.Tensor
    """(B,) bool: the action was outside [−1, 1]."""
    final_tilt: torch.Tensor
    """(B,) rad, of `final_x`; carries no gradient."""
    tilt: torch.Tensor
    """(B,) rad, of the states that follow: `final_x`, or where an episode ended the next one's start; no gradient."""


class _Robot(NamedTuple):
    """What `dynamics` reads of `BallbotParams`, whose cached properties take a lock that torch.compile cannot."""

    total_mass: Any
    first_moment: Any
    pivot_inertia: Any
    axial_inertia: Any
    gravity: Any

    @classmethod
    def of(cls, params: BallbotParams) -> "_Robot":
        derived = (BallbotParams.total_mass, BallbotParams.first_moment, BallbotParams.pivot_inertia)
        return cls(*(value.func(params) for value in derived), params.axial_inertia, params.gravity)


class BallbotBatch:
    """B ballbots that do one task, in torch, differentiable from actions and states to rewards and observations.

    `transition` is a pure function of state and actions; `reset` and `step` apply it to `self.state`. Gradients flow
    through `step` into earlier actions until an episode ends; `detach` cuts them. The physics is the closed form of
    `BallbotEnv(physics="rk4")`.
    """

    def __init__(
        self,
        task: str | Task = "stabilize",
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        compile: bool | str = "auto",
        params: BallbotParams | None = None,
        randomization: Randomization | None = None,
        **task_fields: Any,
    ):
        """Makes the batch; call `reset` first.

        Args:
            task: a name in `TASKS`, or a Task.
            num_envs: B.
            device, dtype: of all tensors; torch.float32 or torch.float64.
            compile: True compiles `transition` at the first step, for half a minute or so, and raises where that fails;
                "auto" does so for batches of at least `COMPILE_FROM` where a compiler is found, and falls back to eager
                execution with a warning in the log; False never compiles.
            params: the nominal robot; default, the paper's.
            randomization: what varies; default, nothing.
            **task_fields: fields of the task that replace its defaults.

        Raises:
            ValueError: num_envs, dtype or compile out of range, or as `make_task`.
            TypeError: a keyword that is no field of the task.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ValueError(f"num_envs must be a positive whole number, not {num_envs!r}")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, not {dtype}")
        if compile not in (True, False, "auto"):
            raise ValueError(f'compile must be True, False or "auto", not {compile!r}')
        self.task = make_task(task, **task_fields)
        self.params = default_params() if params is None else params
        self.randomization = Randomization() if randomization is None else randomization
        self.num_envs, self.device, self.dtype = int(num_envs), torch.device(device), dtype
        self.state: BatchState | None = None
        for name in _Robot._fields:
            getattr(self.params, name)  # computed and kept, before torch.compile meets a lock there
        self._substeps = dynamics.substeps_for(self.task.control_dt)
        self._past_steps = self.randomization.delay_steps(self.task.control_dt)[1]
        self._entropy = int(np.random.SeedSequence().generate_state(1)[0])
        self._compile = compile
        wanted = compile is True or (compile == "auto" and num_envs >= COMPILE_FROM and _has_compiler(self.device))
        self._run = _compiled(self._compilable) if wanted else self.transition
        self._proven = not wanted

    @property
    def compiled(self) -> bool:
        """Whether `step` runs compiled code; settled after the first step."""
        return self._run != self.transition

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: torch.Tensor | None = None,
        x: torch.Tensor | None = None,
        c: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Starts episodes.

        Args:
            seed: an int seeds env i with seed + i, a sequence env i with seed[i], where it is not None. Without one, each
                env goes on to its next episode, or is seeded at random the first time.
            mask: (B,) bool, the envs to reset; default, all. All are reset the first time.
            x: (8, B) initial states and c: (nc, B) constants; default, drawn. They are not checked.

        Returns:
            (B, no) observations of all envs.
        """
        self.state = self.begin(seed, mask, x, c)
        return self.observe(self.state)

    def begin(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: torch.Tensor | None = None,
        x: torch.Tensor | None = None,
        c: torch.Tensor | None = None,
    ) -> BatchState:
        """The state that `reset` would go to; changes nothing."""
        old = self.state
        if old is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
            seeds = torch.tensor(_seeds(self._entropy, self.num_envs), device=self.device)
            episode = torch.zeros_like(seeds)
        else:
            mask = torch.ones_like(old.seed, dtype=torch.bool) if mask is None else mask
            seeds, episode = old.seed, old.episode + 1
        if seed is not None:
            given = torch.tensor([-1 if s is None else s for s in _seeds(seed, self.num_envs)], device=self.device)
            seeds, episode = torch.where(given < 0, seeds, given), torch.where(given < 0, episode, 0)
        new = self._start(seeds, episode, x, c)
        return self._stacked(new if old is None else _select(mask, new, _rows(old)))

    def observe(self, state: BatchState) -> torch.Tensor:
        """(B, no) observations of a state: a pure function, the sensors' noise included."""
        return self._observe(_rows(state))

    def step(self, actions: torch.Tensor) -> BatchStep:
        """Holds forces for one control step; see `transition`. Call `reset` first."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("step() before reset()")
        try:
            self.state, result = self._run(self.state, actions)
        except Exception as error:
            if self._proven or self._compile is True:
                raise
            reason = str(error).strip().splitlines()[:1]
            _log.warning("torch.compile failed, the batch runs eagerly: %s %s", type(error).__name__, reason)
            self._run = self.transition
            self.state, result = self._run(self.state, actions)
        self._proven = True
        return result._replace(**{name: getattr(result, name).bool() for name in _FLAGS}) if self.compiled else result

    def detach(self) -> None:
        """Cuts the gradient: later steps do not reach back behind this point."""
        if self.state is not None:
            self.state = BatchState(*(part.detach() for part in self.state))

    def transition(self, state: BatchState, actions: torch.Tensor) -> tuple[BatchState, BatchStep]:
        """One control step of every env, and the start of the next episode where one ended; a pure function.

        Args:
            state: of the batch.
            actions: (B, 2) forces in units of the robot's force limit; clipped to [−1, 1]. They are taken to be finite.
        """
        task, noise = self.task, self.randomization
        now = _rows(state)
        x, c = now.x, now.c
        asked = actions.to(self.dtype).unbind(-1)
        command = tuple(part.clamp(-1.0, 1.0) * self.params.force_limit for part in asked)
        force, actuator = self._actuate(now, command)
        total = force
        if noise.pushes:
            z = _uniforms(_key(state.seed, state.episode, state.steps + 1), Randomization.PUSH_DRAWS, self.dtype)
            total = tuple(f + push for f, push in zip(force, noise.push(z, task.control_dt), strict=True))
        robot = self.params
        if noise.varies_robot:
            robot = _Robot.of(noise.robot(self.params, now.drawn[:4]))

        rate = task.cost(x, force, c)
        end = dynamics.step(robot, x, total, task.control_dt, self._substeps)
        safe, reached = _all(m >= 0 for m in task.margins(end, c)), _all(g <= 0 for g in task.goal(end, c))
        failure = ~safe  # so that a state that is not finite fails
        steps = state.steps + 1
        last = steps >= task.steps
        success = safe & reached if task.first_exit else safe & reached & last
        terminated = failure | success if task.first_exit else failure
        truncated = last & ~terminated
        done = terminated | truncated
        cost = rate * task.control_dt + task.failure_cost * failure

        after = now._replace(x=end, steps=steps, actuator=actuator)
        new = _select(done, self._start(state.seed, state.episode + 1), after)
        result = BatchStep(
            observation=self._observe(new),
            reward=-cost,
            terminated=terminated,
            truncated=truncated,
            final_observation=self._observe(after),
            final_x=torch.stack(end),
            success=success,
            failure=failure,
            force=torch.stack(force),
            clipped=_any(part.abs() > 1.0 for part in asked),
            final_tilt=_tilt(end),
            tilt=_tilt(new.x),
        )
        return self._stacked(new), result

    def _compilable(self, state: BatchState, actions: torch.Tensor) -> tuple[BatchState, BatchStep]:
        """`transition` with its flags as numbers 0 and 1: torch's CPU code generator stores bools one by one."""
        state, result = self.transition(state, actions)
        numbers = {name: torch.where(getattr(result, name), 1.0, 0.0) for name in _FLAGS}
        return state, result._replace(**numbers)

    def robot(self, i: int) -> BallbotParams:
        """The robot of env i in its running episode."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("no episode before reset()")
        if not self.randomization.varies_robot:
            return self.params
        return self.randomization.robot(self.params, tuple(self.state.drawn[:4, i].tolist()))

    def _start(
        self, seed: torch.Tensor, episode: torch.Tensor, x: torch.Tensor | None = None, c: torch.Tensor | None = None
    ) -> BatchState:
        """The beginnings of episodes, in rows; x and c are drawn where they are not given."""
        task, noise = self.task, self.randomization
        key = _key(seed, episode, 0 * episode)
        varied = noise.varies_robot or noise.varies_actuator
        count = task.constant_draws + task.state_draws + Randomization.EPISODE_DRAWS * varied
        z = _uniforms(key, count, self.dtype)
        z_constants, z = z[: task.constant_draws], z[task.constant_draws :]
        constants = task.draw_constants(z_constants, self.params) if c is None else c.unbind(0)
        state = task.draw_state(z[: task.state_draws], constants, self.params) if x is None else x.unbind(0)
        zero = torch.zeros_like(episode)
        drawn = noise.draw(z[task.state_draws :], task.control_dt) if varied else ()
        still = torch.zeros_like(seed, dtype=self.dtype)
        actuator = (still,) * (2 + 2 * self._past_steps) if noise.varies_actuator else ()
        return BatchState(state, constants, zero, episode, seed, drawn, actuator)

    def _actuate(self, now: BatchState, command: tuple) -> tuple[tuple, tuple]:
        """Force (2) applied, and the actuator's new memory, of a state in rows."""
        if not self.randomization.varies_actuator:
            return command, now.actuator
        pairs = tuple(zip(now.actuator[::2], now.actuator[1::2], strict=True))
        force = actuate(command, pairs[1:], pairs[0], now.drawn[4], now.drawn[5])
        kept = (command, *pairs[1:])[: self._past_steps]
        return force, tuple(part for pair in (force, *kept) for part in pair)

    def _observe(self, now: BatchState) -> torch.Tensor:
        """(B, no) of a state in rows with the sensors' noise, which is drawn for the episode's steps so far."""
        x = now.x
        if self.randomization.is_noisy:
            key = _key(now.seed, now.episode, now.steps + 1)
            z = _uniforms(key, Randomization.PUSH_DRAWS + Randomization.NOISE_DRAWS, self.dtype)
            x = self.randomization.sensed(x, z[Randomization.PUSH_DRAWS :])
        return torch.stack(self.task.observe(x, now.c)).T

    def _stacked(self, rows: BatchState) -> BatchState:
        """A state in rows as tensors."""
        none = torch.zeros(0, *rows.seed.shape, dtype=self.dtype, device=rows.seed.device)
        return BatchState(
            *(part if isinstance(part, torch.Tensor) else torch.stack(part) if part else none for part in rows)
        )


class BallbotVectorEnv(gymnasium.vector.VectorEnv):
    """Many ballbots in one Gymnasium `VectorEnv`: `gymnasium.make_vec("BallbotStabilize-v0", num_envs=1024)`.

    Spaces, rewards, ends and `info` are those of `BallbotEnv(physics="rk4")`, with float32 physics unless dtype says
    otherwise. Episodes restart within the step in which they end (`AutoresetMode.SAME_STEP`): then `infos` has, under
    `final_obs` and `final_info`, what that step showed before the restart. In `final_info`, only the envs that the masks
    `_…` mark are meant. Arrays returned are never written to again; `state` and `constants` in `infos` are the batch's
    own memory, and read-only. Observations and states lie in memory component by component (Fortran order), as those of
    Gymnasium's own batched CartPole; give actions in that order too and they are not copied.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        task: str | Task = "stabilize",
        render_mode: str | None = None,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        compile: bool | str = "auto",
        params: BallbotParams | None = None,
        randomization: Randomization | None = None,
        **task_fields: Any,
    ):
        """Makes the environments; all arguments but render_mode are `BallbotBatch`'s.

        Args:
            render_mode: None or "rgb_array", which draws every env in turn.

        Raises:
            ValueError: an unknown render mode, or as `BallbotBatch`.
            TypeError: a keyword that is no field of the task.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; known: None, 'rgb_array'")
        self.batch = BallbotBatch(task, num_envs, device, dtype, compile, params, randomization, **task_fields)
        self.task, self.params, self.randomization = self.batch.task, self.batch.params, self.batch.randomization
        self.num_envs, self.render_mode = self.batch.num_envs, render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / self.task.control_dt)}
        limit = self.task.OBSERVATION_LIMIT
        self.single_action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space = spaces.Box(-limit, limit, (len(self.task.observation_scale),), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._scene: Scene | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: env i is seeded with seed + i, or with seed[i]; where there is none, it goes on to its next episode.
            options: may hold "reset_mask", (B,) bool NumPy array of the envs to reset; "state", (8,) or (B, 8) initial
                states; "constants", (nc,) or (B, nc), or a dict of some of them by name, each a number or (B,).

        Returns:
            Observations (B, no) of all envs, and infos of those reset.

        Raises:
            TypeError, ValueError: an unknown option, or a value of the wrong type, shape or range.
        """
        self._check_open()
        options = dict(options or {})
        mask = _reset_mask(options.pop("reset_mask", None), self.num_envs)
        x, constants = options.pop("state", None), options.pop("constants", None)
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; known: 'reset_mask', 'state', 'constants'")
        if self.batch.state is None:
            mask = np.ones_like(mask)
        tensor_mask = torch.from_numpy(mask).to(self.batch.device)
        with torch.no_grad():
            state = self.batch.begin(seed, tensor_mask)
            if constants is not None:
                c = self._constants(constants, state, mask)
                state = self.batch.begin(seed, tensor_mask, c=c)
            if x is not None:
                state = self._with_x(state, x, mask)
            self.batch.state = state
            observation = self.batch.observe(state)
        size = self.num_envs
        infos = self._info(
            state,
            np.zeros(size),
            self._array(_tilt(state.x.unbind(0))),
            np.zeros((size, 2)),
            *np.zeros((3, size), bool),
        )
        return self._array(observation, np.float32), _masked(infos, mask)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Holds forces for one control step, and restarts episodes that end.

        Args:
            actions: (B, 2) forces in units of the robot's force limit; clipped to [−1, 1].

        Raises:
            ValueError: actions that are not finite or not of shape (B, 2).
            gymnasium.error.ResetNeeded: before `reset`.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        self._check_open()
        actions = np.asarray(actions, self._dtype, order="F")  # components contiguous, as everything in the batch
        if actions.shape != (self.num_envs, 2):
            raise ValueError(f"actions must have shape ({self.num_envs}, 2), not {actions.shape}")
        if not np.isfinite(actions).all():
            bad = np.flatnonzero(~np.isfinite(actions).all(1))
            raise ValueError(f"actions must be finite; those of envs {bad[:8].tolist()} are not")
        before = self.batch.state
        with torch.no_grad():
            result = self.batch.step(torch.from_numpy(actions).to(self.batch.device))
        reward = self._array(result.reward, np.float64)
        terminated, truncated = self._array(result.terminated), self._array(result.truncated)
        done = terminated | truncated
        ended = np.flatnonzero(done)
        cost, tilt = -reward, self._array(result.tilt)
        force, clipped = self._array(result.force), self._array(result.clipped)
        infos: dict[str, Any] = {}
        if ended.size:
            success, failure = self._array(result.success), self._array(result.failure)
            final = before._replace(x=result.final_x)
            final_tilt = self._array(result.final_tilt)
            final_info = self._info(final, cost, final_tilt, force.T, success, failure, clipped)
            infos["final_info"] = _masked(final_info, done)
            infos["final_obs"] = _some_rows(self._array(result.final_observation, np.float32), ended)
            infos["_final_info"] = infos["_final_obs"] = done
            # What follows is of the next episodes where one ended, and they begin as after `reset`.
            cost, force, clipped = cost.copy(), force.copy(), clipped.copy()
            cost[ended], force[:, ended], clipped[ended] = 0.0, 0.0, False
        never = np.zeros_like(done)
        info = self._info(self.batch.state, cost, tilt, force.T, never, never.copy(), clipped)
        infos |= _masked(info, np.ones_like(done))
        return self._array(result.observation, np.float32), reward, terminated, truncated, infos

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every env: of this object, or "episode_params", the robot of the running episode."""
        if name == "np_random_seed":
            return self.np_random_seed
        if name == "episode_params":
            return tuple(self.batch.robot(i) for i in range(self.num_envs))
        return (getattr(self, name),) * self.num_envs

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """As `get_attr`, or what `render` gives for every env."""
        if name == "render":
            return self.render()
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
        if self.batch.state is None:
            raise gymnasium.error.ResetNeeded("no seeds before reset()")
        return tuple(self.batch.state.seed.tolist())

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image (height, width, 3), uint8, of each env."""
        self._check_open()
        if self.render_mode is None:
            gymnasium.logger.warn('render() without a render mode; make the envs with render_mode="rgb_array"')
            return None
        if self.batch.state is None:
            raise gymnasium.error.ResetNeeded("render() before reset()")
        if self._scene is None:
            self._scene = Scene(self.params)
        images = []
        for x, c in zip(self.batch.state.x.T.tolist(), self.batch.state.c.T.cpu().double().numpy(), strict=True):
            self._scene.set_markers(self.task.markers(c))
            images.append(self._scene.draw(tuple(x)))
        return tuple(images)

    def close_extras(self, **kwargs: Any) -> None:
        """Releases the renderer."""
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    @property
    def _dtype(self) -> type[np.floating]:
        return np.float32 if self.batch.dtype == torch.float32 else np.float64

    def _check_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("this environment was closed; make a new one")

    @staticmethod
    def _array(tensor: torch.Tensor, dtype: Any = None) -> np.ndarray:
        array = tensor.cpu().numpy()
        return array if dtype is None else array.astype(dtype, copy=False)

    def _info(
        self,
        state: BatchState,
        cost: np.ndarray,
        tilt: np.ndarray,
        force: np.ndarray,
        success: np.ndarray,
        failure: np.ndarray,
        clipped: np.ndarray,
    ) -> dict[str, Any]:
        """The keys of `BallbotEnv`'s info, in its order; the batch's own memory is not to be written to."""
        x, c = self._array(state.x.T), self._array(state.c.T)
        x.flags.writeable = c.flags.writeable = False
        return {
            "state": x,
            "cost": cost,
            "tilt": tilt,
            "success": success,
            "failure": failure,
            "force": force,
            "clipped": clipped,
            "constants": c,
        }

    def _constants(self, constants: Any, drawn: BatchState, mask: np.ndarray) -> torch.Tensor:
        """(nc, B) constants, those given in place of those drawn."""
        names, task = self.task.constant_names, self.task
        c = self._array(drawn.c).astype(np.float64)
        if isinstance(constants, dict):
            unknown = sorted(set(constants) - set(names))
            if unknown:
                raise ValueError(f"{task.id} has no constants {unknown}; it has {list(names)}")
            for name, value in constants.items():
                c[names.index(name)] = _finite(value, (self.num_envs,), f"constant {name!r}")
        else:
            c[:] = _finite(constants, (self.num_envs, len(names)), "constants").T
        for distinct in np.unique(c[:, mask], axis=1).T:
            task.check_constants(distinct, self.params)
        return torch.as_tensor(c.astype(self._dtype), device=self.batch.device)

    def _with_x(self, state: BatchState, given: Any, mask: np.ndarray) -> BatchState:
        """The state with the initial x given, checked, where the mask says so."""
        x = torch.as_tensor(_finite(given, (self.num_envs, 8), "state").T.astype(self._dtype, order="C"))
        x = torch.where(torch.from_numpy(mask), x, state.x.cpu()).to(self.batch.device)
        safe = self._array(_all(m >= 0 for m in self.task.margins(x.unbind(0), state.c.unbind(0))))
        if not safe[mask].all():
            bad = np.flatnonzero(mask & ~safe)
            raise ValueError(f"start states of envs {bad[:8].tolist()} violate a margin of {self.task.id}")
        return state._replace(x=x)


def _has_compiler(device: torch.device) -> bool:
    if device.type == "cuda":
        return True  # Triton brings its own
    return any(shutil.which(name) for name in ("g++", "c++", "clang++"))


def _compiled(transition: Any) -> Any:
    """The bound method compiled, from a copy of its code: PyTorch limits recompilations per code object, and here every
    batch size and task is one.
    """
    function = transition.__func__
    own = types.FunctionType(function.__code__.replace(), function.__globals__, function.__name__)
    # By default no loop takes more than 64 operations, and what crosses from one loop to the next goes through memory.
    options = {"max_fusion_size": 1000}
    return torch.compile(types.MethodType(own, transition.__self__), fullgraph=True, dynamic=False, options=options)


def _rows(state: BatchState) -> BatchState:
    """The state with each of its matrices as a tuple of rows (B,), the form in which everything is computed."""
    return BatchState(*(part.unbind(0) if part.ndim == 2 else part for part in state))


def _select(mask: torch.Tensor, new: BatchState, old: BatchState) -> BatchState:
    """The new state where the mask (B,) holds, else the old, both in rows."""

    def chosen(a: Any, b: Any) -> Any:
        if isinstance(a, tuple):
            return tuple(map(chosen, a, b))
        return a if a is b else torch.where(mask, a, b)

    return BatchState(*map(chosen, new, old))


def _all(conditions: Any) -> torch.Tensor:
    """Elementwise and."""
    first, *others = conditions
    for condition in others:
        first = first & condition
    return first


def _any(conditions: Any) -> torch.Tensor:
    """Elementwise or."""
    first, *others = conditions
    for condition in others:
        first = first | condition
    return first


def _tilt(x: tuple) -> torch.Tensor:
    """(B,) rad of states of 8 rows, without gradient, which is infinite at upright."""
    # float rounding can leave a cosine a hair above 1
    return torch.acos(dynamics.cos_tilt(tuple(part.detach() for part in x)).clamp(max=1.0))


def _mix(word: torch.Tensor) -> torch.Tensor:
    """A bijection of 32-bit words that scatters them: the multiply and xor-shift rounds of murmur's finalizer."""
    word = ((word ^ (word >> 16)) * 0x21F0AAAD) & _WORD
    word = ((word ^ (word >> 15)) * 0x735A2D97) & _WORD
    return word ^ (word >> 15)


def _key(seed: torch.Tensor, episode: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """(B,) words from which one step's random numbers follow; step 0 is the start of the episode."""
    return _mix(_mix(_mix(_mix(seed & _WORD) ^ (seed >> 32)) ^ (episode & _WORD)) ^ (step & _WORD))


def _uniforms(key: torch.Tensor, count: int, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    """`count` tensors (B,) of uniform numbers in [0, 1), multiples of 2⁻²⁴ and so the same in both dtypes."""
    words = (_mix((key + 0x9E3779B9 * i) & _WORD) for i in range(1, count + 1))
    return tuple((word >> 8).to(dtype) * 2.0**-24 for word in words)


def _seeds(seed: int | Sequence[int | None], num_envs: int) -> list[int | None]:
    """One seed per env."""
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
        seed = [int(seed) + i for i in range(num_envs)]
    if len(seed) != num_envs:
        raise ValueError(f"seed has {len(seed)} entries for {num_envs} envs")
    for value in seed:
        if value is not None and not 0 <= value < 2**63:
            raise ValueError(f"seeds must be in [0, 2^63), not {value}")
    return list(seed)


def _reset_mask(mask: Any, num_envs: int) -> np.ndarray:
    """The option "reset_mask", checked as Gymnasium's vector envs do."""
    if mask is None:
        return np.ones(num_envs, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, not {mask!r}")
    if mask.shape != (num_envs,):
        raise ValueError(f"options['reset_mask'] must have shape ({num_envs},), not {mask.shape}")
    if not mask.any():
        raise ValueError("options['reset_mask'] must be True somewhere")
    return mask.copy()


def _finite(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """value as a float64 array, broadcast to shape."""
    try:
        array = np.broadcast_to(np.asarray(value, np.float64), shape)
    except (TypeError, ValueError):
        array = np.full(shape, math.nan)
    if not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite numbers that broadcast to {shape}, not {value!r}")
    return array


def _masked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """An info with Gymnasium's masks, which say whose entries are meant."""
    return {key: part for name, value in info.items() for key, part in ((name, value), (f"_{name}", mask))}


def _some_rows(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Gymnasium's layout of `final_obs`: (B,) objects, a row of the array where an index is given, else None."""
    objects = np.empty(len(array), dtype=object)  # full of None
    objects[rows] = np.fromiter(array[rows], dtype=object, count=len(rows))
    return objects
