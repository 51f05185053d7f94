"""The tasks, one file each."""

from ballbot_gym.tasks.base import Reference, Task
from ballbot_gym.tasks.orbit import Orbit
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.turn import Turn
from ballbot_gym.tasks.weave import Weave

TASKS: dict[str, type[Task]] = {
    "stabilize": Stabilize,
    "turn": Turn,
    "orbit": Orbit,
    "weave": Weave,
}
"""Every task by its name on the command line. A new task is one file and one line here."""

__all__ = ["TASKS", "Reference", "Task"]
