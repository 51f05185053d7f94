"""Where physics engines disagree: the same forces in each of them, and episodes that end otherwise."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_gym import certified
from ballbot_gym.engines import make_simulator
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robots import named_robot
from ballbot_gym.rollout import PlanError, rollout
from ballbot_train.evaluation.controllers import make_controller
from ballbot_train.evaluation.results import Result

TIMES = (0.1, 0.25, 0.5, 1.0, 2.0)
"""s, at which distances are measured."""
_EPISODES = 20  # whose forces are played


@dataclass(frozen=True)
class Disagreement:
    """The certified episodes of one controller in two physics.

    `episodes` have another outcome: success, failure or neither. `regret` is the mean of the second's regret less the
    first's, over those `both` that fail in neither.
    """

    task: str
    controller: str
    made_for: str
    robot: str
    friction: float
    first: str
    second: str
    episodes: tuple[int, ...]
    of: int
    both: int
    regret: float


def disagreements(results: Sequence[Result]) -> list[Disagreement]:
    """Every controller on every floor, in the first physics of the results and in each other one."""
    runs: dict[tuple[Any, ...], dict[str, dict[int, Result]]] = {}
    for result in results:
        key = result.task, result.controller, *result.told.values()
        runs.setdefault(key, {}).setdefault(result.physics, {})[result.episode] = result
    found = []
    for key, by_physics in runs.items():
        first, *others = by_physics
        for second in others:
            pairs = [(one, by_physics[second][episode]) for episode, one in by_physics[first].items()]
            differ = tuple(a.episode for a, b in pairs if (a.success, a.failure) != (b.success, b.failure))
            apart = [b.regret - a.regret for a, b in pairs if not (a.failure or b.failure)]
            mean = float(np.mean(apart)) if apart else math.nan
            measured: tuple[Any, ...] = first, second, differ, len(pairs), len(apart), mean
            found.append(Disagreement(*key, *measured))
    return found


def drifts(task: str, robot: str, controller: str, physics: Sequence[str], episodes: int) -> list[dict[str, Any]]:
    """How far the ball is from where the same forces bring it in the first physics, m: rows of a table for `TIMES`.

    A row is over the episodes that last so long in the first physics. Nothing corrects the drift, and the robot is unstable:
    what differs grows a thousandfold in a second.

    Args:
        task: by name.
        robot: by name.
        controller: whose forces they are, by name.
        physics: that it runs in first, and the others.
        episodes: how many, of which at most 20 are taken.
    """
    first, *others = physics
    runs = list(_runs(task, robot, controller, first, min(episodes, _EPISODES)))
    rows = []
    for second in others:
        distances = [_distances(robot, second, states, forces, dt) for states, forces, dt in runs]
        for seconds in TIMES:
            far = [
                float(d[k]) for d, (*_, dt) in zip(distances, runs, strict=True) if (k := round(seconds / dt)) < len(d)
            ]
            if far:
                about = {"task": task, "robot": robot, "controller": controller, "first": first, "second": second}
                measured = {"episodes": len(far), "median": float(np.median(far)), "worst": max(far)}
                rows.append(about | {"seconds": seconds} | measured)
    return rows


def _runs(
    task: str, robot: str, controller: str, physics: str, episodes: int
) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """States (n + 1, 8) and forces (n, 2) of certified episodes, and the control step, s."""
    env = BallbotEnv(task, physics=physics, robot=robot)
    made, known = make_controller(controller, env.task, env.params), certified.load(env.task, robot)
    for episode in range(episodes):
        try:
            trajectory = rollout(env, made, options=known.options(episode)).trajectory
        except PlanError:
            continue
        yield trajectory.x, trajectory.u, env.task.control_dt
    env.close()


def _distances(robot: str, physics: str, states: np.ndarray, forces: np.ndarray, dt: float) -> np.ndarray:
    """(n + 1,) m, from every state to where the same forces bring the robot in another physics."""
    simulator = make_simulator(physics, named_robot(robot), dt)
    simulator.reset(tuple(states[0].tolist()))
    there = [states[0], *(np.array(simulator.step(tuple(u.tolist()))) for u in forces)]
    simulator.close()
    return np.hypot(*(np.array(there) - states)[:, :2].T)
