"""Interval arithmetic for proofs: arrays of balls, and jets of them for first and second derivatives.

A ball is a midpoint m and a radius r ≥ 0: the exact number lies within r of m. Every operation adds a bound of its own
rounding to the radius, from the standard model |fl(a ∘ b) − a ∘ b| ≤ u |a ∘ b| and |fl(Σ aᵢbᵢ) − Σ aᵢbᵢ| ≤ γₙ Σ |aᵢbᵢ|, which
hold for sums in any order and with fused operations (Higham, Accuracy and Stability of Numerical Algorithms, chapters 2 and
3; Rump, Verification methods, Acta Numerica 2010, chapter 5). Library functions are not trusted: sine and cosine are Taylor
polynomials with their remainder. Radii are float64, and midpoints float64 or NumPy's longdouble, with more digits where the
processor has them.

A jet runs through the equations of robots and tasks, because `ballbot_gym.ops` takes `sin` and `cos` from this module.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

VARIABLES = 10
"""Of a jet: 8 components of the state and 2 of the force."""

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-290  # more than what underflows
_FIRST = 1 + VARIABLES  # coefficients before the second derivatives
ALL = tuple(range(VARIABLES))
_LARGEST_ANGLE = 2.0  # rad
_TERMS, _REMAINDER = 17, 1e-28  # 2³⁴/34! < 6e-29, and the terms fall


class _Ball:
    """An array of real numbers within r of m. Without r it is an array of plain numbers, and nothing is bounded."""

    __array_ufunc__ = None  # so that NumPy leaves `array * ball` to this class

    def __init__(self, m: np.ndarray, r: np.ndarray | None = None):
        self.m, self.r = m, r

    @classmethod
    def exact(cls, a: Any) -> "_Ball":
        """Numbers that are known exactly."""
        return a if isinstance(a, _Ball) else cls(np.asarray(a), np.zeros(np.shape(a)))

    @classmethod
    def around(cls, a: np.ndarray, radius: np.ndarray) -> "_Ball":
        """All numbers within a radius of a, which is rounded to float64."""
        m = a.astype(np.float64)
        return cls(m, (radius + np.abs(a - m).astype(np.float64)) * (1 + 8 * _EPS) + _TINY)

    @property
    def most(self) -> np.ndarray:
        """Upper bounds of the absolute values, float64."""
        return (np.abs(self.m) + self._radius).astype(np.float64) * (1 + 8 * _EPS)

    @property
    def least(self) -> np.ndarray:
        """Lower bounds of the numbers, float64."""
        low = (self.m - self._radius).astype(np.float64)
        return low - 8 * _EPS * np.abs(self.m).astype(np.float64) - 8 * _EPS * self._radius - _TINY

    @property
    def T(self) -> "_Ball":
        """Transposed matrices."""
        return self.mapped(lambda a: np.swapaxes(a, -1, -2))

    def mapped(self, f: Callable[[np.ndarray], np.ndarray]) -> "_Ball":
        """With f, which moves entries and computes nothing, applied to midpoints and radii."""
        return _Ball(f(self.m), None if self.r is None else f(self.r))

    def __getitem__(self, i: Any) -> "_Ball":
        return self.mapped(lambda a: a[i])

    def __neg__(self) -> "_Ball":
        return _Ball(-self.m, self.r)

    def __add__(self, other: Any) -> "_Ball":
        if self.r is None or (isinstance(other, _Ball) and other.r is None):
            return _Ball(self.m + getattr(other, "m", other))
        other = _Ball.exact(other)
        return _rounded(self.m + other.m, self.r + other._radius)

    __radd__ = __add__

    def __sub__(self, other: Any) -> "_Ball":
        return self + (-other)

    def __rsub__(self, other: Any) -> "_Ball":
        return -self + other

    def __mul__(self, other: Any) -> "_Ball":
        return _bilinear(np.multiply, self, other)

    __rmul__ = __mul__

    def __matmul__(self, other: Any) -> "_Ball":
        return _bilinear(np.matmul, self, other)

    def __rmatmul__(self, other: Any) -> "_Ball":
        return _bilinear(np.matmul, other, self)

    @property
    def _radius(self) -> np.ndarray:
        if self.r is None:
            raise TypeError("these numbers have no bounds")
        return self.r


def _join(f: Callable[..., np.ndarray], balls: Sequence[_Ball]) -> _Ball:
    """What f, which moves entries and computes nothing, makes of the midpoints and of the radii of several balls."""
    bounded = all(ball.r is not None for ball in balls)
    return _Ball(f([ball.m for ball in balls]), f([ball.r for ball in balls]) if bounded else None)


def _rounded(m: np.ndarray, radius: np.ndarray) -> _Ball:
    """A ball about a result that was rounded once, with a radius before that."""
    return _Ball(m, ((radius + np.finfo(m.dtype).eps * np.abs(m)) * (1 + 8 * _EPS) + _TINY).astype(np.float64))


def _bilinear(f: Callable[..., np.ndarray], a: Any, b: Any) -> _Ball:
    """f(a, b), whose entries are sums of products aᵢbⱼ: n of a matrix product, and else at most four.

    |f(a', b') − f(a, b)| ≤ f(|a| + r_a, |b| + r_b) − f(|a|, |b|). Each of the three sums that are computed is rounded by at
    most γ_{n+2} f(|a| + r_a, |b| + r_b). With u = ε/2 the slack below is more than all of it.
    """
    if (isinstance(a, _Ball) and a.r is None) or (isinstance(b, _Ball) and b.r is None):
        return _Ball(f(getattr(a, "m", a), getattr(b, "m", b)))
    a, b = _Ball.exact(a), _Ball.exact(b)
    m = f(a.m, b.m)
    size_a, size_b = (np.abs(part.m).astype(m.dtype) for part in (a, b))
    upper = f(size_a + a._radius, size_b + b._radius)
    # of the type of m, which may have more digits than a radius
    slack = (2 * (a.m.shape[-1] if f is np.matmul else 4) + 6) * np.finfo(m.dtype).eps
    radius = upper - f(size_a, size_b) + slack * upper
    return _Ball(m, radius.astype(np.float64) * (1 + _EPS) + _TINY)


class _Jet:
    """A function of state and force at N points, as coefficients (…, N): value, gradient and, if wanted, second derivatives.

    Second derivatives are kept with respect to the variables `curved` alone. A jet that `depends` on another variable may be
    added and scaled, so that it is linear in that variable; what would bend it raises an error.
    """

    __array_ufunc__ = None

    def __init__(self, coefficients: _Ball, depends: frozenset[int], curved: tuple[int, ...]):
        self.of, self.depends, self.curved = coefficients, depends, curved

    def __neg__(self) -> "_Jet":
        return self._like(-self.of)

    def __add__(self, other: Any) -> "_Jet":
        if isinstance(other, _Jet):
            return self._like(self.of + other.of, other.depends)
        value = self.of[:1] + float(other)
        return self._like(_join(np.concatenate, [value, self.of[1:]]))

    __radd__ = __add__

    def __sub__(self, other: Any) -> "_Jet":
        return self + (-other)

    def __rsub__(self, other: Any) -> "_Jet":
        return -self + other

    def __mul__(self, other: Any) -> "_Jet":
        if isinstance(other, _Jet):
            self._check_bend(other.depends)
            return self._like(_bilinear(self._product, self.of, other.of), other.depends)
        m = self.of.m * float(other)
        return self._like(_Ball(m) if self.of.r is None else _rounded(m, self.of.r * abs(float(other))))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> "_Jet":
        if isinstance(other, _Jet):
            return self * other._inverse()
        m = self.of.m / float(other)
        return self._like(_Ball(m) if self.of.r is None else _rounded(m, self.of.r / abs(float(other))))

    def chain(self, value: _Ball, slope: _Ball, bend: _Ball) -> "_Jet":
        """g of this jet, for a function g with this value, slope and second derivative, each (N,)."""
        self._check_bend()
        own = self.of[1:_FIRST]
        parts = [value[None], own * slope]
        if len(self.of.m) > _FIRST:
            row, column = _pairs(self.curved)
            parts.append(self.of[_FIRST:] * slope + own[row] * own[column] * bend)
        return self._like(_join(np.concatenate, parts))

    def _inverse(self) -> "_Jet":
        value, r = self.of.m[0], self.of.r
        inverse = _Ball(1 / value)
        if r is not None:
            size = np.abs(value).astype(np.float64) * (1 - 4 * _EPS)
            if not (size - r[0] > 1e-3 * size).all():
                raise ArithmeticError("a divisor may be 0")
            inverse = _rounded(inverse.m, r[0] / (size * (size - r[0])) * (1 + 8 * _EPS))
        square = inverse * inverse
        return self.chain(inverse, -square, square * inverse * 2.0)

    def _like(self, coefficients: _Ball, depends: frozenset[int] = frozenset()) -> "_Jet":
        return _Jet(coefficients, self.depends | depends, self.curved)

    def _check_bend(self, depends: frozenset[int] = frozenset()) -> None:
        if not self.depends | depends <= set(self.curved):
            raise ArithmeticError("this would bend a function of a variable that is not curved")

    def _product(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Coefficients of the product of two jets: (ab)' = ab' + ba', and so on. Sums of at most four products."""
        value_a, value_b, slope_a, slope_b = a[:1], b[:1], a[1:_FIRST], b[1:_FIRST]
        out = np.empty(a.shape, np.result_type(a, b))
        out[:1] = value_a * value_b
        out[1:_FIRST] = value_a * slope_b + value_b * slope_a
        if len(a) > _FIRST:
            row, column = _pairs(self.curved)
            bend = value_a * b[_FIRST:] + value_b * a[_FIRST:]
            out[_FIRST:] = bend + slope_a[row] * slope_b[column] + slope_a[column] * slope_b[row]
        return out


