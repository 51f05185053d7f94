"""Proximal policy optimization by rsl_rl on thousands of batched envs, from scratch or from a policy.

What makes the tasks learnable, besides rewards that pay for living (see `ballbot_gym.tasks.base.Task`):

- The critic sees, besides the observation, the products of all pairs of its entries, and it has a linear path. `critics`
  says why.
- The standard deviation of the actions and the step size fall on a schedule. PPO left to itself narrows the distribution
  before the hardest starts are learnt.
- The actor sees a task's symmetries: in its frame, or averaged over its mirror images.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from ballbot_gym.batch import BatchState
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import Symmetry, average_of, spec_for
from ballbot_train.learning.critics import CriticInputs, relative_advantages, start_at, value_of_living
from ballbot_train.learning.curricula import Curriculum, CurriculumBatch, without_arena
from ballbot_train.learning.learners.model_free import ScopedRng
from ballbot_train.learning.rsl import RslVecEnv
from ballbot_train.policy import PolicyNetwork

_GROUPS = {"actor": ["policy"], "critic": ["critic"]}


@dataclass(frozen=True)
class RslPpoConfig:
    """Settings of `RslPpo`."""

    total_iterations: int = 400
    """Iterations, each of `num_envs * num_steps` env steps."""
    evaluations: int = 20
    """Number of evaluations, at equal distances."""
    num_envs: int = 2048
    """Envs that are stepped together."""
    num_steps: int = 24
    """Control steps of each env per iteration."""
    episode_seconds: float = 4.0
    """Duration of an episode in training, s. Time-outs are bootstrapped, and the first episodes start at staggered times."""
    reward_scale: float = 0.02
    """Factor of every reward."""
    gamma: float = 0.99
    """Discount factor per control step at the start."""
    final_gamma: float = 0.99
    """Discount factor at the end; 1 less it goes there geometrically. A low one learns fast, but spares force at the
    start of an episode that costs more later."""
    averaged_iterations: int = 10
    """Iterations over which the policy is a running average of the actor."""
    gae_lambda: float = 0.9
    """λ of generalized advantage estimation."""
    relative_advantages: float = 0.0
    """Power of the cost to go, as the critic expects it, by which an advantage is divided. With 1 it counts as regret does;
    with 0, that is without it, the first second of an episode, which costs most, hides what the steps after it could save."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the actor's hidden layers."""
    critic_hidden: tuple[int, ...] = (64, 64)
    """Units of the critic's hidden layers."""
    products: bool = True
    """Whether the critic sees the products of all pairs of observed quantities."""
    symmetry: Symmetry = "none"
    """How the actor respects the task's symmetry: opposite observations get opposite actions (odd), its output is averaged
    over the task's mirror images, or it sees and acts in the task's frame or its fine frame."""
    learning_rate: float = 2e-3
    """Step size at the start."""
    final_learning_rate: float = 1e-4
    """Step size at the end. It falls geometrically."""
    std: float = 0.2
    """Standard deviation of the actions at the start, in units of the force limit. It is not learnt."""
    final_std: float = 0.05
    """Standard deviation at the end. It falls geometrically."""
    update_epochs: int = 5
    """Passes over the rollouts of an iteration."""
    num_mini_batches: int = 16
    """Gradient steps of a pass."""
    finetune_learning_rate: float = 3e-5
    """In place of `learning_rate` if training starts from a policy file."""
    finetune_critic_learning_rate: float | None = None
    """Step size of the critic throughout if training starts from a policy file; default, the actor's, which is small."""
    finetune_std: float = 0.03
    """In place of `std` if training starts from a policy file."""
    critic_warmup_iterations: int = 40
    """Iterations that train the critic alone if training starts from a policy file. The policy file also says the shape of
    the actor, symmetry included; `symmetry` is then that of the critic's inputs."""
    clip_range: float = 0.2
    """Range to which the ratio of new and old probability is clipped, about 1."""
    max_grad_norm: float = 1.0
    """Norm to which the gradients of actor and critic are clipped."""
    curriculum: Curriculum = Curriculum()
    """What training makes easier at first."""
    arena: bool = True
    """Whether leaving the arena fails in training. Evaluation keeps the arena."""
    pay: bool = True
    """Whether living pays in training. If not, the reward is minus the running cost. Evaluation is the same."""
    failure_price: float = 300.0
    """What a failure costs at once in training where living does not pay."""


