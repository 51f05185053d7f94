"""The worst starts of a policy: a search in the set of all starts of a task.

A policy that fails in none of 10,000 fresh episodes may still fail from some start. An episode is a function of uniform
random numbers, so each episode is a point of a cube. A search begins at a hard episode. It moves its point by random steps,
and keeps the moves that make the episode harder: by more regret, by a missed goal, and at last by a failure. The steps
become smaller from round to round. From the hardest ends, gradient ascent goes on: its slopes are differences, because a
policy's cost and the optimum both depend on the start.
"""

import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_baselines import find_optima, find_optimum
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import Randomization, named_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.fresh import FreshResult, numbers_of, priced, run_policy
from ballbot_train.work.executors import Workers, completed

with imports_of(__name__):
    import torch

SEARCHES = 1000
ROUNDS = 30
_CONSIDERED = 10  # times as many episodes as searches; searches begin at the hardest of them
_LARGEST, _SMALLEST = 0.1, 0.003  # standard deviations of the steps in the unit cube, in the first and the last round
_TOGETHER = 100  # searches of a task of a worker
_CHECKED = 2  # of these, how many end with an optimum that was searched for as those of certified episodes are
_CLIMBING = 20  # of the ends of all searches, from how many gradient ascent goes on
_CLIMBS, _FIRST_CLIMB = 6, 0.01  # steps of gradient ascent, and the length of the first one in the unit cube
_DIFFERENCE = 1e-4  # in the unit cube, for slopes
_MISSED, _FAILED = 1e6, 2e6  # how hard an episode without success is, and one that fails; no regret is as large


@dataclass(frozen=True)
class Starts:
    """n episodes of a policy."""

    numbers: np.ndarray
    """(n, k) in [0, 1): the task makes an episode of each row."""
    states: np.ndarray
    """(n, 8) initial states."""
    constants: np.ndarray
    """(n, nc)."""
    costs: np.ndarray
    """(n,) the price of a failure included."""
    optima: np.ndarray
    """(n,) optimal costs; NaN where none was found."""
    success: np.ndarray
    """(n,) bool."""
    failure: np.ndarray
    """(n,) bool."""

    @property
    def regrets(self) -> np.ndarray:
        """(n,) cost / optimum − 1, NaN without success."""
        return np.where(self.success, self.costs / self.optima - 1, np.nan)

    @property
    def hardness(self) -> np.ndarray:
        """(n,) the regret of an episode with success; where its optimum is not known, less than any."""
        regrets = np.nan_to_num(self.regrets, nan=-1.0)
        return np.where(self.failure, _FAILED, np.where(self.success, regrets, _MISSED))

    def at(self, chosen: Any) -> "Starts":
        """Some of them, by an index of NumPy."""
        return Starts(**{name: values[chosen] for name, values in vars(self).items()})


def hard_starts(
    policy: Any,
    result: FreshResult,
    workers: int | Workers = 1,
    on_progress: Callable[[int], None] = lambda count: None,
    searches: int = SEARCHES,
    rounds: int = ROUNDS,
) -> tuple[Starts, Starts]:
    """Searches for worse starts than those of fresh episodes. The same seed gives the same starts.

    Args:
        policy: what ran in the fresh episodes; see `fresh.run_policy`.
        result: the fresh episodes, without a randomization.
        workers: where the episodes run; for more than this process the policy must be a name or a file.
        on_progress: called with a number of finished searches.
        searches: how many; each begins at another one of the hardest fresh episodes.
        rounds: how many steps each search tries.

    Returns:
        Where the searches began and where they ended, the hardest end first.

    Raises:
        ValueError: the task draws its episodes in another way than by `draw_constants` and `draw_state`, or the
            episodes have hidden parameters.
    """
    task = result.task
    check_searchable(task, result.randomization)

    def done(
        function: Callable[..., Starts], parts: list[Any], progress: Callable[[int], None], *others: Any
    ) -> Starts:
        """What a function makes of all parts."""
        work = ((k, function, (policy, task, result.robot, part, *others)) for k, part in enumerate(parts))
        found: dict[int, Starts] = {}
        for k, made in completed(work, workers if len(parts) > 1 else 1):
            found[k] = made
            progress(len(made.costs))
        return _joined([found[k] for k in range(len(parts))])

    expensive = np.argsort(-priced(result.costs, result.success, task), kind="stable")[: _CONSIDERED * searches]
    numbers = numbers_of(task, expensive, result.seed)
    began = done(_run, [numbers[chunk] for chunk in _chunks(len(numbers))], lambda count: None)
    began = began.at(np.argsort(-began.hardness, kind="stable")[:searches])
    parts = [began.at(chunk) for chunk in _chunks(len(began.costs))]
    ended = done(_search, parts, on_progress, rounds, result.seed)
    order = np.argsort(-ended.hardness, kind="stable")
    began, ended = began.at(order), ended.at(order)
    climbed = _climb(policy, task, result.robot, ended.at(slice(_CLIMBING)))
    ended = _joined([climbed, ended.at(slice(_CLIMBING, None))])
    order = np.argsort(-ended.hardness, kind="stable")
    return began.at(order), ended.at(order)


