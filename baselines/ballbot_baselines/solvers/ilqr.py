"""Local optima of thousands of episodes of any task, by iLQR in compiled code (`ilqr.c`), a SIMD lane for each episode.

The problem is that of `shooting.py`. A guess that is no motion is first bent toward one by a few Newton steps on the
dynamics. Then each iteration sweeps backwards with the box-constrained Riccati recursion of Tassa et al., "Control-limited
differential dynamic programming" (2014), and simulates the new feedback, with a shorter step where that raises the cost.

The other inequalities g ≥ 0 are the task's margins, its goal and the robot's friction. Each costs m·w·f(g/w) with a
multiplier m, a width w that shrinks, and the logarithm f(t) = −log(1 + t), continued as a parabola below t = −½ (Ben-Tal
and Zibulevsky, "Penalty/barrier multiplier methods for convex programming problems", 1997). So constraints that are not
violated yet are felt too, and steps can stay long.

If a task ends at rest, LQR's cost-to-go can replace the last part of an episode.
"""

import ctypes
import functools
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import casadi
import numpy as np

from ballbot_baselines.solvers import righting
from ballbot_baselines.solvers.compiled import LANES, SIMD
from ballbot_baselines.solvers.formulas import check_formulas
from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_baselines.solvers.shooting import ocp_of
from ballbot_gym import machine_code, ops
from ballbot_gym.machine_code import codegen
from ballbot_gym.robot import Kind, Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task

MARGIN = 2e-5
"""By how much constraints are kept, so that they hold where a solution misses one by `Options.violation`."""

_SUBSTEPS = 1  # of RK4 where a control step is linearized; it is then wrong by a millionth
_LEAST_CURVATURE = 1e-9  # of the cost along an action, so that steps of no length have a best one
_REST = 8 + 36 + 1  # parameters of LQR's cost-to-go: a state, the upper triangle of P, and its share
_OVER = 3.0  # curvature that keeps the actions of a bent guess near their limits


class Options(NamedTuple):
    """Of the solver, in ilqr.c's order, the multiplier last."""

    width: float = 0.2
    """Of the constraints' prices, at first, in the unit of the constraints."""
    tolerance: float = 1e-5
    """Relative: the last iteration promises to lower the cost by less."""
    violation: float = MARGIN
    """By which a constraint is missed at most, besides what the caller keeps of it."""
    bends: float = 3
    """Newton steps on the dynamics, for guesses that are no motions; 0 for those that are."""
    multiplier: float = 0.1
    """Of every constraint, at first."""


@dataclass(frozen=True)
class Motions:
    """J motions of at most n steps, and what is known of them. Those with fewer steps have no meaning at the end.

    | field | shape | meaning |
    |---|---|---|
    | of | (J,) | episodes that they are motions of |
    | steps | (J,) | n at most |
    | x | (J, n+1, ns) | states; ns is 9 with the length of a step, s, where that is free |
    | a | (J, n, 2) | actions |
    | gains | (J, n, 2, ns) | K of the feedback a − K (x' − x) |
    | slopes | (J, n, ns) | of the remaining cost with respect to each state but the last |
    | costs | (J,) | |
    | solved | (J,) bool | the tolerances are met |
    | multipliers | (J, n, np) | of the constraints of each step |
    | end_multipliers | (J, ne) | of those of the last state |
    """

    of: np.ndarray
    steps: np.ndarray
    x: np.ndarray
    a: np.ndarray
    gains: np.ndarray
    slopes: np.ndarray
    costs: np.ndarray
    solved: np.ndarray
    multipliers: np.ndarray
    end_multipliers: np.ndarray

    @classmethod
    def guessed(cls, of: np.ndarray, steps: np.ndarray, x: np.ndarray, a: np.ndarray) -> "Motions":
        """Guesses, without costs or multipliers yet."""
        none = np.zeros((len(of), 0))
        return cls(of, steps, x, a, none, none, np.full(len(of), np.inf), np.zeros(len(of), bool), none, none)

    def some(self, rows: np.ndarray | slice) -> "Motions":
        """Those in some rows: copies, or views for a slice."""
        return Motions(*(getattr(self, field.name)[rows] for field in fields(self)))

    def put(self, rows: np.ndarray, others: "Motions", which: np.ndarray) -> None:
        """Replaces the rows `rows[which]` by the motions `which` of others."""
        for field in fields(self):
            getattr(self, field.name)[rows[which]] = getattr(others, field.name)[which]


