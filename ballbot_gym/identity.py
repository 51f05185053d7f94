"""Digests that tell tasks, robots and observations apart by their content, never by a name.

Each digest covers what is computed and not how: the numbers of a robot, and the values of a task at a few fixed states and
episodes, rounded to nine digits so that machines agree. A comment or a rewritten formula changes nothing.
"""

import hashlib
import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import named_robot
from ballbot_gym.tasks import Task

_PROBES = 8  # states and episodes at which a task is compared
_DIGITS = 9


def digest(*parts: Any) -> str:
    """24 hexadecimal digits of parts that JSON can hold."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def robot_digest(params: BallbotParams) -> str:
    """Digest of all numbers of a robot."""
    return digest(repr(params))


def observation_digest(task: Task, params: BallbotParams) -> str:
    """Digest of the observations of a task at fixed states and constants.

    These are not drawn by the task, so that robots with other episodes share a digest where they observe the same.
    """
    rng, digits = np.random.default_rng(2), []
    for _ in range(_PROBES):
        x, c = rng.uniform(0.1, 0.9, params.state_size), rng.uniform(1.0, 2.0, len(task.constant_names))
        digits.append(_rounded(task.seen(x, np.asarray(task.at(c, 0.5)))))
    return digest(digits)


def problem_digest(task: Task, params: BallbotParams) -> str:
    """Digest of a robot and of a task's episodes, costs, limits, goal and observations.

    Two tasks that share a name and differ in a cost have different digests, and so have two robots of one name.
    """
    values = [
        [_rounded([task.cost(x, u, c), *task.limits(x, c), *task.goal(x, c), *np.ravel(task.seen(x, c))])]
        for x, u, c in _probes(task, params)
    ]
    rng = np.random.default_rng(0)
    episodes = [[_rounded(part) for part in task.sample(rng, params)] for _ in range(_PROBES)]
    fields = [task.id, task.problem(), task.survival_reward, task.steps, task.first_exit]
    return digest(fields, robot_digest(params), values, episodes)


def named_problem_digest(task: str, robot: str) -> str:
    """`problem_digest` of a task and a robot by name."""
    return problem_digest(make_task(task, robot), named_robot(robot))


def _probes(task: Task, params: BallbotParams) -> Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Fixed states, forces, and constants as `Task.at` gives them: those of drawn episodes, moved by some tenths."""
    rng = np.random.default_rng(1)
    for _ in range(_PROBES):
        x, c = task.sample(rng, params)
        x = x + rng.uniform(-0.3, 0.3, x.shape)
        u = params.force_limit * rng.uniform(-1, 1, params.action_size)
        yield x, u, np.asarray(task.at(c, 0.5))


def _rounded(values: Any) -> list[str]:
    return [f"{value:.{_DIGITS}g}" for value in np.ravel(np.asarray(values, np.float64)).tolist()]
