"""Seeds of episodes, so that runs with different seeds have no episode in common, and random numbers of batches.

The random numbers are a hash of (the env's seed, the episode's number, the step, an index), in torch or NumPy. They
therefore do not depend on the batch or on an env's position in it, and the starts of new episodes are drawn without a loop.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any

import numpy as np

from ballbot_gym.checks import shown

_EPISODES = 1_000_000
_WORD = 0xFFFFFFFF  # hashes are 32-bit words kept in int64, whose products then never overflow


def spawned(seed: int) -> int:
    """The seed of a run's first env, from 0 to 2³² − 1, where env i is seeded with the i-th number after it.

    Gymnasium seeds env i with seed + i. So runs with the seeds 0 and 1 would have all episodes but one in common. Spawned
    seeds are far apart: the chance that two runs of 1,000 envs have an episode in common is 5e-7.

    Raises:
        ValueError: the seed is negative.
    """
    return int(np.random.SeedSequence(seed).spawn(1)[0].generate_state(1)[0])


def of_episode(seed: int, i: int) -> int:
    """The seed for `BallbotEnv.reset` of episode i, less than a million, in a set of episodes with this seed."""
    return _EPISODES * seed + i


def seeds_of(seed: int | Sequence[int | None], num_envs: int) -> list[int | None]:
    """One seed per env."""
    if isinstance(seed, bool | str | bytes | Mapping | Set) or not isinstance(seed, int | np.integer | Iterable):
        raise TypeError(f"seed must be a whole number, or one or None for each env, not {shown(seed)}")
    if isinstance(seed, Iterable):
        seeds: list[Any] = list(itertools.islice(seed, num_envs + 1))  # it may have no end
    else:
        seeds = [int(seed) + i for i in range(num_envs)]
    if len(seeds) != num_envs:
        found = f"more than {num_envs}" if len(seeds) > num_envs else len(seeds)
        raise ValueError(f"seed has {found} entries for {num_envs} envs")
    for value in seeds:
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise TypeError(f"seeds must be whole numbers, not {shown(value)}")
        if not 0 <= value < 2**63:
            raise ValueError(f"seeds must be in [0, 2^63), not {shown(value)}")
    return [None if value is None else int(value) for value in seeds]


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
