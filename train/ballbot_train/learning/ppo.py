"""Proximal policy optimization by Stable-Baselines3, from scratch or from demonstrations.

`ModelFree` says what demonstrations do. Adding an imitation loss whose weight falls follows Rajeswaran et al., "Learning
complex dexterous manipulation with deep reinforcement learning and demonstrations", 2018.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import Schedule

from ballbot_gym.robot import Robot, registered_name
from ballbot_gym.tasks import Task
from ballbot_train.learning.actors import spec_for, started
from ballbot_train.learning.critics import QuadraticCritic, cost_to_go
from ballbot_train.learning.datasets import load_demos
from ballbot_train.learning.model_free import ModelFree, ModelFreeConfig
from ballbot_train.learning.settings import number
from ballbot_train.policy.files import PolicySpec
from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class PpoConfig(ModelFreeConfig):
    """Settings of the learner."""

    gae_lambda: float = number(0.98, 0, 1)
    """λ of the advantages."""
    relative_advantages: bool = True
    """Divide advantages by the cost to go, as regret is."""
    relative_values: bool = True
    """Divide the critic's errors by it too."""
    final_std: float = number(0.03, above=0)
    """Deviation at the end; it falls geometrically."""
    backwards: bool = False
    """Learn from the goal backwards; see `curricula`."""
    imitation_weight: float = number(0.1, 0)
    """Of the expert's likelihood after cloning; falls to 0."""


TUNED: dict[str, PpoConfig] = {
    "": PpoConfig(),
    "stabilize": PpoConfig(
        iterations=560,
        evaluations=28,
        num_envs=2048,
        num_steps=24,
        episode_seconds=4.0,
        short_episodes=(0.85, 0.6),
        gamma=0.995,
        final_gamma=0.999,
        gae_lambda=0.9,
        relative_advantages=False,
        relative_values=False,
        symmetry="odd",
        final_std=0.05,
    ),
    "orbit": PpoConfig(
        iterations=600,
        evaluations=40,
        episode_seconds=4.0,
        short_episodes=(0.3, 0.6),
        relative_values=False,
        symmetry="centred",
    ),
    "weave": PpoConfig(
        final_gamma=0.994,
        short_episodes=(0.3, 0.6),
        symmetry="centred",
        final_learning_rate_fraction=0.02,
    ),
    "turn": PpoConfig(
        iterations=700,
        evaluations=56,
        num_envs=1024,
        num_steps=48,
        gamma=0.998,
        final_gamma=0.9995,
        gae_lambda=0.97,
        relative_advantages=False,
        relative_values=False,
        hidden=(128, 128),
        symmetry="fine_frame",
        learning_rate=1.5e-3,
        final_learning_rate_fraction=0.01,
        std=0.15,
        final_std=0.012,
        backwards=True,
    ),
}
"""From scratch by name of task; "" is any other.

Rollouts of two seconds and a λ that looks as far ahead are the rule. What comes of a small error of position shows after a
second, and the critic alone does not tell: with 24 steps and 0.95 Weave's robot never came to rest.
"""

_WARM = PpoConfig(
    iterations=100,
    evaluations=40,
    relative_advantages=False,
    relative_values=False,
    gamma=0.995,
    final_gamma=0.998,
    learning_rate=1e-4,
    final_learning_rate_fraction=0.02,
    std=0.03,
    final_std=0.01,
)

WARM: dict[str, PpoConfig] = {
    "": _WARM,
    "stabilize": replace(_WARM, episode_seconds=4.0, hidden=(128, 128), symmetry="odd"),
    "orbit": replace(
        _WARM, episode_seconds=4.0, symmetry="frame", relative_advantages=True, gamma=0.99, short_episodes=(0.5, 0.6)
    ),
    "weave": replace(_WARM, hidden=(256, 256), symmetry="frame", std=0.02),
    "turn": replace(_WARM, hidden=(256, 256), symmetry="frame", gamma=0.998, learning_rate=3e-5),
}
"""The same with demonstrations, or from a policy; "" is any other task. Small steps and little noise keep what is there."""

