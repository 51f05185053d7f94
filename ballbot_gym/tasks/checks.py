"""Checks of a task before it is used. Errors name the method of the task that is at fault."""

import math
from typing import Any

import numpy as np

from ballbot_gym.robot import Robot
from ballbot_gym.tasks.base import Task


def check_methods(task: Task, params: Robot, x: np.ndarray, c: np.ndarray, where: str = "") -> None:
    """Raises a ValueError that names the method of a task that returns an invalid value.

    Args:
        task: what is checked.
        params: a robot.
        x: state (8,) in which an episode begins; (11,) with wheels.
        c: its constants (nc,).
        where: which episode that is, for the message.
    """
    kind, begin = type(task).__name__, task.at(c, 0.0)
    where = where or "at the start of an episode"
    if type(task).sample is not Task.sample:
        raise ValueError(
            f"{kind}.sample is never called by environments; delete it, and draw an episode from the numbers z in "
            "draw_constants and draw_state"
        )
    if task.goal_reward and not task.first_exit:
        raise ValueError(f"{kind}.goal_reward is paid where reaching the goal ends the episode; set first_exit = True")
    again = task.start(*_draws(task, c), params), task.start(*_draws(task, c), params)
    if again[0] != again[1]:
        raise ValueError(f"{kind}.draw_state gives other states for the same z and c; draw from z alone")
    if (n := len(task.margins(x, begin))) != len(task.margin_names):
        raise ValueError(f"{kind}.margins gives {n} limits, and margin_names names {len(task.margin_names)}; name each")
    _check_cost(task, params, x, begin, where)
    if not isinstance(goal := task.goal(x, begin), tuple) or not goal or any(_number(part) is None for part in goal):
        raise ValueError(f"{kind}.goal gives {goal!r} {where}; give a tuple of numbers, each ≤ 0 in the goal")
    if (n := np.shape(task.observe(x, begin))) != (len(task.observation_scale),):
        raise ValueError(
            f"{kind}.observe gives the shape {n} {where}, and observation_scale has {len(task.observation_scale)} numbers"
        )


def check_paths(task: Task, params: Robot, x: np.ndarray, c: np.ndarray, where: str) -> None:
    """Raises a ValueError where a task guesses no path from a state x (8,), or none that an optimizer can take."""
    kind = type(task).__name__
    if type(task).guess_paths is Task.guess_paths:
        _check_guesses(kind, task.guesses(x, c, params), params, where)
        return
    paths = task.guess_paths(x, c, params)
    if not isinstance(paths, list | tuple | np.ndarray) or not len(paths):
        raise ValueError(f"{kind}.guess_paths gives {paths!r} {where}; give a list with at least one path")
    for path in paths:
        if np.shape(path)[1:] != (2,) or len(path) < 2 or not np.isfinite(path).all():
            raise ValueError(
                f"{kind}.guess_paths gives the shape {np.shape(path)} {where}; give finite (n+1, 2) positions, m"
            )


def _check_guesses(kind: str, guesses: Any, params: Robot, where: str) -> None:
    if not isinstance(guesses, list | tuple) or not guesses:
        raise ValueError(
            f"{kind}.guesses gives {guesses!r} {where}; give a list with at least one pair of states and actions"
        )
    for states, actions in guesses:
        n, sizes = len(actions), (params.state_size, params.action_size)
        if np.shape(states) != (n + 1, sizes[0]) or np.shape(actions) != (n, sizes[1]) or not n:
            raise ValueError(
                f"{kind}.guesses gives the shapes {np.shape(states)} and {np.shape(actions)} {where}; give states "
                f"(n+1, {sizes[0]}) and actions (n, {sizes[1]})"
            )


def _check_cost(task: Task, params: Robot, x: np.ndarray, begin: np.ndarray, where: str) -> None:
    kind, force = type(task).__name__, np.full(params.action_size, 0.1 * params.force_limit)
    given = [task.cost(x, u, begin) for u in (0 * force, force, force)]
    numbers = [_number(cost) for cost in given]
    if any(number is None for number in numbers):
        raise ValueError(f"{kind}.cost gives {given[0]!r} {where}; give one number, with `return`")
    cost, more, again = (math.nan if number is None else number for number in numbers)
    if not (0 <= cost < math.inf and 0 <= more < math.inf):
        raise ValueError(
            f"{kind}.cost gives {cost:g} without force and {more:g} with one {where}; make it finite and ≥ 0"
        )
    if more != again:
        raise ValueError(
            f"{kind}.cost gives {more:g} and {again:g} for the same x, u and c; use no random numbers in it"
        )
    states = [x + 0.1, x - 0.1, *(x + np.random.default_rng(0).uniform(-0.3, 0.3, (4, len(x))))]
    if cost == more == 0 and not any(_number(task.cost(state, force, begin)) for state in states):
        raise ValueError(f"{kind}.cost gives 0 for every state and force, so that no motion is better than another")


def _number(value: Any) -> float | None:
    """One real number as a float, or None."""
    array = np.asarray(value)
    return float(array) if array.shape == () and array.dtype.kind in "iuf" else None


def _draws(task: Task, c: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The same uniform numbers for `Task.start`, and the constants."""
    return (0.5,) * task.state_draws, tuple(np.asarray(c, np.float64).tolist())
