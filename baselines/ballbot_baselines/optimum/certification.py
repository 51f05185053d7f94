"""Computes the certified evaluation sets that `ballbot_gym.certified` loads.

`entries` solves episodes and gives a set of each alone, so that the work can be divided and continued.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ballbot_baselines.optimum import batched
from ballbot_baselines.optimum.find import find_optimum
from ballbot_baselines.optimum.guesses import COARSE
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.solvers.compiled import LANES
from ballbot_baselines.solvers.shooting import SAME_BARRIER, Backoff, Shooting
from ballbot_gym.certified import EvaluationSet
from ballbot_gym.certified.cache import episode, starts
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.robot import PAPER, Randomization, Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

_SLALOM_GUESSES = 256  # random ones; of a robot that has to grip, one of thirty may lead to a solution
_GUESSES = 200  # random ones, where the other searches do not come to a stored cost

AT_ONCE = LANES
"""Episodes whose second searches share the processor's lanes."""


def entries(
    task: str | Task,
    indices: Iterable[int],
    robot: str | Robot = PAPER,
    randomization: Randomization = Randomization(),
) -> Iterator[tuple[int, EvaluationSet | str]]:
    """Solves episodes of a task. Yields the number of each, and a set of it alone with its optimum, or the cause of failure.

    If the robot's friction is limited or the robot varies, an episode without an optimum is drawn again: from some starts the
    robot slips with any force, and only the search can find out which starts these are.

    Args:
        task: the problem, or its name in `TASKS`.
        indices: of the episodes.
        robot: whose optima, or its name in `ROBOTS`.
        randomization: what the robot and the actuator of each episode are drawn from.

    Raises:
        ValueError: no task or robot of that name.
    """
    task, params, left = make_task(task, robot), robot_of(task, robot), iter(indices)
    redrawn = None if params.grips or randomization.moves_optima else 1
    while some := list(itertools.islice(left, AT_ONCE)):
        x0, c = (np.array(part) for part in zip(*(episode(task, params, index) for index in some), strict=True))
        # where optima move, each episode has another robot
        second = (
            None if randomization.moves_optima else batched.search_many(task, params, x0, c, Backoff(), _SLALOM_GUESSES)
        )
        for k, index in enumerate(some):
            found: EvaluationSet | str = ""
            twice = True if second is None else second[k] or False
            for start in itertools.islice(starts(task, params, index, randomization), redrawn):
                try:
                    found = _solved(task, params, randomization, *start, twice)
                    break
                except PlanError as error:
                    found, twice = str(error), True
            yield index, found


def _solved(
    task: Task,
    params: Robot,
    randomization: Randomization,
    x0: np.ndarray,
    c: np.ndarray,
    drawn: tuple[float, ...],
    twice: bool | Optimum,
) -> EvaluationSet:
    """The set of one episode; raises a PlanError where no optimum is found."""
    optimum = ideal = optimum_of(task, params, x0, c, randomization, drawn, twice)
    if drawn and drawn[5] > 0:
        ideal = _optimal(task, randomization.robot(params, drawn), x0, c)
    return EvaluationSet(
        states=np.array([x0]),
        constants=np.array([c]),
        costs=np.array([optimum.cost]),
        durations=np.array([task.control_dt * len(optimum.trajectory.u)]),
        violations=np.array([optimum.violation]),
        statuses=np.array([f"{optimum.solver}: {optimum.solver_status}"]),
        trajectories=(optimum.trajectory,),
        drawn=np.array([drawn]),
        ideal=np.array([ideal.cost]),
    )


def _optimal(*problem: Any, twice: bool | Optimum = True, **options: Any) -> Optimum:
    """What `find_optimum` finds in two searches; raises a PlanError for an episode that is merely feasible."""
    found = find_optimum(*problem, twice=twice, **options)
    if not found.is_optimal:
        raise PlanError(f"only a feasible episode of cost {found.cost:.6g} was found ({found.solver_status})")
    return found


