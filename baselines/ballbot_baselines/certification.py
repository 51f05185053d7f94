"""Computes the certified evaluation sets that `ballbot_gym.certified` loads.

`entries` solves episodes one after the other and yields what JSON holds, so that the work can be divided and continued.
`evaluation_set` makes the set of all entries.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ballbot_baselines.optimum import ALL_GUESSES, find_optimum
from ballbot_gym.certified import TRAJECTORIES, EvaluationSet
from ballbot_gym.certified.cache import episode
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import PAPER, checked_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

Entry = dict[str, Any]
"""The optimum of one episode as JSON holds it: "episode" (its index), "cost", "violation", "solver", "status", and the
optimal trajectory's "t", "x" and "u" as lists; "draw", which draw of the episode it is, where it is not the first; and
"found", how it was found: "guesses" allowed and "tried", and "next_basin", by which share the next best local optimum
costs more. JSON keeps every bit of a float. Where no optimum was found: "episode" and "error", the message."""

_MOST_DRAWS = 20


def entries(
    task: str | Task, indices: Iterable[int], robot: str | BallbotParams = PAPER, guesses: int = ALL_GUESSES
) -> Iterator[Entry]:
    """Solves episodes of a task for a robot, and yields one entry for each, in order.

    If the robot's friction is limited, an episode without an optimum is drawn again: some starts make the robot slip whatever
    it does, and only the search tells which.

    Args:
        task: the problem, or its name in `TASKS`.
        indices: of the episodes.
        robot: whose optima, or its name in `ROBOTS`.
        guesses: see `find_optimum`.

    Raises:
        ValueError: no task or robot of that name.
    """
    task, params = make_task(task, robot), checked_robot(robot)
    for index in indices:
        for draw in range(_MOST_DRAWS if params.grips else 1):
            entry = _solved(task, params, index, draw, guesses)
            if "error" not in entry:
                break
        yield entry


def _solved(task: Task, params: BallbotParams, index: int, draw: int, guesses: int) -> Entry:
    try:
        optimum = find_optimum(task, params, *episode(task, params, index, draw), guesses=guesses)
    except PlanError as error:
        return {"episode": index, "error": str(error)}
    if not optimum.is_optimal:
        reason = f"only a feasible episode of cost {optimum.cost:.6g} was found ({optimum.solver_status})"
        return {"episode": index, "error": reason}
    trajectory = optimum.trajectory
    return {
        "episode": index,
        "cost": optimum.cost,
        "violation": optimum.violation,
        "solver": optimum.solver,
        "status": optimum.solver_status,
        "found": {
            "guesses": guesses,
            "tried": optimum.tried,
            "next_basin": None if math.isnan(optimum.next_basin) else optimum.next_basin,
        },
        "t": trajectory.t.tolist(),
        "x": trajectory.x.tolist(),
        "u": trajectory.u.tolist(),
    } | ({"draw": draw} if draw else {})


def _start(task: Task, params: BallbotParams, entry: Entry) -> tuple[np.ndarray, np.ndarray]:
    """Initial state and constants of the episode of an entry."""
    return episode(task, params, entry["episode"], entry.get("draw", 0))


def evaluation_set(task: Task, params: BallbotParams, entries: Sequence[Entry]) -> EvaluationSet:
    """The set of the first episodes, from their entries in order, from episode 0 on.

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
    episodes = [_start(task, params, entry) for entry in entries]
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
    starts = [_start(task, params, entry) for entry in found]

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
