"""Soft actor-critic by Stable-Baselines3, from scratch or from demonstrations.

With demonstrations, half of every batch is drawn from them and half from the actor's own steps (Ball et al., "Efficient
online reinforcement learning with offline data", 2023). `ModelFree` says what else demonstrations do.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, ReplayBufferSamples
from stable_baselines3.sac.policies import Actor, SACPolicy

from ballbot_gym.robot import Robot, registered_name
from ballbot_gym.tasks import Task
from ballbot_train.learning.actors import spec_for, started
from ballbot_train.learning.critics import QuadraticCritic
from ballbot_train.learning.curricula import FAILURE_PRICE
from ballbot_train.learning.datasets import Demos, load_demos
from ballbot_train.learning.model_free import ModelFree, ModelFreeConfig
from ballbot_train.learning.settings import MOST, number
from ballbot_train.learning.state import load_state, state_of
from ballbot_train.policy.files import Mirrors
from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class SacConfig(ModelFreeConfig):
    """Settings of the learner."""

    symmetry: Literal["none", "mirrors", "frame", "fine_frame", "centred"] = "none"
    """What actor and critics keep of the task's symmetry."""
    products: bool = False
    """Critics see products of all pairs of inputs."""
    gradient_steps: int = number(16, 1, MOST)
    """Gradient steps per control step of all envs."""
    n_steps: int = number(8, 1, MOST)
    """Steps that a target looks ahead."""
    buffer_size: int = number(64_000, 1, 10**8)
    """Own env steps that are kept."""
    target_entropy: float = number(-4.0)
    """Entropy that the coefficient is tuned to, nats."""


_SCRATCH = SacConfig(
    iterations=300,
    num_envs=128,
    num_steps=25,
    episode_seconds=4.0,
    gamma=0.98,
    final_gamma=0.992,
    hidden=(128, 128),
    learning_rate=1e-3,
    final_learning_rate_fraction=0.03,
    batch_size=512,
    std=0.3,
)

# With so many envs the samples of the buffer are at most ten iterations old.
_LONG = replace(_SCRATCH, iterations=700, evaluations=35, num_envs=512, num_steps=12, symmetry="centred")

TUNED: dict[str, SacConfig] = {
    "": _SCRATCH,
    "stabilize": replace(_SCRATCH, evaluations=30, short_episodes=(0.3, 0.6), symmetry="mirrors", products=True),
    "orbit": replace(_LONG, short_episodes=(0.3, 1.0), gamma=0.985, final_gamma=0.993),
    "turn": replace(_SCRATCH, episode_seconds=8.0, symmetry="frame"),
    "weave": replace(
        _LONG,
        episode_seconds=8.0,
        short_episodes=(0.3, 0.6),
        gamma=0.99,
        final_gamma=0.995,
        products=True,
        gradient_steps=8,
        target_entropy=-5.0,
    ),
}
"""From scratch by name of task; "" is any other.

Targets look 0.4 s ahead, in steps that the present policy took. With one step of 0.02 s the critics' errors are larger than
what an action changes, and SAC forgot what it had learned.
"""

_WARM = replace(
    _SCRATCH,
    iterations=60,
    evaluations=40,
    num_envs=64,
    gamma=0.995,
    final_gamma=0.995,
    learning_rate=3e-4,
    final_learning_rate_fraction=0.1,
    std=0.05,
    gradient_steps=8,
    n_steps=1,
    buffer_size=1_000_000,
    target_entropy=-5.0,
)

WARM: dict[str, SacConfig] = {
    "": _WARM,
    "stabilize": replace(_WARM, symmetry="mirrors"),
    "orbit": replace(_WARM, gamma=0.99, final_gamma=0.99, hidden=(64, 64), symmetry="frame"),
    "weave": replace(_WARM, episode_seconds=8.0, hidden=(256, 256), symmetry="frame"),
    "turn": replace(
        _WARM,
        episode_seconds=8.0,
        gamma=0.998,
        final_gamma=0.998,
        hidden=(256, 256),
        symmetry="frame",
        learning_rate=1e-4,
    ),
}
"""The same with demonstrations, or from a policy; "" is any other task. Demonstrations are single steps of the task."""

_CONTROL_DT = 0.05  # s, how long each force is held from scratch: an action changes more, so critics tell actions apart
TAU = 0.005  # share by which the target critics move to the critics at each gradient step
ENT_COEF = 0.01  # entropy coefficient at the start, in scaled rewards per nat
_IMITATION_WEIGHT = 300.0


class _SymmetricReplay(NStepReplayBuffer):
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


class _OwnActor(Actor):
    """SB3's actor as a policy network, whose mean actions may be centred."""

    def __init__(self, *args: Any, network: PolicyNetwork, **kwargs: Any):
        """Args: network: it gets SB3's layers instead of its own; the others are SB3's."""
        super().__init__(*args, **kwargs)
        network.mlp = torch.nn.Sequential(*self.latent_pi, self.mu)
        self.network = network

    def get_action_dist_params(self, obs: PyTorchObs) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        output, log_std, more = super().get_action_dist_params(obs)
        return self.network.centred(output, cast(torch.Tensor, obs).unbind(-1)), log_std, more


