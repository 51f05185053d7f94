"""What a control step costs, pays and ends: the one place that says so, for an env, for batches and for generated code.

It computes with `ops`, so with floats, torch, CasADi and `traced` alike. Truth values are the numbers 1 and 0, because only
these are the same everywhere.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.tasks.base import Task

_LARGEST_OBSERVED = 1e6  # far beyond what any episode shows

GRIP = "grip"
"""The limit that a robot violates that loses its grip."""
ENGINE = "engine"
"""The limit that is violated where an engine's simulation is unstable, so that no state follows."""


def limit_names(task: Task, params: Robot) -> tuple[str, ...]:
    """What can end an episode of a robot: the task's limits, and its grip where friction is limited."""
    return (*task.limit_names, GRIP) if params.grips else task.limit_names


class Outcome(NamedTuple):
    """What one control step did."""

    cost: Any
    """The running cost, and for a failure the price of the time that remains."""
    running: Any
    """The running cost alone."""
    goal: Any
    """Pay for the time that remains, where the goal ends the episode. The reward is survive − running + goal, with survive =
    survival_reward · control_dt."""
    terminated: Any
    truncated: Any
    success: Any
    failure: Any
    violated: Any
    """Index of the first limit that is violated, of `limit_names`; −1 for none."""


def outcome(
    task: Task, before: Vector, force: Vector, end: Vector, c: Vector, steps: Any, grip: tuple[Any, ...] = ()
) -> Outcome:
    """What a control step did.

    Args:
        task: the task.
        before: (8,) state in which the step began.
        force: (2,) force that was held, N.
        end: (8,) state after it.
        c: (nc,) constants of the episode, without the time.
        steps: control steps of the episode, this one included.
        grip: further limits, ≥ 0 where they hold: what keeps a ball's grip.
    """
    running = task.cost(before, force, task.at(c, (steps - 1) * task.control_dt)) * task.control_dt
    c = task.at(c, steps * task.control_dt)
    violated = first_violated((*task.limits(end, c), *grip))
    failure, last = violated >= 0, steps >= task.steps
    reached = ops.full_like(violated, 1.0)
    for excess in task.goal(end, c):
        reached = ops.where(excess <= 0, reached, 0.0)
    success = ops.where(failure, 0.0, reached)
    if not task.first_exit:
        success = ops.where(last, success, 0.0)
    failed = ops.where(failure, ops.full_like(violated, 1.0), 0.0)
    terminated = failed + success if task.first_exit else failed
    ahead = task.survival_reward * task.control_dt * (task.steps - steps)  # pay for the time that remains
    return Outcome(
        cost=running + ops.where(failure, ahead, 0.0),
        running=running,
        goal=ops.where(success > 0, ahead, 0.0) if task.first_exit else 0.0,
        terminated=terminated,
        truncated=ops.where(last, 1.0 - terminated, 0.0),
        success=success,
        failure=failed,
        violated=violated,
    )


class Step(NamedTuple):
    """One control step of a robot, as far as it does not start another episode."""

    end: tuple[Any, ...]
    """The state after it."""
    force: tuple[Any, ...]
    """What the actuators apply, as `Robot.ACTION` names it."""
    total: tuple[Any, ...]
    """The same with pushes."""
    actuator: tuple[Any, ...]
    """What the actuators remember."""
    clipped: Any
    """Whether a component of the action was outside [−1, 1]."""
    grip: tuple[Any, ...]
    """What `info` reports as "grip"; () of a robot that cannot lose its grip."""
    reward: Any
    outcome: Outcome


Move = Callable[[Any, tuple[Any, ...], tuple[Any, ...]], tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]]
"""Robot, state and what is applied -> the state after a control step, and what `Robot.held` gives."""


def closed_form(dt: float) -> Move:
    """How a robot moves over control steps of dt, s, by its equations of motion."""

    def move(robot: Any, x: tuple[Any, ...], u: tuple[Any, ...]) -> tuple[tuple[Any, ...], ...]:
        return robot.step(x, u, dt, robot.substeps(dt)), *robot.held(x, u, dt)

    return move  # pyright: ignore[reportReturnType]


def step(
    task: Task,
    robot: Any,
    x: tuple[Any, ...],
    c: tuple[Any, ...],
    taken: Any,
    action: tuple[Any, ...],
    variation: Randomization = Randomization(),
    drawn: tuple[Any, ...] = (),
    actuator: tuple[Any, ...] = (),
    z: tuple[Any, ...] = (),
    move: Move | None = None,
) -> Step:
    """One control step: what the actuators apply, where it takes the robot, and what it costs, pays and ends.

    A pure function over `ops`: of floats, of NumPy arrays or torch tensors (B,), and of symbols from which C is printed.

    Args:
        task: the task.
        robot: the nominal robot.
        x: the state.
        c: the constants of the episode, without the time.
        taken: control steps of the episode before this one.
        action: in units of the robot's force limit; clipped to [−1, 1].
        variation: what varies, and what it drew for the episode.
        actuator: what the actuators remember.
        z: uniform numbers for a push; () where none comes.
        move: how the robot moves; default, the closed form.
    """
    commanded = tuple([ops.clip(part, -1.0, 1.0) * robot.force_limit for part in action])
    force, actuator = variation.actuate(commanded, drawn, actuator)
    total = force
    if z:
        total = tuple([f + push for f, push in zip(force, variation.push(z, task.control_dt), strict=True)])
    model = variation.robot(robot, drawn) if variation.varies_robot else robot
    end, grip, kept = (move or closed_form(task.control_dt))(model, x, total)
    did = outcome(task, x, force, end, c, taken + 1, kept)
    largest = action[0] * action[0]
    for part in action[1:]:
        largest = ops.maximum(largest, part * part)
    reward = task.survival_reward * task.control_dt - did.running + did.goal
    return Step(end, force, total, actuator, largest > 1.0, grip, reward, did)


def first_violated(limits: tuple[Any, ...]) -> Any:
    """Index of the first limit that is not ≥ 0, so of NaN too; −1 where all are, or where there is none."""
    if not limits:
        return -1.0
    violated = ops.full_like(limits[0], -1.0)
    for i in reversed(range(len(limits))):
        violated = ops.where(limits[i] >= 0, violated, float(i))
    return violated


def check_observation(observation: Any, params: Robot, randomization: Randomization) -> str:
    """What is observed, or a ValueError."""
    if observation not in ("state", "sensors"):
        raise ValueError(f"observation must be 'state' or 'sensors', not {observation!r}")
    if observation == "sensors" and not params.SENSORS:
        raise ValueError("only robots with wheels have sensors; give robot='omni' or observation='state'")
    if observation == "sensors" and randomization.is_noisy:
        raise ValueError("sensors have noise of their own; leave out that of the randomization")
    return observation


def _observation_size(task: Task, params: Robot, observation: str) -> int:
    """Numbers that are observed. Sensors show 9 readings, x and y where the episode began, m, and the task's constants."""
    if observation == "state":
        return task.observation_size(params)
    return 11 + len(task.constant_names) + task.clock


def observation_space(task: Task, params: Robot, history: int = 0, observation: str = "state") -> spaces.Box:
    """What a robot can observe in a task, with a number of earlier observations and actions.

    Past actions lie in [−1, 1]. So the bounds tell this space from a stack of frames that has the same size.
    """
    own = _observation_size(task, params, observation)
    past = np.append(np.full(own, _LARGEST_OBSERVED), np.ones(params.action_size))
    high = np.append(np.full(own, _LARGEST_OBSERVED), np.tile(past, history)).astype(np.float32)
    return spaces.Box(-high, high, dtype=np.float32)
