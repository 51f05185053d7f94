"""Proximal policy optimization by Stable-Baselines3, from scratch or from demonstrations.

`ModelFree` says what demonstrations do. Adding an imitation loss whose weight falls follows Rajeswaran et al., "Learning
complex dexterous manipulation with deep reinforcement learning and demonstrations", 2018.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import Schedule

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import Symmetry, spec_for
from ballbot_train.learning.critics import CriticInputs, QuadraticCritic, relative_advantages
from ballbot_train.learning.curricula import Curriculum
from ballbot_train.learning.demonstrations import Demos, load_demos
from ballbot_train.learning.learners.model_free import ModelFree, ModelFreeConfig, as_policy
from ballbot_train.policy import PolicyNetwork, PolicySpec


@dataclass(frozen=True)
class PpoConfig(ModelFreeConfig):
    """Settings of `Ppo`."""

    rl_iterations: int = 700
    num_envs: int = 32
    num_steps: int = 256
    critic_warmup_iterations: int = 20
    imitation_weight: float = 0.3
    """Weight of the imitation loss, the expert's negative log-likelihood, at the start; falls linearly to 0."""
    symmetry: Symmetry = "none"
    """How the actor respects the task's symmetry: opposite observations get opposite actions (odd), its output is averaged
    over the task's mirror images, or it sees and acts in the task's frame or its fine frame."""
    averaged_iterations: int = 10
    gae_lambda: float = 0.95
    """λ of generalized advantage estimation."""
    relative_advantages: float = 0.0
    """Power of the cost to go, as the critic expects it, by which an advantage is divided, as in `rsl_ppo`; 0: off."""
    learning_rate: float = 1e-3
    """Learning rate at the start."""
    demo_learning_rate: float = 1e-4
    """In place of `learning_rate` if there are demonstrations."""
    demo_critic_learning_rate: float | None = None
    """Learning rate of the critic throughout if there are demonstrations; default, the actor's, which is small."""
    final_learning_rate_fraction: float = 0.02
    """Learning rate at the end, as a fraction of that at the start. It falls as `learning_rate_schedule` says."""
    update_epochs: int = 5
    """Passes over the rollouts of an iteration."""
    batch_size: int = 512
    """Env steps per gradient step."""
    demo_batch_size: int = 2048
    """In place of `batch_size` if there are demonstrations."""
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


_BULK = PpoConfig(
    num_envs=2048,
    num_steps=24,
    batch_size=3072,
    hidden=(64, 64),
    learning_rate=2e-3,
    final_learning_rate_fraction=0.05,
    max_grad_norm=1.0,
)  # as `rsl_ppo` trains, with averages over many envs

_LONG = replace(_BULK, symmetry="centred", num_envs=512, num_steps=96, gamma=0.99, gae_lambda=0.98)
# Rollouts of two seconds and a λ that looks as far ahead. What comes of a small error of position shows after a second, and
# the critic alone does not tell: with 24 steps and 0.95 Weave's robot never came to rest.

TUNED: dict[str, PpoConfig] = {
    "stabilize": replace(
        _BULK,
        symmetry="odd",
        rl_iterations=560,
        final_gamma=0.999,
        gae_lambda=0.9,
        final_std=0.05,
        evaluations=28,
        curriculum=Curriculum(short_episodes=0.85),
    ),
    "orbit": replace(
        _LONG,
        rl_iterations=600,
        evaluations=40,
        final_gamma=0.995,
        relative_advantages=1.0,
        curriculum=Curriculum(short_episodes=0.3),
    ),
    "weave": replace(
        _LONG,
        rl_iterations=400,
        episode_seconds=8.0,
        hidden=(128, 128),
        final_learning_rate_fraction=0.02,
        final_gamma=0.994,
        relative_advantages=1.0,
        relative_values=1.0,
        curriculum=Curriculum(short_episodes=0.3),
    ),
    "turn": replace(
        _LONG,
        symmetry="fine_frame",
        rl_iterations=700,
        evaluations=56,
        num_envs=1024,
        num_steps=48,
        episode_seconds=8.0,
        hidden=(128, 128),
        learning_rate=1.5e-3,
        final_learning_rate_fraction=0.01,
        last_learning_rate=7e-4,
        gamma=0.998,
        final_gamma=0.9995,
        gae_lambda=0.97,
        std=0.15,
        final_std=0.012,
        curriculum_progress=0.2,
        reward_scale=0.05,
        pay=False,
        curriculum=Curriculum(
            goal_factor=5.0,
            ramp="max_speed",
            ramp_start=4.05,
            ramp_step=0.2,
            success=0.75,
            settled_success=0.85,
            starts_on_optima=0.5,
            optima=200,
            starts_seconds=0.1,
            starts_step=0.15,
            starts_success=0.6,
            starts_reserve=0.4,
            starts_goal_factor=1.0,
            retries=0.4,
            retries_per_failure=10.0,
            last_failure_price=60.0,
            shaping=10.0,
        ),
    ),
}
"""Settings by name of task."""


