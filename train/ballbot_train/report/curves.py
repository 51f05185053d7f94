"""Learning curves: interquartile means over seeds with bootstrap bands, against env steps and against minutes of one core.

The interquartile mean of n seeds is the mean of the middle half: the lowest and the highest ⌊n/4⌋ are left out (Agarwal et
al., "Deep reinforcement learning at the edge of the statistical precipice", 2021). The band is the 95 % percentile bootstrap
interval over the seeds. Each curve ends where the first of its seeds ends, so that all its points are of all seeds.
"""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from matplotlib.figure import Figure

from ballbot_gym import files
from ballbot_train.console import markdown
from ballbot_train.report.labels import color, label

AXES = {"env_steps": "env steps", "minutes": "minutes of one core"}
"""What the regret is drawn against."""

_REGRET = "mean regret, no success as failing at once"  # on the certified episodes
_POINTS = 100  # of a curve
_RESAMPLES = 2000


@dataclass(frozen=True)
class TrainingRun:
    """One training, as its folder holds it."""

    folder: Path
    task: str
    learner: str
    seed: int
    settings: str
    """As JSON text; runs that differ in their seeds alone have the same."""
    columns: dict[str, np.ndarray]
    """(n,) one entry per evaluation, by the names of evaluations.csv, with "minutes" and "regret"."""


