"""The robots by name: their URDFs, and the episodes that each is given."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from ballbot_gym.checks import from_fields
from ballbot_gym.params import ROLLING_URDF_PATH, URDF_FOLDER, URDF_PATH, BallbotParams


@dataclass(frozen=True)
class Robot:
    """A robot by name.

    `fields` are the fields of tasks, by the task's name, that differ from the defaults because the paper's episodes are
    beyond this robot.
    """

    about: str
    urdf: Path
    fields: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


ROBOTS: dict[str, Robot] = {
    "paper": Robot("the paper's: a ball that translates, on a floor that gives whatever force is asked", URDF_PATH),
    "rolling": Robot(
        "the paper's with a ball that rolls, driven by a torque, on a floor with friction 0.8",
        ROLLING_URDF_PATH,
        {
            "stabilize": {"start_lean": 0.3, "start_lean_rate": 0.5},
            "orbit": {"max_steady_tilt": 0.56},
        },
    ),
    "kugle": Robot(
        "Kugle V1 of Aalborg University, by its published numbers",
        URDF_FOLDER / "kugle.urdf",
        {
            "stabilize": {"start_position": 1.0, "start_speed": 1.0, "start_lean": 0.1, "start_lean_rate": 0.2},
            "turn": {"min_speed": 0.5, "max_speed": 1.5},
            "orbit": {"min_steady_tilt": 0.05, "max_steady_tilt": 0.15},
            "weave": {"ball_radius": 0.129},
        },
    ),
}
"""Every robot by its name on the command line. A new robot is one URDF and one entry here."""

PAPER = "paper"
"""The default."""


@cache
def named_robot(name: str) -> BallbotParams:
    """The robot of a name in `ROBOTS`, read once from its URDF.

    Raises:
        ValueError: no robot of that name.
    """
    if name not in ROBOTS:
        raise ValueError(f"unknown robot {name!r}; known: {', '.join(map(repr, ROBOTS))}")
    return BallbotParams.from_urdf(ROBOTS[name].urdf)


def file_name(name: str, robot: str) -> str:
    """A name of a file or folder, with that of the robot by name; the paper's robot adds nothing."""
    return name if robot == PAPER else f"{name}-{robot}"


def robot_setting(robot: str) -> dict[str, str]:
    """{"robot": name} for the settings of a record, and nothing for the paper's: older records do not name theirs."""
    return {} if robot == PAPER else {"robot": robot}


def robot_name(params: BallbotParams) -> str:
    """The name in `ROBOTS` of a robot, or of the one that it is a variant of.

    With another friction it is the same robot. Any other is taken for the paper's, or for "rolling" if its ball rolls.
    """
    for name in ROBOTS:
        if replace(named_robot(name), friction=params.friction) == params:
            return name
    return "rolling" if params.rolls else PAPER


def checked_robot(robot: Any, params: Any = None) -> BallbotParams:
    """The robot that was given by name or by its parameters.

    Args:
        robot: a name in `ROBOTS`, a BallbotParams, or the dict of all its fields that `dataclasses.asdict` makes.
        params: the same without a name, or None; not both.

    Raises:
        ValueError: no robot of that name, or a robot and params.
        TypeError: it is something else, such as a dict of fields.
    """
    if params is not None:
        if robot != PAPER:
            raise ValueError("give either robot or params, not both: robot takes a name or a BallbotParams")
        robot = params
    robot = from_fields(BallbotParams, robot)
    if params is None and isinstance(robot, str):
        return named_robot(robot)
    if not isinstance(robot, BallbotParams):
        raise TypeError(
            "params must be a BallbotParams, for instance dataclasses.replace(default_params(), body_mass=12.0), "
            f"not {robot!r}; robot may also be one of {', '.join(map(repr, ROBOTS))}"
        )
    return robot


def own_fields(robot: str | BallbotParams, task: str) -> dict[str, float]:
    """The fields of a task, by name, that a robot has other defaults of."""
    name = robot if isinstance(robot, str) else robot_name(robot)
    named_robot(name)  # raises if there is none
    return dict(ROBOTS[name].fields.get(task, {}))
