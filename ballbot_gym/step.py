"""A control step, and what is observed after it: one pure function each, for an env, for batches and for generated code.

They compute with `ops`, so with floats, NumPy, torch and CasADi alike. Truth values are the numbers 1 and 0, because only
these are the same everywhere.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.robot import Randomization, Robot, Sensors
from ballbot_gym.tasks.base import Task

_LARGEST_OBSERVED = 1e6  # far beyond what any episode shows

GRIP = "grip"
"""Name of the limit that is violated when the ball loses grip."""
ENGINE = "engine"
"""The limit that is violated where an engine's simulation is unstable, so that no state follows."""


def limit_names(task: Task, params: Robot) -> tuple[str, ...]:
    """What can end an episode of a robot: the task's limits, and its grip where friction is limited."""
    return (*task.limit_names, GRIP) if params.grips else task.limit_names


class Outcome(NamedTuple):
    """What one control step costs, pays and ends."""

    reward: Any
    """The sum of the three parts that follow."""
    reward_survive: Any
    """survival_reward · control_dt."""
    reward_cost: Any
    """−cost rate · control_dt."""
    reward_goal: Any
    """Pay for the time that remains, and `Task.goal_reward`, where the goal ends the episode."""
    cost: Any
    """The running cost, the price of the time that remains after a failure, and `Task.goal_reward` where an episode ends
    without its goal."""
    terminated: Any
    truncated: Any
    success: Any
    failure: Any
    violated: Any
    """Index of the first limit that is violated, of `limit_names`; −1 for none."""


FLAGS = ("terminated", "truncated", "success", "failure", "clipped")
"""The truth values of a step, in the order in which vector envs keep them: four of its `Outcome`, and `Step.clipped`."""

PAY = ("reward", "cost", "reward_survive", "reward_cost", "reward_goal")
"""The fields of an `Outcome` that add up over an episode, in the order in which vector envs keep them."""


def outcome(
    task: Task,
    before: Vector,
    force: Vector,
    end: Vector,
    c: Vector,
    steps: Any,
    grip: tuple[Any, ...] = (),
    episode_steps: Any = None,
) -> Outcome:
    """What a control step costs, pays and ends.

    Args:
        task: the task.
        before: (8,) state in which the step began.
        force: (2,) force that was held, N.
        end: (8,) state after it.
        c: (nc,) constants of the episode, without the time.
        steps: control steps of the episode, this one included.
        grip: further limits, ≥ 0 where they hold: what keeps a ball's grip.
        episode_steps: control steps of a whole episode; default, the task's.
    """
    episode_steps = task.steps if episode_steps is None else episode_steps
    running = task.cost(before, force, task.at(c, (steps - 1) * task.control_dt)) * task.control_dt
    c = task.at(c, steps * task.control_dt)
    violated = first_violated((*task.limits(end, c), *grip), like=end)
    failure, last = violated >= 0, steps >= episode_steps
    reached = ops.full_like(violated, 1.0)
    for excess in task.goal(end, c):
        reached = ops.where(excess <= 0, reached, 0.0)
    success = ops.where(failure, 0.0, reached)
    if not task.first_exit:
        success = ops.where(last, success, 0.0)
    failed = ops.where(failure, ops.full_like(violated, 1.0), 0.0)
    terminated = failed + success if task.first_exit else failed
    ahead = task.survival_reward * task.control_dt * (episode_steps - steps)  # pay for the time that remains
    survive = ops.full_like(violated, task.survival_reward * task.control_dt)
    goal = ops.where(success > 0, ahead, 0.0) if task.first_exit else ops.full_like(violated, 0.0)
    price = ops.where(failure, ahead, 0.0)
    if task.goal_reward:
        goal = goal + success * task.goal_reward
        price = price + ops.where(last, 1.0 - success, failed) * task.goal_reward
    return Outcome(
        reward=survive - running + goal,
        reward_survive=survive,
        reward_cost=-running,
        reward_goal=goal,
        cost=running + price,
        terminated=terminated,
        truncated=ops.where(last, 1.0 - terminated, 0.0),
        success=success,
        failure=failed,
        violated=violated,
    )


class StepState(NamedTuple):
    """What determines how an environment continues, except for random numbers."""

    x: tuple[Any, ...]
    """The robot's state."""
    c: tuple[Any, ...]
    """Constants of the episode, without the time."""
    steps: Any
    """Control steps taken in the episode."""
    drawn: tuple[Any, ...] = ()
    """What the randomization drew for the episode; () where nothing varies."""
    actuator: tuple[Any, ...] = ()
    """What the actuator remembers; see `Randomization.actuate`."""
    sensors: tuple[Any, ...] = ()
    """What sensors remember, where they are what is observed; see `Sensors.MEMORY`."""


