"""What PPO and SAC share: their stages, the envs they train on, imitation, and their actors as policies."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

from ballbot_gym.batch import BatchState
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_train.learning.demonstrations import Demos
from ballbot_train.learning.sb3 import BallbotVecEnv
from ballbot_train.policy import PolicyNetwork, PolicySpec


@dataclass(frozen=True)
class ModelFreeConfig:
    """Settings that PPO and SAC share."""

    iterations: int
    """Of reinforcement learning: `envs` times `steps` env steps each."""
    envs: int
    steps: int
    """Control steps of each env per iteration."""
    evaluations: int = 20
    episode: float = 4.0
    """s, after which episodes start anew in training."""
    reward_scale: float = 0.02
    discount: float = 0.995
    """Per control step."""
    hidden: tuple[int, ...] = (128, 128)
    """Of actor and of critics."""
    clone_iterations: int = 20
    """Iterations of behaviour cloning before those of reinforcement learning, of `clone_steps` gradient steps each."""
    clone_steps: int = 300
    clone_batch: int = 1024
    clone_rate: float = 2e-3
    """Learning rate at the start, falling linearly to 0."""
    critic_iterations: int = 10
    """How many iterations of reinforcement learning teach the critic alone, where there are demonstrations."""
    imitation: float = 0.0
    """Weight of the imitation loss at the start of reinforcement learning; fades linearly to 0."""


class ModelFree(ABC):
    """What PPO and SAC have in common; see `training.Learner`.

    With demonstrations there are three stages. First the actor imitates the expert's actions (behaviour cloning). Then its
    critic alone learns what the imitation costs, because a critic that knows nothing would spoil it. From then on it is
    reinforcement learning, whose every gradient step also follows the gradient of an imitation loss, with a weight that
    fades to nothing.

    A resumed run does what it would have done; only the success rate of the last hundred episodes is not kept.
    """

    def __init__(self, task: Task, params: BallbotParams, config: ModelFreeConfig, demos: Demos | None):
        self.config, self.iteration, self._task, self._demos = config, 0, task, demos
        self._clone_iterations = 0 if demos is None else config.clone_iterations
        self._critic_iterations = 0 if demos is None else config.critic_iterations
        self.iterations, self.evaluations = config.iterations + self._clone_iterations, config.evaluations
        self._env = TrainingEnv(task, params, config.envs, config.episode, config.reward_scale)

    def _begin(self, model: BaseAlgorithm, actor: nn.Sequential, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        """Takes SB3's model, its actor from observation to mean action, and its optimizers, the actor's first."""
        self._model, self._actor, self._optimizers = model, actor, optimizers
        model.set_logger(Logger(folder=None, output_formats=[]))
        model._last_obs = self._env.reset()
        model._last_episode_starts = np.ones(self.config.envs, bool)
        self._imitation = None if self._demos is None else Imitation(actor, self._demos, self.config.clone_batch)
        optimizers[0].register_step_pre_hook(self._add_imitation)
        self._random = OwnRandomness()

    @abstractmethod
    def _imitation_scale(self) -> float:
        """What the imitation loss, the mean squared difference of the actions, is multiplied by, besides its weight."""

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
            "optimizers": [optimizer.state_dict() for optimizer in self._optimizers],
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
        for optimizer, old in zip(self._optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(old)
        if self._imitation is not None:
            self._imitation.load_state_dict(state["imitation"])
        model.num_timesteps = state["env_steps"]
        self._env.load_state_dict(state["env"])
        model._last_obs, model._last_episode_starts = state["observations"].numpy(), state["starts"].numpy()
        self._random.load_state_dict(state["random"])

    @property
    def _progress(self) -> float:
        """Share of the iterations of reinforcement learning that are done."""
        return (self.iteration - self._clone_iterations) / self.config.iterations

    @property
    def _critic_only(self) -> bool:
        return self.iteration < self._clone_iterations + self._critic_iterations

    def _clone(self) -> dict[str, float]:
        """One iteration of behaviour cloning."""
        rate = self.config.clone_rate * (1 - self.iteration / self._clone_iterations)
        return self._imitation.clone(self.config.clone_steps, rate)

    def _improve(self) -> dict[str, float]:
        """One iteration of reinforcement learning."""
        config, model = self.config, self._model
        self._actor.requires_grad_(not self._critic_only)
        model.learn(config.envs * config.steps, log_interval=None, reset_num_timesteps=False)
        self._actor.requires_grad_(True)
        return {**model.logger.name_to_value, "train/env_steps": model.num_timesteps}

    def _add_imitation(self, *_: object) -> None:
        """Adds the imitation loss's gradient to that of a step of the actor."""
        if self._imitation is not None and not self._critic_only:
            weight = self.config.imitation * (1 - self._progress) * self._imitation_scale()
            (weight * self._imitation.loss()).backward()


