"""The clock of a simulation in real time: it never builds up lag."""

import time
from collections.abc import Callable
from dataclasses import dataclass

PATIENCE = 0.25
"""s of lag that is caught up; more is given up, and the clock goes on from now."""


@dataclass
class Clock:
    """Says when steps are due. Step k is due k·dt/speed after the start, so that waiting errors do not add up.

    `speed` is simulated seconds per second, and `now` gives wall time in s.
    """

    dt: float
    speed: float = 1.0
    now: Callable[[], float] = time.perf_counter

    def __post_init__(self) -> None:
        self._next: float | None = None  # when the next step is due; None while the simulation stands still

    def stop(self) -> None:
        """Stands still, for instance in a pause. The next call of `take` starts anew."""
        self._next = None

    def take(self) -> float | None:
        """How late the step begins that is due now, s, which is then taken as begun; None where none is due."""
        now = self.now()
        self._next = now if self._next is None else self._next
        late = now - self._next
        if late < 0:
            return None
        self._next = (now if late > PATIENCE else self._next) + self.dt / self.speed
        return late

    def wait(self) -> float:
        """Seconds until the next step is due; 0 if it is due."""
        return 0.0 if self._next is None else max(0.0, self._next - self.now())
