"""Controllers by name: experts of `CONTROLLERS`, policies that come with the package, and policy files."""

from pathlib import Path

from ballbot_baselines import CONTROLLERS
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task
from ballbot_train.policy import load_policy, shipped_policies


def names(task: Task) -> list[str]:
    """The controllers that a task has, experts first."""
    return [*CONTROLLERS, *shipped_policies(task)]


def make_controller(name: str, task: Task, params: BallbotParams) -> Controller:
    """The controller that a name stands for.

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
    if name in (shipped := shipped_policies(task)):
        return load_policy(shipped[name], task, params)
    if not Path(name).suffix:
        raise ValueError(
            f"unknown controller {name!r}; {task.id} has {', '.join(names(task))}, or give a policy's .json"
        )
    return load_policy(name, task, params)
