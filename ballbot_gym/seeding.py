"""Seeds of episodes, so that runs with different seeds have no episode in common."""

import numpy as np

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
