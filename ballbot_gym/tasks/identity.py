"""Digests that tell tasks, robots and observations apart by their content, never by a name.

Each digest covers what is computed and not how: the numbers of a robot, and the values of a task at a few fixed states and
episodes, rounded to nine digits so that machines agree. A comment or a rewritten formula changes nothing.
"""

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from ballbot_gym.robot import Robot, first_of_kind, named_robot
from ballbot_gym.tasks.base import Task

_PROBES = 8  # episodes at which a task is compared
_SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)  # m, rad and per second, of states at which it is compared
_TIMES = (0.0, 0.5, 2.0, 5.0, 7.9)  # s
_DIGITS = 9


def digest(*parts: Any) -> str:
    """24 hexadecimal digits of parts that JSON can hold."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@np.errstate(all="ignore")  # far from every episode a task need not give numbers
def observation_digest(task: Task, params: Robot) -> str:
    """Digest of the observations of a task at fixed states and times, and at constants.

    Of the constants, some are fixed numbers, and some are drawn as the task draws them by default for a shipped robot. So
    robots and tasks with other episodes share a digest where they observe the same.
    """
    rng, names, usual = np.random.default_rng(2), len(task.constant_names), _with_default_fields(task)
    robot = named_robot(first_of_kind(params) if params.OUTPUTS else task.ROBOT)
    digits = []
    for x, time in _anywhere(rng, params):
        drawn = usual.draw_constants(tuple(rng.random(task.constant_draws).tolist()), robot)
        for c in (rng.uniform(1.0, 2.0, names), np.array(drawn, np.float64)):
            digits.append(_rounded(partial(task.seen, params=params), x, np.asarray(task.at(c, time))))
    return digest(digits)


PARTS = ("robot", "fields", "episodes", "costs", "limits", "goal", "observations")
"""Of a problem, each with a digest of its own. A part may change those behind it too."""


@np.errstate(all="ignore")
def problem_parts(task: Task, params: Robot) -> dict[str, str]:
    """Digests of a robot, and of a task's fields, episodes, costs, limits, goal and observations, by `PARTS`.

    Two tasks that share a name and differ in a cost have different digests, and so have two robots of one name.
    """
    probes, rng = list(_probes(task, params)), np.random.default_rng(0)
    goal_reward = [task.goal_reward] if task.goal_reward else []  # digests of tasks without one stay
    values = (
        [task.id, task.problem(), task.survival_reward, task.steps, task.first_exit, *goal_reward],
        [[_digits(part) for part in task.sample(rng, params)] for _ in range(_PROBES)],
        [_rounded(task.cost, *probe) for probe in probes],
        *([_rounded(of, x, c) for x, _, c in probes] for of in (task.limits, task.goal)),
        [_rounded(partial(task.seen, params=params), x, c) for x, _, c in probes],
    )
    return {name: digest(part) for name, part in zip(PARTS, (params.record(), *values), strict=True)}


def problem_digest(task: Task, params: Robot) -> str:
    """One digest of all parts of a problem."""
    return digest(problem_parts(task, params))


def changed_parts(held: Mapping[str, str], wanted: Mapping[str, str]) -> list[str]:
    """Names of the parts of a problem that differ. Those that may follow from a changed robot, or from changed episodes, are
    not named.
    """
    changed = [name for name in PARTS if held.get(name) != wanted.get(name)]
    first = next((name for name in ("robot", "episodes") if name in changed), None)
    return changed if first is None else [name for name in changed if name in (first, "fields")]


def _probes(task: Task, params: Robot) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Fixed states, forces, and constants as `Task.at` gives them: of drawn episodes, near their starts and anywhere."""
    rng = np.random.default_rng(1)
    starts = [task.sample(rng, params) for _ in range(_PROBES)]
    near = [(x + rng.uniform(-0.3, 0.3, x.shape), c, 0.5) for x, c in starts]
    anywhere = [(x, task.sample(rng, params)[1], time) for x, time in _anywhere(rng, params)]
    for x, c, time in (*near, *anywhere):
        yield x, params.force_limit * rng.uniform(-1, 1, params.action_size), np.asarray(task.at(c, time))


def _anywhere(rng: np.random.Generator, params: Robot) -> Iterator[tuple[np.ndarray, float]]:
    """States with components of both signs, near zero and far from it, each with a time, s."""
    for scale, time in itertools.product(_SCALES, _TIMES):
        yield rng.uniform(-scale, scale, params.state_size), time


def _with_default_fields(task: Task) -> Task:
    """A task of the same kind with default fields."""
    try:
        return type(task)()
    except TypeError:  # a field of a user's task has no default
        return task


def _rounded(method: Callable[..., Any], *where: np.ndarray) -> list[str]:
    """What a method of a task gives there, as text; or the error by which it refuses a state that no episode reaches."""
    try:
        return _digits(method(*where))
    except Exception as error:  # of a user's code
        return [type(error).__name__]


def _digits(values: Any) -> list[str]:
    """Numbers as text. Negative zeros, which rounding makes of different signs on other machines, are zeros."""
    return [f"{value + 0.0:.{_DIGITS}g}" for value in np.ravel(np.asarray(values, np.float64)).tolist()]
