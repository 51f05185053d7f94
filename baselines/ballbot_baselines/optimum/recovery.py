"""The recoverable states: some force within the limit still brings the robot from them to rest.

No controller can recover from any other state. One component of the initial state (a speed, for example) is given, and all
others but the lean γ are zero. The largest recoverable lean is then the solution of an optimal-control problem:

    maximize    γ_0        over γ_0 and forces u_k, |u_k| ≤ limit, held for control_dt
    subject to  x_{k+1} = step(x_k, u_k)  (RK4),   margins(x_k) ≥ 0,   goal(x_n) ≤ 0 at the end of the episode

Turning the world by 180° turns the largest lean into the smallest, so both sides of the boundary come from one search.

The force limit is a square, with √2 times the force along its diagonal. So the largest leans are recovered by leaning to the
side as well, and the search starts from such a recovery (`righting.py`).
"""

import math
from dataclasses import replace

import casadi
import numpy as np

from ballbot_baselines.solvers import righting
from ballbot_baselines.solvers.formulas import check_formulas
from ballbot_baselines.solvers.ocp import Ocp, OcpSolver, Solution
from ballbot_baselines.solvers.shooting import Backoff, Shooting, ocp_of
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task

_LEAN = 2  # index of γ in a state
# rad; weight of squared actions, leans and lean rates. It makes the optimum unique, and moves it by half a degree.
_REGULARIZATION = 0.02
_TOLERANCE = 1e-6
_FEASIBLE = 1e-4  # SI units: at the boundary the robot hovers where rounding grows by e^7.8 a second
_ITERATIONS = 300
_STEEP = math.radians(55)  # the lean of the recovery that the search starts from
_PATIENCE = 3  # the search stops after this many values in a row without a recoverable lean


def largest_leans(task: Task, params: Robot, component: int, values: np.ndarray) -> np.ndarray:
    """For each value of one component of the initial state, the largest lean γ that still allows the robot to reach the goal.

    Args:
        task: without constants and with a goal at its end, as Stabilize.
        component: index of a state component other than γ.
        values: (n,) ascending, in the component's SI unit.

    Returns:
        (n,) rad; NaN where no recoverable lean was found. The search goes outward from the value nearest 0. It starts from
        the neighbouring value's solution and from a recovery to the side, and if both fail from standing.
    """
    p = Shooting(task, params, np.zeros(8), np.zeros(0), Backoff(0.0, 0.0, 0.0, 0.0)).parameters()
    solver = OcpSolver(_largest_lean_ocp(task, params), task.steps, "fatrop", _TOLERANCE, _ITERATIONS)
    leans = np.full(len(values), np.nan)
    middle = int(np.argmin(np.abs(values)))
    standing = np.zeros((task.steps + 1, 8)), np.zeros((task.steps, 2))
    sideways = _sideways(task, params) or standing
    for order in (range(middle, len(values)), range(middle, -1, -1)):
        start, failures = standing, 0
        for i in order:
            found = [_solve(solver, *guessed, component, float(values[i]), p) for guessed in (start, sideways)]
            if not any(solution.violation <= _FEASIBLE for solution in found):
                found = [_solve(solver, *standing, component, float(values[i]), p)]
            recovered = [solution for solution in found if solution.violation <= _FEASIBLE]
            if recovered:
                best = max(recovered, key=lambda solution: solution.states[0, _LEAN])
                leans[i] = best.states[0, _LEAN]
                start = best.states, best.inputs
            failures = 0 if recovered else failures + 1
            if failures == _PATIENCE:
                break
    return leans


def _solve(solver: OcpSolver, x: np.ndarray, a: np.ndarray, component: int, value: float, p: list[float]) -> Solution:
    lower, upper = solver.ocp.no_bounds(len(a))
    known = [i for i in range(8) if i != _LEAN]
    lower[0, known] = upper[0, known] = np.where(np.array(known) == component, value, 0.0)
    lower[:, 8:], upper[:, 8:] = -1.0, 1.0
    return solver.solve(x, a, lower, upper, p)


def _sideways(task: Task, params: Robot) -> tuple[np.ndarray, np.ndarray] | None:
    """A simulated recovery from a large lean that first leans to one side, if there is one."""
    x0 = np.zeros(8)
    x0[_LEAN] = _STEEP
    for member in righting.righted(task, params, x0, np.zeros(0), params.force_limit):
        if member.side and len(member.u) == task.steps:
            return member.x, member.u / params.force_limit
    return None


def _largest_lean_ocp(task: Task, params: Robot) -> Ocp:
    """The task's problem with a free initial lean, which the first stage rewards."""
    check_formulas(task, params)
    fixed = ocp_of(task, params.kind)
    price = _REGULARIZATION * task.control_dt

    def cost(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        regular = casadi.sumsqr(a) + casadi.sumsqr(s[2:4]) + 0.1 * casadi.sumsqr(s[6:8])
        return price * regular - casadi.if_else(p[-1] == 0, s[_LEAN], 0)  # the number of the stage is last in p

    return replace(
        fixed,
        name=f"{task.id}-recovery",
        cost=cost,
        final_inequalities=lambda s, p: casadi.vertcat(
            fixed.final_inequalities(s, p), *(-excess for excess in task.goal(s, p[:0]))
        ),
        counts_stages=True,
    )
