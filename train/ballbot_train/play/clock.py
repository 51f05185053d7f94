"""The clock of a simulation in real time: it never builds up lag, and it says how late steps are."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

LATE = 0.020
"""s: a step that comes later than this after its time counts as late."""
_PATIENCE = 0.25  # s of lag that is caught up; more is given up, and the clock goes on from now


@dataclass
class Timing:
    """How well the simulation kept real time."""

    steps: int = 0
    late: int = 0
    """Steps that began more than `LATE` after their time."""
    worst: float = 0.0
    """s, the longest that a step began after its time."""
    lost: float = 0.0
    """s of wall time that were given up."""
    elapsed: float = 0.0
    """s of wall time in which the simulation ran."""

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall time, both at speed 1; 1 at best."""
        return (self.elapsed - self.lost) / self.elapsed if self.elapsed > 0 else 1.0

    @property
    def late_share(self) -> float:
        """The share of late steps."""
        return self.late / self.steps if self.steps else 0.0


@dataclass
class Clock:
    """Says when steps are due. Step k is due k·dt/speed after the start, so that waiting errors do not add up.

    `speed` is simulated seconds per second, and `now` gives wall time in s.
    """

    dt: float
    speed: float = 1.0
    now: Callable[[], float] = time.perf_counter
    timing: Timing = field(default_factory=Timing)

    def __post_init__(self) -> None:
        self._next: float | None = None  # when the next step is due; None while the simulation stands still
        self._last = 0.0

    def stop(self) -> None:
        """Stands still, for instance in a pause. The next call of `take` starts anew."""
        self._next = None

    def take(self) -> bool:
        """Whether a step is due now. It is then taken as begun."""
        now = self.now()
        if self._next is None:
            self._next = self._last = now
        timing, lateness = self.timing, now - self._next
        timing.elapsed += now - self._last
        self._last = now
        if lateness < 0:
            return False
        timing.steps += 1
        timing.late += lateness > LATE
        timing.worst = max(timing.worst, lateness)
        if lateness > _PATIENCE:
            timing.lost += lateness
            self._next = now
        self._next += self.dt / self.speed
        return True

    def wait(self) -> float:
        """Seconds until the next step is due; 0 if it is due."""
        return 0.0 if self._next is None else max(0.0, self._next - self.now())
