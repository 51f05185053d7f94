"""Work that takes longer than a control step, such as planning, beside a simulation that goes on."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from typing import Any

from ballbot_gym import registry
from ballbot_train.executors import prepare_worker

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once


class Background:
    """One thread that does jobs in the order in which they came. Solvers let the simulation run while they compute.

    Threads of one process take turns at running Python, so a simulation in real time would wait for the setup of a solver.
    Another process can therefore do what takes long.
    """

    def __init__(self, other_process: bool = False):
        """Starts the thread. With another process, `compute` calls functions there."""
        self._other = _other_process() if other_process else None
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
            BrokenProcessPool: the other process has ended meanwhile.
            Exception: what the function raises.
        """
        if self._other is None:
            return function(*arguments)
        if self.other_pid is None and not self._closed:
            self._other = _other_process()
        return self._other.submit(function, *arguments).result()

    @property
    def other_pid(self) -> int | None:
        """The number of the other process; None if there is none."""
        return next((process.pid for process in self._processes if process.is_alive()), None)

    @property
    def _processes(self) -> list[Any]:
        """The other process, if there is one; the pool that holds it has no public way to end it."""
        return [] if self._other is None else list((self._other._processes or {}).values())

    def close(self) -> None:
        """Drops all jobs, ends the other process, and waits for the job that is being done; may be called again."""
        self._closed = True
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._other is not None:
            for process in self._processes:
                process.terminate()
            self._other.shutdown()
        self._thread.shutdown()


def _other_process() -> ProcessPoolExecutor:
    """It is spawned: forking a process with threads is not safe."""
    pool = ProcessPoolExecutor(1, get_context("spawn"), prepare_worker, registry.registered())
    pool.submit(int)  # starts it
    return pool