class TrainingEnv(VecEnvWrapper):
    """A task's batched envs for learning: shorter episodes and scaled rewards change no optimum.

    An episode that runs out of time is truncated, and the learners count the value of where it stopped; so shorter
    episodes only leave out rest, of which there is little to learn.
    """

    def __init__(self, task: Task, params: BallbotParams, envs: int, episode: float, reward_scale: float):
        """Args: episode: s; reward_scale: what every reward is multiplied by."""
        shorter = replace(task, duration=episode)
        self._vector = BallbotVectorEnv(envs, shorter, params=params, compile=False)
        self._scale = np.float32(reward_scale)
        super().__init__(BallbotVecEnv(self._vector))

    def reset(self) -> np.ndarray:
        """Starts an episode in every env, as if each were under way for another while, so that they never end together."""
        observation, batch = self.venv.reset(), self._vector.batch
        under_way = torch.arange(self.num_envs) * self._vector.task.steps // self.num_envs
        batch.state = batch.state._replace(steps=under_way)
        return observation

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, done, infos = self.venv.step_wait()
        return observation, self._scale * reward, done, infos

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Of every env: tensors."""
        return self._vector.batch.state._asdict()

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Goes back to a state."""
        self._vector.batch.state = BatchState(**state)


class Imitation:
    """How an actor learns what an expert did: behaviour cloning, and a loss to add to that of reinforcement learning."""

    def __init__(self, actor: nn.Module, demos: Demos, batch: int):
        """Args: actor: observations (n, no) to mean actions (n, 2); batch: demonstrated steps per gradient step."""
        self._actor, self._batch = actor, batch
        self._observations, self._labels = torch.as_tensor(demos.observations), torch.as_tensor(demos.actions)
        self._optimizer = torch.optim.Adam(actor.parameters())

    def loss(self) -> torch.Tensor:
        """Mean squared difference from the expert's actions in some demonstrated states."""
        chosen = torch.randint(len(self._labels), (self._batch,))
        return nn.functional.mse_loss(self._actor(self._observations[chosen]), self._labels[chosen])

    def clone(self, steps: int, learning_rate: float) -> dict[str, float]:
        """Gradient steps of behaviour cloning; returns figures to log."""
        total = 0.0
        self._optimizer.param_groups[0]["lr"] = learning_rate
        for _ in range(steps):
            loss = self.loss()
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()
            total += float(loss.detach())
        return {"loss/cloning": total / steps}

    def state_dict(self) -> dict[str, Any]:
        """Of the optimizer; the actor is not its own."""
        return self._optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state."""
        self._optimizer.load_state_dict(state)


class OwnRandomness:
    """A learner's own streams of the global random numbers of torch and NumPy, from which Stable-Baselines3 draws.

    `with` it, they go on where they stopped the last time, whatever was drawn in between.
    """

    def __init__(self):
        self._capture()

    def __enter__(self) -> None:
        torch.set_rng_state(self._torch)
        np.random.set_state(self._numpy)

    def __exit__(self, *_: object) -> None:
        self._capture()

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values."""
        kind, words, *rest = self._numpy
        return {"torch": self._torch, "numpy": [kind, words.tolist(), *rest]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to a state."""
        kind, words, *rest = state["numpy"]
        self._torch, self._numpy = state["torch"], (kind, np.array(words, np.uint32), *rest)

    def _capture(self) -> None:
        self._torch, self._numpy = torch.get_rng_state(), np.random.get_state()


def as_policy(layers: Iterable[nn.Module], task: Task, **fields: Any) -> PolicyNetwork:
    """The layers of an actor, from observation to mean action, as a policy; fields are the spec's."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    hidden = tuple(layer.out_features for layer in linear[:-1])
    network = PolicyNetwork(PolicySpec.of(task, hidden=hidden, linear=False, **fields))
    for copy, layer in zip((part for part in network.mlp if isinstance(part, nn.Linear)), linear, strict=True):
        copy.load_state_dict(layer.state_dict())
    return network
