"""Optima of thousands of episodes of any task at once, by `ilqr.py`.

The search is that of `search.py`, for all episodes together:

- Where a task ends at rest, only its first seconds are optimized, with LQR's cost-to-go as the cost of their last state, and
  then LQR is simulated to the end. If its actual cost differs from LQR's cost-to-go, the whole episode is optimized.
- Tasks that end at rest without obstacles start from the cheapest simulated recovery (`righting.steering`).
- Slaloms are first solved without their obstacles. That predicts what every choice of sides costs (`sides.py`), and the
  likely ones are compared with forces held longer. The best is tried again, passing all obstacles a step later and earlier.
- First-exit tasks are first solved along each guessed path with a free length of the steps, then for whole numbers of control
  steps near the best arrivals.
- All others are solved along their guessed paths.

What remains unsolved is left to `find_optimum`. `benchmarks/batched_optima.py` compares both.
"""

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from ballbot_baselines.optimum import sides
from ballbot_baselines.optimum.guesses import BASIN_DOUBT, COARSE, CONSIDERED, contenders, straight_path
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.optimum.random_guesses import RandomGuesses, Recovery
from ballbot_baselines.solvers import guess, righting
from ballbot_baselines.solvers.compiled import LANES
from ballbot_baselines.solvers.ilqr import MARGIN, Motions, Options, ilqr
from ballbot_baselines.solvers.shooting import FREE_TIME_INTERVALS, Backoff, Shooting
from ballbot_gym import machine_code
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.paths import sides_passed
from ballbot_gym.trajectory import Trajectory

# of simulated recoveries: bandwidth, rad/s; time constant, s; lean to the side, rad, and how fast it fades, s
_FAMILY = (*itertools.product((7.0, 14.0), (1.0, 1.4), (0.0,), (1.0,)), (10.0, 2.0, 0.0, 1.0))
_SIDEWAYS_FAMILY = tuple(itertools.product((7.0, 10.0, 14.0), (1.0, 1.8), (-0.6, -0.3, 0.3, 0.6), (0.3,)))
# Tries in turn from guesses that are motions, and from those that are none. Small multipliers suit limits that are far away.
_MOTION = tuple(Options(bends=0, width=width, multiplier=1e-3) for width in (0.2, 0.02))
_PATH = tuple(Options(bends=bends, width=width, multiplier=1e-2) for bends, width in ((3, 0.2), (6, 0.2), (1, 0.05)))
_GOAL = tuple(options._replace(multiplier=0.1) for options in _PATH)
_NEAR_GOAL = (Options(bends=3, width=0.005, multiplier=0.01), *_GOAL)  # where the goal's multipliers are about right
_ROUGH_PATH, _ROUGH_GOAL = (
    tuple(options._replace(tolerance=1e-4, violation=1e-3) for options in tries) for tries in (_PATH, _GOAL)
)
# Greater multipliers and narrow prices at first keep a motion on its side of the obstacles.
_SIDES = tuple(
    Options(bends=bends, width=width, multiplier=multiplier, tolerance=1e-4, violation=1e-3)
    for bends, width, multiplier in ((6, 0.02, 10.0), (3, 0.05, 1.0), (1, 0.02, 10.0), (6, 0.01, 30.0), (3, 0.2, 0.1))
)
_ROUGH_SOLUTION = tuple(
    Options(bends=bends, width=width, multiplier=multiplier, tolerance=3e-6)
    for bends, width, multiplier in ((1, 0.02, 3.0), (0, 0.01, 3.0), (3, 0.01, 3.0), (1, 0.02, 1.0))
)
_SHIFTED = Options(bends=1, width=0.002, tolerance=3e-6)  # its multiplier is the least
_SIDES_DOUBT = 0.003  # relative: how differently the coarse grid and rough solutions may order choices of sides
_SECONDS = 3.0  # optimized of a task that ends at rest
_AFTER_SECONDS = 0.6  # optimized of a slalom after its last obstacle
_SHARED_SECONDS = 0.4  # horizons are multiples of these
_AT_REST = 1e-5  # relative to an episode's cost: how wrong LQR's cost-to-go may be after these
_SAME = 0.02  # m: rough solutions that are nowhere farther apart are the same
_FEW = 16  # problems
_AT_ONCE = 256  # episodes in memory
_ENOUGH = 16  # solutions from random guesses
_HOPELESS = 64  # random guesses without a solution, after which an episode is left
_Sides = Sequence[tuple[int, ...]]  # of each slalom, see `find_optima`