TUNED: dict[str, RslPpoConfig] = {
    "stabilize": RslPpoConfig(
        symmetry="odd",
        total_iterations=560,
        gamma=0.995,
        final_gamma=0.999,
        curriculum=Curriculum(short_episodes=0.85),
    ),
    "orbit": RslPpoConfig(
        symmetry="frame",
        total_iterations=600,
        gae_lambda=0.95,
        relative_advantages=1.0,
        final_std=0.03,
        curriculum=Curriculum(short_episodes=0.3),
    ),
    "weave": RslPpoConfig(
        symmetry="mirrors", episode_seconds=8.0, hidden=(128, 128), critic_hidden=(128, 128), total_iterations=800
    ),
    "turn": RslPpoConfig(episode_seconds=8.0, total_iterations=800),
}
"""Settings by name of task."""


class Actor(MLPModel):
    """rsl_rl's model around a policy network, whose output is the mean of the actions."""

    def __init__(self, observations: TensorDict, network: PolicyNetwork, std: float):
        distribution = {
            "class_name": "rsl_rl.modules.distribution:GaussianDistribution",
            "init_std": std,
            "learn_std": False,
        }
        super().__init__(observations, _GROUPS, "actor", 2, (1,), distribution_cfg=distribution)
        self.network = network
        self.mlp = _Mean(network)

    def set_std(self, std: float) -> None:
        """Sets the standard deviation of both actions."""
        assert isinstance(self.distribution, GaussianDistribution)
        self.distribution.std_param.data.fill_(std)


def last_layer(network: torch.nn.Module) -> torch.nn.Linear:
    """The last linear layer of a network."""
    return [layer for layer in network.modules() if isinstance(layer, torch.nn.Linear)][-1]


class _Mean(torch.nn.Module):
    """The mean action of a policy network; before its output is clipped, so that the gradient does not end there."""

    def __init__(self, network: PolicyNetwork):
        super().__init__()
        self._network = (network,)  # in a tuple, so that its parameters are registered once

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        network = self._network[0]
        return network(observation) if network.spec.squash == "tanh" else network.raw(observation)


class Critic(MLPModel):
    """rsl_rl's model with a linear path beside the network, on the group "critic"."""

    def __init__(self, observations: TensorDict, hidden: tuple[int, ...], value: float):
        """Args: value: of every state at the start."""
        super().__init__(observations, _GROUPS, "critic", 1, hidden, activation="tanh")
        self.linear = torch.nn.Linear(observations["critic"].shape[-1], 1)
        start_at(value, self.linear, last_layer(self.mlp))

    def forward(self, obs: TensorDict, masks: Any = None, hidden_state: Any = None, **_: Any) -> torch.Tensor:
        """(B, 1) values."""
        seen = obs["critic"]
        return self.mlp(seen) + self.linear(seen)


class Storage(RolloutStorage):
    """rsl_rl's storage, with mini-batches that are slices of one shuffled copy. Gathering each one anew costs more time."""

    def mini_batch_generator(self, num_mini_batches: int, num_epochs: int = 8) -> Iterator[RolloutStorage.Batch]:
        """Yields the mini-batches of all passes; every pass has the same ones, as in rsl_rl."""
        samples = self.num_envs * self.num_transitions_per_env
        size = samples // num_mini_batches
        order = torch.randperm(samples, device=self.device)

        def shuffled(values: torch.Tensor) -> torch.Tensor:
            return values.flatten(0, 1).index_select(0, order)

        observations = {name: shuffled(cast(torch.Tensor, values)) for name, values in self.observations.items()}
        actions, values, returns = shuffled(self.actions), shuffled(self.values), shuffled(self.returns)
        log_prob, advantages = shuffled(self.actions_log_prob), shuffled(self.advantages)
        assert self.distribution_params is not None
        distribution = tuple(shuffled(parameter) for parameter in self.distribution_params)
        for _ in range(num_epochs):
            for start in range(0, size * num_mini_batches, size):
                part = slice(start, start + size)
                yield RolloutStorage.Batch(
                    observations=TensorDict({n: v[part] for n, v in observations.items()}, batch_size=[size]),
                    actions=actions[part],
                    values=values[part],
                    advantages=advantages[part],
                    returns=returns[part],
                    old_actions_log_prob=log_prob[part],
                    old_distribution_params=tuple(parameter[part] for parameter in distribution),
                )


