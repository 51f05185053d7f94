"""Computes the certified evaluation sets that `ballbot_gym.certified` loads.

`entries` solves episodes one after the other and yields what JSON holds, so that the work can be divided and continued.
`evaluation_set` makes the set of all entries.
"""

import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ballbot_baselines.optimum import ALL_GUESSES, Optimum, find_optimum
from ballbot_gym.certified import TRAJECTORIES, EvaluationSet
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

Entry = dict[str, Any]
"""The optimum of one episode as JSON holds it: "episode" (its index), "cost", "violation", "solver", "status", and the
optimal trajectory's "t", "x" and "u" as lists. JSON keeps every bit of a float. Where no optimum was found: "episode" and
"error", the message."""


def episode(task: Task, params: BallbotParams, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Initial state and constants of episode `index` of the task's evaluation set, the same on every machine."""
    return task.sample(np.random.default_rng([zlib.crc32(task.id.encode()), index]), params)


def entries(task_name: str, indices: Iterable[int]) -> Iterator[Entry]:
    """Solves episodes of a task with default settings for the default robot, and yields one entry for each, in order.

    Raises:
        ValueError: no task of that name.
    """
    task, params = make_task(task_name), default_params()
    for index in indices:
        try:
            optimum = find_optimum(task, params, *episode(task, params, index), guesses=ALL_GUESSES)
        except PlanError as error:
            yield {"episode": index, "error": str(error)}
            continue
        if optimum.is_optimal:
            yield _entry(index, optimum)
        else:
            reason = f"only a feasible episode of cost {optimum.cost:.6g} was found ({optimum.solver_status})"
            yield {"episode": index, "error": reason}


def evaluation_set(task: Task, params: BallbotParams, entries: Sequence[Entry]) -> EvaluationSet:
    """The set of the first episodes.

    Args:
        task: the task that the entries were computed for.
        params: the robot.
        entries: one for each episode, from episode 0 on, in order.

    Raises:
        PlanError: an entry has no optimum; the message names the episodes.
        ValueError: an episode is missing or out of order.
    """
    failed = [f"episode {entry['episode']}: {entry['error']}" for entry in entries if "error" in entry]
    if failed:
        raise PlanError(f"no optimum of {task.id} for\n" + "\n".join(failed))
    for index, entry in enumerate(entries):
        if entry["episode"] != index:
            raise ValueError(
                f"entry {index} of {task.id} is of episode {entry['episode']}; give episodes 0, 1, 2, … in order"
            )
    episodes = [episode(task, params, index) for index in range(len(entries))]
    return EvaluationSet(
        states=np.array([x for x, _ in episodes]),
        constants=np.array([c for _, c in episodes]),
        costs=np.array([entry["cost"] for entry in entries]),
        durations=np.array([entry["t"][-1] - entry["t"][0] for entry in entries]),
        violations=np.array([entry["violation"] for entry in entries]),
        statuses=np.array([f"{entry['solver']}: {entry['status']}" for entry in entries]),
        trajectories=tuple(Trajectory(entry["t"], entry["x"], entry["u"]) for entry in entries[:TRAJECTORIES]),
    )


def arrays(entries: Sequence[Entry], task: Task, params: BallbotParams) -> dict[str, np.ndarray]:
    """The optima of any episodes as arrays, for sets too large for an `EvaluationSet`.

    | array | shape | holds |
    |---|---|---|
    | episodes | (n,) | numbers of the episodes with an optimum |
    | states, constants | (n, 8), (n, nc) | of their starts |
    | costs, violations, statuses | (n,) | as in `EvaluationSet` |
    | lengths | (n,) | control steps of the optimal trajectories |
    | x, u | (Σ lengths + n, 8), (Σ lengths, 2) | the trajectories, one after another |
    | failed, errors | (m,) | episodes without an optimum, and why |
    """
    found = [entry for entry in entries if "error" not in entry]
    failed = [entry for entry in entries if "error" in entry]
    starts = [episode(task, params, entry["episode"]) for entry in found]

    def joined(name: str, width: int) -> np.ndarray:
        return np.concatenate([np.zeros((0, width)), *(np.reshape(entry[name], (-1, width)) for entry in found)])

    return {
        "episodes": np.array([entry["episode"] for entry in found], np.int64),
        "states": np.array([x for x, _ in starts], float).reshape(-1, 8),
        "constants": np.array([c for _, c in starts], float).reshape(len(found), len(task.constant_names)),
        "costs": np.array([entry["cost"] for entry in found], float),
        "violations": np.array([entry["violation"] for entry in found], float),
        "statuses": np.array([f"{entry['solver']}: {entry['status']}" for entry in found], str),
        "lengths": np.array([len(entry["u"]) for entry in found], np.int64),
        "x": joined("x", 8),
        "u": joined("u", 2),
        "failed": np.array([entry["episode"] for entry in failed], np.int64),
        "errors": np.array([entry["error"] for entry in failed], str),
    }


def _entry(index: int, optimum: Optimum) -> Entry:
    trajectory = optimum.trajectory
    return {
        "episode": index,
        "cost": optimum.cost,
        "violation": optimum.violation,
        "solver": optimum.solver,
        "status": optimum.solver_status,
        "t": trajectory.t.tolist(),
        "x": trajectory.x.tolist(),
        "u": trajectory.u.tolist(),
    }
