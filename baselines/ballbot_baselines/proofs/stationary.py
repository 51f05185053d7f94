"""Points for `local_minimum.prove`: Newton's method on the conditions of Karush, Kuhn and Tucker. Nothing here is trusted."""

from dataclasses import replace

import numpy as np

from ballbot_baselines.proofs.intervals import _Ball
from ballbot_baselines.proofs.local_minimum import (
    _Linear,
    _NotProvenError,
    _Parts,
    _parts_of,
    _Point,
    _Problem,
    _residual,
)

# a force this share of its limit from it counts as active, and a constraint whose value is below this
_ACTIVE_FORCE, _ACTIVE = 1e-6, 1e-5
_CLOSE = 1e-3  # share of the force limit: of steps after which the active set is corrected
_CONVERGED = 1e-10  # the same, of steps after which Newton's method has converged
_MOST_STEPS = 12
_WEIGHTS = (0.0, 10.0, 100.0, 1e3, 1e4)  # of squared active constraints, tried until the curvature is positive
_MORE = 5.0  # times the least of these: near the least possible weight the model is nearly singular


def _stationary(problem: _Problem, x: np.ndarray, u: np.ndarray) -> tuple[_Point, _Linear]:
    """The stationary point near a motion x (n+1, 8), u (n, 2), in longdouble, with the linear model about it.

    Raises:
        ArithmeticError: Newton's method does not converge, or not to a minimum.
    """
    limit = problem.robot.force_limit
    fixed = np.abs(u) > limit * (1 - _ACTIVE_FORCE)
    point = _Point(x, np.where(fixed, np.sign(u) * limit, u), np.zeros_like(x), np.zeros(0), fixed, ())
    parts = _parts_of(problem, _Ball(point.x), _Ball(point.u), 2)
    rows = _violated(point, parts, _ACTIVE)
    point = replace(point, rows=rows, mu=np.zeros(len(rows)))
    point = _with_multipliers(point, parts)
    for _ in range(_MOST_STEPS):
        linear = _linear(point, parts)
        moved = _newton(point, parts, linear)
        size = np.abs(moved.u - point.u).max() / limit
        point = _with_active_set(moved, parts, limit) if size < _CLOSE else moved
        same = point.rows == moved.rows and (point.fixed == moved.fixed).all()
        if same and size < _CONVERGED:
            return _refined(problem, point, linear), linear
        parts = _parts_of(problem, _Ball(point.x), _Ball(point.u), 2)
    raise _NotProvenError(f"Newton's method did not converge: its last step is {size:.2g} of the force limit")


def _violated(point: _Point, parts: _Parts, below: float) -> tuple[tuple[int, int], ...]:
    """Constraints whose values are below a number."""
    return tuple(
        (int(k), int(i))
        for k, i in np.argwhere(parts.limits[0].m < below)
        if k > 0 and (k == len(point.u) or i < parts.ends)
    )


def _with_active_set(moved: _Point, parts: _Parts, limit: float) -> _Point:
    """A point whose forces at their bounds and active constraints have multipliers of the right sign."""
    slope = parts.cost[1].m[:, 0] + (moved.lam[1:, None] @ parts.step[1].m)[:, 0]
    over = ~moved.fixed & (np.abs(moved.u) > limit)
    fixed = (moved.fixed & (slope[:, 8:] * np.sign(moved.u) <= 0)) | over
    rows = [(row, mu) for row, mu in zip(moved.rows, moved.mu, strict=True) if mu > 0]
    kept = {row for row, _ in rows}
    rows += [(row, 0.0) for row in _violated(moved, parts, -1e-10) if row not in kept and row not in moved.rows]
    u = np.where(over, np.sign(moved.u) * limit, moved.u)
    return replace(moved, u=u, fixed=fixed, rows=tuple(row for row, _ in rows), mu=np.array([mu for _, mu in rows]))


def _linear(point: _Point, parts: _Parts) -> _Linear:
    """The linear model, with a weight well above the least one for which a Riccati recursion finds a minimum."""
    for weight in _WEIGHTS:
        found = _riccati(point, parts, weight)
        if found is not None:
            return found if weight == 0 else _riccati(point, parts, _MORE * weight) or found
    raise _NotProvenError("the second variation is not positive: this is no minimum")


