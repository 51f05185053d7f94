"""Stable-Baselines3 on the batched environments: it takes its own `VecEnv` and not Gymnasium's vector envs."""

import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from ballbot_gym.seeding import spawned
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_train.policy.saved_models import mark


class BallbotVecEnv(VecEnv):
    """A `BallbotVectorEnv` as a Stable-Baselines3 `VecEnv`: `PPO("MlpPolicy", BallbotVecEnv(make_vec(...)))`.

    The info of a step is empty while an episode is running. When it ends, the info holds:

    | key | meaning |
    |---|---|
    | terminal_observation | (no,) last observation of the episode |
    | TimeLimit.truncated | the episode ran out of time, so learners bootstrap from the value of that observation |
    | is_success | the task's goal held at the end; logged as `rollout/success_rate` |
    | failure | a limit was violated |
    | episode | the return r, the length l in control steps and the seconds t since this object was created, as in `Monitor` |

    A `VecMonitor` is not needed. `gymnasium.make_vec(..., max_episode_steps=100)` limits episodes.
    """

    def __init__(self, env: BallbotVectorEnv):
        """Args: env: the vector env, from now on stepped through this object only.

        Raises:
            TypeError: env is something else; `.unwrapped` of what `gymnasium.make_vec` returns is right.
            ValueError: its autoreset mode is not SAME_STEP, the only one that Stable-Baselines3 supports.
        """
        if not isinstance(env, BallbotVectorEnv):
            raise TypeError(f"BallbotVecEnv needs a BallbotVectorEnv, not {type(env).__name__}")
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(
                'Stable-Baselines3 needs autoreset_mode="SameStep", the default of make_vec, not '
                f'"{env.autoreset_mode.value}"'
            )
        self.env = env
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, np.int64)
        self._made = time.time()
        self._actions: np.ndarray | None = None
        if env.observation == "state":
            mark(env.single_observation_space, env.task, env.params)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.metadata = (
            env.metadata | self.metadata
        )  # of the latter the render modes: the base class draws "human" itself

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds the envs for the next reset, with numbers that runs with other seeds do not use; returns these numbers."""
        return super().seed(None if seed is None else spawned(seed))

    def reset(self) -> np.ndarray:
        """Starts an episode in every env, with the seeds and options set since the last reset."""
        seeded = any(seed is not None for seed in self._seeds)
        observation, _ = self.env.reset(seed=self._seeds if seeded else None, options=_merged(self._options))
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        assert self._actions is not None, "step_async comes before step_wait"
        observation, reward, terminated, truncated, infos = self.env.step(self._actions)
        done = terminated | truncated
        self._returns += reward
        self._lengths += 1
        elapsed = round(time.time() - self._made, 6)
        listed: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            listed[i] = {
                "terminal_observation": infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(infos["final_info"]["success"][i]),
                "failure": bool(infos["final_info"]["failure"][i]),
                "episode": {"r": round(float(self._returns[i]), 6), "l": int(self._lengths[i]), "t": elapsed},
            }
        self._returns[done], self._lengths[done] = 0.0, 0
        return observation, reward.astype(np.float32), done, listed

    def close(self) -> None:
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        values = self.env.get_attr(attr_name)
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        self.env.set_attr(attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        values = self.env.call(method_name, *method_args, **method_kwargs)
        return [values[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None) -> list[bool]:
        # Tools ask for Monitor to know whether episodes' statistics are in the infos.
        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]


def _merged(options: list[dict[str, Any]]) -> dict[str, Any] | None:
    """One dict of reset options for all envs from one for each.

    Raises:
        ValueError: some envs have options that others have not.
    """
    if not any(options):
        return None
    if any(set(option) != set(options[0]) for option in options):
        raise ValueError("reset options must have the same keys for every env")
    return {
        key: {name: np.array([option[key][name] for option in options]) for name in value}
        if isinstance(value, dict)
        else np.stack([option[key] for option in options])
        for key, value in options[0].items()
    }
