"""Controllers by name: experts of `CONTROLLERS`, policies that come with the package, policy files and saved models."""

from pathlib import Path
from types import ModuleType

from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import PAPER, ROBOTS, named_robot, robot_name
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import TASKS, Task
from ballbot_train.console import check_names
from ballbot_train.policy_files import is_run, read_description, shipped_policies, weights_digest

FILTERED = "-ekf"
"""Which of `FILTERS` may follow the name of a controller of a robot with wheels: then it takes sensors in place of states."""


def _experts() -> ModuleType:
    """The package of the experts. It is imported where they are asked for by name: who evaluates a function needs none."""
    import ballbot_baselines

    return ballbot_baselines


def names(task: Task, robot: str = PAPER, track: str | None = "") -> list[str]:
    """The controllers that a task has for a robot, experts first; tracks as of `shipped_policies`."""
    return [*_experts().CONTROLLERS, *shipped_policies(task, robot, track)]


def filters(params: BallbotParams) -> tuple[str, ...]:
    """What may follow the names of controllers of a robot."""
    return _experts().FILTERS if params.wheels is None else (FILTERED,)


def plain(name: str) -> str:
    """The name of a controller without the filter in front of it."""
    return name if name in _experts().VARIANTS else name.removesuffix(_filter_of(name))


def _filter_of(name: str) -> str:
    """Which of `FILTERS` a name ends with, or ""."""
    return next((ending for ending in _experts().FILTERS if name.endswith(ending)), "")


def of_other_robot(name: str, task: Task) -> str:
    """What to type for a policy of a task that comes with the package for other robots; "" of another name."""
    robots = [robot for robot in ROBOTS if name in shipped_policies(task, robot, None)]
    if not robots:
        return ""
    plural = "s" if len(robots) > 1 else ""
    return (
        f"it was made for the robot{plural} {', '.join(robots)}: `ballbot transfer --made-for {robots[0]} "
        f"--controllers {name} --robot YOURS` runs it on yours"
    )


def is_expert(name: str) -> bool:
    """Whether a name is an expert's or a variant's, and no policy's."""
    return plain(name) in _experts().CONTROLLERS | _experts().VARIANTS


def is_file(name: str) -> bool:
    """Whether a controller's name is the path of a policy file, of a run's folder with one, or of a saved model."""
    path = Path(plain(name))
    return not is_expert(name) and (bool(path.suffix) or (path.name != plain(name) and is_run(path)))


def is_saved_model(name: str) -> bool:
    """Whether a controller's name is the path of a model that Stable-Baselines3 saved."""
    return Path(plain(name)).suffix == ".zip"


def acts_in(name: str, task: Task, robot: str = PAPER) -> bool:
    """Whether a task has a controller of that name for a robot; of a file as of `is_made_for`."""
    if is_file(name):
        return is_made_for(name, task, robot)
    ending = _filter_of(name)
    behind = not ending or ending in filters(named_robot(robot))
    return name in _experts().VARIANTS or (behind and name.removesuffix(ending) in names(task, robot, None))


def is_made_for(name: str, task: Task, robot: str = PAPER) -> bool:
    """Whether the policy of a file is one for a task and a robot. A saved model tells only its spaces.

    Raises:
        PolicyError: the file is missing or damaged, or a saved model has observations of the task's size and other spaces.
    """
    if is_saved_model(name):
        from ballbot_train.saved_models import fits  # it imports torch

        return fits(plain(name), task, named_robot(robot))
    spec = read_description(plain(name))["spec"]
    return spec["task"] == task.problem() and spec.get("robot", PAPER) == robot


def made_for(name: str) -> str:
    """What the policy of a file was made for, in words.

    Raises:
        PolicyError: the file is missing or damaged.
    """
    if is_saved_model(name):
        from ballbot_train.saved_models import read

        return f"a task with {read(plain(name)).observations} observations"
    spec = read_description(plain(name))["spec"]
    robot = spec.get("robot", PAPER)
    return spec["task"] if robot == PAPER else f"{spec['task']} of the robot {robot}"


