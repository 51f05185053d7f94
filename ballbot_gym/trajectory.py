"""Trajectory: states and forces over time, with interpolation and a file format; and how motions show themselves."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import files, lazy
from ballbot_gym.robot import Ballbot, Robot, tilt
from ballbot_gym.tasks.paths import hermite_basis

MAX_SAMPLES = 1_000_000
"""Times that `Trajectory.resampled` gives at most."""


class TrajectoryError(ValueError):
    """The arrays of a trajectory do not fit together, or a file holds no trajectory."""


class Displayed:
    """An object that notebooks display as a line of facts."""

    def facts(self) -> dict[str, str]:
        """The facts, by name: numbers with their units, as text."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name} {value}' for name, value in self.facts().items())})"


class Moving(Displayed):
    """The methods `show` and `plot` of everything that contains a motion: trajectories, episodes and optima.

    `ballbot_train.report` draws replays and figures, and is imported when one of these methods is called.
    """

    @property
    def motion(self) -> "Trajectory":
        """The motion that is shown."""
        return getattr(self, "trajectory")  # noqa: B009 (a field of the subclasses)

    def show(self, *others: "Moving", labels: Sequence[str] = (), robot: str | Robot = "paper") -> Path | None:
        """The replay in 3D: in a Jupyter notebook below the cell, elsewhere in the browser.

        Args:
            others: trajectories, episodes or optima to show next to it.
            labels: a name for each motion; default, its kind.
            robot: the robot that is drawn, a name in `ROBOTS` or its parameters.

        Returns:
            The page that was written and opened; None in a notebook.

        Raises:
            ModuleNotFoundError: the extra that draws is not installed; the message names it.
            ValueError: no such robot, another number of labels, or a single state, in which nothing moves.
        """
        return lazy.load("ballbot_train.report.notebook:show_motions")((self, *others), labels, robot)

    def plot(self, *others: "Moving", labels: Sequence[str] = ()) -> Any:
        """A matplotlib Figure of positions, velocities, leans, forces and the path. For arguments and errors see `show`."""
        return lazy.load("ballbot_train.report.notebook:plot_motions")((self, *others), labels)


