"""Linear-quadratic regulators: about an equilibrium, and along a trajectory.

All use the env's own discretization: force held for control_dt, cost summed over control steps. So near an equilibrium the
cost of an endless episode is xᵀPx.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_gym.robot import Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

_ACTIVE = 0.05  # a goal function this close to the greatest one still limits the optimum
_GOAL_PRICE = 10.0  # cost per squared goal tolerance, for references that do not end at an equilibrium


@dataclass(frozen=True)
class Gains:
    """Feedback u = u_ref − K (x − x_ref), with cost-to-go (x − x_ref)ᵀ P (x − x_ref): K (n, 2, 8), P (n+1, 8, 8)."""

    k: np.ndarray
    p: np.ndarray

    @classmethod
    def before(cls, p_final: np.ndarray, model: LinearQuadratic) -> "Gains":
        """Time-varying LQR over the control steps of a model, backwards from the final cost-to-go P (8, 8)."""
        (a, b), (q, r) = model.dynamics, model.step_costs
        k, p = np.zeros((*b.shape[::2], b.shape[1])), np.zeros((len(a) + 1, *p_final.shape))
        after = p[-1] = p_final
        for i in reversed(range(len(a))):
            weighted = b[i].T @ after
            k[i] = np.linalg.solve(r[i] + weighted @ b[i], weighted @ a[i])
            after = q[i] + a[i].T @ after @ (a[i] - b[i] @ k[i])
            after = 0.5 * (after + after.T)  # keeps p symmetric: rounding errors would add up over hundreds of steps
            p[i] = after
        return cls(k, p)


def discrete_lqr(
    task: Task, params: Robot, x: np.ndarray, u: np.ndarray, c: np.ndarray, t: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """K (2, 8) and P (8, 8) of LQR about an equilibrium for the env's steps: Σ cost·control_dt = xᵀPx.

    Raises:
        PlanError: the cost rate has no curvature there in the state or in the force, so that LQR has no gain.
    """
    model = LinearQuadratic(task, params, x[None], u[None], c, t)
    ((a,), (b,)), ((q,), (r,)) = model.dynamics, model.step_costs
    try:
        p = scipy.linalg.solve_discrete_are(a, b, q, r)
    except np.linalg.LinAlgError:
        raise PlanError(
            f"LQR of {task.id} has no gain at its reference: {type(task).__name__}.cost must grow there with the square of "
            "errors of the state and of the force"
        ) from None
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a), p


def lqr_at_end(
    task: Task, params: Robot, x: np.ndarray, c: np.ndarray, t: float = 0.0
) -> tuple[np.ndarray | None, np.ndarray]:
    """K (2, 8) and P (8, 8) where a trajectory ends: LQR's at an equilibrium, else None and `_GOAL_PRICE` per squared goal
    tolerance.
    """
    none = np.zeros(params.action_size)
    model = LinearQuadratic(task, params, x[None], none[None], c, t)
    if model.starts_at_rest:
        return discrete_lqr(task, params, x, none, c, t)
    return None, _GOAL_PRICE * model.goal_weights[0]


def tube_gains(task: Task, params: Robot, trajectory: Trajectory, c: np.ndarray) -> np.ndarray:
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
    return Gains.before(p_final, LinearQuadratic.along(task, params, trajectory, c)).k
