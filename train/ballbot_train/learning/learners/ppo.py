"""Proximal policy optimization by Stable-Baselines3, from scratch or from demonstrations.

`ModelFree` says what demonstrations do. Adding an imitation loss whose weight falls follows Rajeswaran et al., "Learning
complex dexterous manipulation with deep reinforcement learning and demonstrations", 2018.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.demonstrations import Demos, load_demos
from ballbot_train.learning.learners.model_free import ModelFree, ModelFreeConfig, as_policy
from ballbot_train.policy import PolicyNetwork


@dataclass(frozen=True)
class PpoConfig(ModelFreeConfig):
    """Settings of `Ppo`."""

    rl_iterations: int = 400
    num_envs: int = 256
    num_steps: int = 64
    imitation_weight: float = 0.3
    """Weight of the imitation loss, the expert's negative log-likelihood, at the start; falls linearly to 0."""
    gae_lambda: float = 0.95
    """λ of generalized advantage estimation."""
    relative_advantage_floor: float = 0.0
    """If > 0, every advantage is divided by |value| + this, in scaled rewards, because regret is relative; 0: off."""
    learning_rate: float = 1e-3
    """Learning rate at the start."""
    demo_learning_rate: float = 1e-4
    """In place of `learning_rate` if there are demonstrations."""
    final_learning_rate_fraction: float = 0.02
    """Learning rate at the end, as a fraction of that at the start. It falls linearly."""
    update_epochs: int = 5
    """Passes over the rollouts of an iteration."""
    batch_size: int = 2048
    """Env steps per gradient step."""
    clip_range: float = 0.2
    """Range to which the ratio of new and old probability is clipped, about 1."""
    max_grad_norm: float = 0.5
    """Norm to which gradients are clipped."""
    std: float = 0.2
    """Standard deviation of the actions at the start, in units of the force limit."""
    final_std: float = 0.03
    """Standard deviation at the end. It falls geometrically."""
    demo_std: float = 0.05
    """In place of `std` if there are demonstrations."""


TUNED: dict[str, PpoConfig] = {"turn": PpoConfig(episode_seconds=8.0), "weave": PpoConfig(episode_seconds=8.0)}
"""Settings by name of task; every other task takes the defaults."""


class RelativeRollouts(RolloutBuffer):
    """A rollout buffer whose advantages are divided by the absolute value of their state, plus a floor."""

    def __init__(self, *args: Any, floor: float, **kwargs: Any):
        self._floor = floor
        super().__init__(*args, **kwargs)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        super().compute_returns_and_advantage(last_values, dones)
        self.advantages /= np.abs(self.values) + self._floor


class Ppo(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: PpoConfig, seed: int = 0, demos: Demos | None = None):
        """Args: demos: demonstrations to imitate, or None."""
        super().__init__(task, params, config, demos)
        self.config = config
        self._std = config.std if demos is None else config.demo_std
        rate = config.learning_rate if demos is None else config.demo_learning_rate
        model = PPO(
            "MlpPolicy",
            self._env,
            learning_rate=lambda _: schedules.linear(rate, config.final_learning_rate_fraction, self._progress),
            n_steps=config.num_steps,
            batch_size=config.batch_size,
            n_epochs=config.update_epochs,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            max_grad_norm=config.max_grad_norm,
            policy_kwargs={"net_arch": list(config.hidden)},
            rollout_buffer_class=RelativeRollouts if config.relative_advantage_floor else None,
            rollout_buffer_kwargs=(
                {"floor": config.relative_advantage_floor} if config.relative_advantage_floor else None
            ),
            seed=seed,
            device="cpu",
        )
        policy = cast(ActorCriticPolicy, model.policy)
        self._log_std = cast(torch.nn.Parameter, policy.log_std)
        self._log_std.requires_grad_(False)
        actor = torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
        self._set_model(model, actor, (policy.optimizer,))

    @property
    def network(self) -> PolicyNetwork:
        return as_policy(self._actor, self._task, activation="tanh", squash="clip")

    def _improve(self) -> dict[str, float]:
        std = schedules.geometric(self._std, self.config.final_std, self._progress)
        self._log_std.data.fill_(np.log(std))
        return super()._improve()

    def _imitation_scale(self) -> float:
        return float(self._log_std.detach().exp()[0]) ** -2


def make(task: Task, params: BallbotParams, config: PpoConfig, seed: int, demos: Path | None) -> Ppo:
    """Makes the learner.

    Raises:
        ValueError: the demonstrations are of another task.
    """
    return Ppo(task, params, config, seed, None if demos is None else load_demos(demos, task))
