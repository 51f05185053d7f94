"""Proves that certified optima are strict local minima of the problem as the environment computes it: all of them, in files.

`ballbot prove --check` proves those of the first episodes and writes no file. The theorem is at the top of
`ballbot_baselines/proofs/local_minimum.py`, and a reader who trusts nothing reads that file and `intervals.py` next to it.

It writes enclosures.csv with a line for each episode, and prints a line for each task. It ends with exit status 1 if an
optimum was not proven. An interrupted run continues in its folder.
"""

import sys
from pathlib import Path

import tyro

from ballbot_baselines.proofs.minima import _lines, _summary
from ballbot_gym import certified, files
from ballbot_gym.tasks import TASKS
from ballbot_train.work import jobs

_TOGETHER = 20  # episodes of a job


def main(
    tasks: tuple[str, ...] = tuple(TASKS),
    episodes: int = certified.EPISODES,
    out: Path = Path("runs/enclosures"),
    workers: int = 1,
) -> None:
    """Proves the certified optima of the paper's robot.

    Args:
        tasks: names of tasks.
        episodes: the first of each certified set.
        out: folder of the results; an interrupted run continues here.
        workers: processes.
    """
    folder = jobs.RunFolder(out)
    folder.claim({"tasks": tasks, "episodes": episodes})
    work = [
        jobs.Job(
            f"{name}-{first:03d}",
            _lines,
            (name,),
            tuple(range(first, min(first + _TOGETHER, episodes))),
            f"minima of {name}",
        )
        for first in range(0, episodes, _TOGETHER)
        for name in tasks
    ]
    rows = [entry for part in jobs.run(work, out, workers) for entry in part]
    rows.sort(key=lambda row: (tasks.index(row["task"]), row["episode"]))
    names = list(dict.fromkeys(name for row in rows for name in row))
    files.write_csv(out / "enclosures.csv", [{name: row.get(name) for name in names} for row in rows])
    for name in tasks:
        print(_summary(name, [row for row in rows if row["task"] == name]))
    folder.release()
    if not all(row["proven"] for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