class Draws(NamedTuple):
    """Uniform numbers in [0, 1) of a control step; () of what does not vary."""

    push: tuple[Any, ...] = ()
    sensors: tuple[Any, ...] = ()
    noise: tuple[Any, ...] = ()
    """Of the observation after the step."""


class Step(NamedTuple):
    """One control step of a robot, as far as it does not start another episode."""

    state: StepState
    """The state after it."""
    outcome: Outcome
    force: tuple[Any, ...]
    """What the actuators applied, as `Robot.ACTION` names it."""
    clipped: Any
    """Whether a component of the action was outside [−1, 1]."""
    grip: tuple[Any, ...]
    """What `info` reports as "grip"; () of a robot that cannot lose its grip."""


Move = Callable[[Any, tuple[Any, ...], tuple[Any, ...]], tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]]
"""Robot, state and what is applied -> the state after a control step, and what `Robot.held` gives."""


def closed_form(dt: float, substeps: int | None = None) -> Move:
    """How a robot moves over control steps of dt, s, by its equations of motion, in `Robot.substeps` by default."""

    def move(robot: Any, x: tuple[Any, ...], u: tuple[Any, ...]) -> tuple[tuple[Any, ...], ...]:
        return robot.step(x, u, dt, substeps or robot.substeps(dt)), *robot.held(x, u, dt)

    return move  # pyright: ignore[reportReturnType]


def by_engine(end: tuple[Any, ...], floor: tuple[Any, ...], stable: Any, dt: float) -> Move:
    """How a robot moved that an engine simulates.

    Args:
        end: the state after the control step.
        floor: the floor's force on the ball at its end, (f_x, f_y, N) in N; () where the engine does not simulate it.
        stable: ≥ 0 unless the simulation became unstable.
        dt: duration of the step, s.
    """

    def move(robot: Any, x: tuple[Any, ...], u: tuple[Any, ...]) -> tuple[tuple[Any, ...], ...]:
        # a ball that slips in a simulation is no failure
        grip, kept = ((*floor, robot.needed_friction(floor)), (0.0,)) if floor else robot.held(x, u, dt)  # pyright: ignore
        return end, grip, (*kept, stable)

    return move  # pyright: ignore[reportReturnType]


def applied(
    robot: Any, variation: Randomization, state: StepState, action: tuple[Any, ...], push: tuple[Any, ...], dt: float
) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    """What acts on the robot during a control step of dt, s. The other arguments are those of `step`.

    Returns:
        what the actuators apply, as `Robot.ACTION` names it; the same with pushes; and what the actuators remember.
    """
    limit = robot.force_limit
    force = tuple([ops.clip(part, -1.0, 1.0) * limit for part in action])
    actuator = state.actuator
    if actuator:
        force, actuator = variation.actuate(force, state.drawn, actuator)
    if not push:
        return force, force, actuator
    total = tuple([f + pushed for f, pushed in zip(force, variation.push(push, dt), strict=True)])
    return force, total, actuator


def step(
    task: Task,
    robot: Any,
    variation: Randomization,
    state: StepState,
    action: tuple[Any, ...],
    z: Draws = Draws(),
    move: Move | None = None,
    model: Any = None,
    episode_steps: Any = None,
) -> Step:
    """One control step: what the actuators apply, where it takes the robot, and what it costs, pays and ends.

    A pure function over `ops`: of floats, of NumPy arrays or torch tensors (B,), and of symbols from which C is printed.

    Args:
        task: the task.
        robot: the nominal robot.
        variation: what varies.
        state: before the step.
        action: in units of the robot's force limit; clipped to [−1, 1].
        z: uniform numbers for a push and for sensors.
        move: how the robot moves; default, the closed form.
        model: the robot of the episode; default, as the variation drew it.
        episode_steps: control steps of a whole episode; default, the task's.
    """
    if model is None:
        model = variation.robot(robot, state.drawn) if variation.varies_robot else robot
    force, total, actuator = applied(robot, variation, state, action, z.push, task.control_dt)
    end, grip, kept = (move or closed_form(task.control_dt))(model, state.x, total)
    did = outcome(task, state.x, force, end, state.c, state.steps + 1, kept, episode_steps)
    read = state.sensors
    if read:
        read = Sensors(model, task.control_dt).following(read, state.x, total, end, z.sensors)
    largest = action[0] * action[0]
    for part in action[1:]:
        largest = ops.maximum(largest, part * part)
    after = state._replace(x=end, steps=state.steps + 1, actuator=actuator, sensors=read)
    return Step(after, did, force, largest > 1.0, grip)


