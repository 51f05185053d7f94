"""How often, how fast and how globally the optimum of a freshly drawn episode is found.

For every task: `draws` episodes, the share whose optimum is found (violation < 1e-6), the solve time, and those without one
with the solver's status. For Weave also: the share of optima that pass obstacles on both sides, and what an exhaustive
search over all choices of sides finds beyond the default search. Writes CSV files below `out`.
"""

import itertools
import time
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from ballbot_baselines.optimum import find_optimum
from ballbot_gym import files
from ballbot_gym.params import default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.weave import sides_passed, split_constants

console = Console()


def coverage(name: str, draws: int, seed: int) -> dict[str, object]:
    """The row of a task; prints the episodes without an optimum."""
    task, params, rng = TASKS[name](), default_params(), np.random.default_rng(seed)
    seconds, costs, both_sides, failed = [], [], [], 0
    find_optimum(task, params, *task.sample(rng, params))  # compiles, and builds solvers
    for index in track(range(draws), description=name):
        x0, c = task.sample(rng, params)
        start = time.perf_counter()
        try:
            optimum = find_optimum(task, params, x0, c)
        except PlanError as error:
            failed += 1
            console.print(f"{name} draw {index}: {error}")
            continue
        seconds.append(time.perf_counter() - start)
        costs.append(optimum.cost)
        if name == "weave":
            both_sides.append(len(set(sides_passed(optimum.trajectory.x[:, :2], c))) == 2)
    return {
        "task": name,
        "draws": draws,
        "found": f"{1 - failed / draws:.4f}",
        "seconds_median": f"{np.median(seconds):.4f}",
        "seconds_p99": f"{np.percentile(seconds, 99):.4f}",
        "seconds_max": f"{np.max(seconds):.4f}",
        "cost_median": f"{np.median(costs):.3f}",
        "cost_max": f"{np.max(costs):.3f}",
        "both_sides": f"{np.mean(both_sides):.3f}" if both_sides else "",
    }


def exhaustive(episodes: int, seed: int) -> list[dict[str, object]]:
    """The rows of Weave episodes: the default search's cost, and the best over every choice of sides."""
    task, params, rng = TASKS["weave"](), default_params(), np.random.default_rng(seed)
    rows = []
    for index in track(range(episodes), description="exhaustive"):
        x0, c = task.sample(rng, params)
        goal, obstacles = split_constants(c)
        found = find_optimum(task, params, x0, c).cost
        best = found
        for sides in itertools.product((-1, 1), repeat=len(obstacles)):
            try:
                # a single path is solved in full, without the coarse comparison that the default search begins with
                path = task.side_path(x0, goal, obstacles, sides)
                best = min(best, find_optimum(task, params, x0, c, paths=[path]).cost)
            except PlanError:
                continue
        rows.append(
            {
                "episode": index,
                "obstacles": len(obstacles),
                "found": f"{found:.6f}",
                "best": f"{best:.6f}",
                "gap": f"{found / best - 1:.6f}",
            }
        )
    return rows


def main(
    draws: int = 500,
    exhaustive_episodes: int = 30,
    tasks: tuple[str, ...] = tuple(TASKS),
    seed: int = 2026,
    out: Path = Path("runs/optimum_coverage"),
) -> None:
    """Runs both studies."""
    table = [coverage(name, draws, seed) for name in tasks]
    console.print(files.write_csv(out / "coverage.csv", table).read_text())
    if "weave" in tasks and exhaustive_episodes:
        rows = exhaustive(exhaustive_episodes, seed + 1)
        files.write_csv(out / "exhaustive.csv", rows)
        gaps = np.array([float(str(row["gap"])) for row in rows])
        console.print(f"exhaustive search gains more than 0.5 % in {(gaps > 0.005).sum()} of {len(gaps)} episodes")


if __name__ == "__main__":
    tyro.cli(main)
