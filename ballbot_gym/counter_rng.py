"""Random numbers for batches: a hash of (the env's seed, the episode's number, the step, an index), in torch or NumPy.

An env's random numbers therefore do not depend on the batch or on its position in it, and the starts of new episodes are
drawn without a loop.
"""

from typing import Any

import numpy as np

_WORD = 0xFFFFFFFF  # hashes are 32-bit words kept in int64, whose products then never overflow


def key(seed: Any, episode: Any, step: Any) -> Any:
    """(B,) words that determine the random numbers of one step. Step 0 is the start of the episode. Ints give an int."""
    return _mix(_mix(_mix(_mix(seed & _WORD) ^ (seed >> 32)) ^ (episode & _WORD)) ^ (step & _WORD))


def uniforms(key: Any, count: int, dtype: Any) -> tuple[Any, ...]:
    """`count` tensors or arrays (B,) of uniform numbers in [0, 1), multiples of 2⁻²⁴ and so the same in both dtypes."""
    words = (_mix((key + 0x9E3779B9 * i) & _WORD) for i in range(1, count + 1))
    if isinstance(key, np.ndarray):
        return tuple((word >> 8).astype(dtype) * dtype(2.0**-24) for word in words)
    return tuple((word >> 8).to(dtype) * 2.0**-24 for word in words)


def _mix(word: Any) -> Any:
    """A bijection that scatters 32-bit words. It has the multiply and xor-shift rounds of MurmurHash's finalizer."""
    word = ((word ^ (word >> 16)) * 0x21F0AAAD) & _WORD
    word = ((word ^ (word >> 15)) * 0x735A2D97) & _WORD
    return word ^ (word >> 15)
