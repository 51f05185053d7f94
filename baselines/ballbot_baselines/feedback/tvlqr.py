"""Time-varying LQR that keeps the robot on a planned trajectory."""

import numpy as np

from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_baselines.solvers.riccati import Gains, lqr_at_end
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory


class TvlqrController:
    """Tracks a trajectory sampled at control steps: u = u_k − K_k (x − x_k).

    After the end of the trajectory, the last gain keeps the robot at its last state. If that state is an equilibrium, the
    gain is that of LQR.
    """

    def __init__(self, model: LinearQuadratic, end: np.ndarray, gains: Gains, end_gain: np.ndarray | None = None):
        """Takes the gains.

        Args:
            model: of the n control steps to track.
            end: (8,) state after the last of them.
            gains: for each of them.
            end_gain: (2, 8) gain after the end; default, the last gain of the trajectory.
        """
        self.x, self.u, self.gains = model.x, model.u, gains
        self._end, self._end_gain = end, gains.k[-1] if end_gain is None else end_gain
        self._dt, self._start = model.task.control_dt, 0.0

    @classmethod
    def for_task(
        cls,
        task: Task,
        params: Robot,
        trajectory: Trajectory,
        c: np.ndarray | tuple = (),
        end: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> "TvlqrController":
        """With weights from the task's own cost; c (nc,) are the constants the trajectory was planned for.

        Its times are the episode's. `end` is K (2, 8) and P (8, 8) where it ends; default, those of `lqr_at_end`.
        """
        c, last = np.asarray(c, np.float64), trajectory.x[-1]
        end_gain, p_final = end or lqr_at_end(task, params, last, c, trajectory.t[-1])
        model = LinearQuadratic.along(task, params, trajectory, c)
        return cls(model, last, Gains.before(p_final, model), end_gain)

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._start = t

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        i = round((t - self._start) / self._dt)
        if i < len(self.x):
            return self.u[i] - self.gains.k[i] @ (x - self.x[i])
        return -self._end_gain @ (x - self._end)
