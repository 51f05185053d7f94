"""Controllers on the certified episodes of a task, and the leaderboard.

`evaluate(policy, task)` gives one row for anything that acts; `benchmark` runs everything, in parallel and resumably.
"""

import csv
import hashlib
import io
import json
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.rollout import ActionController, Controller, PlanError, rollout
from ballbot_gym.tasks import TASKS, Task
from ballbot_train import jobs
from ballbot_train.console import about
from ballbot_train.evaluation import controllers as registry
from ballbot_train.evaluation.statistics import interval
from ballbot_train.policy import read_about, shipped_policies


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
    effort: float = math.nan
    """Mean of |F| over the episode, N."""
    note: str = ""
    """Why there is no trajectory: the message of the controller that found no plan."""

    @property
    def regret(self) -> float:
        """cost / optimum − 1; NaN for a failed episode, whose cost is a price and not a performance."""
        return math.nan if self.failure else self.cost / self.optimum - 1


@dataclass(frozen=True)
class Row:
    """A leaderboard row. Regret, peak tilt, settle time and effort are of the episodes that did not fail."""

    task: str
    controller: str
    episodes: int
    success: float
    falls: int
    regret_mean: float
    regret_low: float
    """Of the mean's 95 % bootstrap interval."""
    regret_high: float
    regret_median: float
    cost_mean: float
    cost_median: float
    peak_tilt_median: float
    settle_time_median: float
    effort_mean: float
    """Mean of |F|, N."""
    plan_ms_median: float
    step_us_median: float
    recovered: float = math.nan
    """Share of the physically recoverable states from which it recovers, where `ballbot basins` measured it."""


def as_controller(policy: Any, task: Task, params: BallbotParams) -> Controller:
    """Anything that acts, as a Controller.

    Args:
        policy: a Controller; a Stable-Baselines3 model, whose VecNormalize is applied where it was trained with one; a
            function from observation (no,) float32 to action (2,) in [−1, 1]; or a name or file for `make_controller`.
        task: what it is to do.
        params: the robot that it believes to control.

    Raises:
        TypeError: it is none of these.
        ValueError, PolicyError: as `make_controller`.
    """
    if isinstance(policy, str | Path):
        return registry.make_controller(str(policy), task, params)
    if callable(getattr(policy, "reset", None)) and callable(getattr(policy, "act", None)):
        return policy
    if callable(getattr(policy, "predict", None)):
        return ActionController(task, params, _Predictor(policy))
    if callable(policy):
        return ActionController(task, params, lambda observation, begins: policy(observation))
    raise TypeError(
        f"{policy!r} is no policy: give a Controller, a model with predict, a function of the observation, a name or a file"
    )


class _Predictor:
    """An SB3 model's deterministic action, with its recurrent state and the normalization that it was trained with."""

    def __init__(self, model: Any):
        self._model, self._state = model, None
        normalization = getattr(model, "get_vec_normalize_env", lambda: None)()
        self._seen = (lambda observation: observation) if normalization is None else normalization.normalize_obs

    def __call__(self, observation: np.ndarray, begins: bool) -> np.ndarray:
        action, self._state = self._model.predict(
            self._seen(observation),
            state=None if begins else self._state,
            episode_start=np.array([begins]),
            deterministic=True,
        )
        return action


def evaluate(
    policy: Any,
    task: str | Task = "stabilize",
    episodes: int | Iterable[int] = certified.EPISODES,
    physics: str = "bullet",
    name: str | None = None,
    randomization: Randomization | None = None,
) -> Row:
    """The leaderboard row of anything that acts.

    Args:
        policy: see `as_controller`: a Stable-Baselines3 model, a function of the observation, a Controller, the name of a
            controller ("lqr", "trajopt", "nmpc") or a policy file.
        task: a name in `TASKS`, or a Task that has a certified set.
        episodes: how many of the certified episodes, from the first, or their indices.
        physics: "bullet" or "rk4".
        name: of the row; default, the policy's own.
        randomization: what disturbs it; default, nothing.

    Raises:
        TypeError, ValueError: no such policy, task or physics.
        CertificateError: the task has no certified set.
    """
    env = BallbotEnv(task, physics=physics, randomization=randomization)
    try:
        controller = as_controller(policy, env.task, env.params)
        indices = range(episodes) if isinstance(episodes, int) else episodes
        results = run_episodes(env, controller, name or _name(policy), task_name(env.task), indices)
        return summarize(results)
    finally:
        env.close()


