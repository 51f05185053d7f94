"""Soft actor-critic, of Stable-Baselines3, from scratch or from demonstrations.

With demonstrations half of every batch is drawn from them and half from what the actor did itself (Ball et al., Efficient
Online Reinforcement Learning with Offline Data, 2023). And as with PPO the actor begins by imitating the expert, waits for
its critics to learn what that costs, and then follows the gradient of an imitation loss too, whose weight fades.

A resumed run does what it would have done; only the success rate of the last hundred episodes is not kept.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.demos import Demos, load_demos
from ballbot_train.learners.model_free import Imitation, OwnRandomness, TrainingEnv, as_policy
from ballbot_train.policy import PolicyNetwork


@dataclass(frozen=True)
class SacConfig:
    """Settings of `Sac`."""

    iterations: int = 200
    """Of 1000 env steps or so."""
    evaluations: int = 20
    envs: int = 16
    steps: int = 63
    """Control steps of each env per iteration."""
    gradient_steps: int = 4
    """After each control step of all envs."""
    episode: float = 4.0
    """s, after which episodes start anew in training."""
    fall_price: float = 200.0
    reward_scale: float = 0.1
    discount: float = 0.995
    """Per control step."""
    hidden: tuple[int, ...] = (128, 128)
    """Of actor and of critics."""
    critics: int = 2
    learning_rate: float = 5e-4
    """At the start; falls linearly to `final_rate` of it."""
    final_rate: float = 0.1
    batch: int = 256
    follow: float = 0.005
    """Share by which the target critics move to the critics at each gradient step."""
    entropy: float = -5.0
    """Of the actions that the actor keeps, nats."""
    temperature: float = 0.01
    """Price of entropy at the start, in scaled rewards."""
    deviation: float = 0.5
    """Standard deviation of the actions at the start, before they are squashed."""
    demo_deviation: float = 0.05
    """In place of `deviation` where there are demonstrations."""
    clone_iterations: int = 15
    """Iterations of behaviour cloning before SAC's, of `clone_steps` gradient steps each."""
    clone_steps: int = 300
    clone_batch: int = 1024
    clone_rate: float = 2e-3
    """Learning rate at the start, falling linearly to 0."""
    critic_iterations: int = 10
    """How many of SAC's iterations teach the critics alone."""
    imitation: float = 300.0
    """Weight of the imitation loss, the mean squared difference of the actions, at the start of SAC."""


TUNED: dict[str, SacConfig] = {
    "stabilize": SacConfig(),
    "turn": SacConfig(episode=8.0),
    "orbit": SacConfig(),
    "weave": SacConfig(episode=8.0),
}
"""By task."""


