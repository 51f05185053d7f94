"""Proof that an episode's problem, as the environment computes it, has a strict local minimum near given forces.

The problem: forces u_0 … u_{n−1}, each component at most `force_limit`; x_{k+1} = f(x_k, u_k), RK4 with the force held;
minimize Σ ℓ(x_k, u_k)·dt subject to g_i(x_k) ≥ 0 for k = 1 … n: the task's limits, and where a goal ends the episode also
minus its goal functions at k = n. f, ℓ and g are the functions of the package, read as real functions whose constants are
the numbers of the program. The number n of steps is given: where a goal ends the episode, it is not reached earlier near the
minimum, and motions that miss it pay for at least one step more.

The proof, for a motion x, u with multipliers λ (of f) and µ (of those g that are active), all given and never trusted:

1. Unknowns are z = (δx_k, v_k, w_k, ν): states x_k + δx_k, forces u_k − K_k δx_k + v_k, multipliers λ_k + P_k δx_k + w_k
   and µ + ν. Forces at their bound have no v, and a row of K that is 0. F(z) = 0 are the conditions of Karush, Kuhn and
   Tucker with the active constraints as equations, in the combinations of `residual`.
2. K and P come from a Riccati recursion, so the Jacobian of F is nearly M: δx_{k+1} − A δx_k − B v_k, v_k + GBᵀ w_{k+1},
   w_k − Aᵀ w_{k+1} with the closed loop A, which contracts. C is an explicit approximate inverse of M, bordered by the active
   constraints. T(z) = z − C F(z).
3. If |C| (|F(0)| + |F' − M| z̄) + |I − CM| z̄ < z̄ in every component, with F' enclosed over the box |z| ≤ z̄, then T maps the
   box into itself and contracts in the norm max |z_i|/z̄_i (Krawczyk's test; Neumaier, Interval Methods for Systems of
   Equations, section 5.1). So F has exactly one zero in the box.
4. Over the box µ + ν > 0, the slope of the Hamiltonian at a bounded force points out of the bound, and all other constraints
   hold strictly. So the zero is a feasible point that obeys the conditions with strict complementarity.
5. Over the box the Hessian of the Lagrangian is positive definite on all motions of the linearized system: the blocks of a
   Riccati inequality with P − E are positive definite, which a scaled Frobenius norm below 1 shows. So the zero is a strict
   local minimum (Nocedal and Wright, Numerical Optimization, theorem 12.6).
6. On feasible motions the cost is the Lagrangian, whose expansion about (x, u) encloses the cost of the minimum.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi
import numpy as np

from ballbot_baselines.proofs.intervals import _Ball, _derivatives, _join, _variables
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task

_UP = 1 + 1e-11  # more than the rounding of sums of 10⁵ products of numbers ≥ 0
_TINY = 1e-200  # more than what C's entries below 1e-230 give together; those are left out
_ROUNDING = 32 * float(np.finfo(np.float64).eps)  # of a product of matrices, relative to that of their absolute values


_LEAST = (1e-13, 1e-11, 1e-13, 1e-13)  # of the box, m, N and so on: so that no side of it is 0
# leans, lean rates and forces: a step is linear in positions and speeds, which jets verify
_CURVED = (2, 3, 6, 7, 8, 9)


class _NotProvenError(ArithmeticError):
    """A hypothesis of the theorem could not be verified; the message names it."""


@dataclass(frozen=True)
class _Problem:
    """An episode: the task, the robot and the constants (nc,)."""

    task: Task
    robot: Robot
    c: tuple[float, ...]

    def limits(self, x: Any) -> tuple[Any, ...]:
        """What must be ≥ 0 in every state after the first, without entries that repeat another one."""
        limits = self.task.limits(x, self.c)
        return tuple(limits[i] for i in self._distinct)

    def goals(self, x: Any) -> tuple[Any, ...]:
        """What must be ≥ 0 in the last state of an episode that its goal ends."""
        return tuple(-excess for excess in self.task.goal(x, self.c)) if self.task.first_exit else ()

    @cached_property
    def _distinct(self) -> list[int]:
        """Indices of the limits whose formulas differ: unused obstacles repeat the last one."""
        x = tuple(casadi.vertsplit(casadi.SX.sym("x", 8)))
        formulas = [casadi.SX(each) for each in self.task.limits(x, self.c)]
        return [
            i
            for i, formula in enumerate(formulas)
            if not any(casadi.is_equal(formula, other, 1000) for other in formulas[:i])
        ]


@dataclass(frozen=True)
class _Point:
    """A motion with its multipliers, and which constraints are active: arrays, perhaps longdouble, or balls over a box.

    | field | shape | meaning |
    |---|---|---|
    | x, u | (n+1, 8), (n, 2) | states and forces, SI units |
    | lam, mu | (n+1, 8), (m,) | multipliers of the steps and of the active constraints |
    | fixed | (n, 2) | whether a force is at its bound |
    | rows | m pairs (k, i) | the active constraints: entry i of limits and goals, at step k |
    """

    x: Any
    u: Any
    lam: Any
    mu: Any
    fixed: np.ndarray
    rows: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class _Linear:
    """M of the theorem: a (n, 8, 8), b (n, 8, 2), g (n, 2, 2), gb ≈ g bᵀ (n, 2, 8), gains k (n, 2, 8), p (n+1, 8, 8), the
    slopes of the active constraints (m, 8), the weight of their squares, and the curvature r (n, 2, 2) of forces.
    """

    a: np.ndarray
    b: np.ndarray
    g: np.ndarray
    gb: np.ndarray
    k: np.ndarray
    p: np.ndarray
    slopes: np.ndarray
    weight: float
    r: np.ndarray


@dataclass(frozen=True)
class _Parts:
    """Values, gradients and Hessians of the step, its cost and its constraints along a motion."""

    step: tuple[_Ball, _Ball, _Ball]
    cost: tuple[_Ball, _Ball, _Ball]
    limits: tuple[_Ball, _Ball, _Ball]
    ends: int
    """Index of the first constraint that holds in the last state alone."""


@dataclass(frozen=True)
class _Minimum:
    """What was proven: within `radius` of u there is a strict local minimum, and its cost is within [low, high].

    `rounding` bounds what one step of the environment in float64 differs from the real function.
    """

    radius: np.ndarray
    low: float
    high: float
    rounding: float


def _parts_of(problem: _Problem, x: _Ball, u: _Ball, order: int) -> _Parts:
    """The functions of a problem along a motion x (n+1, 8), u (n, 2) with derivatives of order 1 or 2."""
    task, robot = problem.task, problem.robot
    dt = task.control_dt
    points = _join(lambda parts: np.concatenate(parts, 1), [x[:-1], u])
    jets = _variables(points, order, _CURVED)
    step = _derivatives(robot.step(jets[:8], jets[8:], dt, robot.substeps(dt)))
    jets = _variables(points, order)
    states, forces = jets[:8], jets[8:]
    cost = _derivatives((task.cost(states, forces, problem.c) * dt,))
    padded = x.mapped(lambda a: np.concatenate([a, np.zeros((len(a), 2), a.dtype)], 1))
    states = _variables(padded, order)[:8]
    limits, goals = problem.limits(states), problem.goals(states)
    return _Parts(step, cost, _derivatives((*limits, *goals)), len(limits))


def _times(matrices: Any, vectors: Any) -> Any:
    """Products of matrices (n, a, b) and vectors (n, b)."""
    return (matrices @ vectors[..., None])[..., 0]


def _without_specks(a: np.ndarray, k: int) -> np.ndarray:
    """With 0 in place of entries that would soon be denormal, with which processors compute slowly; in every eighth step."""
    if k % 8 == 0:
        a[np.abs(a) < 1e-230] = 0.0
    return a


def _turned(a: np.ndarray) -> np.ndarray:
    return np.swapaxes(a, -1, -2)


def _slopes(point: _Point, parts: _Parts) -> _Ball:
    """Slopes (n, 10) of the Hamiltonian with respect to states and forces."""
    return parts.cost[1][:, 0] + (point.lam[1:, None] @ parts.step[1])[:, 0]


def _gradients(point: _Point, parts: _Parts) -> tuple[_Ball, _Ball]:
    """Slopes of the Lagrangian with respect to x_k (n+1, 8), without the weight of squares, and to u_k (n, 2)."""
    slope = _slopes(point, parts)
    along_x = _join(np.concatenate, [slope[:, :8], 0.0 * parts.limits[1][-1:, 0, :8]]) - point.lam
    rows = [along_x[k] for k in range(len(point.x))]
    for (k, i), mu in zip(point.rows, point.mu, strict=True):
        rows[k] = rows[k] - parts.limits[1][k, i, :8] * mu
    return _join(np.stack, rows), slope[:, 8:]


def _residual(point: _Point, parts: _Parts, linear: _Linear) -> tuple[_Ball, _Ball, _Ball, _Ball]:
    """F(0): of the steps (n, 8), of the forces (n, 2), of the states (n+1, 8) and of the active constraints (m,)."""
    n = len(point.u)
    steps = point.x[1:] - parts.step[0]
    along_x, along_u = _gradients(point, parts)
    along_u = along_u * (~point.fixed).astype(np.float64)
    states = [-along_x[k] for k in range(n + 1)]
    active = [parts.limits[0][k, i] for k, i in point.rows]
    for (k, _), value, slope in zip(point.rows, active, linear.slopes, strict=True):
        states[k] = states[k] - value * (linear.weight * slope)
    price = _times(linear.p[1:], steps)
    forces = _times(linear.g, along_u - _times(_turned(linear.b), price))
    more = _times(_turned(linear.k), along_u) + _times(_turned(linear.a), price)
    states = _join(np.stack, states)
    states = _join(np.concatenate, [states[:n] + more, states[n:]])
    return steps, forces, states, _join(np.array, active) if active else _Ball.exact(np.zeros(0))


Box = tuple[np.ndarray, ...]
"""|δx| (n+1, 8), |v| (n, 2), |w| (n+1, 8), |ν| (m,), or bounds of the four parts of F in the order of `residual`."""


class _Inverse:
    """C of the theorem: |C|, and what it leaves of M."""

    def __init__(self, point: _Point, linear: _Linear):
        self._linear, self._rows, n = linear, point.rows, len(point.u)
        a, b, gb = linear.a, linear.b, linear.gb
        # one row for each component of F; columns are those of δx, of w or of v
        size, every = 8 * n + 8, slice(None)
        of_steps, of_forces = np.zeros((size, size)), np.zeros((2 * n, size))
        of_states = tuple(np.zeros((size, width)) for width in (size, size, 2 * n))
        block = np.zeros((8, size))
        for k in reversed(range(n)):
            now, later = slice(8 * k + 8, 8 * k + 16), slice(8 * k + 8, None)
            block[:, now] = np.eye(8)
            np.abs(block[:, later], out=of_steps[now, later])
            of_forces[2 * k : 2 * k + 2, later] = b[k].T @ block[:, later]
            block[:, later] = _without_specks(a[k].T @ block[:, later], k)
        blocks, columns = tuple(np.zeros((8, part.shape[1])) for part in of_states), {}
        for k in range(n + 1):
            now, until = slice(8 * k, 8 * k + 8), (every, slice(0, 8 * k + 8), slice(0, 2 * k))
            blocks[1][:, now] = np.eye(8)
            for whole, block, part in zip(of_states, blocks, until, strict=True):
                np.abs(block[:, part], out=whole[now, part])
            columns |= {j: linear.slopes[j] @ np.hstack(blocks) for j, row in enumerate(point.rows) if row[0] == k}
            if k < n:
                for block, part in zip(blocks, until, strict=True):
                    block[:, part] = _without_specks(a[k] @ block[:, part], k)
                blocks[0][...] -= gb[k].T @ of_forces[2 * k : 2 * k + 2]
                blocks[2][:, 2 * k : 2 * k + 2] = -gb[k].T
        self._border = np.array([columns[j] for j in range(len(columns))]).reshape(len(columns), 2 * size + 2 * n)
        schur = _Ball.exact(np.zeros((len(columns), len(columns))))
        if columns:
            at = np.array([self._border[:, 8 * k : 8 * k + 8] for k, _ in point.rows])  # (m, m, 8)
            schur = (_Ball.exact(at) @ linear.slopes[:, :, None])[..., 0]
        self.schur = np.linalg.inv(schur.m)
        self._defect = (self.schur @ schur - np.eye(len(columns))).most
        self._states, self._steps, self._forces = of_states, of_steps, np.abs(of_forces)

    def bound(self, right: Box, box: Box) -> Box:
        """|C| right + |I − CM| box."""
        (dx, v, w, nu), linear, n = box, self._linear, len(box[1])
        steps, forces, states = (part * _UP for part in right[:3])
        # C is computed column by column: each is off by the rounding of one product, as if the right-hand side were larger
        steps = steps + _ROUNDING * (_times(np.abs(linear.a), dx[:-1]) + _times(np.abs(linear.b), v))
        forces = forces + _ROUNDING * _times(np.abs(linear.gb), w[1:])
        states = states.copy()
        states[:-1] += _ROUNDING * _times(np.abs(_turned(linear.a)), w[1:])
        states[0] = 0.0  # the first state is given
        every = np.concatenate([states.ravel() @ part for part in self._states])
        every[: 8 * n + 8] += steps.ravel() @ self._steps[8:] + forces.ravel() @ self._forces
        every[16 * n + 16 :] += forces.ravel()
        every = every * _UP + _TINY
        if self._rows:
            pairs = [(k, slope) for (k, _), slope in zip(self._rows, linear.slopes, strict=True)]
            size = np.array(
                [
                    np.concatenate([np.abs(slope) @ part[8 * k : 8 * k + 8] for part in self._states])
                    for k, slope in pairs
                ]
            )
            every = every + _ROUNDING * (nu @ size)
            sums = np.array([np.abs(slope) @ every[8 * k : 8 * k + 8] for k, slope in pairs]) * _UP
            nu = (np.abs(self.schur) @ (sums + right[3]) + self._defect @ nu) * _UP + _TINY
            every = (every + nu @ np.abs(self._border)) * _UP
        x, w = (every[i : i + 8 * n + 8].reshape(n + 1, 8) for i in (0, 8 * n + 8))
        return x, every[16 * n + 16 :].reshape(n, 2), w, nu


def _prove(problem: _Problem, point: _Point, linear: _Linear) -> _Minimum:
    """Proves that there is a strict local minimum near a point.

    Raises:
        ArithmeticError: a hypothesis could not be verified; nothing is then known about the point.
    """
    fixed = point.fixed
    moves = linear.k[fixed], _turned(linear.b)[fixed], linear.g[fixed.any(1)][:, [0, 1], [1, 0]]
    limit = problem.robot.force_limit
    if any(part.any() for part in moves) or not (np.abs(point.u[fixed]) == limit).all():
        raise _NotProvenError("a force that is said to be at its bound moves")
    thin = _parts_of(problem, _Ball.exact(point.x), _Ball.exact(point.u), 1)
    at_point = tuple(part.most for part in _residual(point, thin, linear))
    inverse = _Inverse(point, linear)
    nothing = (
        np.zeros_like(linear.p[:, 0]),
        np.zeros(point.u.shape),
        np.zeros_like(linear.p[:, 0]),
        np.zeros(len(point.mu)),
    )
    # any box will do in which the test succeeds; forces at their bound do not move
    box = tuple(2 * part + least for part, least in zip(inverse.bound(at_point, nothing), _LEAST, strict=True))
    box[0][0], box[1][point.fixed] = 0.0, 0.0
    forces = (_times(np.abs(linear.k), box[0][:-1]) + box[1]) * _UP * ~point.fixed
    x, u = _Ball.around(point.x, box[0]), _Ball.around(point.u, forces)
    parts = _parts_of(problem, x, u, 2)
    multipliers = _Ball.around(point.lam, (_times(np.abs(linear.p), box[0]) + box[2]) * _UP)
    inside = _Point(x, u, multipliers, _Ball.around(point.mu, box[3]), point.fixed, point.rows)
    curvature = _Curvature(inside, parts, linear)
    variation = curvature.variation(box)
    right = tuple(a + b * _UP for a, b in zip(at_point, variation, strict=True))
    image = inverse.bound(right, box)
    free = ~point.fixed
    unknown = ((part[0][1:], part[1][free], part[2][1:], part[3]) for part in (image, box))
    for new, old in zip(*unknown, strict=True):
        if not (new < old).all():
            raise _NotProvenError(f"the contraction: a component is {np.max(new / old):.3g} of what the test allows")
    _check_constraints(problem, inside, parts)
    curvature.check_definite()
    low, high = _cost(point, thin, curvature, box, forces)
    return _Minimum(
        (_times(np.abs(linear.k), image[0][:-1]) + image[1]) * _UP * free, low, high, _rounding(problem, point)
    )


class _Curvature:
    """Second derivatives of the Lagrangian over a box."""

    def __init__(self, inside: _Point, parts: _Parts, linear: _Linear):
        self.inside, self.parts, self.linear, n = inside, parts, linear, len(inside.fixed)
        free = np.concatenate([np.ones((n, 8)), ~inside.fixed], 1)
        bend = parts.step[2].mapped(lambda a: a.reshape(n, 8, -1))
        bend = (inside.lam[1:, None] @ bend)[:, 0].mapped(lambda a: a.reshape(n, 10, 10))
        hessian = (parts.cost[2][:, 0] + bend) * (free[:, None] * free[:, :, None])
        hessian = hessian + np.array([np.diag(row) for row in 1.0 - free])
        states = [hessian[k, :8, :8] for k in range(n)] + [_Ball.exact(np.zeros((8, 8)))]
        self.slopes = [parts.limits[1][k, i, :8] for k, i in inside.rows]
        for j, (k, i) in enumerate(inside.rows):
            square = _Ball.exact(linear.slopes[j][:, None]) * self.slopes[j][None] * linear.weight
            states[k] = states[k] + square - parts.limits[2][k, i, :8, :8] * inside.mu[j]
        self.last, self.along_x = states[n], _join(np.stack, states[:n])
        self.mixed, self.along_u = hessian[:, 8:, :8], hessian[:, 8:, 8:]
        slope = parts.step[1] * free[:, None]
        a, b, k, before, after = slope[:, :, :8], slope[:, :, 8:], linear.k, linear.p[:-1], _Ball.exact(linear.p[1:])
        self.closed, self.b = a - b @ k, b
        # second variation in δx and v, with P: nearly 0, 0 and r
        forced = self.mixed - self.along_u @ k
        self.xx = self.along_x - self.mixed.T @ k - _turned(k) @ forced
        self.vx = forced
        pa, pb = (after @ linear.a).T, (after @ linear.b).T
        self.ex = self.xx + pa @ self.closed - before
        self.ev_x = forced + pb @ self.closed
        self.ev_v = self.along_u + pb @ b
        self.ex_v = forced.T + pa @ b

    def variation(self, box: Box) -> Box:
        """|F' − M| box over the box."""
        (dx, v, w, nu), linear = box, self.linear
        a, b, after = self.closed - linear.a, self.b - linear.b, linear.p[1:]
        steps = _times(a.most, dx[:-1]) + _times(b.most, v)
        g = _Ball.exact(linear.g)
        forces = _times((g @ self.ev_x).most, dx[:-1]) + _times((g @ self.ev_v - np.eye(2)).most, v)
        forces += _times((g @ (b.T @ after)).most, dx[1:]) + _times((g @ self.b.T - linear.gb).most, w[1:])
        states = np.zeros_like(dx)
        states[:-1] = _times(self.ex.most, dx[:-1]) + _times(self.ex_v.most, v)
        states[:-1] += _times((a.T @ after).most, dx[1:]) + _times(a.T.most, w[1:])
        states[-1] = (self.last - linear.p[-1]).most @ dx[-1]
        active = np.zeros(len(nu))
        for j, (k, _) in enumerate(self.inside.rows):
            off = (self.slopes[j] - linear.slopes[j]).most
            states[k] += off * nu[j]
            active[j] = off @ dx[k]
        return steps * _UP, forces * _UP, states * _UP, active * _UP

    def check_definite(self) -> None:
        """Raises an error unless the second variation is positive definite over the box."""
        linear, n = self.linear, len(self.inside.fixed)
        after = _Ball.exact(linear.p[1:])
        off = _join(
            np.concatenate,
            [self.xx + self.closed.T @ (after @ self.closed) - linear.p[:-1], (self.last - linear.p[-1])[None]],
        )
        diagonal = np.sqrt(np.abs(linear.p).max(0).diagonal())
        size = np.sqrt(np.square(off.most / np.outer(diagonal, diagonal)).sum((1, 2)))
        room = 4 * (size[:, None] + size.max() * 1e-3) * diagonal**2  # what P is lowered by in each step
        lowered, turn = linear.p.copy(), np.zeros((n, 2, 8))
        lowered[n] -= np.diag(room[n])
        for k in reversed(range(n)):
            a, b, later = self.closed.m[k], self.b.m[k], lowered[k + 1]
            vx, vv = self.vx.m[k] + b.T @ later @ a, self.along_u.m[k] + b.T @ later @ b
            turn[k] = np.linalg.solve(vv, vx)  # with lower P the best gains differ a little from K
            total = self.xx.m[k] + a.T @ later @ a - vx.T @ turn[k]
            lowered[k] = 0.5 * (total + total.T) - np.diag(room[k])
        scale = 1 / np.sqrt(room)
        root = _Ball.exact(np.linalg.inv(np.linalg.cholesky(linear.r)))
        after, turn = _Ball.exact(lowered[1:]), _Ball.exact(turn)
        xx = self.xx + self.closed.T @ (after @ self.closed) - lowered[:-1]
        vx, vv = self.vx + self.b.T @ (after @ self.closed), self.along_u + self.b.T @ (after @ self.b)
        left = vx - vv @ turn
        xx = xx - vx.T @ turn - turn.T @ left
        vx, vv = root @ left, root @ vv @ _turned(root.m)
        sizes = ((xx * (scale[:-1, :, None] * scale[:-1, None])) - np.eye(8)).most, (vx * scale[:-1, None]).most
        squares = np.square(sizes[0]).sum((1, 2)) + 2 * np.square(sizes[1]).sum((1, 2))
        squares = (squares + np.square((vv - np.eye(2)).most).sum((1, 2))) * _UP
        last = ((self.last - lowered[-1]) * (scale[-1][:, None] * scale[-1]) - np.eye(8)).most
        if not (squares < 1).all() or not np.square(last).sum() * _UP < 1:
            raise _NotProvenError(f"the second variation: {np.sqrt(squares.max()):.3g} is not below 1")