def policy_digest(name: str, task: Task, robot: str | BallbotParams = PAPER) -> str:
    """SHA-256 of the weights of a policy by name or file, as hexadecimal digits; "" of an expert."""
    if is_expert(name):
        return ""
    robot, name = robot if isinstance(robot, str) else robot_name(robot), plain(name)
    return weights_digest(shipped_policies(task, robot, None).get(name, name))


def task_name(policy: str, task: str | None, robot: str = PAPER) -> str:
    """The task that is named, or the registered one that a policy file names, or stabilize.

    Raises:
        ValueError: no such task.
        PolicyError: a policy file that is missing or damaged.
    """
    if task is not None:
        check_names("task", [task], TASKS)
        return task
    if not is_file(policy):
        return "stabilize"
    named = next((name for name in TASKS if is_made_for(policy, make_task(name, robot), robot)), None)
    if named is None:
        raise ValueError(
            f"{policy} was made for {made_for(policy)}, which is none of {', '.join(TASKS)} with its default fields for the "
            f"robot {robot}; give --task, or another --robot"
        )
    return named


def policy_path(name: str, task: Task, robot: str = PAPER) -> Path:
    """The file of a policy that comes with the package, or that is named by its path.

    Raises:
        ValueError: it is an expert, or nothing of that name.
    """
    shipped = shipped_policies(task, robot, None)
    if name in shipped:
        return shipped[name]
    if name in _experts().CONTROLLERS:
        raise ValueError(f"{name} is an expert, and no policy; give a policy's .json, or one of {', '.join(shipped)}")
    if not is_file(name):
        raise ValueError(f"unknown policy {name!r}; {task.id} has {', '.join(shipped)}, or give a policy's .json")
    if is_saved_model(name):
        raise ValueError(
            f"{name} is a saved model of another library; give a policy's .json, as `ballbot train` writes it"
        )
    return Path(name)


def portable(name: str, task: Task, params: BallbotParams) -> str | Controller:
    """The controller of a file, to be sent to workers that do not have the file. Other names stay names.

    Raises: as `make_controller`.
    """
    return make_controller(name, task, params) if is_file(name) else name


def make_controller(name: str, task: Task, params: BallbotParams) -> Controller:
    """The controller that a name stands for. torch is imported only for a policy.

    Args:
        name: in `CONTROLLERS` or `VARIANTS`, of a policy that comes with the package ("shac"), or the path of a policy file
            or of a model that Stable-Baselines3 saved; see `saved_models`. One of `filters(params)` may follow.
        task: what it is to do.
        params: the robot it believes to control.

    Raises:
        ValueError: nothing of that name.
        PolicyError: a policy file that is damaged or of another task.
    """
    if name in _experts().VARIANTS and params.wheels is None:
        return _experts().VARIANTS[name](task, params)
    ending = _filter_of(name)
    controller = _unfiltered(name.removesuffix(ending), task, params)
    if getattr(controller, "told", None) is not None:  # it wants to be told the robot
        ending = ending or "-adaptive"
    if not ending:
        return controller
    from ballbot_baselines.adaptive import FilteredController  # it imports CasADi

    return FilteredController(task, params, ending, controller)


def _unfiltered(name: str, task: Task, params: BallbotParams) -> Controller:
    if name in _experts().CONTROLLERS | _experts().VARIANTS:
        return (_experts().CONTROLLERS | _experts().VARIANTS)[name](task, params)
    robot = robot_name(params)
    shipped = shipped_policies(task, robot, None)
    if name not in shipped and not is_file(name):
        known = f"{task.id} has {', '.join(names(task, robot))}, or give a policy's .json"
        raise ValueError(f"unknown controller {name!r}; {of_other_robot(name, task) or known}")
    if is_saved_model(name):
        from ballbot_train.policy import PolicyController  # it imports torch
        from ballbot_train.saved_models import load_actor

        return PolicyController(task, params, load_actor(name, task, params))
    from ballbot_train.policy import load_policy

    return load_policy(shipped.get(name, name), task, params)