UPDATE_EPOCHS = 5  # passes over the rollouts of an iteration
CLIP_RANGE = 0.2  # to which the ratio of new and old probability is clipped, about 1
MAX_GRAD_NORM = 1.0
_WARM_CRITIC_RATE = 1e-3  # learning rate of the critic throughout after a warm start, where the actor's is small


_LARGEST_ADVANTAGE = 10.0  # to which others are clipped; in multiples of what 99 % of an iteration's stay below


class _Rollouts(RolloutBuffer):
    """A rollout buffer of clipped advantages, which may be relative to the cost to go.

    A failure costs thirty times what an episode of Stabilize does. When nearly all episodes succeed, one that fails has
    advantages far beyond all others. They would decide the gradient of their batch, and spoil the critic for dozens of
    iterations. A lower limit teaches too little of failures: at 3 Weave's policy touched obstacles twice as often as at 10.
    """

    def __init__(self, *args: Any, living: Callable[[float], float] | None = None, **kwargs: Any):
        """Args:
        living: from a discount factor to the value of living indefinitely without cost, where advantages are relative to the
            cost to go; None where they are not. The other arguments are SB3's.
        """
        self._living = living
        super().__init__(*args, **kwargs)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        super().compute_returns_and_advantage(last_values, dones)
        limit = _LARGEST_ADVANTAGE * np.quantile(np.abs(self.advantages), 0.99)
        self.advantages = np.clip(self.advantages, -limit, limit)
        self.returns = self.values + self.advantages
        if self._living is not None:
            relative = self.advantages / cost_to_go(torch.as_tensor(self.values), self._living(self.gamma)).numpy()
            self.advantages = (relative - relative.mean()) / (relative.std() + 1e-8)


_WIDE = 100.0
"""Bound of actions in a frame. SB3 needs one; in the world they are clipped to ±1."""


def _acts_in_frame(spec: PolicySpec) -> bool:
    """Whether the envs can show the features of the frame once, in place of the actor computing them in every epoch."""
    frame = spec.seen_in
    return frame is not None and frame.route is None and spec.squash == "clip" and not spec.history


def _mean(network: PolicyNetwork, seen: torch.Tensor) -> torch.Tensor:
    """The mean of the actions: before the policy's output is clipped, so that the gradient does not end there."""
    if _acts_in_frame(network.spec):
        return network.in_frame(seen)
    return network(seen) if network.spec.squash == "tanh" else network.raw(seen)


class _Branches(MlpExtractor):
    """Actor and critic as SB3's networks, whose outputs are mean actions and values."""

    latent_dim_pi, latent_dim_vf = 2, 1

    def __init__(self, spec: PolicySpec):
        """Args: spec: of the actor; the critic sees the present in its frame."""
        torch.nn.Module.__init__(self)
        self.actor = PolicyNetwork(spec)
        seen, past = self.actor.present, spec.seen - spec.observations
        shown = {} if _acts_in_frame(spec) else {"shown": self.actor.shown}
        self.critic = QuadraticCritic(seen, spec.hidden, torch.nn.Tanh, past, **shown)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return _mean(self.actor, features)

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        return self.critic(features)


class _BranchedPolicy(ActorCriticPolicy):
    """SB3's policy around an actor that respects a symmetry and a critic that sees products."""

    def __init__(self, *args: Any, spec: PolicySpec, **kwargs: Any):
        """Args: spec: of the actor."""
        self._spec = spec
        super().__init__(*args, **kwargs)

    @property
    def branches(self) -> _Branches:
        return cast(_Branches, self.mlp_extractor)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _Branches(self._spec)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)  # initializes all layers as if they were inner ones; the branches hold the last too
        self.action_net = self.value_net = cast(torch.nn.Linear, torch.nn.Identity())
        actor, critic = self.branches.actor, self.branches.critic
        with torch.no_grad():  # so that the first policy does next to nothing
            cast(torch.nn.Linear, actor.mlp[-1]).weight.mul_(0.01)
        critic.start_flat()
        groups: Any = [{"params": list(part.parameters())} for part in (actor, critic)]
        self.optimizer = self.optimizer_class(groups, **{"lr": lr_schedule(1), **self.optimizer_kwargs})


