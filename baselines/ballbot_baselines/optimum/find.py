"""The optimum of any episode of any task, on the env's own discretization (`shooting.py`).

An episode under physics="rk4" that follows the optimal trajectory returns minus its cost. There are two searches, because
each finds what the other misses. `search.py` solves one episode by multiple shooting, from each of the task's guessed paths,
and from simulated recoveries where no path leads to a solution. `batched.py` solves thousands together by iLQR, from other
guesses. The best solution is kept. It is feasible and locally optimal. It is the global optimum if one of the guesses leads
there. What regrets are measured against is searched `twice`, by both.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ballbot_baselines.optimum import batched
from ballbot_baselines.optimum.guesses import CONSIDERED
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.optimum.search import attempts
from ballbot_baselines.solvers.ocp import Solution
from ballbot_baselines.solvers.riccati import tube_gains
from ballbot_baselines.solvers.shooting import SAME_BARRIER, Backoff, Shooting
from ballbot_gym import certified
from ballbot_gym.checks import finite_array
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.robot import Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.paths import sides_passed
from ballbot_gym.trajectory import Trajectory

_NO_CHEAPER = 1e-6  # relative
_SLALOM_GUESSES = 32  # random ones of the second search
_RESERVES = (1.0, 0.3, 0.0)  # shares of what a plan to track leaves unused, from the first that allows a plan


def find_optimum(
    task: str | Task,
    params: str | Robot,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff = Backoff(),
    guesses: int = CONSIDERED,
    paths: list[np.ndarray] | None = None,
    start: float = 0.0,
    twice: bool | Optimum = False,
) -> Optimum:
    """The optimum of an episode: the motion with the lowest cost from state x0 with constants c.

    Args:
        task: the problem, or its name in `TASKS`.
        params: the robot, or its name in `ROBOTS`; "paper" stands for the robot that the task names, as everywhere.
        x0: (8,) initial state, m, rad, m/s, rad/s; order in `Ballbot.STATE`; (11,) with wheels.
        c: (nc,) constants of the episode, named in the task's `constant_names`; (0,) where it has none.
        backoff: distance from the limits that the motion keeps; default, none, for the true optimum.
        guesses: largest number of the task's guessed paths to solve. For a slalom, the costs of all choices of sides are
            predicted by `sides.predict`, and the likely ones are solved; `ALL_GUESSES` solves every one.
        paths: ground paths to start from instead of the task's, (n+1, 2) each, m, one point for each control step.
        start: the episode's time at x0, s: the trajectory's times begin there. It matters to tasks with a clock.
        twice: whether the search of `find_optima` is run too, if it supports the problem; or its result for this episode.
            It starts from other guesses, and finds a motion of lower cost in about one episode of a hundred.

    Returns:
        The optimum with the lowest cost that was found. If no try converged, the feasible motion with the lowest cost; look
        at `status`.

    Raises:
        PlanError: no try led to a feasible motion.
        ValueError: no task or robot of that name, or x0 or c has another shape or is not finite.
    """
    task, params = make_task(task, params), robot_of(task, params)
    x0, c = finite_array(x0, (params.state_size,), "x0"), finite_array(c, (len(task.constant_names),), "c")
    episode = Shooting(task, params, x0, c, backoff, start)
    started = time.perf_counter()
    tried: list[Solution] = []
    for found in attempts(episode, guesses, paths):
        tried += found
        if any(solution.is_optimal for solution in found):
            break
    second = twice if isinstance(twice, Optimum) else None
    if twice is True:
        (second,) = batched.search_many(task, params, x0[None], c[None], backoff, slalom_guesses=_SLALOM_GUESSES) or [
            None
        ]
    if second is not None:
        tried += _cheaper(episode, second, min((s.cost for s in tried if s.is_optimal), default=math.inf))
    within = [solution for solution in tried if solution.is_within_limits]
    # optima come before feasible episodes, and cheap ones before expensive ones
    best = min(within, key=lambda solution: (not solution.success, solution.cost), default=None)
    if best is None:
        tries = "; ".join(f"{s.solver}: {s.status}, violation {s.violation:.1e}" for s in tried)
        raise PlanError(
            f"{task.id}: no feasible episode from x = {episode.x0.tolist()}, c = {episode.c.tolist()} ({tries})"
        )
    t = start + task.control_dt * np.arange(len(best.states))
    trajectory = Trajectory(t, best.states, params.force_limit * best.inputs)
    return Optimum.of(
        best,
        trajectory,
        time.perf_counter() - started,
        slopes=best.slopes,
        markers=tuple(task.markers(c)),
        feedback=partial(tube_gains, task, params, trajectory, c),
    )


def certified_optimum(task: str | Task, params: str | Robot, x0: np.ndarray, c: np.ndarray) -> Optimum | None:
    """The stored optimum of a certified episode, without a search.

    Args:
        task: the problem, or its name in `TASKS`.
        params: the robot, or its name in `ROBOTS`; "paper" stands for the robot that the task names, as everywhere.
        x0: (8,) initial state.
        c: (nc,) constants of the episode.

    Returns:
        None where no certified episode starts so, or the set does not have its motion. A set may have the motions of its
        first episodes alone.
    """
    task, params = make_task(task, params), robot_of(task, params)
    try:
        known = certified.load(task, params)
    except certified.CertificateError:
        return None
    same = (known.states == x0).all(1) & (known.constants == c).all(1) & np.isfinite(known.costs)
    found = np.flatnonzero(same[: len(known.trajectories)])
    if not len(found):
        return None
    i = found[0]
    status, trajectory = str(known.statuses[i]), known.trajectories[i]
    return Optimum(
        cost=float(known.costs[i]),
        trajectory=trajectory,
        status="optimal",
        solver_status=status,
        violation=float(known.violations[i]),
        iterations=0,
        solver=status.partition(":")[0],
        seconds=0.0,
        slopes=np.full_like(trajectory.x, np.nan),
        markers=tuple(task.markers(c)),
        feedback=partial(tube_gains, task, params, trajectory, c),
    )


def find_optima(
    task: str | Task,
    params: str | Robot,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff = Backoff(),
    guesses: int = CONSIDERED,
    sides: Sequence[tuple[int, ...]] | None = None,
) -> list[Optimum | None]:
    """The optima of B episodes from states x0 with constants c, thousands at once on one core.

    The episodes are solved together if C code can be compiled, the task has no clock, and the robot has no wheels. This takes
    a few milliseconds per episode, and leaves some episodes unsolved, which `find_optimum` may solve. Otherwise
    `find_optimum` solves one episode after the other.

    Args:
        task: the problem, or its name in `TASKS`.
        params: the robot, or its name in `ROBOTS`; "paper" stands for the robot that the task names, as everywhere.
        x0: (B, 8) initial states; (B, 11) with wheels.
        c: (B, nc) constants; (B, 0) where the task has none.
        backoff: distance kept from limits; none for the true optimum.
        guesses: how many of the task's guessed paths to solve at most where episodes are solved one after the other.
        sides: of each slalom, 1 for every obstacle that is passed on its left, −1 on its right; default, the best. Obstacles
            behind the initial state do not count.

    Returns:
        The optimum of each episode; None where no search converged, on these sides if they are given.

    Raises:
        ValueError: no task or robot of that name, or x0 or c has another shape or is not finite, or sides do not fit them.
    """
    task, params = make_task(task, params), robot_of(task, params)
    x0, c = np.asarray(x0, np.float64), np.asarray(c, np.float64)
    for name, array, width in (("x0", x0, params.state_size), ("c", c, len(task.constant_names))):
        if array.ndim != 2 or array.shape != (len(x0), width):
            count = "B" if name == "x0" else len(x0)
            raise ValueError(f"{name} must have the shape ({count}, {width}), not {array.shape}")
    if sides is not None:
        _check_sides(task, c, sides)
    found = batched.search_many(task, params, x0, c, backoff, sides=sides)
    if found is None:
        found = _one_by_one(task, params, x0, c, backoff, guesses, sides)
    if sides is not None:
        found = [
            optimum if optimum is not None and _passes(task, optimum, constants, chosen) else None
            for optimum, constants, chosen in zip(found, c, sides, strict=True)
        ]
    return found


def _one_by_one(
    task: Task,
    params: Robot,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff,
    guesses: int,
    sides: Sequence[tuple[int, ...]] | None,
) -> list[Optimum | None]:
    """`find_optima` where episodes cannot be solved together."""
    found: list[Optimum | None] = []
    for i, (state, constants) in enumerate(zip(x0, c, strict=True)):
        paths = None if sides is None else [task.routed_path(state, constants, sides[i])]
        try:
            optimum = find_optimum(task, params, state, constants, backoff, guesses, paths)
            found.append(optimum if optimum.is_optimal else None)
        except PlanError:
            found.append(None)
    return found


def _check_sides(task: Task, c: np.ndarray, sides: Sequence[tuple[int, ...]]) -> None:
    if len(sides) != len(c):
        raise ValueError(f"sides must be those of {len(c)} slaloms, not of {len(sides)}")
    for i, (constants, chosen) in enumerate(zip(c, sides, strict=True)):
        obstacles = task.passed_obstacles(constants)
        if obstacles is None:
            raise ValueError(f"{task.id} has no obstacles that could be passed on chosen sides; leave out sides")
        if len(chosen) < len(obstacles) or not {*chosen} <= {-1, 1}:
            raise ValueError(
                f"sides of slalom {i} must be 1 or -1 for each of {len(obstacles)} obstacles, not {chosen}"
            )


def _passes(task: Task, optimum: Optimum, c: np.ndarray, sides: tuple[int, ...]) -> bool:
    """Whether an optimum passes the obstacles ahead of its initial state on these sides."""
    obstacles, path = np.asarray(task.passed_obstacles(c)), optimum.trajectory.x
    ahead = obstacles[:, 0] > path[0, 0]
    return all(np.array(sides_passed(path, obstacles))[ahead] == np.array(sides[: len(obstacles)])[ahead])


def _cheaper(episode: Shooting, found: Optimum, cost: float) -> list[Solution]:
    """Solutions from another search's optimum, if that is cheaper."""
    if found.cost > cost * (1 - _NO_CHEAPER):
        return []
    trajectory = found.trajectory
    return episode.solve_to_the_end(trajectory.x, trajectory.u / episode.params.force_limit, SAME_BARRIER)


def plan_to_track(
    task: Task, params: Robot, x0: np.ndarray, c: np.ndarray, backoff: Backoff, start: float = 0.0
) -> Optimum:
    """As `find_optimum`, for feedback to track. If no plan keeps the whole reserve of force and friction, it keeps less.

    Args: those of `find_optimum`.

    Raises:
        PlanError: no try came to a feasible episode.
    """
    parts = [backoff.times(share) for share in _RESERVES]
    tries = [replace(backoff, force=part.force, grip=part.grip if params.grips else backoff.grip) for part in parts]
    *more, last = dict.fromkeys(tries)
    for reserve in more:
        try:
            return find_optimum(task, params, x0, c, reserve, start=start)
        except PlanError:
            pass
    return find_optimum(task, params, x0, c, last, start=start)