def unmoved(task: Task, robot: Any, state: StepState) -> Step:
    """As `step` returns it, where an episode starts: nothing is applied, paid or ended, but a limit may be violated."""
    x, zero = state.x, ops.full_like(state.x[0], 0.0)
    violated = first_violated(task.limits(x, task.at(state.c, state.steps * task.control_dt)), like=x)
    grip = (zero,) * (4 if robot.grips else 0)
    return Step(state, Outcome(*(zero,) * 9, violated=violated), (zero,) * robot.action_size, zero, grip)


def start_draws(task: Task, variation: Randomization, senses: bool) -> int:
    """Uniform numbers that `start` takes."""
    varied = variation.episode_draws * variation.active
    return task.constant_draws + task.state_draws + varied + Sensors.FIRST_DRAWS * senses


def start(
    task: Task,
    robot: Any,
    variation: Randomization,
    z: tuple[Any, ...],
    senses: bool = False,
    x: tuple[Any, ...] | None = None,
    c: tuple[Any, ...] | None = None,
    drawn: tuple[Any, ...] | None = None,
) -> StepState:
    """The start of an episode.

    Args:
        task: the task.
        robot: the nominal robot.
        variation: what varies.
        z: `start_draws` uniform numbers.
        senses: whether sensors are observed, and not the state.
        x: the state; drawn where it is not given.
        c: the constants; drawn where they are not given.
        drawn: what the variation drew for the episode; drawn where it is not given.
    """
    z_constants, z = z[: task.constant_draws], z[task.constant_draws :]
    if c is None:
        c = tuple(task.draw_constants(z_constants, robot))
    if x is None:
        x = tuple(task.start(z[: task.state_draws], c, robot))
    if drawn is None:
        own = z[task.state_draws :][: variation.episode_draws]
        drawn = variation.draw(own, task.control_dt) if variation.varies_episodes else ()
    zero = ops.full_like(x[0], 0.0)
    actuator = variation.resting((zero,) * robot.action_size, task.control_dt)
    read = ()
    if senses:
        model = variation.robot(robot, drawn) if variation.varies_robot else robot
        read = Sensors(model, task.control_dt).first(x, z[-Sensors.FIRST_DRAWS :])
    return StepState(x, c, zero, drawn, actuator, read)


def observe(task: Task, robot: Any, variation: Randomization, state: StepState, noise: Any = ()) -> tuple[Any, ...]:
    """What is observed in a state, with the errors of sensors.

    Args:
        task: the task.
        robot: the nominal robot.
        variation: what varies.
        state: the state.
        noise: uniform numbers, where the variation is noisy.
    """
    time = state.steps * task.control_dt
    c = task.at(state.c, time)
    if state.sensors:
        return Sensors.seen(state.sensors, c)
    x = variation.sensed(state.x, noise, state.drawn, time) if variation.is_noisy else state.x
    return ops.components(task.seen(x, c, robot))


def first_violated(limits: tuple[Any, ...], like: Vector) -> Any:
    """Index of the first limit that is not ≥ 0, so of NaN too; −1 where all are, or where there is none.

    It has the shape and the kind of the components of `like`, a state.
    """
    violated = ops.full_like(ops.components(like)[0], -1.0)
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
        raise ValueError("sensor readings have noise of their own; leave out the noise of the randomization")
    return observation


def observation_size(task: Task, params: Robot | type[Robot], observation: str) -> int:
    """Numbers that a robot or a kind of robot observes.

    Sensors show 9 readings, x and y where the episode began, m, and the task's constants.
    """
    if observation == "state":
        return task.observation_size(params)
    return 11 + len(task.constant_names) + task.clock


def observation_space(task: Task, params: Robot, history: int = 0, observation: str = "state") -> spaces.Box:
    """What a robot can observe in a task, with a number of earlier observations and actions.

    Past actions lie in [−1, 1]. So the bounds tell this space from a stack of frames that has the same size.
    """
    own = observation_size(task, params, observation)
    past = np.append(np.full(own, _LARGEST_OBSERVED), np.ones(params.action_size))
    high = np.append(np.full(own, _LARGEST_OBSERVED), np.tile(past, history)).astype(np.float32)
    return spaces.Box(-high, high, dtype=np.float32)