@cache
def _pairs(curved: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The variables of each second derivative."""
    row, column = np.triu_indices(len(curved))
    return np.array(curved)[row], np.array(curved)[column]


def _series(x: _Ball, first: int) -> _Ball:
    """Sine (first = 1) or cosine (first = 0) of angles of at most 2 rad, by Taylor's polynomial and its remainder."""
    if not (np.abs(x.m) + (0.0 if x.r is None else x.r) < _LARGEST_ANGLE).all():
        raise ArithmeticError(f"an angle may exceed {_LARGEST_ANGLE} rad")
    eps, square = np.finfo(x.m.dtype).eps, x * x
    coefficient, coefficients = np.ones((), x.m.dtype), []
    for k in range(first, first + 2 * _TERMS, 2):
        # at most 34 factors, each of which is rounded twice
        coefficients.append(coefficient if x.r is None else _Ball(coefficient, 80 * eps * np.abs(coefficient)))
        coefficient = -coefficient / ((k + 1) * (k + 2))
    total = _Ball(np.zeros_like(x.m), None if x.r is None else np.full(x.m.shape, _REMAINDER))
    for each in reversed(coefficients):
        total = total * square + each
    return total * x if first else total


def _sin(a: _Jet) -> _Jet:
    """Sine of a jet."""
    s, c = _series(a.of[0], 1), _series(a.of[0], 0)
    return a.chain(s, c, -s)


def _cos(a: _Jet) -> _Jet:
    """Cosine of a jet."""
    s, c = _series(a.of[0], 1), _series(a.of[0], 0)
    return a.chain(c, -s, -c)


sin, cos = _sin, _cos  # the names by which `ballbot_gym.ops` finds them


def _variables(points: _Ball, order: int, curved: tuple[int, ...] = tuple(range(VARIABLES))) -> tuple[_Jet, ...]:
    """The jets of the variables at N points (N, VARIABLES), with first or also second derivatives; see `Jet` for `curved`."""
    jets, size = [], _FIRST + (len(_pairs(curved)[0]) if order == 2 else 0)
    for i in range(VARIABLES):
        m = np.zeros((size, len(points.m)), points.m.dtype)
        m[0], m[1 + i] = points.m[:, i], 1.0
        r = None
        if points.r is not None:
            r = np.zeros(m.shape)
            r[0] = points.r[:, i]
        jets.append(_Jet(_Ball(m, r), frozenset({i}), curved))
    return tuple(jets)


def _derivatives(jets: Sequence[_Jet]) -> tuple[_Ball, _Ball, _Ball]:
    """Values (N, n), gradients (N, n, VARIABLES) and Hessians (N, n, VARIABLES, VARIABLES) of n jets.

    Of jets of order 1 the last is empty, (N, n, 0).
    """

    def hessians(parts: list[np.ndarray]) -> np.ndarray:
        if len(parts[0]) == _FIRST:
            return np.zeros((parts[0].shape[1], len(parts), 0))
        out = np.zeros((parts[0].shape[1], len(parts), VARIABLES, VARIABLES), parts[0].dtype)
        row, column = _pairs(jets[0].curved)
        for i, part in enumerate(parts):
            out[:, i, row, column] = out[:, i, column, row] = part[_FIRST:].T
        return out

    balls = [jet.of for jet in jets]
    values = _join(lambda parts: np.stack([part[0] for part in parts], -1), balls)
    slopes = _join(lambda parts: np.stack([part[1:_FIRST].T for part in parts], 1), balls)
    return values, slopes, _join(hessians, balls)
