"""Whether a log is of the robot that it is said to be of: columns with a wrong sign or unit, and errors of predictions."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ballbot_baselines.identification.estimate import Problem
from ballbot_baselines.identification.likelihood import Innovations, Readings

HORIZONS = (0.1, 0.5, 1.0)
"""How far ahead motions are predicted, s."""
_SECONDS = 15.0  # of a log that are enough to judge signs and units
_LOUDER, _LOOSER = 2.0, 4.0  # times the noise and drift that estimates start from: the robot is not the nominal one
_FAR_LOOSER = 40.0  # the same of a robot that is far from the nominal one
_CLEAR = 0.1  # how much likelier a log must be with another sign or unit, per time, as a logarithm
_MOST = 50.0  # of a squared innovation over its variance: one that is wrong may be wrong without bounds
_NONSENSE = 10.0  # mean of a squared innovation over its variance, plus the variance's logarithm
_NEARLY = 0.8  # of the gain of the best explanation
_UNITS = {
    180 / math.pi: "is in rad, where deg is said",
    math.pi / 180: "is in deg, where rad is said",
    1e3: "is a thousand times too small",
    1e-3: "is a thousand times too large",
}
_STARTS = 0.1  # s between the starts of predictions
_BEGIN = 1.0  # s that a filter has to find the state


class _Suspicion(NamedTuple):
    """What may be wrong with some columns: all of them would have to be multiplied by the factor."""

    names: tuple[str, ...]
    factor: float


class Suspect(NamedTuple):
    """Columns that are wrong, judged from the log alone."""

    names: tuple[str, ...]
    fault: str
    others: tuple[tuple[str, ...], ...]
    """Other columns: if they had this fault, that would explain the log nearly as well."""

    @classmethod
    def found(cls, problem: Problem, readings: Readings) -> "Suspect | None":
        """The columns whose sign or unit is wrong; None where all are right.

        Raises:
            ValueError: the robot explains the log with no sign or unit.
        """
        # The log is multiplied by factors, so its likelihood is that of the corrected log times the factors.
        last = int(np.searchsorted(readings.t, readings.t[0] + _SECONDS))
        part = readings.between(0, last)
        columns = (*readings.names, *Readings.commanded(problem.robot))
        suspicions = [_Suspicion((), 1.0), *_suspicions(columns)]
        factors = np.array([[each.factor if name in each.names else 1.0 for name in columns] for each in suspicions])
        misfit = _misfits(problem, part, factors, _LOOSER)
        gains = _gains(part, factors, misfit)
        best = int(np.argmax(gains))
        if misfit[:, best].mean() > _NONSENSE:
            raise ValueError(
                "the readings contradict each other and the commands, whatever their signs and units: this is no log of such "
                "a robot, or its columns are something else"
            )
        if gains[best] < _CLEAR * last or _explained_by_drift(problem, part, factors[[0, best]]):
            return None
        near = [int(i) for i in np.flatnonzero(gains > _NEARLY * gains[best])]
        first = min(near, key=lambda i: (len(suspicions[i].names), -gains[i]))
        names, factor = suspicions[first]
        others = tuple(
            each.names
            for each in (suspicions[i] for i in near)
            if each.factor == factor and not set(names) & set(each.names)
        )
        return cls(names, "has the wrong sign" if factor == -1 else _UNITS[factor], others)


def _misfits(problem: Problem, part: Readings, factors: np.ndarray, looser: float) -> np.ndarray:
    """(n, B, m) −2 log-likelihoods of readings, without a constant, where readings and commands are multiplied by factors
    (B, m + k), and the nominal robot drifts more than estimates start from.
    """
    lanes = problem.lanes(np.zeros((len(factors), len(problem.parameters))))
    # with unknown forces a filter would not care about commands
    lanes = lanes._replace(noise=_LOUDER * lanes.noise, drift=lanes.drift * [looser, looser, 0.0])
    with np.errstate(all="ignore"):  # of filters that fail
        found = Innovations.of(problem.robot, part, lanes, factors)
        fails = ~(np.isfinite(found.missed) & (found.variance > 0) & (found.variance < np.inf))
        variance = np.where(fails, 1.0, found.variance)
        return np.where(fails, _MOST, np.minimum(found.missed**2 / variance, _MOST) + np.log(variance))


def _gains(part: Readings, factors: np.ndarray, misfit: np.ndarray) -> np.ndarray:
    """(B,) by how much the log-likelihood of a log multiplied by factors (B, m + k) exceeds that of the first of them."""
    changed = np.log(np.abs(factors[:, : len(part.names)])) @ np.isfinite(part.y).sum(axis=0)
    scores = -0.5 * misfit.sum(axis=(0, 2)) + changed
    return scores - scores[0]


def _explained_by_drift(problem: Problem, part: Readings, factors: np.ndarray) -> bool:
    """Whether a log that is multiplied by the second factors (2, m + k) is likelier than as it is because its robot is far
    from the nominal one: where the filter trusts the nominal robot less, it is not.
    """
    gains = _gains(part, factors, _misfits(problem, part, factors, _FAR_LOOSER))
    return bool(gains[1] < _CLEAR * len(part.t))


def _suspicions(columns: tuple[str, ...]) -> Iterator[_Suspicion]:
    kind_of = Readings.group_of
    groups: dict[tuple[str, ...], None] = {(name,): None for name in columns}
    for wanted in (
        *(lambda name, kind=kind: kind_of(name) == kind for kind in dict.fromkeys(map(kind_of, columns))),
        *(lambda name, axis=axis: name in (f"lean_{axis}", f"lean_rate_{axis}") for axis in "xy"),
        *(lambda name, axis=axis: name in (f"position_{axis}", f"speed_{axis}") for axis in "xy"),
        lambda name: kind_of(name) in ("lean", "lean_rate", "gyro"),
        lambda name: kind_of(name) in ("position", "speed", "wheel_speed", "wheel_angle"),
    ):
        groups[tuple(name for name in columns if wanted(name))] = None
    for names in filter(None, groups):
        yield _Suspicion(names, -1.0)
        if not any(name.startswith("command") for name in names):
            for factor in _UNITS:
                yield _Suspicion(names, factor)


class Predictions(NamedTuple):
    """Median sizes of the errors of predicted readings."""

    groups: tuple[str, ...]
    """Kinds of readings, such as "lean"."""
    horizons: tuple[float, ...]
    """s."""
    errors: np.ndarray
    """(B, groups, horizons) of B robots, in the unit of the readings; NaN where the log is too short."""
    constant: np.ndarray
    """(groups, horizons) of the prediction that nothing changes."""

    @classmethod
    def of(cls, problem: Problem, z: np.ndarray, readings: Readings) -> "Predictions":
        """Errors of what B robots predict of a log from the states that their filters find, with the commands of the log.

        Args:
            problem: of the log.
            z: (B, p) the robots, their drives and their sensors.
            readings: a part of a log that was held back.
        """
        lanes, dt = problem.lanes(z), readings.dt
        found, forces = Innovations.of(problem.robot, readings, lanes), lanes.applied(readings)
        steps = [max(1, round(horizon / dt)) for horizon in HORIZONS]
        reached, starts = _starts(readings, steps)
        errors = np.full((len(z), len(HORIZONS), len(readings.names)), np.nan)
        for lane in range(len(z) if reached else 0):
            values = {name: float(value[0]) for name, value in problem.values(z[lane : lane + 1]).items()}
            robot = problem.robot_of(values)
            later = readings.predicted(robot, found.states[starts, lane], forces[:, lane], starts, reached)
            for i, step in enumerate(reached):
                wrong = later[i] + lanes.bias[lane] - readings.y[starts + step]
                errors[lane, i] = _medians(np.abs(wrong))
        constant = np.full(errors.shape[1:], np.nan)
        for i, step in enumerate(reached):
            constant[i] = _medians(np.abs(readings.y[starts + step] - readings.y[starts]))
        groups = tuple(dict.fromkeys(map(Readings.group_of, readings.names)))
        members = [[i for i, name in enumerate(readings.names) if readings.group_of(name) == group] for group in groups]
        together = [np.sqrt(np.mean(np.stack([*errors, constant])[..., own] ** 2, axis=-1)) for own in members]
        *own, constant = np.stack(together, axis=1)
        return cls(groups, HORIZONS, np.array(own), constant)


def _starts(readings: Readings, steps: list[int]) -> tuple[list[int], np.ndarray]:
    """Those of the numbers of steps, growing, over which a log is long enough to predict, and the starts of predictions."""
    dt, restarts = readings.dt, np.array(readings.restarts, dtype=int)
    begin = _BEGIN / dt
    for count in range(len(steps), 0, -1):
        last = steps[count - 1]
        starts = np.arange(round(begin), len(readings.t) - last, max(1, round(_STARTS / dt)))
        starts = starts[[not ((restarts > i - begin) & (restarts <= i + last)).any() for i in starts]]
        if len(starts):
            return steps[:count], starts
    return [], np.zeros(0, dtype=int)


def _medians(sizes: np.ndarray) -> np.ndarray:
    """(m,) medians of sizes (s, m), some of which are NaN; NaN where all are."""
    known = ~np.isnan(sizes).all(axis=0)
    return np.where(known, np.nanmedian(np.where(known, sizes, 0.0), axis=0), np.nan)
