"""Linear-quadratic regulators: about an equilibrium, along a trajectory, and around a closed motion.

All use the env's own discretization: force held for control_dt, cost summed over control steps. So near an equilibrium the
cost of an endless episode is xᵀPx.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from ballbot_baselines.solvers.linearize import cost_slopes, discretize, goal_weight, quadratic_cost
from ballbot_gym.robot import Robot, substeps_for
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Reference, Task
from ballbot_gym.trajectory import Trajectory

_MAX_ROUNDS = 50  # around a closed motion until the Riccati equation is periodic
_ACTIVE = 0.05  # a goal function this close to the greatest one still limits the optimum
_GOAL_PRICE = 10.0  # cost per squared goal tolerance, for references that do not end at an equilibrium


@dataclass(frozen=True)
class Gains:
    """Feedback u = u_ref − K (x − x_ref), with cost-to-go (x − x_ref)ᵀ P (x − x_ref): K (n, 2, 8), P (n+1, 8, 8)."""

    k: np.ndarray
    p: np.ndarray


def discrete_lqr(
    task: Task, params: Robot, x: np.ndarray, u: np.ndarray, c: np.ndarray, t: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """K (2, 8) and P (8, 8) of LQR about an equilibrium for the env's steps: Σ cost·control_dt = xᵀPx.

    Raises:
        PlanError: the cost rate has no curvature there in the state or in the force, so that LQR has no gain.
    """
    a, b, q, r = (matrix[0] for matrix in _steps(task, params, x[None], u[None], c, t))
    try:
        p = scipy.linalg.solve_discrete_are(a, b, q, r)
    except np.linalg.LinAlgError:
        raise PlanError(
            f"LQR of {task.id} has no gain at its reference: {type(task).__name__}.cost must grow there with the square of "
            "errors of the state and of the force"
        ) from None
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a), p


def is_equilibrium(params: Robot, x: np.ndarray, u: np.ndarray) -> bool:
    """Whether state x (8,) stays where it is under force u (2,), to 1e-6."""
    return bool(np.abs(params.derivative(np.asarray(x), np.asarray(u))).max() < 1e-6)


def lqr_at_end(
    task: Task, params: Robot, x: np.ndarray, c: np.ndarray, t: float = 0.0
) -> tuple[np.ndarray | None, np.ndarray]:
    """K (2, 8) and P (8, 8) where a trajectory ends: LQR's at an equilibrium, else None and `_GOAL_PRICE` per squared goal
    tolerance.
    """
    none = np.zeros(params.action_size)
    if is_equilibrium(params, x, none):
        return discrete_lqr(task, params, x, none, c, t)
    return None, _GOAL_PRICE * goal_weight(task, x, c, t)


def _riccati(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray, p_final: np.ndarray) -> Gains:
    """Time-varying LQR, backwards from the final cost-to-go.

    Args:
        a: (n, 8, 8) slopes of the next state with respect to the state.
        b: (n, 8, 2) slopes of the next state with respect to the input.
        q: (n, 8, 8) cost of each step, state part.
        r: (n, 2, 2) cost of each step, input part.
        p_final: (8, 8) cost-to-go at the end.
    """
    k, p = np.zeros((*b.shape[::2], b.shape[1])), np.zeros((len(a) + 1, *p_final.shape))
    after = p[-1] = p_final
    for i in reversed(range(len(a))):
        weighted = b[i].T @ after
        k[i] = np.linalg.solve(r[i] + weighted @ b[i], weighted @ a[i])
        after = q[i] + a[i].T @ after @ (a[i] - b[i] @ k[i])
        after = 0.5 * (after + after.T)  # keeps p symmetric: rounding errors would add up over hundreds of steps
        p[i] = after
    return Gains(k, p)


def tracking_gains(
    task: Task,
    params: Robot,
    x: np.ndarray,
    u: np.ndarray,
    c: np.ndarray,
    p_final: np.ndarray,
    start: float = 0.0,
) -> Gains:
    """Time-varying LQR along states x (n, 8) and forces u (n, 2) at control steps, weighted by the task's own cost.

    The first point is at the episode's time `start`, s.
    """
    return _riccati(*_steps(task, params, x, u, c, start), p_final)


def reference_gains(
    task: Task, params: Robot, reference: Reference, c: np.ndarray, start: float = 0.0
) -> tuple[Reference, Gains]:
    """LQR about a reference motion, with a gain for each of its points.

    Around a closed motion the gains are periodic. A task with a clock gives an open reference that may be no motion of the
    robot, so forces that look ahead are added to it (`_feedforward`). The first point is at the episode's time `start`, s.

    Raises:
        PlanError: there is no gain.
    """
    if reference.closed:
        return reference, _closed_gains(task, params, reference, c)
    end = start + task.control_dt * len(reference.x)
    _, p_final = lqr_at_end(task, params, reference.x[-1], c, end)
    gains = tracking_gains(task, params, reference.x, reference.u, c, p_final, start)
    if task.clock:
        reference = replace(reference, u=reference.u + _feedforward(task, params, reference, c, gains, start))
    return reference, gains


def _closed_gains(task: Task, params: Robot, reference: Reference, c: np.ndarray) -> Gains:
    """LQR around a closed motion: the Riccati recursion goes backwards, round after round, until it is periodic."""
    steps, after = _steps(task, params, reference.x, reference.u, c), np.eye(reference.x.shape[1])
    for _ in range(_MAX_ROUNDS):
        gains = _riccati(*steps, after)
        if np.allclose(after, gains.p[0], rtol=1e-6):
            return gains
        after = gains.p[0]
    raise PlanError(f"LQR around the closed motion of {task.id} found no periodic gain in {_MAX_ROUNDS} rounds")


def _steps(
    task: Task, params: Robot, x: np.ndarray, u: np.ndarray, c: np.ndarray, start: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What `_riccati` takes of the control steps at states x (n, 8) and forces u (n, 2)."""
    dt = task.control_dt
    q, r = quadratic_cost(task, x, u, c, start + dt * np.arange(len(x)))
    return *discretize(params, x, u, dt), q * dt, r * dt


