"""Trajectory optimization as a controller: plan at reset, track with TVLQR."""

from dataclasses import replace

import numpy as np

from ballbot_baselines.feedback.tvlqr import TvlqrController
from ballbot_baselines.optimum.find import certified_optimum, plan_to_track
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.solvers.shooting import Backoff
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.tasks import Task

EXECUTED = Backoff(margin=0.01, goal=0.1, force=0.02, grip=0.1)
"""How far plans for execution stay from their limits: 1 cm from obstacles, a tenth of the goal's tolerance, 2 % of the
force, a tenth of the weight in normal force, where friction is limited."""

# A robot that differs from the model misses its plan: half of the goal's tolerance and 3 cm are left for that.
_CAUTIOUS = Backoff(margin=0.03, goal=0.5, grip=0.1)


class TrajoptController:
    """Plans the optimum from the state at reset, with a back-off from the limits, and tracks it with TVLQR.

    If the solver does not converge, a plan that is only feasible is tracked. `plan` is the plan of the episode. `reset`
    raises a PlanError if it finds no plan.
    """

    def __init__(self, task: Task, params: Robot, backoff: Backoff = EXECUTED, for_robots: Randomization | None = None):
        """Takes the model.

        Args:
            task: the problem.
            params: the robot.
            backoff: distance of the plan from its limits.
            for_robots: if given, the plan is one for `params` with the least friction of these robots, and its back-off is
                as large as all of them need: their least force is enough for the plan.
        """
        if for_robots is not None:
            params = params.varied(friction=for_robots.friction[0])
            backoff = replace(_CAUTIOUS, force=1 - for_robots.force[0])
        self._task, self._params, self._backoff = task, params, backoff
        self.plan: Optimum | None = None

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self.plan = self._planned(t, x, c)
        self._tracker = TvlqrController.for_task(self._task, self._params, self.plan.trajectory, c)
        self._tracker.reset(t, x, c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        return self._tracker.act(t, x)

    def _planned(self, t: float, x: np.ndarray, c: np.ndarray) -> Optimum:
        return plan_to_track(self._task, self._params, x, c, self._backoff, start=t)


class OptimumController(TrajoptController):
    """Tracks the optimum itself, without a back-off: the one against which regret is measured.

    It is the certified one where that is stored, and is searched for elsewhere.
    """

    def __init__(self, task: Task, params: Robot):
        super().__init__(task, params, Backoff())

    def _planned(self, t: float, x: np.ndarray, c: np.ndarray) -> Optimum:
        known = certified_optimum(self._task, self._params, x, c) if t == 0 else None
        return known or super()._planned(t, x, c)
