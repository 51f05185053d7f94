"""The tasks, one file each."""

from ballbot_gym.tasks.base import Task
from ballbot_gym.tasks.stabilize import Stabilize

TASKS: dict[str, type[Task]] = {
    "stabilize": Stabilize,
}
"""Every task by its name on the command line. A new task is one file and one line here."""

__all__ = ["TASKS", "Task"]
