"""The robots by name: their URDFs, and the fields of tasks that differ for each robot."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ballbot_gym.checks import from_fields
from ballbot_gym.robot.base import Robot
from ballbot_gym.robot.urdf import OMNI_URDF_PATH, ROLLING_URDF_PATH, URDF_FOLDER, URDF_PATH, read_urdf


@dataclass(frozen=True)
class Registered:
    """A robot by name.

    `fields` are the fields of tasks, by the task's name, that differ from the defaults because the paper's episodes are
    beyond this robot.
    """

    params: Robot
    fields: Mapping[str, dict[str, float]]


ROBOTS: dict[str, Registered] = {}
"""Every robot by its name on the command line. `ballbot_gym.register_robot` fills it."""

PAPER = "paper"
"""The default."""


def register_robot(
    name: str, urdf: str | Path | Robot, fields: Mapping[str, Mapping[str, float]] | None = None
) -> None:
    """Gives a robot a name that environments, experts and commands accept.

    Args:
        name: small letters, digits and underscores.
        urdf: its file, with the chain of joints that `read_urdf` describes; or its parameters.
        fields: fields of tasks, by the task's name, that differ from the defaults if the usual episodes are too hard for it:
            `{"stabilize": {"start_lean": 0.3}}`.

    Raises:
        ValueError: the name is no such word, or another robot has it.
        UrdfError: the URDF is missing or has another chain.
        TypeError: urdf or fields are something else.
    """
    check_name(name, "robot")
    if not isinstance(urdf, str | Path | Robot):
        raise TypeError(f"register_robot: urdf must be a path or a Robot, not {urdf!r}")
    fields = {} if fields is None else fields
    if not isinstance(fields, Mapping) or not all(isinstance(each, Mapping) for each in fields.values()):
        raise TypeError(
            'register_robot: fields must be fields by task, such as {"stabilize": {"start_lean": 0.3}}, '
            f"not {fields!r}"
        )
    params = urdf if isinstance(urdf, Robot) else read_urdf(urdf)
    robot = Registered(params, {task: dict(own) for task, own in fields.items()})
    if ROBOTS.get(name, robot) != robot:
        raise ValueError(f"register_robot: the name {name!r} is taken by another robot; give yours another name")
    ROBOTS[name] = robot


def check_name(name: Any, what: str) -> None:
    """Raises a ValueError for a name that cannot be part of a file's name or an option."""
    if not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise ValueError(f"the name of a {what} must be small letters, digits and underscores, not {name!r}")


def short_name(name: str) -> str:
    """The name of a task or robot, from MODULE:NAME as Gymnasium's ids have it: the module, which registers it, is imported.

    Raises:
        ValueError: there is no such module, or it exits when it is imported.
        ModuleNotFoundError: the module imports another that is not installed.
    """
    module, colon, short = name.rpartition(":")
    if colon:
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            if not f"{module}.".startswith(f"{error.name}."):
                raise ModuleNotFoundError(
                    f"{name}: the module {module!r} imports {error.name!r}, which is not installed", name=error.name
                ) from error
            raise ValueError(f"{name}: no module {error.name!r} is installed or in {os.getcwd()}") from None
        except SystemExit:
            raise ValueError(
                f'{name}: the module {module!r} exits when it is imported; put what it runs under if __name__ == "__main__"'
            ) from None
    return short


def named_robot(name: str) -> Robot:
    """The robot of a name in `ROBOTS`, or of MODULE:NAME.

    Raises:
        ValueError: no robot of that name.
    """
    short = short_name(name) if isinstance(name, str) else name
    if short not in ROBOTS:
        raise ValueError(f"unknown robot {name!r}; known: {', '.join(map(repr, ROBOTS))}")
    return ROBOTS[short].params


def file_name(name: str, robot: str) -> str:
    """A name of a file or folder, with that of the robot by name; the paper's robot adds nothing."""
    return name if robot == PAPER else f"{name}-{robot}"


def robot_setting(robot: str) -> dict[str, str]:
    """{"robot": name} for the settings of a record, and nothing for the paper's: older records do not name theirs."""
    return {} if robot == PAPER else {"robot": robot}