@dataclass(frozen=True)
class _Rest:
    """LQR where a task ends at rest: its gain (2, 8), and P (8, 8) of its cost-to-go xᵀPx of states x relative to the end."""

    gain: np.ndarray
    p: np.ndarray

    def slopes(self, off: np.ndarray) -> np.ndarray:
        """(..., 8) of the cost-to-go, of states (..., 8) relative to the end."""
        # BLAS would add in an order that depends on the number of states
        return sum((2 * off[..., i, None] * row for i, row in enumerate(self.p)), np.zeros(8))

    def costs(self, off: np.ndarray) -> np.ndarray:
        """(...) costs-to-go of states (..., 8) relative to the end."""
        return 0.5 * (self.slopes(off) * off).sum(axis=-1)


def _rest(task: Task, params: Robot) -> _Rest | None:
    """LQR where the task ends, if that is at rest, and the same relative to the end of every episode."""
    if task.first_exit:
        return None
    found: list[_Rest] = []
    for x0, c in (task.sample(np.random.default_rng(seed), params) for seed in range(2 if task.constant_names else 1)):
        end = task.reference(x0, c, params)
        if not end.is_point or not LinearQuadratic(task, params, end.x, end.u, c).starts_at_rest:
            return None
        try:
            found.append(_Rest(*discrete_lqr(task, params, end.x[0], end.u[0], c)))
        except PlanError:
            return None
    return found[0] if np.allclose(found[0].p, found[-1].p, rtol=1e-9) else None


