"""The optimum of any episode of any task, on the env's own discretization.

    minimize   Σ_k cost(x_k, u_k, c)·control_dt        over forces u_k, |u_k| ≤ limit, held for control_dt
    subject to x_{k+1} = step(x_k, u_k)  (RK4),   margins(x_k, c) ≥ 0,   first-exit tasks: goal(x_n, c) ≤ 0 at a free n,
               limits(x_k, u_k) ≥ 0 at both ends of each step, where the robot's friction is limited (`dynamics.limits`).

So an episode under physics="rk4" that follows the optimal trajectory returns minus this cost. The problem is solved by
multiple shooting from each of the task's guessed paths, and the best solution is kept. If no path leads to a solution, the
search starts from simulated recoveries (`righting.py`). The solution is feasible and locally optimal. It is the global
optimum if one of the guesses leads there.
"""

import math
import time
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Literal

import casadi
import numpy as np

from ballbot_baselines import guess, righting, sides
from ballbot_baselines.ocp import Bounds, Ocp, OcpSolution, OcpSolver, spent
from ballbot_gym import dynamics
from ballbot_gym.ops import is_number
from ballbot_gym.params import BallbotParams
from ballbot_gym.paths import cubic, then_stay
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

FEASIBLE = 1e-6
"""Largest constraint violation of an optimum, in SI units."""

FROM_RIGHTING = -1
"""The `guess` of an optimum that was found from a simulated recovery."""

_FREE_TIME_INTERVALS = 60
_MOST_ITERATIONS = 200
_QUICK_ITERATIONS = 80  # of the first try where there is one guessed path; a second guess is tried before more
_BARRIER = 0.1  # of the first iterate
_HIGH_BARRIER = 1.0  # with the other, fatrop goes in circles from one start in thousands
_NEAR_BARRIER = 1e-3  # near a solution of nearly the same problem: about half the iterations
_COARSE = 2  # control steps per interval when several guesses are compared
_COARSEST = 4  # the same when choices of sides are compared first
_ROUGH = 1e-4  # tolerance there: costs are then right to 1e-5 of their value, in four iterations less
_BASIN_DOUBT = 0.01  # relative: relaxed costs that differ by less may be ordered differently on the env's grid
_CONSIDERED = 5  # guesses tried at most by default; tasks name the likeliest first
_SIDE_DOUBT = 0.01  # relative: choices of sides that are predicted to cost more than the best by more are not solved
_COARSEST_DOUBT = 0.005  # relative: how differently the coarsest grid may order choices of sides; 0.0035 was measured
_GRID_DOUBT = 0.002  # the same of the coarse grid; 0.0007 was measured
_GRIPPING_ITERATIONS = 300  # of the coarse searches of a robot that has to grip: 130 to 270 are common
_GRIPPING_DOUBT = 0.02  # in place of both doubts: predictions leave friction out, coarse grids are rough about it
_STRAIGHT_SECONDS = 3.0  # how long the guessed motion without obstacles takes
_RESERVES = (1.0, 0.3, 0.0)  # shares of what a plan to track leaves unused, from the first that allows a plan

_Start = tuple[int, np.ndarray, np.ndarray]  # index of a path, states (n+1, 8) and actions (n, 2) to start from

ALL_GUESSES = 2**10
"""`guesses` that make `find_optimum` solve every guess."""


@dataclass(frozen=True)
class Optimum:
    """The best episode found: its cost, trajectory (forces held), and what the solver said of it.

    `status` is "optimal" if the solver converged, and else "feasible": such an episode obeys every constraint, and a cheaper
    one may be near. `solver_status` is the solver's own word. `guess` is the index of the guessed path that led to it, or
    `FROM_RIGHTING`. `seconds` is the wall time of the whole search, `solver_seconds` the part in solvers, and
    `setup_seconds` the part that differentiated and compiled. `costates` (n, 8) are the slopes of the remaining cost with
    respect to the states x_1 … x_n; they are 0 for a simulated episode.
    """

    cost: float
    trajectory: Trajectory
    status: Literal["optimal", "feasible"]
    solver_status: str
    violation: float
    iterations: int
    solver: str
    guess: int
    seconds: float
    solver_seconds: float
    setup_seconds: float
    costates: np.ndarray

    @property
    def is_optimal(self) -> bool:
        """Whether the solver converged."""
        return self.status == "optimal"


