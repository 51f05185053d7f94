"""Certified evaluation sets: for every task 200 fixed episodes with their optima.

`load(task)` reads what `ballbot certify` computed: initial states, constants, optimal costs and the solver's status of each
episode, and the optimal trajectories of the first 20 episodes. Costs hold for the env's discretization with physics="rk4".
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ballbot_gym import files
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

EPISODES = 200
TRAJECTORIES = 20


class CertificateError(ValueError):
    """No evaluation set for this task as it is configured."""


@dataclass(frozen=True)
class EvaluationSet:
    """n episodes of a task with their optima.

    | field | shape | meaning |
    |---|---|---|
    | states | (n, 8) | initial states |
    | constants | (n, nc) | constants of the episodes |
    | costs | (n,) | optimal costs |
    | durations | (n,) | of the optimal episodes, s |
    | violations | (n,) | largest constraint violation of the optimum, SI units |
    | statuses | (n,) | how the solver ended, e.g. "fatrop: Solve_Succeeded" |
    | trajectories | ≤ n | the first optimal trajectories, forces held over control steps |
    """

    states: np.ndarray
    constants: np.ndarray
    costs: np.ndarray
    durations: np.ndarray
    violations: np.ndarray
    statuses: np.ndarray
    trajectories: tuple[Trajectory, ...]

    def __len__(self) -> int:
        return len(self.costs)

    def options(self, i: int) -> dict[str, np.ndarray]:
        """What to give `env.reset(options=...)` to start episode i."""
        return {"state": self.states[i], "constants": self.constants[i]}

    def save(self, task: Task, path: Path) -> Path:
        """Writes the set and the task's fields. `load` refuses it for a task with other fields."""
        arrays = {
            "task": np.array(repr(task)),
            **{name: getattr(self, name) for name in _PER_EPISODE},
            "lengths": np.array([len(trajectory.u) for trajectory in self.trajectories]),
            "x": np.concatenate([trajectory.x for trajectory in self.trajectories]),
            "u": np.concatenate([trajectory.u for trajectory in self.trajectories]),
        }
        return files.write_npz(path, arrays)


_PER_EPISODE = ("states", "constants", "costs", "durations", "violations", "statuses")


def path_of(task: Task) -> Path:
    """Where the package keeps the evaluation set of a task."""
    return Path(__file__).parent / f"{task.id}.npz"


def load(task: Task, path: Path | None = None) -> EvaluationSet:
    """The evaluation set of a task.

    Args:
        task: must have the fields for which the set was computed.
        path: a set made by `ballbot certify --out`, instead of the packaged one.

    Raises:
        CertificateError: there is none, or it belongs to other fields of the task.
    """
    path = path_of(task) if path is None else Path(path)
    if not path.exists():
        raise CertificateError(f'{path}: no evaluation set of {task.id}; compute it with "ballbot certify"')
    with np.load(path, allow_pickle=False) as arrays:
        if str(arrays["task"]) != repr(task):
            raise CertificateError(
                f'{path} was computed for {arrays["task"]}, not for {task!r}; compute another with "ballbot certify"'
            )
        lengths, x, u = arrays["lengths"], arrays["x"], arrays["u"]
        forces = np.split(u, np.cumsum(lengths)[:-1])
        states = np.split(x, np.cumsum(lengths + 1)[:-1])
        times = (task.control_dt * np.arange(n + 1) for n in lengths)
        trajectories = tuple(Trajectory(*parts) for parts in zip(times, states, forces, strict=True))
        return EvaluationSet(**{name: arrays[name] for name in _PER_EPISODE}, trajectories=trajectories)
