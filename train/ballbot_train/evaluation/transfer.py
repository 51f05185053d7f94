"""Sim-to-sim transfer: controllers that were made for one robot, run on another, in one physics engine or in several.

The controller plans and observes as for its own robot. It meets the certified episodes of the robot that it runs on, and its
cost is compared with that robot's optimum on its own floor, on other floors too. PyBullet and MuJoCo simulate a rolling
robot's contact, and its friction may differ from what the controller was made for.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ballbot_gym import certified, files
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import named_robot
from ballbot_train import jobs
from ballbot_train.evaluation import benchmark
from ballbot_train.evaluation.results import Result, Row, shown, to_json
from ballbot_train.executors import Workers

_CHUNK = 5  # episodes of a job


@dataclass(frozen=True)
class TransferResult(Result):
    """An episode of a controller on a robot that it may not have been made for."""

    made_for: str = ""
    robot: str = ""
    friction: float = math.nan


@dataclass(frozen=True)
class TransferRow(Row):
    """A row of the matrix."""

    made_for: str = ""
    robot: str = ""
    friction: float = math.nan
    """Of the floor that it ran on; infinite for the paper's."""
    physics: str = ""


def floor(robot: str, friction: float | None) -> BallbotParams:
    """A robot by name on a floor with this friction; None is the robot's own.

    Raises:
        ValueError: a friction for a robot whose ball does not roll.
    """
    params = named_robot(robot)
    if friction is None:
        return params
    if not params.rolls:
        raise ValueError(f"the ball of {robot!r} does not roll, so its floor has no friction; give a rolling robot")
    return replace(params, friction=friction)


def episodes_of(task: str, robot: str, episodes: int) -> int:
    """How many certified episodes to run: at most as many as there are."""
    return min(episodes, len(certified.load(task, robot, episodes=range(1))))


def controllers_of(
    tasks: Sequence[str], names: Sequence[str], made_for: Sequence[str]
) -> dict[str, dict[str, list[str]]]:
    """The controllers to run, by the robot that they were made for and by task; a name is of the robots that have it.

    Raises:
        ValueError: a name that no robot has, or that is given twice; or no task.
        PolicyError: a policy file that is missing or damaged.
    """
    own = {robot: [name for name in names if _has(robot, tasks, name)] for robot in made_for}
    unknown = [name for name in names if not any(name in group for group in own.values())]
    if unknown:
        benchmark.controllers_of(tasks, unknown, made_for[0])  # says why
    return {robot: benchmark.controllers_of(tasks, own[robot], robot) for robot in made_for if own[robot] or not names}


def _has(robot: str, tasks: Sequence[str], name: str) -> bool:
    try:
        return bool(benchmark.controllers_of(tasks, [name], robot))
    except ValueError:
        return False


def run(
    controllers: Mapping[str, Mapping[str, Sequence[str]]],
    robot: str,
    frictions: Sequence[float | None],
    episodes: int,
    physics: Sequence[str],
    out: Path,
    workers: int | Workers,
    on_progress: Callable[[str, int], None],
    seed: int = 0,
) -> list[TransferResult]:
    """Runs everything, resumably.

    Args:
        controllers: names by task, by the robot that they were made for.
        robot: what they run on, by name.
        frictions: of the floors; None is the robot's own.
        episodes: certified episodes of each task, from the first.
        physics: some of "bullet", "mujoco" and "rk4".
        out: folder of the results.
        workers: a number of processes, or `Workers`.
        on_progress: called with a task and a number of finished episodes.
        seed: of whatever is drawn.
    """
    work = []
    for made_for, by_task in controllers.items():
        for task, names in by_task.items():
            count = episodes_of(task, robot, episodes)
            for name in names:
                for friction, engine in itertools.product(frictions, physics):
                    params = floor(robot, friction)
                    of = {"made_for": made_for, "robot": robot, "friction": params.friction}
                    label = f"{made_for}-{robot}-{params.friction:g}"
                    for start in range(0, count, _CHUNK):
                        part = range(start, min(start + _CHUNK, count))
                        job = benchmark.episode_job(
                            task, name, engine, part, seed, None, label, "", robot, made_for, params
                        )
                        work.append((job, of))
    done = jobs.run([job for job, _ in work], out, workers, on_progress)
    return [TransferResult(**entry, **of) for (_, of), entries in zip(work, done, strict=True) for entry in entries]


def write(rows: Sequence[TransferRow], results: Sequence[TransferResult], facts: Mapping[str, Any], out: Path) -> None:
    """Writes transfer.csv, episodes.csv and transfer.json, which holds the facts as "about" and the rows."""
    for name, entries in (("transfer", rows), ("episodes", results)):
        named = [{_NAMED.get(key, key): value for key, value in asdict(entry).items()} for entry in entries]
        files.write_csv(out / f"{name}.csv", named)
    files.write(out / "transfer.json", to_json({"about": {**facts, "regret": REGRET}, "rows": rows}))


REGRET = "regret over the optimum on the robot's own floor"
"""What tables and figures call it."""
HEADER = ["task", "made for", "controller", "runs on", "friction", "physics", "success", "falls", REGRET, "peak tilt"]


_NAMED = {
    name: f"{name}_on_own_floor" for name in ("regret_mean", "regret_low", "regret_high", "regret_median", "optimum")
}
"""Columns of the CSV files."""


def cells(row: TransferRow) -> list[str]:
    """A row as text, under `HEADER`; what does not exist is a dash."""
    return [
        row.task,
        row.made_for,
        row.controller,
        row.robot,
        shown(row.friction, "g"),
        row.physics,
        f"{100 * row.success:.1f} %",
        f"{row.falls}/{row.episodes}",
        shown(row.regret_mean, ".2%"),
        shown(row.peak_tilt_median, ".1f", "°"),
    ]
