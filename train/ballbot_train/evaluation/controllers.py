"""Controllers by name: experts of `CONTROLLERS`, policies that come with the package, and policy files."""

from pathlib import Path

from ballbot_baselines import CONTROLLERS
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task
from ballbot_train.policy_files import shipped_policies


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