def optimum_of(
    task: Task,
    params: Robot,
    x0: np.ndarray,
    c: np.ndarray,
    randomization: Randomization,
    drawn: tuple[float, ...],
    twice: bool | Optimum = True,
) -> Optimum:
    """The optimum of an episode for which a randomization drew this: of its own robot, and no force comes while it is late.

    Args:
        task: the problem.
        params: the nominal robot.
        x0: (8,) initial state.
        c: (nc,) constants.
        randomization: without an actuator that lags; noise and pushes move no optimum.
        drawn: what its `draw` drew.
        twice: same as in `find_optimum`, used if no force is late.

    Raises:
        PlanError: the robot violates a limit before it can be moved, or no try came to an optimum.
    """
    if randomization.moves_optima:
        params = randomization.robot(params, drawn)
    delay = round(drawn[5]) if randomization.varies_actuator else 0
    if not delay:
        return _optimal(task, params, x0, c, twice=twice)
    dt, none, states, cost = task.control_dt, np.zeros(params.action_size), [np.asarray(x0, np.float64)], 0.0
    for k in range(delay):
        began = task.at(c, k * dt)
        cost += dt * float(task.cost(states[-1], none, began))
        states.append(np.array(params.step(states[-1], none, dt, params.substeps(dt))))
        violated = task.violated(states[-1], task.at(c, (k + 1) * dt))
        if violated or min(params.limits(states[-2], none, hold=dt), default=1.0) < 0:
            raise PlanError(f"{task.id}: the limit of {violated or 'grip'} is violated before the first force can act")
    rest, start = replace(task, duration=dt * (task.steps - delay)), delay * dt
    paths = None
    if rest.steps % COARSE and task.passed_obstacles(c) is not None:
        # only over an even number of steps are choices of sides compared
        longer = replace(task, duration=rest.duration + dt)
        paths = [find_optimum(longer, params, states[-1], c, start=start).trajectory.x[:-1, :2]]
    found = _optimal(rest, params, states[-1], c, paths=paths, start=start)
    x = np.concatenate([states[:-1], found.trajectory.x])
    u = np.concatenate([np.zeros((delay, params.action_size)), found.trajectory.u])
    return replace(
        found,
        cost=cost + found.cost,
        trajectory=Trajectory(dt * np.arange(len(x)), x, u),
        slopes=np.concatenate([np.full((delay, x.shape[1]), np.nan), found.slopes]),
        feedback=partial(_delayed, found, delay),
    )


def _delayed(optimum: Optimum, steps: int) -> np.ndarray:
    """Gains after control steps in which there is no feedback."""
    return np.pad(optimum.gains, ((steps, 0), (0, 0), (0, 0)))


def arrays(entries: Mapping[int, EvaluationSet | str], task: Task, params: Robot) -> dict[str, np.ndarray]:
    """The entries of any episodes as arrays, for sets too large for an `EvaluationSet`.

    | array | shape | holds |
    |---|---|---|
    | episodes | (n,) | numbers of the episodes with an optimum |
    | states, constants | (n, 8), (n, nc) | of their starts |
    | costs, violations, statuses | (n,) | as in `EvaluationSet` |
    | lengths | (n,) | control steps of the optimal trajectories |
    | x, u | (Σ lengths + n, 8), (Σ lengths, 2) | the trajectories, one after another |
    | failed, errors | (m,) | episodes without an optimum, and why |
    """
    found = {index: part for index, part in entries.items() if isinstance(part, EvaluationSet)}
    failed = {index: error for index, error in entries.items() if isinstance(error, str)}
    moved = [part.trajectories[0] for part in found.values()]

    def joined(name: str, *width: int) -> np.ndarray:
        return np.concatenate([np.zeros((0, *width)), *(getattr(part, name) for part in found.values())])

    return {
        "episodes": np.array(list(found), np.int64),
        "states": joined("states", params.state_size),
        "constants": joined("constants", len(task.constant_names)),
        "costs": joined("costs"),
        "violations": joined("violations"),
        "statuses": np.array([part.statuses[0] for part in found.values()], str),
        "lengths": np.array([len(trajectory.u) for trajectory in moved], np.int64),
        "x": np.concatenate([np.zeros((0, params.state_size)), *(trajectory.x for trajectory in moved)]),
        "u": np.concatenate([np.zeros((0, params.action_size)), *(trajectory.u for trajectory in moved)]),
        "failed": np.array(list(failed), np.int64),
        "errors": np.array(list(failed.values()), str),
    }


def _motion_again(
    task: Task, robot: Robot, known: EvaluationSet, i: int, found: Optimum | None, same: float
) -> Trajectory:
    """The motion of a certified episode whose forces are not stored.

    Args:
        task: the problem.
        robot: whose optima the set contains.
        known: the certified set.
        i: number of the episode.
        found: an optimum of the episode that may be it.
        same: the largest difference of the motion's cost from the stored one; if no search finds one, it is the last motion.

    Raises:
        PlanError: no search found a motion.
    """
    x0, c = known.states[i], known.constants[i]
    shooting = Shooting(task, robot, x0, c, Backoff())

    def searches() -> Iterator[Optimum | None]:
        yield found
        yield find_optimum(task, robot, x0, c, twice=True)
        yield batched.multistart(task, robot, x0[None], c[None], _GUESSES)[0][0]

    motion = None
    for optimum in searches():
        if optimum is None:
            continue
        x, u = optimum.trajectory.x, optimum.trajectory.u
        near = shooting.solve_to_the_end(x, u / robot.force_limit, SAME_BARRIER)[-1]
        motion = Trajectory(optimum.trajectory.t, near.states, robot.force_limit * near.inputs)
        same_length = len(u) == round(known.durations[i] / task.control_dt)
        if near.is_optimal and same_length and abs(near.cost - known.costs[i]) < same:
            break
    if motion is None:
        raise PlanError("no search found a motion")
    return motion
