"""Time-varying LQR that keeps the robot on a planned trajectory."""

import numpy as np

from ballbot_baselines.lqr import Gains, discrete_lqr, final_weight, is_equilibrium, tracking_gains
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory


class TvlqrController:
    """Tracks a trajectory with gains from the task's cost.

    The trajectory is sampled at control steps; past its end the last state is held where it is an equilibrium, else
    followed by the last gain.
    """

    def __init__(self, task: Task, params: BallbotParams, trajectory: Trajectory, c: np.ndarray | tuple = ()):
        """Args: trajectory in time from 0; c (nc,) the constants of the episode it was planned for."""
        c = np.asarray(c, np.float64)
        dt = task.control_dt
        times = trajectory.t[0] + dt * np.arange(max(1, round(trajectory.duration / dt)))
        self.x = np.array([trajectory.state(t) for t in times])
        self.u = np.array([_mean_force(trajectory, t, dt) for t in times])
        end = trajectory.x[-1]
        self.gains: Gains = tracking_gains(task, params, self.x, self.u, c, final_weight(task, params, end, c))
        self._dt, self._start = dt, 0.0
        self._end, self._end_gain = end, self.gains.k[-1]
        if is_equilibrium(params, end, np.zeros(2)):
            self._end_gain = discrete_lqr(task, params, end, np.zeros(2), c)[0]

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._start = t

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        i = round((t - self._start) / self._dt)
        if i < len(self.x):
            return self.u[i] - self.gains.k[i] @ (x - self.x[i])
        return -self._end_gain @ (x - self._end)


def _mean_force(trajectory: Trajectory, t: float, dt: float) -> np.ndarray:
    """The force to hold over a control step for one that may vary within it: its value at mid-step."""
    return trajectory.force(t) if trajectory.held else trajectory.force(t + 0.5 * dt)
