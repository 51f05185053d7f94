"""Time-varying LQR that keeps the robot on a planned trajectory."""

import numpy as np

from ballbot_baselines.feedback.lqr import Gains, lqr_at_end, tracking_gains
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

_ACTIVE = 0.05  # a goal function this close to the greatest one still limits the optimum


class TvlqrController:
    """Tracks a trajectory sampled at control steps: u = u_k − K_k (x − x_k).

    Past the trajectory's end its last state is held by the last gain, which is LQR's where that state is an equilibrium.
    """

    def __init__(self, trajectory: Trajectory, dt: float, gains: Gains, end_gain: np.ndarray | None = None):
        """Takes the gains.

        Args:
            trajectory: what to track.
            dt: s, the control step.
            gains: for each of the trajectory's n steps.
            end_gain: (2, 8) for what comes after the end; default, the last of the trajectory's.
        """
        self.x, self.u = _sampled(trajectory, dt)
        self.gains = gains
        self._end, self._end_gain = trajectory.x[-1], gains.k[-1] if end_gain is None else end_gain
        self._dt, self._start = dt, 0.0

    @classmethod
    def for_task(
        cls,
        task: Task,
        params: BallbotParams,
        trajectory: Trajectory,
        c: np.ndarray | tuple = (),
        end: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> "TvlqrController":
        """With weights from the task's own cost; c (nc,) are the constants the trajectory was planned for.

        Its times are the episode's. `end` is K (2, 8) and P (8, 8) where it ends; default, those of `lqr_at_end`.
        """
        c, dt = np.asarray(c, np.float64), task.control_dt
        end_gain, p_final = end or lqr_at_end(task, params, trajectory.x[-1], c, trajectory.t[-1])
        gains = tracking_gains(task, params, *_sampled(trajectory, dt), c, p_final, trajectory.t[0])
        return cls(trajectory, dt, gains, end_gain)

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._start = t

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        i = round((t - self._start) / self._dt)
        if i < len(self.x):
            return self.u[i] - self.gains.k[i] @ (x - self.x[i])
        return -self._end_gain @ (x - self._end)


def tube_gains(task: Task, params: BallbotParams, trajectory: Trajectory, c: np.ndarray) -> np.ndarray:
    """Feedback about an optimum of n steps, (n, 2, 8), N per unit of the state.

    The gains are TVLQR's. If the task ends in its goal, only those goal functions that limit the optimum are weighted at its
    end. Weighting the whole goal would ask for forces that the optimum from a neighbouring state does not need.
    """
    end, h = trajectory.x[-1], 1e-5
    if task.first_exit:
        goal = np.array(task.goal(end, c), np.float64)
        slopes = np.array(
            [np.subtract(task.goal(end + d, c), task.goal(end - d, c)) / (2 * h) for d in h * np.eye(len(end))]
        )
        active = slopes[:, goal > goal.max() - _ACTIVE]
        p_final = active @ active.T + 1e-3 * np.eye(len(end))
    else:
        _, p_final = lqr_at_end(task, params, end, c, trajectory.t[-1])
    return tracking_gains(task, params, *_sampled(trajectory, task.control_dt), c, p_final, trajectory.t[0]).k


def _sampled(trajectory: Trajectory, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 8) at the starts of a trajectory's control steps, and the forces (n, 2) to hold over them.

    A force that varies within a step is represented by its value at mid-step.
    """
    times = trajectory.t[0] + dt * np.arange(max(1, round(trajectory.duration / dt)))
    middle = 0.0 if trajectory.held else 0.5 * dt
    return np.array([trajectory.state(t) for t in times]), np.array([trajectory.force(t + middle) for t in times])
