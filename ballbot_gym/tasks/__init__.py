"""The tasks, one file each."""

from ballbot_gym.tasks.ballbot import BallbotTask
from ballbot_gym.tasks.base import Reference, Task
from ballbot_gym.tasks.orbit import Orbit
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.turn import Turn
from ballbot_gym.tasks.weave import Weave

TASKS: dict[str, type[Task]] = {}
"""Every task by its name on the command line. `ballbot_gym.register_task` fills it."""

SHIPPED: tuple[type[Task], ...] = (Stabilize, Turn, Orbit, Weave)
"""The tasks that come with the package."""

__all__ = ["SHIPPED", "TASKS", "BallbotTask", "Reference", "Task"]
