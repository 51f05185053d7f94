"""A policy on thousands of fresh episodes: how often it fails, what it costs, and in which episodes.

Fresh episodes are drawn with a seed, and none of them is certified. They all run at once in the batched closed-form model, in
double precision. A mean over them hides nothing: `FreshResult.bins` gives success and cost for every range of every quantity
that `Task.measures` names, and `FreshResult.worst` the worst episodes.

Seeds give disjoint sets, the same on every machine, and the first n episodes of a set are the set of n episodes. The set on
which training chooses a policy is drawn for another purpose, and so shares no episode with them.
"""

import itertools
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from ballbot_gym import files
from ballbot_gym.certified import cache
from ballbot_gym.env import make_task
from ballbot_gym.lazy import imports_of
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_gym.registry import name_of
from ballbot_gym.robot import PAPER, Randomization, named_robot
from ballbot_gym.rollout import ActionController, Controller, PlanError
from ballbot_gym.step import limit_names
from ballbot_gym.tasks import Task
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector.batch import BallbotBatch, BatchState
from ballbot_gym.vector.episodes import BatchEpisodes, run_episodes
from ballbot_train.evaluation.controllers import ControllerName, _senses, as_controller
from ballbot_train.evaluation.results import near_share, to_json, warn_of_small
from ballbot_train.evaluation.statistics import Interval
from ballbot_train.policy.layers import with_compiled_layers
from ballbot_train.policy.network import PolicyController, PolicyNetwork
from ballbot_train.work import jobs
from ballbot_train.work.executors import Workers, completed

with imports_of(__name__):
    import torch

EPISODES = 10_000
"""Fresh episodes by default."""

_MOST_EPISODES = 1_000_000
_BATCH = 2500  # episodes that run at once
_PURPOSES = {"evaluation": 0, "validation": 1, "training": 2}
_DISCRETE = 12  # values; a quantity with no more than these gets a bin for each of them
_PER_BIN = 125  # episodes of a bin on average
_MOST_BINS = 80


@dataclass(frozen=True)
class _Summary:
    """What a policy does on fresh episodes, in numbers. Intervals are Wilson's, of 95 %."""

    episodes: int
    success: float
    """Share of the episodes."""
    success_low: float
    success_high: float
    failures: int
    """Episodes that ended at a violated limit."""
    failures_per_10000: float
    failures_per_10000_low: float
    failures_per_10000_high: float
    failed_by: dict[str, int]
    """Failures by the limit that was violated: tilt, obstacle or arena."""
    cost_mean: float
    """Of all episodes, a failure's price included, as the next three."""
    cost_median: float
    cost_p99: float
    cost_worst: float
    near: float
    """Share of the episodes that ended in the goal or near it, within `results.NEAR` times its tolerances."""
    optima: int = 0
    """Episodes whose optimum is known: of those that did not fail, the regrets."""
    regret_mean: float = math.nan
    regret_median: float = math.nan
    regret_p99: float = math.nan
    regret_worst: float = math.nan


