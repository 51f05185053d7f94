"""Searches certified episodes from thousands of random guesses, to see whether a motion exists that costs less.

The guesses are random detours of the task's paths and of the best known motion, of random length where an episode ends in a
goal, and random recoveries where it ends at rest. Every episode is also searched by `find_optimum` alone, to see how often
that misses the best motion. It writes multistart.csv with a line for each episode, and prints a line for each robot and
task. An interrupted run continues in its folder.

Where motions were found that cost less, it writes the certified set with these, for `benchmarks/install_optima.py`. It ends
with exit status 1 if a certified cost is not that of the best motion, up to a few millionths.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from ballbot_baselines import Optimum, find_optimum
from ballbot_baselines.optimum.batched import multistart
from ballbot_gym import Trajectory, certified, files
from ballbot_gym.certified import EvaluationSet
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_train.work import jobs

_TOGETHER = 40  # episodes of a job
_SAME = 1e-3  # relative: solutions whose costs differ by less count as the certified one
_MISSED = 1e-4  # relative: what counts as an optimum that a search misses
_MOVED = 4e-6  # relative: what counts as another optimum; solvers keep small reserves, which cost less


def searched(robot: str, name: str, guesses: int, indices: Sequence[int]) -> Iterator[jobs.Entry]:
    """Searches certified episodes."""
    task, params = make_task(name, robot), named_robot(robot)
    known = certified.load(task, robot)
    rows = list(indices)
    found, costs = multistart(task, params, known.states[rows], known.constants[rows], guesses)
    for i, optimum, tried in zip(rows, found, costs.T, strict=True):
        problem = task, params, known.states[i], known.constants[i]
        alone = find_optimum(*problem, twice=True)
        best = min(alone, find_optimum(*problem, twice=optimum or False), key=lambda each: each.cost)
        yield {
            "robot": robot,
            "task": name,
            "episode": i,
            "guesses": guesses,
            "certified": float(known.costs[i]),
            "found": best.cost,
            "find_optimum": alone.cost,
            "solved": int(np.isfinite(tried).sum()),
            "reached": int((tried < best.cost * (1 + _SAME)).sum()),
            "basins": len(np.unique(np.round(np.log(tried[np.isfinite(tried)]) / _SAME))),
            "motion": _recorded(best) if best.cost < known.costs[i] * (1 - _MOVED) else None,
        }


def _recorded(optimum: Optimum) -> dict[str, Any]:
    """What a certified set has of an optimum."""
    motion = optimum.trajectory
    return {
        "violation": optimum.violation,
        "status": f"{optimum.solver}: {optimum.solver_status}",
        **{name: getattr(motion, name).tolist() for name in ("t", "x", "u")},
    }


def _moved(row: jobs.Entry) -> bool:
    """Whether the certified cost is not that of the best motion."""
    return abs(row["found"] / row["certified"] - 1) > _MOVED


def improved(robot: str, name: str, rows: Sequence[jobs.Entry]) -> EvaluationSet:
    """The certified set, with the motions that cost less."""
    known = certified.load(make_task(name, robot), robot)
    costs, durations, violations, statuses, motions = (
        each.copy() if isinstance(each, np.ndarray) else list(each)
        for each in (known.costs, known.durations, known.violations, known.statuses.astype(object), known.trajectories)
    )
    for row in rows:
        if motion := row["motion"]:
            i, moved = row["episode"], Trajectory(*(np.array(motion[part]) for part in ("t", "x", "u")))
            costs[i], durations[i], violations[i], statuses[i] = (
                row["found"],
                moved.t[-1],
                motion["violation"],
                motion["status"],
            )
            if i < len(motions):
                motions[i] = moved
    return replace(
        known,
        costs=costs,
        ideal=costs,
        durations=durations,
        violations=violations,
        statuses=np.array(statuses, str),
        trajectories=tuple(motions),
    )


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
    shown = [{name: value for name, value in row.items() if name != "motion"} for row in rows]
    files.write_csv(out / "multistart.csv", shown)
    for robot in robots:
        for name in tasks:
            some = [row for row in rows if (row["robot"], row["task"]) == (robot, name)]
            print(_line(some, guesses))
            if any(row["motion"] for row in some):
                task = make_task(name, robot)
                path = improved(robot, name, some).save(task, out / certified.path_of(task, robot).name, robot)
                print(f"  the certified set with the motions that cost less: {path}")
    folder.release()
    if any(map(_moved, rows)):
        sys.exit(1)


def _line(rows: Sequence[jobs.Entry], guesses: int) -> str:
    certified_costs, found, alone, reached, solved = (
        np.array([row[name] for row in rows]) for name in ("certified", "found", "find_optimum", "reached", "solved")
    )
    best_known = np.minimum(found, certified_costs)
    parts = [
        f"{rows[0]['robot']} {rows[0]['task']}: {solved.mean() / guesses:.0%} of {guesses} guesses per episode solved",
        f"{reached.mean() / guesses:.0%} reach the best",
        f"{(reached == 0).sum()} of {len(rows)} episodes not reached by them",
        f"find_optimum misses the best by more than {_MISSED:.2%} in {(alone > best_known * (1 + _MISSED)).sum()}",
        f"{sum(map(_moved, rows))} optima moved",
    ]
    for row, cost, best in zip(rows, certified_costs, found, strict=True):
        if _moved(row):
            parts.append(f"episode {row['episode']} costs {best:.9g}, and {cost:.9g} is certified")
    return ", ".join(parts[:5]) + "".join(f"\n  {part}" for part in parts[5:])


if __name__ == "__main__":
    tyro.cli(main)