class _OwnPolicy(SACPolicy):
    """SB3's policy with a policy network as its actor, and critics of another network."""

    def __init__(self, *args: Any, actor: Callable[..., Actor], products: bool, layer_norm: bool, **kwargs: Any):
        """Args:
        actor: makes one as SB3's `Actor` is made.
        products: whether critics see products.
        layer_norm: whether the layers of others are normalized.
        """
        self._actor, self._products, self._layer_norm = actor, products, layer_norm
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return self._actor(**kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        critic = super().make_critic(features_extractor)
        inputs, hidden = (
            critic.features_extractor.features_dim + sum(self.action_space.shape or ()),
            cast(list[int], self.net_arch),
        )
        critic.q_networks = [self._critic(inputs, hidden) for _ in critic.q_networks]
        for index, network in enumerate(critic.q_networks):
            critic.add_module(f"qf{index}", network)
        return critic.to(self.device)

    def _critic(self, inputs: int, hidden: list[int]) -> torch.nn.Module:
        if self._products:
            return QuadraticCritic(inputs, hidden, self.activation_fn)
        after: Any = [torch.nn.LayerNorm] if self._layer_norm else None
        return torch.nn.Sequential(*create_mlp(inputs, 1, hidden, self.activation_fn, post_linear_modules=after))


def _last_bias(critic: torch.nn.Module) -> torch.Tensor:
    """The bias of a critic's output."""
    last = critic.linear if isinstance(critic, QuadraticCritic) else cast(torch.nn.Sequential, critic)[-1]
    return cast(torch.nn.Linear, last).bias


class _Sac(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(
        self,
        task: Task,
        params: Robot,
        config: SacConfig,
        seed: int = 0,
        demos: str | Path | None = None,
        start: PolicyNetwork | None = None,
    ):
        """See `Algorithm.make`. Demonstrations are stored along with its own steps, and a policy must be one of SAC's."""
        if demos is not None and config.n_steps > 1:
            raise ValueError("n_steps must be 1 with demonstrations, which are single steps")
        spec = spec_for(task, config.symmetry, config.hidden, robot=registered_name(params))
        frame = spec.seen_in
        spec = replace(spec, activation="silu", squash="tanh" if frame is None else "tanh_in_frame")
        start = None if start is None else started(start, spec)
        if start is not None and start.spec != spec:
            raise ValueError(f"a policy of {start.spec} cannot start one of {spec}; give --hidden or --symmetry")
        given = None if demos is None else load_demos(demos, task, spec.robot)
        if given is not None and task.first_exit:
            given = given.without_pay(task, FAILURE_PRICE)
        if given is not None and frame is not None:
            given = given.in_frame(frame)
        warm = demos is not None or start is not None
        super().__init__(task, params, config, given, warm, frame, control_dt=None if warm else _CONTROL_DT)
        self.config, self._imitation_weight = config, _IMITATION_WEIGHT
        network = PolicyNetwork(spec)
        model = SAC(
            _OwnPolicy,
            self._env,
            learning_rate=lambda _: self._learning_rate,
            buffer_size=config.buffer_size,
            learning_starts=0,
            batch_size=config.batch_size,
            tau=TAU,
            gamma=self._gamma,
            gradient_steps=config.gradient_steps,
            replay_buffer_class=_SymmetricReplay,
            replay_buffer_kwargs={
                "demos": given,
                "reward_scale": self._reward_scale,
                "mirrors": spec.mirrors,
                "n_steps": config.n_steps,
                "gamma": self._gamma,
            },
            ent_coef=f"auto_{ENT_COEF}",
            target_entropy=config.target_entropy,
            policy_kwargs={
                "net_arch": list(config.hidden),
                "activation_fn": torch.nn.SiLU,
                "actor": partial(_OwnActor, network=network),
                "products": config.products,
                "layer_norm": warm,
            },
            seed=seed,
            device="cpu",
        )
        # with an entropy coefficient that is tuned, SB3 makes both
        self._log_ent_coef = cast(torch.Tensor, model.log_ent_coef)
        self._replay = cast(_SymmetricReplay, model.replay_buffer)
        actor, log_std = model.actor, cast(torch.nn.Linear, model.actor.log_std)
        torch.nn.init.zeros_(log_std.weight)
        torch.nn.init.constant_(log_std.bias, math.log(config.std))
        # Critics overestimate, more and more, because they learn from their own estimates. Costs are not negative, so there
        # is a limit, and values drift no farther.
        model.critic_target.register_forward_hook(
            lambda _module, _inputs, values: tuple(value.clamp(max=self._highest()) for value in values)
        )
        if not warm:
            model.critic.register_forward_hook(self._weigh)
        self._set_model(
            model,
            network,
            start,
            (actor.optimizer, model.critic.optimizer, cast(torch.optim.Optimizer, model.ent_coef_optimizer)),
            self._replay,
            [_last_bias(critic) for critic in (*model.critic.q_networks, *model.critic_target.q_networks)],
        )

    def _act(self, seen: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self._actor.centred(self._actor.mlp(seen), seen.unbind(-1)))

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"log_ent_coef": self._log_ent_coef.detach()} | state_of(self, ["_replay"])

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._log_ent_coef.data.copy_(state["log_ent_coef"])
        load_state(self, ["_replay"], state)

    @property
    def _value_without_costs(self) -> float:
        # SAC's values also count the entropies of all later steps. They are negative here, and small, but near the goal they
        # are larger than the costs to go: if they were taken for costs, the critics' errors there would count for little.
        later = self._model.gamma / (1 - self._model.gamma)
        return super()._value_without_costs + later * self._log_ent_coef.exp().item() * self.config.target_entropy

    def _highest(self) -> float:
        """The most that a value can be, because costs are not negative.

        Where an episode ends at its goal, the time that is left is paid at once, without a discount.
        """
        living = self._value_of_living(self._model.gamma)
        return max(living, self._value_of_living(1.0)) if self._trained.first_exit else living


make = _Sac
