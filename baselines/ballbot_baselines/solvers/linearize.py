"""Linear models of the robot and quadratic models of a task's cost, by automatic differentiation."""

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import casadi
import numpy as np

from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

_YAW_WEIGHT = 0.1  # of ψ², ψ̇² and ω_z², SI units, 1/s


@dataclass(frozen=True, eq=False)
class LinearQuadratic:
    """Control steps as LQR sees them: the robot's linear model, and a quadratic model of the task's cost, about n points.

    The points are states x (n, 8) with forces u (n, 2), N, each held for a control step; with wheels they have 11 and 3
    components. Each part of the model is computed when it is first used.
    """

    task: Task
    params: Robot
    x: np.ndarray
    u: np.ndarray
    c: np.ndarray
    """(nc,) constants of the episode."""
    start: float = 0.0
    """The episode's time at the first point, s. It matters to tasks with a clock."""

    @classmethod
    def along(cls, task: Task, params: Robot, trajectory: Trajectory, c: np.ndarray) -> "LinearQuadratic":
        """About the states at the starts of a trajectory's control steps, and the forces to hold over them.

        A force that varies within a step is represented by its value at mid-step.
        """
        dt = task.control_dt
        times = trajectory.t[0] + dt * np.arange(max(1, round(trajectory.duration / dt)))
        middle = 0.0 if trajectory.held else 0.5 * dt
        x, u = np.array([trajectory.state(t) for t in times]), np.array([trajectory.force(t + middle) for t in times])
        return cls(task, params, x, u, c, trajectory.t[0])

    @cached_property
    def dynamics(self) -> tuple[np.ndarray, np.ndarray]:
        """A: (n, 8, 8) and B: (n, 8, 2), with dx⁺ = A dx + B du over a control step (RK4)."""
        a, b = _jacobians(self.params, self.task.control_dt)(np.asarray(self.x).T, np.asarray(self.u).T)
        return _blocks(a, len(self.x)), _blocks(b, len(self.x))

    @cached_property
    def costs(self) -> tuple[np.ndarray, np.ndarray]:
        """Half the Hessian of the task's cost rate, made positive semidefinite: Q (n, 8, 8) and R (n, 2, 2), 1/s.

        For a quadratic cost xᵀQx + uᵀRu these are Q and R. Mixed terms of x and u are left out; no task has any. With wheels
        Q also has a small weight on the heading. Tasks leave the heading free, and LQR has no gain for a state that may drift
        at no cost.
        """
        n, states = np.shape(self.x)
        q, r = self._derivatives(2)
        weights = _semidefinite(0.5 * _blocks(q, n))
        weights[:, range(8, states), range(8, states)] += _YAW_WEIGHT
        return weights, 0.5 * _blocks(r, n)

    @cached_property
    def step_costs(self) -> tuple[np.ndarray, np.ndarray]:
        """The same of a control step: Q and R times `control_dt`."""
        q, r = self.costs
        return q * self.task.control_dt, r * self.task.control_dt

    @cached_property
    def step_cost_slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """The gradient of a control step's cost with respect to x (n, 8) and to u (n, 2)."""
        along_x, along_u = self._derivatives(1)
        return self.task.control_dt * np.array(along_x).T, self.task.control_dt * np.array(along_u).T

    @cached_property
    def goal_weights(self) -> np.ndarray:
        """(n, 8, 8) half the Hessian of the sum of the task's goal functions: about 1 per squared tolerance."""
        hessians = _goal_hessian(self.task, np.shape(self.x)[1])(np.asarray(self.x).T, self._constants)
        return _semidefinite(0.5 * _blocks(hessians, len(self.x)))

    @property
    def starts_at_rest(self) -> bool:
        """Whether the first state stays where it is under the first force, to 1e-6."""
        return bool(np.abs(self.params.derivative(np.asarray(self.x[0]), np.asarray(self.u[0]))).max() < 1e-6)

    @property
    def _constants(self) -> np.ndarray:
        """(nc, n) constants at every point, with its time below them if the task has a clock."""
        n = len(self.x)
        times = self.start + self.task.control_dt * np.arange(n)
        return self.task.at(np.tile(np.asarray(self.c, np.float64), (n, 1)), times).T

    def _derivatives(self, order: int) -> tuple[casadi.DM, casadi.DM]:
        """Of the cost rate with respect to x and to u: gradients (order 1) or Hessians (order 2)."""
        x, u = np.asarray(self.x), np.asarray(self.u)
        return _cost_derivatives(self.task, order, x.shape[1], u.shape[1])(x.T, u.T, self._constants)


@lru_cache(maxsize=64)  # controllers that estimate their robot come with many
def _jacobians(params: Robot, dt: float) -> casadi.Function:
    """Of the state after a control step of dt, s."""
    x, u = casadi.SX.sym("x", params.state_size), casadi.SX.sym("u", params.action_size)
    out = params.step(x, u, dt, params.substeps(dt))
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
