"""Smooth ground paths: cubic Hermite interpolation, paths that end at rest, and how they pass obstacles."""

from typing import Any

import numpy as np


def hermite_basis(s: Any) -> tuple[Any, Any, Any, Any]:
    """The four cubic Hermite polynomials at a fraction s of an interval, a number or an array.

    Returns:
        Factors of the value at the start, the slope at the start times the interval's length, the value at the end, and
        the slope at the end times the interval's length. Their sum with these is the interpolated value.
    """
    return (1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2, s**2 * (3 - 2 * s), s**2 * (s - 1)


def cubic(p0: np.ndarray, v0: np.ndarray, p1: np.ndarray, v1: np.ndarray, steps: int, dt: float) -> np.ndarray:
    """The cubic ground path from position p0 and velocity v0 to position p1 and velocity v1.

    Args:
        p0: (2,) position at the start, m.
        v0: (2,) velocity at the start, m/s.
        p1: (2,) position at the end, m.
        v1: (2,) velocity at the end, m/s.
        steps: intervals of the path.
        dt: length of an interval, s.

    Returns:
        (steps+1, 2) m, a position every dt s.
    """
    start, start_slope, end, end_slope = hermite_basis(np.linspace(0.0, 1.0, steps + 1)[:, None])
    duration = steps * dt
    return start * p0 + start_slope * duration * v0 + end * p1 + end_slope * duration * v1


def catmull_rom(knots_x: np.ndarray, knots_y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A smooth curve through knots, flat at the first and the last one.

    Between knots it is cubic. At each inner knot its slope is that of the line through the two neighbouring knots
    (Catmull and Rom).

    Args:
        knots_x: (n,) increasing.
        knots_y: (n,).
        x: (m,) where to evaluate, within the knots.

    Returns:
        (m,) values.
    """
    slopes = np.zeros_like(knots_y)
    slopes[1:-1] = (knots_y[2:] - knots_y[:-2]) / (knots_x[2:] - knots_x[:-2])
    i = np.clip(np.searchsorted(knots_x, x, side="right") - 1, 0, len(knots_x) - 2)
    h = knots_x[i + 1] - knots_x[i]
    start, start_slope, end, end_slope = hermite_basis((x - knots_x[i]) / h)
    return start * knots_y[i] + start_slope * h * slopes[i] + end * knots_y[i + 1] + end_slope * h * slopes[i + 1]


def then_stay(path: np.ndarray, steps: int) -> np.ndarray:
    """A path (n, 2) extended to (steps+1, 2) by repeating its last point, or cut to that length."""
    rest = np.repeat(path[-1:], max(0, steps + 1 - len(path)), axis=0)
    return np.concatenate([path, rest])[: steps + 1]


def sides_passed(path: np.ndarray, obstacles: np.ndarray) -> tuple[int, ...]:
    """The sides on which a path (k, at least 2) passes obstacles (n, 3), where it is nearest to their x: 1 left, −1 right."""
    nearest = [int(np.argmin(np.abs(path[:, 0] - x))) for x in obstacles[:, 0]]
    return tuple(1 if path[k, 1] > y else -1 for k, y in zip(nearest, obstacles[:, 1], strict=True))
