"""`ballbot transfer`: controllers made for one robot, run on another, in one physics engine or in several.

A controller plans and observes as for its own robot. Its cost is compared with the optimum of the robot that it runs on, on
that robot's own floor, even if it runs on another floor.
"""

from collections.abc import Callable
from pathlib import Path

from ballbot_gym.robot import PAPER, ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import Filter, WorkersOption
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.evaluation.results import Row, leaderboard
from ballbot_train.evaluation.runner import Group, MeasuredRun, checked_episodes, floor
from ballbot_train.evaluation.statistics import shown
from ballbot_train.work.console import Physics, RobotName, check_names, console, physics_or_default
from ballbot_train.work.executors import Workers

_REGRET = "regret over the optimum on the robot's own floor"
_IN_CSV = {
    name: f"{name}_on_own_floor" for name in ("regret_mean", "regret_low", "regret_high", "regret_median", "optimum")
}
_TABLE: dict[str, Callable[[Row], str]] = {
    "task": lambda row: row.task,
    "made for": lambda row: row.labels["made_for"],
    "controller": lambda row: row.controller,
    "runs on": lambda row: row.labels["robot"],
    "friction": lambda row: shown(row.labels["friction"], "g"),
    "physics": lambda row: row.physics,
    "success": lambda row: f"{100 * row.success:.1f} %",
    "falls": lambda row: f"{row.falls}/{row.episodes}",
    _REGRET: lambda row: shown(row.regret_mean, ".2%"),
    "peak tilt": lambda row: shown(row.peak_tilt_median, ".1f", "°"),
}


def transfer(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    made_for: tuple[RobotName, ...] = (PAPER, "rolling"),
    robot: RobotName = "rolling",
    frictions: tuple[float, ...] = (),
    episodes: int = 20,
    physics: tuple[Physics, ...] = (),
    seed: int = 0,
    out: Path = Path("runs/transfer"),
    workers: WorkersOption = Workers(),
    filter: Filter | None = None,
) -> None:
    """Runs controllers that were made for one robot on another: success, falls, and regret over the optimum of the latter.

    Args:
        tasks: names of tasks.
        controllers: names of experts and policies; default, all that the robots have.
        made_for: names of the robots that experts plan for and policies were trained on.
        robot: name of the robot that all of them run on, with its certified episodes.
        frictions: coefficients of friction of the floor, for a robot whose ball rolls; default, the robot's own.
        episodes: number of certified episodes of each task, from the first.
        physics: "bullet", "mujoco" or "rk4", where "rk4" has no contact between ball and floor; default, the first that is
            installed.
        seed: seed of the bootstrap intervals.
        out: folder of the results; an interrupted run continues here.
        workers: where the work is done.
        filter: filter in front of every controller: it estimates the robot, the delay, or the state from sensors.
    """
    check_names("robot", made_for, ROBOTS, least=1)
    for friction in frictions:
        floor(robot, friction)
    chosen = controllers_of(tasks, controllers, made_for, filter)
    if len(set(physics)) < len(physics):
        raise ValueError(f"a physics is given more than once: {' '.join(physics)}")
    engines, episodes = [physics_or_default(one, robot) for one in physics or (None,)], checked_episodes(episodes)
    settings = {"frictions": frictions, "physics": engines, "episodes": episodes, "seed": seed}
    run = MeasuredRun.open(out, workers, chosen, robot, **settings)
    groups = [
        Group(
            task,
            name,
            engine,
            robot,
            made_for=own,
            friction=friction,
            labels={"made_for": own, "robot": robot, "friction": getattr(floor(robot, friction), "friction", None)},
        )
        for own, by_task in chosen.items()
        for task, names in by_task.items()
        for name in names
        for friction in frictions or (None,)
        for engine in engines
    ]
    results = run.measure(groups, episodes, seed)
    rows = leaderboard(results, seed)
    title = f"{episodes} certified episodes of {robot} per task"
    run.publish("transfer", title, _TABLE, rows, results, renamed=_IN_CSV, regret=_REGRET)
    console.print(f"matrix: {out / 'transfer.csv'}")
