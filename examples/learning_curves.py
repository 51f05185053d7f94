"""Learning curves over seeds: `python examples/learning_curves.py --runs runs/five runs/ten`, each a folder of runs.

The line is the interquartile mean over the seeds of a folder, and the band their 95 % bootstrap interval (Agarwal et al.,
"Deep reinforcement learning at the edge of the statistical precipice", 2021). It ends where the first of the seeds ends.
"""

import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro
from scipy.stats import trim_mean

POINTS, RESAMPLES = 100, 2000


def read(folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Minutes of one core, and mean regrets on the certified episodes, of each run.

    In these means, an episode without success counts at least as much as an immediate failure.
    """
    runs = []
    for path in sorted(folder.glob("*/evaluations.csv")):
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        minutes, ratios = (np.array([float(row[name]) for row in rows]) for name in ("cpu_seconds", "cost_ratio"))
        runs.append((minutes / 60, ratios - 1))
    return runs


def main(runs: tuple[Path, ...], out: Path = Path("curves.png")) -> None:
    """Draws a line for each folder, and prints where its seeds end.

    Args:
        runs: folders, each with the runs of several seeds of `ballbot train`.
        out: path of the picture.
    """
    rng = np.random.default_rng(0)
    for folder in runs:
        read_runs = read(folder)
        if not read_runs:
            raise SystemExit(f"{folder} holds no runs: give folders of folders that ballbot train wrote")
        minutes = np.linspace(max(t[0] for t, _ in read_runs), min(t[-1] for t, _ in read_runs), POINTS)
        regrets = np.array([np.interp(minutes, *run) for run in read_runs])
        drawn = trim_mean(regrets[rng.integers(len(regrets), size=(RESAMPLES, len(regrets)))], 0.25, axis=1)
        (line,) = plt.plot(minutes, trim_mean(regrets, 0.25), label=f"{folder.name} ({len(regrets)} seeds)")
        plt.fill_between(minutes, *np.percentile(drawn, [2.5, 97.5], axis=0), color=line.get_color(), alpha=0.2)
        last = np.array([regret[-1] for _, regret in read_runs])
        print(f"{folder}: median {np.median(last):.2%}, worst {last.max():.2%} of {len(last)} seeds")
    plt.yscale("log")
    plt.xlabel("minutes of one core")
    plt.ylabel("mean regret")
    plt.legend()
    plt.savefig(out, dpi=110)
    print(out)


if __name__ == "__main__":
    tyro.cli(main)