@dataclass(frozen=True)
class Backoff:
    """How far a plan stays from its limits, so that a controller that tracks it stays within them.

    `margin` is in the unit of the task's margins (obstacles: m). `goal` is the fraction of the goal's tolerance that the plan
    leaves unused. `force` is the fraction of the force limit that the plan leaves for feedback. `grip` is the fraction
    of the robot's weight that it leaves of the normal force, and so of the friction, where friction is limited.

    Raises:
        ValueError: a field is negative or not finite, or a fraction is not below 1.
    """

    # The defaults make up for the solvers' tolerance, so that optimal forces and states obey the limits exactly.
    margin: float = 1e-7
    goal: float = 1e-6
    force: float = 1e-7
    grip: float = 1e-5

    def __post_init__(self) -> None:
        for name, below in (("margin", math.inf), ("goal", 1.0), ("force", 1.0), ("grip", 1.0)):
            value = getattr(self, name)
            if not is_number(value):
                raise ValueError(f"Backoff: {name} must be a number, not {value!r}")
            if not 0 <= value < below:
                raise ValueError(f"Backoff: {name} must be at least 0 and below {below:g}, not {value}")

    def times(self, share: float) -> "Backoff":
        """A share of it; fields that are more than the defaults stay so."""
        least = asdict(Backoff())
        return Backoff(**{name: min(value, max(share * value, least[name])) for name, value in asdict(self).items()})


def find_optimum(
    task: Task,
    params: BallbotParams,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff = Backoff(),
    guesses: int = _CONSIDERED,
    paths: list[np.ndarray] | None = None,
) -> Optimum:
    """The cheapest episode from state x0 with constants c.

    Args:
        task: the problem.
        params: the robot.
        x0: (8,) initial state.
        c: (nc,) constants of the episode.
        backoff: distance kept from limits; none for the true optimum.
        guesses: how many of the task's guessed paths to solve at most. For a slalom all choices of sides are considered, and
            those that `sides.predict` finds likely are solved; `ALL_GUESSES` solves every one.
        paths: ground paths to start from instead of the task's.

    Returns:
        The cheapest optimum found. If no try converged, the cheapest feasible episode found; look at `status`.

    Raises:
        PlanError: no try came to a feasible episode.
    """
    x0, c = np.asarray(x0, np.float64), np.asarray(c, np.float64)
    own_paths = paths is None
    paths = task.guess_paths(x0, c, params) if paths is None else paths
    likely = own_paths and guesses > 1 and task.steps % _COARSE == 0
    obstacles = task.passed_obstacles(c) if likely else None
    paths = paths if obstacles is not None else paths[: guesses if own_paths else None]
    started, before = time.perf_counter(), (spent.solving, spent.setup)
    solve = _solve_first_exit if task.first_exit else _solve_fixed_time
    alone = own_paths and len(paths) == 1 and not task.first_exit
    if obstacles is not None:
        tried = _solve_likely_sides(task, params, x0, c, backoff, paths, guesses, obstacles)
        if guesses >= ALL_GUESSES or not tried:
            tried += solve(task, params, x0, c, backoff, paths[:guesses])
    elif alone:
        tried = _solve_quickly(task, params, x0, c, backoff, paths)
    else:
        tried = solve(task, params, x0, c, backoff, paths)
    if not _any_optimal(tried):
        tried += _solve_from_righting(task, params, x0, c, backoff)
    if alone and not _any_optimal(tried):
        tried += _solve_quickly(task, params, x0, c, backoff, paths, _HIGH_BARRIER)
    if alone and not _any_optimal(tried):
        tried += _solve_fixed_time(task, params, x0, c, backoff, paths)
    best = min((t for t in tried if is_within_limits(t[1])), key=_rank, default=None)
    if best is None:
        tries = "; ".join(f"{s.solver}: {s.status}, violation {s.violation:.1e}" for _, s in tried)
        raise PlanError(f"{task.id}: no feasible episode from x = {x0.tolist()}, c = {c.tolist()} ({tries})")
    index, solution = best
    return Optimum(
        cost=solution.cost,
        trajectory=Trajectory(
            task.control_dt * np.arange(len(solution.states)), solution.states, params.force_limit * solution.inputs
        ),
        status="optimal" if is_feasible(solution) else "feasible",
        solver_status=solution.status,
        violation=solution.violation,
        iterations=solution.iterations,
        solver=solution.solver,
        guess=index,
        seconds=time.perf_counter() - started,
        solver_seconds=spent.solving - before[0],
        setup_seconds=spent.setup - before[1],
        costates=solution.costates,
    )


