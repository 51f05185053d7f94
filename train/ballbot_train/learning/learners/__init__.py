"""Learning algorithms by name, one file each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.learning.learners import bc, dagger, ppo, sac, shac
from ballbot_train.learning.training import Learner


@dataclass(frozen=True)
class Algorithm:
    """How a learner is made."""

    make: Callable[[Task, BallbotParams, Any, int, Path | None], Learner]
    """(task, params, settings, seed, folder of demonstrations or None) -> learner at its beginning."""
    tuned: Mapping[str, Any]
    """Settings, a frozen dataclass, by name of task."""
    demonstrations: bool
    """Whether it can use demonstrations."""


LEARNERS: dict[str, Algorithm] = {
    "bc": Algorithm(bc.make, bc.TUNED, demonstrations=True),
    "dagger": Algorithm(dagger.make, dagger.TUNED, demonstrations=True),
    "ppo": Algorithm(ppo.make, ppo.TUNED, demonstrations=True),
    "sac": Algorithm(sac.make, sac.TUNED, demonstrations=True),
    "shac": Algorithm(shac.make, shac.TUNED, demonstrations=False),
}
