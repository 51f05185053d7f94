"""Linear models of the robot and quadratic models of a task's cost, by automatic differentiation."""

from functools import cache, lru_cache

import casadi
import numpy as np

from ballbot_gym.robot import Robot, substeps_for
from ballbot_gym.tasks import Task

_YAW_WEIGHT = 0.1  # of ψ², ψ̇² and ω_z², SI units, 1/s


def discretize(params: Robot, x: np.ndarray, u: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Linearizes the control step (force held for dt s, RK4) about points of a trajectory.

    Args:
        params: the robot.
        x: (n, 8) states; order and units in `Ballbot.STATE`. With wheels they have 11 components, and forces have 3.
        u: (n, 2) forces, N.
        dt: s.

    Returns:
        A: (n, 8, 8) and B: (n, 8, 2), with dx⁺ = A dx + B du.
    """
    a, b = _jacobians(params, dt)(np.asarray(x).T, np.asarray(u).T)
    return _blocks(a, len(x)), _blocks(b, len(x))


def quadratic_cost(
    task: Task, x: np.ndarray, u: np.ndarray, c: np.ndarray, t: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Half the Hessian of the task's cost rate at points of a trajectory, made positive semidefinite.

    For a quadratic cost xᵀQx + uᵀRu these are Q and R, 1/s. The points' times in the episode, t (n,) or one, s, matter
    to tasks with a clock.

    Returns:
        Q: (n, 8, 8) and R: (n, 2, 2). Mixed terms of x and u are left out; no task has any. With wheels Q also has a small
        weight on the heading. Tasks leave the heading free, and LQR has no gain for a state that may drift at no cost.
    """
    n, states = np.shape(x)
    q, r = _cost_derivatives(task, 2, states, np.shape(u)[1])(
        np.asarray(x).T, np.asarray(u).T, _constants(task, c, t, n)
    )
    weights = _semidefinite(0.5 * _blocks(q, n))
    weights[:, range(8, states), range(8, states)] += _YAW_WEIGHT
    return weights, 0.5 * _blocks(r, n)


def cost_slopes(
    task: Task, x: np.ndarray, u: np.ndarray, c: np.ndarray, t: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The gradient of the task's cost rate with respect to x (n, 8) and to u (n, 2); arguments of `quadratic_cost`."""
    along_x, along_u = _cost_derivatives(task, 1, np.shape(x)[1], np.shape(u)[1])(
        np.asarray(x).T, np.asarray(u).T, _constants(task, c, t, len(x))
    )
    return np.array(along_x).T, np.array(along_u).T


def goal_weight(task: Task, x: np.ndarray, c: np.ndarray, t: float = 0.0) -> np.ndarray:
    """(8, 8) half the Hessian of the sum of the task's goal functions at x: about 1 per squared tolerance."""
    return _semidefinite(0.5 * np.array(_goal_hessian(task, len(x))(x, _constants(task, c, t, 1)))[None])[0]


def _constants(task: Task, c: np.ndarray, t: np.ndarray | float, n: int) -> np.ndarray:
    """(nc, n) constants at n times, with these below them if the task has a clock."""
    return task.at(np.tile(np.asarray(c, np.float64), (n, 1)), np.broadcast_to(t, (n,))).T


@lru_cache(maxsize=64)  # controllers that estimate their robot come with many
def _jacobians(params: Robot, dt: float) -> casadi.Function:
    """Of the state after a control step of dt, s."""
    x, u = casadi.SX.sym("x", params.state_size), casadi.SX.sym("u", params.action_size)
    out = params.step(x, u, dt, substeps_for(dt))
    outputs = [casadi.densify(casadi.jacobian(out, x)), casadi.densify(casadi.jacobian(out, u))]
    return casadi.Function("jacobians", [x, u], outputs, {"cse": True})


@cache
def _cost_derivatives(task: Task, order: int, states: int, forces: int) -> casadi.Function:
    """Gradients (order 1) or Hessians (order 2) of the cost rate with respect to x and to u."""
    x, u = casadi.SX.sym("x", states), casadi.SX.sym("u", forces)
    c = casadi.SX.sym("c", len(task.constant_names) + task.clock)
    cost = task.cost(x, u, c)
    parts = [casadi.gradient(cost, z) if order == 1 else casadi.hessian(cost, z)[0] for z in (x, u)]
    return casadi.Function("derivatives", [x, u, c], [casadi.densify(part) for part in parts])


@cache
def _goal_hessian(task: Task, states: int) -> casadi.Function:
    x, c = casadi.SX.sym("x", states), casadi.SX.sym("c", len(task.constant_names) + task.clock)
    return casadi.Function("hessian", [x, c], [casadi.densify(casadi.hessian(sum(task.goal(x, c)), x)[0])])


def _blocks(horizontal: casadi.DM, n: int) -> np.ndarray:
    """(r, n·k) matrices side by side as (n, r, k)."""
    array = np.array(horizontal)
    return array.reshape(array.shape[0], n, -1).transpose(1, 0, 2)


def _semidefinite(matrices: np.ndarray) -> np.ndarray:
    """The nearest positive semidefinite matrices. Negative eigenvalues are clipped, because LQR needs Q ⪰ 0."""
    values, vectors = np.linalg.eigh(matrices)
    return (vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
