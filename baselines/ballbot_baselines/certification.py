"""Computes the certified evaluation sets that `ballbot_gym.certified` loads.

`entries` solves a few episodes after the other and yields what JSON holds, so that the work can be divided and continued.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ballbot_baselines.batched import BatchOptima
from ballbot_baselines.compiled import LANES
from ballbot_baselines.optimum import Optimum, find_optimum, second_search
from ballbot_baselines.search import COARSE
from ballbot_gym import dynamics
from ballbot_gym.certified import cache
from ballbot_gym.certified.cache import episode
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import PAPER, checked_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

Entry = dict[str, Any]
"""The optimum of one episode as JSON holds it: "episode" (its index), "cost", "violation", "solver", "status", and the
optimal trajectory's "t", "x" and "u" as lists; "draw", which draw of the episode it is, where it is not the first; and
"found", how it was found: guesses "tried", and "next_basin", by which share the next best local optimum
costs more. JSON keeps every bit of a float. Where no optimum was found: "episode" and "error", the message."""

AT_ONCE = LANES
"""Episodes whose second searches share the processor's lanes."""

_MOST_DRAWS = 20


def entries(
    task: str | Task,
    indices: Iterable[int],
    robot: str | BallbotParams = PAPER,
    randomization: Randomization = Randomization(),
) -> Iterator[Entry]:
    """Solves episodes of a task for a robot, and yields one entry for each, in order.

    If the robot's friction is limited or the robot varies, an episode without an optimum is drawn again: some starts make the
    robot slip whatever it does, and only the search tells which.

    Args:
        task: the problem, or its name in `TASKS`.
        indices: of the episodes.
        robot: whose optima, or its name in `ROBOTS`.
        randomization: what the robot and the actuator of each episode are drawn from.

    Raises:
        ValueError: no task or robot of that name.
    """
    task, params, left = make_task(task, robot), checked_robot(robot), iter(indices)
    while some := list(itertools.islice(left, AT_ONCE)):
        second = None
        if not randomization.moves_optima:  # else each has another robot
            x0, c = (np.array(part) for part in zip(*(episode(task, params, i, 0) for i in some), strict=True))
            second = second_search(task, params, x0, c)
        for k, index in enumerate(some):
            for draw in range(_MOST_DRAWS if params.grips or randomization.moves_optima else 1):
                twice = True if second is None or draw else second.some(slice(k, k + 1))
                entry = _solved(task, params, index, draw, randomization, twice)
                if "error" not in entry:
                    break
            yield entry


def _solved(
    task: Task, params: BallbotParams, index: int, draw: int, randomization: Randomization, twice: bool | BatchOptima
) -> Entry:
    x0, c = episode(task, params, index, draw)
    drawn = cache.drawn(task, randomization, index, draw)
    delay = randomization.moves_optima and drawn[5] > 0
    try:
        optimum = optimum_of(task, params, x0, c, randomization, drawn, twice)
        ideal = optimum
        if delay:
            ideal = find_optimum(task, randomization.robot(params, drawn), x0, c, twice=True)
    except PlanError as error:
        return {"episode": index, "error": str(error)}
    for found in (optimum, ideal):
        if not found.is_optimal:
            reason = f"only a feasible episode of cost {found.cost:.6g} was found ({found.solver_status})"
            return {"episode": index, "error": reason}
    trajectory = optimum.trajectory
    return (
        {
            "episode": index,
            "cost": optimum.cost,
            "violation": optimum.violation,
            "solver": optimum.solver,
            "status": optimum.solver_status,
            "found": {
                "tried": optimum.tried,
                "next_basin": None if math.isnan(optimum.next_basin) else optimum.next_basin,
            },
            "t": trajectory.t.tolist(),
            "x": trajectory.x.tolist(),
            "u": trajectory.u.tolist(),
        }
        | ({"draw": draw} if draw else {})
        | ({"ideal": ideal.cost} if delay else {})
    )


def optimum_of(
    task: Task,
    params: BallbotParams,
    x0: np.ndarray,
    c: np.ndarray,
    randomization: Randomization,
    drawn: tuple[float, ...],
    twice: bool | BatchOptima = True,
) -> Optimum:
    """The optimum of an episode for which a randomization drew this: of its own robot, and no force comes while it is late.

    Args:
        task: the problem.
        params: the nominal robot.
        x0: (8,) initial state.
        c: (nc,) constants.
        randomization: without an actuator that lags; noise and pushes move no optimum.
        drawn: what its `draw` drew.
        twice: as of `find_optimum`, where no force is late.

    Raises:
        PlanError: the robot violates a limit before it can be moved, or no try came to a feasible episode.
    """
    if randomization.moves_optima:
        params = randomization.robot(params, drawn)
    delay = round(drawn[5]) if randomization.varies_actuator else 0
    if not delay:
        return find_optimum(task, params, x0, c, twice=twice)
    dt, none, states, cost = task.control_dt, np.zeros(params.action_size), [np.asarray(x0, np.float64)], 0.0
    for k in range(delay):
        began = task.at(c, k * dt)
        cost += dt * float(task.cost(states[-1], none, began))
        states.append(np.array(dynamics.step(params, states[-1], none, dt, dynamics.substeps_for(dt))))
        violated = task.violated(states[-1], task.at(c, (k + 1) * dt))
        if violated or min(dynamics.limits(params, states[-2], none, hold=dt), default=1.0) < 0:
            raise PlanError(f"{task.id}: the limit of {violated or 'grip'} is violated before a force can come")
    rest, start = replace(task, duration=dt * (task.steps - delay)), delay * dt
    paths = None
    if rest.steps % COARSE and task.passed_obstacles(c) is not None:
        # only over an even number of steps are choices of sides compared
        longer = replace(task, duration=rest.duration + dt)
        paths = [find_optimum(longer, params, states[-1], c, start=start).trajectory.x[:-1, :2]]
    found = find_optimum(rest, params, states[-1], c, paths=paths, start=start, twice=True)
    x = np.concatenate([states[:-1], found.trajectory.x])
    u = np.concatenate([np.zeros((delay, params.action_size)), found.trajectory.u])
    return replace(found, cost=cost + found.cost, trajectory=Trajectory(dt * np.arange(len(x)), x, u))


def _start(task: Task, params: BallbotParams, entry: Entry) -> tuple[np.ndarray, np.ndarray]:
    """Initial state and constants of the episode of an entry."""
    return episode(task, params, entry["episode"], entry.get("draw", 0))


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
        "states": np.array([x for x, _ in starts], float).reshape(-1, params.state_size),
        "constants": np.array([c for _, c in starts], float).reshape(len(found), len(task.constant_names)),
        "costs": np.array([entry["cost"] for entry in found], float),
        "violations": np.array([entry["violation"] for entry in found], float),
        "statuses": np.array([f"{entry['solver']}: {entry['status']}" for entry in found], str),
        "lengths": np.array([len(entry["u"]) for entry in found], np.int64),
        "x": joined("x", params.state_size),
        "u": joined("u", params.action_size),
        "failed": np.array([entry["episode"] for entry in failed], np.int64),
        "errors": np.array([entry["error"] for entry in failed], str),
    }