def _check_constraints(problem: _Problem, inside: _Point, parts: _Parts) -> None:
    """Raises an error unless active constraints press and all others hold strictly over the box."""
    limit, fixed = problem.robot.force_limit, inside.fixed
    multipliers, forces = inside.mu.least, inside.u.most
    if not (multipliers > 0).all():
        raise _NotProvenError(f"strict complementarity: a multiplier may be {multipliers.min():.3g}")
    if not (forces[~fixed] < limit).all():
        raise _NotProvenError("a free force may exceed its bound")
    inwards = (-_slopes(inside, parts)[:, 8:] * np.sign(inside.u.m)).least[fixed]
    if not (inwards > 0).all():
        raise _NotProvenError(f"strict complementarity: the multiplier of a force may be {inwards.min():.3g}")
    n, values, limits = len(fixed), parts.limits[0], parts.ends
    holds = values.least > 0
    for k, i in inside.rows:
        holds[k, i] = True
    if not holds[1:, :limits].all() or not holds[n].all():
        raise _NotProvenError("a constraint that is not active may be violated")
    if values.m.shape[1] > limits and not ((-values).least[1:n, limits:] > 0).any(1).all():
        raise _NotProvenError("the goal may be reached earlier")


def _cost(point: _Point, thin: _Parts, curvature: _Curvature, box: Box, forces: np.ndarray) -> tuple[float, float]:
    """Bounds of the cost of the minimum: the Lagrangian's value, slopes and curvature times the box."""
    value = thin.cost[0][:, 0] + (point.lam[1:] * (thin.step[0] - point.x[1:])) @ np.ones(8)
    total: Any = sum((value[k] for k in range(1, len(value.m))), value[0])
    for (k, i), mu in zip(point.rows, point.mu, strict=True):
        total = total - thin.limits[0][k, i] * mu
    along_x, along_u = _gradients(point, thin)
    dx = box[0]
    bend = np.zeros((len(dx), 8, 8))
    bend[:-1], bend[-1] = curvature.along_x.most, curvature.last.most
    for (k, _), slope, own in zip(point.rows, curvature.slopes, curvature.linear.slopes, strict=True):
        bend[k] += (
            curvature.linear.weight * np.abs(own)[:, None] * slope.most
        )  # which is in along_x, and not in the Lagrangian
    off = (along_x.most * dx)[1:].sum() + (along_u.most * forces).sum() + 0.5 * (dx * _times(bend, dx)).sum()
    off += (forces * _times(curvature.mixed.most, dx[:-1])).sum() + 0.5 * (
        forces * _times(curvature.along_u.most, forces)
    ).sum()
    middle = float(total.m)
    spread = float(off * _UP + (total - middle).most)
    return float(np.nextafter(middle - spread, -np.inf)), float(np.nextafter(middle + spread, np.inf))


def _rounding(problem: _Problem, point: _Point) -> float:
    """Bound of what a step of the environment in float64 differs from the real function in states of the motion."""
    robot, dt = problem.robot, problem.task.control_dt
    x, u = point.x.astype(np.float64), point.u.astype(np.float64)
    real = _parts_of(problem, _Ball.exact(x), _Ball.exact(u), 1).step[0]
    return float((real - robot.step(x[:-1], u, dt, robot.substeps(dt))).most.max())