def _name(policy: Any) -> str:
    return str(policy) if isinstance(policy, str | Path) else getattr(policy, "__name__", type(policy).__name__.lower())


def task_name(task: Task) -> str:
    """The task's name in `TASKS`."""
    return next(name for name, kind in TASKS.items() if type(task) is kind)


def run_episodes(
    env: BallbotEnv, controller: Controller, name: str, task: str, episodes: Iterable[int], seed: int = 0
) -> list[Result]:
    """Runs certified episodes under any controller; one that finds no plan has failed the episode.

    Args:
        env: what to run in.
        controller: what acts.
        name: of the controller, in the results.
        task: the task's name, in the results.
        episodes: their indices.
        seed: of what the env's randomization draws, episode i with seed + i.
    """
    return list(_iterate_episodes(env, controller, name, task, episodes, seed))


def _iterate_episodes(
    env: BallbotEnv, controller: Controller, name: str, task: str, episodes: Iterable[int], seed: int
) -> Iterator[Result]:
    episode_set = certified.load(env.task)
    for i in episodes:
        optimum = float(episode_set.costs[i])
        common = {"task": task, "controller": name, "episode": i, "physics": env.physics, "optimum": optimum}
        try:
            run = rollout(env, controller, seed=seed + i, options=episode_set.options(i))
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
                "effort": float(np.hypot(*run.trajectory.u.T).mean()),
            }
        yield Result(**common, **outcome, **measures)


def summarize(results: Sequence[Result], seed: int = 0) -> Row:
    """The leaderboard row of one controller on one task; seed is of the bootstrap."""
    standing = [result for result in results if not result.failure]

    def median(values: Iterable[float]) -> float:
        finite = [value for value in values if math.isfinite(value)]
        return float(np.median(finite)) if finite else math.nan

    regrets = [result.regret for result in standing]
    low, high = interval(regrets, seed)
    return Row(
        task=results[0].task,
        controller=results[0].controller,
        episodes=len(results),
        success=float(np.mean([result.success for result in results])),
        falls=len(results) - len(standing),
        regret_mean=float(np.mean(regrets)) if regrets else math.nan,
        regret_low=low,
        regret_high=high,
        regret_median=median(regrets),
        cost_mean=float(np.mean([result.cost for result in results])),
        cost_median=median(result.cost for result in results),
        peak_tilt_median=median(result.peak_tilt for result in standing),
        settle_time_median=median(result.settle_time for result in standing),
        effort_mean=float(np.mean([result.effort for result in standing])) if standing else math.nan,
        plan_ms_median=1e3 * median(result.plan_seconds for result in results),
        step_us_median=1e6 * median(result.step_seconds for result in results),
    )


def controllers_of(tasks: Sequence[str], names: Sequence[str] = ()) -> dict[str, list[str]]:
    """The controllers to run on each task: those named that the task has; without names, all it has.

    A policy is made for one task, and is left out for the others; tasks left without a controller are left out too.

    Raises:
        ValueError: a name that none of the tasks has.
        PolicyError: a policy file that is missing or damaged.
    """
    check_names("task", tasks, TASKS)
    known = {task: registry.names(make_task(task)) for task in tasks}
    if not names:
        return known
    made_for = {name: read_about(name)["spec"]["task"] for name in names if Path(name).suffix}
    chosen = {
        task: [
            name
            for name in names
            if (made_for[name] == repr(make_task(task)) if name in made_for else name in known[task])
        ]
        for task in tasks
    }
    unused = [name for name in names if not any(name in group for group in chosen.values())]
    if unused:
        every = dict.fromkeys(name for group in known.values() for name in group)
        if unused[0] in made_for:
            raise ValueError(f"{unused[0]} was made for {made_for[unused[0]]}, which is none of {', '.join(tasks)}")
        check_names("controller", unused, every)
    return {task: group for task, group in chosen.items() if group}


