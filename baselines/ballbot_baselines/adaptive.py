"""NMPC behind a filter: for robots, delays and sensors that nobody told it.

`TrackFilter` estimates the state, the robot and the delay. NMPC with the estimated robot acts on the state in which its
force will begin to act. Where the estimate has moved far from the robot that the episode was planned for, the rest of the
episode is planned anew, from the present state. That takes longer than a control step.

What friction the floor has is not seen before the robot slips, so plans take the least of the track.
"""

import contextlib
from dataclasses import replace

import numpy as np

from ballbot_baselines.kalman import TrackFilter
from ballbot_baselines.nmpc import BACKOFF, NmpcController
from ballbot_baselines.shooting import Backoff
from ballbot_gym import dynamics
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import TRACKS, Randomization
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task

_MOVED = 0.02  # of a factor of the robot, and at least twice its deviation: then the episode is planned anew
_NOISY_BACKOFF = Backoff(margin=0.03, goal=0.2, force=0.02, grip=0.1)  # with room for errors of the estimate


class AdaptiveNmpcController:
    """NMPC for a track: it knows what may vary and how far, and estimates what was drawn.

    | attribute | meaning |
    |---|---|
    | `filter` | the estimate |
    | `nmpc` | what acts on it; made anew with each plan |
    | `plans` | how many plans were made in the episode |
    """

    def __init__(self, task: Task, params: BallbotParams, track: Randomization, backoff: Backoff = BACKOFF):
        self._task, self._params, self._track, self._backoff = task, params, track, backoff
        self.filter = TrackFilter(task, params, track)

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._c, self._start, self.plans = c, t, 0
        self.filter.reset(x)
        self._plan(t)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        if t > self._start:
            self.filter.update(t - self._start, x, self._u)
            moved = np.abs(self.filter.factors - self._factors) > np.maximum(_MOVED, 2 * self.filter.deviations)
            if self.filter.delay != self._delay or moved.any():
                with contextlib.suppress(PlanError):  # the plan before is followed
                    self._plan(t)
        robot = self.filter.robot
        self.nmpc.adapt(robot)
        limit = self._params.force_limit
        # the robot applies a share of what it is asked for
        u = self.nmpc.act(*self._when_free(t)) * limit / robot.force_limit
        self._u = np.clip(u, -limit, limit)
        return self._u

    def _plan(self, t: float) -> None:
        """Plans the rest of the episode for the estimated robot from the state in which the next force begins to act."""
        self._factors, self._delay = self.filter.factors, self.filter.delay
        nmpc = NmpcController(self._task, self.filter.robot, backoff=self._backoff)
        nmpc.reset(*self._when_free(t), self._c)
        self.nmpc, self.plans = nmpc, self.plans + 1

    def _when_free(self, t: float) -> tuple[float, np.ndarray]:
        """When the next command will begin to act, s, and the state (8,) then."""
        x, dt, robot = self.filter.x, self._task.control_dt, self.filter.robot
        share = robot.force_limit / self._params.force_limit
        for u in self.filter.under_way:
            x = np.asarray(dynamics.step(robot, x, share * u, dt, dynamics.substeps_for(dt)))
        return t + dt * self.filter.delay, x


def adaptive_nmpc(task: Task, params: BallbotParams) -> AdaptiveNmpcController:
    """For the tracks "unknown" and "late", whose sensors are exact."""
    return AdaptiveNmpcController(
        task, params, replace(TRACKS["unknown"], actuator_delay=TRACKS["late"].actuator_delay)
    )


def filtered_nmpc(task: Task, params: BallbotParams) -> AdaptiveNmpcController:
    """For the track "noisy", whose robot is known."""
    return AdaptiveNmpcController(task, params, TRACKS["noisy"], _NOISY_BACKOFF)


def filtered_adaptive_nmpc(task: Task, params: BallbotParams) -> AdaptiveNmpcController:
    """For the track "real", which has all of it."""
    return AdaptiveNmpcController(task, params, TRACKS["real"], _NOISY_BACKOFF)
