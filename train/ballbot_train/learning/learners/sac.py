"""Soft actor-critic, of Stable-Baselines3, from scratch or from demonstrations.

With demonstrations half of every batch is drawn from them and half from what the actor did itself (Ball et al., Efficient
Online Reinforcement Learning with Offline Data, 2023); what else they do is `ModelFree`'s.
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
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning.demonstrations import Demos, load_demos
from ballbot_train.learning.learners.model_free import ModelFree, ModelFreeConfig, as_policy
from ballbot_train.policy import PolicyNetwork


@dataclass(frozen=True)
class SacConfig(ModelFreeConfig):
    """Settings of `Sac`."""

    iterations: int = 200
    envs: int = 16
    steps: int = 63
    clone_iterations: int = 15
    imitation: float = 300.0
    gradient_steps: int = 4
    """After each control step of all envs."""
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


class Sac(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: SacConfig, seed: int = 0, demos: Demos | None = None):
        """Args: demos: `Demos` to learn from too, or None."""
        super().__init__(task, params, config, demos)
        model = SAC(
            "MlpPolicy",
            self._env,
            learning_rate=lambda _: config.learning_rate * (1 - (1 - config.final_rate) * self._progress),
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
        actor = model.actor
        torch.nn.init.zeros_(actor.log_std.weight)
        deviation = config.deviation if demos is None else config.demo_deviation
        torch.nn.init.constant_(actor.log_std.bias, math.log(deviation))
        self._begin(
            model,
            torch.nn.Sequential(*actor.latent_pi, actor.mu, torch.nn.Tanh()),
            (actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer),
        )

    @property
    def network(self) -> PolicyNetwork:
        return as_policy(self._actor, self._task, activation="silu", squash="tanh")

    def state_dict(self) -> dict[str, Any]:
        model = self._model
        own = {"temperature": model.log_ent_coef.detach(), "replay": model.replay_buffer.state_dict()}
        return super().state_dict() | own

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._model.log_ent_coef.data.copy_(state["temperature"])
        self._model.replay_buffer.load_state_dict(state["replay"])

    def _imitation_scale(self) -> float:
        return 1.0


def make(task: Task, params: BallbotParams, config: SacConfig, seed: int, demos: Path | None) -> Sac:
    """The learner at its beginning."""
    return Sac(task, params, config, seed, None if demos is None else load_demos(demos, task))
