"""Experts that know the model: linear control, trajectory optimization, and the optima everything is measured by."""

from collections.abc import Callable

from ballbot_baselines.lqr import LqrController
from ballbot_baselines.nmpc import NmpcController
from ballbot_baselines.trajopt import TrajoptController
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task

CONTROLLERS: dict[str, Callable[[Task, BallbotParams], Controller]] = {
    "lqr": LqrController,
    "trajopt": TrajoptController,
    "nmpc": NmpcController,
}
"""Every controller by its name on the command line. A new one is one file and one line here."""

__all__ = ["CONTROLLERS", "Controller"]
