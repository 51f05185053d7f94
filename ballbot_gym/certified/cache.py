"""Optima of any problem in the user's cache folder: a folder per problem, a file per episode.

The folder's name holds a digest of all that an optimum depends on: what the task computes, its fields, draws and guesses, the
robot, and the solver's version. What a task computes is compared at fixed states; see `tasks.identity`. So a change anywhere
behind `cost` makes another problem, and a comment does not.
"""

import os
import zlib
from collections.abc import Iterator
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import machine_code
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import digest, problem_parts

_MOST_DRAWS = 20


def episode(task: Task, params: Robot, index: int, draw: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Initial state (8,) and constants (nc,) of episode `index` of a task's evaluation set, the same on every machine.

    A later draw replaces a draw whose goal a robot with limited friction cannot reach.
    """
    seed = [*task.episode_seed(index), *([draw] if draw else [])]
    return task.sample(np.random.default_rng(seed), params)


def starts(
    task: Task, params: Robot, index: int, randomization: Randomization = Randomization()
) -> Iterator[tuple[np.ndarray, np.ndarray, tuple[float, ...]]]:
    """Initial state, constants and what a randomization that moves optima draws, of each draw of `episode`.

    A later draw replaces a draw without a feasible solution. All draws are the same on every machine.
    """
    for draw in range(_MOST_DRAWS):
        drawn: tuple[float, ...] = ()
        if randomization.moves_optima:
            rng = np.random.default_rng([zlib.crc32(task.id.encode()), index, draw, 1])
            drawn = randomization.draw(tuple(rng.random(randomization.most_draws).tolist()), task.control_dt)
        yield *episode(task, params, index, draw), drawn


def folder(task: Task, params: Robot, randomization: Randomization = Randomization()) -> Path:
    """Where the optima of a problem are kept: in $BALLBOT_OPTIMA, or the folder `optima` of the user's cache.

    Raises:
        ValueError: $BALLBOT_OPTIMA or $BALLBOT_CACHE is no absolute path; or others may write into $BALLBOT_OPTIMA, where a
            poor motion would pass for the optimum.
    """
    base = Path(os.environ.get("BALLBOT_OPTIMA") or machine_code.cache_folder() / "optima")
    if not base.is_absolute():
        raise ValueError(
            f"BALLBOT_OPTIMA must be an absolute path, not {str(base)!r}; unset it for the user's cache folder"
        )
    if os.environ.get("BALLBOT_OPTIMA") and base.exists():
        try:
            machine_code.check_private(base, "BALLBOT_OPTIMA")
        except PermissionError as error:
            raise ValueError(str(error)) from error
    return base / f"{type(task).__name__}-{_digest(task, params, randomization)}"


def path(task: Task, params: Robot, index: int, randomization: Randomization = Randomization()) -> Path:
    """Where the optimum of an episode is kept, as an `EvaluationSet` of this episode alone."""
    return folder(task, params, randomization) / f"{index:06d}.npz"


@lru_cache(maxsize=64)
def _digest(task: Task, params: Robot, randomization: Randomization) -> str:
    """Of all that an optimum depends on, as 24 hexadecimal digits."""
    computed = problem_parts(task, params)
    parts: list[Any] = [task.id, task.problem(), *map(_version, ("ballbot-gym", "casadi"))]
    parts += [computed[name] for name in ("robot", "episodes", "costs", "limits", "goal")]
    parts += [repr(randomization)] if randomization.moves_optima else []
    for index in range(2):
        x, c = episode(task, params, index)
        dt, force = task.control_dt, np.full(params.action_size, 0.1 * params.force_limit)
        parts.append(np.round(params.step(x, force, dt, params.substeps(dt)), 9).tolist())
        paths = [np.round(path, 9).tolist() for path in task.guess_paths(x, c, params)]
        guesses = [] if paths else [np.round(states, 9).tolist() for states, _ in task.guesses(x, c, params)]
        parts.append([x.tolist(), c.tolist(), paths, *guesses])
    return digest(*parts)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
