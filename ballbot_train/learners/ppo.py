"""Proximal policy optimization, of Stable-Baselines3, from scratch or from demonstrations.

With demonstrations there are three stages. First the actor imitates the expert's actions (behaviour cloning). Then its
critic alone learns what the imitation costs, because the first advantages of a critic that knows nothing would spoil it.
From then on it is PPO, whose every gradient step also follows the gradient of an imitation loss, with a weight that fades
linearly to nothing (Rajeswaran et al., Learning Complex Dexterous Manipulation with Deep Reinforcement Learning and
Demonstrations, 2018).

A resumed run does what it would have done; only the success rate of the last hundred episodes is not kept.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.logger import Logger

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.demos import Demos, load_demos
from ballbot_train.learners.model_free import Imitation, OwnRandomness, TrainingEnv, as_policy
from ballbot_train.policy import PolicyNetwork


@dataclass(frozen=True)
class PpoConfig:
    """Settings of `Ppo`."""

    iterations: int = 400
    """Of PPO: `envs` times `steps` env steps each."""
    evaluations: int = 20
    envs: int = 256
    steps: int = 64
    """Control steps of each env per iteration."""
    episode: float = 4.0
    """s, after which episodes start anew in training."""
    fall_price: float = 300.0
    reward_scale: float = 0.1
    discount: float = 0.995
    """Per control step."""
    gae_lambda: float = 0.95
    relative: float = 0.0
    """> 0 divides every advantage by the size of the value there plus this (both in scaled rewards): regret is relative."""
    hidden: tuple[int, ...] = (128, 128)
    """Of actor and of critic."""
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
    clone_iterations: int = 20
    """Iterations of behaviour cloning before PPO's, of `clone_steps` gradient steps each."""
    clone_steps: int = 300
    clone_batch: int = 1024
    clone_rate: float = 2e-3
    """Learning rate at the start, falling linearly to 0."""
    critic_iterations: int = 10
    """How many of PPO's iterations teach the critic alone."""
    imitation: float = 0.3
    """Weight of the imitation loss, minus the mean log-probability of the expert's actions, at the start of PPO."""


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


class Ppo:
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: PpoConfig, seed: int = 0, demos: Demos | None = None):
        """Args: demos: a `Demos` to begin with, or None."""
        self.config, self.iteration, self._task = config, 0, task
        self._clone_iterations = 0 if demos is None else config.clone_iterations
        self._critic_iterations = 0 if demos is None else config.critic_iterations
        self._deviation = config.deviation if demos is None else config.demo_deviation
        self._rate = config.learning_rate if demos is None else config.demo_rate
        self.iterations, self.evaluations = config.iterations + self._clone_iterations, config.evaluations
        self._env = TrainingEnv(task, params, config.envs, config.episode, config.fall_price, config.reward_scale)
        self._model = PPO(
            "MlpPolicy",
            self._env,
            learning_rate=lambda _: self._learning_rate(),
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
        self._model.set_logger(Logger(folder=None, output_formats=[]))
        self._model._last_obs = self._env.reset()
        self._model._last_episode_starts = np.ones(config.envs, bool)
        policy = self._model.policy
        policy.log_std.requires_grad_(False)
        self._actor = torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
        self._imitation = None if demos is None else Imitation(self._actor, demos, config.clone_batch)
        policy.optimizer.register_step_pre_hook(self._add_imitation)
        self._random = OwnRandomness()

    @property
    def network(self) -> PolicyNetwork:
        return as_policy(self._actor, self._task, activation="tanh", squash="clip")

    def iterate(self) -> dict[str, float]:
        with self._random:
            figures = self._clone() if self.iteration < self._clone_iterations else self._improve()
        self.iteration += 1
        return figures

    def state_dict(self) -> dict[str, Any]:
        model = self._model
        return {
            "iteration": self.iteration,
            "policy": model.policy.state_dict(),
            "optimizer": model.policy.optimizer.state_dict(),
            "imitation": self._imitation and self._imitation.state_dict(),
            "env_steps": model.num_timesteps,
            "env": self._env.state_dict(),
            "observations": torch.as_tensor(model._last_obs),
            "starts": torch.as_tensor(model._last_episode_starts),
            "random": self._random.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        model = self._model
        self.iteration = state["iteration"]
        model.policy.load_state_dict(state["policy"])
        model.policy.optimizer.load_state_dict(state["optimizer"])
        if self._imitation is not None:
            self._imitation.load_state_dict(state["imitation"])
        model.num_timesteps = state["env_steps"]
        self._env.load_state_dict(state["env"])
        model._last_obs, model._last_episode_starts = state["observations"].numpy(), state["starts"].numpy()
        self._random.load_state_dict(state["random"])

    @property
    def _progress(self) -> float:
        """Share of PPO's iterations done."""
        return (self.iteration - self._clone_iterations) / self.config.iterations

    def _learning_rate(self) -> float:
        return self._rate * (1 - (1 - self.config.final_rate) * self._progress)

    def _clone(self) -> dict[str, float]:
        """One iteration of behaviour cloning."""
        rate = self.config.clone_rate * (1 - self.iteration / self._clone_iterations)
        return self._imitation.clone(self.config.clone_steps, rate)

    def _improve(self) -> dict[str, float]:
        """One iteration of PPO."""
        config, model = self.config, self._model
        deviation = self._deviation * (config.final_deviation / self._deviation) ** self._progress
        model.policy.log_std.data.fill_(np.log(deviation))
        self._actor.requires_grad_(not self._critic_only)
        model.learn(config.envs * config.steps, log_interval=None, reset_num_timesteps=False)
        self._actor.requires_grad_(True)
        return {**model.logger.name_to_value, "train/env_steps": model.num_timesteps}

    @property
    def _critic_only(self) -> bool:
        return self.iteration < self._clone_iterations + self._critic_iterations

    def _add_imitation(self, *_: object) -> None:
        """Adds the imitation loss's gradient to that of a step of PPO."""
        weight = self.config.imitation * (1 - self._progress)
        if self._imitation is not None and not self._critic_only:
            variance = float(self._model.policy.log_std.detach().exp()[0]) ** 2
            (weight / variance * self._imitation.loss()).backward()


def make(task: Task, params: BallbotParams, config: PpoConfig, seed: int, demos: Path | None) -> Ppo:
    """The learner at its beginning."""
    return Ppo(task, params, config, seed, None if demos is None else load_demos(demos, task))
