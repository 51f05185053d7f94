"""Certified evaluation sets: for every robot and task 200 fixed episodes with their optima.

`load(task, robot)` reads what comes with the package, or what `ballbot certify` and evaluation computed into the user's
cache: initial states, constants, optimal costs and the solver's status of each episode, and optimal trajectories. Costs hold
for the env's discretization with physics="rk4". A set says what it was made for, and `load` refuses it for any other task or
robot, because a regret relative to the optimum of another problem has no meaning.
"""

import itertools
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ballbot_gym import files
from ballbot_gym.certified import cache, version
from ballbot_gym.checks import shown
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.registry import name_of
from ballbot_gym.robot import (
    PAPER,
    Randomization,
    Robot,
    checked_robot,
    file_name,
    named_robot,
    robot_name,
    short_name,
)
from ballbot_gym.tasks import SHIPPED, Task
from ballbot_gym.tasks.identity import problem_parts
from ballbot_gym.trajectory import Trajectory

EPISODES = 200
TRAJECTORIES = 20
_FEW = 5  # trajectories in the files of tracks, which are many, and of robots with wheels, whose states are larger

_SAME = 1e-6  # of states and, relative, of costs: what rounding differs by between machines is far less


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
    | drawn | (n, 14), (n, 6) or (n, 0) | what a randomization drew for the episodes; names in `Randomization.DRAWN` |
    | ideal | (n,) | optimal costs if forces came without delay |

    Where a randomization moves the optima, each is that of the episode's own robot, and its first forces are 0 for as long as
    the episode's forces are delayed. In a set of the user's cache, episodes whose optima were not computed are NaN.
    """

    states: np.ndarray
    constants: np.ndarray
    costs: np.ndarray
    durations: np.ndarray
    violations: np.ndarray
    statuses: np.ndarray
    trajectories: tuple[Trajectory, ...]
    drawn: np.ndarray
    ideal: np.ndarray

    def __len__(self) -> int:
        return len(self.costs)

    def options(self, i: int) -> dict[str, np.ndarray]:
        """What to give `env.reset(options=...)` to start episode i."""
        drawn = {"drawn": self.drawn[i]} if self.drawn.shape[1] else {}
        return {"state": self.states[i], "constants": self.constants[i], **drawn}

    def first(self, episodes: int) -> "EvaluationSet":
        """A set of the first episodes alone."""
        chosen = {name: getattr(self, name)[:episodes] for name in _PER_EPISODE}
        return EvaluationSet(**chosen, trajectories=self.trajectories[:episodes])

    def save(
        self,
        task: Task,
        path: Path,
        robot: str | Robot,
        randomization: Randomization = Randomization(),
        trajectories: int | None = None,
    ) -> Path:
        """Writes the set, with what defines its optima, so that it is never read for another problem or robot.

        Args:
            task: whose optima these are.
            path: of the file.
            robot: whose optima these are, or its name in `ROBOTS`.
            randomization: what the robots and actuators of the episodes were drawn from.
            trajectories: how many of them to write at most, from the first; default, `TRAJECTORIES`, and fewer for tracks and
                for robots with wheels.
        """
        params, varied = checked_robot(robot), randomization.moves_optima
        names = _PER_EPISODE if varied else _PER_EPISODE[:-2]
        few = _FEW if varied or params.LONG_EQUATIONS else TRAJECTORIES
        moved = self.trajectories[: few if trajectories is None else trajectories]
        arrays = {
            "benchmark": np.array(version.BENCHMARK),
            "task": np.array(task.problem()),
            **({} if params == named_robot(PAPER) else {"robot": np.array(params.record())}),
            **({"randomization": np.array(repr(randomization))} if varied else {}),
            **{name: getattr(self, name) for name in names},
            "lengths": np.array([len(trajectory.u) for trajectory in moved]),
            "x": np.concatenate([trajectory.x for trajectory in moved]),
            "u": np.concatenate([trajectory.u for trajectory in moved]),
        }
        return files.write(path, files.npz(arrays))


_PER_EPISODE = ("states", "constants", "costs", "durations", "violations", "statuses", "drawn", "ideal")


def named_problem(task: str, robot: str) -> dict[str, str]:
    """`problem_parts` of a task and a robot by name."""
    return problem_parts(make_task(task, robot), robot_of(task, robot))


def path_of(task: Task, robot: str = PAPER, track: str = "") -> Path:
    """The path of the evaluation set of a task, a robot by name and a track.

    It is in this folder; for a task of another package, in the folder `certified` next to the module of the task.
    """
    folder, kind = Path(__file__).parent, type(task)
    if kind not in SHIPPED:
        module = getattr(sys.modules.get(kind.__module__), "__file__", None)
        folder = folder if module is None else Path(module).parent / "certified"
    return folder / f"{file_name(task.id, robot)}{track and f'-{track}'}.npz"


def load(
    task: str | Task,
    robot: str | Robot,
    path: str | Path | None = None,
    episodes: Iterable[int] | None = None,
    randomization: Randomization = Randomization(),
) -> EvaluationSet:
    """The evaluation set of a task and a robot.

    Args:
        task: a name in `TASKS`, or a Task that is the very problem of the set; its pay and its arena may differ.
        robot: whose optima: the params of the robot that runs, or a name in `ROBOTS`. Another friction is another robot.
        path: a set made by `ballbot certify --out`, instead of the packaged one.
        episodes: indices whose optima are needed; default, the first 200.
        randomization: what the robots and actuators of the episodes are drawn from.

    Raises:
        CertificateError: there is none, or can be none; it belongs to another robot, task or other fields of the task, or it
            is damaged.
        ValueError: no task or robot of that name.
    """
    params = robot_of(task, robot)
    name = short_name(robot) if isinstance(robot, str) and robot != PAPER else robot_name(params)
    task = make_task(task, name)
    needed = range(EPISODES) if episodes is None else list(episodes)
    if not randomization.moves_optima:
        randomization = Randomization()
    elif randomization.actuator_lag[1] > 0:
        raise CertificateError("no optimum is known where the actuator lags; leave actuator_lag out")
    try:
        if path is None and name_of(task) is None:  # a subclass may have its parent's id and name
            raise CertificateError(f"there is no evaluation set of {type(task).__name__}, which is not in TASKS")
        track = randomization.track
        if path is None and randomization.moves_optima and not track:
            raise CertificateError(f"there is no evaluation set of {randomization}, which is not in TRACKS")
        given = path_of(task, name, track) if path is None else Path(path)
        if not given.exists():
            raise CertificateError(f"there is no evaluation set of {task.id} at {given}")
        found = _read((_version(given),), task, params, randomization)
        if path is None and not all(0 <= index < len(found) for index in needed):
            raise CertificateError(f"{given} has {len(found)} episodes, and not all of {shown(needed)}")
        return found
    except CertificateError as error:
        cached = None if path is not None else from_cache(task, params, needed, randomization)
        if cached is not None:
            return cached
        again = _command(task, params, name, path is not None, randomization.track)
        raise CertificateError(f"{error}; {again}") from error.__cause__


def from_cache(
    task: Task, params: Robot, episodes: Iterable[int], randomization: Randomization = Randomization()
) -> EvaluationSet | None:
    """What the user's cache has of some episodes; None where one is missing, or does not move or cost as it did.

    `statuses` say how each optimum was found.
    """
    needed = tuple(dict.fromkeys(episodes))
    if not needed:
        return None
    try:
        paths = [_version(cache.path(task, params, index, randomization)) for index in needed]
        found = _read(tuple(paths), task, params, randomization)
    except (FileNotFoundError, CertificateError):
        return None
    if len(found) != len(needed):
        return None
    for index, *begun in zip(needed, found.states, found.constants, found.drawn, strict=True):
        starts = cache.starts(task, params, index, randomization)
        if not any(all(map(np.array_equal, begun, start)) for start in starts):
            return None
    rows, arrays = max(EPISODES, max(needed) + 1), {}
    for name in _PER_EPISODE:
        values = getattr(found, name)
        arrays[name] = np.full((rows, *values.shape[1:]), "" if name == "statuses" else np.nan, values.dtype)
        arrays[name][list(needed)] = values
    moved = dict(zip(needed, found.trajectories, strict=True))
    first = itertools.takewhile(moved.__contains__, itertools.count())
    return EvaluationSet(**arrays, trajectories=tuple(moved[index] for index in first))


def _version(path: Path) -> tuple[Path, int, int]:
    """A file, when it was written, ns, and its size."""
    status = path.stat()
    return path, status.st_mtime_ns, status.st_size


@lru_cache(maxsize=16)
def _read(
    versions: tuple[tuple[Path, int, int], ...], task: Task, params: Robot, randomization: Randomization
) -> EvaluationSet:
    """The sets of some files in their present versions as one. If there are several, each file has all its trajectories.

    The trajectories are checked by stepping them; this is done once for every set of files.
    """
    parts = [_arrays_of(path, task, params, randomization) for path, _, _ in versions]
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    for array in arrays.values():
        array.setflags(write=False)  # everybody who loads the set gets it
    lengths, x, u = arrays["lengths"], arrays["x"], arrays["u"]
    forces = np.split(u, np.cumsum(lengths)[:-1])
    states = np.split(x, np.cumsum(lengths + 1)[:-1])
    times = (task.control_dt * np.arange(n + 1) for n in lengths)
    trajectories = tuple(Trajectory(*each) for each in zip(times, states, forces, strict=True))
    if not _holds(arrays, task, params, randomization):
        raise CertificateError(
            f"{versions[0][0]}: its optimal trajectories have other states or costs in {task.problem()} than when they were "
            "computed, because the cost, the limits or the equations have changed since then"
        )
    return EvaluationSet(**{name: arrays[name] for name in _PER_EPISODE}, trajectories=trajectories)


def _arrays_of(path: Path, task: Task, params: Robot, randomization: Randomization) -> dict[str, np.ndarray]:
    """What a file holds that `EvaluationSet.save` wrote for this very problem."""
    try:
        arrays = files.read_npz(path)
        if "drawn" not in arrays and "costs" in arrays:
            arrays |= {"drawn": np.zeros((arrays["costs"].size, 0)), "ideal": arrays["costs"]}
        missing = [name for name in ("task", "lengths", "x", "u", *_PER_EPISODE) if name not in arrays]
        if missing:
            raise ValueError(f"it has no array {', '.join(missing)}")
        # sets that were written before there was a version are of the first
        version.check(str(arrays.get("benchmark", "1")), "it", "compute it again with ballbot certify")
        made_for = [str(arrays["task"]), str(arrays.get("robot", named_robot(PAPER).record()))]
        made_for.append(str(arrays.get("randomization", repr(Randomization()))))
        for made, wanted in zip(made_for, (task.problem(), params.record(), repr(randomization)), strict=True):
            if made != wanted:
                raise CertificateError(f"{path} was computed for {made}, not for {wanted}")
        return _checked(task, params, arrays)
    except CertificateError:
        raise
    except ValueError as error:
        raise CertificateError(f"{path} is not an evaluation set: {error}") from error


def _command(task: Task, params: Robot, robot: str, file: bool, track: str) -> str:
    """How the set of a task and a robot is computed, in words."""
    name = name_of(task)
    first = [] if name else [f"ballbot_gym.register_task({type(task).__name__}) gives the task a name"]
    own = params == named_robot(robot) and (name is None or task.problem() == make_task(name, robot).problem())
    if not own:
        first.append("ballbot_gym.register_robot gives this robot, with the fields of its tasks, a name")
        robot = "NAME"
    given = f" --tasks {name or 'NAME'}" + ("" if robot == PAPER else f" --robot {robot}")
    given += f" --randomization {track}" if track else ""
    return "; ".join(
        [
            *([] if file else ["ballbot_train.evaluate and `ballbot benchmark` compute what they need of it"]),
            *first,
            f'compute all of it with "ballbot certify{given}"',
        ]
    )


def _holds(arrays: Mapping[str, np.ndarray], task: Task, params: Robot, randomization: Randomization) -> bool:
    """Whether the trajectories, of the first episodes, move, cost and keep the limits as when they were found."""
    dt, lengths, u = task.control_dt, arrays["lengths"], arrays["u"]
    number = np.repeat(np.arange(len(lengths)), lengths)
    step = np.arange(len(u)) - (np.cumsum(lengths) - lengths)[number]
    row = np.arange(len(u)) + number  # each trajectory has a state more than steps
    before, after, c = arrays["x"][row], arrays["x"][row + 1], arrays["constants"][number]
    began, ended = (task.at(c, dt * k) for k in (step, step + 1))
    robot = randomization.robot(params, tuple(arrays["drawn"][number].T)) if randomization.moves_optima else params
    known = arrays["costs"][: len(lengths)]
    with np.errstate(all="ignore"):  # of damaged files
        moved = np.abs(robot.step(before, u, dt, params.substeps(dt)) - after) <= _SAME
        found = np.bincount(number, dt * np.broadcast_to(task.cost(before, u, began), len(u)), len(known))
        kept = all(np.min(margin) >= -_SAME for margin in task.margins(after, ended))
        return bool(moved.all() and (np.abs(found - known) <= _SAME * known).all() and kept)


def _checked(task: Task, params: Robot, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a set; raises a ValueError that names the one whose shape or values make no sense."""
    n = arrays["costs"].size
    if n == 0:
        raise ValueError("it has no episode")
    if arrays["statuses"].dtype.kind != "U" or arrays["statuses"].shape != (n,):
        raise ValueError(f"statuses must be {n} texts, not {arrays['statuses'].shape} of {arrays['statuses'].dtype}")
    shapes = dict.fromkeys(("costs", "durations", "violations", "ideal"), (n,)) | {
        "states": (n, params.state_size),
        "constants": (n, len(task.constant_names)),
        "drawn": (n, arrays["drawn"].shape[-1]),
    }
    found = {name: files.numbers(arrays[name], name, shape) for name, shape in shapes.items()}
    if not (found["costs"] > 0).all():
        raise ValueError("costs must be positive")
    lengths = arrays["lengths"]
    if lengths.ndim != 1 or lengths.dtype.kind not in "iu" or not 0 < lengths.size <= n:
        raise ValueError(f"lengths must be whole numbers, one for each of at most {n} trajectories")
    if (lengths < 0).any() or (lengths > task.steps).any():
        raise ValueError(f"lengths must be 0 to {task.steps} control steps")
    steps = int(lengths.sum())
    for name, shape in (("x", (steps + lengths.size, params.state_size)), ("u", (steps, params.action_size))):
        found[name] = files.numbers(arrays[name], name, shape)
    return found | {"lengths": lengths, "statuses": arrays["statuses"]}