def robot_name(params: Robot) -> str:
    """The name in `ROBOTS` of a robot, or of the robot that it is a variant of.

    A robot that is not registered, and differs from a registered one only in friction, has the name of that robot. Any other
    variant has the name of the first registered robot of its kind. Records use `registered_name`, which gives a name to
    exactly the registered robots only.

    Raises:
        ValueError: no robot of this kind is registered.
    """
    by_numbers = {robot.params: name for name, robot in reversed(ROBOTS.items())}
    if params in by_numbers:
        return by_numbers[params]
    alike = [name for name, robot in ROBOTS.items() if type(robot.params) is type(params)]
    for name in alike:
        if named_robot(name).on_any_floor() == params.on_any_floor():
            return name
    return first_of_kind(params)


def first_of_kind(params: Robot) -> str:
    """The name of the first robot that is registered of a robot's kind, or else of the nearest kind that this one extends.

    Raises:
        ValueError: none is.
    """
    for kind in type(params).__mro__:
        for name, robot in ROBOTS.items():
            if type(robot.params) is kind:
                return name
    raise ValueError(f"no {type(params).__name__} has a name; give it one with ballbot_gym.register_robot")


def registered_name(params: Robot) -> str:
    """The name in `ROBOTS` of exactly this robot.

    Raises:
        ValueError: it has none.
    """
    name = robot_name(params)
    if ROBOTS[name].params != params:
        raise ValueError(
            f"this robot has no name: its numbers are not those of {name!r}. Give it one with ballbot_gym.register_robot, "
            "because policies and records of a training name their robot"
        )
    return name


def checked_robot(robot: Any, params: Any = None) -> Robot:
    """The robot that was given by name or by its parameters.

    Args:
        robot: a name in `ROBOTS`, a Robot, or the dict of all its fields that `dataclasses.asdict` makes.
        params: the same without a name, or None; not both.

    Raises:
        ValueError: no robot of that name, or a robot and params.
        TypeError: it is something else, such as a dict of fields.
    """
    if params is not None:
        if robot != PAPER:
            raise ValueError("give either robot or params, not both: robot takes a name or a Robot")
        robot = params
    for kind in dict.fromkeys(type(each.params) for each in ROBOTS.values()):
        robot = from_fields(kind, robot)
    if params is None and isinstance(robot, str):
        return named_robot(robot)
    if not isinstance(robot, Robot):
        raise TypeError(
            "params must be a Robot, for instance dataclasses.replace(default_params(), body_mass=12.0), "
            f"not {robot!r}; robot may also be one of {', '.join(map(repr, ROBOTS))}"
        )
    return robot


register_robot(PAPER, URDF_PATH)
register_robot(  # the paper's with a ball that rolls, driven by a torque, on a floor with friction 0.8
    "rolling",
    ROLLING_URDF_PATH,
    {"stabilize": {"start_lean": 0.3, "start_lean_rate": 0.5}, "orbit": {"max_steady_tilt": 0.56}},
)
register_robot(  # Kugle V1 of Aalborg University, by its published numbers
    "kugle",
    URDF_FOLDER / "kugle.urdf",
    {
        "stabilize": {"start_position": 1.0, "start_speed": 1.0, "start_lean": 0.1, "start_lean_rate": 0.2},
        "turn": {"min_speed": 0.5, "max_speed": 1.5},
        "orbit": {"min_steady_tilt": 0.05, "max_steady_tilt": 0.15},
        "weave": {"ball_radius": 0.129},
    },
)
_HEADING = {"heading_weight": 1.0}  # 1/s: with a free heading it pays to spin, which is far from linear
register_robot(  # Kugle V1 with its three omni-wheels and motors: it yaws, and its torque falls with speed
    "omni", OMNI_URDF_PATH, {task: fields | _HEADING for task, fields in ROBOTS["kugle"].fields.items()}
)
register_robot(  # the same with motors for leans of 30°
    "omni_strong",
    URDF_FOLDER / "omni_strong.urdf",
    {
        "stabilize": {"start_position": 1.0, "start_speed": 2.0, "start_lean": 0.3, "start_lean_rate": 0.5} | _HEADING,
        "turn": {"min_speed": 1.0, "max_speed": 4.0} | _HEADING,
        "orbit": {"max_steady_tilt": 0.52} | _HEADING,
        "weave": {"ball_radius": 0.129} | _HEADING,
    },
)
