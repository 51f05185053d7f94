"""BallbotEnv: Gymnasium's interface to a task and a simulator."""

import dataclasses
import math
import sys
from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from ballbot_gym.checks import (
    check_history,
    finite_array,
    fixed,
    real_array,
    reset_options,
)
from ballbot_gym.drawing import Drawing, Drawn, can_view, need_viewer
from ballbot_gym.engines import State, checked_physics, make_simulator
from ballbot_gym.engines.closed_form import Rk4Simulator
from ballbot_gym.machine_code.single import StepCode, StepProblem
from ballbot_gym.registry import named_task, spec_of
from ballbot_gym.robot import (
    PAPER,
    ROBOTS,
    Randomization,
    Robot,
    checked_robot,
    named_robot,
    robot_name,
)
from ballbot_gym.step import (
    ENGINE,
    Draws,
    Step,
    StepState,
    applied,
    by_engine,
    check_observation,
    closed_form,
    limit_names,
    observation_space,
    observe,
    start,
    start_draws,
    step,
    unmoved,
)
from ballbot_gym.tasks import TASKS, Task

if TYPE_CHECKING:
    from ballbot_gym.drawing.viewer import Viewer

_FLOAT32 = np.dtype(np.float32)


class EnvState(NamedTuple):
    """What `BallbotEnv.get_state` returns: everything that determines the rest of an episode. It may be pickled."""

    task: Task
    x: State
    """(8,) state; order and units in `Ballbot.STATE`, or (11,) as `Omni.STATE`."""
    constants: State
    """(nc,) constants of the episode."""
    steps_left: int
    """Control steps to the end of the episode; 0 where it has ended."""
    rng: dict[str, Any]
    """State of the random number generator."""
    drawn: State = ()
    """What the randomization drew for the episode; () where nothing varies."""
    actuator: State = ()
    """What the actuator remembers; see `Randomization.actuate`."""
    memory: tuple[float, ...] = ()
    """What the simulator remembers besides the state; see `Simulator.memory`."""
    past: tuple[float, ...] = ()
    """What is observed of the present, and of the past behind it, where the env has a history."""
    sensors: tuple[float, ...] = ()
    """What sensors remember, where they are what is observed; see `Sensors.MEMORY`."""


class TaskEnv:
    """What single and vector environments of a task share."""

    task: Task
    params: Robot
    randomization: Randomization
    closed = False
    most_steps: int | None = None
    """Control steps after which an episode is truncated, where they are fewer than the task's."""
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The registered spec, with the number of control steps of these episodes."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec_of(spec, self.task, self.params, self.randomization, self.most_steps)

    @property
    def limit_names(self) -> tuple[str, ...]:
        """What can end an episode; `info["violated"]` is an index of it."""
        return limit_names(self.task, self.params)

    def _check_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("this environment was closed; make a new one")


