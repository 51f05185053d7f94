"""Proximal policy optimization, of Stable-Baselines3, from scratch or from demonstrations.

What demonstrations do is `ModelFree`'s; the imitation loss whose weight fades is that of Rajeswaran et al., Learning Complex
Dexterous Manipulation with Deep Reinforcement Learning and Demonstrations, 2018.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning.demonstrations import Demos, load_demos
from ballbot_train.learning.learners.model_free import ModelFree, ModelFreeConfig, as_policy
from ballbot_train.policy import PolicyNetwork


@dataclass(frozen=True)
class PpoConfig(ModelFreeConfig):
    """Settings of `Ppo`."""

    iterations: int = 400
    envs: int = 256
    steps: int = 64
    imitation: float = 0.3
    """Of the expert's negative log-probability."""
    gae_lambda: float = 0.95
    relative: float = 0.0
    """> 0 divides every advantage by the size of the value there plus this (both in scaled rewards): regret is relative."""
    learning_rate: float = 1e-3
    """At the start; falls linearly to `final_rate` of it."""
    demo_rate: float = 1e-4
    """In place of `learning_rate` where there are demonstrations."""
    final_rate: float = 0.02
    epochs: int = 5
    batch: int = 2048
    clip: float = 0.2
    max_gradient: float = 0.5
    deviation: float = 0.2
    """Standard deviation of the actions at the start, falling geometrically to `final_deviation`."""
    final_deviation: float = 0.03
    demo_deviation: float = 0.05
    """In place of `deviation` where there are demonstrations."""


TUNED: dict[str, PpoConfig] = {
    "stabilize": PpoConfig(),
    "turn": PpoConfig(episode=8.0),
    "orbit": PpoConfig(),
    "weave": PpoConfig(episode=8.0),
}
"""By task."""


class RelativeRollouts(RolloutBuffer):
    """A rollout buffer with advantages relative to the value of the state they were won in."""

    def __init__(self, *args: Any, floor: float, **kwargs: Any):
        self._floor = floor
        super().__init__(*args, **kwargs)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        super().compute_returns_and_advantage(last_values, dones)
        self.advantages /= np.abs(self.values) + self._floor


class Ppo(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: PpoConfig, seed: int = 0, demos: Demos | None = None):
        """Args: demos: `Demos` to begin with, or None."""
        super().__init__(task, params, config, demos)
        self._deviation = config.deviation if demos is None else config.demo_deviation
        self._rate = config.learning_rate if demos is None else config.demo_rate
        model = PPO(
            "MlpPolicy",
            self._env,
            learning_rate=lambda _: self._rate * (1 - (1 - config.final_rate) * self._progress),
            n_steps=config.steps,
            batch_size=config.batch,
            n_epochs=config.epochs,
            gamma=config.discount,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip,
            max_grad_norm=config.max_gradient,
            policy_kwargs={"net_arch": list(config.hidden)},
            rollout_buffer_class=RelativeRollouts if config.relative else None,
            rollout_buffer_kwargs={"floor": config.relative} if config.relative else None,
            seed=seed,
            device="cpu",
        )
        policy = model.policy
        policy.log_std.requires_grad_(False)
        self._begin(
            model, torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net), (policy.optimizer,)
        )

    @property
    def network(self) -> PolicyNetwork:
        return as_policy(self._actor, self._task, activation="tanh", squash="clip")

    def _improve(self) -> dict[str, float]:
        deviation = self._deviation * (self.config.final_deviation / self._deviation) ** self._progress
        self._model.policy.log_std.data.fill_(np.log(deviation))
        return super()._improve()

    def _imitation_scale(self) -> float:
        return float(self._model.policy.log_std.detach().exp()[0]) ** -2


def make(task: Task, params: BallbotParams, config: PpoConfig, seed: int, demos: Path | None) -> Ppo:
    """The learner at its beginning."""
    return Ppo(task, params, config, seed, None if demos is None else load_demos(demos, task))
