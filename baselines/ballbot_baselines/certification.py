"""Computes the certified evaluation sets that `ballbot_gym.certified` loads."""

import zlib
from collections.abc import Iterator

import numpy as np

from ballbot_baselines.optimum import Optimum, find_optimum
from ballbot_gym.certified import TRAJECTORIES, EvaluationSet
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task


def episode(task: Task, params: BallbotParams, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Initial state and constants of episode `index` of the task's evaluation set, the same on every machine."""
    return task.sample(np.random.default_rng([zlib.crc32(task.id.encode()), index]), params)


def solve_episodes(task: Task, params: BallbotParams, indices: range) -> Iterator[tuple[int, Optimum | PlanError]]:
    """The optimum of each episode, or the error that says why there is none."""
    for index in indices:
        x0, c = episode(task, params, index)
        try:
            yield index, find_optimum(task, params, x0, c)
        except PlanError as error:
            yield index, error


def evaluation_set(task: Task, params: BallbotParams, optima: list[Optimum]) -> EvaluationSet:
    """The set of the first episodes, given all their optima in order."""
    episodes = [episode(task, params, index) for index in range(len(optima))]
    return EvaluationSet(
        states=np.array([x for x, _ in episodes]),
        constants=np.array([c for _, c in episodes]),
        costs=np.array([optimum.cost for optimum in optima]),
        durations=np.array([optimum.trajectory.duration for optimum in optima]),
        violations=np.array([optimum.violation for optimum in optima]),
        statuses=np.array([f"{optimum.solver}: {optimum.status}" for optimum in optima]),
        trajectories=tuple(optimum.trajectory for optimum in optima[:TRAJECTORIES]),
    )
