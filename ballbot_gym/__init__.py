"""Gymnasium environments of a ballbot at high lean. Importing this package registers their ids."""

import gymnasium

from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.tasks import TASKS, Task

__all__ = ["TASKS", "BallbotEnv", "BallbotParams", "Randomization", "Task"]

for _name, _task in TASKS.items():
    gymnasium.register(
        id=_task.id,
        entry_point="ballbot_gym.env:BallbotEnv",
        # imported, with torch, when first used
        vector_entry_point="ballbot_gym.vector:BallbotVectorEnv",
        kwargs={"task": _name},
    )
