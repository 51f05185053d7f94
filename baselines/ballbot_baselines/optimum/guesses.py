"""What the searches of one episode (`search.py`) and of many at once (`batched.py`) share: what they start from, and which of
their rough solutions they solve in full.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ballbot_gym.tasks import Task
from ballbot_gym.tasks.paths import cubic, then_stay

CONSIDERED = 5
"""Guessed paths that are tried at most; tasks name the likeliest first."""
ALL_GUESSES = 2**10
"""`guesses` that make `find_optimum` solve every guess."""
COARSE = 2
"""Control steps per interval when several guesses are compared."""
BASIN_DOUBT = 0.01
"""Paths whose coarse costs differ by less than this share may be ordered differently on the env's grid."""
_STRAIGHT_SECONDS = 3.0  # how long the guessed motion without obstacles takes


def straight_path(task: Task, params: Any, x0: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(steps+1, 2) m, from the position and velocity of x0 to rest where the task's reference ends."""
    goal = task.reference(x0, c, params).x[-1, :2]
    steps = min(task.steps, round(_STRAIGHT_SECONDS / task.control_dt))
    return then_stay(cubic(x0[:2], x0[4:6], goal, np.zeros(2), steps, task.control_dt), task.steps)


def contenders(costs: Sequence[float] | np.ndarray, doubt: float, same: Callable[[int, int], bool]) -> list[int]:
    """Which solutions of an episode are within a relative `doubt` of the best, sorted by cost, without repetitions.

    Args:
        costs: of the solutions; infinite where there is none.
        doubt: relative.
        same: whether two of them are the same solution.
    """
    chosen: list[int] = []
    for i in np.argsort(costs, kind="stable").tolist():
        contends = math.isfinite(costs[i]) and (not chosen or costs[i] < costs[chosen[0]] * (1 + doubt))
        if contends and not any(same(i, j) for j in chosen):
            chosen.append(i)
    return chosen
