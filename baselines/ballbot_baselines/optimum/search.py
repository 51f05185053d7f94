"""Which guesses the optimum of an episode is searched from, and in which order.

Each guess is one of the task's ground paths. The choices of sides in a slalom are predicted first (`sides.py`). If no path
leads to a solution, the search starts from simulated recoveries (`righting.py`).
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ballbot_baselines.optimum import sides
from ballbot_baselines.optimum.guesses import (
    ALL_GUESSES,
    BASIN_DOUBT,
    COARSE,
    contenders,
    straight_path,
)
from ballbot_baselines.solvers import guess, righting
from ballbot_baselines.solvers.ocp import Solution
from ballbot_baselines.solvers.shooting import BARRIER, FREE_TIME_INTERVALS, NEAR_BARRIER, Shooting
from ballbot_gym.tasks.paths import sides_passed

_QUICK_ITERATIONS = 80  # of the first try where there is one guessed path; a second guess is tried before more
_HIGH_BARRIER = 1.0  # from one start in thousands fatrop goes in circles with the usual one, and not with this
_COARSEST = 4  # the same when choices of sides are compared first
_ROUGH = 1e-4  # tolerance there: costs are then right to 1e-5 of their value, in four iterations less
_COARSEST_DOUBT = 0.005  # relative: how differently the coarsest grid may order choices of sides; 0.0035 was measured
_GRID_DOUBT = 0.002  # the same of the coarse grid; 0.0007 was measured
_GRIPPING_ITERATIONS = 300  # of the coarse searches of a robot that has to grip: 130 to 270 are common


def attempts(episode: Shooting, guesses: int, given: list[np.ndarray] | None) -> Iterator[list[Solution]]:
    """Every solution found, one kind of guess after the other. The first kind that leads to an optimum suffices.

    Args:
        episode: the problem.
        guesses: how many of the task's guessed paths to solve at most.
        given: ground paths to start from instead of the task's.
    """
    task, x0, c, params = episode.task, episode.x0, episode.c, episode.params
    if given is None and (cases := task.search_cases(episode)) is not None:
        yield cases
        return
    paths = task.guess_paths(x0, c, params) if given is None else given
    if not paths:
        yield _from_states(episode, task.guesses(x0, c, params)[:guesses])
        return
    likely = given is None and guesses > 1 and task.steps % COARSE == 0
    obstacles = task.passed_obstacles(c) if likely else None
    if obstacles is not None:
        found = _from_likely_sides(episode, paths, guesses, obstacles)
        yield found + (_from_paths(episode, paths[:guesses]) if guesses >= ALL_GUESSES or not found else [])
        yield _from_righting(episode)
        return
    if given is None:
        paths = paths[:guesses]
    alone = given is None and len(paths) == 1 and not task.first_exit
    yield _quickly(episode, paths[0], BARRIER) if alone else _from_paths(episode, paths)
    yield _from_righting(episode)
    if alone:
        yield _quickly(episode, paths[0], _HIGH_BARRIER)
        yield _from_paths(episode, paths)


def _from_states(episode: Shooting, guesses: list[tuple[np.ndarray, np.ndarray]]) -> list[Solution]:
    """Every solution found from guessed states and actions."""
    task, limit, found = episode.task, episode.params.force_limit, list[Solution]()
    for x, u in guesses:
        if task.first_exit:
            relaxed = episode.relaxed(x, u / limit, task.control_dt)
            found += episode.in_whole_steps(relaxed) if relaxed.is_optimal else [relaxed]
        else:
            found += episode.solve_to_the_end(x, u / limit)
    return found


def _quickly(episode: Shooting, path: np.ndarray, barrier: float) -> list[Solution]:
    """With fatrop and few iterations: a second guess is worth more than many iterations from a bad one."""
    return [episode.solve(*episode.along(path), barrier=barrier, iterations=_QUICK_ITERATIONS)]


def _from_paths(episode: Shooting, paths: list[np.ndarray]) -> list[Solution]:
    """Every solution found.

    Paths of first-exit tasks are first solved with a free interval length, which gives their costs and their times of
    arrival. The best are then solved again for whole numbers of control steps near those times. Several paths of another task
    are first solved with forces held for two control steps. That takes half the time and suffices to compare them. Only the
    paths that may be the best are then solved in full.
    """
    task = episode.task
    if task.first_exit:
        tried = []
        for path in paths:
            h = (len(path) - 1) * task.control_dt / FREE_TIME_INTERVALS
            tried.append(episode.relaxed(*episode.along(guess.resampled(path, FREE_TIME_INTERVALS), h), h))
        found = [solution for solution in tried if not solution.is_optimal]
        for relaxed in _distinct([solution for solution in tried if solution.is_optimal], BASIN_DOUBT):
            found += episode.in_whole_steps(relaxed)
        return found
    if len(paths) == 1 or task.steps % COARSE:
        return _refined(episode, [], BASIN_DOUBT, paths)
    starts = [episode.along(path) for path in paths]
    coarse = [episode.solve(x[::COARSE], a[::COARSE], COARSE) for x, a in starts]
    return _refined(episode, [solution for solution in coarse if solution.is_optimal], BASIN_DOUBT, paths)


def _refined(episode: Shooting, coarse: list[Solution], doubt: float, paths: list[np.ndarray]) -> list[Solution]:
    """Solves from the coarse solutions within a relative `doubt` of the best; along the paths, if there are none."""
    near = [_on_grid(solution, episode.task.steps) for solution in _distinct(coarse, doubt)]
    starts, barrier = (near, NEAR_BARRIER) if near else (map(episode.along, paths), BARRIER)
    return [solution for x, a in starts for solution in episode.solve_to_the_end(x, a, barrier)]


def _on_grid(solution: Solution, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States and actions of a solution on a finer grid."""
    return guess.resampled(solution.states, steps), np.repeat(solution.inputs, steps // len(solution.inputs), axis=0)


def _distinct(solved: list[Solution], doubt: float) -> list[Solution]:
    """Those of the solutions that are `contenders`."""
    costs = [solution.cost for solution in solved]
    found = contenders(costs, doubt, lambda i, j: math.isclose(costs[i], costs[j], rel_tol=1e-5))
    return [solved[i] for i in found]


# --- simulated recoveries ---


def _from_righting(episode: Shooting) -> list[Solution]:
    """Solutions from simulated recoveries, to either side of the fall; and those recoveries that are episodes themselves.

    The recovery within the plane of the fall is tried last, because it may lead to a saddle point.
    """
    task, params, c, limit = episode.task, episode.params, episode.c, episode.params.force_limit
    found: list[Solution] = []
    for member in righting.righted(task, params, episode.x0, c, (1 - episode.backoff.force) * limit, episode.start):
        if not task.first_exit and len(member.u) == task.steps:
            found.append(_simulated(episode, member.x, member.u, member.cost))
        if member.side == 0 and any(solution.is_optimal for solution in found):
            break
        for x, u in member.guesses(task, params, c):
            if task.first_exit:
                relaxed = episode.relaxed(x, u / limit, task.control_dt)
                found += episode.in_whole_steps(relaxed) if relaxed.is_optimal else [relaxed]
            else:
                found.append(episode.solve(x, u / limit))
    return found


def _simulated(episode: Shooting, x: np.ndarray, u: np.ndarray, cost: float) -> Solution:
    """A simulated recovery that lasts the whole episode as a solution."""
    task, params, c, backoff = episode.task, episode.params, episode.c, episode.backoff
    t = episode.start + task.control_dt * np.arange(len(x))
    room = [(1 - backoff.goal) ** 2 - 1 - np.asarray(excess) for excess in task.goal(x[-1], task.at(c, t[-1]))]
    room += [np.asarray(margin) - backoff.margin for margin in task.margins(x, task.at(c, t))]
    room += params.limits(x[:-1], u, backoff.grip, task.control_dt)
    return Solution(
        success=False,
        status="simulated feedback",
        cost=cost,
        states=x,
        inputs=u / params.force_limit,
        violation=max(0.0, -min(float(np.min(part)) for part in room)),
        iterations=0,
        solver="simulation",
        slopes=np.zeros((len(x), params.state_size)),
    )


# --- the sides of a slalom ---


def _from_likely_sides(episode: Shooting, paths: list[np.ndarray], most: int, obstacles: np.ndarray) -> list[Solution]:
    """As `_from_paths`, but of all choices of sides only those are solved that are predicted to be the best, or nearly.

    The motion without obstacles comes first: it takes few iterations, and it predicts what every choice costs, and how the
    robot then moves. Each search starts from that predicted motion, and from the choice's guessed path if that fails. Where
    there is no motion without obstacles, nothing is solved.
    """
    task, params, x0, c = episode.task, episode.params, episode.x0, episode.c
    iterations, grid_doubt = _QUICK_ITERATIONS, _GRID_DOUBT
    coarsest, tolerance = (_COARSEST if task.steps % _COARSEST == 0 else COARSE), _ROUGH
    if params.grips:
        iterations, grid_doubt = _GRIPPING_ITERATIONS, sides.GRIPPING_DOUBT
        coarsest, tolerance = COARSE, None

    def solved_from(path: np.ndarray, barrier: float, episode: Shooting = episode) -> Solution:
        x, a = (part[::coarsest] for part in episode.along(path))
        return episode.solve(x, a, coarsest, barrier=barrier, iterations=iterations, tolerance=tolerance)

    free = solved_from(straight_path(task, params, x0, c), NEAR_BARRIER, replace(episode, c=task.without_obstacles(c)))
    if not free.success:
        return []
    motion = guess.resampled(free.states[:, :2], task.steps)
    goal_y = task.reference(x0, c, params).x[-1, 1:2]
    prediction = sides.predict(task, params, x0[None], goal_y, motion[None, :, 0], obstacles[None])
    rows = {tuple(side): row for row, side in enumerate(prediction.sides.tolist())}
    row_of = [rows[sides_passed(path, obstacles)] for path in paths]
    predicted, across = free.cost + prediction.costs[0, row_of], prediction.y(0)[row_of]
    solved: list[Solution] = []
    least = math.inf  # that was predicted of a choice that is solved
    for i in np.argsort(predicted, kind="stable")[:most].tolist():
        if predicted[i] > least * (1 + prediction.doubt):
            break
        motion = np.column_stack([motion[:, 0], across[i]])
        for start, barrier in ((motion, NEAR_BARRIER), (motion, BARRIER), (paths[i], BARRIER)):
            solution = solved_from(start, barrier)
            if solution.success:
                solved.append(solution)
                least = min(least, predicted[i])
                break
    if coarsest > COARSE and len(_distinct(solved, _COARSEST_DOUBT)) > 1:
        solved = _on_coarse_grid(episode, _distinct(solved, _COARSEST_DOUBT)) or solved
    return _refined(episode, solved, grid_doubt, paths[:most])


def _on_coarse_grid(episode: Shooting, solved: list[Solution]) -> list[Solution]:
    """Solutions with forces held for `COARSE` control steps, from those on the coarsest grid."""
    n = episode.task.steps // COARSE
    rough = {"barrier": NEAR_BARRIER, "iterations": _QUICK_ITERATIONS, "tolerance": _ROUGH}
    found = [episode.solve(*_on_grid(solution, n), COARSE, **rough) for solution in solved]
    return [solution for solution in found if solution.success]
