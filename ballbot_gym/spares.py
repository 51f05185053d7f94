"""Arrays whose memory is that of earlier ones to which nobody refers any more.

Memory that goes back to the system comes again as pages that the system clears. That takes longer than a step of large
batches.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

_MOST = 4
"""Arrays of a kind that are kept: of two steps, and two that users may hold for a while."""


class Spares:
    """Arrays of one kind, each with a note of what its memory holds."""

    def __init__(self, make: Callable[[], tuple[np.ndarray, Any]]):
        """Args: make: gives a new array, and its first note."""
        self._make = make
        self._kept: list[list[Any]] = []

    def __getstate__(self) -> dict[str, Any]:
        return {"_make": self._make, "_kept": []}  # a copy has memory of its own

    def take(self) -> list[Any]:
        """An array that only this object refers to, and its note, which the caller may change.

        The array is as new, or as its last user left it. Views refer to the array whose memory they show.
        """
        for kept in self._kept:
            if sys.getrefcount(kept[0]) == _KEPT_ONLY:
                return kept
        kept = list(self._make())
        self._kept.append(kept)
        if len(self._kept) > _MOST:
            del self._kept[0]
        return kept


def sparse_rows(size: int, columns: int) -> Spares:
    """Arrays (size, columns) of float32, NaN but for the rows that `fill` has set."""
    return Spares(partial(_no_rows, size, columns))


def _no_rows(size: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full((size, columns), np.nan, np.float32), np.empty(0, np.int64)


def fill(spares: Spares, indices: np.ndarray, values: Any) -> np.ndarray:
    """An array of `sparse_rows` with values, one row for each index, at some indices. All others are NaN."""
    kept = spares.take()
    array: np.ndarray = kept[0]
    array[kept[1]] = np.nan
    array[indices] = values
    kept[1] = indices
    return array


def _references(kept: list[list[Any]]) -> int:
    """To the first array, as `Spares.take` counts them, which depends on the Python."""
    for first in kept:
        return sys.getrefcount(first[0])
    return 0


_KEPT_ONLY = _references([[np.empty(1), None]])
"""References to an array that is only kept."""
