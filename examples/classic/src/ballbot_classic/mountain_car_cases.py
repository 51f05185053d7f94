"""The optimum of MountainCarContinuous-v0 by cases, in each of which the problem is smooth.

A case says how many control steps the car takes, and whether the wall stops it. Where it does, the motion has two
independent parts: to the wall, and from rest at the wall to the goal. All parts are one problem of the longest
episode, whose first steps stand still where fewer are taken.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import casadi
import numpy as np

from ballbot_baselines import Ocp, OcpSolver, Solution

Guesses = list[tuple[np.ndarray, np.ndarray]]

_SOLVED = 6  # guesses, of other numbers of turns
_WORSE = 1.03  # times the best solution: where others cost more, better times do not make up for it
_NEAR_STEPS = 20  # solutions that turn as often and arrive within these steps become the same at their best times
_BETWEEN = 24  # control steps between the best times of motions that turn once more or less
_BARRIER, _NEAR_BARRIER = 1e-3, 1e-6  # of the first iterate, and near a solution
_STRIDE = 4  # of the search for the best time at first, control steps
_ROOM = 1e-7  # kept from limits, so that rounding breaks none
_STOPPED = (
    3e-6  # kept from both sides of the wall's edge, and so from that of the goal: rounding to float32 moves the car by
)
_ARRIVED = 1e-5  # up to 5e-7 on its way to the wall, and a little more on its way to the goal
_FROM_WALL = 0.25  # guessed force


def solutions(task: Any, episode: Any, guesses: Guesses | None = None) -> list[Solution]:
    """Solutions of an episode of `MountainCarUp`, see `Task.search_cases`.

    Args:
        task: the task.
        episode: the problem.
        guesses: states (n+1, 2) and actions (n, 1) to start from; default, those of the task.
    """
    search = _Search(task, episode.params, episode.backoff.force)
    guesses = _different(task.guesses(episode.x0, episode.c, episode.params) if guesses is None else guesses)
    found = search.against_the_wall(guesses[:_SOLVED])
    # where the wall may stop the car, that is cheaper than to turn in front of it: the motion is freer
    return found or [search.best_time(search.solved(*guess)) for guess in guesses[:_SOLVED]]


def _different(guesses: Guesses) -> Guesses:
    """The first of the guesses that turn as often."""
    kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for x, u in guesses:
        kept.setdefault(_turns(x), (x, u))
    return list(kept.values())


def _turns(x: np.ndarray) -> int:
    return int(np.sum(np.diff(np.sign(x[1:, 1])) != 0))


class _Search:
    def __init__(self, task: Any, params: Any, backoff: float):
        self._task, self._params, self._backoff = task, params, backoff

    def motion(self, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
        return solution.states, solution.inputs * self._params.force_limit

    def solved(
        self, x: np.ndarray, u: np.ndarray, steps: int | None = None, to_wall: bool = False, near: bool = False
    ) -> Solution:
        """The solution of a case from a motion x (n+1, 2) and u (n, 1).

        Args:
            x: the guess; it begins where the solution does.
            u: its forces.
            steps: to the goal, or to the wall; default, n.
            to_wall: whether the wall stops the car at the end.
            near: whether the guess solves nearly the same problem.
        """
        task, params, most = self._task, self._params, self._task.steps
        steps = steps or len(u)
        still = most - steps
        made = _solver(task, params, _NEAR_BARRIER if near else _BARRIER)
        at = np.maximum(np.arange(-still, steps + 1), 0) * (len(u) / steps)  # steps of the guess
        guess = np.column_stack([np.interp(at, np.arange(len(x)), column) for column in x.T])
        force = np.interp(at[:-1], np.arange(len(u)), u[:, 0])[:, None] / params.force_limit
        lower, upper = made.ocp.no_bounds(most)
        lower[still + 1 :, 0], upper[still + 1 :, 0] = _STOPPED - params.reach, params.end - _ROOM
        lower[:, 1], upper[:, 1] = _ROOM - params.speed_limit, params.speed_limit - _ROOM
        lower[0, :2] = upper[0, :2] = x[0]
        lower[-1, 0] = -params.reach if to_wall else task.goal_position + _ARRIVED
        lower[:, 2], upper[:, 2] = self._backoff - 1, 1 - self._backoff
        force[:still] = 0.0
        solution = made.solve(guess, force, lower, upper, [still, float(to_wall)])
        return replace(
            solution,
            states=solution.states[still:],
            inputs=solution.inputs[still:],
            slopes=solution.slopes[still:],
        )

    def best_time(self, begun: Solution, most: int | None = None, to_wall: bool = False) -> Solution:
        """The cheapest of the solutions that take more or fewer steps, at most as many as given, from one on downhill."""
        tried = {len(begun.inputs): begun}

        def cost(steps: int) -> float:
            if not 1 <= steps <= (most or self._task.steps):
                return math.inf
            if steps not in tried:
                near = tried[min(tried, key=lambda known: abs(known - steps))]
                tried[steps] = self.solved(*self.motion(near), steps, to_wall, near=True)
            return tried[steps].cost if tried[steps].is_optimal else math.inf

        best = len(begun.inputs)
        for stride in (_STRIDE, 1):
            while (nearby := min((best - stride, best + stride), key=cost)) and cost(nearby) < cost(best):
                best = nearby
            before, here, after = (cost(best + shift) for shift in (-stride, 0, stride))
            if stride > 1 and math.isfinite(before + here + after):  # the parabola through three times
                guessed = best + round(0.5 * stride * (before - after) / (before - 2 * here + after))
                best = min((best, guessed), key=cost)
        return tried[best]

    def against_the_wall(self, guesses: Guesses) -> list[Solution]:
        """The best that the wall stops once, where the guesses last turn."""
        after, begun = _from_wall(self._task, self._params, self._backoff), list[Solution]()
        at_wall, tried = np.array([[-self._params.reach, 0.0]]), list[tuple[int, int]]()
        for x, u in guesses:
            turned = np.flatnonzero((x[1:-1, 1] <= 0) & (x[2:, 1] > 0))
            if not len(turned):
                continue
            last = min(int(turned[-1]) + 1, self._task.steps - len(after.inputs))
            turns = _turns(x[:last])
            if not any(abs(turns - other) <= 1 and abs(last - steps) <= _NEAR_STEPS for other, steps in tried):
                tried.append((turns, last))
                begun.append(self.solved(np.concatenate([x[:last], at_wall]), u[:last], to_wall=True))
        found, least = list[Solution](), math.inf
        for before in sorted((each for each in begun if each.is_optimal), key=lambda each: each.cost):
            if before.cost + after.cost <= _WORSE * least:
                found += self._both(before, after)
                least = min((each.cost for each in found), default=math.inf)
        return found

    def _both(self, before: Solution, after: Solution) -> Iterator[Solution]:
        """Both parts at their best times; where there is no time for these, the second is hastened while that pays."""
        most, least = self._task.steps - len(after.inputs), math.inf
        before = self.best_time(before, most, to_wall=True)
        for steps in (len(before.inputs) - _BETWEEN, len(before.inputs) + _BETWEEN):
            if before.is_optimal and 1 <= steps <= most:
                other = self.solved(*self.motion(before), steps, to_wall=True, near=True)
                other = self.best_time(other, most, to_wall=True)
                before = min((each for each in (before, other) if each.is_optimal), key=lambda each: each.cost)
        while before.is_optimal and after.is_optimal and before.cost + after.cost < least:
            least, steps = before.cost + after.cost, len(after.inputs) - 1
            yield _joined(before, after)
            if len(before.inputs) + len(after.inputs) < self._task.steps or not steps:
                return
            after = _from_wall(self._task, self._params, self._backoff, steps)
            before = self.solved(*self.motion(before), len(before.inputs) + 1, to_wall=True, near=True)


@lru_cache(maxsize=100)
def _from_wall(task: Any, params: Any, backoff: float, steps: int | None = None) -> Solution:
    """The best from rest at the wall to the goal, in a number of steps or in any."""
    search = _Search(task, params, backoff)
    if steps is not None:
        return search.solved(*search.motion(_from_wall(task, params, backoff)), steps, near=True)
    x = [np.array([-params.reach, 0.0])]
    while x[-1][0] < task.goal_position and len(x) <= task.steps:
        x.append(params.step(x[-1], np.array([_FROM_WALL * params.force_limit]), 1.0))
    forces = np.full((len(x) - 1, 1), _FROM_WALL * params.force_limit)
    return search.best_time(search.solved(np.array(x), forces))


def _joined(before: Solution, after: Solution) -> Solution:
    return replace(
        before,
        cost=before.cost + after.cost,
        states=np.concatenate([before.states[:-1], after.states]),
        inputs=np.concatenate([before.inputs, after.inputs]),
        violation=max(before.violation, after.violation),
        iterations=before.iterations + after.iterations,
        slopes=np.concatenate([before.slopes[:-1], after.slopes]),
    )


@lru_cache(maxsize=4)
def _solver(task: Any, params: Any, barrier: float) -> OcpSolver:
    """p is the number of steps that stand still, and whether the wall stops the last step."""

    def moved(s: casadi.SX, a: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
        speed = s[1] + params.power * params.force_limit * a[0] - params.gravity * casadi.cos(3 * s[0])
        return s[0] + speed, speed

    def stops(p: casadi.SX) -> casadi.SX:
        return casadi.logic_and(p[1] > 0, p[2] == task.steps - 1)

    def after(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        place, speed = moved(s, a)
        place, speed = casadi.if_else(stops(p), -params.reach, place), casadi.if_else(stops(p), 0.0, speed)
        return casadi.vertcat(casadi.if_else(p[2] < p[0], s[0], place), casadi.if_else(p[2] < p[0], s[1], speed))

    ocp = Ocp(
        name=f"{task.id}-cases",
        states=2,
        inputs=1,
        params=2,
        counts_stages=True,
        next=after,
        cost=lambda s, a, p: task.cost(s, params.force_limit * a, p[:0]),
        inequalities=lambda s, a, p: casadi.if_else(stops(p), -params.reach - moved(s, a)[0] - _STOPPED, 1.0),
    )
    return OcpSolver(ocp, task.steps, barrier=barrier)
