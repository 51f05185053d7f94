"""The motion that is most informative about a robot, within a limit of lean.

A motion consists of circles of several frequencies. Near the upright robot everything is linear, so the information of a log
is about Σ w_f H_f: that of each frequency alone at the greatest lean, H_f, times the share w_f of its squared lean. The
logarithm of the volume of the intervals, −½ ln det(I + Σ w_f H_f), is convex in the shares. They are its minimum for
Σ w_f = 1. In the end the motion is scaled to the limit.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize

from ballbot_baselines.identification.estimate import Problem
from ballbot_baselines.identification.record import Recorded, Waves, record
from ballbot_gym.robot import Ballbot

_PERIOD = 20.0  # s
_PERIODS = (1, 2, 3, 5, 8, 12, 18, 26, 36)  # of each frequency in that time
_FIRST = 0.02  # m, the radius of the circles that are tried first
_MOST_FORCE = 0.7  # of the limit
_MOST_GROWTH = 20.0  # at once
_SCALINGS = 3


class _Designed(NamedTuple):
    """A motion, and the standard deviations that a log of it leaves."""

    motion: Waves
    lean: float
    """The greatest, rad."""
    names: tuple[str, ...]
    """Of the parameters of robot and drive."""
    deviations: np.ndarray
    """(p,) after a log of the motion, in spreads of the prior."""
    balancing: np.ndarray
    """(p,) after a log of the same length of a robot that balances in one place behind noisy sensors."""

    @property
    def ratio(self) -> float:
        """The intervals of the motion over those of balancing, as their geometric mean."""
        return float(np.exp(np.mean(np.log(self.deviations / self.balancing))))


def design(
    robot: Ballbot,
    seconds: float = 20.0,
    max_lean: float = math.radians(8),
    known: tuple[str, ...] = (),
    watch: Callable[[int, int], object] = lambda done, total: None,
) -> _Designed:
    """The motion that makes the volume of the intervals smallest.

    Args:
        robot: the nominal one, on whose model the motion is tried.
        seconds: of the log.
        max_lean: rad.
        known: same as in `Problem`.
        watch: called with the number of frequencies that are done, and that of all.

    Returns:
        motion, its greatest lean in rad, the names of the p parameters of robot and drive, their standard deviations (p,)
        after a log of the motion, in spreads of the prior, and those after balancing (p,). `ratio` compares the two.
    """
    balancing = record(robot, seconds, Waves.still(), None if robot.SENSORS else "noisy", "rk4")
    problem, count = Problem(robot, balancing.readings.names, known), len(_PERIODS)
    sizes, alone = np.zeros(count), []
    for i, share in enumerate(np.eye(count)):
        motion, made = _at_limit(robot, _FIRST * share, seconds, max_lean)
        sizes[i] = motion.amplitudes[0, i]
        alone.append(_information(problem, made))
        watch(i + 1, count)
    shares = _best_shares(np.array(alone))
    motion, made = _at_limit(robot, sizes * np.sqrt(shares), seconds, max_lean)
    of = [i for i, each in enumerate(problem.parameters) if each.unit]
    deviations = [_deviations(_information(problem, each))[of] for each in (made, balancing)]
    return _Designed(motion, made.lean, tuple(problem.parameters[i].name for i in of), *deviations)


def _at_limit(robot: Ballbot, sizes: np.ndarray, seconds: float, max_lean: float) -> tuple[Waves, Recorded]:
    """Circles of these relative sizes (k,), scaled to the greatest lean or to what the drive can do; and their log."""
    for _ in range(_SCALINGS):
        motion = _circles(sizes, robot)
        made = record(robot, seconds, motion, None, "rk4")
        force = np.abs(made.readings.commands).max()
        sizes = sizes * min(max_lean / made.lean, _MOST_FORCE * robot.force_limit / force, _MOST_GROWTH)
    return motion, made


def _circles(sizes: np.ndarray, robot: Ballbot) -> Waves:
    """Circles of these radii (k,), m, in turn to the left and to the right, whose phases keep their sum small."""
    order = np.arange(len(sizes))
    phases = -math.pi * order * (order - 1) / max(np.count_nonzero(sizes), 1)
    quarter = math.pi / 2 * (-1.0) ** order
    turn = Waves.driving(robot, np.random.default_rng(0)).amplitudes[2, 0]
    turns = turn * np.ones(len(sizes)) / math.sqrt(len(sizes))
    return Waves(
        np.array([sizes, sizes, turns]), np.array(_PERIODS) / _PERIOD, np.array([phases, phases + quarter, phases])
    )


def _information(problem: Problem, made: Recorded) -> np.ndarray:
    return problem.information([made.readings], np.zeros(len(problem.parameters)))[2]


def _deviations(h: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diag(np.linalg.inv(h + np.eye(len(h)))))


def _best_shares(alone: np.ndarray) -> np.ndarray:
    """(k,) shares w ≥ 0 with Σ w = 1 that minimize −ln det(I + Σ w_f H_f), of H (k, p, p)."""
    count, own = len(alone), np.eye(alone.shape[1])

    def volume(w: np.ndarray) -> tuple[float, np.ndarray]:
        h = own + np.tensordot(w, alone, 1)
        return -np.linalg.slogdet(h)[1], -np.einsum("fij,ji->f", alone, np.linalg.inv(h))

    found = scipy.optimize.minimize(
        volume, np.full(count, 1 / count), jac=True, method="SLSQP", bounds=[(0.0, 1.0)] * count,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1, "jac": lambda w: np.ones(count)},
    )  # fmt: skip
    return np.maximum(found.x, 0.0)
