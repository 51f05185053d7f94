"""Checks of what users hand in: numbers, options, how many environments, and what may be set."""

import dataclasses
import reprlib
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

LARGEST = 1e6
"""Of any number of a state or a constant."""
MOST_ENVS = 2**20
"""Environments in a batch. Machine code takes about 1 kB for each, and seeds are listed in Python."""

_LONGEST_HISTORY = 1000  # control steps
_FLOATS = (np.dtype(np.float64), np.dtype(np.float32))


def shown(value: Any) -> str:
    """What a value is, shortened, for a message."""
    try:
        return reprlib.repr(value)
    except ValueError:  # Python writes no whole numbers of more than 4300 digits
        return f"something of type {type(value).__name__}"


def real_array(value: Any, what: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """A value as an array of float32 or float64: an array of these is returned as it is.

    Raises:
        ValueError: it does not have the shape, if one is given; or it holds anything but real numbers: complex ones, truth
            values, words, whole numbers of more than 64 bits, other objects, or masked entries.
    """
    if type(value) is np.ndarray and value.dtype in _FLOATS and (shape is None or value.shape == shape):
        return value
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # rows of different lengths, or a tensor elsewhere than on the CPU
        raise ValueError(f"{what} must be real numbers, not {shown(value)}") from None
    if shape is not None and array.shape != shape:
        raise ValueError(f"{what} must have shape {shape}, not {array.shape}")
    if array.dtype.kind in "iuf" and not np.ma.is_masked(value):
        with np.errstate(over="ignore"):  # what is beyond float64 is infinite, and nowhere allowed
            return array if array.dtype in _FLOATS else array.astype(np.float64)
    raise ValueError(f"{what} must be real numbers, not {shown(value)}")


def finite_array(value: Any, shape: tuple[int, ...], what: str, broadcast: bool = False) -> np.ndarray:
    """A value as a float64 array of that shape, to which it may be broadcast.

    Raises:
        ValueError: it has another shape, or anything but real numbers within ±`LARGEST`.
    """
    wanted = f"finite numbers that broadcast to {shape}" if broadcast else f"{shape[0]} finite numbers"
    try:
        array = real_array(value, what, None if broadcast else shape).astype(np.float64)
        array = np.broadcast_to(array, shape)
    except ValueError:
        array = np.array(np.nan)
    if not np.isfinite(array).all():
        raise ValueError(f"{what} must be {wanted}, not {shown(value)}")
    if (np.abs(array) > LARGEST).any():
        raise ValueError(f"{what} must be numbers within ±{LARGEST:g}, not {shown(value)}")
    return array


def reset_options(options: Any, *names: str) -> list[Any]:
    """The reset options of those names; None where one is not given.

    Raises:
        ValueError: options is no dict, or has other keys.
    """
    if options is None:
        return [None] * len(names)
    if not isinstance(options, dict):
        raise ValueError(f"options must be a dict with {' and '.join(map(repr, names))}, not {shown(options)}")
    unknown = sorted(set(options) - set(names), key=repr)
    if unknown:
        raise ValueError(f"unknown reset options {shown(unknown)}; known: {', '.join(map(repr, names))}")
    return [options.get(name) for name in names]


def check_num_envs(num_envs: Any) -> int:
    """num_envs, or a ValueError."""
    if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
        raise ValueError(f"num_envs must be a positive whole number, not {shown(num_envs)}")
    if num_envs > MOST_ENVS:
        raise ValueError(f"num_envs must be at most {MOST_ENVS}, not {shown(num_envs)}: make several batches")
    return int(num_envs)


def from_fields(kind: type, value: Any) -> Any:
    """An object from the dict of all its fields, into which JSON turns it; anything else as it is."""
    if isinstance(value, dict) and value.keys() == {field.name for field in dataclasses.fields(kind)}:
        return kind(**value)
    return value


def check_finite(actions: np.ndarray) -> None:
    """Raises a ValueError that names the envs whose actions (B, 2) are not finite."""
    # for one env, all() and any() take several times as long as counting
    if np.count_nonzero(np.isfinite(actions)) < actions.size:
        bad = np.flatnonzero(~np.isfinite(actions).all(1))
        raise ValueError(f"actions must be finite; those of envs {bad[:8].tolist()} are not")


def check_history(history: Any) -> int:
    """history, or a ValueError."""
    if isinstance(history, bool) or not isinstance(history, int | np.integer) or not 0 <= history <= _LONGEST_HISTORY:
        raise ValueError(f"history must be a whole number of control steps, 0 to {_LONGEST_HISTORY}, not {history!r}")
    return int(history)


_Kind = TypeVar("_Kind", bound=type)


def fixed(*names: str) -> Callable[[_Kind], _Kind]:
    """Makes attributes of the decorated class read-only once they are set: what is computed from them would not follow."""

    def decorate(kind: _Kind) -> _Kind:
        for name in names:
            setter = partial(_set_once, name=name)
            # read in C, because an env reads some in every step
            setattr(kind, name, property(attrgetter(f"_{name}"), setter))
        return kind

    return decorate


def _set_once(instance: Any, value: Any, name: str) -> None:
    if hasattr(instance, f"_{name}"):
        raise fixed_error(instance, name)
    setattr(instance, f"_{name}", value)


def fixed_error(instance: Any, name: str) -> AttributeError:
    """What setting an attribute raises that is fixed."""
    instead = "take a wrapper" if name.endswith("_space") else f"make a new {type(instance).__name__}"
    return AttributeError(f"{name!r} cannot be set: {instead} instead")
