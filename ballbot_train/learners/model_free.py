"""What PPO and SAC share: the envs they train on, imitation, their random numbers, and their actors as policies."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import nn

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.vector import BallbotVectorEnv, BatchState
from ballbot_train.demos import Demos
from ballbot_train.policy import PolicyNetwork, PolicySpec
from ballbot_train.sb3 import BallbotVecEnv


class TrainingEnv(VecEnvWrapper):
    """A task's batched envs for learning: shorter episodes, cheaper falls and scaled rewards change no optimum.

    An episode that runs out of time is truncated, and the learners count the value of where it stopped; so shorter
    episodes only leave out rest, of which there is little to learn. A fall still costs more than any sensible episode.
    """

    def __init__(
        self, task: Task, params: BallbotParams, envs: int, episode: float, fall_price: float, reward_scale: float
    ):
        """Args: episode: s; fall_price: in place of the task's; reward_scale: what every reward is multiplied by."""
        shorter = replace(task, duration=episode, failure_cost=fall_price)
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