def _chunks(count: int) -> list[slice]:
    return [slice(k, k + _TOGETHER) for k in range(0, count, _TOGETHER)]


def check_searchable(task: Task, randomization: Randomization) -> None:
    """Raises a ValueError where episodes are no functions of uniform numbers, or have hidden parameters."""
    if randomization.active:
        raise ValueError("a search for hard starts needs a robot without hidden parameters; leave out --randomization")
    if type(task).sample is not Task.sample or task.constant_draws + task.state_draws == 0:
        raise ValueError(
            f"{type(task).__name__} does not draw its episodes by draw_constants and draw_state alone, so there is no set "
            "of starts to search in"
        )


def _search(policy: Any, task: Task, robot: str, now: Starts, rounds: int, seed: int) -> Starts:
    """Where searches from some starts end: the same in whichever process they run."""
    rng = np.random.default_rng([seed, zlib.crc32(now.numbers.tobytes())])
    n = np.arange(len(now.costs))
    for step in np.geomspace(_LARGEST, _SMALLEST, rounds):
        moved = now.numbers + step * rng.standard_normal(now.numbers.shape)
        moved = np.minimum(1 - np.abs(1 - np.abs(moved)), np.nextafter(1.0, 0.0))  # reflected at both ends
        tried = _run(policy, task, robot, moved)
        now = _joined([now, tried]).at(n + len(n) * (tried.hardness > now.hardness))
    return _checked(task, robot, now)


def _climb(policy: Any, task: Task, robot: str, now: Starts) -> Starts:
    """Where gradient ascent goes from some starts."""
    n, k = now.numbers.shape
    most, length = np.nextafter(1.0, 0.0), np.full(n, _FIRST_CLIMB)
    for _ in range(_CLIMBS):
        # (2, k, n, k): each number of each start a little higher, and a little lower
        near = np.array([[now.numbers + sign * each for each in _DIFFERENCE * np.eye(k)] for sign in (1, -1)])
        near = np.clip(near, 0.0, most)
        high, low = _run(policy, task, robot, near.reshape(-1, k)).hardness.reshape(2, k, n)
        slopes = ((high - low) / (near[0] - near[1]).sum(axis=-1)).T
        slopes /= np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), np.finfo(float).tiny)
        moved = np.clip(now.numbers + length[:, None] * slopes, 0.0, most)
        tried = _run(policy, task, robot, moved)
        harder = tried.hardness > now.hardness
        now = _joined([now, tried]).at(np.arange(n) + n * harder)
        length *= np.where(harder, 2.0, 1 / 3)
    return _checked(task, robot, now)


def _checked(task: Task, robot: str, starts: Starts) -> Starts:
    """The starts, where the hardest ones have an optimum that was searched for as those of certified episodes are."""
    for i in np.argsort(-starts.hardness, kind="stable")[:_CHECKED]:
        with suppress(PlanError):
            cost = find_optimum(task, robot, starts.states[i], starts.constants[i], twice=True).cost
            starts.optima[i] = np.fmin(starts.optima[i], cost)
    return starts


def _joined(parts: Sequence[Starts]) -> Starts:
    return Starts(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def _run(policy: Any, task: Task, robot: str, numbers: np.ndarray) -> Starts:
    """The episodes of numbers (n, k)."""
    params, few = named_robot(robot), task.constant_draws
    constants = [task.draw_constants(tuple(row[:few]), params) for row in numbers.tolist()]
    states = [task.start(tuple(row[few:]), c, params) for row, c in zip(numbers.tolist(), constants, strict=True)]
    x, c = np.array(states, np.float64), np.array(constants, np.float64).reshape(len(numbers), -1)
    run = run_policy(policy, task, x, c, np.zeros((len(x), 0)), robot, dtype=torch.float64)
    optima = np.array([np.nan if each is None else each.cost for each in find_optima(task, robot, x, c)])
    return Starts(numbers, x, c, run.cost.numpy(), optima, run.success.numpy(), run.failure.numpy())