def search_many(
    task: Task,
    params: Robot,
    x0: np.ndarray,
    c: np.ndarray,
    backoff: Backoff,
    slalom_guesses: int = 0,
    sides: _Sides | None = None,
) -> list[Optimum | None] | None:
    """The optima of B episodes from states x0 (B, 8) with constants c (B, nc), found on one core; None where none was found.

    Slaloms are searched from up to `slalom_guesses` random guesses, too, or on given `sides`, see `find_optima`. The other
    tasks' searches miss nothing that random guesses find; `benchmarks/multistart.py` counts it.

    There is no list where episodes cannot be searched together: C code cannot be compiled here, it lacks an operation of the
    task, the task has a clock, or the robot has wheels.
    """
    if not _solves(task, params):
        return None
    backoff = replace(backoff, margin=max(MARGIN, backoff.margin), goal=max(MARGIN, backoff.goal))
    parts = [slice(first, first + _AT_ONCE) for first in range(0, len(x0), _AT_ONCE)]
    found: list[Optimum | None] = []
    for some in parts:
        batch = _Batch(task, params, x0[some], c[some], backoff, sides and sides[some])
        batch.search(slalom_guesses if batch.is_slalom else 0, _ENOUGH)
        found += batch.optima()
    return found


def multistart(
    task: Task, params: Robot, x0: np.ndarray, c: np.ndarray, guesses: int
) -> tuple[list[Optimum | None], np.ndarray]:
    """Searches B episodes from random guesses, too; arguments as in `search_many`.

    Returns:
        The optima, and costs (guesses, B) to which the random guesses led; infinite where one led to no solution.
    """
    batch = _Batch(task, params, x0, c, Backoff(margin=MARGIN, goal=MARGIN))
    costs = batch.search(guesses)
    return batch.optima(), costs


def _solves(task: Task, params: Robot) -> bool:
    try:
        ilqr(task, params)
    except (machine_code.NoMachineCodeError, NotImplementedError, OSError):
        return False
    return True


class _Known(NamedTuple):
    """A motion of an episode that was found before random guesses are tried."""

    path: np.ndarray
    """(n+1, 2) on the ground, m."""
    rough_cost: float
    """Of a slalom, with forces held longer; infinite if that is not known."""