class RslPpo:
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: RslPpoConfig, seed: int = 0):
        """Raises a ValueError where the task does not have what the settings ask for."""
        for name in ("gamma", "final_gamma"):
            if not 0 < getattr(config, name) < 1:
                raise ValueError(f"{name} must be between 0 and 1, not {getattr(config, name):g}")
        self.config, self.iteration, self._task = config, 0, task
        self.iterations, self.evaluations = config.total_iterations, config.evaluations
        torch.manual_seed(seed)
        self._random = ScopedRng()
        with self._random:
            shorter = replace(task, duration=config.episode_seconds)
            self._batch = CurriculumBatch(
                shorter if config.arena else without_arena(shorter),
                config.num_envs,
                params,
                config.curriculum,
                config.gamma,
                full=task,
                pay=config.pay,
                failure_price=config.failure_price,
            )
            spec = spec_for(task, config.symmetry, config.hidden)
            inputs = CriticInputs(len(task.observation_scale), config.products, spec.frame)
            self._env = RslVecEnv(self._batch, seed, inputs)
            self._env.episode_length_buf = torch.randint(shorter.steps, (config.num_envs,))
            self._seen = self._env.get_observations()
            network = PolicyNetwork(spec)
            with torch.no_grad():  # so that the first policy does next to nothing
                last_layer(network.mlp).weight.mul_(0.1)
            self._rate, self._std, self._warmup_iterations = config.learning_rate, config.std, 0
            self._critic_rate: float | None = None
            self._make(network)

    def start_from(self, network: PolicyNetwork) -> None:
        """Takes a policy of any shape as the actor; the critic is trained alone at first."""
        self._rate, self._std = self.config.finetune_learning_rate, self.config.finetune_std
        self._warmup_iterations = self.config.critic_warmup_iterations
        self._critic_rate = self.config.finetune_critic_learning_rate
        mine = self._actor.network.spec
        started = PolicyNetwork(replace(network.spec, task=mine.task, robot=mine.robot))
        started.load_state_dict(network.state_dict())
        with self._random:
            self._make(started)

    def _make(self, network: PolicyNetwork) -> None:
        """Makes actor, critic and algorithm around a policy network."""
        config, seen = self.config, self._seen
        self._actor = Actor(seen, network, self._std)
        self._average = average_of(network, config.averaged_iterations)
        self._critic = Critic(seen, config.critic_hidden, self._value_of_living(config.gamma))
        self._ppo = PPO(
            self._actor,
            self._critic,
            Storage("rl", config.num_envs, config.num_steps, seen, (2,)),
            num_learning_epochs=config.update_epochs,
            num_mini_batches=config.num_mini_batches,
            clip_param=config.clip_range,
            gamma=config.gamma,
            lam=config.gae_lambda,
            entropy_coef=0.0,
            learning_rate=self._rate,
            max_grad_norm=config.max_grad_norm,
            schedule="fixed",
        )
        groups = [{"params": list(part.parameters())} for part in (self._actor, self._critic)]
        self._ppo.optimizer = torch.optim.Adam(groups, self._rate)

    @property
    def network(self) -> PolicyNetwork:
        """A running average of the actor over its last iterations."""
        return cast(PolicyNetwork, self._average.module)

    @property
    def difficulty(self) -> dict[str, float]:
        """How far the curriculum has come."""
        return self._batch.difficulty

    def iterate(self) -> dict[str, float]:
        with self._random:
            return self._iterate()

    def _iterate(self) -> dict[str, float]:
        config = self.config
        progress = self.iteration / max(1, self.iterations - 1)
        rate = schedules.geometric(self._rate, config.final_learning_rate, progress)
        std = schedules.geometric(self._std, config.final_std, progress)
        of_actor, of_critic = self._ppo.optimizer.param_groups
        of_actor["lr"], of_critic["lr"] = rate, rate if self._critic_rate is None else self._critic_rate
        self._actor.set_std(std)
        self._set_gamma(schedules.discount(config.gamma, config.final_gamma, progress))
        ended = early = paid = 0.0
        potentials = []
        with torch.no_grad():
            for _ in range(config.num_steps):
                self._seen, reward, ends, extras = self._env.step(self._ppo.act(self._seen))
                self._ppo.process_env_step(self._seen, config.reward_scale * reward, ends, extras)
                terminated = ends.bool() & ~extras["time_outs"]
                potentials.append(config.reward_scale * self._batch.last_potential[:, None])
                ended, early = ended + float(ends.sum()), early + float(terminated.sum())
                paid += float(reward.mean())
            self._ppo.compute_returns(self._seen)
            if config.relative_advantages:
                storage = self._ppo.storage
                living = self._value_of_living(self._ppo.gamma) - torch.stack(potentials)
                storage.advantages = relative_advantages(
                    storage.returns, storage.values, living, config.relative_advantages
                )
        self._actor.requires_grad_(self.iteration >= self._warmup_iterations)
        losses = self._ppo.update()
        self._average.update_parameters(self._actor.network)
        self.iteration += 1
        return {
            **{f"loss/{name}": float(value) for name, value in losses.items()},
            "train/reward": paid / config.num_steps,
            "train/early_end_rate": early / max(1.0, ended),
            "train/learning_rate": rate,
            "train/std": std,
            "train/gamma": self._ppo.gamma,
            "train/env_steps": self.iteration * config.num_envs * config.num_steps,
            **{f"curriculum/{name}": value for name, value in self.difficulty.items()},
        }

    def _value_of_living(self, gamma: float) -> float:
        return value_of_living(self._task, self.config.reward_scale, gamma) if self.config.pay else 0.0

    def _set_gamma(self, gamma: float) -> None:
        """Sets the discount factor, and moves all values by what it changes in the value of living for ever."""
        change = self._value_of_living(gamma) - self._value_of_living(self._ppo.gamma)
        with torch.no_grad():
            self._critic.linear.bias.add_(change)
        self._ppo.gamma = self._batch.gamma = gamma

    def state_dict(self) -> dict[str, Any]:
        assert self._batch.state is not None
        return {
            "iteration": self.iteration,
            "actor": self._actor.state_dict(),
            "critic": self._ppo.critic.state_dict(),
            "average": self._average.state_dict(),
            "optimizer": self._ppo.optimizer.state_dict(),
            "batch": list(self._batch.state),
            "curriculum": self._batch.curriculum_state(),
            "random": self._random.state_dict(),
            "gamma": self._ppo.gamma,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.iteration = state["iteration"]
        self._actor.load_state_dict(state["actor"])
        self._ppo.critic.load_state_dict(state["critic"])
        self._average.load_state_dict(state["average"])
        self._ppo.optimizer.load_state_dict(state["optimizer"])
        self._batch.state = BatchState(*state["batch"])
        self._batch.load_curriculum_state(state["curriculum"])
        self._seen = self._env.get_observations()
        self._random.load_state_dict(state["random"])
        self._ppo.gamma = self._batch.gamma = state["gamma"]


def make(task: Task, params: BallbotParams, config: RslPpoConfig, seed: int, demos: str | Path | None) -> RslPpo:
    """Makes the learner; it uses no demonstrations. Raises a ValueError where the task lacks what the settings ask for."""
    return RslPpo(task, params, config, seed)
