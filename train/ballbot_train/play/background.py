"""Work that takes longer than a control step, such as planning, beside a simulation that goes on."""

import contextlib
import multiprocessing
import pickle
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once
_CLOSING = 30.0  # s, that `close` waits for the job that is being done


class OtherProcess:
    """Another process that calls functions, one at a time.

    Threads of one process take turns at running Python. So a simulation in real time would wait for the setup of a solver.
    """

    def __init__(self) -> None:
        """Starts it. It is spawned: forking a process with threads is not safe."""
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there,), daemon=True, name="ballbot-play")
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
            raise EOFError("the process that plans has ended") from error
        if succeeded:
            return value
        raise value

    @property
    def pid(self) -> int:
        """Its number."""
        assert self._process.pid is not None
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.is_alive()

    def close(self) -> None:
        """Ends it, whatever it does; may be called again."""
        self._process.terminate()
        self._process.join()


def _serve(there: Connection) -> None:
    """What the other process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is for the process that started this one
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments = there.recv()
            try:
                there.send_bytes(pickle.dumps((True, function(*arguments))))
            except Exception as error:  # the one who asked decides what it means
                there.send((False, error))


class Background:
    """One thread that does jobs by key, in the order in which they came. Solvers let the simulation run while they compute.

    A new job replaces an older one of the same key. So while a slider moves, only its last value is worked on. All methods
    are for the thread of the simulation, except `compute`, which is for jobs.
    """

    def __init__(self, other_process: bool = False):
        """Starts the thread. With another process, `compute` calls functions there."""
        self._other = OtherProcess() if other_process else None
        self._changed = threading.Condition()
        self._jobs: dict[str, tuple[int, Callable[[], Any]]] = {}
        self._done: dict[str, tuple[int, Any]] = {}
        self._wanted: dict[str, int] = {}
        self._count = 0
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True, name="ballbot-play")
        self._thread.start()

    def submit(self, key: str, job: Callable[[], Any]) -> None:
        """Asks for a job. What an older job of this key returns is dropped."""
        with self._changed:
            self._count += 1
            self._jobs.pop(key, None)
            self._jobs[key] = self._count, job
            self._wanted[key] = self._count
            self._changed.notify_all()

    def cancel(self, key: str) -> None:
        """Drops the job of this key and what it returns."""
        with self._changed:
            self._jobs.pop(key, None)
            self._wanted.pop(key, None)
            self._changed.notify_all()

    def finished(self) -> dict[str, Any]:
        """What the jobs that ended since the last call returned, by key. A job that raised gives its exception."""
        with self._changed:
            fresh = {key: value for key, (number, value) in self._done.items() if self._wanted.get(key) == number}
            for key in fresh:
                del self._wanted[key]
            self._done.clear()
            return fresh

    def pending(self, key: str) -> bool:
        """Whether the job of this key was asked for, and `finished` has not given its value."""
        return key in self._wanted

    def wait(self, seconds: float) -> bool:
        """Waits until every job has ended; whether that came in time."""
        with self._changed:
            return self._changed.wait_for(lambda: all(self._ended(key) for key in self._wanted), seconds)

    def compute(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """What a function returns, that may be called in another process.

        Raises:
            Exception: what the function raises.
        """
        if self._other is None:
            return function(*arguments)
        if not self._other.is_alive and not self._closed:
            self._other = OtherProcess()
        return self._other(function, *arguments)

    @property
    def other_pid(self) -> int | None:
        """The number of the other process; None if there is none."""
        return None if self._other is None else self._other.pid

    def close(self) -> None:
        """Ends the thread after the job that it does, and waits for that; may be called again."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._wanted.clear()
            self._changed.notify_all()
        if self._other is not None:
            self._other.close()
        self._thread.join(_CLOSING)

    def _ended(self, key: str) -> bool:
        return key in self._done and self._done[key][0] == self._wanted[key]

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closed)
                if self._closed:
                    return
                key = next(iter(self._jobs))
                number, job = self._jobs.pop(key)
            try:
                with _ONE_JOB:
                    value = job()
            except Exception as error:  # the simulation decides what an error means
                value = error
            with self._changed:
                if number >= self._done.get(key, (0, None))[0]:
                    self._done[key] = number, value
                self._changed.notify_all()
