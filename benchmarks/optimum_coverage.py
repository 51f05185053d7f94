"""How often, how fast and how globally the optimum is found, on fresh episodes of every task.

The first study draws episodes and plans them. Some of Weave are also planned as they were before all sides were considered:
from their five shortest paths. The second study searches other episodes exhaustively, from every guessed path, which is
every choice of sides, and from random detours of the path found. An interrupted run continues in its folder.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import tyro

from ballbot_baselines import Optimum, find_optimum
from ballbot_baselines.optimum.guesses import ALL_GUESSES
from ballbot_gym import files
from ballbot_gym.robot import default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS, Task
from ballbot_gym.tasks.paths import sides_passed
from ballbot_train.work import jobs

_DETOURS = 3
_SHORTEST = 5  # paths of the former search for slaloms
_COMPARED = 200  # episodes of Weave that are also planned from these
_IMPROVED = 1e-3  # relative


def episode(task: Task, seed: int, study: int, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Episode `index` of a study: initial state and constants."""
    return task.sample(np.random.default_rng([seed, study, index]), default_params())


def planned(name: str, seed: int, indices: Sequence[int]) -> Iterator[jobs.Entry]:
    """Plans episodes; times are of the processor, s, and so are those of a busy machine little longer."""
    task, params = TASKS[name](), default_params()
    find_optimum(task, params, *episode(task, seed, 9, 0))  # compiles, and builds solvers
    for i in indices:
        x0, c = episode(task, seed, 0, i)
        start = time.process_time()
        optimum, error = _found(task, x0, c)
        entry: jobs.Entry = {"episode": i, "seconds": time.process_time() - start, "error": error}
        if optimum is not None:
            entry |= {"status": optimum.status, "cost": optimum.cost}
        if optimum is not None and task.passed_obstacles(c) is not None and i < _COMPARED:
            start = time.process_time()
            before = find_optimum(task, params, x0, c, paths=task.guess_paths(x0, c, params)[:_SHORTEST])
            entry |= {"seconds_before": time.process_time() - start, "cost_before": before.cost}
            entry["both_sides"] = (
                len(set(sides_passed(optimum.trajectory.x, np.asarray(task.passed_obstacles(c))))) == 2
            )
        yield entry


def _found(task: Task, x0: np.ndarray, c: np.ndarray) -> tuple[Optimum | None, str]:
    try:
        return find_optimum(task, default_params(), x0, c), ""
    except PlanError as error:
        return None, str(error)


def searched(name: str, seed: int, indices: Sequence[int]) -> Iterator[jobs.Entry]:
    """Searches episodes exhaustively: the default search's cost, and the best of every other search."""
    task, params = TASKS[name](), default_params()
    for i in indices:
        x0, c = episode(task, seed, 1, i)
        found = find_optimum(task, params, x0, c)
        costs = [found.cost]
        rng = np.random.default_rng([seed, 2, i])
        path = found.trajectory.x[:, :2]
        s = np.linspace(0, np.pi, len(path))[:, None]
        detours = [
            path + sum(np.sin(k * s) * rng.normal(scale=0.5 / k, size=2) for k in (1, 2, 3)) for _ in range(_DETOURS)
        ]
        searches = [{"guesses": ALL_GUESSES}, *({"paths": [detour]} for detour in detours)]
        for search in searches:
            try:
                other = find_optimum(task, params, x0, c, **search)
            except PlanError:
                continue
            costs += [other.cost] if other.is_optimal else []
        yield {"episode": i, "found": found.cost, "best": min(costs), "gap": found.cost / min(costs) - 1}


def main(
    draws: int = 2000,
    exhaustive_episodes: int = 200,
    tasks: tuple[str, ...] = tuple(TASKS),
    seed: int = 2026,
    out: Path = Path("runs/optimum_coverage"),
    workers: int = 1,
) -> None:
    """Runs both studies, and writes coverage.csv and exhaustive.csv.

    Args:
        draws: episodes of each task that are planned.
        exhaustive_episodes: episodes of each task that are searched exhaustively.
        tasks: names of tasks.
        seed: of the episodes.
        out: folder of the results; an interrupted run continues here.
        workers: processes.
    """
    jobs.RunFolder(out).claim({"draws": draws, "exhaustive": exhaustive_episodes, "tasks": tasks, "seed": seed})
    studies = ((planned, draws), (searched, exhaustive_episodes))
    work = [
        jobs.Job(
            f"{name}-{study.__name__}-{first:05d}",
            study,
            (name, seed),
            tuple(range(first, min(first + 50, count))),
            name,
        )
        for name in tasks
        for study, count in studies
        for first in range(0, count, 50)
    ]
    done = jobs.run(work, out, workers, lambda group, count: print(f"{group}: {count} more", flush=True))
    table, rows = [], []
    for name in tasks:
        entries = {
            study: [
                entry
                for job, part in zip(work, done, strict=True)
                if job.group == name and job.function is study
                for entry in part
            ]
            for study, _ in studies
        }
        table.append(_row(name, entries[planned]))
        rows += [{"task": name, **entry} for entry in entries[searched]]
    print(files.write_csv(out / "coverage.csv", table).read_text())
    if rows:
        files.write_csv(out / "exhaustive.csv", rows)
        for name in tasks:
            gaps = np.array([row["gap"] for row in rows if row["task"] == name])
            print(
                f"{name}: exhaustive search gains more than 0.1 % in {(gaps > _IMPROVED).sum()} of {len(gaps)} episodes"
            )
    jobs.RunFolder(out).release()


def _row(name: str, entries: Sequence[jobs.Entry]) -> dict[str, object]:
    for entry in entries:
        if entry["error"]:
            print(f"{name} draw {entry['episode']}: {entry['error']}")
    seconds = [entry["seconds"] for entry in entries]
    before = [entry["seconds_before"] for entry in entries if "seconds_before" in entry]
    worse = [entry["cost"] > entry["cost_before"] * (1 + _IMPROVED) for entry in entries if "cost_before" in entry]
    better = [entry["cost"] < entry["cost_before"] * (1 - _IMPROVED) for entry in entries if "cost_before" in entry]
    costs = [entry["cost"] for entry in entries if "cost" in entry]
    return {
        "task": name,
        "draws": len(entries),
        "optimal": f"{np.mean([entry.get('status') == 'optimal' for entry in entries]):.4f}",
        "feasible": sum(entry.get("status") == "feasible" for entry in entries),
        "none": sum(bool(entry["error"]) for entry in entries),
        "seconds_median": f"{np.median(seconds):.4f}",
        "seconds_p95": f"{np.percentile(seconds, 95):.4f}",
        "seconds_max": f"{np.max(seconds):.4f}",
        "seconds_median_before": f"{np.median(before):.4f}" if before else "",
        "seconds_p95_before": f"{np.percentile(before, 95):.4f}" if before else "",
        "cheaper_than_before": sum(better),
        "dearer_than_before": sum(worse),
        "cost_median": f"{np.median(costs):.3f}",
        "cost_max": f"{np.max(costs):.3f}",
        "both_sides": f"{np.mean([entry['both_sides'] for entry in entries if 'both_sides' in entry]):.3f}"
        if before
        else "",
    }


if __name__ == "__main__":
    tyro.cli(main)