class _Ilqr:
    """The solver of a task and a robot. `rest` says where the task ends at rest.

    With `free_time`, the length of the steps is free, within the last two parameters of each problem.

    Raises:
        machine_code.NoMachineCodeError: it cannot be compiled here.
        NotImplementedError: the task has an operation that `codegen` does not support, or a clock; or the
            robot has no `BATCHED_OPTIMA`.
    """

    def __init__(self, task: Task, params: Robot, free_time: bool = False):
        if task.clock:
            raise NotImplementedError(
                f"{task.id} has a clock, which batches of optima do not support; use find_optimum"
            )
        if not params.BATCHED_OPTIMA:
            raise NotImplementedError(
                f"the search of many optima at once does not support {type(params).__name__}, see Robot.BATCHED_OPTIMA; "
                "find_optimum solves its episodes one by one"
            )
        check_formulas(task, params)
        self._limit, self.rest = params.force_limit, None if free_time else _rest(task, params)
        library, self._sizes = _compiled(task, params.kind, free_time, self.rest is not None)
        self.states = self._sizes["STATES"]
        self._solve, self._follow = library.solve, library.follow
        of_all = [ctypes.c_int64, ctypes.c_int64, ctypes.c_double]
        self._solve.argtypes, self._solve.restype = [*of_all, *[ctypes.c_void_p] * 11], None
        self._follow.argtypes, self._follow.restype = [*of_all, *[ctypes.c_void_p] * 8], None

    def solve(
        self,
        guesses: Motions,
        length: float,
        given: np.ndarray,
        options: Sequence[Options],
        multipliers: np.ndarray | None = None,
        end_multipliers: np.ndarray | None = None,
    ) -> Motions:
        """Solves J problems.

        Args:
            guesses: of the solutions.
            length: of a step, s; 1 where it is free.
            given: (J, np) parameters: p of `ocp_of` but the first, the largest action, and the bounds of a free length, s, or
                else, for tasks with a `rest`, a state (8,), P's upper triangle (36,), and the share of LQR's cost-to-go that
                counts.
            options: of the solver, for each problem.
            multipliers, end_multipliers: (J, n, path constraints) and (J, constraints of the end) at first, of a solution of
                nearly the same problem; default, the option.
        """
        jobs, n = guesses.a.shape[:2]
        x, a = np.array(guesses.x, np.float64, order="C"), np.array(guesses.a, np.float64, order="C")
        steps, given = np.array(guesses.steps, np.int64), np.ascontiguousarray(given)
        settings = np.array(options, np.float64)
        m, e = np.zeros((jobs, n, self._sizes["PATH"])), np.zeros((jobs, self._sizes["END"]))
        m[:] = settings[:, -1:, None] if multipliers is None else multipliers
        e[:] = settings[:, -1:] if end_multipliers is None else end_multipliers
        gains, slopes = np.zeros((jobs, n, 2, self.states)), np.zeros((jobs, n, self.states))
        costs, solved = np.zeros(jobs), np.zeros(jobs, np.int64)
        arrays = (settings, steps, given, x, a, m, e, gains, slopes, costs, solved)
        self._solve(jobs, n, length, *(array.ctypes.data for array in arrays))
        return Motions(guesses.of, steps, x, a, gains, slopes, costs, solved == 1, m, e)

    def simulate(
        self,
        x0: np.ndarray,
        steps: int,
        length: float,
        given: np.ndarray,
        paths: np.ndarray | None = None,
        settings: tuple[float, float] = (0.0, 0.0),
        ends: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulates J episodes under `righting.steering`, or under LQR at the end.

        Args:
            x0: (J, 8) initial states.
            steps: n.
            length: of a step, s.
            given: same as in `solve`.
            paths: (J, n, 4) where to steer the ball, m, and leans that are added, rad.
            settings: of this feedback, its bandwidth, rad/s, and its time constant, s.
            ends: (J, 8) states about which LQR acts.

        Returns:
            States (J, n+1, 8), actions (J, n, 2), and costs (J,), which are infinite where a margin is violated.
        """
        jobs = len(x0)
        x, a, costs, missed = (np.zeros((jobs, *shape)) for shape in ((steps + 1, self.states), (steps, 2), (), ()))
        x[:, 0], feedback = x0, None
        if ends is not None:
            assert self.rest is not None
            feedback = np.column_stack([np.tile(self.rest.gain.ravel() / self._limit, (jobs, 1)), ends])
        arrays = given, paths, np.array(settings), feedback, x, a, costs, missed
        kept = [None if array is None else np.ascontiguousarray(array) for array in arrays]
        self._follow(jobs, steps, length, *(None if array is None else array.ctypes.data for array in kept))
        return x, a, np.where((missed <= 0) & np.isfinite(costs), costs, np.inf)


ilqr = functools.lru_cache(maxsize=8)(_Ilqr)
"""The solver, made once."""


@functools.cache
def _compiled(task: Task, kind: Kind, free_time: bool, rests: bool) -> tuple[ctypes.CDLL, dict[str, int]]:
    """The functions of ilqr.c for a task and a kind of robot, and the sizes that they were made for."""
    code = _Code(task, kind, free_time, rests)
    # no name of a task, so that tasks with the same code share its library
    name = "ilqr-free" if free_time else "ilqr"
    return ctypes.CDLL(str(machine_code.library(name, code.source(), SIMD))), code.sizes


class _Code:
    """The functions of ilqr.c: what a control step of one episode computes, as C that computes it for `LANES`."""

    def __init__(self, task: Task, kind: Kind, free_time: bool, rests: bool):
        self._ocp = ocp_of(task, kind, free_time)
        self._substeps = kind.robot.substeps(task.control_dt)
        self._free, self.ns, self._rests = free_time, 9 if free_time else 8, rests
        symbol = casadi.SX.sym
        self._x, self._a, self._dt = symbol("x", self.ns), symbol("a", 2), symbol("dt")
        self._p = symbol("p", self._ocp.params + 2 * free_time + _REST * rests)
        self._all = casadi.vertcat(self._x[8] if free_time else self._dt, self._p[: self._ocp.params - 1])
        self._robot: Any = kind.model(self._all[1 : 1 + len(kind.numbers)])
        self._limit, self._largest = self._robot.force_limit, self._p[self._ocp.params - 1]
        self._width, self._share, self._gain = symbol("width"), symbol("share"), symbol("gain", 2 * self.ns)
        self._following, self._step = symbol("following", self.ns), symbol("step", 2)
        path, end = (
            self._ocp.inequalities(self._x, self._a, self._all),
            self._ocp.final_inequalities(self._x, self._all),
        )
        self._multipliers, self._end_multipliers = symbol("m", path.shape[0]), symbol("e", end.shape[0])
        self._upper = [(i, j) for i in range(self.ns) for j in range(i, self.ns)]
        self.sizes = {
            "DOUBLE": 1,
            "LANES": LANES,
            "STATES": self.ns,
            "PATH": path.shape[0],
            "END": end.shape[0],
            "PARAMS": self._p.shape[0],
        }

    def source(self) -> str:
        """The whole C code."""
        defined = [f"#define {name} {value}" for name, value in self.sizes.items()]
        own = codegen.text("ilqr.c", __file__)
        blocks = [self._sweep(), self._end(), self._hold(), self._bend(), self._steer()]
        return "\n".join([*defined, codegen.text("real.h"), *blocks, own])

    def _after(self, x: casadi.SX, a: casadi.SX, substeps: int) -> casadi.SX:
        return casadi.vertcat(self._robot.step(x[:8], self._limit * a, self._all[0], substeps), x[8:])

    def _sweep(self) -> str:
        """One control step of the Riccati recursion.

        What is ahead, and comes out for the step before: second derivatives of the cost-to-go in the order of `_upper`, its
        slopes, and by how much the changes lower the cost. `open` says that x need not be a motion.
        """
        x, a, ns = self._x, self._a, self.ns
        z, squares = casadi.vertcat(x, a), len(self._upper)
        ahead = casadi.SX.sym("ahead", squares + ns + 1)
        damping, open_ = casadi.SX.sym("damping"), casadi.SX.sym("open")
        reached, cost, limits = (
            self._after(x, a, _SUBSTEPS),
            self._ocp.cost(x, a, self._all),
            self._ocp.inequalities(x, a, self._all),
        )
        linear, of_limits = casadi.jacobian(reached, z), casadi.jacobian(limits, z)
        push, stiffness = _price_slopes(limits, self._multipliers, self._width)
        value = casadi.SX(ns, ns)
        for k, (i, j) in enumerate(self._upper):
            value[i, j] = value[j, i] = ahead[k]
        slope_ahead = ahead[squares : squares + ns] + value @ (open_ * (reached - self._following))
        of_cost, slope = casadi.hessian(cost, z)
        if self._free:  # how the cost of a step bends with its length would make the recursion indefinite
            of_cost[8, :], of_cost[:, 8] = 0, 0
        # `push` is 0 in steps of no length, because their multipliers are
        slope = slope + linear.T @ slope_ahead - of_limits.T @ push
        hessian = of_cost + linear.T @ value @ linear + of_limits.T @ casadi.diag(stiffness) @ of_limits
        over = casadi.vertcat(*(a[i] - self._clipped(a[i]) for i in range(2)))
        of_action = hessian[ns:, ns:] + casadi.diag(_LEAST_CURVATURE + damping + _OVER * (over != 0))
        of_change, mixed = slope[ns:] + _OVER * over, hessian[ns:, :ns]
        bound = self._largest + 1e9 * open_
        change, inverse = _box_step(of_action, of_change, -bound - a, bound - a)
        feedback = inverse @ mixed
        moved = of_action @ change + of_change
        before = hessian[:ns, :ns] - mixed.T @ feedback
        promised = ahead[squares + ns] - 0.5 * casadi.dot(change, moved + of_change)
        slope_before = slope[:ns] + mixed.T @ change - feedback.T @ moved
        out = casadi.vertcat(*(before[i, j] for i, j in self._upper), slope_before, promised)
        return _block(
            "sweep",
            (ahead, x, a, self._dt, self._multipliers, self._p, self._width, damping, self._following, open_),
            (out, change, casadi.vec(feedback.T), slope_before),
        )

    def _end(self) -> str:
        """The cost of the last state, with what is ahead of the last step, and its constraints."""
        x, p = self._x, self._all
        limits, cost = self._ocp.final_inequalities(x, p), self._ocp.final_cost(x, p)
        if self._rests:
            end, squares, share = casadi.vertsplit(self._p[-_REST:], [0, 8, _REST - 1, _REST])
            upper = casadi.SX(casadi.Sparsity.upper(8).T, squares).T
            cost += share * casadi.bilin(casadi.triu2symm(upper), x - end, x - end)
        push, stiffness = _price_slopes(limits, self._end_multipliers, self._width)
        of_limits, held = casadi.jacobian(limits, x), casadi.SX.sym("held", push.shape[0])
        # How the goal bends counts: its functions are squares, which have no slope in its middle.
        curved = casadi.substitute(casadi.hessian(casadi.dot(held, limits), x)[0], held, push)
        hessian = casadi.hessian(cost, x)[0] - curved + of_limits.T @ casadi.diag(stiffness) @ of_limits
        slope = casadi.gradient(cost, x) - of_limits.T @ push
        ahead = casadi.vertcat(*(hessian[i, j] for i, j in self._upper), slope, 0)
        return _block("end", (x, self._end_multipliers, self._p, self._width), (ahead, cost, limits))

    def _hold(self) -> str:
        """The feedback's action held for a control step: the next state, action, cost, constraints and their price."""
        about = casadi.SX.sym("about", self.ns)
        wanted = self._a + self._share * self._step - self._feedback(self._x - about)
        taken = casadi.vertcat(*(self._clipped(wanted[i]) for i in range(2)))
        limits, cost = self._ocp.inequalities(self._x, taken, self._all), self._ocp.cost(self._x, taken, self._all)
        price = casadi.sum1(_price(limits, self._multipliers, self._width))
        return _block(
            "hold",
            (
                self._x,
                self._a,
                self._step,
                self._share,
                self._gain,
                about,
                self._dt,
                self._p,
                self._multipliers,
                self._width,
            ),
            (self._after(self._x, taken, self._substeps), taken, cost, limits, price),
        )

    def _bend(self) -> str:
        """The same to first order, from a guess that is no motion: how the next state moves, and the action."""
        moved, x, a = casadi.SX.sym("moved", self.ns), self._x, self._a
        bent = a + self._share * self._step - self._feedback(moved)
        reached = self._after(x, a, _SUBSTEPS)
        change = casadi.jtimes(reached, casadi.vertcat(x, a), casadi.vertcat(moved, bent - a))
        return _block(
            "bend",
            (x, moved, self._following, a, self._step, self._share, self._gain, self._dt, self._p),
            (change + reached - self._following, bent),
        )

    def _steer(self) -> str:
        """The action of `righting.steering`."""
        path, settings = casadi.SX.sym("path", 4), casadi.SX.sym("settings", 2)
        target, aside = (tuple(casadi.vertsplit(part)) for part in (path[:2], path[2:]))
        limit, x = self._limit, tuple(casadi.vertsplit(self._x[:8]))
        force = righting.steering(self._robot, x, aside, settings[0], settings[1], target, limit)
        return _block("steer", (self._x, path, settings, self._p), (casadi.vertcat(*force) / limit,))

    def _clipped(self, a: casadi.SX) -> casadi.SX:
        return ops.clip(a, -self._largest, self._largest)

    def _feedback(self, off: casadi.SX) -> casadi.SX:
        return casadi.reshape(self._gain, self.ns, 2).T @ off


def _block(name: str, inputs: Sequence[casadi.SX], outputs: Sequence[casadi.SX]) -> str:
    parts = [
        [casadi.vertsplit(casadi.densify(casadi.SX(v))) if v.numel() else [] for v in vs] for vs in (inputs, outputs)
    ]
    return codegen.block(
        name, *([(f"{kind}{i}", part) for i, part in enumerate(some)] for kind, some in zip("io", parts, strict=True))
    )


def _price(limits: casadi.SX, multipliers: casadi.SX, width: casadi.SX) -> casadi.SX:
    ratio = limits / width
    below = casadi.fmin(ratio + 0.5, 0)
    return multipliers * width * (2 * below * below - 2 * below - casadi.log(1 + (ratio - below)))


def _price_slopes(limits: casadi.SX, multipliers: casadi.SX, width: casadi.SX) -> tuple[casadi.SX, casadi.SX]:
    """By how much the price falls, and how it bends, per constraint."""
    ratio = limits / width
    below = casadi.fmin(ratio + 0.5, 0)
    inside = 1 / (1 + (ratio - below))
    return multipliers * (inside - 4 * below), multipliers / width * inside * inside


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
