"""Computes the certified evaluation sets that `ballbot_gym.certified` loads."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ballbot_baselines.optimum import find_optimum
from ballbot_gym.certified import TRAJECTORIES, EvaluationSet
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory


def episode(task: Task, params: BallbotParams, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Initial state and constants of episode `index` of the task's evaluation set, the same on every machine."""
    return task.sample(np.random.default_rng([zlib.crc32(task.id.encode()), index]), params)


def entries(task_name: str, indices: Sequence[int]) -> Iterator[dict[str, Any]]:
    """The optimum of each episode as one JSON entry, or {"error": why there is none}.

    The entries of the first `TRAJECTORIES` episodes hold the whole trajectory under "x" and "u".
    """
    task, params = make_task(task_name), default_params()
    for index in indices:
        x0, c = episode(task, params, index)
        try:
            optimum = find_optimum(task, params, x0, c)
        except PlanError as error:
            yield {"error": str(error)}
            continue
        entry = {
            "cost": optimum.cost,
            "duration": optimum.trajectory.duration,
            "violation": optimum.violation,
            "status": f"{optimum.solver}: {optimum.status}",
        }
        if index < TRAJECTORIES:
            entry |= {"x": optimum.trajectory.x.tolist(), "u": optimum.trajectory.u.tolist()}
        yield entry


def evaluation_set(task: Task, params: BallbotParams, entries: Sequence[Mapping[str, Any]]) -> EvaluationSet:
    """The set of the first episodes, given the entries of all of them in order."""
    episodes = [episode(task, params, index) for index in range(len(entries))]

    def trajectory(entry: Mapping[str, Any]) -> Trajectory:
        x, u = np.array(entry["x"]), np.array(entry["u"])
        return Trajectory(task.control_dt * np.arange(len(x)), x, u)

    return EvaluationSet(
        states=np.array([x for x, _ in episodes]),
        constants=np.array([c for _, c in episodes]),
        costs=np.array([entry["cost"] for entry in entries]),
        durations=np.array([entry["duration"] for entry in entries]),
        violations=np.array([entry["violation"] for entry in entries]),
        statuses=np.array([entry["status"] for entry in entries]),
        trajectories=tuple(trajectory(entry) for entry in entries[:TRAJECTORIES]),
    )
