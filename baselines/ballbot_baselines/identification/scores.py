"""The regret of the controller that made a log, in the parts of the log that are episodes of Stabilize.

Such a part begins away from rest, or is about to, and ends at rest. Its origin is the place where it ends, so that a robot
that drives from one place to another, or recovers from a push, has performed an episode. The world is turned so that a robot
with wheels ends with a heading of 0: a log does not say which heading was asked for, and gyroscope and wheels only show by
how much a heading changes. States are those that the filter finds, and forces those that the identified robot applies. The
optimum has no delay and no noise.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ballbot_baselines.identification.estimate import Found
from ballbot_baselines.identification.likelihood import Innovations, Readings
from ballbot_baselines.optimum.measured import regret
from ballbot_gym.env import make_task
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Stabilize
from ballbot_gym.trajectory import Trajectory

_AWAKE = 1.0  # s at the begin of a log, and after gaps, in which filters find the state
_RESTING = 0.5  # s at rest that end an episode
_AWAY = 0.2  # m, or that many m/s or rad, by which an episode must begin away from rest
_LONGEST, _SHORTEST = 8.0, 1.5  # s
_PLACE = slice(0, 2)
_HEADING = 8  # of a state of a robot with wheels


class _Score(NamedTuple):
    """An episode that a log contains."""

    begin: float
    """s, on the clock of the log."""
    duration: float
    """s."""
    cost: float
    optimum: float
    """Cost of the best motion from the same state."""

    @property
    def regret(self) -> float:
        return self.cost / self.optimum - 1


def _scores(found: Found, readings: Readings, most: int = 3) -> list[_Score]:
    """The episodes of Stabilize in a log, those that begin farthest from rest first.

    Args:
        found: the robot that was identified.
        readings: of the whole log.
        most: episodes that are scored at most, because each needs an optimum.
    """
    lanes = found.problem.lanes(found.z[None])
    states = Innovations.of(found.problem.robot, readings, lanes).states[:, 0, : found.robot.state_size]
    forces, dt = lanes.applied(readings)[:, 0], readings.dt
    parts = sorted(_parts(readings, states, dt), key=lambda part: -_distance(states[part.start], states[part.stop]))
    scores, usual = [], make_task("stabilize", found.problem.robot)
    for part in parts[:most]:
        x, t = states[part.start : part.stop + 1], readings.t[part.start : part.stop + 1]
        rest = round(_RESTING / dt)
        x = _from_the_end(x, rest)
        limit = found.robot.force_limit
        held = np.clip(forces[part.start : part.stop], -limit, limit)
        duration = usual.control_dt * int((t[-1] - t[0]) / usual.control_dt)
        task = replace(usual, duration=duration)
        try:
            measured = regret(Trajectory(t - t[0], x, held), task, found.robot)
        except (ValueError, PlanError):  # it begins beyond a limit, or no optimum is found
            continue
        if measured.success:
            scores.append(_Score(float(t[0]), float(task.duration), measured.cost, measured.optimum.cost))
    return scores


def _parts(readings: Readings, states: np.ndarray, dt: float) -> Iterator[slice]:
    """Indices of the first and the last state of each part that begins away from rest and ends at rest."""
    rest, awake = round(_RESTING / dt), round(_AWAKE / dt)
    resting = np.all(np.stack(np.broadcast_arrays(*Stabilize.at_rest(states)[1:])) <= 0, axis=0)
    # at rest for a while: the count of readings at rest among the last ones is all of them
    count = np.convolve(resting, np.ones(rest), mode="full")[: len(resting)]
    ends = np.flatnonzero((count >= rest) & (np.append(0, count[:-1]) < rest))
    first, longest = awake, round(_LONGEST / dt)
    restarts = np.array(readings.restarts, dtype=int)
    for end in ends.tolist():
        begin = max(first, end - longest)
        later = np.flatnonzero(~resting[end:])
        leaves = end + int(later[0]) if len(later) else len(states)
        begun = np.flatnonzero(~resting[begin:end])
        if len(begun):
            begin += int(begun[0])
            stop = min(leaves - 1, begin + longest)  # as long as it stays at rest
            whole = not ((restarts > begin - awake) & (restarts <= stop)).any()
            long = readings.t[stop] - readings.t[begin] >= _SHORTEST
            if whole and long and _distance(states[begin], states[stop]) > _AWAY:
                yield slice(begin, stop)
        first = leaves


def _from_the_end(x: np.ndarray, rest: int) -> np.ndarray:
    """States (n, s) in a world whose origin and heading are the median ones of the last `rest` states."""
    x = x.copy()
    x[:, _PLACE] -= np.median(x[-rest:, _PLACE], axis=0)
    return _turned(x, -float(np.median(x[-rest:, _HEADING]))) if x.shape[1] > _HEADING else x


def _turned(x: np.ndarray, angle: float) -> np.ndarray:
    """States (n, 11) after the whole robot is turned about the vertical through the origin, rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    about = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    place, _, speed, rates, heading, spin = np.split(x, [2, 4, 6, 8, 10], axis=1)
    before = _lean_frames(x[:, 2], x[:, 3])
    axis = before[:, :, 2] @ about.T
    gamma, theta = np.arctan2(axis[:, 0], axis[:, 2]), np.arcsin(axis[:, 1])
    change = np.swapaxes(_lean_frames(gamma, theta), 1, 2) @ about @ before  # from the old frame to the new one
    psi = heading[:, 0] + np.arctan2(change[:, 1, 0], change[:, 0, 0])
    # the turning of the body, in the frames of the leans
    lean, other = np.cos(x[:, 3]) * rates[:, 0], np.sin(x[:, 3]) * rates[:, 0] + heading[:, 1]
    turning = np.einsum("nij,nj->ni", change, np.column_stack([-rates[:, 1], lean, other]))
    gamma_rate = turning[:, 1] / np.cos(theta)
    psi_rate = turning[:, 2] - np.sin(theta) * gamma_rate
    moved = place @ about[:2, :2].T, gamma, theta, speed @ about[:2, :2].T, gamma_rate, -turning[:, 0], psi, psi_rate
    return np.column_stack([*moved, spin])


def _lean_frames(gamma: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(n, 3, 3) axes of the frames that lean, in columns; see `ballbot_gym.robot.omni`."""
    sin_g, cos_g, sin_t, cos_t, zero = np.sin(gamma), np.cos(gamma), np.sin(theta), np.cos(theta), 0.0 * gamma
    rows = (cos_g, -sin_g * sin_t, sin_g * cos_t), (zero, cos_t, sin_t), (-sin_g, -cos_g * sin_t, cos_g * cos_t)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def _distance(x: np.ndarray, end: np.ndarray) -> float:
    """How far a state is from rest at the place of another."""
    return float(max(np.hypot(*(x[_PLACE] - end[_PLACE])), np.abs(x[2:6]).max()))
