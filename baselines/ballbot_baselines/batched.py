"""Optima of thousands of episodes, by iLQR with force limits in compiled code, for tasks that end at rest without obstacles.

Every episode starts from its cheapest simulated recovery (`righting.steering`). Each iteration first sweeps backwards with
the box-constrained Riccati recursion of Tassa et al., "Control-limited differential dynamic programming" (2014). Then it
simulates the new feedback, with shorter steps where the cost rises. Sweep and simulation are one call of compiled code each,
which takes a fraction of a millisecond.

Only the first seconds of an episode are optimized. LQR's cost-to-go stands for the rest, where the robot is nearly at rest.
The returned cost is that of the whole episode, simulated in the closed form under these forces and then LQR's. So it is never
below the optimum.

Margins are not part of the optimization. Episodes that violate one, or that no recovery survives, are not solved.
`benchmarks/batched_optima.py` measures it on Stabilize.
"""

import functools
import itertools
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import casadi
import numpy as np

from ballbot_baselines import righting
from ballbot_baselines.compiled import LANES, InPlace, in_lanes
from ballbot_baselines.lqr import discrete_lqr, is_equilibrium
from ballbot_gym import dynamics, ops
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task

_SECONDS = 3.0  # optimized; LQR's cost-to-go counts for the rest
# of simulated recoveries: bandwidth, rad/s; time constant, s; lean to the side, rad, and how fast it fades, s
_FAMILY = tuple(itertools.product((7.0, 14.0), (1.0, 1.4), (0.0,), (1.0,)))
_SIDEWAYS_FAMILY = tuple(itertools.product((7.0, 10.0, 14.0), (1.0, 1.8), (-0.6, -0.3, 0.3, 0.6), (0.3,)))
_MOST_ITERATIONS = 15
_SHORTER_STEPS = (0.5, 0.2, 0.05, 0.01)  # shares of a step that are tried in turn where the whole step raises the cost
_TOLERANCE = 1e-5  # relative: an iteration that promises to lower the cost by less is the last
_SUBSTEPS = 1  # of RK4 where a control step is linearized; it is then wrong by a millionth
_FORCE_BACKOFF = 1e-7  # of the force limit, as in `shooting.Backoff`
_AT_ONCE = 256  # episodes in memory between iterations
_NO_GAINS, _NO_STATES, _NO_FORCES = np.zeros((1, 1, 16)), np.zeros((1, 1, 8)), np.zeros((1, 1, 2))

_one_at_a_time = threading.Lock()  # a task's compiled functions read and write the same arrays in every call


@dataclass(frozen=True)
class BatchOptima:
    """Optima of B episodes of n control steps.

    | field | shape | meaning |
    |---|---|---|
    | costs | (B,) | NaN where not solved |
    | solved | (B,) bool | it converged, and no margin is violated |
    | states | (B, n+1, 8) | |
    | forces | (B, n, 2) | N |
    | gains | (B, n, 2, 8) | K of the feedback u − K (x' − x) about the optimum, N per unit of the state |
    | slopes | (B, n, 8) | of the remaining cost with respect to each state but the last |
    | iterations | (B,) | |
    """

    costs: np.ndarray
    solved: np.ndarray
    states: np.ndarray
    forces: np.ndarray
    gains: np.ndarray
    slopes: np.ndarray
    iterations: np.ndarray


def solves(task: Task, params: BallbotParams) -> bool:
    """Whether `find_optima` solves this task: it comes to rest in an equilibrium, and only tilt and arena limit it."""
    if task.first_exit or params.grips:
        return False
    x, c = task.sample(np.random.default_rng(0), params)
    reference = task.reference(x, c, params)
    free = len(task.margins(tuple(x), tuple(c))) == len(Task.margins(task, tuple(x), tuple(c)))
    return free and not len(c) and len(reference.x) == 1 and is_equilibrium(params, reference.x[0], reference.u[0])