class RelativeRollouts(RolloutBuffer):
    """A rollout buffer of advantages relative to the cost to go."""

    def __init__(
        self,
        *args: Any,
        living: Callable[[float], float],
        potential: Callable[[], np.ndarray],
        power: float,
        **kwargs: Any,
    ):
        """Makes an empty one.

        Args:
            living: from a discount factor to the value of living for ever without cost.
            potential: the scaled potentials (n_envs,), by which rewards are shaped, of the states before the last step.
            power: of the cost to go.
        """
        self._living, self._potential, self._power = living, potential, power
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        super().reset()
        self.potentials = np.zeros((self.buffer_size, self.n_envs), np.float32)

    def add(self, *args: Any, **kwargs: Any) -> None:
        self.potentials[self.pos] = self._potential()
        super().add(*args, **kwargs)

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray) -> None:
        super().compute_returns_and_advantage(last_values, dones)
        returns, values = torch.as_tensor(self.returns), torch.as_tensor(self.values)
        living = self._living(self.gamma) - torch.as_tensor(self.potentials)
        self.advantages = relative_advantages(returns, values, living, self._power).numpy()


class MeanAction(torch.nn.Module):
    """A policy network before its output is clipped, which is the mean of the actions."""

    def __init__(self, network: PolicyNetwork):
        super().__init__()
        self.network = network

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.network.raw(observation)


class Branches(torch.nn.Module):
    """Actor and critic in the place of SB3's `MlpExtractor`. Their outputs are mean actions and values."""

    latent_dim_pi, latent_dim_vf = 2, 1

    def __init__(self, actor: MeanAction, critic: QuadraticCritic):
        super().__init__()
        self.actor, self.critic = actor, critic

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.actor(features), self.critic(features)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return self.actor(features)

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        return self.critic(features)


class BranchedPolicy(ActorCriticPolicy):
    """SB3's policy around an actor that respects a symmetry and a critic that sees products."""

    def __init__(self, *args: Any, spec: PolicySpec, products: bool, value: float, **kwargs: Any):
        """Args: spec: of the actor; products: whether the critic sees them; value: of every state at the start."""
        self._spec, self._products, self._value = spec, products, value
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        inputs = CriticInputs(self.features_dim, self._products, self._spec.frame)
        self.branches = Branches(
            MeanAction(PolicyNetwork(self._spec)), QuadraticCritic(inputs, self._spec.hidden, torch.nn.Tanh)
        )
        self.mlp_extractor = cast(MlpExtractor, self.branches)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # the branches hold the last layers, and SB3 has just initialized them as if they were inner ones
        self.action_net = self.value_net = cast(torch.nn.Linear, torch.nn.Identity())
        with torch.no_grad():  # so that the first policy does next to nothing
            cast(torch.nn.Linear, self.branches.actor.network.mlp[-1]).weight.mul_(0.01)
        self.branches.critic.start_at(self._value)
        rate: dict[str, Any] = {"lr": lr_schedule(1)}
        self.optimizer = self.optimizer_class(self.parameters(), **rate, **self.optimizer_kwargs)