def _keep_critic_rate(optimizer: torch.optim.Optimizer, *_: object) -> None:
    optimizer.param_groups[1]["lr"] = _WARM_CRITIC_RATE  # SB3 gives one to all groups


class _Ppo(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(
        self,
        task: Task,
        params: Robot,
        config: PpoConfig,
        seed: int = 0,
        demos: str | Path | None = None,
        start: PolicyNetwork | None = None,
        **world: Any,
    ):
        """See `Algorithm.make`. A policy to start from decides the shape of the actor."""
        warm = demos is not None or start is not None
        if warm and config.backwards:
            raise ValueError("--backwards works only from scratch; give --no-backwards with --demos or --start")
        if config.backwards and config.relative_advantages:
            raise ValueError(
                "--backwards shapes rewards, so that returns are not the cost to go: give --no-relative-advantages too"
            )
        spec = spec_for(
            task, config.symmetry, config.hidden, history=world.get("history", 0), robot=registered_name(params)
        )
        if start is not None:
            start = started(start, spec)
            spec = start.spec
        given = None if demos is None else load_demos(demos, task, spec.robot)
        frame = spec.seen_in if _acts_in_frame(spec) else None
        if given is not None and frame is not None:
            given = given.in_frame(frame, 1.0)
        super().__init__(task, params, config, given, warm, frame, 1.0, backwards=config.backwards, **world)
        if frame is not None:
            self._env.action_space = gymnasium.spaces.Box(-_WIDE, _WIDE, (spec.actions,), np.float32)
        self.config = config
        model = PPO(
            _BranchedPolicy,
            self._env,
            learning_rate=lambda _: self._learning_rate,
            n_steps=config.num_steps,
            batch_size=config.batch_size,
            n_epochs=UPDATE_EPOCHS,
            gamma=self._gamma,
            gae_lambda=config.gae_lambda,
            clip_range=CLIP_RANGE,
            max_grad_norm=MAX_GRAD_NORM,
            policy_kwargs={"spec": spec},
            rollout_buffer_class=_Rollouts,
            rollout_buffer_kwargs={"living": self._value_of_living if config.relative_advantages else None},
            seed=seed,
            device="cpu",
        )
        policy = cast(_BranchedPolicy, model.policy)
        self._log_std = cast(torch.nn.Parameter, policy.log_std)
        self._log_std.requires_grad_(False)
        if config.relative_values:  # the critic's last layer, which the policy has as an identity
            policy.value_net.register_forward_hook(self._weigh)
        if warm:
            policy.optimizer.register_step_pre_hook(_keep_critic_rate)
        self._env.bootstrap = self._last_values
        actor, critic = policy.branches.actor, policy.branches.critic
        self._set_model(model, actor, start, (policy.optimizer,), model.rollout_buffer, [critic.linear.bias])

    def _act(self, seen: torch.Tensor) -> torch.Tensor:
        return _mean(self._actor, seen)

    def _last_values(self, observations: np.ndarray) -> np.ndarray:
        """Discounted values (n,) of the last observations (n, no) of episodes that ran out of time."""
        with torch.no_grad():
            values = self._model.policy.predict_values(torch.as_tensor(observations))
        return self._model.gamma * values.squeeze(-1).numpy()

    def _improve(self) -> dict[str, float]:
        first, last = self.config.std, self.config.final_std
        std = first * (last / first) ** self._progress
        self._log_std.data.fill_(np.log(std))
        # by so much the gradient of the expert's likelihood is greater than that of the squared difference
        self._imitation_weight = self.config.imitation_weight * float(self._log_std.exp()[0]) ** -2
        return super()._improve()


make = _Ppo