def find_optima(task: Task, params: BallbotParams, x0: np.ndarray, forces: np.ndarray | None = None) -> BatchOptima:
    """Optimizes B episodes on one core.

    Args:
        task: one that `solves` admits.
        x0: (B, 8) initial states.
        forces: (B, k, 2) N, of episodes to start from where they are cheaper than the simulated recoveries, as those of a
            policy; k at least `optimized_steps(task)`.

    Raises:
        ValueError: the task is none that it solves, or an array has the wrong shape.
    """
    if not solves(task, params):
        raise ValueError(f"{task.id} with this robot is not solved in batches; take find_optimum")
    x0 = np.asarray(x0, np.float64)
    if x0.ndim != 2 or x0.shape[1] != 8:
        raise ValueError(f"x0 must have the shape (B, 8), not {x0.shape}")
    steps, count = optimized_steps(task), len(x0)
    if forces is not None and (forces.shape[::2] != (count, 2) or forces.shape[1] < steps):
        raise ValueError(f"forces must have the shape ({count}, at least {steps}, 2), not {forces.shape}")
    solver = _solver(task, params)
    n = task.steps
    optima = BatchOptima(
        costs=np.full(count, np.nan),
        solved=np.zeros(count, bool),
        states=np.zeros((count, n + 1, 8)),
        forces=np.zeros((count, n, 2)),
        gains=np.zeros((count, n, 2, 8)),
        slopes=np.zeros((count, n, 8)),
        iterations=np.zeros(count, int),
    )
    with _one_at_a_time:
        for first in range(0, count, _AT_ONCE):
            rows = np.arange(first, min(first + _AT_ONCE, count))
            solver.solve(x0[rows], None if forces is None else forces[rows, :steps], optima, rows)
    optima.solved[:] = np.isfinite(optima.costs)
    return optima


def optimized_steps(task: Task) -> int:
    """Control steps at the start of an episode that `find_optima` optimizes."""
    return min(task.steps, round(_SECONDS / task.control_dt))


@dataclass(frozen=True)
class _Episodes:
    """B simulated episodes, the steps first: states (n+1, B, 8), forces (n, B, 2), N.

    `held` (B,) are their costs, `cost` (B,) those with LQR's cost-to-go, infinite where a margin is violated.
    """

    x: np.ndarray
    u: np.ndarray
    held: np.ndarray
    cost: np.ndarray

    def of(self, rows: np.ndarray) -> "_Episodes":
        """Some of them, copied."""
        return _Episodes(self.x[:, rows], self.u[:, rows], self.held[rows], self.cost[rows])

    def put(self, rows: np.ndarray, others: "_Episodes") -> None:
        """Puts others in the place of some of them."""
        self.x[:, rows], self.u[:, rows], self.held[rows], self.cost[rows] = (
            others.x,
            others.u,
            others.held,
            others.cost,
        )

    def improve(self, rows: np.ndarray, others: "_Episodes") -> np.ndarray:
        """Puts others in the place of some of them where they are cheaper, and says where (len(rows),)."""
        cheaper = others.cost < self.cost[rows]
        self.put(rows[cheaper], others.of(cheaper))
        return cheaper