def plan_to_track(task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray, backoff: Backoff) -> Optimum:
    """As `find_optimum`, for feedback to track: with less friction or force in reserve where there is no plan with more.

    Args: as of `find_optimum`.

    Raises:
        PlanError: no try came to a feasible episode.
    """
    parts = [backoff.times(share) for share in _RESERVES]
    tries = [replace(backoff, force=part.force, grip=part.grip if params.grips else backoff.grip) for part in parts]
    *more, last = dict.fromkeys(tries)
    for reserve in more:
        try:
            return find_optimum(task, params, x0, c, reserve)
        except PlanError:
            pass
    return find_optimum(task, params, x0, c, last)


def is_feasible(solution: OcpSolution) -> bool:
    """Converged, and within `FEASIBLE` of every constraint."""
    return solution.success and is_within_limits(solution)


def is_within_limits(solution: OcpSolution) -> bool:
    """Within `FEASIBLE` of every constraint, converged or not."""
    return bool(solution.violation < FEASIBLE and np.isfinite(solution.cost))


def _any_optimal(tried: list[tuple[int, OcpSolution]]) -> bool:
    return any(is_feasible(solution) for _, solution in tried)


def _rank(tried: tuple[int, OcpSolution]) -> tuple[bool, float]:
    """Optima come before feasible episodes, and cheap ones before dear ones."""
    return not tried[1].success, tried[1].cost