@fixed("task", "params", "randomization", "history", "observation", "physics", "render_mode")
@fixed("action_space", "observation_space")
class BallbotEnv(TaskEnv, gymnasium.Env):
    """A ballbot that does one task. The task's docstring lists observation, action, cost and ends of episodes.

    The reward of a step is `task.survival_reward` · control_dt minus the step's cost. A failure ends the episode, and its
    last step costs survival_reward for every remaining second. So return + cost = `task.survival_pay` in every episode, and
    maximizing the return minimizes the cost; see `Task`.

    `info` has, after `reset` and each `step`:

    | key | meaning |
    |---|---|
    | state | (8,) float64 state x; order and units in `Ballbot.STATE`; with wheels (11,), in `Omni.STATE` |
    | cost | cost of this step, with the price of a failure (0 after `reset`): the objective, and no constraint's cost |
    | reward_survive | part of the reward: survival_reward · control_dt |
    | reward_cost | part of the reward: −cost rate · control_dt |
    | reward_goal | part of the reward: at the first exit survival_reward for each second that remained, and `goal_reward` |
    | tilt | rad, between the body's axis and the vertical |
    | success | the task's goal holds at the end of the episode |
    | is_success | the same, under the name that Stable-Baselines3 looks for |
    | failure | a limit is violated: the robot fell, touched something or left the arena |
    | violated | the index of that limit in `limit_names`, which holds "tilt", "arena" or "obstacle 2", for example; else −1 |
    | constraint_cost | 1.0 where a limit is violated, else 0.0: the cost of safe reinforcement learning |
    | force | (2,) N, applied in this step (0 after `reset`); with wheels (3,), the force of each wheel at standstill |
    | clipped | the action was outside [−1, 1] and was clipped |
    | constants | (nc,) the episode's constants, named in the task's `constant_names` |
    | grip | (4,) f_x, f_y, N of the floor on the ball when the step began, and the friction it needs (0 after `reset`) |
    | drawn | (6,), (14,) or (20,) numbers that a randomization drew for the episode, see `Randomization.DRAWN` |

    Only envs with a randomization have `drawn`, and only robots whose friction is limited have `grip`. Such a robot has lost
    its grip if, at the beginning or at the end of a step, its motion needs more friction than there is, or a floor that
    pulls. The closed form does not model a slipping ball, so with physics="rk4" a loss of grip is a failure, and `violated`
    is the index of "grip". PyBullet and MuJoCo simulate the contact of a rolling ball: it may slip or leave the floor, which
    is no failure. `grip` is then the force at the end of the step.

    If the simulation of PyBullet or MuJoCo becomes unstable, the episode fails, and `violated` is the index of "engine". The
    state is then the last one before the instability.

    Task, robot, physics and spaces of an env are fixed: setting such an attribute raises an AttributeError.

    `copy.deepcopy`, `pickle` and `cloudpickle` make an independent env in the same state. The same actions then give
    bit-identical results. A copy in PyBullet has a physics client of its own. The page of render_mode="human" is not copied.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 50}

    def __init__(
        self,
        task: str | Task = "stabilize",
        physics: str | None = None,
        render_mode: str | None = None,
        params: Robot | None = None,
        physics_dt: float | None = None,
        randomization: Randomization | str | None = None,
        robot: str | Robot = PAPER,
        history: int = 0,
        observation: str = "state",
        **task_fields: Any,
    ):
        """Makes the environment; usually through `gymnasium.make("BallbotStabilize-v0", ...)`.

        Args:
            task: a name in `TASKS`, an id, or a Task.
            physics: "bullet" or "pybullet", the URDF in PyBullet; "mujoco", the same robot in MuJoCo; or "rk4", the
                closed-form model. Default, for every id too, the first that is installed; "rk4" comes with a warning.
            render_mode: None; "rgb_array", which needs no display; or "human": a page in the browser, in real time.
            params: the robot as a Robot; the same as robot.
            physics_dt: s, the simulator's step; default 1 ms for Bullet, 5 ms for MuJoCo, 2 ms where it has contact, and
                10 ms for rk4.
            randomization: what varies, or a name in `TRACKS`; default, nothing. In Bullet each new `com_height` loads a URDF,
                which takes 2 ms and 5 kB of memory that PyBullet never frees.
            robot: a name in `ROBOTS`, such as "paper", "rolling", "kugle" or "omni", or a Robot. For some robots the
                episodes of a task are easier.
            history: number of earlier observations that are appended to each observation, the latest first, each with the
                action (2) that followed it. At the start of an episode they are copies of its first observation, each with
                an action of 0.
            observation: "state"; or "sensors" of a robot with wheels, as `ballbot_gym.robot.sensors` says.
            **task_fields: fields of the task that replace its defaults, as `duration=4.0`.

        Raises:
            ValueError: an unknown task, physics or render mode, or a task field out of its range.
            TypeError: a keyword that is no field of the task.
            ImportError: physics="bullet" without a usable PyBullet, "mujoco" without MuJoCo, or render_mode="human" without
                the extra "play".
        """
        self._page: "Viewer | None" = None
        self._now: StepState | None = None  # until the first reset
        self.params = robot_of(task, robot, params)
        self.physics = physics = checked_physics(physics, self.params)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"unknown render_mode {render_mode!r}; known: None, 'human', 'rgb_array'")
        if render_mode == "human":
            need_viewer()
        self.task = make_task(task, self.params, **task_fields)
        self.render_mode = render_mode
        modes, fps = ["human", "rgb_array"] if can_view() else ["rgb_array"], round(1 / self.task.control_dt)
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": fps}
        dt = self.task.control_dt
        self.action_space = spaces.Box(-1.0, 1.0, (self.params.action_size,), np.float32)
        self.randomization = Randomization.checked(randomization, self.params)
        self._robot = self.params  # of the episode
        self.observation = check_observation(observation, self.params, self.randomization)
        self.randomization.delay_steps(dt)  # raises an error where it is no whole number of these
        self.history = check_history(history)
        self.observation_space = observation_space(self.task, self.params, self.history, self.observation)
        self._past = np.zeros(0)  # the last observation with a history
        self._physics_dt, self._engine = physics_dt, physics != "rk4"
        self._contact = self._engine and self.params.CONTACT and self.params.grips
        self._simulator = make_simulator(physics, self.params, dt, physics_dt)
        self._substeps = self._simulator.substeps if isinstance(self._simulator, Rk4Simulator) else 0
        self._senses = self.observation == "sensors"
        self.step_problem = StepProblem(
            self.task, self.params.kind, self.randomization, self._senses, self._substeps, self._contact
        )
        self._code: StepCode | None = None
        self._constants, self._measured = np.zeros(0), tuple(each.name for each in self.params.MEASUREMENTS)
        # read in every step
        self._varies = self.randomization.varies_episodes
        self._draws = self.step_problem.draws()
        self._random = any(self._draws)
        self._start_draws = start_draws(self.task, self.randomization, self._senses)
        self._action_shape, self._human = self.action_space.shape, render_mode == "human"
        self._steps_left = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: seeds the draw of this and the following episodes.
            options: may contain "state", the (8,) initial state; "constants", the (nc,) constants of the episode or a dict of
                some of them by name; and "drawn", the parameters of a randomization, as `info` has them. Everything else is
                drawn at random.

        Raises:
            ValueError: an unknown option, or a state or constants of the wrong shape, not finite, or unsafe.
        """
        self._check_open()
        super().reset(seed=seed)
        draws = ("drawn",) if self._varies else ()
        state, constants, *drawn = reset_options(options, "state", "constants", *draws)
        now = self._started(state, constants, drawn[0] if drawn else None)
        self._begin(now)
        z = tuple(self.np_random.random(len(self._draws.noise)).tolist()) if self._random else ()
        if self._code is None:
            made, measured, seen, x, force = self._shown(unmoved(self.task, self.params, now), z)
        else:
            made, measured = self._code.start(now, z)
            seen, x, force = self._code.seen.astype(_FLOAT32), np.array(now.x), self._code.force.copy()
        self._steps_left = 0
        self._check_start(made)
        self._steps_left = self.task.steps
        if self._human:
            self.render()
        info = self._info(made, measured, x, force)
        return self._with_past(seen), info

    def step(self, action: Sequence[float] | np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds a force for one control step.

        Args:
            action: (2,) force in units of the robot's force limit; clipped to [−1, 1]. With wheels (3,), the torque of each
                motor at standstill in units of its stall torque.

        Raises:
            ValueError: an action that is not of real, finite numbers or not of the action space's shape.
            gymnasium.error.ResetNeeded: before `reset`, or after the end of an episode.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        if self._steps_left <= 0:
            self._check_open()
            raise gymnasium.error.ResetNeeded(
                "the episode has ended; call reset()" if self._now else "step() before reset()"
            )
        parts, z, code = self._checked(action), self._draws, self._code
        if self._random:
            z = _split(self.np_random, z)
        now = self._now
        assert now is not None
        moved = self._simulated(now, parts, z) if self._engine else None
        if code is None:
            made, measured, seen, x, force = self._interpreted(now, parts, z, moved)
        else:
            made, measured = code.step(now, parts, z, moved)
            seen, x, force = code.seen.astype(_FLOAT32), code.x.copy(), code.force.copy()
        self._now, did = made.state, made.outcome
        self._steps_left -= 1
        terminated = did.terminated > 0
        if terminated:
            self._steps_left = 0
        if self._human:
            self.render()
        info = self._info(made, measured, x, force)
        if self._past.size:
            seen = self._with_past(seen, parts)
        return seen, did.reward, terminated, did.truncated > 0, info

    def _interpreted(
        self, now: StepState, action: tuple[float, ...], z: Draws, moved: tuple[State, tuple[float, ...], float] | None
    ) -> tuple[Step, State, np.ndarray, np.ndarray, np.ndarray]:
        """A control step in Python, and what `_shown` says of it."""
        dt = self.task.control_dt
        move = by_engine(*moved, dt) if moved else closed_form(dt, self._substeps)
        made = step(self.task, self.params, self.randomization, now, action, z, move, self._robot)
        return self._shown(made, z.noise)

    def _shown(self, made: Step, noise: tuple[float, ...]) -> tuple[Step, State, np.ndarray, np.ndarray, np.ndarray]:
        """A step, and measurements, (no,) float32 observation, state and force after it."""
        after = made.state
        seen = np.array(observe(self.task, self.params, self.randomization, after, noise), np.float32)
        return made, self.params.measurements(after.x), seen, np.array(after.x), np.array(made.force)

    def _check_start(self, made: Step) -> None:
        """Raises a ValueError if an episode would start out of range."""
        if made.outcome.violated < 0:
            return
        params, x = self.params, made.state.x
        values = [f"{quantity.name} = {value:g}" for quantity, value in zip(params.STATE, x, strict=True)]
        measured = zip(params.MEASUREMENTS, params.measurements(x), strict=True)
        values += [f"{quantity.name} = {value:g} {quantity.unit}" for quantity, value in measured]
        violated = self.limit_names[int(made.outcome.violated)]
        raise ValueError(
            f"{self.task.id}: the start state is out of range: it violates the limit of {violated} ({', '.join(values)})"
        )

    def _simulated(self, now: StepState, action: tuple[float, ...], z: Draws) -> tuple[State, tuple[float, ...], float]:
        """The engine's control step: the state after it, the floor's force where it is simulated, and ≥ 0 if it is stable."""
        simulator = self._simulator
        _, total, _ = applied(self.params, self.randomization, now, action, z.push, self.task.control_dt)
        x, floor = simulator.step(total), ()
        if not math.isfinite(sum(x)) or simulator.is_unstable():
            return now.x, (0.0, 0.0, 0.0) if self._contact else (), -1.0
        if self._contact:
            floor = simulator.floor_force() or ()
        return x, floor, 0.0

    @property
    def limit_names(self) -> tuple[str, ...]:
        names = super().limit_names
        return (*names, ENGINE) if self._engine else names

    @property
    def episode_params(self) -> Robot:
        """The robot of the running episode: `params`, or what a randomization drew."""
        return self._robot

    @property
    def slip(self) -> float:
        """Speed of the ball's lowest point over the floor, m/s: 0 in models whose ball cannot slip."""
        self._check_open()
        return math.hypot(*self._simulator.slip())

    def render(self) -> np.ndarray | None:
        """The current state as an image (height, width, 3), uint8, or on the page of render_mode="human"."""
        self._check_open()
        if self.render_mode is None:
            gymnasium.logger.warn('render() without a render mode; make the environment with render_mode="rgb_array"')
            return None
        if self._now is None:
            raise gymnasium.error.ResetNeeded("render() before reset()")
        markers = tuple(self.task.markers(self._constants))
        drawing = Drawing(self.params, (Drawn(np.array(self._now.x)),), markers=markers)
        if self.render_mode == "rgb_array":
            from ballbot_gym.drawing.picture import picture  # here and below, because most environments draw nothing

            return picture(drawing)
        if self._page is None:
            from ballbot_gym.drawing.viewer import Viewer

            self._page = Viewer()
            sys.stderr.write(f"the robot is shown at {self._page.address}\n")
        self._page.show(drawing, self.task.control_dt)
        return None

    def get_state(self) -> EnvState:
        """The state of the env in its episode. `set_state` continues from it bit-identically, for instance in tree search.

        Raises:
            gymnasium.error.ResetNeeded: before `reset`.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        self._check_open()
        if self._now is None:
            raise gymnasium.error.ResetNeeded("get_state() before reset()")
        x, c, _, drawn, actuator, read = self._now
        rng, memory = dict(self.np_random.bit_generator.state), self._simulator.memory()
        past = tuple(self._past.tolist())
        return EnvState(self.task, x, c, self._steps_left, rng, drawn, actuator, memory, past, read)

    def set_state(self, state: EnvState) -> None:
        """Continues from a state that `get_state` of this env returned, or `get_state` of an env with the same arguments.

        An env that `gymnasium.make` returned still needs a `reset` before its first `step`.

        Raises:
            ValueError: the state is of another task, or of an env with other randomization.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        self._check_open()
        if not isinstance(state, EnvState):
            raise TypeError(f"set_state() takes what get_state() returned, not {type(state).__name__}")
        if state.task != self.task:
            raise ValueError(f"the state is of {state.task}, and this env's task is {self.task}")
        observed = len(state.past), bool(state.sensors)
        size = sum(self.observation_space.shape or ()) if self.history else 0
        if (bool(state.drawn), *observed) != (self._varies, size, self._senses):
            raise ValueError("the state is of an env with another randomization, history or observation")
        self._past = np.array(state.past, np.float32)
        self._steps_left = state.steps_left
        self.np_random.bit_generator.state = state.rng
        steps = self.task.steps - state.steps_left
        self._begin(
            StepState(state.x, state.constants, steps, state.drawn, state.actuator, state.sensors), state.memory
        )

    def __getstate__(self) -> dict[str, Any]:
        self.np_random  # noqa: B018  an env that was never seeded is seeded here, so that its copy draws the same episodes
        kept = {name: value for name, value in self.__dict__.items() if name not in ("_simulator", "_page", "_code")}
        return kept | {"_memory": () if self.closed else self._simulator.memory()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        memory = state.pop("_memory")
        self.__dict__.update(state)
        self._page = self._code = None
        self._simulator = make_simulator(self.physics, self.params, self.task.control_dt, self._physics_dt)
        if self.closed:
            self._simulator.close()
        elif self._now is not None:
            self._begin(self._now, memory)

    def close(self) -> None:
        """Releases the physics client and the page; may be called again."""
        self.closed = True
        self._steps_left = 0
        self._simulator.close()
        if self._page is not None:
            self._page.close()
            self._page = None

    def _begin(self, now: StepState, memory: tuple[float, ...] = ()) -> None:
        """Continues from a state, with what the simulator remembers besides."""
        self._now, self._constants = now, np.array(now.c, np.float64)
        if self.randomization.varies_robot:
            self._robot = self.randomization.robot(self.params, now.drawn)
            self._simulator.set_params(self._robot)
        self._simulator.reset(now.x, memory)
        if self._code is None:
            self._code = StepCode.compiled(self.step_problem, self.params)
        if self._code is not None:
            self._code.begin(now.c, now.drawn, self.params, self._robot)

    def _started(self, state: Any, constants: Any, drawn: Any) -> StepState:
        """The start of an episode. What is not given is drawn. Raises a ValueError if what is given is no such thing."""
        task, params, noise = self.task, self.params, self.randomization
        z = tuple(self.np_random.random(self._start_draws).tolist())
        c = None
        if constants is not None:
            if isinstance(constants, dict):
                task.check_constant_names(constants)
                own = task.draw_constants(z[: task.constant_draws], params)
                constants = [constants.get(name, value) for name, value in zip(task.constant_names, own, strict=True)]
            given = finite_array(constants, (len(task.constant_names),), "constants")
            task.check_constants(given, params)
            c = _floats(given)
        x = None if state is None else _floats(finite_array(state, (params.state_size,), "state"))
        if drawn is not None:
            drawn = _floats(finite_array(drawn, (noise.episode_draws,), "drawn"))
        begun = start(task, params, noise, z, self._senses, x, c, drawn)
        begun = StepState(_floats(begun.x), _floats(begun.c), 0, *begun[3:])
        if x is not None or c is not None:
            self._check_start(unmoved(task, params, begun))  # now, so that an episode goes on after such a mistake
        return begun

    def _checked(self, action: Sequence[float] | np.ndarray) -> tuple[float, ...]:
        """An action as floats. Raises a ValueError if it is none."""
        parts = real_array(action, "action", self._action_shape).tolist()
        if not math.isfinite(sum(parts)) and not all(map(math.isfinite, parts)):
            raise ValueError(f"action must be finite, not {parts}")
        return tuple(parts)

    def _with_past(self, own: np.ndarray, tried: tuple[float, ...] | None = None) -> np.ndarray:
        """An observation, with the past behind it; at the start of an episode nothing was tried."""
        if not self.history:
            return own
        if tried is None:
            still = np.zeros(self.params.action_size, np.float32)
            self._past = np.append(own, np.tile(np.append(own, still), self.history))
        else:
            old, size = self._past, len(own)
            action = np.array(tried).clip(-1.0, 1.0).astype(np.float32)
            self._past = np.concatenate((own, old[:size], action, old[size:]))[: len(old)]
        return self._past.copy()

    def _info(self, made: Step, measured: State, x: np.ndarray, force: np.ndarray) -> dict[str, Any]:
        """`info` of a step, with what is measured, the state and the force."""
        _, survive, running, goal, cost, _, _, succeeded, failed, violated = made.outcome
        success = succeeded > 0
        info = {
            "state": x,
            "cost": cost,
            "reward_survive": survive,
            "reward_cost": running,
            "reward_goal": goal,
            "success": success,
            "is_success": success,
            "failure": failed > 0,
            "violated": int(violated),
            "constraint_cost": failed,
            "force": force,
            "clipped": made.clipped > 0,
            "constants": self._constants.copy(),
        }
        info.update(zip(self._measured, measured))  # noqa: B905  strict takes time in every step
        if made.grip:
            info["grip"] = np.array(made.grip)
        if self._varies:
            info["drawn"] = np.array(made.state.drawn)
        return info


def make_task(task: str | Task, robot: str | Robot = PAPER, /, **task_fields: Any) -> Task:
    """The task named, with some fields replaced.

    Args:
        task: a name in `TASKS`, MODULE:NAME of one that a module registers, its id, or a Task.
        robot: whose defaults the fields have: a name in `ROBOTS`, or a Robot; default, the robot that the task names.
        **task_fields: fields that replace the defaults.

    Raises:
        ValueError: no task of that name, or fields given together with a Task.
        TypeError: a keyword that is no field of the task.
    """
    if isinstance(task, Task):
        if task_fields:
            raise ValueError(f"fields {sorted(task_fields)} cannot be given together with a Task; use replace()")
        return task
    task = named_task(task)
    own, given = named_robot(TASKS[task].ROBOT), robot_of(task, robot)
    family = [kind for kind in type(own).__mro__ if issubclass(kind, Robot)][-2]  # below Robot itself
    if not isinstance(given, family):
        raise ValueError(
            f"{TASKS[task].id} is a task of a {family.__name__}, and the robot is a {type(given).__name__}; give robot="
            f"{TASKS[task].ROBOT!r}"
        )
    known = sorted(field.name for field in dataclasses.fields(TASKS[task]))
    for name in sorted(task_fields.keys() - set(known)):
        # Python's own words, because clients such as torchrl look for them.
        raise TypeError(f"{TASKS[task].id} got an unexpected keyword argument {name!r}; it has {', '.join(known)}")
    name = robot.rpartition(":")[2] if isinstance(robot, str) else robot_name(robot)
    return TASKS[task](**(ROBOTS[name].fields.get(task, {}) | task_fields))


def robot_of(task: str | Task, robot: Any = PAPER, params: Any = None) -> Robot:
    """The robot that was given, see `checked_robot`; by default the one that the task names as its own."""
    if params is None and isinstance(robot, str) and robot == PAPER:
        robot = (type(task) if isinstance(task, Task) else TASKS[named_task(task)]).ROBOT
    return checked_robot(robot, params)


def _floats(vector: Sequence[Any] | np.ndarray) -> State:
    return tuple(map(float, vector))


def _split(rng: np.random.Generator, like: Draws) -> Draws:
    """As many uniform numbers as there are."""
    z = iter(rng.random(sum(map(len, like))).tolist())
    return Draws._make(tuple(islice(z, len(part))) for part in like)
