"""Elementary functions for robot and tasks, which then work with floats, NumPy, CasADi and torch alike.

A vector is an array whose last axis holds the components (NumPy, torch), a column (CasADi), or a tuple of components.
A tuple's components may be floats, arrays of one shape, tensors or symbols. This layout is fast both for one robot in pure
Python and for a batch on an accelerator.
"""

import math
import numbers
import sys
from types import ModuleType
from typing import Any

import numpy as np

Vector = Any
"""A tuple of components, an ndarray or tensor (..., n), or a CasADi column (n,)."""


_NUMBERS = (float, int)  # a tuple, because a union would be made in every call


def _library(a: Any) -> ModuleType:
    """The library of `a`, or this project's module that defines its class. It is already imported, because `a` exists."""
    module = type(a).__module__
    return sys.modules.get(module if module[:8] == "ballbot_" else module.partition(".")[0], np)


def sin(a: Any) -> Any:
    """Sine, elementwise."""
    return math.sin(a) if isinstance(a, _NUMBERS) else _library(a).sin(a)


def cos(a: Any) -> Any:
    """Cosine, elementwise."""
    return math.cos(a) if isinstance(a, _NUMBERS) else _library(a).cos(a)


def sqrt(a: Any) -> Any:
    """Square root, elementwise."""
    return math.sqrt(a) if isinstance(a, _NUMBERS) else _library(a).sqrt(a)


def exp(a: Any) -> Any:
    """Exponential, elementwise."""
    return math.exp(a) if isinstance(a, float) else _library(a).exp(a)


def log(a: Any) -> Any:
    """Natural logarithm, elementwise."""
    return math.log(a) if isinstance(a, float) else _library(a).log(a)


def arccos(a: Any) -> Any:
    """Arc cosine, elementwise."""
    return math.acos(a) if isinstance(a, _NUMBERS) else _library(a).arccos(a)


def arctan(a: Any) -> Any:
    """Arc tangent, elementwise."""
    return math.atan(a) if isinstance(a, _NUMBERS) else _library(a).arctan(a)


def floor(a: Any) -> Any:
    """The greatest whole number that is not above a, elementwise."""
    return float(math.floor(a)) if isinstance(a, float) else _library(a).floor(a)


def clip(a: Any, low: Any, high: Any) -> Any:
    """The nearest number in [low, high], elementwise; NaN stays NaN, but not with CasADi."""
    if isinstance(a, _NUMBERS):
        return a if low <= a <= high else max(min(a, high), low)  # most numbers are in range
    library = _library(a)
    return library.fmax(library.fmin(a, high), low) if _is_casadi(a) else library.clip(a, low, high)


def minimum(a: Any, b: Any) -> Any:
    """The lesser of two numbers, elementwise."""
    return _least_or_greatest("minimum", "fmin", min, a, b)


def maximum(a: Any, b: Any) -> Any:
    """The greater of two numbers, elementwise."""
    return _least_or_greatest("maximum", "fmax", max, a, b)


def _least_or_greatest(name: str, of_symbols: str, of_floats: Any, a: Any, b: Any) -> Any:
    if isinstance(a, _NUMBERS) and isinstance(b, _NUMBERS):
        return of_floats(a, b)
    return getattr(_library(a), of_symbols if _is_casadi(a) else name)(a, b)


def where(condition: Any, a: Any, b: Any) -> Any:
    """a where the condition holds, else b, elementwise. Not for what optimizers differentiate: they need smooth functions."""
    if isinstance(condition, bool | np.bool_):
        return a if condition else b
    library = _library(condition)
    if library.__name__ == "casadi":
        return library.if_else(condition, a, b)
    if library.__name__ == "torch":
        kinds = [part.dtype for part in (a, b) if isinstance(part, library.Tensor)]
        kind = kinds[0] if kinds else library.float32  # the default of torch
        a, b = (
            library.as_tensor(part, dtype=kind, device=condition.device) if isinstance(part, float) else part
            for part in (a, b)
        )
        return library.where(condition, a, b)
    return library.where(condition, a, b)


def full_like(a: Any, value: float) -> Any:
    """A number in the shape and of the kind of `a`."""
    library = _library(a)
    return library.full_like(a, value) if library.__name__ in ("torch", "numpy") and getattr(a, "ndim", 0) else value


def between(z: Any, low: Any, high: Any) -> Any:
    """A uniform number z in [0, 1) as one in [low, high), elementwise."""
    return low + (high - low) * z


def squared(*parts: Any) -> Any:
    """Sum of the squares of components."""
    total: Any = 0
    for part in parts:  # sum() rounds floats otherwise from Python 3.12 on
        total = total + part * part
    return total


def scaled(parts: tuple[Any, ...], scale: tuple[float, ...], like: Vector) -> Vector:
    """A vector of the kind of `like` whose components are the parts, each divided by its scale."""
    return stack(tuple(part / s for part, s in zip(parts, scale, strict=True)), like)


def components(v: Vector) -> tuple[Any, ...]:
    """Splits a vector into its components."""
    if isinstance(v, tuple):
        return v
    if _is_casadi(v):
        return tuple(v[i] for i in range(v.shape[0]))
    return tuple(v[..., i] for i in range(v.shape[-1]))


def stack(parts: tuple[Any, ...], like: Vector) -> Vector:
    """Joins components into a vector of the kind of `like`; constants among them are broadcast."""
    if isinstance(like, tuple):
        return parts
    library = _library(like)
    if _is_casadi(like):
        return library.vertcat(*parts)
    if library.__name__ == "torch":
        tensors = [library.as_tensor(part, dtype=like.dtype, device=like.device) for part in parts]
        return library.stack(library.broadcast_tensors(*tensors), dim=-1)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _is_casadi(v: Any) -> bool:
    return type(v).__module__.partition(".")[0] == "casadi"


def is_number(value: object) -> bool:
    """Whether something is one real number, and no truth value."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def as_float(value: Any) -> Any:
    """One real number, of NumPy too, as a float; anything else, such as a tensor or a symbol, as it is.

    A whole number that is too large for a float stays what it is.
    """
    if not is_number(value) and not (isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "iuf"):
        return value
    try:
        return float(value)
    except OverflowError:
        return value


def is_positive(value: Any) -> bool:
    """Whether a real number is positive, and finite as a float: a whole number may be too large for one."""
    try:
        return 0 < float(value) < math.inf
    except OverflowError:
        return False