def _feedforward(
    task: Task, params: Robot, reference: Reference, c: np.ndarray, gains: Gains, start: float = 0.0
) -> np.ndarray:
    """(n, 2) forces, N, to add along an open reference that is no motion of the robot, or not the cheapest near it.

    They are the forces of the cheapest motion in the linear model about the reference. LQR's gains are the feedback of the
    same model. The model includes the errors of the reference in the equations of motion, and the gradients of the cost.
    """
    x, u, dt = reference.x, reference.u, task.control_dt
    a, b, _, r = _steps(task, params, x, u, c, start)
    of_x, of_u = cost_slopes(task, x, u, c, start + dt * np.arange(len(x)))
    missed = np.zeros_like(x)
    missed[:-1] = params.step(x, u, dt, substeps_for(dt))[:-1] - x[1:]
    forces, slope = (
        np.zeros_like(u),
        np.zeros(x.shape[1]),
    )  # half the slope of the cost-to-go, which is xᵀPx + 2 slopeᵀx
    for i in reversed(range(len(x))):
        after = gains.p[i + 1]
        slope = slope + after @ missed[i]
        along = dt * of_u[i] / 2 + b[i].T @ slope
        forces[i] = -np.linalg.solve(r[i] + b[i].T @ after @ b[i], along)
        slope = dt * of_x[i] / 2 + a[i].T @ slope - gains.k[i].T @ along
    return forces


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
    return tracking_gains(task, params, *held_steps(trajectory, task.control_dt), c, p_final, trajectory.t[0]).k


def held_steps(trajectory: Trajectory, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 8) at the starts of a trajectory's control steps, and the forces (n, 2) to hold over them.

    A force that varies within a step is represented by its value at mid-step.
    """
    times = trajectory.t[0] + dt * np.arange(max(1, round(trajectory.duration / dt)))
    middle = 0.0 if trajectory.held else 0.5 * dt
    return np.array([trajectory.state(t) for t in times]), np.array([trajectory.force(t + middle) for t in times])
