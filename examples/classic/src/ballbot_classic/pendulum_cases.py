"""The optimum of Pendulum-v1 by cases, in each of which the problem is smooth.

A case says how many turns the pendulum has made at each control step, which the cost of the angle depends on, and at which
steps the rate is clipped. The angle's cost is the least over all numbers of turns. So a solution of a case costs at least the
true cost of its motion, and to repeat the search in the case of that motion lowers the cost until they agree. Where a rate
reaches its limit without being clipped, the search is repeated with this rate clipped. The best solution is tried again a
control step earlier and later, as long as that lowers the cost.

In a case the rate is clipped when it is used: the variables are ψ, the angle a control step ago, and r, the rate before it is
clipped, so that θ = ψ + dt·clipped(r). A rate that is clipped must be beyond its limit, and no other may be.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi
import numpy as np

from ballbot_baselines import Ocp, OcpSolver, Solution

Guesses = list[tuple[np.ndarray, np.ndarray]]

_TURN = 2 * math.pi
_SOLVED = 400  # guesses
_WORSE = 1.25  # times the best solution: guesses that cost more lead to no better one
_ROUNDS = 60  # changes of the case, each by a control step or so
_CHANGES, _CLIPS = 8, 3  # of the number of turns, and intervals of clipped rates, in an episode
_ITERATIONS = 80
_ROOM = 1e-7  # kept from limits, so that rounding breaks none
_NEVER = 1e6


def solutions(task: Any, episode: Any, guesses: Guesses | None = None) -> list[Solution]:
    """Solutions of an episode of `PendulumUp`, see `Task.search_cases`.

    Args:
        task: the task.
        episode: the problem.
        guesses: states (n+1, 2) and actions (n, 1) to start from; default, those of the task.
    """
    params, found = episode.params, list[Solution]()
    for x, u in task.guesses(episode.x0, episode.c, params)[:_SOLVED] if guesses is None else guesses:
        if _cost(task, x, u) > _WORSE * min((solution.cost for solution in found), default=math.inf):
            break
        found += _descended(episode, x, u, found)
    least = math.inf
    while found and (best := min(found, key=lambda solution: solution.cost)).cost < least:
        least = best.cost
        for steps in (-1, 1):
            found += _descended(episode, *_shifted(best, steps, params.force_limit), found)
    return found


def _shifted(solution: Solution, steps: int, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """States (n+1, 2) and actions (n, 1) of a solution, later by some control steps, as a guess.

    A torque at its limit switches between control steps, and wherever it does so is a local optimum.
    """
    n = len(solution.inputs)
    at = np.clip(np.arange(n + 1) - steps, 0, n)
    x = solution.states[at]
    x[0] = solution.states[0]
    return x, limit * solution.inputs[np.minimum(at[:-1], n - 1)]


def _descended(episode: Any, x: np.ndarray, u: np.ndarray, known: list[Solution]) -> list[Solution]:
    """Solutions from a motion x (n+1, 2) and u (n, 1), each in the case of the one before and cheaper, until they lead to a
    known one.
    """
    params, found, least = episode.params, list[Solution](), math.inf
    clipped = np.abs(x[1:, 1]) >= params.speed_limit
    for _ in range(_ROUNDS):
        turns = np.floor((x[:-1, 0] + math.pi) / _TURN)
        numbers = _numbers(turns, np.where(clipped, np.sign(x[1:, 1]), 0.0))
        if numbers is None:
            break
        solution = _solved(episode, x, u, numbers)
        repeated = any(math.isclose(solution.cost, other.cost, rel_tol=1e-9) for other in known + found)
        if not solution.is_optimal or repeated or solution.cost > least:
            break
        x, u, least = solution.states, solution.inputs * params.force_limit, solution.cost
        found.append(solution)
        at_limit = np.abs(x[1:, 1]) > params.speed_limit - 1e-4
        if (at_limit <= clipped).all() and (turns == np.floor((x[:-1, 0] + math.pi) / _TURN)).all():
            break
        clipped = clipped | at_limit
    return found


def _cost(task: Any, x: np.ndarray, u: np.ndarray) -> float:
    return float(task.control_dt * np.sum(task.cost(x[:-1], u, np.zeros(0))))


def _solved(episode: Any, x: np.ndarray, u: np.ndarray, numbers: list[float]) -> Solution:
    """The solution of a case from a motion x (n+1, 2) and u (n, 1), as states and actions of the pendulum."""
    params, backoff = episode.params, episode.backoff
    n, dt = len(u), episode.task.control_dt
    made = _solver(episode.task, params, n)
    before = x[:, 0] - dt * x[:, 1]
    rate = np.append(x[0, 1], x[:-1, 1] + dt * params.derivative(x[:-1], u)[:, 1])  # before it is clipped
    lower, upper = made.ocp.no_bounds(n)
    lower[0, :2] = upper[0, :2] = before[0], rate[0]
    lower[:, 2], upper[:, 2] = backoff.force - 1, 1 - backoff.force
    solution = made.solve(np.column_stack([before, rate]), u / params.force_limit, lower, upper, numbers)
    rates = np.clip(solution.states[:, 1], -params.speed_limit, params.speed_limit)
    angles = solution.states[:, 0] + dt * rates
    slopes = np.column_stack([solution.slopes[:, 0], solution.slopes[:, 1] - dt * solution.slopes[:, 0]])
    return replace(solution, states=np.column_stack([angles, rates]), slopes=slopes)


@lru_cache(maxsize=4)
def _solver(task: Any, params: Any, n: int) -> OcpSolver:
    dt, limit = task.control_dt, params.force_limit

    def clips(p: casadi.SX) -> list[tuple[casadi.SX, casadi.SX]]:
        """Side of each interval of clipped rates, and whether the stage is in it."""
        k, first = p[-1], 1 + 2 * _CHANGES
        rows = (p[first + 3 * i : first + 3 * i + 3] for i in range(_CLIPS))
        return [(row[0], casadi.logic_and(k >= row[1], k <= row[2])) for row in rows]

    def used(s: casadi.SX, p: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
        """θ and the clipped rate."""
        rate = s[1]
        for side, inside in clips(p):
            rate = casadi.if_else(inside, side * params.speed_limit, rate)
        return s[0] + dt * rate, rate

    def after(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        x = used(s, p)
        return casadi.vertcat(x[0], x[1] + dt * params.derivative(x, (limit * a[0],))[1])

    def cost(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        theta, rate = used(s, p)
        turns = p[0]
        for i in range(_CHANGES):
            turns += casadi.if_else(p[-1] >= p[1 + 2 * i], p[2 + 2 * i], 0)
        return dt * task.rate(theta - _TURN * turns, rate, limit * a[0])

    def room(s: casadi.SX, p: casadi.SX) -> casadi.SX:
        room = params.speed_limit - s[1] * s[1] / params.speed_limit
        for side, inside in clips(p):
            room = casadi.if_else(inside, side * s[1] - params.speed_limit, room)
        return room - _ROOM

    ocp = Ocp(
        name=f"{task.id}-cases",
        states=2,
        inputs=1,
        params=1 + 2 * _CHANGES + 3 * _CLIPS,
        counts_stages=True,
        next=after,
        cost=cost,
        inequalities=lambda s, a, p: room(s, p),
        final_inequalities=room,
    )
    return OcpSolver(ocp, n, max_iterations=_ITERATIONS, barrier=1e-3)


def _numbers(turns: np.ndarray, clipped: np.ndarray) -> list[float] | None:
    """Parameters of a case; None where turns or clipping change too often.

    Args:
        turns: (n,) at each control step.
        clipped: (n,) side to which the rate is clipped at the end of each step, or 0.
    """
    at = np.flatnonzero(np.diff(turns))
    starts = np.flatnonzero(np.diff(clipped, prepend=0.0) * clipped > 0)
    ends = np.flatnonzero(np.diff(clipped, append=0.0) * clipped < 0)
    if len(at) > _CHANGES or len(starts) > _CLIPS:
        return None
    changes, clips = np.tile([_NEVER, 0.0], (_CHANGES, 1)), np.tile([1.0, _NEVER, _NEVER], (_CLIPS, 1))
    changes[: len(at)] = np.column_stack([at + 1, np.diff(turns)[at]])
    clips[: len(starts)] = np.column_stack([clipped[starts], starts + 1, ends + 1])
    return [turns[0], *changes.ravel(), *clips.ravel()]
