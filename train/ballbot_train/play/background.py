"""Work that takes longer than a control step, such as planning, beside a simulation that goes on."""

import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from typing import Any

from ballbot_train.executors import end_process, worker_process

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once


class Background:
    """One thread that does jobs in the order in which they came. Solvers let the simulation run while they compute.

    Threads of one process take turns at running Python, so a simulation in real time would wait for the setup of a solver.
    Another process can therefore do what takes long.
    """

    def __init__(self, other_process: bool = False):
        """Starts the thread. With another process, `compute` calls functions there."""
        self._other = worker_process() if other_process else None
        if self._other is not None:
            self._other.submit(int)  # which starts it
        self._thread = ThreadPoolExecutor(1, "ballbot-play")
        self._closed = False

    def submit(self, job: Callable[[], Any]) -> Future:
        """Asks for a job. A future that is cancelled before the job begins saves it."""

        def alone() -> Any:
            with _ONE_JOB:
                return job()

        return self._thread.submit(alone)

    def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What a function of a module returns, that may be called in another process; for jobs.

        Raises:
            BrokenExecutor: the other process has ended meanwhile.
            Exception: what the function raises.
        """
        if self._other is None:
            return function(*arguments)
        try:
            future = self._other.submit(function, *arguments)
        except BrokenExecutor:
            if self._closed:
                raise
            self._other = worker_process()
            future = self._other.submit(function, *arguments)
        return future.result()

    def close(self) -> None:
        """Drops all jobs, ends the other process, and waits for the job that is being done; may be called again."""
        self._closed = True
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._other is not None:
            end_process(self._other)
        self._thread.shutdown()
