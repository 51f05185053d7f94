"""Behaviour cloning: the policy is fitted to the expert's actions in the states of a demonstration dataset."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import Symmetry
from ballbot_train.learning.demonstrations import StreamedDemos, load_demos
from ballbot_train.learning.fitting import Fit, Samples
from ballbot_train.policy import PolicyNetwork
from ballbot_train.shards import is_set


@dataclass(frozen=True)
class BcConfig:
    """Settings of `BehaviourCloning`."""

    total_iterations: int = 60
    """Number of iterations."""
    evaluations: int = 6
    """Number of evaluations, at equal distances."""
    gradient_steps: int = 200
    """Gradient steps per iteration."""
    batch_size: int = 1024
    """Samples per gradient step."""
    symmetry: Symmetry = "none"
    """How the policy respects the task's symmetry: opposite observations get opposite actions (odd), its output is averaged
    over the task's mirror images, or it sees and acts in the task's frame or its fine frame."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the policy's hidden layers."""
    learning_rate: float = 3e-3
    """Learning rate at the start."""
    final_learning_rate_fraction: float = 0.01
    """Learning rate at the end, as a fraction of that at the start. It falls along half a cosine."""


TUNED: dict[str, BcConfig] = {"weave": BcConfig(hidden=(256, 256))}
"""Settings by name of task; every other task takes the defaults."""


class BehaviourCloning:
    """The learner; see `training.Learner`. An iteration's random numbers depend on seed and iteration alone."""

    # an iteration reads one shard of demonstrations that are shards
    def __init__(
        self, task: Task, params: BallbotParams, config: BcConfig, seed: int, samples: "Samples | StreamedDemos"
    ):
        self.config, self.iteration = config, 0
        self.iterations, self.evaluations = config.total_iterations, config.evaluations
        self._seed, self._samples = seed, samples
        self._fit = Fit(task, params, config.symmetry, config.hidden, seed)

    @property
    def network(self) -> PolicyNetwork:
        return self._fit.network

    def iterate(self) -> dict[str, float]:
        config = self.config
        progress = self.iteration / config.total_iterations
        rate = schedules.cosine(config.learning_rate, config.final_learning_rate_fraction, progress)
        rng = np.random.default_rng([self._seed, self.iteration])
        samples = self._samples
        if isinstance(samples, StreamedDemos):
            demos = samples.at(self.iteration)
            samples = Samples.of(demos.observations, demos.actions)
        loss = self._fit.run(samples, config.gradient_steps, config.batch_size, rate, rng)
        self.iteration += 1
        return {"loss/imitation": loss, "train/learning_rate": rate}

    def state_dict(self) -> dict[str, Any]:
        return {"iteration": self.iteration, **self._fit.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.iteration = state["iteration"]
        self._fit.load_state_dict(state)


def make(task: Task, params: BallbotParams, config: BcConfig, seed: int, demos: str | Path | None) -> BehaviourCloning:
    """Makes the learner.

    Raises:
        ValueError: there are no demonstrations, or they are of another task.
    """
    if demos is None:
        raise ValueError('bc learns from demonstrations: give --demos a dataset of "ballbot demos"')
    if is_set(demos):
        return BehaviourCloning(task, params, config, seed, StreamedDemos(demos, task, seed))
    loaded = load_demos(demos, task)
    return BehaviourCloning(task, params, config, seed, Samples.of(loaded.observations, loaded.actions))
