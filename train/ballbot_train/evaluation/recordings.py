"""What a controller did in the certified episodes, as one small file: states and actions at every control step.

States are whole multiples of `GRID`, actions of `ACTION_GRID`. Whole numbers are the same on every machine, and the second
differences of smooth motions are small, so that 200 episodes of 400 control steps take 0.5 to 2 MB.

An .npz file holds

| array | shape | meaning |
|---|---|---|
| about | (bytes,) uint8 | JSON: what ran, see `Recording.about` |
| lengths | (n,) uint32 | control steps of episodes 0 to n − 1; 0 where the controller found no plan |
| states | (5, n_x, steps + n) uint8 | all states in turn, see `_packed`; n_x is the robot's `state_size` |
| actions | (5, n_u, steps) uint8 | all actions in turn; n_u is the robot's `action_size` |
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import files
from ballbot_gym.robot import ROBOTS, Robot, file_name, robot_name
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.names import file_part
from ballbot_train.work.provenance import provenance

GRID = 1e-8
"""Of states, SI units. A step from a rounded state ends up to 12 times as far from the next one, in a violent fall."""
ACTION_GRID = 2.0**-28
"""Of actions, which are fractions of the force limit."""
FOLDER = "recordings"
"""Of a results folder."""
LARGEST_FILE = 4 * 2**20  # bytes
_LARGEST_UNPACKED = 2**26  # bytes; 200 episodes of 8,000 control steps need as many
_ABOUT_LIMIT = 2**14  # bytes
_ARRAYS = {"about", "lengths", "states", "actions"}
_BYTES = 5  # of a second difference
_MOST = 2**36  # grid units; no second difference needs more


@dataclass(frozen=True)
class Recording:
    """A file's content: states (steps + n, n_x) in SI units, actions (steps, n_u), and each episode's control steps."""

    about: dict[str, Any]
    """"task" (a name), "problem" (`Task.problem`), "robot", "physics", "controller", "policy" (the digest of its weights, or
    ""), "versions"; of a submission "name" and "link" too."""
    lengths: np.ndarray
    states: np.ndarray
    actions: np.ndarray

    @classmethod
    def of_episode(cls, trajectory: Trajectory | None, params: Robot) -> "Recording":
        """What was done in one episode; None is that no plan was found."""
        if trajectory is None:
            return cls({}, np.zeros(1, np.int64), np.zeros((0, params.state_size)), np.zeros((0, params.action_size)))
        return cls({}, np.array([len(trajectory.u)]), trajectory.x, trajectory.u / params.force_limit)

    @classmethod
    def of_run(
        cls,
        episodes: Sequence["Recording"],
        task: Task,
        name: str,
        robot: Robot,
        physics: str,
        controller: str,
        policy: str = "",
    ) -> "Recording":
        """What was done in the first certified episodes, in order.

        `name` is the task's, `policy` the digest of the controller's weights.
        """
        made_by = provenance()
        about = {
            "task": name,
            "problem": task.problem(),
            "robot": robot_name(robot),
            "physics": physics,
            "controller": controller,
            "policy": policy,
            "versions": {key: str(made_by[key]) for key in ("version", "commit", "python", "numpy")},
        }
        joined = (
            np.concatenate([getattr(each, part) for each in episodes]) for part in ("lengths", "states", "actions")
        )
        return cls(about, *joined)

    @classmethod
    def read(cls, path: str | Path, content: bytes | None = None) -> "Recording":
        """What `to_bytes` gave, in a file. Sizes are checked before anything is unpacked, and nothing is executed.

        Args: content: as `to_bytes` gives it, if it is read already.

        Raises:
            FileError: it is missing, damaged, too large, or no recording.
        """
        arrays = files.read_npz(path, _LARGEST_UNPACKED, content or files.read(path, LARGEST_FILE))
        if unknown := arrays.keys() - _ARRAYS:
            raise files.FileError(
                f"{path} holds {', '.join(sorted(unknown))}, which no recording has: costs are computed"
            )
        if missing := _ARRAYS - arrays.keys():
            raise files.FileError(f"{path} is not a recording: it has no array {', '.join(sorted(missing))}")
        lengths, text = arrays["lengths"], arrays["about"]
        if lengths.dtype != np.uint32 or lengths.ndim != 1 or text.dtype != np.uint8 or text.ndim != 1:
            raise files.FileError(
                f"{path} is not a recording: lengths must be uint32 and about uint8, each of one axis"
            )
        steps = int(lengths.sum(dtype=np.int64))
        facts = files.read_json(path, _ABOUT_LIMIT, text.tobytes())
        sizes = _sizes_of(facts, arrays)
        shapes = {
            "states": (_BYTES, sizes[0], steps + int(np.count_nonzero(lengths))),
            "actions": (_BYTES, sizes[1], steps),
        }
        for name, shape in shapes.items():
            if arrays[name].shape != shape or arrays[name].dtype != np.uint8:
                raise files.FileError(f"{path}: {name} has the shape {arrays[name].shape}, and not {shape} of uint8")
        return cls(
            facts,
            lengths.astype(np.int64),
            GRID * _unpacked(arrays["states"]),
            ACTION_GRID * _unpacked(arrays["actions"]),
        )

    def to_bytes(self) -> bytes:
        """The content of its file."""
        arrays = {
            "about": np.frombuffer(json.dumps(self.about).encode(), np.uint8),
            "lengths": self.lengths.astype(np.uint32),
            "states": _packed(self.states / GRID),
            "actions": _packed(self.actions / ACTION_GRID),
        }
        return files.npz(arrays)

    def write_in(self, out: Path) -> Path:
        """Writes the recording of a run into a results folder; no two controllers share a file."""
        name = f"{file_name(self.about['task'], self.about['robot'])}-{file_part(self.about['controller'])}.npz"
        return files.write(out / FOLDER / name, self.to_bytes())


def _sizes_of(facts: dict[str, Any], arrays: dict[str, np.ndarray]) -> tuple[int, int]:
    """Components of a state and of an action: those of the robot that is named, or else what the arrays have."""
    if (name := facts.get("robot")) in ROBOTS:
        robot = ROBOTS[name].params
        return robot.state_size, robot.action_size
    states, actions = (arrays[part].shape[1] if arrays[part].ndim == 3 else 0 for part in ("states", "actions"))
    return states, actions


def _packed(values: np.ndarray) -> np.ndarray:
    """The second differences of (n, m) along n, as planes of their bytes (5, m, n); small numbers have zeros there.

    Values are rounded. Values too large for an integer, such as those of a diverged simulation, are clipped.
    """
    whole = np.rint(np.clip(values, -_MOST, _MOST)).astype(np.int64)
    differences = np.diff(whole, 2, axis=0, prepend=np.zeros((2, whole.shape[1]), np.int64))
    zigzag = np.ascontiguousarray(((differences << 1) ^ (differences >> 63)).T.astype("<u8"))
    return zigzag.view(np.uint8).reshape(whole.shape[1], -1, 8).transpose(2, 0, 1)[:_BYTES]


def _unpacked(planes: np.ndarray) -> np.ndarray:
    """(n, m) int64 of what `_packed` gave."""
    zigzag = np.zeros((*planes.shape[1:], 8), np.uint8)
    zigzag[..., :_BYTES] = planes.transpose(1, 2, 0)
    whole = zigzag.view("<u8")[..., 0].astype(np.int64)
    return np.cumsum(np.cumsum((whole >> 1) ^ -(whole & 1), 1), 1).T
