"""Optima per second of `find_optima`, many episodes at once, compared with `find_optimum`, on fresh episodes of each task.

Times are of the processor, of one process, so that a busy machine spoils them less. Run it with OMP_NUM_THREADS=1. Both solve
the same episodes in turns, some at a time. Compiling is left out.
"""

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro

from ballbot_baselines import find_optima, find_optimum
from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.robot import default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation import fresh

_ACCURATE = 1e-4  # relative
_TURN = 200  # episodes that each solves before the other's turn: a set of certificates


@dataclass(frozen=True)
class Row:
    """A task: milliseconds per episode, how many times as many per second as one by one, and how accurate they are."""

    task: str
    episodes: int
    one_by_one_milliseconds: float
    milliseconds: float
    speedup: float
    solved: float
    accurate: float
    """Share of those solved whose cost is at most 1e-4 above that of `find_optimum`."""
    worst: float
    """Greatest excess over `find_optimum`, relative."""
    best: float
    """The same of the least, negative where `find_optima` found a cheaper one."""


def measured(name: str, episodes: int, seed: int) -> Row:
    """Solves the same episodes in both ways."""
    task, params = make_task(name), default_params()
    x0, c, _ = fresh.draw(task, range(episodes), seed, "training", "paper")
    find_optimum(task, params, x0[0], c[0])  # compiles
    find_optima(task, params, x0[:1], c[:1])
    costs, alone, seconds = np.full(episodes, np.nan), np.full(episodes, np.nan), np.zeros(2)
    for first in range(0, episodes, _TURN):
        rows, begin = range(first, min(first + _TURN, episodes)), time.process_time()
        for i in rows:
            try:
                found = find_optimum(task, params, x0[i], c[i])
                alone[i] = found.cost if found.is_optimal else math.nan
            except PlanError as error:
                print(f"{name}, episode {i}: {error}")
        seconds[0] += time.process_time() - begin
        begin = time.process_time()
        optima = find_optima(task, params, x0[rows], c[rows])
        costs[rows] = [math.nan if optimum is None else optimum.cost for optimum in optima]
        seconds[1] += time.process_time() - begin
    excess = (costs / alone - 1)[np.isfinite(costs) & np.isfinite(alone)]
    return Row(
        task=name,
        episodes=episodes,
        one_by_one_milliseconds=1e3 * seconds[0] / episodes,
        milliseconds=1e3 * seconds[1] / episodes,
        speedup=seconds[0] / seconds[1],
        solved=float(np.isfinite(costs).mean()),
        accurate=float((excess < _ACCURATE).mean()),
        worst=float(excess.max()),
        best=float(excess.min()),
    )


def main(episodes: int = 400, seed: int = 0, out: Path = Path("runs/batched_optima")) -> None:
    """Measures, and writes batched_optima.csv.

    Args:
        episodes: of each task.
        seed: of the episodes.
        out: folder of the results.
    """
    rows = [measured(name, episodes, seed) for name in TASKS]
    for row in rows:
        print(
            f"{row.task:10s} {row.one_by_one_milliseconds:7.2f} and {row.milliseconds:6.2f} ms, {row.speedup:5.1f} times, "
            f"{row.solved:.2%} solved, {row.accurate:.2%} within 1e-4, {row.best:+.2%} to {row.worst:+.3%}"
        )
    files.write_csv(out / "batched_optima.csv", [asdict(row) for row in rows])
    print(f"written to {out}")


if __name__ == "__main__":
    tyro.cli(main)
