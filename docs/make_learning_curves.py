"""Draws regret over training time, and writes the tables of from-scratch.md: python docs/make_learning_curves.py [RUN ...]

RUN is a folder of `ballbot train`. Its evaluations first go into experiments/learning-curves.csv and replace those of another
run with the same task, learner and seed. The picture and the table of minutes show what that file holds. The table of runs
shows from-scratch.csv, which is written by hand.
"""

import csv
import json
import re
import sys
from collections import defaultdict
from io import StringIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ballbot_gym import files
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.statistics import Interval
from ballbot_train.report.labels import color, label
from ballbot_train.work.console import markdown

_EXPERIMENTS = Path(__file__).parent / "experiments"
PAGE = _EXPERIMENTS / "from-scratch.md"
RUNS = _EXPERIMENTS / "from-scratch.csv"
CURVES = _EXPERIMENTS / "learning-curves.csv"
PICTURE = Path(__file__).parent / "pictures" / "learning-curves.png"
LEVELS = (0.05, 0.02, 0.01)
_EPISODES = 10_000  # in which failures are counted
_TABLES = re.compile(r"(<!-- (\w+) -->\n).*?(<!-- end of \2 -->)", flags=re.DOTALL)
_RUN = ("task", "learner", "seed")
_COLUMNS = (*_RUN, "cpu_seconds", "regret_mean", "success")
_RELIABLE = 0.99  # the mean regret of those that succeed says little where fewer do

Row = dict[str, str]


def read(path: Path = CURVES) -> list[Row]:
    """Rows of a file; of the default, one for each evaluation."""
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def add(folders: list[Path]) -> None:
    """Puts the evaluations of these runs into the file."""
    rows = read()
    for folder in folders:
        config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
        run = {name: str(config[name]) for name in _RUN}
        rows = [row for row in rows if any(row[name] != run[name] for name in _RUN)]
        found = read(folder / "evaluations.csv")
        rows += [run | {"cpu_seconds": f"{float(row['cpu_seconds']):.0f}", **_shown(row)} for row in found]
    rows.sort(key=lambda row: (list(TASKS).index(row["task"]), row["learner"], int(row["seed"])))
    text = StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files.write(CURVES, text.getvalue())


def _shown(row: Row) -> Row:
    return {"regret_mean": f"{float(row['regret_mean']):.5f}", "success": row["success"]}


def curves() -> dict[tuple[str, str], list[np.ndarray]]:
    """For each task and learner the runs: seconds of processor time and mean regrets of reliable evaluations, (2, n)."""
    runs: dict[tuple[str, str, str], list[tuple[float, float]]] = defaultdict(list)
    for row in read():
        evaluations = runs[row["task"], row["learner"], row["seed"]]
        if float(row["success"]) >= _RELIABLE:
            evaluations.append((float(row["cpu_seconds"]), float(row["regret_mean"])))
    found = defaultdict(list)
    for (task, learner, _), evaluations in runs.items():
        found[task, learner].append(np.array(evaluations).reshape(-1, 2).T)
    return found


def page() -> str:
    """The page as both files make it."""
    tables = {"runs": run_table(), "minutes": minute_table()}
    text = PAGE.read_text(encoding="utf-8")
    return _TABLES.sub(lambda match: f"{match[1]}\n{tables[match[2]]}\n{match[3]}", text)


def run_table() -> str:
    """The policy that each run chose: its training time, its success and regret, and how often it fails."""
    rows = []
    for row in read(RUNS):
        failures = int(row["failures_per_10000"])
        ends = Interval.of_share(failures, _EPISODES)
        low, high = (f"{_EPISODES * end:.2g}" for end in (ends.low, ends.high))
        shares = (float(row[name]) for name in ("regret_mean", "regret_median"))
        rows.append(
            [row["task"].capitalize(), row["learner"], row["seed"], f"{float(row['cpu_seconds']) / 60:.1f}"]
            + [f"{100 * float(row['success']):.0f} %", *(f"{100 * share:.1f} %" for share in shares)]
            + [f"{failures} ({low} to {high})"]
        )
    return markdown(
        ["task", "learner", "seed", "minutes", "success", "mean regret", "median", "failures per 10,000, 95 %"], rows
    )


def minute_table() -> str:
    """Minutes of one core until the mean regret falls below each level: the median of the runs, and their range."""
    rows = []
    for (task, learner), runs in curves().items():
        times = [[_first(run, level) for run in runs] for level in LEVELS]
        rows.append([task.capitalize(), learner, str(len(runs)), *map(_minutes, times)])
    return markdown(["task", "learner", "seeds", *(f"minutes to {100 * level:.0f} %" for level in LEVELS)], rows)


def _first(run: np.ndarray, level: float) -> float:
    """Seconds to the first evaluation below a level; infinity if there is none."""
    below = run[0, run[1] < level]
    return below[0] if len(below) else np.inf


def _minutes(seconds: list[float]) -> str:
    median, least, most = (value / 60 for value in (np.median(seconds), min(seconds), max(seconds)))
    if np.isinf(median):
        return "" if np.isinf(least) else f"in {np.isfinite(seconds).sum()} of {len(seconds)} runs"
    if len(seconds) == 1:
        return f"{median:.1f}"
    return f"{median:.1f} ({least:.1f} to {'never' if np.isinf(most) else f'{most:.1f}'})"


def picture() -> Figure:
    """A panel for each task, a line for each run."""
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    panels = dict(zip(TASKS, figure.subplots(1, len(TASKS), sharey=True), strict=True))
    for (task, learner), runs in curves().items():
        for k, (seconds, regrets) in enumerate(runs):
            name = "" if k else label(learner)
            panels[task].plot(seconds / 60, 100 * regrets, ".-", ms=3, lw=1.2, color=color(learner), label=name)
    for task, axis in panels.items():
        axis.set(title=task.capitalize(), xlabel="minutes of one core", xscale="log", yscale="log")
        axis.set(xlim=(0.3, 60), xticks=[1, 3, 10, 30], ylim=(0.12, 50), yticks=[0.2, 0.5, 1, 2, 5, 10, 20])
        axis.minorticks_off()
        axis.xaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_major_formatter("{x:g} %")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    next(iter(panels.values())).set_ylabel("mean regret")
    return figure


def main(folders: list[str]) -> None:
    """Adds these runs, draws the picture and writes the page."""
    if folders:
        add([Path(folder) for folder in folders])
    picture().savefig(PICTURE, dpi=110)
    files.write(PAGE, page())
    print(PICTURE, PAGE, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
