"""Seeds of episodes, so that runs with different seeds have no episode in common."""

import itertools
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any

import numpy as np

from ballbot_gym.checks import shown

_EPISODES = 1_000_000


def spawned(seed: int) -> int:
    """The seed of a run's first env, from 0 to 2³² − 1, where env i is seeded with the i-th number after it.

    Gymnasium seeds env i with seed + i. So runs with the seeds 0 and 1 would see the same episodes, moved by one env.
    Spawned seeds are far apart: two runs of 1,000 envs have an episode in common with a chance of 5e-7.

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
