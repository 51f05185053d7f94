"""Gymnasium environments of a ballbot at high lean. Importing this package registers their ids."""

import gymnasium

from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import TASKS, Task

__all__ = ["TASKS", "BallbotEnv", "BallbotParams", "Task"]

for _name, _task in TASKS.items():
    gymnasium.register(id=_task.id, entry_point="ballbot_gym.env:BallbotEnv", kwargs={"task": _name})