def _riccati(point: _Point, parts: _Parts, weight: float, lagrangian: bool = True) -> _Linear | None:
    """The Riccati recursion of the Lagrangian's second-order model, or of the cost's alone; None without a minimum."""
    n, free = len(point.u), np.concatenate([np.ones((len(point.u), 8)), ~point.fixed], 1)
    lam = point.lam.astype(np.float64) * lagrangian
    slope = parts.step[1].m * free[:, None]
    hessian = parts.cost[2].m[:, 0] + np.einsum("ki,kiab->kab", lam[1:], parts.step[2].m)
    hessian = hessian * free[:, None] * free[:, :, None] + np.array([np.diag(row) for row in 1 - free])
    p = np.zeros((n + 1, 8, 8))
    slopes = np.array([parts.limits[1].m[k, i, :8] for k, i in point.rows]).reshape(-1, 8)
    for j, (k, i) in enumerate(point.rows):
        bend = weight * np.outer(slopes[j], slopes[j]) - lagrangian * point.mu[j] * parts.limits[2].m[k, i, :8, :8]
        if k < n:
            hessian[k, :8, :8] += bend
        else:
            p[n] += bend
    k, r, g = np.zeros((n, 2, 8)), np.zeros((n, 2, 2)), np.zeros((n, 2, 2))
    for i in reversed(range(n)):
        total = hessian[i] + slope[i].T @ p[i + 1] @ slope[i]
        total = 0.5 * (total + total.T)
        r[i] = total[8:, 8:]
        if not np.linalg.eigvalsh(r[i])[0] > 0:
            return None
        g[i] = np.linalg.inv(r[i])
        k[i] = g[i] @ total[8:, :8]
        p[i] = total[:8, :8] - total[:8, 8:] @ k[i]
        p[i] = 0.5 * (p[i] + p[i].T)
    b = slope[:, :, 8:]
    return _Linear(slope[:, :, :8] - b @ k, b, g, g @ np.swapaxes(b, 1, 2), k, p, slopes, weight, r)


def _solved(linear: _Linear, steps: np.ndarray, forces: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, ...]:
    """M⁻¹ of right-hand sides (n, 8, q), (n, 2, q), (n+1, 8, q)."""
    w, v, dx = states.copy(), forces.copy(), np.zeros_like(states)
    for k in reversed(range(len(steps))):
        w[k] += linear.a[k].T @ w[k + 1]
        v[k] -= linear.gb[k] @ w[k + 1]
    for k in range(len(steps)):
        dx[k + 1] = linear.a[k] @ dx[k] + linear.b[k] @ v[k] + steps[k]
    return dx, v, w


def _newton(point: _Point, parts: _Parts, linear: _Linear) -> _Point:
    """The point after one step of Newton's method."""
    steps, forces, states, active = (part.m.astype(np.float64) for part in _residual(point, parts, linear))
    dx, v, w = _solved(linear, -steps[..., None], -forces[..., None], -states[..., None])
    nu = np.zeros(0)
    if point.rows:
        border = np.zeros((*states.shape, len(point.rows)))
        for j, (k, _) in enumerate(point.rows):
            border[k, :, j] = linear.slopes[j]
        none = np.zeros((*steps.shape, len(point.rows))), np.zeros((*forces.shape, len(point.rows)))
        columns = _solved(linear, none[0], none[1], border)
        rows = list(zip((k for k, _ in point.rows), linear.slopes, strict=True))
        nu = np.linalg.solve(
            np.array([slope @ columns[0][k] for k, slope in rows]),
            np.array([slope @ dx[k, :, 0] for k, slope in rows]) + active,
        )
        dx, v, w = (part - (column @ nu)[..., None] for part, column in zip((dx, v, w), columns, strict=True))
    dx, v, w = (part[..., 0] for part in (dx, v, w))
    return replace(
        point,
        x=point.x + dx,
        u=point.u + v - (linear.k @ dx[:-1, :, None])[..., 0],
        lam=point.lam + (linear.p @ dx[..., None])[..., 0] + w,
        mu=point.mu + nu,
    )


def _refined(problem: _Problem, point: _Point, linear: _Linear) -> _Point:
    """The point with more digits."""
    x, u, lam, mu = (part.astype(np.longdouble) for part in (point.x, point.u, point.lam, point.mu))
    point = replace(point, x=x, u=u, lam=lam, mu=mu)
    for _ in range(2):
        point = _newton(point, _parts_of(problem, _Ball(point.x), _Ball(point.u), 1), linear)
    return point


def _with_multipliers(point: _Point, parts: _Parts) -> _Point:
    """The point with the multipliers for which the forces' slopes are least, by the adjoint of the closed loop."""
    n, m = len(point.u), len(point.rows)
    linear = _riccati(point, parts, _WEIGHTS[1], lagrangian=False)
    if linear is None:
        raise _NotProvenError("the cost is not convex")
    slope = parts.cost[1].m[:, 0]
    along_u = slope[:, 8:] * ~point.fixed
    lam, forces = np.zeros((n + 1, 8, m + 1)), np.zeros((n, 2, m + 1))
    for j, (k, _) in enumerate(point.rows):
        lam[k, :, j] -= linear.slopes[j]
    for k in reversed(range(n)):
        lam[k] += linear.a[k].T @ lam[k + 1]
        lam[k, :, m] += slope[k, :8] - linear.k[k].T @ along_u[k]
        forces[k] = linear.b[k].T @ lam[k + 1]
        forces[k, :, m] += along_u[k]
    flat = forces.reshape(2 * n, m + 1)
    mu = np.linalg.lstsq(flat[:, :m], -flat[:, m], rcond=None)[0] if m else np.zeros(0)
    return replace(point, lam=lam @ np.append(mu, 1.0), mu=mu)
