"""What takes longer than a control step, such as planning, beside a simulation that goes on."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.controllers import make_controller

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once


class Background:
    """One thread that does jobs in the order in which they came. Solvers let the simulation run while they compute."""

    def __init__(self):
        self._thread = ThreadPoolExecutor(1, "ballbot-play")

    def submit(self, job: Callable[..., Any], *arguments: Any) -> Future:
        """Asks for a job. A future that is cancelled before the job begins saves it."""

        def alone() -> Any:
            with _ONE_JOB:
                return job(*arguments)

        return self._thread.submit(alone)

    def close(self) -> None:
        """Drops all jobs, and waits for the one that is being done; may be called again."""
        self._thread.shutdown(cancel_futures=True)


def begun(name: str, task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> Controller:
    """The controller of a name, at the start of an episode in state x (8,) with constants c (nc,)."""
    controller = make_controller(name, task, params)
    controller.reset(0.0, x, c)
    return controller


def optimum_costs(task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(n + 1,) what the optimum of an episode has cost after each control step."""
    from ballbot_baselines import find_optimum

    trajectory = find_optimum(task, params, x, c, twice=True).trajectory
    rates = task.cost(tuple(trajectory.x[:-1].T), tuple(trajectory.u.T), task.at(tuple(c), trajectory.t[:-1]))
    return np.concatenate([[0.0], np.cumsum(rates * task.control_dt)])
