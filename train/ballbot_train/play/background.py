"""What takes longer than a control step, such as planning, beside a simulation that goes on."""

import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.controllers import is_expert, make_controller
from ballbot_train.executors import Processes, end_processes, result_of

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once
_FROM_ELSEWHERE = ("lqr", "trajopt")  # controllers that are data, so that they can come from another process


class Background:
    """One thread that does jobs in the order in which they came. Solvers let the simulation run while they compute.

    Threads of one process take turns at running Python, so a simulation in real time would wait for the setup of a solver.
    Another process can therefore do what takes long.
    """

    def __init__(self, other_process: bool = False):
        """Starts the thread. With another process, `compute` calls functions there."""
        self._other: Processes | None = None
        if other_process:
            self._start()
        self._thread = ThreadPoolExecutor(1, "ballbot-play")
        self._closed = False

    def _start(self) -> Processes:
        self._other = Processes(1)
        self._other.submit(int)  # which starts it
        return self._other

    def submit(self, job: Callable[..., Any], *arguments: Any) -> Future:
        """Asks for a job. A future that is cancelled before the job begins saves it."""

        def alone() -> Any:
            with _ONE_JOB:
                return job(*arguments)

        return self._thread.submit(alone)

    def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What a function of a module returns, that may be called in another process; for jobs.

        Raises:
            WorkerError: the other process has ended meanwhile.
            Exception: what the function raises.
        """
        if self._other is None:
            return function(*arguments)
        try:
            future = self._other.submit(function, *arguments)
        except BrokenExecutor:
            if self._closed:
                raise
            future = self._start().submit(function, *arguments)
        return result_of(future)

    def controller(self, name: str, task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> Controller:
        """For jobs: the controller of a name, at the start of an episode in state x (8,) with constants c (nc,)."""
        if name in _FROM_ELSEWHERE:
            return self.compute(_expert, name, task, params, x, c)
        controller = make_controller(name, task, params)
        if is_expert(name):
            from ballbot_baselines.nmpc import NmpcController, prepared_plan  # it imports CasADi

            if isinstance(controller, NmpcController):  # its solver stays in this process
                controller.start(0.0, c, self.compute(prepared_plan, task, params, x, c, controller.backoff))
                return controller
        controller.reset(0.0, x, c)
        return controller

    def optimum(self, task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> np.ndarray:
        """For jobs: (n + 1,) what the optimum of an episode has cost after each control step."""
        return self.compute(optimum_costs, task, params, x, c)

    def close(self) -> None:
        """Drops all jobs, ends the other process, and waits for the job that is being done; may be called again."""
        self._closed = True
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._other is not None:
            end_processes(self._other)
        self._thread.shutdown()


def optimum_costs(task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> np.ndarray:
    """As `Background.optimum`."""
    from ballbot_baselines import find_optimum

    trajectory = find_optimum(task, params, x, c, twice=True).trajectory
    rates = task.cost(tuple(trajectory.x[:-1].T), tuple(trajectory.u.T), task.at(tuple(c), trajectory.t[:-1]))
    return np.concatenate([[0.0], np.cumsum(rates * task.control_dt)])


def _expert(name: str, task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> Controller:
    """An expert at the start of an episode."""
    controller = CONTROLLERS[name](task, params)
    controller.reset(0.0, x, c)
    return controller