@lru_cache(maxsize=64)
def shooting_ocp(task: Task, params: BallbotParams) -> Ocp:
    """A task on its env's discretization, or with forces held longer than its control steps.

    Inputs are actions, force / limit; `shooting_parameters` gives p. How long forces are held comes first in it, so that
    problems on fine and coarse grids share all compiled functions, and all tasks of a robot share those of the dynamics.
    """
    nc, limit = len(task.constant_names), params.force_limit

    def margins(x: casadi.SX, p: casadi.SX) -> casadi.SX:
        return casadi.vertcat(*task.margins(x, p[1 : 1 + nc])) - p[1 + nc]

    def path(x: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        return casadi.vertcat(margins(x, p), *dynamics.limits(params, x, limit * a, p[3 + nc], p[0]))

    def final(x: casadi.SX, p: casadi.SX) -> casadi.SX:
        if not task.first_exit:
            return margins(x, p)
        return casadi.vertcat(margins(x, p), _goal_room(task, x, p, nc))

    return Ocp(
        name=task.id,
        states=8,
        inputs=2,
        params=nc + 3 + params.grips,
        next=lambda x, a, p: dynamics.step(params, x, limit * a, p[0], dynamics.substeps_for(task.control_dt)),
        cost=lambda x, a, p: task.cost(x, limit * a, p[1 : 1 + nc]) * p[0],
        inequalities=path if params.grips else lambda x, a, p: margins(x, p),
        final_inequalities=final,
    )


def free_time_ocp(task: Task, params: BallbotParams) -> Ocp:
    """A first-exit task over intervals of one free length h, the ninth state. Its solution tells roughly when to arrive."""
    nc = len(task.constant_names)
    fixed, limit = shooting_ocp(task, params), params.force_limit
    return replace(
        fixed,
        name=f"{task.id}-free-time",
        states=9,
        next=lambda s, a, p: casadi.vertcat(dynamics.step(params, s[:8], limit * a, s[8], 2), s[8]),
        cost=lambda s, a, p: task.cost(s[:8], limit * a, p[1 : 1 + nc]) * s[8],
        inequalities=lambda s, a, p: fixed.inequalities(s[:8], a, p),
        final_inequalities=lambda s, p: fixed.final_inequalities(s[:8], p),
    )


def shooting_parameters(
    task: Task, params: BallbotParams, c: np.ndarray, backoff: Backoff, coarseness: int = 1
) -> list[float]:
    """p of `shooting_ocp`: s that forces are held, c, back-offs from margins and goal, and of grip if friction is limited."""
    return [
        task.control_dt * coarseness,
        *c,
        backoff.margin,
        backoff.goal,
        *([backoff.grip] if params.grips else []),
    ]


def _goal_room(task: Task, x: casadi.SX, p: casadi.SX, nc: int) -> casadi.SX:
    # Goal functions are normalized, q/tolerance² − 1: keeping a fraction b of the tolerance asks (1−b)² − 1 − g ≥ 0.
    return (1 - p[2 + nc]) ** 2 - 1 - casadi.vertcat(*task.goal(x, p[1 : 1 + nc]))


@lru_cache(maxsize=256)
def _solver(
    task: Task,
    params: BallbotParams,
    steps: int,
    solver: str,
    iterations: int = _MOST_ITERATIONS,
    barrier: float = _BARRIER,
    tolerance: float | None = None,
) -> OcpSolver:
    ocp = shooting_ocp(task, params)
    tolerance = tolerance or _tolerance(params)
    return OcpSolver(ocp, steps, solver, tolerance, max_iterations=iterations, barrier=barrier)


@lru_cache(maxsize=8)
def _free_time_solver(task: Task, params: BallbotParams, solver: str) -> OcpSolver:
    return OcpSolver(free_time_ocp(task, params), _FREE_TIME_INTERVALS, solver, _tolerance(params))


def _tolerance(params: BallbotParams) -> float:
    """Of the solvers. On the friction cone fatrop stalls between 1e-7 and 1e-8, at the same cost to 7 digits."""
    return 1e-6 if params.grips else 1e-8


def _bounds(ocp: Ocp, n: int, x0: np.ndarray, backoff: Backoff) -> Bounds:
    bounds = Bounds.free(ocp, n)
    bounds.state_lower[0, :8] = bounds.state_upper[0, :8] = x0
    bounds.input_lower[:], bounds.input_upper[:] = backoff.force - 1, 1 - backoff.force
    return bounds


def _solve_from(
    task: Task, params: BallbotParams, x: np.ndarray, a: np.ndarray, c: np.ndarray, backoff: Backoff, near: bool = False
) -> list[OcpSolution]:
    """Solves with fatrop from guessed states (n+1, 8) and actions (n, 2). If fatrop fails, ipopt tries the same guess.

    `near` says that the guess solves nearly the same problem.
    """
    tries = [("fatrop", _NEAR_BARRIER)] if near else []
    solutions = []
    for name, barrier in (*tries, ("fatrop", _BARRIER), ("ipopt", _BARRIER)):
        solver = _solver(task, params, len(a), name, barrier=barrier)
        solutions.append(_solve_with(solver, task, params, x, a, c, backoff))
        if is_feasible(solutions[-1]):
            break
    return solutions


def _solve_with(
    solver: OcpSolver,
    task: Task,
    params: BallbotParams,
    x: np.ndarray,
    a: np.ndarray,
    c: np.ndarray,
    backoff: Backoff,
    coarseness: int = 1,
) -> OcpSolution:
    bounds = _bounds(solver.ocp, len(a), x[0], backoff)
    return solver.solve(x, a, bounds, shooting_parameters(task, params, c, backoff, coarseness))


def _solve_fixed_time(
    task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray, backoff: Backoff, paths: list[np.ndarray]
) -> list[tuple[int, OcpSolution]]:
    """Every solution found, with the index of the path it came from.

    With several paths, each is first solved with forces held for two control steps. That takes half the time and suffices to
    compare the paths. Only the paths that may be the best are then solved in full.
    """
    starts, fine = _starts(task, params, x0, paths), []
    if len(paths) > 1 and task.steps % _COARSE == 0:
        fine = _contenders(task, params, x0, c, backoff, starts)
    return _solve_all(task, params, c, backoff, fine or starts, near=bool(fine))


def _solve_all(
    task: Task, params: BallbotParams, c: np.ndarray, backoff: Backoff, starts: list[_Start], near: bool
) -> list[tuple[int, OcpSolution]]:
    """From every start; `near` as of `_solve_from`."""
    return [(i, s) for i, x, a in starts for s in _solve_from(task, params, x, a, c, backoff, near)]


def _solve_quickly(
    task: Task,
    params: BallbotParams,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff,
    paths: list[np.ndarray],
    barrier: float = _BARRIER,
) -> list[tuple[int, OcpSolution]]:
    """From every path with fatrop and few iterations: a second guess is worth more than many iterations from a bad one."""
    solver = _solver(task, params, task.steps, "fatrop", iterations=_QUICK_ITERATIONS, barrier=barrier)
    return [(i, _solve_with(solver, task, params, x, a, c, backoff)) for i, x, a in _starts(task, params, x0, paths)]


def _starts(task: Task, params: BallbotParams, x0: np.ndarray, paths: list[np.ndarray]) -> list[_Start]:
    """Index, states (n+1, 8) and actions (n, 2) along each path."""
    starts = [guess.along_path(params, path, task.control_dt, start=x0) for path in paths]
    return [(i, x, u / params.force_limit) for i, (x, u) in enumerate(starts)]


def _solve_from_righting(
    task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray, backoff: Backoff
) -> list[tuple[int, OcpSolution]]:
    """Solutions from simulated recoveries, to either side of the fall; and those recoveries that are episodes themselves.

    The recovery within the plane of the fall is tried last, because it may lead to a saddle point.
    """
    found = []
    for member in righting.righted(task, params, x0, c, (1 - backoff.force) * params.force_limit):
        found += [(FROM_RIGHTING, s) for s in _simulated(task, params, member, c, backoff)]
        if member.side == 0 and _any_optimal(found):
            break
        for x, u in righting.guesses(task, params, member, c):
            a = u / params.force_limit
            if task.first_exit:
                relaxed = _relax_time(task, params, x, a, c, backoff)
                solved = _whole_steps(task, params, c, backoff, relaxed) if is_feasible(relaxed) else [relaxed]
            else:
                solved = [_solve_with(_solver(task, params, len(a), "fatrop"), task, params, x, a, c, backoff)]
            found += [(FROM_RIGHTING, s) for s in solved]
    return found


def _simulated(
    task: Task, params: BallbotParams, member: righting.Member, c: np.ndarray, backoff: Backoff
) -> list[OcpSolution]:
    """A simulated recovery as a solution, if it lasts the whole episode."""
    if task.first_exit or len(member.u) < task.steps:
        return []
    room = [(1 - backoff.goal) ** 2 - 1 - np.asarray(excess) for excess in task.goal(member.x[-1], c)]
    room += [np.asarray(margin) - backoff.margin for margin in task.margins(member.x, c)]
    room += dynamics.limits(params, member.x[:-1], member.u, backoff.grip, task.control_dt)
    return [
        OcpSolution(
            success=False,
            status="simulated feedback",
            cost=member.cost,
            states=member.x,
            inputs=member.u / params.force_limit,
            violation=max(0.0, -min(float(np.min(part)) for part in room)),
            iterations=0,
            seconds=0.0,
            solver="simulation",
            costates=np.zeros((len(member.u), 8)),
        )
    ]


def _solve_likely_sides(
    task: Task,
    params: BallbotParams,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff,
    paths: list[np.ndarray],
    most: int,
    obstacles: np.ndarray,
) -> list[tuple[int, OcpSolution]]:
    """As `_solve_fixed_time`, but of all choices of sides only those are solved that are predicted to be the best, or nearly.

    The motion without obstacles comes first: it takes few iterations, and it predicts what every choice costs, and how the
    robot then moves. Each search starts from that predicted motion, and from the choice's guessed path if that fails. Where
    there is no motion without obstacles, nothing is solved.
    """
    iterations, side_doubt, grid_doubt = _QUICK_ITERATIONS, _SIDE_DOUBT, _GRID_DOUBT
    coarsest, tolerance = (_COARSEST if task.steps % _COARSEST == 0 else _COARSE), _ROUGH
    if params.grips:
        iterations, side_doubt, grid_doubt = _GRIPPING_ITERATIONS, _GRIPPING_DOUBT, _GRIPPING_DOUBT
        coarsest, tolerance = _COARSE, None

    def solved_from(path: np.ndarray, c: np.ndarray, barrier: float) -> OcpSolution:
        solver = _solver(task, params, task.steps // coarsest, "fatrop", iterations, barrier, tolerance)
        x, u = guess.along_path(params, path, task.control_dt, start=x0)
        return _solve_with(
            solver, task, params, x[::coarsest], u[::coarsest] / params.force_limit, c, backoff, coarsest
        )

    free = solved_from(_straight(task, params, x0, c), task.without_obstacles(c), _NEAR_BARRIER)
    if not free.success:
        return []
    along = guess.resampled(free.states[:, :2], task.steps)
    prediction = sides.predict(task, params, x0, c, along, obstacles)
    rows = {tuple(side): row for row, side in enumerate(prediction.sides.tolist())}
    row_of = [rows[_side_choice(path, obstacles)] for path in paths]
    predicted = free.cost + prediction.costs[row_of]
    solved: list[tuple[int, OcpSolution]] = []
    for i in np.argsort(predicted, kind="stable")[:most].tolist():
        if solved and predicted[i] > predicted[solved[0][0]] * (1 + side_doubt):
            break
        motion = np.column_stack([along[:, 0], prediction.y[row_of[i]]])
        for start, barrier in ((motion, _NEAR_BARRIER), (motion, _BARRIER), (paths[i], _BARRIER)):
            solution = solved_from(start, c, barrier)
            if solution.success:
                solved.append((i, solution))
                break
    if coarsest > _COARSE and len(_distinct(solved, _COARSEST_DOUBT)) > 1:
        solved = _on_coarse_grid(task, params, c, backoff, _distinct(solved, _COARSEST_DOUBT)) or solved
    fine = _refined(task, solved, grid_doubt)
    starts = fine or _starts(task, params, x0, paths[:most])
    return _solve_all(task, params, c, backoff, starts, near=bool(fine))


def _on_coarse_grid(
    task: Task, params: BallbotParams, c: np.ndarray, backoff: Backoff, solved: list[tuple[int, OcpSolution]]
) -> list[tuple[int, OcpSolution]]:
    """Solutions with forces held for `_COARSE` control steps, from those on the coarsest grid."""
    n = task.steps // _COARSE
    solver = _solver(task, params, n, "fatrop", _QUICK_ITERATIONS, _NEAR_BARRIER, _ROUGH)
    found = [(i, _solve_with(solver, task, params, *_on_grid(s, n), c, backoff, _COARSE)) for i, s in solved]
    return [(i, solution) for i, solution in found if solution.success]


def _straight(task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(steps+1, 2) m, from the position and velocity of x0 to rest where the task's reference ends."""
    goal = task.reference(x0, c, params).x[-1, :2]
    steps = min(task.steps, round(_STRAIGHT_SECONDS / task.control_dt))
    return then_stay(cubic(x0[:2], x0[4:6], goal, np.zeros(2), steps, task.control_dt), task.steps)


def _side_choice(path: np.ndarray, obstacles: np.ndarray) -> tuple[int, ...]:
    """The sides on which a guessed path passes obstacles (n, 3), where it crosses their x."""
    nearest = [int(np.argmin(np.abs(path[:, 0] - x))) for x in obstacles[:, 0]]
    return tuple(1 if path[k, 1] > y else -1 for k, y in zip(nearest, obstacles[:, 1], strict=True))


def _contenders(
    task: Task,
    params: BallbotParams,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff,
    starts: list[_Start],
) -> list[_Start]:
    """Starts at the coarse solutions within `_BASIN_DOUBT` of the best; none, if no coarse solution is feasible."""
    n = task.steps // _COARSE
    solver = _solver(task, params, n, "fatrop")
    solved = []
    for index, x, a in starts:
        solution = _solve_with(solver, task, params, x[::_COARSE], a[::_COARSE], c, backoff, _COARSE)
        if is_feasible(solution):
            solved.append((index, solution))
    return _refined(task, solved)


def _refined(task: Task, solved: list[tuple[int, OcpSolution]], doubt: float = _BASIN_DOUBT) -> list[_Start]:
    """Starts at the coarse solutions within a relative `doubt` of the best."""
    return [(index, *_on_grid(solution, task.steps)) for index, solution in _distinct(solved, doubt)]


def _on_grid(solution: OcpSolution, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States and actions of a solution on a finer grid."""
    return guess.resampled(solution.states, steps), np.repeat(solution.inputs, steps // len(solution.inputs), axis=0)


def _distinct(solved: list[tuple[int, OcpSolution]], doubt: float = _BASIN_DOUBT) -> list[tuple[int, OcpSolution]]:
    """The solutions within a relative `doubt` of the best, sorted by cost, without repetitions."""
    kept: list[tuple[int, OcpSolution]] = []
    for index, solution in sorted(solved, key=lambda pair: pair[1].cost):
        contends = not kept or solution.cost < kept[0][1].cost * (1 + doubt)
        if contends and not any(math.isclose(solution.cost, k.cost, rel_tol=1e-5) for _, k in kept):
            kept.append((index, solution))
    return kept


def _solve_first_exit(
    task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray, backoff: Backoff, paths: list[np.ndarray]
) -> list[tuple[int, OcpSolution]]:
    """Every solution found, with the index of the path it came from.

    Each path is first solved with a free interval length, which gives its cost and its time of arrival. The best are then
    solved again for whole numbers of control steps near that time.
    """
    tried = [(i, _solve_free_time(task, params, x0, c, backoff, path)) for i, path in enumerate(paths)]
    found = [t for t in tried if not is_feasible(t[1])]
    for index, solution in _distinct([t for t in tried if is_feasible(t[1])]):
        found += [(index, s) for s in _whole_steps(task, params, c, backoff, solution)]
    return found


def _solve_free_time(
    task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray, backoff: Backoff, path: np.ndarray
) -> OcpSolution:
    n = _FREE_TIME_INTERVALS
    h = (len(path) - 1) * task.control_dt / n
    x, u = guess.along_path(params, guess.resampled(path, n), h, start=x0)
    return _in_free_time(task, params, x, u / params.force_limit, h, c, backoff)


def _relax_time(
    task: Task, params: BallbotParams, x: np.ndarray, a: np.ndarray, c: np.ndarray, backoff: Backoff
) -> OcpSolution:
    """The solution with a free interval length from states and actions at control steps."""
    n = _FREE_TIME_INTERVALS
    actions = guess.resampled(np.vstack([a, a[-1:]]), n)[:-1]
    h = len(a) * task.control_dt / n
    return _in_free_time(task, params, guess.resampled(x, n), actions, h, c, backoff)


def _in_free_time(
    task: Task, params: BallbotParams, x: np.ndarray, a: np.ndarray, h: float, c: np.ndarray, backoff: Backoff
) -> OcpSolution:
    n = len(a)
    for name in ("fatrop", "ipopt"):
        solver = _free_time_solver(task, params, name)
        bounds = _bounds(solver.ocp, n, x[0], backoff)
        bounds.state_lower[:, 8], bounds.state_upper[:, 8] = task.control_dt / 4, task.duration / n
        states = np.column_stack([x, np.full(n + 1, h)])
        solution = solver.solve(states, a, bounds, shooting_parameters(task, params, c, backoff))
        if is_feasible(solution):
            break
    return solution


def _whole_steps(
    task: Task, params: BallbotParams, c: np.ndarray, backoff: Backoff, relaxed: OcpSolution
) -> list[OcpSolution]:
    """Solutions that arrive after whole numbers of control steps: from the relaxed time, both ways while the cost falls."""
    arrival = relaxed.states[0, 8] * _FREE_TIME_INTERVALS / task.control_dt
    steps = min(max(1, math.ceil(arrival)), task.steps)
    groups = {steps: _at_steps(task, params, c, backoff, relaxed, steps)}
    for direction in (-1, 1):
        nearby = steps + direction
        while 1 <= nearby <= task.steps:
            groups[nearby] = _at_steps(task, params, c, backoff, relaxed, nearby)
            if not _better(groups[nearby][-1], groups[nearby - direction][-1]):
                break
            nearby += direction
    return [solution for group in groups.values() for solution in group]


def _better(a: OcpSolution, b: OcpSolution) -> bool:
    return is_feasible(a) and (not is_feasible(b) or a.cost < b.cost)


def _at_steps(
    task: Task, params: BallbotParams, c: np.ndarray, backoff: Backoff, relaxed: OcpSolution, steps: int
) -> list[OcpSolution]:
    x = guess.resampled(relaxed.states[:, :8], steps)
    a = guess.resampled(np.vstack([relaxed.inputs, relaxed.inputs[-1:]]), steps)[:-1]
    return _solve_from(task, params, x, a, c, backoff, near=True)
