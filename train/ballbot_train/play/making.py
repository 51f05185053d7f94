"""How the controllers of the playground are made. All of this takes long, so that it is done in the background."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_train.evaluation.controllers import is_expert, make_controller
from ballbot_train.play.driving import DRIVERS, DriveController, Stick
from ballbot_train.play.tunable import Tunable

_FROM_ELSEWHERE = ("lqr", "trajopt")  # controllers that are data, so that they can come from another process


def make(
    name: str,
    task: Tunable,
    params: BallbotParams,
    x: np.ndarray,
    c: np.ndarray,
    stick: Stick,
    compute: Callable[..., Any],
) -> Controller:
    """The controller of a name, at the start of an episode in state x (8,) with constants c (nc,) of the tunable task.

    What takes long is called by `compute`, that may have another process do it.
    """
    if name in DRIVERS:
        return DriveController(task, params, stick, DRIVERS[name])
    if name in _FROM_ELSEWHERE:
        return compute(_expert, name, task, params, x, c)
    if not is_expert(name):
        controller = make_controller(name, task.base, params)
        controller.reset(0.0, x, c[: len(task.base.constant_names)])
        return controller
    from ballbot_baselines.nmpc import NmpcController, prepared_plan  # it imports CasADi

    controller = make_controller(name, task, params)
    if isinstance(controller, NmpcController):  # its solver stays in this process
        controller.start(0.0, c, compute(prepared_plan, task, params, x, c, controller.backoff))
    else:
        controller.reset(0.0, x, c)
    return controller


def optimum_costs(task: Tunable, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(n + 1,) what the optimum has cost after each control step."""
    from ballbot_baselines import find_optimum

    trajectory = find_optimum(task, params, x, c).trajectory
    rates = task.cost(tuple(trajectory.x[:-1].T), tuple(trajectory.u.T), tuple(c))
    return np.concatenate([[0.0], np.cumsum(rates * task.control_dt)])


def _expert(name: str, task: Tunable, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> Controller:
    """An expert at the start of an episode."""
    controller = CONTROLLERS[name](task, params)
    controller.reset(0.0, x, c)
    return controller