@dataclass(frozen=True, repr=False)
class Trajectory(Moving):
    """States at increasing times, with what the actuators apply between them.

    t: (N+1,) s. x: (N+1, n); order and units in the robot's `STATE`. u: (N, m), as `ACTION` names it, where each is held
    until the next time, or (N+1, m) where it runs linearly between times. xdot: (N+1, n) slopes of x, if known: with them
    x is interpolated by cubics, else linearly.

    Raises:
        TrajectoryError: shapes that do not fit, times that do not increase, or values that are not finite.
    """

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    xdot: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("t", "x", "u", "xdot"):
            value = getattr(self, name)
            if value is not None:
                try:
                    object.__setattr__(self, name, files.numbers(value, name))
                except ValueError as error:
                    raise TrajectoryError(str(error)) from None
        n = self.t.size - 1
        if n < 0 or self.t.shape != (n + 1,) or self.x.ndim != 2 or len(self.x) != n + 1 or not self.x.shape[1]:
            raise TrajectoryError(f"t {self.t.shape} and x {self.x.shape} must be (N+1,) and (N+1, n)")
        if self.u.ndim != 2 or len(self.u) not in (n, n + 1) or not self.u.shape[1]:
            raise TrajectoryError(f"u {self.u.shape} must be ({n}, m) for held forces, or ({n + 1}, m) for linear ones")
        if self.xdot is not None and self.xdot.shape != self.x.shape:
            raise TrajectoryError(f"xdot {self.xdot.shape} must have the shape of x, {self.x.shape}")
        if not (np.diff(self.t) > 0).all():
            raise TrajectoryError("times must increase")

    @property
    def motion(self) -> "Trajectory":
        """Itself."""
        return self

    def facts(self) -> dict[str, str]:
        facts = {"duration": f"{self.duration:.2f} s", "states": f"{len(self.t)}"}
        if self.is_of_ballbot:
            facts["peak tilt"] = f"{np.degrees(self.tilt.max()):.1f}°"
            facts["peak speed"] = f"{np.hypot(self.x[:, 4], self.x[:, 5]).max():.2f} m/s"
        return facts | {"peak force": f"{np.linalg.norm(self.u, axis=1).max(initial=0.0):.0f} N"}

    @property
    def is_of_ballbot(self) -> bool:
        """Whether states begin with the eight components of `Ballbot.STATE`, and actions are two or three forces."""
        return self.x.shape[1] >= len(Ballbot.STATE) and self.u.shape[1] in (2, 3)

    @property
    def duration(self) -> float:
        """In s."""
        return float(self.t[-1] - self.t[0])

    @property
    def held(self) -> bool:
        """Whether forces are held between times, rather than linear."""
        return len(self.u) == len(self.t) - 1

    @property
    def tilt(self) -> np.ndarray:
        """(N+1,) angle between the body's axis and the vertical, rad; NaN of robots other than ballbots."""
        return tilt(self.x) if self.is_of_ballbot else np.full(len(self.x), np.nan)

    def state(self, t: float) -> np.ndarray:
        """x(t), (8,). Before the start it is the first state, after the end the last one."""
        i, fraction = self._locate(t)
        if i == len(self.t) - 1:
            return self.x[-1].copy()
        a, b = self.x[i], self.x[i + 1]
        if self.xdot is None:
            return a + fraction * (b - a)
        h = self.t[i + 1] - self.t[i]
        slope_a, slope_b = h * self.xdot[i], h * self.xdot[i + 1]
        start, start_slope, end, end_slope = hermite_basis(fraction)
        return start * a + start_slope * slope_a + end * b + end_slope * slope_b

    def force(self, t: float) -> np.ndarray:
        """u(t), (2,) N. Before the start it is the first force, after the end the last one."""
        i, fraction = self._locate(t)
        if self.held:
            return self.u[min(i, len(self.u) - 1)].copy()
        if i == len(self.t) - 1:
            return self.u[-1].copy()
        return self.u[i] + fraction * (self.u[i + 1] - self.u[i])

    def states_until(self, t: float) -> np.ndarray:
        """(n, 8) the states until time t."""
        return np.concatenate([self.x[self.t < t], self.state(t)[None]])

    def _locate(self, t: float) -> tuple[int, float]:
        """The interval that contains t, and the fraction of it before t; (N, 0) at the end."""
        if t >= self.t[-1]:
            return len(self.t) - 1, 0.0
        i = max(0, int(np.searchsorted(self.t, t, side="right")) - 1)
        return i, max(0.0, (t - self.t[i]) / (self.t[i + 1] - self.t[i]))

    def resampled(self, dt: float) -> "Trajectory":
        """The interpolated states and forces every dt s, with linear forces. For figures and comparisons.

        Raises:
            TrajectoryError: these are more than `MAX_SAMPLES` times.
        """
        if not (dt > 0 and self.duration / dt <= MAX_SAMPLES):
            raise TrajectoryError(f"{self.duration:g} s every {dt:g} s are more than {MAX_SAMPLES:,} times")
        times = np.append(np.arange(self.t[0], self.t[-1], dt), self.t[-1])
        times = times[np.concatenate([[True], np.diff(times) > 1e-9])]
        return Trajectory(times, np.array([self.state(t) for t in times]), np.array([self.force(t) for t in times]))

    def save(self, path: str | Path) -> Path:
        """Writes an .npz file of the arrays. A reader never sees half of it."""
        arrays = {"t": self.t, "x": self.x, "u": self.u}
        if self.xdot is not None:
            arrays["xdot"] = self.xdot
        return files.write(path, files.npz(arrays))

    @classmethod
    def load(cls, path: str | Path) -> "Trajectory":
        """Reads what `save` wrote.

        Raises:
            TrajectoryError: the file is no trajectory.
        """
        try:
            arrays = files.read_npz(path)
            missing = [name for name in ("t", "x", "u") if name not in arrays]
            if missing:
                raise TrajectoryError(f"it has no array {', '.join(missing)}")
            return cls(**{name: arrays[name] for name in ("t", "x", "u", "xdot") if name in arrays})
        except ValueError as error:
            raise TrajectoryError(f"{path}: not a trajectory file: {error}") from error
