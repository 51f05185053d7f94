"""Controllers behind a filter: for unknown robots, delays and sensors.

`TrackFilter` estimates the state, the robot and the delay. `SensorFilter` estimates the state of a robot with wheels. A
controller acts on the predicted state at the time when its force starts to act. Its force is divided by the estimated share
of a force that the robot applies. NMPC uses the estimated robot as its model too. If the estimate moves far from the robot
that the episode was planned for, the rest of the episode is planned again from the present state. That takes longer than a
control step. Shortly before a goal a new plan may just miss it and go all the way round. Then the previous plan, which
tolerates some error, is followed.

The friction of the floor cannot be measured before the robot slips, so plans assume the lowest friction of the track.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ballbot_baselines.feedback.kalman import SensorFilter, TrackFilter, _DisturbanceFilter
from ballbot_baselines.feedback.nmpc import BACKOFF, NmpcController
from ballbot_baselines.solvers.shooting import Backoff
from ballbot_gym.robot import TRACKS, Robot
from ballbot_gym.rollout import Controller, PlanError
from ballbot_gym.tasks import Task

_MOVED = 0.02  # change of a factor, and at least twice its deviation, after which the episode is planned again
_LATER = 1.0  # s by which plans that go all the way round to a goal end later, and are not followed
_NOISY_BACKOFF = Backoff(margin=0.03, goal=0.2, force=0.02, grip=0.1)  # with room for errors of the estimate

_TRACKS = {
    "-adaptive-ekf": TRACKS["real"],
    "-ekf": TRACKS["noisy"],
    "-adaptive": replace(TRACKS["unknown"], actuator_delay=TRACKS["late"].actuator_delay),
}
"""What each of `FILTERS` takes for possible."""


class FilteredController:
    """A controller that acts on the estimates of `filter`, one of the filters in `FILTERS`.

    For robots with wheels "-ekf" estimates the state from sensors. Every other filter uses the ranges of what varies on its
    track. It acts in B episodes at once, given states (B, 8) and constants (B, nc), if the controller does.
    """

    def __init__(
        self,
        task: Task,
        params: Robot,
        ending: str,
        controller: Controller,
        errors: Mapping[str, float] | None = None,
    ):
        """Args: errors: of sensors and model, same as in `SensorFilter`; the other filters have those of their tracks."""
        self._task, self._params, self._controller = task, params, controller
        self.senses = bool(params.SENSORS) and ending == "-ekf"
        rubs = self.senses and params.without_dry_friction() != params
        of_sensors = _DisturbanceFilter if rubs else SensorFilter
        self.filter = of_sensors(task, params, errors) if self.senses else TrackFilter(task, params, _TRACKS[ending])

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._c, self._start = c, t
        self.filter.reset(x, c)
        self._begin(t)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        if t > self._start:
            self.filter.update(t - self._start, x, self._u)
            self._adapt(t)
        limit = self._params.force_limit
        # the robot applies only a share of the command
        u = self._controller.act(self._when_free(t), self.filter.when_free()) / self.filter.factors[..., 2:]
        u = u - self.filter.disturbance
        self._u = np.clip(u, -limit, limit)
        return self._u

    def _begin(self, t: float) -> None:
        self._adapt(t)
        self._controller.reset(self._when_free(t), self.filter.when_free(), self._c)

    def _adapt(self, t: float) -> None:
        """Passes the present estimates of the robot to the controller."""
        if getattr(self._controller, "estimates", None) is not None:
            self._controller.estimates = self.filter.factors  # pyright: ignore[reportAttributeAccessIssue]

    def _when_free(self, t: float) -> Any:
        """When the next command will begin to act, s; (B,) of B episodes."""
        return t + self._task.control_dt * self.filter.delay


class AdaptiveNmpcController(FilteredController):
    """NMPC for a track: `filter` estimates what was drawn, and it plans with that."""

    filter: TrackFilter
    _controller: NmpcController

    def __init__(self, task: Task, params: Robot, ending: str):
        self._backoff = BACKOFF if ending == "-adaptive" else _NOISY_BACKOFF
        super().__init__(task, params, ending, NmpcController(task, params, backoff=self._backoff))

    def _begin(self, t: float) -> None:
        self._controller = self._planned(t)

    def _adapt(self, t: float) -> None:
        moved = np.abs(self.filter.factors - self._factors) > np.maximum(_MOVED, 2 * self.filter.deviations)
        if self.filter.delay != self._delay or moved.any():
            with contextlib.suppress(PlanError):  # the plan before is followed
                planned = self._planned(t)
                if _end(planned) < _end(self._controller) + _LATER:
                    self._controller = planned
        self._controller.adapt(self.filter.robot)

    def _planned(self, t: float) -> NmpcController:
        """NMPC for the estimated robot, with a plan of the rest of the episode from where the next force begins to act."""
        self._factors, self._delay = self.filter.factors, self.filter.delay
        nmpc = NmpcController(self._task, self.filter.robot, backoff=self._backoff)
        nmpc.reset(self._when_free(t), self.filter.when_free(), self._c)
        return nmpc


def _end(nmpc: NmpcController) -> float:
    """When its plan ends, s."""
    assert nmpc.plan is not None
    return nmpc.plan.trajectory.t[-1]
