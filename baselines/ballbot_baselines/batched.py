"""Optima of thousands of episodes, by iLQR with force limits in compiled code, for tasks that come to rest freely.

Every episode starts from its cheapest simulated recovery (`righting.steering`). Each iteration sweeps backwards with the
box-constrained Riccati recursion of Tassa et al., "Control-limited differential dynamic programming" (2014), and rolls the
new feedback out, with shorter steps where the cost rises. Each of both is one call of compiled code, which takes a fraction
of a millisecond.

An episode is optimized for its first seconds, and LQR's cost-to-go counts for what is left: there the robot is nearly at
rest. The cost that is returned is that of the whole episode in the closed form, under these forces and LQR's after them. So
it is the cost of an episode that exists, and never below the optimum.

It knows no margins: episodes that violate one, and those that no recovery survives, are not solved. Measured on Stabilize:
see `benchmarks/batched_optima.py`.
"""

import functools
import itertools
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import casadi
import numpy as np

from ballbot_baselines import righting
from ballbot_baselines.compiled import compiled
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
_FORCE_BACKOFF = 1e-7  # of the force limit, as in `optimum.Backoff`


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
    | iterations | (B,) | until it converged |
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
    """Optimizes B episodes, one after the other, on one core.

    Args:
        task: one that `solves` admits.
        params: the robot.
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
        for i in range(count):
            optima.costs[i] = solver.solve(x0[i], None if forces is None else forces[i, :steps], optima, i)
    optima.solved[:] = np.isfinite(optima.costs)
    return optima


def optimized_steps(task: Task) -> int:
    """Control steps at the start of an episode that `find_optima` optimizes."""
    return min(task.steps, round(_SECONDS / task.control_dt))


@dataclass(frozen=True)
class _Episode:
    """A simulated episode: states (n+1, 8), forces (n, 2), their cost, and that with LQR's cost-to-go after them.

    The last is infinite where a margin is violated.
    """

    x: np.ndarray
    u: np.ndarray
    held: float
    cost: float


class _Solver:
    """The optimizer of one task."""

    def __init__(self, task: Task, params: BallbotParams):
        self._task, self._steps = task, optimized_steps(task)
        rest = task.reference(np.zeros(8), np.zeros(0), params)
        self._rest = rest.x[-1]
        self._lqr, self._p = discrete_lqr(task, params, rest.x[-1], rest.u[-1], np.zeros(0))
        limit = params.force_limit * (1 - _FORCE_BACKOFF)
        n, rest_steps = self._steps, task.steps - self._steps
        functions = compiled(
            f"{task.id}-batch",
            (
                _following(task, params, limit).mapaccum("follow", n),
                _following(task, params, limit).mapaccum("follow_to_end", max(rest_steps, 1)),
                _steering(task, params, limit, self._rest[:2]).mapaccum("steer", n),
                _sweeping(task, params, limit).mapaccum("sweep", n),
            ),
        )
        self._follow, self._follow_to_end, self._steer, self._sweep = map(_Call, functions)
        self._no_gains = np.zeros((n, 16))
        self._lqr_gains = np.tile(self._lqr.ravel(), (rest_steps, 1))
        self._at_rest, self._no_forces = np.tile(self._rest, (rest_steps, 1)), np.zeros((rest_steps, 2))
        self._end_value = np.array([2 * self._p[i, j] for i, j in _UPPER])
        times = task.control_dt * np.arange(n)[:, None]
        self._fading = {fade: np.exp(-times / fade) for *_, fade in (*_FAMILY, *_SIDEWAYS_FAMILY)}

    def solve(self, x0: np.ndarray, forces: np.ndarray | None, optima: BatchOptima, row: int) -> float:
        """Optimizes one episode from x0 (8,), and writes it into a row of `optima`, but for the cost.

        Args:
            x0: (8,).
            forces: (T, 2) to start from where they are cheaper than recoveries.
            optima: to be filled.
            row: of these.

        Returns:
            The cost of the whole episode; NaN if it did not converge, or violates a margin.
        """
        best = self._recovery(x0)
        if forces is not None:
            given = self._roll(x0, forces, self._no_gains, np.zeros((self._steps, 8)))
            best = min(best, given, key=lambda episode: episode.cost)
        converged, gains, slopes = False, self._no_gains, np.zeros((self._steps, 8))
        while np.isfinite(best.cost) and not converged and optima.iterations[row] < _MOST_ITERATIONS:
            change, gains, slopes, promised = self._backward(best)
            optima.iterations[row] += 1
            tried = (self._roll(x0, best.u + share * change, gains, best.x[:-1]) for share in (1.0, *_SHORTER_STEPS))
            lower = next((episode for episode in tried if episode.cost < best.cost), None)
            if lower is None:
                break
            converged = promised < _TOLERANCE * best.cost
            best = lower
        n = self._steps
        x, u = optima.states[row], optima.forces[row]
        x[: n + 1], u[:n], optima.slopes[row, :n] = best.x, best.u, slopes
        optima.gains[row, :n], optima.gains[row, n:] = gains.reshape(n, 2, 8), self._lqr
        cost, room = best.held, min(np.min(margin) for margin in self._task.margins(x0, np.zeros(0)))
        if len(self._no_forces):
            x[n + 1 :], u[n:], costs, rooms = self._follow_to_end(x[n], self._no_forces, self._lqr_gains, self._at_rest)
            cost, room = cost + float(costs.sum()), min(room, rooms.min())
        optima.slopes[row, n:] = 2 * (x[n:-1] - self._rest) @ self._p
        return cost if converged and room >= 0 else np.nan

    def _recovery(self, x0: np.ndarray) -> _Episode:
        """The cheapest simulated recovery. Where none in the plane of the fall survives, those to its sides are tried."""
        best = _Episode(np.zeros((self._steps + 1, 8)), np.zeros((self._steps, 2)), 0.0, np.inf)
        side = righting.leaning_aside(x0, np.ones(1))[:, 0]
        for family in (_FAMILY, _SIDEWAYS_FAMILY):
            for bandwidth, seconds, lean, fade in family:
                found = self._episode(x0, self._steer(x0, lean * self._fading[fade] * side, [bandwidth, seconds]))
                best = min(best, found, key=lambda episode: episode.cost)
            if np.isfinite(best.cost):
                break
        return best

    def _roll(self, x0: np.ndarray, u: np.ndarray, gains: np.ndarray, about: np.ndarray) -> _Episode:
        """Simulates u − K (x − about)."""
        return self._episode(x0, self._follow(x0, u, gains, about))

    def _episode(self, x0: np.ndarray, simulated: Sequence[np.ndarray]) -> _Episode:
        """An episode of the optimized steps, with LQR's cost-to-go after them."""
        after, u, costs, room = simulated
        held, cost = float(costs.sum()), np.inf
        if room.min() > 0:  # NaN is not
            off = after[-1] - self._rest
            cost = held + float(off @ self._p @ off)
        return _Episode(np.concatenate([x0[None], after]), u, held, cost)

    def _backward(self, episode: _Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Changes of the forces (T, 2), feedback K (T, 16), slopes of the cost-to-go (T, 8), and by how much the linear model
        says that the changes lower the cost.
        """
        end = np.concatenate([self._end_value, 2 * self._p @ (episode.x[-1] - self._rest), [0.0]])
        ahead, change, gains = self._sweep(end, episode.x[-2::-1], episode.u[::-1])
        return change[::-1], gains[::-1], ahead[::-1, 36:44], float(ahead[-1, 44])


@functools.lru_cache(maxsize=4)
def _solver(task: Task, params: BallbotParams) -> _Solver:
    return _Solver(task, params)


class _Call:
    """A CasADi function that reads and writes NumPy arrays (n, k), which CasADi sees as (k, n), without a copy of its own."""

    def __init__(self, function: casadi.Function):
        self._buffer, self._evaluate = function.buffer()
        self._arguments = [np.zeros(function.size_in(i)[::-1]) for i in range(function.n_in())]
        self._results = [np.zeros(function.size_out(i)[::-1]) for i in range(function.n_out())]
        # CasADi's type stubs ask for a size too, and NumPy's do not know that arrays are buffers.
        for i, array in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(array))  # pyright: ignore[reportArgumentType, reportCallIssue]
        for i, array in enumerate(self._results):
            self._buffer.set_res(i, memoryview(array))  # pyright: ignore[reportArgumentType, reportCallIssue]

    def __call__(self, *arguments: np.ndarray | Sequence[float]) -> list[np.ndarray]:
        for kept, given in zip(self._arguments, arguments, strict=True):
            kept[:] = given
        self._evaluate()
        return [result.copy() for result in self._results]


# The functions of one control step. `mapaccum` calls them for one step after the other, with the first result as the first
# argument of the next.


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
    slopes, and by how much the changes lower the cost. The other results are the change of the force (2,) and K (16,).
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
    return casadi.Function("sweep_step", [ahead, x, u], [out, change, casadi.vec(feedback.T)], {"cse": True})


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
    step, least = casadi.SX.nan(2), casadi.SX.inf()
    for edge in (low, high):
        first = casadi.vertcat(edge[0], ops.clip(-(gradient[1] + b * edge[0]) / c, low[1], high[1]))
        second = casadi.vertcat(ops.clip(-(gradient[0] + b * edge[1]) / a, low[0], high[0]), edge[1])
        for tried in (first, second):
            cost = 0.5 * casadi.dot(tried, hessian @ tried) + casadi.dot(gradient, tried)
            step = casadi.if_else(cost < least, tried, step)
            least = casadi.fmin(cost, least)
    step = casadi.if_else(inside, free, step)
    moves = [casadi.logic_and(step[i] > low[i], step[i] < high[i]) for i in range(2)]
    both = casadi.logic_and(*moves)
    alone = casadi.diag(casadi.vertcat(casadi.if_else(moves[0], 1 / a, 0), casadi.if_else(moves[1], 1 / c, 0)))
    return step, casadi.if_else(both, inverse, alone)