class Ppo(ModelFree):
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: PpoConfig, seed: int = 0, demos: Demos | None = None):
        """Takes demonstrations to imitate, or None.

        Raises:
            ValueError: the task does not have the symmetry that the settings ask for.
        """
        spec = spec_for(task, config.symmetry, config.hidden)
        super().__init__(task, params, config, demos)
        self.config = config
        self._std = config.std if demos is None else config.demo_std
        rate = config.learning_rate if demos is None else config.demo_learning_rate
        value = self._value_of_living(self._gamma)
        plain = config.symmetry == "none" and not config.products
        model = PPO(
            "MlpPolicy" if plain else BranchedPolicy,
            self._env,
            learning_rate=lambda _: self._annealed(rate, config.final_learning_rate_fraction),
            n_steps=config.num_steps,
            batch_size=config.batch_size if demos is None else config.demo_batch_size,
            n_epochs=config.update_epochs,
            gamma=self._gamma,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            max_grad_norm=config.max_grad_norm,
            policy_kwargs=(
                {"net_arch": list(config.hidden)}
                if plain
                else {"spec": spec, "products": config.products, "value": value}
            ),
            rollout_buffer_class=RelativeRollouts if config.relative_advantages else None,
            rollout_buffer_kwargs=(
                {
                    "living": self._value_of_living,
                    "potential": lambda: config.reward_scale * self._env.batch.last_potential.numpy(),
                    "power": config.relative_advantages,
                }
                if config.relative_advantages
                else None
            ),
            seed=seed,
            device="cpu",
        )
        policy = cast(ActorCriticPolicy, model.policy)
        self._log_std = cast(torch.nn.Parameter, policy.log_std)
        self._log_std.requires_grad_(False)
        if isinstance(policy, BranchedPolicy):
            actor = policy.branches.actor
        else:
            actor = torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
        if self._relative_values:  # its last layer, which a `BranchedPolicy` has as an identity
            policy.value_net.register_forward_hook(self._weigh)
        if demos is not None and config.demo_critic_learning_rate is not None:
            _set_critic_rate(policy, actor, config.demo_critic_learning_rate)
        self._model: PPO
        self._set_model(model, actor, (policy.optimizer,))

    @property
    def network(self) -> PolicyNetwork:
        actor = self._kept
        if isinstance(actor, MeanAction):
            return actor.network
        return as_policy(actor.children(), self._task, activation="tanh", squash="clip")

    def _improve(self) -> dict[str, float]:
        std = schedules.geometric(self._std, self.config.final_std, self._progress)
        self._log_std.data.fill_(np.log(std))
        return super()._improve()

    def _value_biases(self) -> list[torch.Tensor]:
        policy = cast(ActorCriticPolicy, self._model.policy)
        critic = policy.branches.critic.linear if isinstance(policy, BranchedPolicy) else policy.value_net
        return [cast(torch.nn.Linear, critic).bias]

    def _take_gamma(self, gamma: float) -> None:
        super()._take_gamma(gamma)
        self._model.rollout_buffer.gamma = gamma

    def _imitation_scale(self) -> float:
        return float(self._log_std.detach().exp()[0]) ** -2


def _set_critic_rate(policy: ActorCriticPolicy, actor: torch.nn.Module, rate: float) -> None:
    """Gives a policy an optimizer in which all but the actor has a learning rate of its own."""
    of_actor = list(actor.parameters())
    ids = {id(parameter) for parameter in of_actor}
    of_critic = [parameter for parameter in policy.parameters() if id(parameter) not in ids]
    groups: Any = [{"params": of_actor, "lr": rate}, {"params": of_critic, "lr": rate}]
    policy.optimizer = policy.optimizer_class(groups, **policy.optimizer_kwargs)

    def keep_rate(optimizer: torch.optim.Optimizer, *_: object) -> None:
        optimizer.param_groups[1]["lr"] = rate  # SB3 gives one to all groups

    policy.optimizer.register_step_pre_hook(keep_rate)


def make(task: Task, params: BallbotParams, config: PpoConfig, seed: int, demos: str | Path | None) -> Ppo:
    """Makes the learner.

    Raises:
        ValueError: the demonstrations are of another task, or the task does not have the symmetry that the settings ask for.
    """
    return Ppo(task, params, config, seed, None if demos is None else load_demos(demos, task))
