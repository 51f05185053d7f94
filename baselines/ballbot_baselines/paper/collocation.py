"""Direct collocation: trajectory optimization between two states with a free time step. A problem is plain data.

    minimize    Σ_{n<N} cost(x_n, u_n, h, q)
    subject to  Hermite–Simpson:  the cubic through (x_n, f_n) and (x_{n+1}, f_{n+1}) obeys the dynamics at mid-interval,
                                  with u linear between knots
                equalities(x_n, u_n, q) = 0,  inequalities(x_n, u_n, q) ≥ 0 at every knot
                limits(x_n, u_n) ≥ 0 at every knot, where the robot's friction is limited (`Ballbot.limits`)
                bounds on x_0, x_N, leans, forces, step h and free variables q;   x_N = x_0 if periodic

This module writes the problem as a staged `Ocp`, and `ocp.OcpSolver` solves it. The input of a stage is the next knot without
its position, which follows from the other components, because the dynamics do not depend on it. The step h and the free
variables q are states that do not change.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.solvers.ocp import ACCEPTABLE, Ocp, OcpSolver, Solution
from ballbot_gym.robot import Ballbot
from ballbot_gym.rollout import PlanError
from ballbot_gym.trajectory import Trajectory

_INTERIOR = (np.arange(8) + 0.5) / 8  # where between knots the collocation error is measured

# Where things stand in the staged state s = [x, u/limit, h, q, x_start]. Only periodic problems have an x_start. Inputs are
# the next [x, u/limit] from the leans on.
_X, _A, _INPUTS, _H = slice(0, 8), slice(8, 10), slice(2, 10), 10


@dataclass(frozen=True)
class Problem:
    """A trajectory optimization problem as plain data. Vectors are in SI units, in the order of `Ballbot.STATE`."""

    name: str
    cost: Callable[[Any, Any, Any, Any], Any]
    """(x, u, h, q) -> cost of a knot; the last knot has none."""
    initial: tuple[np.ndarray, np.ndarray]
    """Lower and upper bound of x_0, (8,) each; equal where it is given."""
    final: tuple[np.ndarray, np.ndarray]
    """Lower and upper bound of x_N, (8,) each."""
    intervals: int = 40
    step: tuple[float, float] = (0.005, 0.2)
    """Bounds of h, s."""
    lean_limit: float = np.inf
    """Of |γ| and |θ|, rad."""
    periodic: bool = False
    """x_N = x_0."""
    free: tuple[tuple[float, float, float], ...] = ()
    """Lower bound, upper bound and guess of further decision variables q."""
    equalities: Callable[[Any, Any, Any], tuple] | None = None
    """(x, u, q) -> each 0, at knots 0 … N−1."""
    inequalities: Callable[[Any, Any, Any], tuple] | None = None
    """(x, u, q) -> each ≥ 0, at all knots."""

    def hermite_simpson(self, params: Ballbot) -> Ocp:
        """The staged problem whose dynamics and equality constraints are Hermite–Simpson's."""
        q, limit = self._free, params.force_limit
        start = slice(q.stop, q.stop + 8 * self.periodic)

        def interval(s: casadi.SX, w: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
            """The next [x, u/limit], and the defects of its components from the leans on."""
            x0, u0, h, x1, u1 = s[_X], limit * s[_A], s[_H], casadi.vertcat(0, 0, w[:6]), limit * w[6:]
            f0, f1 = params.derivative(x0, u0), params.derivative(x1, u1)
            middle = 0.5 * (x0 + x1) + h / 8 * (f0 - f1)
            f_middle = params.derivative(middle, 0.5 * (u0 + u1))
            reached = x0 + h / 6 * (f0 + 4 * f_middle + f1)
            return casadi.vertcat(reached[:2], w), w[:6] - reached[2:]

        def path(function: Callable | None, s: casadi.SX) -> casadi.SX:
            return casadi.SX(0, 1) if function is None else casadi.vertcat(*function(s[_X], limit * s[_A], s[q]))

        def inequalities(s: casadi.SX) -> casadi.SX:
            asked = path(self.inequalities, s)
            return casadi.vertcat(asked, *params.limits(s[_X], limit * s[_A])) if params.grips else asked

        ocp = Ocp(
            name="hermite-simpson",
            states=start.stop,
            inputs=8,
            params=0,
            next=lambda s, w, p: casadi.vertcat(interval(s, w)[0], s[_H:]),
            cost=lambda s, w, p: self.cost(s[_X], limit * s[_A], s[_H], s[q]),
            equalities=lambda s, w, p: casadi.vertcat(interval(s, w)[1], path(self.equalities, s)),
            inequalities=lambda s, w, p: inequalities(s),
            final_inequalities=lambda s, p: inequalities(s),
        )
        if not self.periodic:
            return ocp
        initial = np.zeros((8, start.stop))  # x_start is x_0
        initial[:, _X], initial[:, start] = np.eye(8), -np.eye(8)
        return replace(ocp, final_equalities=lambda s, p: s[_X] - s[start], initial_matrix=initial)

    def solve(self, params: Ballbot, guess: Trajectory, solver: str = "ipopt", max_iterations: int = 500) -> Optimum:
        """Solves the problem from a guess, which should be roughly a motion: its N+1 knots, at equal times, with linear
        forces.

        The optimum's trajectory has linear forces and cubic states. From a straight line between two states the solvers take
        up to 12 times as many iterations, or stop at an infeasible point.

        Raises:
            PlanError: the solver did not converge to a feasible plan; the message says how it ended and how infeasible it is.
        """
        n, ocp = self.intervals, self.hermite_simpson(params)
        bounds = self._bounds(ocp)
        knots = np.column_stack([guess.x, guess.u / params.force_limit])
        start = guess.x[0] if self.periodic else ()
        constant = np.tile([guess.t[1] - guess.t[0], *(value for _, _, value in self.free), *start], (n + 1, 1))
        optimizer = OcpSolver(ocp, n, solver, max_iterations=max_iterations)
        started = time.perf_counter()
        result = optimizer.solve(np.hstack([knots, constant]), knots[1:, _INPUTS], *bounds)
        seconds = time.perf_counter() - started
        converged = result.success or result.status == ACCEPTABLE
        if not (converged and result.is_within_limits):
            raise PlanError(
                f"{self.name}: {solver} found no plan: {result.status} after {result.iterations} iterations, constraints "
                f"violated by {result.violation:.1e}. Try another guess or more time."
            )
        return _optimum(params, result, seconds)

    def _bounds(self, ocp: Ocp) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = ocp.no_bounds(self.intervals)
        lower[:, 2:4], upper[:, 2:4] = -self.lean_limit, self.lean_limit
        lower[:, _A], upper[:, _A] = -1, 1
        for knot, (low, high) in ((0, self.initial), (-1, self.final)):
            lower[knot, _X] = np.maximum(lower[knot, _X], low)
            upper[knot, _X] = np.minimum(upper[knot, _X], high)
        # h and q do not change, so bounds at the first knot suffice.
        lower[0, _H], upper[0, _H] = self.step
        for i, (low, high, _) in enumerate(self.free):
            lower[0, _H + 1 + i], upper[0, _H + 1 + i] = low, high
        for knot, i in np.argwhere(lower > upper)[:1]:
            name, low, high = Ballbot.STATE[i][0] if i < 8 else "a decision variable", lower[knot, i], upper[knot, i]
            raise PlanError(
                f"{self.name}: at knot {knot}, {name} has lower bound {low:g} above its upper bound {high:g}"
            )
        return lower, upper

    @property
    def _free(self) -> slice:
        """Where the free variables q stand in a staged state."""
        return slice(_H + 1, _H + 1 + len(self.free))


def _optimum(params: Ballbot, result: Solution, seconds: float) -> Optimum:
    x, u = result.states[:, _X], params.force_limit * result.states[:, _A]
    t = result.states[0, _H] * np.arange(len(x))
    trajectory = Trajectory(t, x, u, xdot=params.derivative(x, u))
    return Optimum.of(result, trajectory, seconds, slopes=np.full(x.shape, np.nan))


def collocation_error(params: Ballbot, trajectory: Trajectory) -> float:
    """The largest ∫|ẋ − f(x, u)| dt over an interval and a state component, for x cubic and u linear between knots.

    It measures a plan's error between knots, in state units, and shrinks as knots are added.
    """
    t, u = trajectory.t, trajectory.u
    step = np.diff(t)
    inner = (t[:-1, None] + step[:, None] * _INTERIOR).ravel()
    spline = CubicHermiteSpline(t, trajectory.x, trajectory.xdot)
    forces = np.column_stack([np.interp(inner, t, u[:, i]) for i in range(2)])
    residual = np.abs(spline(inner, 1) - params.derivative(spline(inner), forces))
    return float((residual.reshape(len(step), len(_INTERIOR), 8).mean(axis=1) * step[:, None]).max())