def policy_digests(controllers: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """SHA-256 of the weights of every learned policy among controllers by task, under "TASK/NAME"."""
    digests = {}
    for task, group in controllers.items():
        shipped = shipped_policies(make_task(task))
        for name in group:
            if name not in CONTROLLERS:
                weights = Path(shipped.get(name, name)).with_suffix(".safetensors")
                digests[f"{task}/{name}"] = hashlib.sha256(weights.read_bytes()).hexdigest()
    return digests


def begin(out: Path, controllers: Mapping[str, Sequence[str]], workers: int, **settings: Any) -> dict[str, Any]:
    """Claims a folder for a run of controllers by task with some settings; returns the facts that its results name.

    Raises:
        ValueError: the folder holds an unfinished run with other settings, policies or code.
    """
    settings["policies"] = policy_digests(controllers)
    facts = about() | settings | {"workers": workers}
    jobs.claim(out, {key: facts[key] for key in ("version", "commit", *settings)})
    return facts


def checked_episodes(episodes: int, quick: bool, few: int) -> int:
    """How many certified episodes to run: `few` at most if quick.

    Raises:
        ValueError: there are not so many.
    """
    if not 1 <= episodes <= certified.EPISODES:
        raise ValueError(f"episodes must be 1 to {certified.EPISODES}, not {episodes}")
    return min(episodes, few) if quick else episodes


def benchmark(
    controllers: Mapping[str, Sequence[str]],
    episodes: int,
    physics: str,
    out: Path,
    workers: int,
    on_progress: Callable[[str, int], None],
    seed: int = 0,
) -> list[Result]:
    """Runs the controllers of every task, in parallel processes; what an interrupted run finished is not run again.

    Args:
        controllers: names by task, as `controllers_of` gives.
        episodes: how many of each task's certified ones.
        physics: "bullet" or "rk4".
        out: folder of the results.
        workers: processes.
        on_progress: called with a task and a number of finished episodes.
        seed: of whatever is drawn.
    """
    work = [
        episode_job(task, name, physics, range(start, min(start + _CHUNK, episodes)), seed)
        for task, group in controllers.items()
        for name in group
        for start in range(0, episodes, _CHUNK)
    ]
    return [Result(**entry) for entries in jobs.run(work, out, workers, on_progress) for entry in entries]


_CHUNK = 5  # episodes of a job


def episode_job(
    task: str,
    controller: str,
    physics: str,
    episodes: range,
    seed: int,
    randomization: Randomization | None = None,
    label: str = "",
    group: str = "",
) -> jobs.Job:
    """Some certified episodes under a controller by name, as a job whose entries are the fields of Results.

    The label tells jobs apart that differ in their randomization; progress counts for the group, or else the task.
    """
    what = f"{task}-{controller}-{physics}-{label}"
    slug = "".join(sign if sign.isalnum() else "-" for sign in what)
    return jobs.Job(
        name=f"{slug[-80:]}{zlib.crc32(what.encode()):08x}-{episodes.start:03d}-{episodes.stop:03d}",
        function=_episode_entries,
        arguments=(task, controller, physics, seed, randomization),
        items=tuple(episodes),
        group=group or task,
    )


def _episode_entries(
    task: str, controller: str, physics: str, seed: int, randomization: Randomization | None, episodes: Sequence[int]
) -> Iterator[jobs.Entry]:
    env = BallbotEnv(task, physics=physics, randomization=randomization)
    made = registry.make_controller(controller, env.task, env.params)
    for result in _iterate_episodes(env, made, controller, task, episodes, seed):
        yield asdict(result)
    env.close()


def leaderboard(results: Sequence[Result], seed: int = 0) -> list[Row]:
    """One row per task and controller, in the order of the results; seed is of the bootstrap."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.task, result.controller), []).append(result)
    return [summarize(group, seed) for group in groups.values()]


def write_leaderboard(rows: Sequence[Row], results: Sequence[Result], about: dict[str, object], out: Path) -> None:
    """Writes leaderboard.csv, episodes.csv and leaderboard.json, which holds about, rows and episodes."""
    files.write(out / "leaderboard.csv", to_csv(rows))
    files.write(out / "episodes.csv", to_csv(results))
    files.write(out / "leaderboard.json", to_json({"about": about, "rows": rows, "episodes": results}))


def read_results(path: Path) -> tuple[dict[str, Any], list[Result]]:
    """What a benchmark's facts and episodes were.

    Args:
        path: its folder, its leaderboard.json or its episodes.csv, which holds no facts.

    Raises:
        ValueError: it is none of these.
    """
    path = Path(path)
    path = path / "leaderboard.json" if path.is_dir() else path
    try:
        if path.suffix == ".csv":
            with path.open(newline="") as file:
                return {}, [_from_csv(entry) for entry in csv.DictReader(file)]
        document = json.loads(path.read_text())
        entries = [
            {key: math.nan if value is None else value for key, value in entry.items()}
            for entry in document["episodes"]
        ]
        return document["about"], [Result(**entry) for entry in entries]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} holds no episodes of a benchmark: {error!r}") from error


def _from_csv(entry: Mapping[str, str]) -> Result:
    kinds = {field.name: field.type for field in fields(Result)}
    read = {str: str, int: int, float: float, bool: lambda text: text == "True"}
    return Result(**{key: read[kinds[key]](value) for key, value in entry.items()})


def to_csv(entries: Sequence[Any]) -> str:
    """Dataclass instances of one kind as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(entries[0])], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(entry) for entry in entries)
    return text.getvalue()


