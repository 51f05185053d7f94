"""Gymnasium environments of a ballbot at high lean. Importing this package registers their ids."""

import importlib.metadata

import gymnasium

from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.tasks import TASKS, Task

__all__ = ["TASKS", "BallbotEnv", "BallbotParams", "Randomization", "Task"]

try:
    __version__ = importlib.metadata.version("ballbot-gym")
except importlib.metadata.PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "unknown"

for _name, _task in TASKS.items():
    gymnasium.register(
        id=_task.id,
        entry_point="ballbot_gym.env:BallbotEnv",
        # imported, with torch, when first used
        vector_entry_point="ballbot_gym.vector:BallbotVectorEnv",
        kwargs={"task": _name},
    )
