"""Searches certified episodes from thousands of random guesses, to see whether a motion exists that costs less.

The guesses are random detours of the task's paths and of the best known motion, of random length where an episode ends in a
goal, and random recoveries where it ends at rest. It writes multistart.csv with a line for each episode, and prints a line
for each robot and task. An interrupted run continues in its folder.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tyro

from ballbot_baselines.optimum.batched import multistart
from ballbot_gym import certified, files
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_train.work import jobs

_TOGETHER = 40  # episodes of a job
_SAME = 1e-3  # relative: solutions whose costs differ by less count as the certified one
_LOWER = 1e-4  # relative: what counts as a motion that costs less; tolerances of the solvers are far below


def searched(robot: str, name: str, guesses: int, indices: Sequence[int]) -> Iterator[jobs.Entry]:
    """Searches certified episodes."""
    task, params = make_task(name, robot), named_robot(robot)
    known = certified.load(task, robot)
    rows = list(indices)
    found, costs = multistart(task, params, known.states[rows], known.constants[rows], guesses)
    for i, optimum, tried in zip(rows, found, costs.T, strict=True):
        certificate, best = float(known.costs[i]), np.inf if optimum is None else optimum.cost
        yield {
            "robot": robot,
            "task": name,
            "episode": i,
            "guesses": guesses,
            "certified": certificate,
            "found": best if np.isfinite(best) else None,
            "solved": int(np.isfinite(tried).sum()),
            "reached": int((tried < min(best, certificate) * (1 + _SAME)).sum()),
            "basins": len(np.unique(np.round(np.log(tried[np.isfinite(tried)]) / _SAME))),
        }


def main(
    tasks: tuple[str, ...] = tuple(TASKS),
    robots: tuple[str, ...] = (PAPER, "rolling", "kugle"),
    guesses: int = 2000,
    episodes: int = certified.EPISODES,
    out: Path = Path("runs/multistart"),
    workers: int = 1,
) -> None:
    """Searches the certified episodes of robots and tasks.

    Args:
        tasks: names of tasks.
        robots: names of robots without wheels.
        guesses: random guesses of each episode.
        episodes: the first of each certified set.
        out: folder of the results; an interrupted run continues here.
        workers: processes.
    """
    folder = jobs.RunFolder(out)
    folder.claim({"tasks": tasks, "robots": robots, "guesses": guesses, "episodes": episodes})
    work = [
        jobs.Job(
            f"{robot}-{name}-{first:03d}",
            searched,
            (robot, name, guesses),
            tuple(range(first, min(first + _TOGETHER, episodes))),
            f"{robot} {name}",
        )
        for robot in robots
        for name in tasks
        for first in range(0, episodes, _TOGETHER)
    ]
    rows = [entry for part in jobs.run(work, out, workers) for entry in part]
    files.write_csv(out / "multistart.csv", rows)
    for robot in robots:
        for name in tasks:
            print(_line([row for row in rows if (row["robot"], row["task"]) == (robot, name)], guesses))
    folder.release()


def _line(rows: Sequence[jobs.Entry], guesses: int) -> str:
    certified_costs = np.array([row["certified"] for row in rows])
    found = np.array([np.inf if row["found"] is None else row["found"] for row in rows])
    reached, solved = (np.array([row[name] for row in rows]) for name in ("reached", "solved"))
    change = found / certified_costs - 1
    lower = np.flatnonzero(change < -_LOWER).tolist()
    moved = ", ".join(f"{rows[i]['episode']} by {-change[i]:.2%}" for i in lower)
    return (
        f"{rows[0]['robot']} {rows[0]['task']}: {solved.mean() / guesses:.0%} of {guesses} guesses solved, "
        f"{reached.mean() / guesses:.0%} reach the best, {(reached == 0).sum()} of {len(rows)} episodes not reached again, "
        f"{len(lower)} cost less{f' (episodes {moved})' if moved else ''}"
    )


if __name__ == "__main__":
    tyro.cli(main)
