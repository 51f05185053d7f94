"""`ballbot benchmark`: controllers by their regret on the certified episodes."""

import json
import math
import os
import shutil
from pathlib import Path
from typing import Literal

from ballbot_baselines import CONTROLLERS
from ballbot_baselines.controller import rollout
from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv
from ballbot_gym.tasks import TASKS
from ballbot_train import evaluate, figures
from ballbot_train.console import about, console, markdown, print_table, progress_bar
from ballbot_train.report import write_report


def benchmark(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = tuple(CONTROLLERS),
    episodes: int = certified.EPISODES,
    quick: bool = False,
    physics: Literal["bullet", "rk4"] = "bullet",
    out: Path = Path("runs/benchmark"),
    workers: int = os.cpu_count() or 1,
) -> None:
    """Compares controllers by their regret on the certified episodes, and writes a leaderboard with figures.

    Args:
        tasks: names of tasks.
        controllers: names of controllers.
        episodes: how many of each task's certified episodes.
        quick: only 10 episodes of each task.
        physics: "bullet" or "rk4".
        out: folder of the results; an interrupted run continues here.
        workers: processes; 1 gives the cleanest times per control step.
    """
    evaluate.check_names("task", list(tasks), TASKS)
    evaluate.check_names("controller", list(controllers), CONTROLLERS)
    if not 1 <= episodes <= certified.EPISODES:
        raise ValueError(f"episodes must be 1 to {certified.EPISODES}, not {episodes}")
    episodes = min(episodes, 10) if quick else episodes
    facts = about() | {"physics": physics, "episodes": episodes, "workers": workers}
    _claim(out, {key: facts[key] for key in ("version", "commit", "physics", "episodes")})
    with progress_bar() as progress:
        bars = {task: progress.add_task(task, total=episodes * len(controllers)) for task in tasks}
        results = evaluate.benchmark(
            list(tasks),
            list(controllers),
            episodes,
            physics,
            out,
            workers,
            lambda task, count: progress.advance(bars[task], count),
        )
    rows = evaluate.leaderboard(results)
    evaluate.write_leaderboard(rows, results, facts, out)
    pictures = [figures.save(figures.regret_figure(results), out / "figures" / "regret.png")]
    pictures += [_episode_figure(task, list(controllers), physics, out) for task in tasks]
    table = [_cells(row) for row in rows]
    files.write(out / "leaderboard.md", markdown(_HEADER, table))
    report = write_report("ballbot-gym: leaderboard", _HEADER, table, pictures, facts, out / "report.html")
    shutil.rmtree(out / "episodes", ignore_errors=True)  # only needed to resume: episodes.csv has it all
    (out / "unfinished.json").unlink(missing_ok=True)
    print_table(f"{episodes} certified episodes per task, physics={physics}", _HEADER, table)
    for result in results:
        if result.note:
            console.print(f"no plan: {result.task} episode {result.episode}: {result.note}")
    console.print(f"report: {report}")


_HEADER = [
    "task",
    "controller",
    "success",
    "falls",
    "regret mean",
    "regret median",
    "cost mean",
    "cost median",
    "peak tilt",
    "settle",
    "plan",
    "per step",
]


def _cells(row: evaluate.Row) -> list[str]:
    def shown(value: float, form: str, unit: str = "") -> str:
        return format(value, form) + unit if math.isfinite(value) else "–"

    return [
        row.task,
        row.controller,
        f"{100 * row.success:.1f} %",
        f"{row.falls}/{row.episodes}",
        shown(row.regret_mean, ".2%"),
        shown(row.regret_median, ".2%"),
        shown(row.cost_mean, ".2f"),
        shown(row.cost_median, ".2f"),
        shown(row.peak_tilt_median, ".1f", "°"),
        shown(row.settle_time_median, ".2f", " s"),
        shown(row.plan_ms_median, ".0f", " ms"),
        shown(row.step_us_median, ".0f", " µs"),
    ]


def _episode_figure(task: str, controllers: list[str], physics: str, out: Path) -> Path:
    """The first certified episode of a task under every controller."""
    env = BallbotEnv(task, physics=physics)
    episode_set = certified.load(env.task)
    curves = [figures.Curve("optimum", episode_set.trajectories[0], "0.35", "--")]
    for i, name in enumerate(controllers):
        run = rollout(env, CONTROLLERS[name](env.task, env.params), options=episode_set.options(0))
        label = figures.LABELS.get(name, name) + (" (fails)" if run.failure else "")
        curves.append(figures.Curve(label, run.trajectory, figures.color(name, i)))
    circles = figures.marker_circles(env.task.markers(episode_set.constants[0]))
    env.close()
    figure = figures.trajectory_figure(f"{env.task.id}, certified episode 0", curves, circles)
    return figures.save(figure, out / "figures" / f"{task}.png")


def _claim(out: Path, config: dict[str, object]) -> None:
    """Marks the folder as this run's, so that only the same run continues in it."""
    marker = out / "unfinished.json"
    if marker.exists() and json.loads(marker.read_text()) != config:
        raise ValueError(
            f"{out} holds an unfinished run of {json.loads(marker.read_text())}, this is {config}; "
            "give another --out or delete the folder"
        )
    files.write(marker, json.dumps(config))
