"""The optimum of any episode of any task, on the env's own discretization (`shooting.py`).

An episode under physics="rk4" that follows the optimal trajectory returns minus its cost. The problem is solved by multiple
shooting from each of the task's guessed paths, and from simulated recoveries where no path leads to a solution (`search.py`).
The best solution is kept. It is feasible and locally optimal. It is the global optimum if one of the guesses leads there.
What regrets are measured against is searched `twice`, by two methods.
"""

import math
import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ballbot_baselines.optimum import batched
from ballbot_baselines.optimum.search import ALL_GUESSES, attempts
from ballbot_baselines.solvers.ocp import OcpSolution
from ballbot_baselines.solvers.shooting import Backoff, Shooting
from ballbot_gym.checks import finite_array
from ballbot_gym.display import Moving
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import checked_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Trajectory

__all__ = ["ALL_GUESSES", "Backoff", "Optimum", "find_optimum", "plan_to_track"]

_CONSIDERED = 5  # guesses tried at most by default; tasks name the likeliest first
_NO_CHEAPER = 1e-6  # relative
_RESERVES = (1.0, 0.3, 0.0)  # shares of what a plan to track leaves unused, from the first that allows a plan


@dataclass(frozen=True, repr=False)
class Optimum(Moving):
    """The best episode found: its cost, trajectory (forces held), and what the solver said of it.

    | field | meaning |
    |---|---|
    | `status` | "optimal" if the solver converged, else "feasible": it obeys every constraint, but may not be the cheapest |
    | `solver_status` | the solver's own word |
    | `violation` | largest amount by which a constraint is missed, SI units |
    | `seconds` | wall time of the whole search |
    | `costates` | (n, 8) slopes of the remaining cost with respect to x_1 … x_n; 0 for a simulated episode |
    | `markers` | what the task draws |
    """

    cost: float
    trajectory: Trajectory
    status: Literal["optimal", "feasible"]
    solver_status: str
    violation: float
    iterations: int
    solver: str
    seconds: float
    costates: np.ndarray
    markers: tuple[Marker, ...] = ()

    def facts(self) -> dict[str, str]:
        return {"cost": f"{self.cost:.4g}", "status": self.status, "found in": f"{self.seconds:.2f} s"}

    @property
    def is_optimal(self) -> bool:
        """Whether the solver converged."""
        return self.status == "optimal"


def find_optimum(
    task: str | Task,
    params: str | BallbotParams,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff = Backoff(),
    guesses: int = _CONSIDERED,
    paths: list[np.ndarray] | None = None,
    start: float = 0.0,
    twice: bool | batched.BatchOptima = False,
) -> Optimum:
    """The cheapest episode from state x0 with constants c.

    Args:
        task: the problem, or its name in `TASKS`.
        params: the robot, or its name in `ROBOTS`.
        x0: (8,) initial state, m, rad, m/s, rad/s; order in `dynamics.STATE`; (11,) with wheels.
        c: (nc,) constants of the episode, named in the task's `constant_names`; (0,) where it has none.
        backoff: distance kept from limits; none for the true optimum.
        guesses: how many of the task's guessed paths to solve at most. For a slalom all choices of sides are considered, and
            those that `sides.predict` finds likely are solved; `ALL_GUESSES` solves every one.
        paths: ground paths to start from instead of the task's, (n+1, 2) each, m, one point for each control step.
        start: the episode's time at x0, s: the trajectory's times begin there. It matters to tasks with a clock.
        twice: whether `batched.find_optima` searches too, where it can, or what it found for this episode. It starts from
            other guesses, and finds something cheaper in about one episode of a hundred.

    Returns:
        The cheapest optimum found. If no try converged, the cheapest feasible episode found; look at `status`.

    Raises:
        PlanError: no try came to a feasible episode.
        ValueError: no task or robot of that name, or x0 or c has another shape or is not finite.
    """
    task, params = make_task(task, params), checked_robot(params)
    x0, c = finite_array(x0, (params.state_size,), "x0"), finite_array(c, (len(task.constant_names),), "c")
    episode = Shooting(task, params, x0, c, backoff, start)
    started = time.perf_counter()
    tried: list[OcpSolution] = []
    for found in attempts(episode, guesses, paths):
        tried += found
        if any(solution.is_optimal for solution in found):
            break
    if twice is True and batched.solves(task, params):
        twice = batched.find_optima(task, params, x0[None], c[None], backoff)
    if isinstance(twice, batched.BatchOptima):
        tried += _cheaper(episode, twice, min((s.cost for s in tried if s.is_optimal), default=math.inf))
    within = [solution for solution in tried if solution.is_within_limits]
    # optima come before feasible episodes, and cheap ones before expensive ones
    best = min(within, key=lambda solution: (not solution.success, solution.cost), default=None)
    if best is None:
        tries = "; ".join(f"{s.solver}: {s.status}, violation {s.violation:.1e}" for s in tried)
        raise PlanError(
            f"{task.id}: no feasible episode from x = {episode.x0.tolist()}, c = {episode.c.tolist()} ({tries})"
        )
    t = start + task.control_dt * np.arange(len(best.states))
    return Optimum(
        cost=best.cost,
        trajectory=Trajectory(t, best.states, params.force_limit * best.inputs),
        status="optimal" if best.is_optimal else "feasible",
        solver_status=best.status,
        violation=best.violation,
        iterations=best.iterations,
        solver=best.solver,
        seconds=time.perf_counter() - started,
        costates=best.costates,
        markers=tuple(task.markers(c)),
    )


def _cheaper(episode: Shooting, found: batched.BatchOptima, cost: float) -> list[OcpSolution]:
    """Solutions from what was found at once for an episode, if that is cheaper."""
    if not found.solved[0] or found.costs[0] > cost * (1 - _NO_CHEAPER):
        return []
    x, u = found.states[0, : found.steps[0] + 1], found.forces[0, : found.steps[0]]
    return episode.solve_to_the_end(x, u / episode.params.force_limit, near=True)


def plan_to_track(
    task: Task, params: BallbotParams, x0: np.ndarray, c: np.ndarray, backoff: Backoff, start: float = 0.0
) -> Optimum:
    """As `find_optimum`, for feedback to track. Where no plan keeps the whole reserve of force and friction, it keeps less.

    Args: as of `find_optimum`.

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
