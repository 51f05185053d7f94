"""Soft actor-critic by Stable-Baselines3, from scratch or from demonstrations.

With demonstrations, half of every batch is drawn from them and half from the actor's own steps (Ball et al., "Efficient
online reinforcement learning with offline data", 2023). `ModelFree` says what else demonstrations do.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, ReplayBufferSamples
from stable_baselines3.sac.policies import Actor, SACPolicy

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.symmetry import FRAMES, Frame
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.critics import CriticInputs, QuadraticCritic, highest_value
from ballbot_train.learning.curricula import Curriculum
from ballbot_train.learning.demonstrations import Demos, load_demos
from ballbot_train.learning.frames import demos_in_frame
from ballbot_train.learning.learners.model_free import ModelFree, ModelFreeConfig, as_policy
from ballbot_train.policy import PolicyNetwork, centred
from ballbot_train.policy_files import Mirrors


@dataclass(frozen=True)
class SacConfig(ModelFreeConfig):
    """Settings of `Sac`."""

    products: bool = False
    """Whether the critics have a linear path, and see the products of all pairs of observed quantities and actions; with
    demonstrations they do not. With targets of one step of 0.02 s, as those have, nothing was learnt with them."""
    rl_iterations: int = 200
    num_envs: int = 16
    num_steps: int = 63
    clone_iterations: int = 15
    imitation_weight: float = 300.0
    gradient_steps: int = 4
    """Gradient steps after each control step of all envs."""
    symmetry: Literal["none", "mirrors", "frame", "fine_frame", "centred"] = "none"
    """Whether actor and critics learn from the task's mirror images as well, over which the policy is averaged; or see the
    task's frame, or its fine frame, and act in it; with an actor that is exact in the steady motion of the end (centred)."""
    n_steps: int = 1
    """Control steps whose rewards a target of the critics adds up before it takes a value; with demonstrations one alone."""
    buffer_steps: int = 0
    """Env steps of its own that it keeps to learn from; 0, or with demonstrations: all. With the last ones alone, `n_steps`
    may be larger, because they are of nearly the same policy."""
    layer_norm: bool = False
    """Whether the critics' hidden layers are normalized, as Ball et al. do, unless they see products."""
    num_critics: int = 2
    """Critics, whose smallest value counts."""
    learning_rate: float = 5e-4
    """Learning rate at the start."""
    final_learning_rate_fraction: float = 0.1
    """Learning rate at the end, as a fraction of that at the start. It falls as `learning_rate_schedule` says."""
    batch_size: int = 256
    """Env steps per gradient step."""
    tau: float = 0.005
    """Share by which the target critics move to the critics at each gradient step."""
    target_entropy: float = -5.0
    """Entropy of the actions to which the entropy coefficient is tuned, nats."""
    ent_coef: float = 0.01
    """Entropy coefficient at the start, in scaled rewards per nat."""
    std: float = 0.5
    """Standard deviation of the actions at the start, before tanh."""
    demo_std: float = 0.05
    """In place of `std` if there are demonstrations."""


_FAR = SacConfig(
    control_dt=0.05,
    n_steps=8,
    gradient_steps=16,
    batch_size=512,
    learning_rate=1e-3,
    final_learning_rate_fraction=0.03,
    relative_values=1.0,
    std=0.3,
    target_entropy=-4.0,
    averaged_iterations=10,
)
# Targets that look 0.4 s ahead, in steps that the present policy took. With one step of 0.02 s the critics' errors are larger
# than what an action changes, and SAC forgot what it had learnt.

TUNED: dict[str, SacConfig] = {
    "stabilize": replace(
        _FAR,
        symmetry="mirrors",
        rl_iterations=300,
        num_envs=128,
        num_steps=25,
        buffer_steps=64_000,
        gamma=0.98,
        final_gamma=0.992,
        products=True,
        evaluations=30,
        curriculum=Curriculum(short_episodes=0.3),
    ),
    "orbit": replace(
        _FAR,
        symmetry="centred",
        rl_iterations=700,
        num_envs=512,
        num_steps=12,
        buffer_steps=64_000,
        gamma=0.985,
        final_gamma=0.993,
        evaluations=35,
        curriculum=Curriculum(short_episodes=0.3, short_seconds=1.0),
    ),
    "turn": SacConfig(episode_seconds=8.0, symmetry="frame"),
    "weave": SacConfig(episode_seconds=8.0, symmetry="frame"),
}
"""Settings by name of task; every other task takes the defaults."""


