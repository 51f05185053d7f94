"""Controllers by name: experts of `CONTROLLERS`, policies that come with the package, and policy files."""

from pathlib import Path

from ballbot_baselines import CONTROLLERS
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import TASKS, Task
from ballbot_train.console import check_names
from ballbot_train.policy_files import read_description, shipped_policies


def names(task: Task) -> list[str]:
    """The controllers that a task has, experts first."""
    return [*CONTROLLERS, *shipped_policies(task)]


def is_file(name: str) -> bool:
    """Whether a controller's name is the path of a policy file.

    Raises:
        ValueError: it is the path of a saved Stable-Baselines3 model.
    """
    if Path(name).suffix == ".zip":
        raise ValueError(
            f"{name} is a saved Stable-Baselines3 model, which does not say by which algorithm; load it and give the model: "
            f'evaluate(stable_baselines3.PPO.load("{name}"), ...)'
        )
    return name not in CONTROLLERS and bool(Path(name).suffix)


def task_name(policy: str, task: str | None) -> str:
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
    made_for = read_description(policy)["spec"]["task"]
    named = next((name for name in TASKS if make_task(name).problem() == made_for), None)
    if named is None:
        raise ValueError(
            f"{policy} was made for {made_for}, which is none of {', '.join(TASKS)} with its default fields"
        )
    return named


def policy_path(name: str, task: Task) -> Path:
    """The file of a policy that comes with the package, or that is named by its path.

    Raises:
        ValueError: it is an expert, or nothing of that name.
    """
    shipped = shipped_policies(task)
    if name in shipped:
        return shipped[name]
    if name in CONTROLLERS:
        raise ValueError(f"{name} is an expert, and no policy; give a policy's .json, or one of {', '.join(shipped)}")
    if not is_file(name):
        raise ValueError(f"unknown policy {name!r}; {task.id} has {', '.join(shipped)}, or give a policy's .json")
    return Path(name)


def make_controller(name: str, task: Task, params: BallbotParams) -> Controller:
    """The controller that a name stands for. torch is imported only for a policy.

    Args:
        name: in `CONTROLLERS`, of a policy that comes with the package ("shac"), or the path of a policy file.
        task: what it is to do.
        params: the robot it believes to control.

    Raises:
        ValueError: nothing of that name.
        PolicyError: a policy file that is damaged or of another task.
    """
    if name in CONTROLLERS:
        return CONTROLLERS[name](task, params)
    shipped = shipped_policies(task)
    if name not in shipped and not is_file(name):
        raise ValueError(
            f"unknown controller {name!r}; {task.id} has {', '.join(names(task))}, or give a policy's .json"
        )
    from ballbot_train.policy import load_policy  # it imports torch

    return load_policy(shipped.get(name, name), task, params)