class _Batch:
    """The search of some episodes."""

    def __init__(
        self, task: Task, params: Robot, x0: np.ndarray, c: np.ndarray, backoff: Backoff, sides: _Sides | None = None
    ):
        self._wanted_sides = sides
        self._task, self._params, self._x0, self._c, self._backoff = task, params, x0, c, backoff
        self._solver = ilqr(task, params)
        self._seconds, self._costs = 0.0, np.full(len(x0), np.inf)
        self._known: dict[int, _Known] = {}
        self._best: dict[int, tuple[Motions, int]] = {}  # of each solved episode, and the row that it has among others

    @cached_property
    def _ends(self) -> np.ndarray:
        """(B, 8) where each episode comes to rest, of a task that ends there."""
        episodes = zip(self._x0, self._c, strict=True)
        return np.array([self._task.reference(x, c, self._params).x[-1] for x, c in episodes])

    @cached_property
    def is_slalom(self) -> bool:
        """Whether the task is to pass obstacles."""
        return self._task.passed_obstacles(self._c[0]) is not None and self._task.steps % COARSE == 0

    @cached_property
    def _ends_at_a_point(self) -> bool:
        return self._task.reference(self._x0[0], self._c[0], self._params).is_point

    @cached_property
    def _guessed_paths(self) -> list[list[np.ndarray]]:
        """The task's guessed paths of each episode."""
        return [self._task.guess_paths(x0, c, self._params) for x0, c in zip(self._x0, self._c, strict=True)]

    @cached_property
    def _obstacles(self) -> list[np.ndarray]:
        """(n, 3) of each slalom, as `Task.passed_obstacles` gives them."""
        return [np.asarray(self._task.passed_obstacles(c)) for c in self._c]

    def search(self, guesses: int = 0, enough: float = math.inf) -> np.ndarray:
        """Searches from the task's guesses, and then from random ones; returns costs (guesses, B) of the latter.

        A cost is infinite where a guess leads to no solution. Solutions of slaloms that are clearly not the best are not
        refined, so their costs are those with forces held longer.

        Args:
            guesses: random ones of each episode at most.
            enough: solutions from random guesses after which an episode needs no more.
        """
        started = time.perf_counter()
        with np.errstate(all="ignore"):  # motions that diverge may overflow, and are left out
            self._search()
            costs = self._search_randomly(guesses, enough)
        self._seconds = (time.perf_counter() - started) / max(1, len(self._x0))
        return costs

    def optima(self) -> list[Optimum | None]:
        """The best that was found of each episode."""
        return [self._optimum(*self._best[i]) if i in self._best else None for i in range(len(self._x0))]

    def _optimum(self, found: Motions, i: int) -> Optimum:
        task, limit, n = self._task, self._params.force_limit, found.steps[i]
        end = np.full((1, found.x.shape[2]), np.nan if task.first_exit else 0.0)
        return Optimum(
            cost=float(found.costs[i]),
            trajectory=Trajectory(
                task.control_dt * np.arange(n + 1), found.x[i, : n + 1].copy(), limit * found.a[i, :n]
            ),
            status="optimal",
            solver_status="converged",
            violation=0.0,  # each constraint is kept by as much as it may be missed
            iterations=0,
            solver="ilqr",
            seconds=self._seconds,
            slopes=np.concatenate([found.slopes[i, :n], end]),
            markers=tuple(task.markers(self._c[found.of[i]])),
            feedback=partial(np.multiply, limit, found.gains[i, :n].copy()),
        )

    def _search(self) -> None:
        task = self._task
        if task.first_exit:
            self._arrive(*self._paths(np.arange(len(self._x0))))
        elif self.is_slalom:
            self._weave()
        elif self._ends_at_a_point:
            self._keep(self._recoveries(), _MOTION)  # over the first seconds where LQR is right about the rest
            self._follow_paths(np.flatnonzero(np.isinf(self._costs)))
        else:
            self._follow_paths(np.arange(len(self._x0)))

    def _given(self, of: np.ndarray, steps: int, c: np.ndarray | None = None, free_time: bool = False) -> np.ndarray:
        """Parameters of `ilqr`, (J, np), of episodes `of` (J,), or with other constants (B, nc).

        LQR's cost-to-go is added if `steps` control steps end before the episode does.
        """
        c = (self._c if c is None else c)[of]
        _, *given = Shooting(self._task, self._params, self._x0[0], c[0], self._backoff).parameters()
        rows = np.tile([*given, 1 - self._backoff.force], (len(c), 1))
        first = len(self._params.numbers())
        rows[:, first : first + c.shape[1]] = c
        if free_time:
            bounds = self._task.control_dt / 4, self._task.duration / FREE_TIME_INTERVALS
            return np.column_stack([rows, np.tile(bounds, (len(c), 1))])
        if self._solver.rest is None:
            return rows
        of_rest = [*self._solver.rest.p[np.triu_indices(8)], float(steps < self._task.steps)]
        return np.column_stack([rows, self._ends[of], np.tile(of_rest, (len(c), 1))])

    def _solve(
        self,
        guesses: Motions,
        tries: Sequence[Options],
        coarseness: int = 1,
        c: np.ndarray | None = None,
        free_time: bool = False,
        chosen_sides: np.ndarray | None = None,
        end_multipliers: np.ndarray | None = None,
    ) -> Motions:
        """Solves guesses with some options in turn until they are solved, and on chosen sides (J, obstacles) of obstacles.

        They may start from multipliers (J, ne) of the end.
        """
        solver, length = self._solver, coarseness * self._task.control_dt
        if free_time:
            solver, length = ilqr(self._task, self._params, True), 1.0
        given = self._given(guesses.of, coarseness * guesses.a.shape[1], c, free_time)
        found, left, waiting = None, np.arange(len(guesses.of)), tries
        while waiting and len(left):
            # few that are left would not fill the processor's lanes
            now, waiting = (waiting, ()) if len(left) * len(waiting) <= _FEW else (waiting[:1], waiting[1:])
            rows = np.tile(left, len(now))
            options = [tried for tried in now for _ in left]
            ends = None if end_multipliers is None else end_multipliers[rows]
            again = solver.solve(guesses.some(rows), length, given[rows], options, end_multipliers=ends)
            right = again.solved
            if chosen_sides is not None:
                right = right & (self._sides(again.of, again.x) == chosen_sides[rows]).all(axis=1)
            if found is None and len(now) == 1:  # all of them, so nothing is to be copied
                found = again
            else:
                found = again.some(np.arange(len(left))) if found is None else found
                for better in (again.solved & ~found.solved[rows], right):
                    first = np.unique(np.where(better, rows, -1), return_index=True)[1]
                    found.put(rows, again, first[better[first]])
            left = np.setdiff1d(left, rows[right])
        assert found is not None
        found.costs[~found.solved] = np.inf
        return found

    def _sides(self, of: Sequence[int] | np.ndarray, paths: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """(J, most obstacles) on which sides ground paths (n, at least 2) pass; 0 where there is no obstacle."""
        found = np.zeros((len(of), max(map(len, self._obstacles))), int)
        for row, (i, path) in enumerate(zip(of, paths, strict=True)):
            found[row, : len(self._obstacles[i])] = sides_passed(path, self._obstacles[i])
        return found

    def _keep(
        self, guesses: Motions, tries: Sequence[Options], end_multipliers: np.ndarray | None = None
    ) -> np.ndarray:
        """Solves guesses, keeps the cheapest solution of every episode, and returns all costs (J,).

        After guesses that end early, LQR continues. If its actual cost differs from its cost-to-go, the whole episode is
        solved with this motion as the guess.
        """
        if not len(guesses.of):
            return np.zeros(0)
        return self._kept(self._solve(guesses, tries, end_multipliers=end_multipliers))

    def _kept(self, found: Motions) -> np.ndarray:
        if self._solver.rest is not None and found.a.shape[1] < self._task.steps:
            found = self._to_the_end(found)
            again = np.flatnonzero(~found.solved & np.isfinite(found.costs))
            found.costs[again] = self._keep(found.some(again), _MOTION)
        self._write(found)
        return found.costs

    def _write(self, found: Motions) -> None:
        """Keeps the cheapest solution of every episode."""
        for i in np.flatnonzero(found.solved).tolist():
            row, cost = int(found.of[i]), found.costs[i]
            if cost < self._costs[row]:
                self._costs[row], self._best[row] = cost, (found, i)

    def _to_the_end(self, found: Motions) -> Motions:
        """Whole episodes, of solutions of their first seconds and LQR then: solved where LQR's cost-to-go was right."""
        rest, ends, limit = self._solver.rest, self._ends[found.of], self._params.force_limit
        assert rest is not None
        left, last = self._task.steps - found.a.shape[1], found.x[:, -1]
        given = self._given(found.of, self._task.steps)
        x, a, costs = self._solver.simulate(last, left, self._task.control_dt, given, ends=ends)
        expected = rest.costs(last - ends)
        whole = replace(
            found,
            steps=found.steps + left,
            x=np.concatenate([found.x, x[:, 1:]], axis=1),
            a=np.concatenate([found.a, a], axis=1),
            gains=np.concatenate([found.gains, np.broadcast_to(rest.gain / limit, (len(a), left, 2, 8))], axis=1),
            slopes=np.concatenate([found.slopes, rest.slopes(x[:, :-1] - ends[:, None])], axis=1),
            costs=found.costs - expected + costs,
        )
        whole.solved[:] &= np.abs(costs - expected) <= _AT_REST * np.abs(whole.costs)
        return whole

    def _recoveries(self) -> Motions:
        """The cheapest simulated recoveries. Where none in the plane of the fall survives, those to its sides are tried."""
        count, n = len(self._x0), self._recovery_steps
        best = np.full(count, np.inf)
        x, a = np.zeros((count, n + 1, 8)), np.zeros((count, n, 2))
        for family in (_FAMILY, _SIDEWAYS_FAMILY):
            rows = np.flatnonzero(np.isinf(best))
            for how in family if len(rows) else ():
                states, actions, costs = self._recovered(rows, Recovery(*how))
                cheaper = costs < best[rows]
                for kept, values in zip((x, a, best), (states, actions, costs), strict=True):
                    kept[rows[cheaper]] = values[cheaper]
        return Motions.guessed(np.arange(count), np.full(count, n), x, a).some(np.isfinite(best))

    @property
    def _recovery_steps(self) -> int:
        """Control steps that are simulated; LQR's cost-to-go counts after them."""
        task = self._task
        return task.steps if self._solver.rest is None else min(task.steps, round(_SECONDS / task.control_dt))

    def _recovered(self, of: np.ndarray, how: Recovery) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States (J, n+1, 8), actions (J, n, 2) and costs (J,) of simulated recoveries of some episodes."""
        task, x0, n = self._task, self._x0[of], self._recovery_steps
        times, side = task.control_dt * np.arange(n), righting.leaning_aside(x0, np.ones(len(of))).T
        path = np.zeros((len(of), n, 4))
        path[..., :2] = self._ends[of, None, :2]
        path[..., 2:] = how.lean * np.exp(-times / how.fade)[None, :, None] * side[:, None]
        steering, given = (how.bandwidth, how.seconds), self._given(of, task.steps)
        states, actions, costs = self._solver.simulate(x0, n, task.control_dt, given, path, steering)
        if self._solver.rest is not None and n < task.steps:
            costs = costs + self._solver.rest.costs(states[:, -1] - self._ends[of])
        return states, actions, costs

    def _along(self, of: Sequence[int], paths: Sequence[np.ndarray], coarseness: int = 1) -> Motions:
        """Guesses along ground paths (steps+1, 2) of the same number of steps."""
        x, a = self._motion(np.array(paths), self._task.control_dt, self._x0[of])
        a = a[:, ::coarseness]
        return Motions.guessed(np.asarray(of), np.full(len(a), a.shape[1]), x[:, ::coarseness], a)

    def _motion(self, path: np.ndarray, length: float | np.ndarray, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, u = guess.along_path(self._params, path, length, start=x0)
        return x, u / self._params.force_limit

    def _paths(self, rows: np.ndarray) -> tuple[list[int], list[np.ndarray]]:
        """The index of the episode of each guessed path, and the paths."""
        of, paths = [], []
        for i in rows.tolist():
            some = self._guessed_paths[i][:CONSIDERED]
            of += [i] * len(some)
            paths += some
        return of, paths

    def _follow_paths(self, rows: np.ndarray) -> None:
        """Along guessed paths; several of an episode are first compared with forces held longer."""
        if not len(rows):
            return
        of, paths = self._paths(rows)
        chosen = np.arange(len(of))
        if len(of) > len(rows) and self._task.steps % COARSE == 0:
            found = self._solve(self._along(of, paths, COARSE), _ROUGH_PATH, COARSE)
            chosen = _contenders(found, BASIN_DOUBT)
        self._keep(self._along([of[i] for i in chosen], [paths[i] for i in chosen]), _PATH)

    def _arrive(self, of: Sequence[int], paths: Sequence[np.ndarray]) -> np.ndarray:
        """The episodes of first-exit tasks along paths, as `Shooting.in_whole_steps` does it for one; returns costs (J,).

        Solutions that are clearly not the best are not solved for whole steps, so their costs are those with a free length.
        """
        task, n = self._task, FREE_TIME_INTERVALS
        lengths = np.array([len(path) - 1 for path in paths]) * task.control_dt / n
        x, a = self._motion(np.array([guess.resampled(path, n) for path in paths]), lengths, self._x0[of])
        x = np.concatenate([x, np.broadcast_to(lengths[:, None, None], (len(of), n + 1, 1))], axis=-1)
        motions = Motions.guessed(np.array(of), np.full(len(of), n), x, a)
        relaxed = self._solve(motions, _ROUGH_GOAL, free_time=True)
        chosen = _contenders(relaxed, BASIN_DOUBT)
        arrivals = np.ceil(relaxed.x[chosen, 0, 8] * n / task.control_dt).astype(int)
        tried: dict[int, dict[int, float]] = {i: {} for i in chosen.tolist()}  # costs by number of steps
        wanted = [
            (i, s)
            for i, arrival in zip(chosen.tolist(), arrivals.tolist(), strict=True)
            for s in range(arrival - 1, arrival + 2)
        ]
        while wanted := [(i, s) for i, s in wanted if 1 <= s <= task.steps]:
            wanted.sort(key=lambda pair: pair[1])  # episodes of about as many steps are solved together
            rows, steps = np.array(wanted).T
            x, a = np.zeros((len(rows), steps.max() + 1, 8)), np.zeros((len(rows), steps.max(), 2))
            for s in np.unique(steps).tolist():
                some = rows[steps == s]
                x[steps == s, : s + 1], a[steps == s, :s] = guess.motion_resampled(
                    relaxed.x[some, :, :8], relaxed.a[some], s
                )
            guesses = Motions.guessed(relaxed.of[rows], steps, x, a)
            found = self._keep(guesses, _NEAR_GOAL, relaxed.end_multipliers[rows])
            for (i, s), cost in zip(wanted, found.tolist(), strict=True):
                tried[i][s] = cost
            wanted = []
            for i, costs in tried.items():
                best = min(costs, key=costs.__getitem__, default=0)
                if costs and math.isfinite(costs[best]):
                    wanted += [(i, s) for s in (best - 1, best + 1) if s not in costs]
        costs = relaxed.costs.copy()
        costs[chosen] = [min(tried[i].values(), default=np.inf) for i in chosen.tolist()]
        return costs

    def _weave(self) -> None:
        """Slaloms: likely choices of sides are compared with forces held longer, over the time until LQR is right about the
        rest.
        """
        task, params, coarse, every = self._task, self._params, COARSE, np.arange(len(self._x0))
        straight = [straight_path(task, params, x0, c) for x0, c in zip(self._x0, self._c, strict=True)]
        away = np.array([task.without_obstacles(c) for c in self._c])
        free = self._solve(self._along(every.tolist(), straight, coarse), _ROUGH_PATH, coarse, c=away)
        along = guess.resampled(free.x[..., :1], task.steps)[..., 0]
        goal_y = np.array([straight_one[-1, 1] for straight_one in straight])
        likely: dict[int, dict[int, np.ndarray]] = {}  # choices by the steps that are optimized, and by episode
        counts = np.where(free.solved, [len(each) for each in self._obstacles], 0)
        for count in np.unique(counts[counts > 0]):
            rows = np.flatnonzero(counts == count)
            own = np.array([self._obstacles[i] for i in rows])
            found = sides.predict(task, params, self._x0[rows], goal_y[rows], along[rows], own)
            predicted, steps = free.costs[rows, None] + found.costs, np.full(len(rows), task.steps)
            if self._solver.rest is not None:  # rounded up, so that many episodes share a horizon
                shared = coarse * max(1, round(_SHARED_SECONDS / task.control_dt / coarse))
                after = found.passed.max(1) + _AFTER_SECONDS / task.control_dt
                steps = np.minimum(steps, np.ceil(after / shared).astype(int) * shared)
            for i, prices, last in zip(rows.tolist(), predicted, steps.tolist(), strict=True):
                order = np.argsort(prices, kind="stable")
                if self._wanted_sides is not None:
                    wanted, ahead = self._wanted_sides[i][:count], self._obstacles[i][:, 0] > self._x0[i, 0]
                    order = order[((found.sides[order] == wanted) | ~ahead).all(1)]
                chosen = order[prices[order] <= prices[order[0]] * (1 + found.doubt)]
                likely.setdefault(last, {})[i] = found.sides[chosen]
        for steps, choices in likely.items():
            self._pass_obstacles(choices, steps)

    def _pass_obstacles(self, likely: Mapping[int, np.ndarray], steps: int) -> None:
        """The best of likely choices of sides (k, obstacles) of episodes, whose first control steps are optimized."""
        task, coarse = self._task, COARSE
        of = [i for i, choices in likely.items() for _ in choices]
        paths = [
            task.routed_path(self._x0[i], self._c[i], tuple(chosen.tolist()))[: steps + 1]
            for i, choices in likely.items()
            for chosen in choices
        ]
        along, wanted = self._along(of, paths, coarse), self._sides(of, paths)
        rough = self._solve(along, _SIDES, coarse, chosen_sides=wanted)
        chosen = _contenders(rough, _SIDES_DOUBT)
        if not len(chosen):
            return
        left = chosen[np.isinf(self._refine(rough.some(chosen), steps, wanted[chosen]))]
        if len(left):
            self._keep(self._along([of[i] for i in left], [paths[i] for i in left]), _PATH)

    def _refine(self, rough: Motions, steps: int, chosen_sides: np.ndarray | None = None) -> np.ndarray:
        """Solves slaloms in full from solutions with forces held longer, keeps the cheapest, and returns all costs (J,)."""
        x = np.array([guess.resampled(states, steps) for states in rough.x])
        near = Motions.guessed(rough.of, np.full(len(x), steps), x, np.repeat(rough.a, COARSE, axis=1))
        found = self._solve(near, _ROUGH_SOLUTION, chosen_sides=chosen_sides)
        self._pass_later(found)
        return self._kept(found)

    def _search_randomly(self, guesses: int, enough: float) -> np.ndarray:
        """Keeps the cheapest solutions from random guesses; returns costs (guesses, B), as `search` does."""
        count = len(self._x0)
        random = [RandomGuesses(x0, c) for x0, c in zip(self._x0, self._c, strict=True)]
        costs = np.full((guesses, count), np.inf)
        if guesses:
            self._known = self._known_motions()
        for first in range(0, guesses, LANES):
            solved, numbers = np.isfinite(costs).sum(axis=0), np.arange(first, min(first + LANES, guesses))
            left = np.flatnonzero((solved < enough) & ((solved > 0) | (first < _HOPELESS)))
            number, of = (part.ravel() for part in np.meshgrid(numbers, left, indexing="ij"))
            recovering = (number % 3 == 0) & self._ends_at_a_point & (not self.is_slalom)
            for rows, search in ((recovering, self._recover_randomly), (~recovering, self._detour)):
                if rows.any():
                    costs[number[rows], of[rows]] = search(of[rows], random)
        return costs

    def _known_motions(self) -> dict[int, _Known]:
        """The path of the best motion so far of each solved episode; in a slalom with its cost if forces are held longer."""
        paths = {i: found.x[row, : found.steps[row] + 1, :2] for i, (found, row) in self._best.items()}
        if not self.is_slalom or not paths:
            return {i: _Known(path, np.inf) for i, path in paths.items()}
        rough = self._solve(self._along(list(paths), list(paths.values()), COARSE), _SIDES, COARSE)
        return {i: _Known(path, cost) for (i, path), cost in zip(paths.items(), rough.costs.tolist(), strict=True)}

    def _recover_randomly(self, of: np.ndarray, random: Sequence[RandomGuesses]) -> np.ndarray:
        """(J,) costs from a random recovery of each of some episodes."""
        tried = [self._recovered(np.array([i]), random[i].recovery()) for i in of]
        x, a, costs = (np.concatenate(part) for part in zip(*tried, strict=True))
        survived = np.isfinite(costs)
        guesses = Motions.guessed(of, np.full(len(of), self._recovery_steps), x, a)
        costs[survived] = self._keep(guesses.some(survived), _MOTION)
        return costs

    def _detour(self, of: np.ndarray, random: Sequence[RandomGuesses]) -> np.ndarray:
        """(J,) costs along a random detour of each of some episodes, of its best known motion or of a guessed path."""
        task, paths = self._task, []
        for i in of.tolist():
            known = self._known[i].path if i in self._known else None
            paths.append(random[i].detour(self._guessed_paths[i], known, task.first_exit))
        if task.first_exit:
            return self._arrive(of.tolist(), paths)
        if not self.is_slalom:
            return self._keep(self._along(of.tolist(), paths), _PATH)
        rough = self._solve(self._along(of.tolist(), paths, COARSE), _SIDES, COARSE)
        costs = rough.costs.copy()
        new = [row for row in _contenders(rough, _SIDES_DOUBT).tolist() if self._is_new(rough, row)]
        if new:
            costs[new] = self._refine(rough.some(np.array(new)), task.steps)
        return costs

    def _is_new(self, rough: Motions, row: int) -> bool:
        """Whether a rough solution is another motion than the known one of its episode, and may be better."""
        known = self._known.get(int(rough.of[row]))
        if known is None:
            return True
        moved = np.abs(rough.x[row, :, :2] - known.path[::COARSE]).max()
        return bool(moved > _SAME and rough.costs[row] < known.rough_cost * (1 + _SIDES_DOUBT))

    def _pass_later(self, found: Motions) -> None:
        """Replaces the best solution of every episode by one that passes the obstacles a control step later or earlier, where
        that is cheaper.

        A robot cuts corners between its control steps. So wherever an apex lies between two of them is a local optimum.
        """
        of = found.of[np.isfinite(found.costs)]
        if not len(of):
            return
        rows = np.array([np.where(found.of == i, found.costs, np.inf).argmin() for i in np.unique(of)])
        two = np.tile(rows, 2)
        x, a, multipliers = (
            np.concatenate([_shifted(part[rows], 1), _shifted(part[rows], -1)])
            for part in (found.x, found.a, found.multipliers)
        )
        x[:, 0] = found.x[two, 0]
        multipliers = np.maximum(multipliers, _SHIFTED.multiplier)
        guesses = Motions.guessed(found.of[two], found.steps[two], x, a)
        given, ends = self._given(guesses.of, a.shape[1]), found.end_multipliers[two]
        moved = self._solver.solve(guesses, self._task.control_dt, given, [_SHIFTED] * len(two), multipliers, ends)
        moved.costs[~moved.solved] = np.inf
        earlier = moved.costs[len(rows) :] < moved.costs[: len(rows)]
        best = np.arange(len(rows)) + len(rows) * earlier
        found.put(two, moved, best[moved.costs[best] < found.costs[rows]])


def _shifted(values: np.ndarray, later: int) -> np.ndarray:
    """(J, n, k) values, each shifted by `later` steps; the first or last ones are repeated."""
    n = values.shape[1]
    return values[:, np.clip(np.arange(n) - later, 0, n - 1)]


def _contenders(found: Motions, doubt: float) -> np.ndarray:
    """Which of J solutions are `contenders` for the optimum of their episode."""

    def same(i: int, j: int) -> bool:
        return bool(np.abs(found.x[i, :, :2] - found.x[j, :, :2]).max() <= _SAME)

    chosen = []
    for episode in np.unique(found.of):
        rows = np.flatnonzero(found.of == episode)
        mine = contenders(found.costs[rows], doubt, lambda i, j, rows=rows: same(rows[i], rows[j]))
        chosen += rows[mine].tolist()
    return np.array(sorted(chosen), int)