class SymmetricReplay(ReplayBuffer):
    """A replay buffer half of whose samples are demonstrations, if there are any."""

    def __init__(self, *args: Any, demos: Demos | None, reward_scale: float, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._demos: tuple[torch.Tensor, ...] | None = None
        if demos is not None:
            columns = (
                demos.observations,
                demos.executed,
                demos.next_observations,
                demos.terminations[:, None],
                reward_scale * demos.rewards[:, None],
            )
            self._demos = tuple(torch.as_tensor(np.asarray(column, np.float32)) for column in columns)

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        if self._demos is None:
            return super().sample(batch_size, env)
        own = super().sample(batch_size // 2, env)
        chosen = torch.randint(len(self._demos[0]), (batch_size - batch_size // 2,))
        return ReplayBufferSamples(*(torch.cat([a, b[chosen]]) for a, b in zip(own[:5], self._demos, strict=True)))

    def state_dict(self) -> dict[str, Any]:
        """What is filled of it, the demonstrations excepted."""
        filled = self.buffer_size if self.full else self.pos
        return {"pos": self.pos, "full": self.full} | {
            name: torch.from_numpy(getattr(self, name)[:filled].copy()) for name in _COLUMNS
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""
        self.pos, self.full = state["pos"], state["full"]
        for name in _COLUMNS:
            getattr(self, name)[: len(state[name])] = state[name].numpy()


_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Sac:
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: SacConfig, seed: int = 0, demos: Demos | None = None):
        """Args: demos: `Demos` to learn from too, or None."""
        self.config, self.iteration, self._task = config, 0, task
        self._clone_iterations = 0 if demos is None else config.clone_iterations
        self._critic_iterations = 0 if demos is None else config.critic_iterations
        self.iterations, self.evaluations = config.iterations + self._clone_iterations, config.evaluations
        self._env = TrainingEnv(task, params, config.envs, config.episode, config.fall_price, config.reward_scale)
        self._model = SAC(
            "MlpPolicy",
            self._env,
            learning_rate=lambda _: self._learning_rate(),
            buffer_size=config.iterations * config.steps * config.envs,
            learning_starts=0,
            batch_size=config.batch,
            tau=config.follow,
            gamma=config.discount,
            gradient_steps=config.gradient_steps,
            replay_buffer_class=SymmetricReplay,
            replay_buffer_kwargs={"demos": demos, "reward_scale": config.reward_scale},
            ent_coef=f"auto_{config.temperature}",
            target_entropy=config.entropy,
            policy_kwargs={
                "net_arch": list(config.hidden),
                "n_critics": config.critics,
                "activation_fn": torch.nn.SiLU,
            },
            seed=seed,
            device="cpu",
        )
        self._model.set_logger(Logger(folder=None, output_formats=[]))
        self._model._last_obs = self._env.reset()
        actor = self._model.actor
        torch.nn.init.zeros_(actor.log_std.weight)
        torch.nn.init.constant_(
            actor.log_std.bias, math.log(config.deviation if demos is None else config.demo_deviation)
        )
        self._mean = torch.nn.Sequential(*actor.latent_pi, actor.mu, torch.nn.Tanh())
        self._imitation = None if demos is None else Imitation(self._mean, demos, config.clone_batch)
        actor.optimizer.register_step_pre_hook(self._add_imitation)
        self._random = OwnRandomness()

    @property
    def network(self) -> PolicyNetwork:
        return as_policy(self._mean, self._task, activation="silu", squash="tanh")

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
            "temperature": model.log_ent_coef.detach(),
            "optimizers": [optimizer.state_dict() for optimizer in self._optimizers],
            "imitation": self._imitation and self._imitation.state_dict(),
            "replay": model.replay_buffer.state_dict(),
            "env_steps": model.num_timesteps,
            "env": self._env.state_dict(),
            "observations": torch.as_tensor(model._last_obs),
            "random": self._random.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        model = self._model
        self.iteration = state["iteration"]
        model.policy.load_state_dict(state["policy"])
        model.log_ent_coef.data.copy_(state["temperature"])
        for optimizer, old in zip(self._optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(old)
        if self._imitation is not None:
            self._imitation.load_state_dict(state["imitation"])
        model.replay_buffer.load_state_dict(state["replay"])
        model.num_timesteps = state["env_steps"]
        self._env.load_state_dict(state["env"])
        model._last_obs = state["observations"].numpy()
        self._random.load_state_dict(state["random"])

    @property
    def _optimizers(self) -> tuple[torch.optim.Optimizer, ...]:
        return self._model.actor.optimizer, self._model.critic.optimizer, self._model.ent_coef_optimizer

    @property
    def _progress(self) -> float:
        """Share of SAC's iterations done."""
        return (self.iteration - self._clone_iterations) / self.config.iterations

    @property
    def _critic_only(self) -> bool:
        return self.iteration < self._clone_iterations + self._critic_iterations

    def _learning_rate(self) -> float:
        return self.config.learning_rate * (1 - (1 - self.config.final_rate) * self._progress)

    def _clone(self) -> dict[str, float]:
        """One iteration of behaviour cloning."""
        rate = self.config.clone_rate * (1 - self.iteration / self._clone_iterations)
        return self._imitation.clone(self.config.clone_steps, rate)

    def _improve(self) -> dict[str, float]:
        """One iteration of SAC."""
        config, model = self.config, self._model
        model.actor.requires_grad_(not self._critic_only)
        model.learn(config.envs * config.steps, log_interval=None, reset_num_timesteps=False)
        model.actor.requires_grad_(True)
        return {**model.logger.name_to_value, "train/env_steps": model.num_timesteps}

    def _add_imitation(self, *_: object) -> None:
        """Adds the imitation loss's gradient to that of a step of the actor."""
        weight = self.config.imitation * (1 - self._progress)
        if self._imitation is not None and not self._critic_only:
            (weight * self._imitation.loss()).backward()


def make(task: Task, params: BallbotParams, config: SacConfig, seed: int, demos: Path | None) -> Sac:
    """The learner at its beginning."""
    return Sac(task, params, config, seed, None if demos is None else load_demos(demos, task))
