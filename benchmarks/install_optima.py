"""Puts evaluation sets into the package: python benchmarks/install_optima.py SET.npz ..., as `ballbot certify` writes them.

If the package has a cheaper optimum of an episode, that one is retained.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ballbot_gym import certified
from ballbot_gym.certified import EvaluationSet
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, TRACKS, Randomization
from ballbot_gym.tasks import TASKS

CHEAPER = 1e-7  # relative: optima that differ by less are the same
PER_EPISODE = ("states", "constants", "costs", "durations", "violations", "statuses", "drawn", "ideal")


def cheapest(old: EvaluationSet, new: EvaluationSet) -> EvaluationSet:
    """The cheaper optimum of each episode; the new one where the episodes differ."""
    better = new.costs < old.costs * (1 - CHEAPER)
    for name in ("states", "constants", "drawn"):
        better |= (getattr(new, name) != getattr(old, name)).any(1)
    chosen = {}
    for name in PER_EPISODE:
        one, other = getattr(old, name), getattr(new, name)
        chosen[name] = np.where(better[:, None] if one.ndim > 1 else better, other, one)
    pairs = zip(better.tolist(), old.trajectories, new.trajectories, strict=False)
    print(f"{better.sum()} of {len(old)} optima are cheaper than those installed")
    return replace(old, **chosen, trajectories=tuple(second if take else first for take, first, second in pairs))


def install(path: Path) -> None:
    """Finds what the set is of by its name."""
    for name, robot, track in ((name, robot, track) for name in TASKS for robot in ROBOTS for track in ("", *TRACKS)):
        task, varied = make_task(name, robot), TRACKS.get(track, Randomization())
        place = certified.path_of(task, robot, track)
        if place.name != path.name:
            continue
        kept = certified.load(task, robot, path, randomization=varied)
        if len(kept) < certified.EPISODES:
            raise ValueError(f"the package needs sets of {certified.EPISODES} episodes, and {path} has {len(kept)}")
        try:
            kept = cheapest(certified.load(task, robot, place, randomization=varied), kept)
        except certified.CertificateError as error:  # none, or of another problem
            print(error)
        print(f"installed: {kept.save(task, place, robot, varied)}")
        return
    raise ValueError(f"{path} is named as no set of the package is")


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        install(Path(argument))
