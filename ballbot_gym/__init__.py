"""Gymnasium environments of a ballbot at high lean. Importing this package registers their ids.

Everything that users need is imported from here: `from ballbot_gym import BallbotEnv`. Modules inside the
package may move; these names stay.
"""

import importlib.metadata
from typing import TYPE_CHECKING

from ballbot_gym import ops
from ballbot_gym.env import BallbotEnv
from ballbot_gym.lazy import exports
from ballbot_gym.registry import load_plugins, register_task
from ballbot_gym.robot import (
    Ballbot,
    Cylinder,
    GeneralOmni,
    Omni,
    PointBall,
    Quantity,
    Randomization,
    Robot,
    RollingBall,
    Shape,
    Sphere,
    Wheels,
    default_params,
    named_robot,
    read_urdf,
    register_robot,
    urdf_text,
)
from ballbot_gym.rollout import Controller, Episode, rollout
from ballbot_gym.seeding import spawned
from ballbot_gym.tasks import SHIPPED, TASKS, BallbotTask, Reference, Task
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.orbit import Orbit
from ballbot_gym.tasks.paths import catmull_rom, cubic, then_stay
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.turn import Turn
from ballbot_gym.tasks.weave import Weave
from ballbot_gym.trajectory import Trajectory

if TYPE_CHECKING:
    from ballbot_gym.engines.mjcf import MujocoModel
    from ballbot_gym.vector import BallbotVectorEnv
    from ballbot_gym.vector.batch import BallbotBatch

__all__ = [
    "TASKS",
    "Ballbot",
    "BallbotBatch",
    "BallbotEnv",
    "BallbotTask",
    "BallbotVectorEnv",
    "Controller",
    "Cylinder",
    "Episode",
    "GeneralOmni",
    "Marker",
    "MujocoModel",
    "Omni",
    "Orbit",
    "PointBall",
    "Quantity",
    "Randomization",
    "Reference",
    "Robot",
    "RollingBall",
    "Shape",
    "Sphere",
    "Stabilize",
    "Task",
    "Trajectory",
    "Turn",
    "Weave",
    "Wheels",
    "catmull_rom",
    "cubic",
    "default_params",
    "named_robot",
    "ops",
    "read_urdf",
    "register_robot",
    "register_task",
    "rollout",
    "spawned",
    "then_stay",
    "urdf_text",
]

__getattr__ = exports(
    __name__, {"BallbotBatch": "vector.batch", "BallbotVectorEnv": "vector", "MujocoModel": "engines.mjcf"}
)  # torch is imported for the first two

try:
    __version__ = importlib.metadata.version("ballbot-gym")
except importlib.metadata.PackageNotFoundError:  # run from a checkout that is not installed
    __version__ = "unknown"

for _task in SHIPPED:
    register_task(_task)
load_plugins()
