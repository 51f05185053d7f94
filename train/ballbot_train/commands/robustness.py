"""`ballbot robustness`: the leaderboard under disturbances."""

import math
import os
from pathlib import Path
from typing import Literal

from ballbot_gym import files
from ballbot_gym.tasks import TASKS
from ballbot_train import jobs
from ballbot_train.console import console, markdown, print_table, progress_bar
from ballbot_train.evaluation import evaluate
from ballbot_train.evaluation import robustness as track
from ballbot_train.report import figures


def robustness(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    stresses: tuple[str, ...] = tuple(track.STRESSES),
    episodes: int = 20,
    quick: bool = False,
    physics: Literal["bullet", "rk4"] = "bullet",
    seed: int = 0,
    out: Path = Path("runs/robustness"),
    workers: int = os.cpu_count() or 1,
) -> None:
    """Runs the certified episodes under pushes, noise, delay, lag and other robots, and draws success and regret by severity.

    Args:
        tasks: names of tasks.
        controllers: as of `ballbot benchmark`.
        stresses: names of disturbances.
        episodes: how many of each task's certified episodes.
        quick: only 3 episodes of each task.
        physics: "bullet" or "rk4".
        seed: of pushes, noise and the bootstrap intervals.
        out: folder of the results; an interrupted run continues here.
        workers: processes.
    """
    chosen = evaluate.controllers_of(tasks, controllers)
    evaluate.check_names("stress", stresses, track.STRESSES)
    episodes = evaluate.checked_episodes(episodes, quick, few=3)
    facts = evaluate.begin(out, chosen, workers, physics=physics, episodes=episodes, seed=seed)
    runs = sum(map(len, chosen.values())) * episodes
    with progress_bar() as progress:
        bars = {
            name: progress.add_task(name, total=runs * (1 if name == track.NONE else len(track.STRESSES[name].levels)))
            for name in (track.NONE, *stresses)
        }
        results = track.run(
            chosen,
            stresses,
            episodes,
            physics,
            out,
            workers,
            lambda name, count: progress.advance(bars[name], count),
            seed,
        )
    rows = track.rows_of(results, seed)
    track.write(rows, results, facts, out)
    for task in chosen:
        figures.save(figures.robustness_figure(rows, task), out / "figures" / f"robustness-{task}.png")
    table = [
        _cells(track.curve_of(rows, task, controller, name), name)
        for task, group in chosen.items()
        for name in stresses
        for controller in group
    ]
    header = ["task", "disturbance", "controller", "severity", "success, %", "falls, %", "regret, %"]
    files.write(out / "robustness.md", markdown(header, table))
    jobs.release(out)
    print_table(f"{episodes} certified episodes per task and severity, physics={physics}", header, table)
    console.print(f"curves: {out / 'figures'}")


def _cells(curve: list[track.StressRow], stress: str) -> list[str]:
    def joined(values: list[float]) -> str:
        return " · ".join(f"{value:.0f}" if math.isfinite(value) else "–" for value in values)

    return [
        curve[0].task,
        stress,
        curve[0].controller,
        " · ".join(f"{row.level:g}" for row in curve),
        joined([100 * row.success for row in curve]),
        joined([100 * row.falls / row.episodes for row in curve]),
        joined([100 * row.regret_mean for row in curve]),
    ]