def to_json(document: Mapping[str, Any]) -> str:
    """A document as JSON; its lists of dataclass instances become lists of objects, one a line, with null for NaN."""

    def line(entry: Any) -> str:
        return json.dumps({key: _or_null(value) for key, value in asdict(entry).items()}, ensure_ascii=False)

    def text(value: Any) -> str:
        if isinstance(value, list | tuple) and value and hasattr(value[0], "__dataclass_fields__"):
            return "[\n  " + ",\n  ".join(map(line, value)) + "\n ]"
        return json.dumps(value, ensure_ascii=False)

    return "{\n" + ",\n".join(f" {json.dumps(key)}: {text(value)}" for key, value in document.items()) + "\n}\n"


def _or_null(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def check_names(kind: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raises a ValueError for a name that is not registered."""
    known = list(known)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"unknown {kind} {', '.join(unknown)}; known: {', '.join(known)}")


HEADER = [
    "task",
    "controller",
    "success",
    "falls",
    "regret mean",
    "regret median",
    "peak tilt",
    "settle",
    "mean force",
    "recovered",
    "plan",
    "per step",
]


def cells(row: Row) -> list[str]:
    """A row as text, under `HEADER`; behind the mean regret its interval, per cent; what does not exist is a dash."""

    def shown(value: float, form: str, unit: str = "") -> str:
        return format(value, form) + unit if math.isfinite(value) else "–"

    ends = f" ({100 * row.regret_low:.2f} to {100 * row.regret_high:.2f})" if math.isfinite(row.regret_low) else ""
    return [
        row.task,
        row.controller,
        f"{100 * row.success:.1f} %",
        f"{row.falls}/{row.episodes}",
        shown(row.regret_mean, ".2%") + ends,
        shown(row.regret_median, ".2%"),
        shown(row.peak_tilt_median, ".1f", "°"),
        shown(row.settle_time_median, ".2f", " s"),
        shown(row.effort_mean, ".0f", " N"),
        shown(row.recovered, ".0%"),
        shown(row.plan_ms_median, ".0f", " ms"),
        shown(row.step_us_median, ".0f", " µs"),
    ]
