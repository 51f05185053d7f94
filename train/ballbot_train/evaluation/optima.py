"""Optima on demand: certified sets where there are some; else the optima that are needed, computed into the user's cache.

Importing this module is light: CasADi is imported when an optimum is computed.
"""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

from ballbot_gym import certified
from ballbot_gym.certified import cache
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.lazy import imports_of
from ballbot_gym.registry import name_of
from ballbot_gym.robot import PAPER, Randomization, Robot, file_name, robot_name
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.checks import check_methods, check_paths
from ballbot_train.work import jobs
from ballbot_train.work.console import console, progress_bars
from ballbot_train.work.executors import Workers, completed

with imports_of(__name__):
    import filelock


_TASKS = 32  # at least, so that many workers have something to do


def known(
    task: str | Task,
    robot: str | Robot = PAPER,
    episodes: Iterable[int] | None = None,
    workers: int | Workers = 1,
    randomization: Randomization = Randomization(),
) -> certified.EvaluationSet:
    """The evaluation set of a task and a robot, with the optima of some episodes at least. What is missing is computed.

    Args:
        task: a name in `TASKS`, or any Task.
        robot: a name in `ROBOTS`, or any Robot.
        episodes: their indices; default, the first 200.
        workers: processes that compute, or `Workers`.
        randomization: what the robots and actuators of the episodes are drawn from.

    Raises:
        PlanError: an episode has no optimum that can be found.
        ValueError: no task or robot of that name, or no optimum is known under such a randomization.
    """
    task, params = make_task(task, robot), robot_of(task, robot)
    if not randomization.moves_optima:
        randomization = Randomization()
    needed = range(certified.EPISODES) if episodes is None else list(episodes)
    try:
        return certified.load(task, params, episodes=needed, randomization=randomization)
    except certified.CertificateError:
        if randomization.actuator_lag[1] > 0:
            raise
        compute(task, params, needed, workers, randomization=randomization)
        return certified.load(task, params, episodes=needed, randomization=randomization)


def compute(
    task: Task,
    params: Robot,
    episodes: Iterable[int],
    workers: int | Workers = 1,
    randomization: Randomization = Randomization(),
) -> None:
    """Computes the optima of episodes that the user's cache lacks. Each is kept as soon as it is found.

    Another process that computes optima of the same problem is waited for, and its optima are taken.

    Args:
        task: and params: the problem.
        episodes: their indices.
        workers: processes that compute, or `Workers`.
        randomization: see `known`.

    Raises:
        PlanError: an episode has no optimum; all others are kept.
        ValueError: a method of the task gives what no optimizer can use; the message names it.
    """
    needed = list(dict.fromkeys(episodes))
    folder = cache.folder(task, params, randomization)
    jobs.RunFolder(folder).make()
    lock = filelock.FileLock(folder / "computing.lock")
    try:
        held = lock.acquire(timeout=0)
    except filelock.Timeout:
        console.print(f"another process computes optima of {task.id}; waiting for it")
        held = lock.acquire()
    failures = []
    with held:
        missing = [i for i in needed if certified.from_cache(task, params, [i], randomization) is None]
        if not missing:
            return
        name = f"optima of {file_name(name_of(task) or type(task).__name__, robot_name(params))}"
        with progress_bars({name: len(missing)}) as advance:
            from ballbot_baselines.optimum.certification import AT_ONCE

            each = min(AT_ONCE, -(-len(missing) // _TASKS))
            parts = (missing[k : k + each] for k in range(0, len(missing), each))
            work = ((part, _solved, (task, params, part, randomization)) for part in parts)
            solved = (
                [_solve(task, params, missing, randomization)]
                if Workers.of(workers).here == 1
                else (entries for _, entries in completed(work, workers))
            )
            for index, found in itertools.chain.from_iterable(solved):
                advance(name, 1)
                if isinstance(found, str):
                    failures.append(f"episode {index}: {found}")
                else:
                    found.save(task, cache.path(task, params, index, randomization), params, randomization)
    if failures:
        raise PlanError(
            f"no optimum of {task.id} for\n"
            + "\n".join(failures)
            + f"\nLook whether {type(task).__name__}.goal can be reached "
            "from what draw_state draws within duration and margins, and whether guess_paths leads there"
        )


def _check_start(task: Task, params: Robot, index: int) -> None:
    """Raises a ValueError that names the method of a task with which an episode cannot even begin."""
    kind, where = type(task).__name__, f"at the start of episode {index}"
    x, c = cache.episode(task, params, index)
    check_methods(task, params, x, c, where)
    if violated := task.violated(x, task.at(c, 0.0)):  # as a state does that is not finite
        raise ValueError(f"{kind}.draw_state draws {x.tolist()} {where}, which is beyond the limit of {violated}")
    check_paths(task, params, x, c, where)


def _solve(
    task: Task, params: Robot, episodes: list[int], randomization: Randomization
) -> Iterator[tuple[int, certified.EvaluationSet | str]]:
    """`certification.entries` of some episodes. Starts are checked just before they are solved, because that takes a while
    for thousands of them.
    """
    from ballbot_baselines.optimum.certification import entries

    def checked() -> Iterator[int]:
        for index in episodes:
            _check_start(task, params, index)
            yield index

    return entries(task, checked(), params, randomization)


def _solved(*problem: Any) -> list[tuple[int, certified.EvaluationSet | str]]:
    return list(_solve(*problem))
