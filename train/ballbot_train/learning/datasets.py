"""Reads demonstrations: Minari datasets, and sets of shards."""

import itertools
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ballbot_gym import files
from ballbot_gym.checks import LARGEST
from ballbot_gym.robot import PAPER, ROBOTS, named_robot, robot_name
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import problem_parts
from ballbot_gym.tasks.symmetry import REACH, Frame
from ballbot_train.policy.files import OBSERVATION_VERSION
from ballbot_train.work import shards
from ballbot_train.work.console import option
from ballbot_train.work.jobs import check_same

IN_DATASET = {
    "observations": "observations",
    "states": "infos/state",
    "labels": "infos/expert_action",
    "actions": "actions",
    "rewards": "rewards",
    "terminations": "terminations",
    "truncations": "truncations",
}
"""Where Minari keeps the arrays of an episode, by their names in a shard."""


@dataclass(frozen=True)
class Demos:
    """n control steps of demonstrations, episode after episode.

    | field | shape | meaning |
    |---|---|---|
    | observations | (n, no) float32 | before the step |
    | actions | (n, 2) float32 | the expert's, in [−1, 1] |
    | rewards | (n,) float32 | of the executed actions |
    | next_observations | (n, no) float32 | after the step; of an episode's last step too |
    | terminations, truncations | (n,) bool | the episode ended with this step |
    | executed | (n, 2) float32 | executed actions: the expert's plus noise, in [−1, 1] |
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_observations: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    executed: np.ndarray

    def __len__(self) -> int:
        return len(self.actions)

    def median_cost(self, task: Task) -> float:
        """Median cost of the episodes."""
        starts = np.flatnonzero(np.roll(self.terminations | self.truncations, 1))
        return float(task.survival_pay - np.median(np.add.reduceat(self.rewards, starts, dtype=np.float64)))

    def without_pay(self, task: Task, failure_price: float) -> "Demos":
        """The same steps where living does not pay: rewards are minus the running cost, and a failure costs its price.

        The step that arrives at the goal of a first-exit task is known by its reward, the pay of all the time that was left.
        """
        pay = task.survival_reward * task.control_dt
        starts = np.flatnonzero(np.append(True, (self.terminations | self.truncations)[:-1]))
        step = np.arange(len(self)) - np.repeat(starts, np.diff(np.append(starts, len(self))))
        arrived = self.terminations & (self.rewards > pay) & task.first_exit
        failed = self.terminations & ~arrived
        rewards = self.rewards - pay - arrived * pay * (task.steps - step - 1) - failed * failure_price
        return replace(self, rewards=rewards.astype(np.float32))

    def in_frame(self, frame: Frame, reach: float = REACH) -> "Demos":
        """The same steps with features instead of observations, and with actions in the frame, divided by `reach`."""
        observations, axes = _seen_in(frame, self.observations)
        next_observations, _ = _seen_in(frame, self.next_observations)
        turned = {
            name: np.einsum("nji,nj->ni", axes, getattr(self, name)) / np.float32(reach)
            for name in ("actions", "executed")
        }
        return replace(self, observations=observations, next_observations=next_observations, **turned)


def _seen_in(frame: Frame, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a frame shows of observations (n, no), and where its axes are.

    Returns:
        Features (n, size) float32; and (n, 2, 2) float32, the frame's two directions as columns, which are orthonormal.
    """
    features, back = frame.features(tuple(observations.T))
    one, zero = np.ones(len(observations), np.float32), np.zeros(len(observations), np.float32)
    return _columns(features), np.stack([_columns(back(unit)) for unit in ((one, zero), (zero, one))], -1)


def _columns(parts: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*parts), -1).astype(np.float32)


def load_demos(path: str | Path, task: Task, robot: str = PAPER) -> Demos:
    """Reads a dataset of `ballbot demos`, all its episodes.

    Args:
        path: folder of the dataset, or the URL of shards.
        task: the dataset must have been made for this very task.
        robot: name of the robot that it must show.

    Raises:
        ValueError: there is no such dataset, or it is damaged, or of another task, robot or observation version.
    """
    _check_made_for(str(path), metadata_of(path), task, robot)
    try:
        arrays = _sharded(path) if shards.Shards.is_at(path) else _dataset(Path(path))
        return _demos(arrays, len(task.observation_scale))
    except Exception as error:  # h5py has dozens of ways to refuse a damaged file
        raise ValueError(f'{path} is damaged; record it again with "ballbot demos" ({error!r:.300})') from error