@dataclass(frozen=True)
class FreshResult:
    """n fresh episodes of a task under one policy. Arrays have one entry per episode."""

    task: Task
    policy: str
    seed: int
    states: np.ndarray
    """(n, 8) initial states."""
    constants: np.ndarray
    """(n, nc)."""
    costs: np.ndarray
    """(n,) costs, the price of a failure included."""
    success: np.ndarray
    """(n,) bool."""
    failure: np.ndarray
    """(n,) bool."""
    violated: tuple[str, ...]
    """The limit at which each episode ended, or ""."""
    durations: np.ndarray
    """(n,) s."""
    goal_errors: np.ndarray
    """(n,) how far from the goal the episodes ended, in units of its tolerances: at most 1 in the goal."""
    measures: dict[str, np.ndarray]
    """The result of `Task.measures` for each episode."""
    optima: np.ndarray
    """(k,) optimal costs of the first k ≤ n episodes; NaN where none was found."""
    drawn: np.ndarray
    """(n, 6 or 14) what a randomization drew for the episodes, or (n, 0)."""
    robot: str = PAPER
    """By name."""
    randomization: Randomization = Randomization()
    """Parameters hidden from the policy."""

    def __len__(self) -> int:
        return len(self.costs)

    @property
    def regrets(self) -> np.ndarray:
        """(m,) cost / optimum − 1 of the episodes that did not fail and whose optimum is known."""
        k = len(self.optima)
        regrets = (self.costs[:k] / self.optima - 1)[~self.failure[:k]]
        return regrets[np.isfinite(regrets)]

    def summary(self) -> _Summary:
        """The numbers. Warns as `results.leaderboard`."""
        warn_of_small(self.optima)
        n, failures = len(self), int(self.failure.sum())
        success = int(self.success.sum())
        success_low, success_high = Interval.of_share(success, n)
        failures_low, failures_high = Interval.of_share(failures, n)
        kinds = [name.partition(" ")[0] for name in self.violated if name]  # "obstacle 3" is an obstacle
        return _Summary(
            episodes=n,
            success=success / n,
            success_low=success_low,
            success_high=success_high,
            failures=failures,
            failures_per_10000=1e4 * failures / n,
            failures_per_10000_low=1e4 * failures_low,
            failures_per_10000_high=1e4 * failures_high,
            failed_by={kind: kinds.count(kind) for kind in sorted(set(kinds))},
            **_spread("cost", self.costs),
            near=near_share(self.goal_errors, self.failure),
            optima=int(np.isfinite(self.optima).sum()),
            **_spread("regret", self.regrets),
        )

    def bins(self) -> list[dict[str, Any]]:
        """Success, failures and mean cost, a failure's price included, by equally wide ranges of every measure.

        A measure has a range per 125 episodes, 4 to 80; one with few values has one for each. Empty ranges are left out.
        """
        rows, count = [], min(max(len(self) // _PER_BIN, 4), _MOST_BINS)
        for name, values in self.measures.items():
            distinct = np.unique(values)
            few = len(distinct) <= _DISCRETE
            lows = distinct if few else np.linspace(distinct[0], distinct[-1], count, endpoint=False)
            highs = distinct if few else np.append(lows[1:], distinct[-1])
            number = np.searchsorted(lows, values, side="right") - 1
            for i in np.unique(number):
                chosen = number == i
                row = {"measure": name, "low": float(lows[i]), "high": float(highs[i]), "episodes": int(chosen.sum())}
                row |= {"success": float(self.success[chosen].mean()), "failures": int(self.failure[chosen].sum())}
                rows.append(row | {"cost_mean": float(self.costs[chosen].mean())})
        return rows

    def worst(self, count: int = 10) -> list[int]:
        """The indices of the worst episodes: those without success first, and then those with the highest cost."""
        return np.lexsort((-self.costs, -priced(self.costs, self.success, self.task)))[:count].tolist()

    def with_optima(self, count: int, workers: int | Workers) -> "FreshResult":
        """The same with the optima of its first `count` episodes, NaN where none was found. They stay in the user's cache."""
        task, params, varied = self.task, named_robot(self.robot), self.randomization
        name = name_of(task) or task.id
        work = [
            jobs.Job(f"{i:06d}", _optimum, (task, params, x, c, varied, tuple(drawn.tolist())), (i,), name)
            for i, (x, c, drawn) in enumerate(zip(self.states[:count], self.constants, self.drawn, strict=False))
        ]
        found = jobs.run(work, cache.folder(task, params, varied) / f"fresh-{self.seed}", workers)
        return replace(self, optima=np.array([entry["cost"] for (entry,) in found]))

    def episode(self, i: int) -> dict[str, Any]:
        """What episode i was and how it ended, as a line of a table."""
        ending = self.violated[i] or ("" if self.success[i] else "goal missed")
        return {
            "episode": i,
            "cost": float(self.costs[i]),
            "success": bool(self.success[i]),
            "failure": bool(self.failure[i]),
            "failed": ending,
            "duration": float(self.durations[i]),
            "goal_error": float(self.goal_errors[i]),
            **{name: float(values[i]) for name, values in self.measures.items()},
        }

    def write(self, worst: Sequence[Mapping[str, Any]], facts: Mapping[str, Any], out: Path) -> None:
        """Writes fresh.json, with the facts as "about", summary, bins and worst episodes; and bins, worst and fresh.csv.

        fresh.csv has a line for each episode.
        """
        bins = self.bins()
        document = {"about": facts, "summary": [self.summary()], "bins": bins, "worst": list(worst)}
        files.write(out / "fresh.json", to_json(document))
        files.write_csv(out / "bins.csv", bins)
        flat = ("start", "constants")  # lists, which are in the JSON file
        files.write_csv(out / "worst.csv", [{key: entry[key] for key in entry if key not in flat} for entry in worst])
        files.write_csv(out / "fresh.csv", [self.episode(i) for i in range(len(self))])


def _spread(name: str, values: np.ndarray) -> dict[str, float]:
    """Mean, median, 99th percentile and largest under their names in a Summary; nothing where there is no value."""
    if not len(values):
        return {}
    of = {"mean": values.mean(), "median": np.median(values), "p99": np.percentile(values, 99), "worst": values.max()}
    return {f"{name}_{key}": float(value) for key, value in of.items()}


def priced(costs: np.ndarray, success: np.ndarray, task: Task) -> np.ndarray:
    """(n,) costs, in which an episode without success costs at least as much as failing at once."""
    return np.where(success, costs, np.maximum(costs, task.survival_pay))


def draw(
    task: Task,
    episodes: Iterable[int],
    seed: int,
    purpose: Literal["evaluation", "validation", "training"] = "evaluation",
    robot: str = PAPER,
    randomization: Randomization = Randomization(),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Initial states (n, 8) and constants (n, nc) of fresh episodes, and what a randomization draws for them, (n, 6 or 14),
    or (n, 0) where it draws nothing.

    Args:
        task: the task.
        episodes: their numbers.
        seed: of the set.
        purpose: what the set is for; sets for different purposes share no episode.
        robot: by name.
        randomization: what robots and actuators are drawn from.
    """
    rng, params, drawn = partial(_rng, task, seed, purpose), named_robot(robot), []
    for i in episodes:
        z = tuple(rng(i, 1).random(randomization.most_draws).tolist()) if randomization.varies_episodes else ()
        drawn.append((*task.sample(rng(i), params), randomization.draw(z, task.control_dt) if z else ()))
    x, c, robots = map(np.array, zip(*drawn, strict=True))
    return x, c, robots


def numbers_of(task: Task, episodes: Iterable[int], seed: int) -> np.ndarray:
    """The uniform numbers (n, k) that `draw` turns into constants and initial states, for a task that does not sample in
    its own way; see `Task.sample`.
    """
    count = task.constant_draws + task.state_draws
    return np.stack([_rng(task, seed, "evaluation", int(i)).random(count) for i in episodes])


def _rng(task: Task, seed: int, purpose: str, *key: int) -> np.random.Generator:
    """The generator of an episode."""
    entropy = zlib.crc32(task.id.encode())
    return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=(_PURPOSES[purpose], seed, *key)))


def run_policy(
    policy: Any,
    task: Task,
    x: np.ndarray,
    c: np.ndarray,
    drawn: np.ndarray,
    robot: str = PAPER,
    randomization: Randomization = Randomization(),
    dtype: torch.dtype = torch.float32,
    margins: bool = False,
) -> BatchEpisodes:
    """Runs B episodes under a policy, all at once in the batched closed-form model.

    Args:
        policy: a policy file, a saved model, the name of a shipped policy, perhaps followed by that of a filter, a model with
            Stable-Baselines3's `predict`, or a function of tensors such as a `PolicyNetwork`. It gets float32. A function of
            one observation works as well, and is slower.
        task: the task.
        x: (B, 8) initial states.
        c: (B, nc) constants.
        drawn: what `draw` gives for the episodes.
        robot: by name.
        randomization: what varies.
        dtype: in which the model computes.
        margins: same as for `run_episodes`.

    Raises:
        ValueError: nothing of that name, or a controller that does not run in the batch.
        PolicyError: a policy file that is damaged or of another task.
        TypeError: it is none of these.
    """
    policy = _network_of(_acting(policy, task, robot))
    world: dict[str, Any] = {"randomization": randomization, "history": getattr(policy, "history", 0)}
    acts = isinstance(policy, ActionController) or callable(policy)
    plain = acts and not world["history"] and randomization == Randomization()
    batch: Any = make_envs(len(x), task, plain, dtype=dtype, robot=robot, **world).batch
    return run_episodes(batch, _act(policy, batch), x, c, drawn if drawn.shape[1] else None, margins)


def make_envs(num_envs: int, task: Task, plain: bool, **settings: Any) -> BallbotVectorEnv:
    """Envs in machine code where nothing varies and the task's can be made, and else in torch without compiling, which takes
    longer than most runs.

    Args:
        num_envs: B.
        task: the task.
        plain: whether nothing varies, and no past is seen.
        settings: other arguments of `BallbotVectorEnv`.
    """
    if plain:
        try:
            return BallbotVectorEnv(num_envs, task, engine="native", **settings)
        except (ImportError, NoMachineCodeError):
            pass
    return BallbotVectorEnv(num_envs, task, engine="torch", compile=False, **settings)


def _acting(policy: Any, task: Task, robot: str) -> Any:
    """What acts in many episodes at once: a Controller, or a function of tensors."""
    params = named_robot(robot)
    if isinstance(policy, str | Path):
        name = ControllerName(str(policy))
        controller = None if name.is_expert else name.make(task, params)
        if controller is None or _senses(controller):
            what = "an expert" if controller is None else "behind the filter of sensors"
            raise ValueError(
                f"{policy} is {what}, which acts in one episode at a time, and fresh episodes run all at once; give a "
                "policy, or run it on certified episodes with ballbot benchmark"
            )
        return controller
    if callable(getattr(policy, "predict", None)):
        return as_controller(policy, task, params)
    if not callable(policy):
        raise TypeError(
            f"{policy!r} is not a policy: give a name, a file, a model with predict, or a function of tensors"
        )
    return policy


def _network_of(policy: Any) -> Any:
    """The network of a policy, with its layers in machine code; anything else as it is."""
    network = policy.network if isinstance(policy, PolicyController) else policy
    if not isinstance(network, PolicyNetwork) or (network is not policy and network.spec.informed):
        return policy
    return with_compiled_layers(network)


def _act(policy: Any, batch: BallbotBatch) -> Callable[[torch.Tensor], torch.Tensor]:
    """What acts as a function from observations (B, no) to actions (B, 2), for one episode of each environment of a batch."""
    if isinstance(policy, ActionController):
        begins = itertools.chain([True], itertools.repeat(False))
        return lambda seen: torch.as_tensor(policy.action(seen.float().numpy(), next(begins)), device=seen.device)
    if not callable(policy):
        return _behind_filter(policy, batch)
    if isinstance(policy, PolicyNetwork) and policy.spec.informed:
        return lambda seen: policy.knowing(seen.float(), cast(BatchState, batch.state), batch.randomization)
    function: Any = policy
    return lambda seen: _asked(function, seen.float(), batch.params.action_size)


def _asked(function: Any, seen: torch.Tensor, actions: int) -> torch.Tensor:
    """Actions (B, actions) of a function of tensors (B, no), or of one that takes a single observation (no,) as on certified
    episodes; that one is called for each row.
    """
    shape = (len(seen), actions)
    try:
        given = function(seen)
        if isinstance(given, torch.Tensor) and given.shape == shape:
            return given
        reason: Exception | None = None
    except (TypeError, ValueError, RuntimeError, IndexError) as error:
        given, reason = None, error
    try:
        single = np.stack([np.asarray(function(row), np.float32).reshape(-1) for row in seen.cpu().numpy()])
    except (TypeError, ValueError, RuntimeError, IndexError) as error:
        raise reason or error from None
    if single.shape != shape:
        raise reason or ValueError(
            f"the policy gives {tuple(getattr(given, 'shape', ()))} for observations {tuple(seen.shape)}; give actions "
            f"{shape} for all of them, or ({actions},) for one observation"
        )
    return torch.as_tensor(single, device=seen.device)


def _behind_filter(controller: Controller, batch: BallbotBatch) -> Callable[[torch.Tensor], torch.Tensor]:
    """The controller as a function of observations. It ignores them, and takes the readings of the batch's sensors."""
    steps = itertools.count()

    def act(observation: torch.Tensor) -> torch.Tensor:
        assert batch.state is not None
        x, t = batch.sensed(batch.state).T.double().numpy(), next(steps) * batch.task.control_dt
        if t == 0:
            controller.reset(t, x, batch.state.c.T.double().numpy())
        return torch.from_numpy(controller.act(t, x) / batch.params.force_limit)

    return act


def evaluate_fresh(
    policy: Any,
    task: str | Task = "stabilize",
    episodes: int = EPISODES,
    seed: int = 0,
    name: str | None = None,
    on_progress: Callable[[int], None] = lambda count: None,
    robot: str = PAPER,
    randomization: Randomization | str | None = None,
    workers: int | Workers = 1,
) -> FreshResult:
    """Runs a policy on fresh episodes.

    Args:
        policy: see `run_policy`.
        task: a name in `TASKS`, or a Task.
        episodes: how many.
        seed: of the episodes.
        name: of the policy in the result; default, its own.
        on_progress: called with a number of finished episodes.
        robot: by name.
        randomization: parameters hidden from the policy, or a name in `TRACKS`; default, none.
        workers: where the episodes run; for more than this process the policy must be a name or a file. A few
            run here.

    Raises:
        TypeError, ValueError, PolicyError: no such policy or task, or a number out of its range.
    """
    task, params, varied = make_task(task, robot), named_robot(robot), Randomization.checked(randomization)
    check_fresh(policy, task, episodes, seed, robot)
    numbers = [range(episodes)[start : start + _BATCH] for start in range(0, episodes, _BATCH)]
    problem = (policy, task, robot, varied, seed)
    found: dict[int, _Part] = {}
    workers = workers if len(numbers) > 1 else 1  # a few run sooner than processes start
    for start, part in completed(((each.start, _part, (*problem, each)) for each in numbers), workers):
        found[start] = part
        on_progress(len(part.states))
    parts = [found[start] for start in sorted(found)]
    states, constants, drawn = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("states", "constants", "drawn")
    )
    runs = [part.run for part in parts]
    vary = {
        name: row
        for name, row in zip((*Randomization.DRAWN, *Randomization.DISPLACED), drawn.T, strict=False)
        if np.ptp(row) > 0
    }
    names = limit_names(task, params)
    violated = torch.cat([run.violated for run in runs]).tolist()
    return FreshResult(
        task=task,
        policy=name or (str(policy) if isinstance(policy, str | Path) else type(policy).__name__),
        seed=seed,
        states=states,
        constants=constants,
        costs=torch.cat([run.cost for run in runs]).numpy(),
        success=torch.cat([run.success for run in runs]).numpy(),
        failure=torch.cat([run.failure for run in runs]).numpy(),
        violated=tuple(names[number] if number >= 0 else "" for number in violated),
        durations=torch.cat([run.steps for run in runs]).numpy() * task.control_dt,
        goal_errors=torch.cat([run.goal_error for run in runs]).numpy(),
        measures={key: np.concatenate([part.measures[key] for part in parts]) for key in parts[0].measures} | vary,
        optima=np.zeros(0),
        drawn=drawn,
        robot=robot,
        randomization=varied,
    )


class _Part(NamedTuple):
    """Some of the fresh episodes, as in `FreshResult`."""

    states: np.ndarray
    constants: np.ndarray
    drawn: np.ndarray
    run: BatchEpisodes
    measures: dict[str, np.ndarray]


def _part(policy: Any, task: Task, robot: str, varied: Randomization, seed: int, numbers: range) -> _Part:
    """Episodes of the given numbers."""
    states, constants, drawn = draw(task, numbers, seed, robot=robot, randomization=varied)
    run = run_policy(policy, task, states, constants, drawn, robot, varied, torch.float64)
    described = [task.measures(x, c, named_robot(robot)) for x, c in zip(states, constants, strict=True)]
    measures = {key: np.array([entry[key] for entry in described]) for key in described[0]}
    return _Part(states, constants, drawn, run, measures)


def check_fresh(policy: Any, task: Task, episodes: int, seed: int, robot: str = PAPER) -> None:
    """Raises the error of `run_policy` for what is no policy, and a ValueError for a number that is out of its range."""
    if not 1 <= episodes <= _MOST_EPISODES:
        raise ValueError(f"the number of fresh episodes must be 1 to {_MOST_EPISODES:,}, not {episodes}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed must be 0 to {2**32 - 1}, not {seed}")
    _acting(policy, task, robot)


def _optimum(*problem: Any) -> Iterator[jobs.Entry]:
    """Of one episode, which is named last."""
    from ballbot_baselines.optimum.certification import optimum_of  # it imports CasADi

    try:
        yield {"cost": optimum_of(*problem[:-1]).cost}
    except PlanError:
        yield {"cost": math.nan}
