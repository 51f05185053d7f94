"""Controllers on the certified episodes of a task, and the leaderboard."""

import csv
import io
import json
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from ballbot_baselines.controller import Controller, rollout
from ballbot_baselines.optimum import PlanError
from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv
from ballbot_train.controllers import make_controller


@dataclass(frozen=True)
class Result:
    """One certified episode under one controller; SI units, angles in degrees."""

    task: str
    controller: str
    episode: int
    physics: str
    cost: float
    optimum: float
    success: bool
    failure: bool
    peak_tilt: float
    settle_time: float
    duration: float
    plan_seconds: float
    step_seconds: float
    note: str = ""
    """Why there is no trajectory: the message of the controller that found no plan."""

    @property
    def regret(self) -> float:
        """cost / optimum − 1; NaN for a failed episode, whose cost is a price and not a performance."""
        return math.nan if self.failure else self.cost / self.optimum - 1


@dataclass(frozen=True)
class Row:
    """A leaderboard row. Regret, peak tilt and settle time are of the episodes that did not fail."""

    task: str
    controller: str
    episodes: int
    success: float
    falls: int
    regret_mean: float
    regret_median: float
    cost_mean: float
    cost_median: float
    peak_tilt_median: float
    settle_time_median: float
    plan_ms_median: float
    step_us_median: float


def evaluate_episodes(task: str, controller: str, physics: str, episodes: Iterable[int]) -> list[Result]:
    """Runs certified episodes, by index, under a controller by name; see `make_controller`."""
    env = BallbotEnv(task, physics=physics)
    results = run_episodes(env, make_controller(controller, env.task, env.params), controller, task, episodes)
    env.close()
    return results


def run_episodes(
    env: BallbotEnv, controller: Controller, name: str, task: str, episodes: Iterable[int]
) -> list[Result]:
    """Runs certified episodes under any controller; one that finds no plan has failed the episode."""
    episode_set = certified.load(env.task)
    results = []
    for i in episodes:
        optimum = float(episode_set.costs[i])
        common = {"task": task, "controller": name, "episode": i, "physics": env.physics, "optimum": optimum}
        try:
            run = rollout(env, controller, options=episode_set.options(i))
        except PlanError as error:
            outcome = {"cost": env.task.failure_cost, "success": False, "failure": True, "note": str(error)}
            measures = dict.fromkeys(("peak_tilt", "settle_time", "duration", "plan_seconds", "step_seconds"), math.nan)
        else:
            outcome = {"cost": run.cost, "success": run.success, "failure": run.failure}
            measures = {
                "peak_tilt": math.degrees(run.peak_tilt),
                "settle_time": run.settle_time,
                "duration": run.trajectory.duration,
                "plan_seconds": run.reset_seconds,
                "step_seconds": run.act_seconds,
            }
        results.append(Result(**common, **outcome, **measures))
    return results


def summarize(results: list[Result]) -> Row:
    """The leaderboard row of one controller on one task."""
    standing = [result for result in results if not result.failure]

    def median(values: Iterable[float]) -> float:
        finite = [value for value in values if math.isfinite(value)]
        return float(np.median(finite)) if finite else math.nan

    regrets = [result.regret for result in standing]
    return Row(
        task=results[0].task,
        controller=results[0].controller,
        episodes=len(results),
        success=float(np.mean([result.success for result in results])),
        falls=len(results) - len(standing),
        regret_mean=float(np.mean(regrets)) if regrets else math.nan,
        regret_median=median(regrets),
        cost_mean=float(np.mean([result.cost for result in results])),
        cost_median=median(result.cost for result in results),
        peak_tilt_median=median(result.peak_tilt for result in standing),
        settle_time_median=median(result.settle_time for result in standing),
        plan_ms_median=1e3 * median(result.plan_seconds for result in results),
        step_us_median=1e6 * median(result.step_seconds for result in results),
    )


def benchmark(
    tasks: list[str],
    controllers: list[str],
    episodes: int,
    physics: str,
    out: Path,
    workers: int,
    on_progress: Callable[[str, int], None],
) -> list[Result]:
    """Runs every controller on every task, in parallel processes; what an interrupted run finished is not run again.

    Each chunk of episodes is one file in `out/episodes`, which is written when the chunk is done.
    """
    chunks = [
        (task, controller, physics, range(start, min(start + _CHUNK, episodes)))
        for task in tasks
        for controller in controllers
        for start in range(0, episodes, _CHUNK)
    ]
    results, missing = [], []
    for chunk in chunks:
        path = _chunk_path(out, *chunk)
        if path.exists():
            results += _read_chunk(path)
            on_progress(chunk[0], len(chunk[3]))
        else:
            missing.append(chunk)
    # spawn: a forked child would share PyBullet's clients and CasADi's state with this process
    with ProcessPoolExecutor(max_workers=workers, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(evaluate_episodes, *chunk): chunk for chunk in missing}
        try:
            for future in as_completed(running):
                chunk, done = running[future], future.result()
                files.write(_chunk_path(out, *chunk), json.dumps([asdict(result) for result in done]))
                results += done
                on_progress(chunk[0], len(done))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # else an interrupt would wait for every chunk
            raise
    order = {(task, controller): i for i, (task, controller, *_) in enumerate(chunks)}
    return sorted(results, key=lambda result: (order[result.task, result.controller], result.episode))


_CHUNK = 10  # episodes


def _chunk_path(out: Path, task: str, controller: str, physics: str, episodes: range) -> Path:
    return out / "episodes" / f"{task}-{controller}-{physics}-{episodes.start:03d}-{episodes.stop:03d}.json"


def _read_chunk(path: Path) -> list[Result]:
    return [Result(**entry) for entry in json.loads(path.read_text())]


def leaderboard(results: list[Result]) -> list[Row]:
    """One row per task and controller, in the order of the results."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.task, result.controller), []).append(result)
    return [summarize(group) for group in groups.values()]


def write_leaderboard(rows: list[Row], results: list[Result], about: dict[str, object], out: Path) -> None:
    """Writes leaderboard.csv, leaderboard.json and episodes.csv."""
    files.write(out / "leaderboard.csv", _csv(rows))
    files.write(out / "episodes.csv", _csv(results))
    # NaN is no JSON: what does not exist is null
    table = [{key: _or_null(value) for key, value in asdict(row).items()} for row in rows]
    files.write(out / "leaderboard.json", json.dumps({"about": about, "rows": table}, indent=1))


def _csv(entries: list) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(entries[0])], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(entry) for entry in entries)
    return text.getvalue()


def _or_null(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_names(kind: str, names: list[str], known: Iterable[str]) -> None:
    """Raises a ValueError for a name that is not registered."""
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"unknown {kind} {', '.join(unknown)}; known: {', '.join(known)}")
