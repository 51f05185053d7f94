"""BallbotVectorEnv: Gymnasium's vector interface to a `BallbotBatch`, with NumPy arrays."""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ballbot_gym.batch import BallbotBatch, BatchState, all_of, tilt_of
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.scene import Scene
from ballbot_gym.tasks import Task


class BallbotVectorEnv(gymnasium.vector.VectorEnv):
    """Many ballbots in one Gymnasium `VectorEnv`: `gymnasium.make_vec("BallbotStabilize-v0", num_envs=1024)`.

    Spaces, rewards, ends and `info` are those of `BallbotEnv(physics="rk4")`, in float32 by default. An env starts its next
    episode in the step that ends the last one (`AutoresetMode.SAME_STEP`). `infos["final_obs"]` and `infos["final_info"]`
    then hold the observation and info before the restart. The entries of `final_info` are valid only for the envs that the
    masks `_…` mark. Returned arrays never change later; `state` and `constants` in `infos` share the batch's memory and are
    read-only. Observations and states are in Fortran order, component by component, like those of Gymnasium's own batched
    CartPole. Actions in that order are not copied.
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
        """Makes the environments. All arguments except render_mode are those of `BallbotBatch`.

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
            seed: env i is seeded with seed + i, or with seed[i]. An env without a seed starts its next episode.
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
            state = self.batch.initial_state(seed, tensor_mask)
            if constants is not None:
                c = self._constants(constants, state, mask)
                state = self.batch.initial_state(seed, tensor_mask, c=c)
            if x is not None:
                state = self._with_x(state, x, mask)
            self.batch.state = state
            observation = self.batch.observe(state)
        size = self.num_envs
        infos = self._info(
            state,
            np.zeros(size),
            self._array(tilt_of(state.x.unbind(0))),
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
        before = self.batch.state
        if before is None:
            raise gymnasium.error.ResetNeeded("step() before reset()")
        actions = np.asarray(actions, self._dtype, order="F")  # components contiguous, as everything in the batch
        if actions.shape != (self.num_envs, 2):
            raise ValueError(f"actions must have shape ({self.num_envs}, 2), not {actions.shape}")
        if not np.isfinite(actions).all():
            bad = np.flatnonzero(~np.isfinite(actions).all(1))
            raise ValueError(f"actions must be finite; those of envs {bad[:8].tolist()} are not")
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
            # Where an episode ended, the info below is that of the next episode's start, as after `reset`.
            cost, force, clipped = cost.copy(), force.copy(), clipped.copy()
            cost[ended], force[:, ended], clipped[ended] = 0.0, 0.0, False
        never = np.zeros_like(done)
        state = self.batch.state
        assert state is not None
        info = self._info(state, cost, tilt, force.T, never, never.copy(), clipped)
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
        """An info with the keys of `BallbotEnv`'s, in the same order. Arrays that share the batch's memory are read-only."""
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
        """(nc, B) constants: those given, and drawn ones for the rest."""
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
        """The state with the given initial x in the masked envs. Raises a ValueError if one violates a margin."""
        x = torch.as_tensor(_finite(given, (self.num_envs, 8), "state").T.astype(self._dtype, order="C"))
        x = torch.where(torch.from_numpy(mask), x, state.x.cpu()).to(self.batch.device)
        safe = self._array(all_of(m >= 0 for m in self.task.margins(x.unbind(0), state.c.unbind(0))))
        if not safe[mask].all():
            bad = np.flatnonzero(mask & ~safe)
            raise ValueError(f"start states of envs {bad[:8].tolist()} violate a margin of {self.task.id}")
        return state._replace(x=x)


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
    """An info with Gymnasium's masks, which mark the envs whose entries are valid."""
    return {key: part for name, value in info.items() for key, part in ((name, value), (f"_{name}", mask))}


def _some_rows(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Gymnasium's layout of `final_obs`: (B,) objects, a row of the array where an index is given, else None."""
    objects = np.empty(len(array), dtype=object)  # full of None
    objects[rows] = np.fromiter(array[rows], dtype=object, count=len(rows))
    return objects
