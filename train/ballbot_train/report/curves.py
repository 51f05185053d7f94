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

import numpy as np
import scipy.stats
from matplotlib.figure import Figure

from ballbot_gym import files
from ballbot_train.report.labels import color, label

AXES = {"env_steps": "env steps", "minutes": "minutes of one core"}
"""What the regret is drawn against."""

_REGRET = "mean regret, no success as failing at once"  # on the certified episodes
_POINTS = 100  # of a curve
_RESAMPLES = 2000


@dataclass(frozen=True)
class LearningCurve:
    """The same training on several seeds."""

    label: str
    learner: str
    task: str
    runs: tuple[dict[str, np.ndarray], ...]
    """Of each seed (n,) one entry per evaluation, by the names of evaluations.csv, with "minutes" and "regret"."""

    def against(self, axis: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """x, interquartile mean, low and high of its band, (m,) each; empty where the runs do not know x."""
        known = [(run[axis], run["regret"]) for run in self.runs]
        known = [(x[keep], y[keep]) for x, y in known if (keep := np.isfinite(x) & np.isfinite(y)).sum() > 1]
        if len(known) < len(self.runs):
            none = np.zeros(0)
            return none, none, none, none
        grid = np.linspace(max(x[0] for x, _ in known), min(x[-1] for x, _ in known), _POINTS)
        return grid, *_middle_and_band(np.array([np.interp(grid, x, y) for x, y in known]))

    def final(self, name: str) -> np.ndarray:
        """(n,) the last value of each seed."""
        return np.array([run[name][-1] for run in self.runs])


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """(..., m) mean of the middle half of (..., n, m) values over n."""
    return scipy.stats.trim_mean(values, 0.25, axis=-2)


def _middle_and_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interquartile mean of (n, m) values over n, and low and high of its 95 % percentile bootstrap interval, (m,) each."""
    chosen = np.random.default_rng(0).integers(len(values), size=(_RESAMPLES, len(values)))
    low, high = np.percentile(interquartile_mean(values[chosen]), [2.5, 97.5], axis=0)
    return interquartile_mean(values), low, high


def read_curves(paths: Sequence[Path]) -> list[LearningCurve]:
    """A curve for each learner and settings in folders: runs, or folders of runs.

    Runs that differ in their seeds alone are of one curve. Where a learner has several on a task, folders tell them apart.

    Raises:
        ValueError: a folder holds none, or a run's files are damaged.
    """
    groups: dict[tuple[str, str, str], list[tuple[Path, dict[str, np.ndarray]]]] = {}
    for path in paths:
        found = sorted(path.glob("evaluations.csv")) or sorted(path.glob("*/evaluations.csv"))
        if not found:
            raise ValueError(
                f"{path} holds no training, and neither do the folders in it; give folders of ballbot train"
            )
        for file in found:
            kind, columns = _read_run(file.parent)
            groups.setdefault(kind, []).append((file.parent, columns))
    kinds = [(task, learner) for task, learner, _ in groups]
    curves = []
    for (task, learner, _), members in groups.items():
        name = label(learner)
        if kinds.count((task, learner)) > 1:
            own, _ = members[0]
            name += f", {own.parent.name if own.name.startswith('seed-') else own.name}"
        curves.append(LearningCurve(name, learner, task, tuple(columns for _, columns in members)))
    return curves


def _read_run(folder: Path) -> tuple[tuple[str, str, str], dict[str, np.ndarray]]:
    """Task, learner and settings, as JSON text, of a training, and its columns as in `LearningCurve.runs`."""
    config = files.read_json(folder / "config.json")
    try:
        text = files.read(folder / "evaluations.csv").decode()
        rows = list(csv.DictReader(text.splitlines()))
        names = [name for name in rows[0] if name is not None]
        columns = {name: np.array([float(row[name]) for row in rows]) for name in names}
        columns["minutes"] = columns["cpu_seconds"] / 60
        columns["regret"] = columns["cost_ratio"] - 1
        return (config["task"], config["learner"], json.dumps(config["settings"], sort_keys=True)), columns
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise ValueError(f"{folder} holds no training of ballbot train, or a damaged one: {error!r}") from error


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


def summary(curves: Sequence[LearningCurve]) -> list[dict[str, str]]:
    """Rows of a table: where each curve ends."""
    rows = []
    for curve in curves:
        regret, steps = curve.final("regret"), np.median(curve.final("env_steps"))
        middle, low, high = (float(value[0]) for value in _middle_and_band(regret[:, None]))
        rows.append(
            {
                "task": curve.task,
                "curve": curve.label,
                "seeds": f"{len(curve.runs)}",
                "env steps": "–" if math.isnan(steps) else f"{steps:,.0f}",
                "minutes": f"{np.median(curve.final('minutes')):.1f}",
                "regret: IQM [95 %]": f"{middle:.4g} [{low:.4g}, {high:.4g}]",
                "median": f"{np.median(regret):.4g}",
                "worst": f"{regret.max():.4g}",
                "success": f"{np.median(curve.final('success')):.1%}",
                "failures": f"{np.median(curve.final('failures')):.0f}",
            }
        )
    return rows
