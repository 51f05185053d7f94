"""Work that takes longer than a control step, such as planning, beside a simulation that goes on."""

import contextlib
import multiprocessing
import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from ballbot_gym import registry
from ballbot_gym.robots import Robot

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once


class OtherProcess:
    """Another process that calls functions, one at a time. It ends with the one that started it, however that ends.

    Threads of one process take turns at running Python. So a simulation in real time would wait for the setup of a solver.
    """

    def __init__(self) -> None:
        """Starts it. It is spawned: forking a process with threads is not safe."""
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(there, *registry.registered()), daemon=True, name="ballbot-play"
        )
        self._process.start()
        there.close()

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What the function returns there. It is named in a module, and arguments and result can be pickled.

        Raises:
            EOFError: the process has ended.
            Exception: what the function raises.
        """
        try:
            self._here.send((function, arguments))
            succeeded, value = self._here.recv()
        except OSError as error:
            raise EOFError("the other process has ended") from error
        if succeeded:
            return value
        raise value

    @property
    def pid(self) -> int | None:
        """Its number; None if it has ended."""
        return self._process.pid if self._process.is_alive() else None

    def close(self) -> None:
        """Ends it, whatever it does; may be called again."""
        self._process.terminate()
        self._process.join()


def _serve(there: Connection, modules: tuple[str, ...], robots: dict[str, Robot]) -> None:
    """What the other process does. Modules and robots are those that users registered."""
    registry.restore(modules, robots)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is for the process that started this one
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments = there.recv()
            try:
                there.send_bytes(pickle.dumps((True, function(*arguments))))
            except Exception as error:  # the one who asked decides what it means
                there.send((False, error))


class Background:
    """One thread that does jobs in the order in which they came. Solvers let the simulation run while they compute."""

    def __init__(self, other_process: bool = False):
        """Starts the thread. With another process, `compute` calls functions there."""
        self._other = OtherProcess() if other_process else None
        self._thread = ThreadPoolExecutor(1, "ballbot-play")
        self._closed = False

    def submit(self, job: Callable[[], Any]) -> Future:
        """Asks for a job. A future that is cancelled before the job begins saves it."""

        def alone() -> Any:
            with _ONE_JOB:
                return job()

        return self._thread.submit(alone)

    def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What a function returns, that may be called in another process; for jobs.

        Raises:
            Exception: what the function raises.
        """
        if self._other is None:
            return function(*arguments)
        if self._other.pid is None and not self._closed:
            self._other = OtherProcess()
        return self._other(function, *arguments)

    @property
    def other_pid(self) -> int | None:
        """The number of the other process; None if there is none."""
        return None if self._other is None else self._other.pid

    def close(self) -> None:
        """Drops all jobs, and waits for the one that is being done; may be called again."""
        self._closed = True
        self._thread.shutdown(wait=False, cancel_futures=True)
        if self._other is not None:
            self._other.close()
        self._thread.shutdown()
