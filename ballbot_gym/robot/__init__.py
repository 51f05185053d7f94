"""Robots: what a robot is, a file for each kind, the robots by name, and what varies from episode to episode."""

from ballbot_gym.robot.ballbot import (
    LEAST_NORMAL_FORCE,
    Ballbot,
    cos_tilt,
    tilt,
)
from ballbot_gym.robot.base import RK4_STEP, Kind, Quantity, Robot
from ballbot_gym.robot.general_omni import GeneralOmni
from ballbot_gym.robot.omni import Omni, Wheels
from ballbot_gym.robot.point_ball import PointBall
from ballbot_gym.robot.randomization import (
    ROBOT_FACTORS,
    TRACKS,
    Randomization,
    normals,
)
from ballbot_gym.robot.registry import (
    PAPER,
    ROBOTS,
    Registered,
    check_name,
    checked_robot,
    file_name,
    first_of_kind,
    named_robot,
    register_robot,
    registered_name,
    robot_name,
    robot_setting,
    short_name,
)
from ballbot_gym.robot.rolling_ball import RollingBall
from ballbot_gym.robot.sensors import Sensors
from ballbot_gym.robot.shapes import Cylinder, Shape, Sphere
from ballbot_gym.robot.urdf import (
    OMNI_URDF_PATH,
    ROLLING_URDF_PATH,
    URDF_FOLDER,
    URDF_PATH,
    UrdfError,
    default_params,
    read_urdf,
    urdf_text,
)

__all__ = [
    "LEAST_NORMAL_FORCE",
    "OMNI_URDF_PATH",
    "PAPER",
    "RK4_STEP",
    "ROBOTS",
    "ROBOT_FACTORS",
    "ROLLING_URDF_PATH",
    "TRACKS",
    "URDF_FOLDER",
    "URDF_PATH",
    "Ballbot",
    "Cylinder",
    "GeneralOmni",
    "Kind",
    "Omni",
    "PointBall",
    "Quantity",
    "Randomization",
    "Registered",
    "Robot",
    "RollingBall",
    "Sensors",
    "Shape",
    "Sphere",
    "UrdfError",
    "Wheels",
    "check_name",
    "checked_robot",
    "cos_tilt",
    "default_params",
    "file_name",
    "first_of_kind",
    "named_robot",
    "normals",
    "read_urdf",
    "register_robot",
    "registered_name",
    "robot_name",
    "robot_setting",
    "short_name",
    "tilt",
    "urdf_text",
]  # fmt: skip
