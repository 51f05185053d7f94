"""Gymnasium environments of a ballbot at high lean. Importing this package registers their ids."""

import importlib.metadata

from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.registry import load_plugins, register_task
from ballbot_gym.robots import named_robot, register_robot
from ballbot_gym.tasks import SHIPPED, TASKS, Task

__all__ = [
    "TASKS",
    "BallbotEnv",
    "BallbotParams",
    "Randomization",
    "Task",
    "named_robot",
    "register_robot",
    "register_task",
]

try:
    __version__ = importlib.metadata.version("ballbot-gym")
except importlib.metadata.PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "unknown"

for _task in SHIPPED:
    register_task(_task)
load_plugins()
