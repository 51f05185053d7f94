"""Behaviour cloning: the policy is fitted to what the expert answered in the states of a demonstration dataset."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ballbot_baselines.lqr import equilibrium_gain
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning.demonstrations import load_demos
from ballbot_train.policy import PolicyNetwork, PolicySpec


@dataclass(frozen=True)
class BcConfig:
    """Settings of `BehaviourCloning`."""

    iterations: int = 60
    evaluations: int = 6
    steps: int = 200
    """Gradient steps per iteration."""
    batch: int = 1024
    """Samples per gradient step."""
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 3e-3
    """At the start; falls along a half cosine to `final_rate` of it."""
    final_rate: float = 0.01


TUNED: dict[str, BcConfig] = {
    "stabilize": BcConfig(),
    "turn": BcConfig(),
    "orbit": BcConfig(),
    "weave": BcConfig(hidden=(256, 256)),
}
"""By task."""


@dataclass
class Samples:
    """n labelled observations, which can grow: observations (n, no), actions (n, 2), weights (n,) of their errors."""

    observations: torch.Tensor
    actions: torch.Tensor
    weights: torch.Tensor

    @classmethod
    def of(cls, observations: np.ndarray, actions: np.ndarray, weights: np.ndarray | None = None) -> "Samples":
        """From arrays; weights default to 1."""
        weights = np.ones(len(actions)) if weights is None else weights
        return cls(*(torch.as_tensor(np.asarray(part, np.float32)) for part in (observations, actions, weights)))

    def __len__(self) -> int:
        return len(self.actions)

    def add(self, other: "Samples") -> None:
        """Appends others."""
        self.observations = torch.cat([self.observations, other.observations])
        self.actions = torch.cat([self.actions, other.actions])
        self.weights = torch.cat([self.weights, other.weights])


class Fit:
    """A policy network fitted to samples by Adam on the weighted mean squared error of its actions."""

    def __init__(self, task: Task, params: BallbotParams, hidden: tuple[int, ...], seed: int):
        """The network starts as LQR where the task has an equilibrium to rest at, else at zero."""
        torch.manual_seed(seed)
        self.network = PolicyNetwork(PolicySpec.of(task, hidden=hidden))
        with torch.no_grad():
            self.network.linear.weight.zero_()
            self.network.linear.bias.zero_()
            if (gain := equilibrium_gain(task, params)) is not None:
                self.network.linear.weight[:, :8] = torch.tensor(gain[0])
        self._optimizer = torch.optim.Adam(self.network.parameters())

    def run(self, samples: Samples, steps: int, batch: int, rate: float, rng: np.random.Generator) -> float:
        """Takes gradient steps on batches drawn with rng; returns their mean loss."""
        self._optimizer.param_groups[0]["lr"] = rate
        total = 0.0
        for _ in range(steps):
            drawn = torch.as_tensor(rng.integers(len(samples), size=min(batch, len(samples))))
            error = (self.network(samples.observations[drawn]) - samples.actions[drawn]) ** 2
            weights = samples.weights[drawn]
            loss = (weights * error.mean(1)).sum() / weights.sum()
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()
            total += float(loss.detach())
        return total / steps

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values."""
        return {"network": self.network.state_dict(), "optimizer": self._optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])


def annealed(rate: float, final: float, share: float) -> float:
    """A learning rate that falls along a half cosine to a fraction `final` of itself, after a share of the iterations."""
    return rate * (final + (1 - final) * (1 + math.cos(math.pi * share)) / 2)


class BehaviourCloning:
    """The learner; see `training.Learner`. What an iteration draws depends on seed and iteration alone."""

    def __init__(self, task: Task, params: BallbotParams, config: BcConfig, seed: int, samples: Samples):
        self.config, self.iteration = config, 0
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self._seed, self._samples = seed, samples
        self._fit = Fit(task, params, config.hidden, seed)

    @property
    def network(self) -> PolicyNetwork:
        return self._fit.network

    def iterate(self) -> dict[str, float]:
        config = self.config
        rate = annealed(config.learning_rate, config.final_rate, self.iteration / config.iterations)
        rng = np.random.default_rng([self._seed, self.iteration])
        loss = self._fit.run(self._samples, config.steps, config.batch, rate, rng)
        self.iteration += 1
        return {"loss/imitation": loss, "train/learning_rate": rate}

    def state_dict(self) -> dict[str, Any]:
        return {"iteration": self.iteration, **self._fit.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.iteration = state["iteration"]
        self._fit.load_state_dict(state)


def make(task: Task, params: BallbotParams, config: BcConfig, seed: int, demos: Path | None) -> BehaviourCloning:
    """The learner at its beginning.

    Raises:
        ValueError: no demonstrations, or those of another task.
    """
    if demos is None:
        raise ValueError('bc learns from demonstrations: give --demos a dataset of "ballbot demos"')
    loaded = load_demos(demos, task)
    return BehaviourCloning(task, params, config, seed, Samples.of(loaded.observations, loaded.actions))