class _Solver:
    """The optimizer of one task."""

    def __init__(self, task: Task, params: BallbotParams):
        self._task, self._steps = task, optimized_steps(task)
        rest = task.reference(np.zeros(8), np.zeros(0), params)
        self._rest = rest.x[-1]
        self._lqr, self._p = discrete_lqr(task, params, rest.x[-1], rest.u[-1], np.zeros(0))
        limit = params.force_limit * (1 - _FORCE_BACKOFF)
        n, rest_steps = self._steps, task.steps - self._steps
        follow, steer, sweep = in_lanes(
            f"{task.id}-batch",
            (
                _following(task, params, limit),
                _steering(task, params, limit, self._rest[:2]),
                _sweeping(task, params, limit),
            ),
        )
        self._follow, self._follow_to_end = _Call(follow, n), _Call(follow, max(rest_steps, 1))
        self._steer, self._sweep = _Call(steer, n), _Call(sweep, n, last_alone=True)
        self._lqr_gains, self._at_rest = self._lqr.reshape(1, 1, 16), self._rest.reshape(1, 1, 8)
        self._end_value = np.array([2 * self._p[i, j] for i, j in _UPPER])
        times = task.control_dt * np.arange(n)
        self._fading = {fade: np.exp(-times / fade) for *_, fade in (*_FAMILY, *_SIDEWAYS_FAMILY)}

    def solve(self, x0: np.ndarray, forces: np.ndarray | None, optima: BatchOptima, rows: np.ndarray) -> None:
        """Optimizes B episodes, and writes those that some recovery survives into `optima`.

        Args:
            x0: (B, 8) initial states.
            forces: (B, T, 2) to start from where they are cheaper than recoveries.
            optima: to be filled. Costs stay NaN where it did not converge, or a margin is violated.
            rows: (B,) of these.
        """
        current = self._recoveries(x0)
        if forces is not None:
            current.improve(np.arange(len(x0)), self._roll(x0, forces.swapaxes(0, 1), _NO_GAINS, _NO_STATES))
        active = np.flatnonzero(np.isfinite(current.cost))
        current, iterations = current.of(active), 0
        while len(active):
            change, gains, slopes, promised = self._backward(current)
            iterations += 1
            before, x = current, current.x[:-1]
            current = self._roll(x[0], before.u + change, gains, x)
            dearer = np.flatnonzero(~(current.cost < before.cost))
            current.put(dearer, before.of(dearer))
            for share in _SHORTER_STEPS:
                if len(dearer):
                    u = before.u[:, dearer] + share * change[:, dearer]
                    tried = self._roll(x[0, dearer], u, gains[:, dearer], x[:, dearer])
                    dearer = dearer[~current.improve(dearer, tried)]
            stuck = np.isin(np.arange(len(active)), dearer)
            converged = ~stuck & (promised < _TOLERANCE * before.cost)
            over = stuck | converged | (iterations == _MOST_ITERATIONS)
            if over.any():
                optima.iterations[rows[active[over]]] = iterations
                self._write(
                    optima, rows[active[over]], current.of(over), gains[:, over], slopes[:, over], converged[over]
                )
                active, current = active[~over], current.of(~over)

    def _write(
        self,
        optima: BatchOptima,
        rows: np.ndarray,
        episodes: _Episodes,
        gains: np.ndarray,
        slopes: np.ndarray,
        converged: np.ndarray,
    ) -> None:
        """Writes episodes, followed by LQR, with gains (T, B, 16) and slopes (T, B, 8), into rows (B,) of `optima`."""
        n, costs = self._steps, episodes.held
        margins = self._task.margins(episodes.x[0], np.zeros(0))
        room = np.min(np.broadcast_arrays(*margins), axis=0)
        optima.states[rows, : n + 1] = episodes.x.swapaxes(0, 1)
        optima.forces[rows, :n] = episodes.u.swapaxes(0, 1)
        optima.gains[rows, :n] = gains.swapaxes(0, 1).reshape(len(rows), n, 2, 8)
        optima.slopes[rows, :n] = slopes.swapaxes(0, 1)
        if n < self._task.steps:
            x, u, running, rooms = self._follow_to_end(episodes.x[-1:], _NO_FORCES, self._lqr_gains, self._at_rest)
            costs, room = costs + _total(running), np.minimum(room, rooms.min(axis=(0, 2)))
            x = np.concatenate([episodes.x[-1:], x])
            optima.states[rows, n:], optima.forces[rows, n:] = x.swapaxes(0, 1), u.swapaxes(0, 1)
            optima.gains[rows, n:] = self._lqr
            optima.slopes[rows, n:] = 2 * _product(x[:-1] - self._rest, self._p).swapaxes(0, 1)
        optima.costs[rows] = np.where(converged & (room >= 0), costs, np.nan)

    def _recoveries(self, x0: np.ndarray) -> _Episodes:
        """The cheapest simulated recoveries. Where none in the plane of the fall survives, those to its sides are tried."""
        n, count = self._steps, len(x0)
        best = _Episodes(np.zeros((n + 1, count, 8)), np.zeros((n, count, 2)), np.zeros(count), np.full(count, np.inf))
        side = righting.leaning_aside(x0, np.ones(count)).T
        for family in (_FAMILY, _SIDEWAYS_FAMILY):
            rows = np.flatnonzero(np.isinf(best.cost))
            for bandwidth, seconds, lean, fade in family if len(rows) else ():
                aside = lean * self._fading[fade][:, None, None] * side[rows]
                best.improve(
                    rows,
                    self._episodes(x0[rows], self._steer(x0[None, rows], aside, np.array([[[bandwidth, seconds]]]))),
                )
        return best

    def _roll(self, x0: np.ndarray, u: np.ndarray, gains: np.ndarray, about: np.ndarray) -> _Episodes:
        """Simulates u − K (x − about)."""
        return self._episodes(x0, self._follow(x0[None], u, gains, about))

    def _episodes(self, x0: np.ndarray, simulated: Sequence[np.ndarray]) -> _Episodes:
        """Episodes of the optimized steps, with LQR's cost-to-go after them."""
        after, u, costs, room = simulated
        held, off = _total(costs), after[-1] - self._rest
        safe = room.min(axis=(0, 2)) > 0  # NaN is not
        with np.errstate(over="ignore", invalid="ignore"):  # of what fell
            cost = np.where(safe, held + (_product(off, self._p) * off).sum(axis=1), np.inf)
        return _Episodes(np.concatenate([x0[None], after]), u, held, cost)

    def _backward(self, episodes: _Episodes) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Changes of the forces (T, B, 2), feedback K (T, B, 16), slopes of the cost-to-go (T, B, 8), and by how much the
        linear model says that the changes lower the costs (B,).
        """
        count = len(episodes.cost)
        slope = 2 * _product(episodes.x[-1] - self._rest, self._p)
        end = np.concatenate([np.tile(self._end_value, (count, 1)), slope, np.zeros((count, 1))], axis=1)
        ahead, change, gains, slopes = self._sweep(end[None], episodes.x[-2::-1], episodes.u[::-1])
        return change[::-1], gains[::-1], slopes[::-1], ahead[-1, :, -1]


# NumPy's own sums and products add in an order that depends on the number of episodes.


def _total(costs: np.ndarray) -> np.ndarray:
    """(B,) sums of (n, B, 1)."""
    return np.cumsum(costs[..., 0], axis=0)[-1]


def _product(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(..., 8) products of rows (..., 8) and a matrix (8, 8)."""
    return functools.reduce(np.add, (rows[..., i, None] * row for i, row in enumerate(matrix)))