@dataclass(frozen=True)
class LearningCurve:
    """The same training on several seeds."""

    label: str
    learner: str
    task: str
    runs: tuple[TrainingRun, ...]

    def against(self, axis: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """x, interquartile mean, low and high of its band, (m) each; empty where the runs do not know x."""
        known = [(run.columns[axis], run.columns["regret"]) for run in self.runs]
        known = [(x[keep], y[keep]) for x, y in known if (keep := np.isfinite(x) & np.isfinite(y)).sum() > 1]
        if len(known) < len(self.runs):
            none = np.zeros(0)
            return none, none, none, none
        grid = np.linspace(max(x[0] for x, _ in known), min(x[-1] for x, _ in known), _POINTS)
        values = np.array([np.interp(grid, x, y) for x, y in known])
        return grid, interquartile_mean(values), *bootstrap_band(values)

    def final(self, name: str) -> np.ndarray:
        """(n,) the last value of each seed."""
        return np.array([run.columns[name][-1] for run in self.runs])


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """(..., m) mean of the middle half of (..., n, m) values over n."""
    return scipy.stats.trim_mean(values, 0.25, axis=-2)


def bootstrap_band(values: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Low and high (m,) of the 95 % percentile bootstrap interval of the interquartile mean of (n, m) values over n."""
    chosen = np.random.default_rng(seed).integers(len(values), size=(_RESAMPLES, len(values)))
    means = interquartile_mean(values[chosen])
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    return low, high


def read_runs(paths: Sequence[Path]) -> list[TrainingRun]:
    """The trainings in folders: runs, or folders of runs.

    Raises:
        ValueError: a folder holds none, or a run's files are damaged.
    """
    runs = []
    for path in paths:
        found = (
            [path]
            if (path / "evaluations.csv").exists()
            else [p.parent for p in sorted(path.glob("*/evaluations.csv"))]
        )
        if not found:
            raise ValueError(
                f"{path} holds no training, and neither do the folders in it; give folders of ballbot train"
            )
        runs += [_read_run(folder) for folder in found]
    return runs


def _read_run(folder: Path) -> TrainingRun:
    config = files.read_json(folder / "config.json")
    try:
        text = files.read(folder / "evaluations.csv").decode()
        rows = list(csv.DictReader(text.splitlines()))
        names = [name for name in rows[0] if name is not None]
        columns = {name: np.array([float(row[name]) for row in rows]) for name in names}
        columns["minutes"] = columns["cpu_seconds"] / 60
        columns["regret"] = columns["cost_ratio"] - 1
        settings = json.dumps(config["settings"], sort_keys=True)
        return TrainingRun(folder, config["task"], config["learner"], config["seed"], settings, columns)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise ValueError(f"{folder} holds no training of ballbot train, or a damaged one: {error!r}") from error


def grouped(runs: Sequence[TrainingRun]) -> list[LearningCurve]:
    """A curve for each learner and settings. Where a learner has several on a task, folders tell them apart."""
    groups: dict[tuple[str, str, str], list[TrainingRun]] = {}
    for run in runs:
        groups.setdefault((run.task, run.learner, run.settings), []).append(run)
    kinds = [(task, learner) for task, learner, _ in groups]
    curves = []
    for (task, learner, _), members in groups.items():
        name = label(learner)
        if kinds.count((task, learner)) > 1:
            own = members[0].folder
            name += f", {own.parent.name if own.name.startswith('seed-') else own.name}"
        curves.append(LearningCurve(name, learner, task, tuple(members)))
    return curves


def figure(curves: Sequence[LearningCurve]) -> Figure:
    """A row of two axes per task: against env steps and against minutes. Learners that count no env steps have none."""
    tasks = list(dict.fromkeys(curve.task for curve in curves))
    drawn = Figure(figsize=(11, 0.6 + 3.6 * len(tasks)), layout="constrained")
    grid = drawn.subplots(len(tasks), len(AXES), squeeze=False)
    for row, task in zip(grid, tasks, strict=True):
        for axis, name in zip(row, AXES, strict=True):
            for i, curve in enumerate(curve for curve in curves if curve.task == task):
                x, middle, low, high = curve.against(name)
                if not len(x):
                    continue
                shade = color(curve.learner, i) if curve.label == label(curve.learner) else f"C{i}"
                axis.plot(x, middle, color=shade, label=f"{curve.label} ({len(curve.runs)} seeds)")
                axis.fill_between(x, low, high, color=shade, alpha=0.2, linewidth=0)
            axis.set(xlabel=AXES[name], ylabel=_REGRET, title=task, yscale="log")
            axis.grid(alpha=0.3)
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=8)
    return drawn


def points(curves: Sequence[LearningCurve]) -> list[dict[str, Any]]:
    """Every point of the figure, as rows of a table."""
    rows = []
    for curve in curves:
        for axis in AXES:
            for x, middle, low, high in zip(*curve.against(axis), strict=True):
                place = {"task": curve.task, "curve": curve.label, "axis": axis, "x": float(x)}
                rows.append(place | {"iqm": float(middle), "low": float(low), "high": float(high)})
    return rows


def summary(curves: Sequence[LearningCurve]) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table: where each curve ends."""
    header = ["task", "curve", "seeds", "env steps", "minutes", "regret: IQM [95 %]", "median", "worst"]
    header += ["success", "failures"]
    rows = []
    for curve in curves:
        final = curve.final("regret")
        low, high = bootstrap_band(final[:, None])
        rows.append(
            [
                curve.task,
                curve.label,
                f"{len(curve.runs)}",
                _number(np.median(curve.final("env_steps"))),
                f"{np.median(curve.final('minutes')):.1f}",
                f"{interquartile_mean(final[:, None])[0]:.4g} [{low[0]:.4g}, {high[0]:.4g}]",
                f"{np.median(final):.4g}",
                f"{final.max():.4g}",
                f"{np.median(curve.final('success')):.1%}",
                f"{np.median(curve.final('failures')):.0f}",
            ]
        )
    return header, rows


def _number(value: Any) -> str:
    return "–" if math.isnan(value) else f"{value:,.0f}"


def write(curves: Sequence[LearningCurve], out: Path) -> Path:
    """Writes curves.png, curves.csv with every point, and curves.md with where each curve ends; returns the figure's path."""
    from ballbot_train.report.figures import save

    files.write_csv(out / "curves.csv", points(curves), ("task", "curve", "axis", "x", "iqm", "low", "high"))
    files.write(out / "curves.md", markdown(*summary(curves)))
    return save(figure(curves), out / "curves.png")
