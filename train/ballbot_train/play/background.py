"""Work that takes longer than a control step, such as planning, beside a simulation that goes on."""

import threading
from collections.abc import Callable
from typing import Any

_ONE_JOB = threading.Lock()  # solvers are kept for reuse, and none may be used by two threads at once
_CLOSING = 30.0  # s, that `close` waits for the job that is being done


class Background:
    """One thread that does jobs by key, in the order in which they came. Solvers let the simulation run while they compute.

    A new job replaces an older one of the same key. So while a slider moves, only its last value is worked on. All methods
    are for the thread of the simulation.
    """

    def __init__(self) -> None:
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

    def close(self) -> None:
        """Ends the thread after the job that it does, and waits for that; may be called again."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._wanted.clear()
            self._changed.notify_all()
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