@functools.lru_cache(maxsize=4)
def _solver(task: Task, params: BallbotParams) -> _Solver:
    return _Solver(task, params)


class _Call:
    """A function of `LANES` episodes and one control step, for n steps of any number of episodes.

    Its first result is its first argument in the next step. Arguments and results are arrays (n, B, k). Arguments may have
    n = 1 or B = 1: the same for all steps or episodes. CasADi sees them as (k, n · LANES).
    """

    def __init__(self, step: casadi.Function, n: int, last_alone: bool = False):
        """Makes it. With `last_alone`, the first result is returned for the last step alone."""
        function = step.mapaccum(n)
        self._arguments = [self._array(function.size_in(i)) for i in range(function.n_in())]
        first, *others = results = [self._array(function.size_out(i)) for i in range(function.n_out())]
        self._evaluate = InPlace(function, self._arguments, results)
        self._wanted = [first[-1:] if last_alone else first, *others]

    @staticmethod
    def _array(size: tuple[int, int]) -> np.ndarray:
        return np.zeros((size[1] // LANES, LANES, size[0]))

    def __call__(self, *arguments: np.ndarray) -> list[np.ndarray]:
        count = max(array.shape[1] for array in arguments)
        each = []
        for kept, given in zip(self._arguments, arguments, strict=True):
            if given.shape[1] == count:
                each.append((kept, given))
            else:
                kept[:] = given  # the same for all episodes
        results = [np.empty((len(kept), count, kept.shape[2])) for kept in self._wanted]
        for first in range(0, count, LANES):
            width = min(LANES, count - first)
            episodes, lanes = slice(first, first + width), slice(width)
            for kept, given in each:
                kept[:, lanes] = given[:, episodes]  # other lanes compute what was there before
            self._evaluate()
            for result, kept in zip(results, self._wanted, strict=True):
                result[:, episodes] = kept[:, lanes]
        return results


# The functions of one control step and one episode.


def _held(task: Task, params: BallbotParams, x: casadi.SX, u: Sequence[casadi.SX]) -> list[casadi.SX]:
    """State after the step, force, cost, and the least margin."""
    force = casadi.vertcat(*u)
    after = dynamics.step(params, x, force, task.control_dt, dynamics.substeps_for(task.control_dt))
    room = casadi.mmin(casadi.vertcat(*task.margins(after, casadi.SX(0, 1))))
    return [after, force, task.control_dt * task.cost(x, force, casadi.SX(0, 1)), room]


def _following(task: Task, params: BallbotParams, limit: float) -> casadi.Function:
    """u − K (x − about) held."""
    x, u, k, about = (casadi.SX.sym(name, size) for name, size in (("x", 8), ("u", 2), ("k", 16), ("about", 8)))
    forces = u - casadi.reshape(k, 8, 2).T @ (x - about)
    clipped = [ops.clip(forces[i], -limit, limit) for i in range(2)]
    return casadi.Function("follow_step", [x, u, k, about], _held(task, params, x, clipped))


def _steering(task: Task, params: BallbotParams, limit: float, target: np.ndarray) -> casadi.Function:
    """The cascade's force held; gains are its bandwidth and time constant."""
    x, aside, gains = (casadi.SX.sym(name, size) for name, size in (("x", 8), ("aside", 2), ("gains", 2)))
    u = righting.steering(params, x, aside, gains[0], gains[1], tuple(map(float, target)), limit)
    return casadi.Function("steer_step", [x, aside, gains], _held(task, params, x, u))


def _sweeping(task: Task, params: BallbotParams, limit: float) -> casadi.Function:
    """One control step of the Riccati recursion.

    What is ahead, and comes out for the step before: 36 second derivatives of the cost-to-go in the order of `_UPPER`, its 8
    slopes, and by how much the changes lower the cost. The other results are the change of the force (2,), K (16,), and the
    slopes again.
    """
    ahead, x, u = (casadi.SX.sym(name, size) for name, size in (("ahead", 45), ("x", 8), ("u", 2)))
    z, dt = casadi.vertcat(x, u), task.control_dt
    linear = casadi.jacobian(dynamics.step(params, x, u, dt, _SUBSTEPS), z)
    of_cost, slope_of_cost = casadi.hessian(dt * task.cost(x, u, casadi.SX(0, 1)), z)
    value = casadi.SX(8, 8)
    for k, (i, j) in enumerate(_UPPER):
        value[i, j] = value[j, i] = ahead[k]
    hessian = of_cost + linear.T @ value @ linear
    slope = slope_of_cost + linear.T @ ahead[36:44]
    of_force, mixed = hessian[8:, 8:], hessian[8:, :8]
    change, inverse = _box_step(of_force, slope[8:], -limit - u, limit - u)
    feedback = inverse @ mixed
    moved = of_force @ change + slope[8:]
    before = hessian[:8, :8] - mixed.T @ feedback
    promised = ahead[44] - 0.5 * casadi.dot(change, moved + slope[8:])
    slope_before = slope[:8] + mixed.T @ change - feedback.T @ moved
    out = casadi.vertcat(*(before[i, j] for i, j in _UPPER), slope_before, promised)
    return casadi.Function(
        "sweep_step", [ahead, x, u], [out, change, casadi.vec(feedback.T), slope_before], {"cse": True}
    )


_UPPER = [(i, j) for i in range(8) for j in range(i, 8)]


def _box_step(hessian: casadi.SX, gradient: casadi.SX, low: casadi.SX, high: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
    """The d (2,) within [low, high] that minimizes ½ dᵀHd + gᵀd, and the inverse of H (2, 2) in its free components.

    In two dimensions it is the free minimum, or else the least of the minima on the four edges.
    """
    a, b, c = hessian[0, 0], hessian[0, 1], hessian[1, 1]
    determinant = a * c - b * b
    inverse = casadi.vertcat(casadi.horzcat(c, -b), casadi.horzcat(-b, a)) / determinant
    free = -inverse @ gradient
    inside = casadi.logic_and(casadi.mmin(free - low) >= 0, casadi.mmin(high - free) >= 0)
    on_edges = []
    for edge in (low, high):
        first = casadi.vertcat(edge[0], ops.clip(-(gradient[1] + b * edge[0]) / c, low[1], high[1]))
        second = casadi.vertcat(ops.clip(-(gradient[0] + b * edge[1]) / a, low[0], high[0]), edge[1])
        on_edges += [first, second]
    costs = [0.5 * casadi.dot(tried, hessian @ tried) + casadi.dot(gradient, tried) for tried in on_edges]
    step, least = on_edges[0], costs[0]
    for tried, cost in zip(on_edges[1:], costs[1:], strict=True):
        step = casadi.if_else(cost < least, tried, step)
        least = casadi.fmin(cost, least)
    step = casadi.if_else(inside, free, step)
    moves = [casadi.logic_and(step[i] > low[i], step[i] < high[i]) for i in range(2)]
    both = casadi.logic_and(*moves)
    alone = casadi.diag(casadi.vertcat(casadi.if_else(moves[0], 1 / a, 0), casadi.if_else(moves[1], 1 / c, 0)))
    return step, casadi.if_else(both, inverse, alone)