class SymmetricReplay(NStepReplayBuffer):
    """A replay buffer that draws half of its samples from demonstrations, if there are any, and shows mirror images."""

    def __init__(self, *args: Any, demos: Demos | None, reward_scale: float, mirrors: Mirrors = (), **kwargs: Any):
        """Args: mirrors: signs of observation and action in each; each sample is as it was, or one of its mirror images."""
        super().__init__(*args, **kwargs)
        # of observations and actions: (images, entries), the first image being the step as it was
        self._signs = [torch.tensor([[1] * len(part[0]), *part]) for part in zip(*mirrors, strict=True)]
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
            samples = super().sample(batch_size, env)
        else:
            own = super().sample(batch_size // 2, env)
            chosen = torch.randint(len(self._demos[0]), (batch_size - batch_size // 2,))
            both = zip(own[:5], self._demos, strict=True)
            samples = ReplayBufferSamples(*(torch.cat([a, b[chosen]]) for a, b in both))
        if not self._signs:
            return samples
        image = torch.randint(len(self._signs[0]), (batch_size,))
        seen, acted = (signs[image] for signs in self._signs)
        return samples._replace(
            observations=seen * samples.observations,
            actions=acted * samples.actions,
            next_observations=seen * samples.next_observations,
        )

    def state_dict(self) -> dict[str, Any]:
        """The steps in the buffer, without the demonstrations."""
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


class Critics(ContinuousCritic):
    """SB3's critics, each with another network."""

    def __init__(
        self,
        observation_space: gymnasium.Space,
        action_space: gymnasium.spaces.Box,
        net_arch: list[int],
        *,
        features_dim: int,
        activation_fn: type[torch.nn.Module],
        network: "CriticNetwork",
        **kwargs: Any,
    ):
        """Args: network: makes one critic's network; the others are SB3's."""
        super().__init__(
            observation_space,
            action_space,
            net_arch,
            features_dim=features_dim,
            activation_fn=activation_fn,
            **kwargs,
        )
        inputs = features_dim + get_action_dim(action_space)
        self.q_networks = [network(inputs, net_arch, activation_fn) for _ in range(self.n_critics)]
        for index, critic in enumerate(self.q_networks):
            self.add_module(f"qf{index}", critic)


class CentredActor(Actor):
    """SB3's actor in a frame, whose mean action keeps the frame's steady motion exactly; see `PolicyNetwork`."""

    def __init__(self, *args: Any, frame: Frame, **kwargs: Any):
        """Args: frame: that the envs show; the others are SB3's."""
        super().__init__(*args, **kwargs)
        self._frame = frame

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        mean, log_std, more = super().get_action_dist_params(obs)
        return _centred(mean, cast(torch.Tensor, obs), self._mlp, self._frame), log_std, more

    def mean_action(self) -> "CentredMean":
        """The mean of its actions, with the same layers."""
        return CentredMean(torch.nn.Sequential(*self.latent_pi, self.mu), self._frame)

    def _mlp(self, features: torch.Tensor) -> torch.Tensor:
        return self.mu(self.latent_pi(features))


class CentredMean(torch.nn.Module):
    """The mean action of a centred actor."""

    def __init__(self, mlp: torch.nn.Module, frame: Frame):
        super().__init__()
        self.mlp, self._frame = mlp, frame

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return torch.tanh(_centred(self.mlp(features), features, self.mlp, self._frame))


def _centred(
    output: torch.Tensor, features: torch.Tensor, network: Callable[[torch.Tensor], torch.Tensor], frame: Frame
) -> torch.Tensor:
    """(n, 2) centred output of a network for features (n, size), before it is squashed."""
    assert frame.steady is not None
    return centred(
        output, features.unbind(-1), network, frame.steady, "tanh_in_frame", lambda values: torch.stack(values, -1)
    )


class OwnPolicy(SACPolicy):
    """SB3's policy with critics of another network, and an actor that may be centred."""

    def __init__(self, *args: Any, network: "CriticNetwork", centre: Frame | None, **kwargs: Any):
        """Args: network: makes one critic's network; centre: the frame of a centred actor; the others are SB3's."""
        self._network, self._centre = network, centre
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        if self._centre is None:
            return super().make_actor(features_extractor)
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return CentredActor(**kwargs, frame=self._centre).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return Critics(**kwargs, network=self._network).to(self.device)


CriticNetwork = Callable[[int, list[int], type[torch.nn.Module]], torch.nn.Module]
"""From number of inputs, units of the hidden layers and activation to a network with one output."""


def _critic_network(products: bool, layer_norm: bool, value: float) -> CriticNetwork:
    """What makes critics: they see products and expect `value` everywhere at the start, or their layers may be normalized."""

    def network(inputs: int, hidden: list[int], activation: type[torch.nn.Module]) -> torch.nn.Module:
        if products:
            return QuadraticCritic(CriticInputs(inputs), hidden, activation, value)
        after: Any = [torch.nn.LayerNorm] if layer_norm else None
        return torch.nn.Sequential(*create_mlp(inputs, 1, hidden, activation, post_linear_modules=after))

    return network


def last_bias(critic: torch.nn.Module) -> torch.Tensor:
    """The bias of a critic's output."""
    last = critic.linear if isinstance(critic, QuadraticCritic) else cast(torch.nn.Sequential, critic)[-1]
    return cast(torch.nn.Linear, last).bias


class Sac(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: SacConfig, seed: int = 0, demos: Demos | None = None):
        """Takes demonstrations to learn from as well, or None.

        Raises:
            ValueError: the task has no frame, and the settings ask for it; or they shape rewards beside demonstrations.
        """
        if demos is not None and config.curriculum.shaping:
            raise ValueError(
                "curriculum.shaping cannot be used with sac's demonstrations, because their rewards are not shaped"
            )
        if demos is not None and not config.pay:
            demos = demos.without_pay(task, config.failure_price)
        self._spec = spec_for(task, config.symmetry, config.hidden)
        frame = None if self._spec.frame is None else FRAMES[self._spec.frame]
        if demos is not None and frame is not None:
            demos = demos_in_frame(demos, frame)
        super().__init__(task, params, config, demos, frame)
        self.config = config
        products = config.products and demos is None
        rate = config.learning_rate
        value = self._value_of_living(self._gamma)
        own = products or config.layer_norm or self._spec.centred
        critic = _critic_network(products, config.layer_norm, value)
        networks = {"network": critic, "centre": frame if self._spec.centred else None}
        model = SAC(
            OwnPolicy if own else "MlpPolicy",
            self._env,
            learning_rate=lambda _: self._annealed(rate, config.final_learning_rate_fraction),
            buffer_size=(demos is None and config.buffer_steps)
            or config.rl_iterations * config.num_steps * config.num_envs,
            learning_starts=0,
            batch_size=config.batch_size,
            tau=config.tau,
            gamma=self._gamma,
            gradient_steps=config.gradient_steps,
            replay_buffer_class=SymmetricReplay,
            replay_buffer_kwargs={
                "demos": demos,
                "reward_scale": config.reward_scale,
                "mirrors": self._spec.mirrors,
                "n_steps": config.n_steps if demos is None else 1,
                "gamma": self._gamma,
            },
            ent_coef=f"auto_{config.ent_coef}",
            target_entropy=config.target_entropy,
            policy_kwargs={
                "net_arch": list(config.hidden),
                "n_critics": config.num_critics,
                "activation_fn": torch.nn.SiLU,
                **(networks if own else {}),
            },
            seed=seed,
            device="cpu",
        )
        # with an entropy coefficient that is tuned, SB3 makes both
        self._log_ent_coef = cast(torch.Tensor, model.log_ent_coef)
        self._replay = cast(SymmetricReplay, model.replay_buffer)
        actor, log_std = model.actor, cast(torch.nn.Linear, model.actor.log_std)
        torch.nn.init.zeros_(log_std.weight)
        torch.nn.init.constant_(log_std.bias, math.log(config.std if demos is None else config.demo_std))
        if not products:
            for critic in (*model.critic.q_networks, *model.critic_target.q_networks):
                torch.nn.init.constant_(last_bias(critic), value)
        if not config.curriculum.shaping:  # which adds to rewards
            # Critics overestimate, more and more, because they learn from their own estimates. Costs are not negative, so
            # there is a limit, and values drift no farther.
            model.critic_target.register_forward_hook(
                lambda _module, _inputs, values: tuple(value.clamp(max=self._highest()) for value in values)
            )
        if self._relative_values:
            model.critic.register_forward_hook(self._weigh)
        self._model: SAC
        self._set_model(
            model,
            actor.mean_action()
            if isinstance(actor, CentredActor)
            else torch.nn.Sequential(*actor.latent_pi, actor.mu, torch.nn.Tanh()),
            (actor.optimizer, model.critic.optimizer, cast(torch.optim.Optimizer, model.ent_coef_optimizer)),
        )

    @property
    def network(self) -> PolicyNetwork:
        squash = "tanh" if self._spec.frame is None else "tanh_in_frame"
        symmetry = {"frame": self._spec.frame, "centred": self._spec.centred, "mirrors": self._spec.mirrors}
        return as_policy(self._kept.modules(), self._task, activation="silu", squash=squash, **symmetry)

    def state_dict(self) -> dict[str, Any]:
        own = {"log_ent_coef": self._log_ent_coef.detach(), "replay": self._replay.state_dict()}
        return super().state_dict() | own

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._log_ent_coef.data.copy_(state["log_ent_coef"])
        self._replay.load_state_dict(state["replay"])

    def _highest(self) -> float:
        """The most that a value can be."""
        config = self.config
        return highest_value(self._trained, config.reward_scale, self._model.gamma) if config.pay else 0.0

    def _value_biases(self) -> list[torch.Tensor]:
        critics = (*self._model.critic.q_networks, *self._model.critic_target.q_networks)
        return [last_bias(critic) for critic in critics]

    def _take_gamma(self, gamma: float) -> None:
        super()._take_gamma(gamma)
        self._replay.gamma = gamma

    def _imitation_scale(self) -> float:
        return 1.0


def make(task: Task, params: BallbotParams, config: SacConfig, seed: int, demos: str | Path | None) -> Sac:
    """Makes the learner.

    Raises:
        ValueError: the demonstrations are of another task.
    """
    return Sac(task, params, config, seed, None if demos is None else load_demos(demos, task))