def _check_made_for(path: str, metadata: Mapping[str, Any], task: Task, robot: str) -> None:
    """Raises a ValueError for demonstrations of another task, robot or observation version."""
    if metadata.get("task") != repr(task):
        raise ValueError(f"{path} holds demonstrations of {metadata.get('task')}, not of {task!r}")
    shown = str(metadata["demos"].get("robot", PAPER)).rpartition(":")[2]
    # learners know their robot by `robot_name`, which is another where only the friction is
    if robot not in (shown, robot_name(named_robot(shown)) if shown in ROBOTS else shown):
        raise ValueError(f"{path} holds demonstrations of the robot {shown}, not of {robot}; make others with --robot")
    if shown in ROBOTS and "problem" in metadata:  # older ones have no digest
        wanted = {"problem": problem_parts(task, named_robot(shown))}
        check_same({"problem": metadata["problem"]}, wanted, Path(path), "demonstrations")
    if metadata.get("observation_version") != OBSERVATION_VERSION:
        raise ValueError(
            f"{path} holds observations of version {metadata.get('observation_version')}, this is {OBSERVATION_VERSION}; "
            'record it again with "ballbot demos"'
        )


def _sharded(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of all shards of a set as those of one."""
    parts = [arrays for arrays in shards.Shards(path) if arrays]  # without a plan there is no array
    return {name: np.concatenate([part[name] for part in parts]) for name in (*IN_DATASET, "lengths")}


def _dataset(path: Path) -> dict[str, np.ndarray]:
    """A dataset's HDF5 as arrays of a shard; see `_demos`.

    Minari itself would make the env that a dataset describes, with whatever code that names, and read arrays of any size.
    """
    main = path / "data" / "main_data.hdf5"
    if not main.is_file():
        raise ValueError(f"{main} is not a regular file")
    size, declared = main.stat().st_size, 0
    arrays: dict[str, list[np.ndarray]] = {name: [] for name in IN_DATASET}
    with h5py.File(main, "r") as file:
        for i in range(len(file)):
            group: Any = file[f"episode_{i}"]
            declared += sum(group[place].nbytes for place in IN_DATASET.values())
            if declared > size:
                raise ValueError(f"its arrays declare more than the {size} bytes of {main.name}")
            for name, place in IN_DATASET.items():
                arrays[name].append(group[place][()])
    lengths = np.array([len(each) for each in arrays["actions"]], np.int64)
    return {name: np.concatenate(parts) for name, parts in arrays.items()} | {"lengths": lengths}


def _demos(arrays: Mapping[str, np.ndarray], observations: int) -> Demos:
    """The demonstrations of a shard's arrays; `observations` is the size of an observation.

    Raises:
        KeyError, ValueError, IndexError, TypeError: they do not fit together, or one holds something else than numbers.
    """
    lengths = arrays["lengths"]
    n, ends = int(lengths.sum()), np.cumsum(lengths + 1) - 1  # where the observations of each episode end
    size = np.shape(arrays["actions"])[1:]  # of an action
    shapes = {"observations": (n + len(lengths), observations), "labels": (n, *size), "actions": (n, *size)}
    shapes["rewards"] = (n,)
    found = {
        name: files.numbers(arrays[name], name, shape, LARGEST).astype(np.float32) for name, shape in shapes.items()
    }
    for name in ("terminations", "truncations"):
        if arrays[name].dtype != np.bool_ or arrays[name].shape != (n,):
            raise ValueError(f"{name} must be {n} truth values, not {arrays[name].shape} of {arrays[name].dtype}")
    return Demos(
        observations=np.delete(found["observations"], ends, 0),
        actions=found["labels"],
        rewards=found["rewards"],
        next_observations=np.delete(found["observations"], ends - lengths, 0),
        terminations=arrays["terminations"],
        truncations=arrays["truncations"],
        executed=found["actions"],
    )


def command_of(path: str | Path) -> str:
    """The command that records a dataset of `ballbot demos` again.

    Raises:
        ValueError: it is no such dataset.
    """
    settings, options = metadata_of(path)["demos"], {"out": str(path)}
    if shards.Shards.is_at(path):
        settings, options = {"episodes": shards.Shards(path).episodes} | settings, {"shards": str(path)}
    words = ["ballbot", "demos", *itertools.chain(*itertools.starmap(option, (settings | options).items()))]
    return shlex.join(words)


def metadata_of(path: str | Path) -> dict[str, Any]:
    """Metadata of a dataset of `ballbot demos`; raises a ValueError for anything else."""
    try:
        if shards.Shards.is_at(path):
            metadata = shards.Shards(path).about or {}
        else:
            metadata = files.read_json(Path(path) / "data" / "metadata.json")
        if not isinstance(metadata.get("demos"), dict):
            raise ValueError("not made by ballbot demos")
    except ValueError as error:
        raise ValueError(f'{path} is not a dataset of "ballbot demos": {error}') from error
    return metadata
