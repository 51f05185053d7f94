"""Optima of any problem in the user's cache folder: a folder per problem, a file per episode.

The folder's name holds a digest of all that an optimum depends on: the task's formulas, fields, draws and guesses, the
robot, and the solver's version. Formulas are traced operation by operation. So a change anywhere behind `cost` makes another
problem, and a comment does not. Where they cannot be traced, the source of the class is taken.
"""

import hashlib
import inspect
import json
import os
import uuid
import zlib
from collections.abc import Iterator
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import machine_code
from ballbot_gym.machine_code import traced
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.tasks import Task

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
            drawn = randomization.draw(tuple(rng.random(len(Randomization.DRAWN)).tolist()), task.control_dt)
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
    varied = [repr(randomization)] if randomization.moves_optima else []
    parts = [
        task.id,
        task.problem(),
        params.record(),
        *map(_version, ("ballbot-gym", "casadi")),
        _formulas(task, params),
    ]
    parts += varied
    for index in range(2):
        x, c = episode(task, params, index)
        paths = [np.round(path, 9).tolist() for path in task.guess_paths(x, c, params)]
        guesses = [] if paths else [np.round(states, 9).tolist() for states, _ in task.guesses(x, c, params)]
        parts.append(json.dumps([x.tolist(), c.tolist(), paths, *guesses]))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def _formulas(task: Task, params: Robot) -> str:
    """What the task and the robot compute, as text."""

    def compute(x: tuple, u: tuple, c: tuple, z_constants: tuple, z_state: tuple) -> tuple[Any, ...]:
        drawn = (*task.draw_constants(z_constants, params), *task.draw_state(z_state, c[:constants], params))
        moved = params.step(x, u, task.control_dt, params.substeps(task.control_dt))
        return (task.cost(x, u, c), *task.margins(x, c), *task.goal(x, c), *drawn, *moved)

    constants = len(task.constant_names)
    counts = (params.state_size, params.action_size, constants + task.clock, task.constant_draws, task.state_draws)
    try:
        return traced.function("problem", compute, counts)
    except Exception:  # users' code may raise any error when it gets a traced number
        kinds = [kind for kind in type(task).__mro__ if issubclass(kind, Task) and kind is not Task]
        try:
            return "".join(map(inspect.getsource, kinds))
        except (OSError, TypeError):
            # changes of a task without source code go unnoticed, so its optima are kept for this process alone
            return uuid.uuid4().hex
