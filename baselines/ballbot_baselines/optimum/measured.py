"""The regret of any trajectory, by any controller: its cost minus that of the optimum from the same start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballbot_baselines.optimum.find import find_optimum
from ballbot_baselines.optimum.lower_bound import PlanarBound
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_gym.checks import finite_array
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.robot import PAPER, Robot
from ballbot_gym.step import limit_names, outcome
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

_CLOCK = 0.1  # of a control step: by so much may a recorded clock be short of the end of a step
_LINEAR_STEPS = 4  # times more steps of integration along forces that run linearly than along held ones


@dataclass(frozen=True)
class Regret:
    """What a trajectory costs, and whether it is one of this robot.

    | field | meaning |
    |---|---|
    | `regret` | cost / optimum.cost − 1 |
    | `proven` | the regret is proven to be at most this, among motions in the start's vertical plane; else NaN |
    | `cost` | as an env counts it: on the task's control steps, up to the episode's end, the price of a failure included |
    | `optimum` | the optimum from the trajectory's first state |
    | `success` | whether the episode reaches its goal |
    | `violated` | the limit whose violation ended the episode, or "" |
    | `duration` | of the episode, s |
    | `defects` | (N, 8) recorded states minus the states that the robot's equations predict from the ones before, SI units |
    | `force_excess` | by how much the largest recorded force exceeds the force limit, N; 0 if none does |

    Defects of an optimum are below 1e-6. If they are not small, this robot cannot perform the motion, and the regret has no
    meaning. `proven` is a number for two fifths of the starts of Stabilize in a vertical plane: see `PlanarBound`.
    """

    regret: float
    cost: float
    optimum: Optimum
    success: bool
    violated: str
    duration: float
    defects: np.ndarray
    force_excess: float
    proven: float = math.nan


def regret(
    trajectory: Trajectory | tuple[np.ndarray, ...],
    task: str | Task,
    robot: str | Robot = PAPER,
    constants: Sequence[float] | np.ndarray = (),
) -> Regret:
    """The regret of a trajectory from any source, such as another simulator or a robot.

    Args:
        trajectory: a Trajectory, or arrays (t, x, u): t (N+1,) s, at any increasing times; x (N+1, 8) states, order and units
            in `Ballbot.STATE`; u (N, 2) N, each held until the next time, or (N+1, 2), linear between times. It may begin
            at any time, and continue after the episode's end, or stop a tenth of a control step before it.
        task: a name in `TASKS`, or any Task.
        robot: a name in `ROBOTS`, or any Robot; default, the robot that the task names.
        constants: (nc,) of the episode, named in the task's `constant_names`.

    Raises:
        ValueError: it ends before the episode does, or starts beyond a limit; the constants have another shape; or (as
            TrajectoryError) the arrays do not fit together.
        PlanError: no optimum is found from its first state.
    """
    params = robot_of(task, robot)
    task = make_task(task, params)
    moved = trajectory if isinstance(trajectory, Trajectory) else Trajectory(*trajectory)
    if len(moved.t) < 2:
        raise ValueError("a trajectory needs at least two times")
    if len(constants) != len(task.constant_names):
        raise ValueError(
            f"{task.id} needs the episode's constants {list(task.constant_names)}: give constants, "
            f"{len(task.constant_names)} numbers, not {len(constants)}"
        )
    c = finite_array(constants, (len(task.constant_names),), "constants")
    moved = Trajectory(moved.t - moved.t[0], moved.x, moved.u, moved.xdot)
    steps = min(task.steps, int(moved.duration / task.control_dt + _CLOCK))
    x = np.array([moved.state(k * task.control_dt) for k in range(steps + 1)])
    end, violated, success = _end(task, params, moved, x, c)
    cost = _cost(task, moved, x[: end + 1], c)
    if violated:
        cost += task.survival_reward * task.control_dt * (task.steps - end)
    if not success:
        cost += task.goal_reward
    optimum = find_optimum(task, params, x[0], c, twice=True)
    return Regret(
        regret=cost / optimum.cost - 1,
        cost=cost,
        optimum=optimum,
        success=success,
        violated=violated,
        duration=end * task.control_dt,
        defects=_defects(params, moved),
        force_excess=max(0.0, float(np.abs(moved.u).max()) - params.force_limit),
        proven=cost / PlanarBound.stored().of_episode(task, params, x[0]) - 1,
    )


def _end(task: Task, params: Robot, moved: Trajectory, x: np.ndarray, c: np.ndarray) -> tuple[int, str, bool]:
    """The control step at which an episode through states x (n+1, 8) ends, the violated limit, and whether it succeeds."""
    if start := task.violated(x[0], task.at(c, 0.0)):
        raise ValueError(f"{task.id}: the trajectory starts beyond the limit of {start}")
    steps, dt = np.arange(1, len(x)), task.control_dt
    force = np.array([moved.force((k - 0.5) * dt) for k in steps]).reshape(-1, params.action_size)
    limits = params.limits(x[:-1], force, hold=dt)
    did = outcome(task, x[:-1], force, x[1:], c, steps, (np.minimum.reduce(limits),) if limits else ())
    ended = np.flatnonzero(np.broadcast_to(did.terminated + did.truncated, steps.shape))
    if not len(ended):
        raise ValueError(
            f"the trajectory lasts {moved.duration:g} s, and an episode of {task.id} lasts {task.duration:g} s"
            f"{' unless it reaches its goal' if task.first_exit else ''}, so the cost of the rest is not known; record the "
            f"whole episode, or give a task of that duration, such as {type(task).__name__}(duration=...)"
        )
    end = int(ended[0])
    violated = int(did.violated[end])
    return end + 1, limit_names(task, params)[violated] if violated >= 0 else "", bool(did.success[end])


def _cost(task: Task, moved: Trajectory, x: np.ndarray, c: np.ndarray) -> float:
    """Of an episode through states x (n+1, 8): each state counts for its control step, with the forces within it."""
    grid = task.control_dt * np.arange(len(x))
    edges = np.unique(np.concatenate([grid, moved.t[moved.t < grid[-1]]]))
    middles = (edges[1:] + edges[:-1]) / 2
    forces = np.array([moved.force(t) for t in middles])
    steps = np.minimum((middles / task.control_dt).astype(int), len(x) - 2)
    rates = task.cost(x[steps], forces, task.at(c, task.control_dt * steps))
    return float(np.sum(np.diff(edges) * np.broadcast_to(rates, len(middles))))


def _defects(params: Robot, moved: Trajectory) -> np.ndarray:
    """(N, 8) recorded states less those that the equations make of the ones before."""
    dt, x = np.diff(moved.t), moved.x[:-1]
    parts = params.substeps(dt.max()) * (1 if moved.held or params.DISCRETE else _LINEAR_STEPS)
    for i in range(parts):
        share = (i + 0.5) / parts
        force = moved.u if moved.held else (1 - share) * moved.u[:-1] + share * moved.u[1:]
        x = params.step(x, force, dt / parts, 1)
    return np.asarray(moved.x[1:] - x)
