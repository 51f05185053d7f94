"""`ballbot robustness`: the leaderboard under disturbances."""

from collections.abc import Callable, Iterable
from pathlib import Path

from ballbot_gym.robot import PAPER
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import Filter, WorkersOption
from ballbot_train.evaluation import robustness as stressed
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.evaluation.results import Row, leaderboard
from ballbot_train.evaluation.runner import MeasuredRun, checked_episodes
from ballbot_train.evaluation.statistics import shown
from ballbot_train.report import figures
from ballbot_train.work.console import Physics, RobotName, check_names, console, physics_or_default
from ballbot_train.work.executors import Workers


def robustness(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    stresses: tuple[str, ...] = tuple(stressed.STRESSES),
    episodes: int = 20,
    physics: Physics | None = None,
    seed: int = 0,
    out: Path = Path("runs/robustness"),
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    filter: Filter | None = None,
) -> None:
    """Draws success and regret on the certified episodes against the severity of pushes, noise, delay, lag and other masses.

    Args:
        tasks: names of tasks.
        controllers: same as in `ballbot benchmark`; by default nmpc-offset-free, NMPC with a disturbance estimator, runs too.
        stresses: names of disturbances.
        episodes: number of certified episodes of each task, from the first.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        seed: seed of pushes, noise and the bootstrap intervals.
        out: folder of the results; an interrupted run continues here.
        workers: where the work is done.
        robot: name of the robot, with its episodes and controllers.
        filter: filter in front of every controller: it estimates the robot, the delay, or the state from sensors.
    """
    chosen = controllers_of(tasks, controllers, [robot], filter)[robot]
    if not controllers:
        chosen = {task: [*group, "nmpc-offset-free"] for task, group in chosen.items()}
    physics = physics_or_default(physics, robot)
    check_names("stress", stresses, stressed.STRESSES, least=1)
    episodes = checked_episodes(episodes)
    settings = {"physics": physics, "episodes": episodes, "seed": seed}
    run = MeasuredRun.open(out, workers, {robot: chosen}, robot, **settings)
    results = run.measure(stressed.groups_of(chosen, stresses, physics, robot), episodes, seed)
    rows = leaderboard(results, seed)
    for task in chosen:
        figures.save(
            figures.robustness_figure(rows, task, run.ways),
            out / "figures" / f"robustness-{task}.png",
        )
    curves = [
        stressed.curve_of(rows, task, controller, name)
        for task, group in chosen.items()
        for name in stresses
        for controller in group
    ]
    title = f"{episodes} certified episodes per task and severity, physics={physics}"
    labels = {name: stress.label for name, stress in stressed.STRESSES.items()}
    run.publish("robustness", title, _TABLE, rows, results, curves, stresses=labels)
    console.print(f"curves: {out / 'figures'}")


def _joined(values: Iterable[float]) -> str:
    return " · ".join(shown(value, ".0f") for value in values)


_TABLE: dict[str, Callable[[list[Row]], str]] = {
    "task": lambda curve: curve[0].task,
    "disturbance": lambda curve: curve[-1].labels["stress"],
    "controller": lambda curve: curve[0].controller,
    "physics": lambda curve: curve[0].physics,
    "severity": lambda curve: " · ".join(f"{row.labels['level']:g}" for row in curve),
    "success, %": lambda curve: _joined(100 * row.success for row in curve),
    "falls, %": lambda curve: _joined(100 * row.falls / row.episodes for row in curve),
    stressed.REGRET: lambda curve: _joined(100 * row.regret_mean for row in curve),
}
