"""Random guesses of the motion of an episode, from which a search may find a basin that all other guesses miss.

They depend on the episode alone, and not on others that are searched with it.
"""

from typing import NamedTuple

import numpy as np

from ballbot_baselines.solvers import guess

_BUMPS = (1, 2, 3)  # half waves along the path
_SMALLEST, _LARGEST = 0.05, 1.0  # m, of the standard deviation of a bump


class Recovery(NamedTuple):
    """How `righting.steering` moves a robot back."""

    bandwidth: float
    """rad/s"""
    seconds: float
    """Time constant, s."""
    lean: float
    """To the side, rad."""
    fade: float
    """Time constant with which this lean fades, s."""


class RandomGuesses:
    """The random guesses of the episode from x0 (8,) with constants c (nc,), one after the other."""

    def __init__(self, x0: np.ndarray, c: np.ndarray):
        self._rng = np.random.default_rng(np.frombuffer(x0.tobytes() + c.tobytes(), np.uint32))

    def recovery(self) -> Recovery:
        """A random recovery."""
        rng = self._rng
        return Recovery(rng.uniform(6, 15), rng.uniform(0.8, 2.2), rng.normal(scale=0.3), rng.uniform(0.2, 1.5))

    def detour(self, paths: list[np.ndarray], known: np.ndarray | None, first_exit: bool) -> np.ndarray:
        """A ground path (n+1, 2), m, with random bumps between its ends. With `first_exit` its length is random, too.

        It is one of some paths, or in half of all cases that of a motion that is known.
        """
        rng = self._rng
        bases = paths if known is None or rng.uniform() >= 0.5 else [known]
        path = bases[rng.integers(len(bases))]
        s = np.linspace(0, 1, len(path))[:, None] ** rng.uniform(0.3, 1)  # bumps lie nearer to the start
        scale = _SMALLEST * (_LARGEST / _SMALLEST) ** rng.uniform()
        bumps = [np.sin(k * np.pi * s) * rng.normal(scale=scale / k, size=2) for k in _BUMPS]
        path = path + np.sum(bumps, axis=0)
        return guess.resampled(path, max(2, round((len(path) - 1) * rng.uniform(0.6, 1.6)))) if first_exit else path
