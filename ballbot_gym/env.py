"""BallbotEnv: Gymnasium's interface to a task and a simulator."""

import dataclasses
import math
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from ballbot_gym.checks import (
    check_constant_names,
    check_history,
    finite_array,
    fixed,
    real_array,
    reset_options,
)
from ballbot_gym.drawing import Drawing, Drawn
from ballbot_gym.drawing.picture import picture
from ballbot_gym.drawing.viewer import Viewer, can_show, need_library
from ballbot_gym.engines import State, checked_physics, make_simulator
from ballbot_gym.engines.closed_form import Rk4Simulator
from ballbot_gym.machine_code import step_code
from ballbot_gym.registry import named_task, spec_of
from ballbot_gym.robot import (
    PAPER,
    Randomization,
    Robot,
    checked_randomization,
    checked_robot,
    named_robot,
    needed_friction,
    own_fields,
    sensors,
)
from ballbot_gym.step import ENGINE, Outcome, check_observation, limit_names, observation_space, outcome
from ballbot_gym.tasks import TASKS, Task

_NO_GRIP = (0.0, 0.0, 0.0, 0.0)
_NOTHING_DONE = Outcome(0.0, -0.0, *(0.0,) * 5, violated=-1.0)  # whose reward_cost is 0.0
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
    """What sensors remember, where they are what is observed; see `sensors.MEMORY`."""


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
    | cost | what this step cost, a failure's price included (0 after `reset`): the objective, and no constraint's cost |
    | reward_survive | part of the reward: survival_reward · control_dt |
    | reward_cost | part of the reward: −cost rate · control_dt |
    | reward_goal | part of the reward: survival_reward for every second that remained at the first exit, else 0 |
    | tilt | rad, between the body's axis and the vertical |
    | success | the task's goal holds at the end of the episode |
    | is_success | the same, under the name that Stable-Baselines3 looks for |
    | failure | a limit is violated: the robot fell, touched something or left the arena |
    | violated | the index of that limit in `limit_names`, which holds "tilt", "arena" or "obstacle 2", for example; else −1 |
    | constraint_cost | 1.0 where a limit is violated, else 0.0: the cost of safe reinforcement learning |
    | force | (2,) N, applied in this step (0 after `reset`); with wheels (3,), the pull of each at standstill |
    | clipped | the action was outside [−1, 1] and was clipped |
    | constants | (nc,) the episode's constants, named in the task's `constant_names` |
    | grip | (4,) f_x, f_y, N of the floor on the ball as the step began, and the friction it needs (0 after `reset`) |
    | drawn | (6,) or (14,) what a randomization drew for the episode; names in `Randomization.DRAWN` |

    Only envs with a randomization have `drawn`, and only robots whose friction is limited have `grip`. Such a robot has lost
    its grip if it needs more friction, or a floor that pulls, when a step begins or at its end. The closed form cannot say
    how it slips, so with physics="rk4" that is a failure, and `violated` is the index of "grip". PyBullet and MuJoCo simulate
    the contact of a rolling ball: it slips or leaves the floor, and that by itself is no failure. `grip` is then the force at
    the end of the step.

    Where the simulation of PyBullet or MuJoCo becomes unstable, the episode fails, and `violated` is the index of "engine".
    The state is then the last one before.

    Task, robot, physics and spaces of an env are fixed: setting such an attribute is an AttributeError.

    `copy.deepcopy`, `pickle` and `cloudpickle` make an independent env in the same state. The same actions then give
    bit-identical results. A copy of a Bullet env has a physics client of its own. The page is not copied.
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
            robot: a name in `ROBOTS`, such as "paper", "rolling", "kugle" or "omni", or a Robot. Tasks draw other
                episodes for some.
            history: number of earlier observations that are appended to each observation, the latest first, each with the
                action (2) that followed it. At the start of an episode they are copies of its first one, with the action 0.
            observation: "state"; or "sensors" of a robot with wheels, as `ballbot_gym.robot.sensors` says.
            **task_fields: fields of the task that replace its defaults, as `duration=4.0`.

        Raises:
            ValueError: an unknown task, physics or render mode, or a task field out of its range.
            TypeError: a keyword that is no field of the task.
            ImportError: physics="bullet" without a usable PyBullet, "mujoco" without MuJoCo, or render_mode="human" without
                the extra "play".
        """
        self._page: Viewer | None = None
        self._state: State = ()  # until the first reset
        self.params = robot_of(task, robot, params)
        physics = checked_physics(physics, self.params)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"unknown render_mode {render_mode!r}; known: None, 'human', 'rgb_array'")
        if render_mode == "human":
            need_library()
        self.task = make_task(task, self.params, **task_fields)
        self.physics = physics
        self.render_mode = render_mode
        modes, fps = ["human", "rgb_array"] if can_show() else ["rgb_array"], round(1 / self.task.control_dt)
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": fps}
        self.action_space = spaces.Box(-1.0, 1.0, (self.params.action_size,), np.float32)
        self.randomization = checked_randomization(randomization, self.params)
        self._robot = self.params  # of the episode
        self._drawn: State = ()
        self._resting = self.randomization.resting((0.0,) * self.params.action_size, self.task.control_dt)
        self._actuator = self._resting
        self.observation = check_observation(observation, self.params, self.randomization)
        self._sensors: tuple[float, ...] = ()
        self._noisy = self.randomization.is_noisy or self.observation == "sensors"
        self.history = check_history(history)
        self.observation_space = observation_space(self.task, self.params, self.history, self.observation)
        self._past = self._tried = np.zeros(0)  # the last observation with a history, and the action on it
        self._physics_dt, self._may_lose = physics_dt, physics != "rk4"
        self._simulator = make_simulator(physics, self.params, self.task.control_dt, physics_dt)
        self._judge: step_code.Judge | None = None
        self._resets = 0
        self._constants: tuple[float, ...] = ()
        self._constants_array = np.zeros(0)
        # read in every step or reset
        self._remembers, self._varies = self.history > 0, self.randomization.varies_episodes
        self._random, self._varies_robot = self.randomization.active, self.randomization.varies_robot
        self._action_shape = self.action_space.shape
        self._steps, self._survive = self.task.steps, self.task.survival_reward * self.task.control_dt
        self._grips, self._force_limit, self._human = self.params.grips, self.params.force_limit, render_mode == "human"
        self._steps_left = self._taken = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: seeds the draw of this and the following episodes.
            options: may hold "state", the (8,) initial state; "constants", the (nc,) constants of the episode or a dict of
                some of them by name; and "drawn", what `info` has under that key. Everything else is drawn.

        Raises:
            ValueError: an unknown option, or a state or constants of the wrong shape, not finite, or unsafe.
        """
        self._check_open()
        super().reset(seed=seed)
        draws = ("drawn",) if self._varies else ()
        state, constants, *drawn = reset_options(options, "state", "constants", *draws)
        x, c = self._draw(state, constants)
        self._resets += 1
        self._use_code()
        judge, measured = self._start(x, c)
        self._set_constants(c)
        self._state = x
        if self._random:
            z = tuple(self.np_random.random(self.randomization.episode_draws).tolist())
            self._drawn, self._actuator = self.randomization.draw(z, self.task.control_dt), self._resting
            for given in drawn:
                if given is not None:
                    self._drawn = _floats(finite_array(given, (len(z),), "drawn"))
        self._restore_simulator()
        if self.observation == "sensors":
            z = tuple(self.np_random.random(sensors.FIRST_DRAWS).tolist())
            self._sensors = sensors.first(self.episode_params, x, z, self.task.control_dt)
        self._steps_left, self._taken = self._steps, 0
        if self._human:
            self.render()
        return self._shown(judge, (*_NOTHING_DONE, *measured), 0.0, (0.0,) * self.params.action_size)

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
                "the episode has ended; call reset()" if self._state else "step() before reset()"
            )
        force, clipped = self._force(action)
        total = force
        if self._drawn:
            noise = self.randomization
            force, self._actuator = noise.actuate(force, self._drawn, self._actuator)
            total = force
            if noise.pushes:
                z = tuple(self.np_random.random(Randomization.PUSH_DRAWS).tolist())
                total = tuple([f + push for f, push in zip(force, noise.push(z, self.task.control_dt), strict=True)])
        if self._remembers:
            self._tried = np.asarray(action, np.float64).clip(-1.0, 1.0).astype(_FLOAT32)
        before = self._state
        x = self._simulator.step(total)
        lost = self._may_lose and (not math.isfinite(sum(x)) or self._simulator.is_unstable())
        self._state = x = before if lost else x
        if self._sensors:
            z = tuple(self.np_random.random(sensors.DRAWS).tolist())
            self._sensors = sensors.following(
                self.episode_params, self._sensors, before, total, x, z, self.task.control_dt
            )
        self._steps_left -= 1
        grip, kept = _NO_GRIP, 0.0
        if self._grips and not lost:
            grip, kept = self._grip(before, total)
        self._taken = steps = self._steps - self._steps_left
        judge = self._judge
        did = None if judge is None or lost else judge.judge(before, force, x, steps, kept)
        if did is None:
            judge = None
            end = outcome(self.task, before, force, x, self._constants, steps, (-1.0 if lost else kept,))
            end = end._replace(violated=len(self.limit_names) - 1) if lost else end
            did = *end, *self.params.measurements(x)
        terminated = did[3] > 0
        if terminated:
            self._steps_left = 0
        if self._human:
            self.render()
        seen, info = self._shown(judge, did, self._survive, force, clipped, grip)
        return seen, self._survive - did[1] + did[2], terminated, did[4] > 0, info

    @property
    def limit_names(self) -> tuple[str, ...]:
        names = super().limit_names
        return (*names, ENGINE) if self._may_lose else names

    @property
    def episode_params(self) -> Robot:
        """The robot of the running episode: `params`, unless randomized."""
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
        if not self._state:
            raise gymnasium.error.ResetNeeded("render() before reset()")
        markers = tuple(self.task.markers(self._constants_array))
        drawing = Drawing(self.params, (Drawn(np.array(self._state)),), markers=markers)
        if self.render_mode == "rgb_array":
            return picture(drawing)
        if self._page is None:
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
        if not self._state:
            raise gymnasium.error.ResetNeeded("get_state() before reset()")
        rng, memory, past = (
            dict(self.np_random.bit_generator.state),
            self._simulator.memory(),
            tuple(self._past.tolist()),
        )
        held = self._state, self._constants, self._steps_left, rng, self._drawn, self._actuator, memory, past
        return EnvState(self.task, *held, self._sensors)

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
        if (bool(state.drawn), *observed) != (self.randomization.active, size, self.observation == "sensors"):
            raise ValueError("the state is of an env with another randomization, history or observation")
        self._drawn, self._actuator, self._sensors = state.drawn, state.actuator, state.sensors
        self._past = np.array(state.past, np.float32)
        self._set_constants(state.constants)
        self._state, self._steps_left = state.x, state.steps_left
        self._taken = self.task.steps - state.steps_left
        self.np_random.bit_generator.state = state.rng
        self._restore_simulator(state.memory)

    def __getstate__(self) -> dict[str, Any]:
        self.np_random  # noqa: B018  an env that was never seeded is seeded here, so that its copy draws the same episodes
        kept = {name: value for name, value in self.__dict__.items() if name not in ("_simulator", "_page", "_judge")}
        return kept | {"_memory": () if self.closed else self._simulator.memory()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        memory = state.pop("_memory")
        self.__dict__.update(state)
        self._page = self._judge = None
        self._simulator = make_simulator(self.physics, self.params, self.task.control_dt, self._physics_dt)
        if self.closed:
            self._simulator.close()
        elif self._state:
            self._use_code()
            self._set_constants(self._constants)
            self._restore_simulator(memory)

    def close(self) -> None:
        """Releases the physics client and the page; may be called again."""
        self.closed = True
        self._steps_left = 0
        self._simulator.close()
        if self._page is not None:
            self._page.close()
            self._page = None

    def _set_constants(self, c: State) -> None:
        """Makes c the constants of the episode."""
        self._constants, self._constants_array = c, np.array(c, np.float64)
        if self._judge is not None:
            self._judge.c[:] = c

    def _use_code(self) -> None:
        """Takes machine code if there is some, from the second episode on. `_set_constants` must follow."""
        if self._resets < 2:
            return  # an env of one episode is not worth a compilation
        if isinstance(self._simulator, Rk4Simulator):
            self._simulator.use_code()
        if self._judge is None:
            self._judge = step_code.judge(self.task, self.params)

    def _restore_simulator(self, memory: tuple[float, ...] = ()) -> None:
        """Puts the simulator into the env's state, and what it remembers besides into its memory."""
        if self._varies_robot:
            self._robot = self.randomization.robot(self.params, self._drawn)
            self._simulator.set_params(self._robot)
        self._simulator.reset(self._state, memory)

    def _grip(self, x: State, total: tuple[float, ...]) -> tuple[tuple[float, ...], float]:
        """What `info` reports as "grip" of a step from state x, and a limit that is ≥ 0 if the robot kept its grip."""
        simulated = self._simulator.floor_force()
        if simulated is not None:
            return (*simulated, needed_friction(simulated)), 0.0
        grip, limits = self.episode_params.held(x, total, self.task.control_dt)
        return grip, min(limits)

    def _start(self, x: State, c: State) -> tuple[step_code.Judge | None, State]:
        """Who judged a start, if machine code did, and its measurements. Raises a ValueError if it is out of range."""
        if self._judge is not None:
            self._judge.c[:] = c
            did = self._judge.judge(x, (0.0,) * self.params.action_size, x, 0, 0.0)
            if did is not None and did[7] < 0:
                return self._judge, did[8:]
            if self._state:  # the episode of the env continues if this one cannot start
                self._judge.c[:] = self._constants
        task = self.task
        if violated := task.violated(x, task.at(c, 0.0)):
            values = [f"{quantity.name} = {value:g}" for quantity, value in zip(self.params.STATE, x, strict=True)]
            measured = zip(self.params.MEASUREMENTS, self.params.measurements(x), strict=True)
            values += [f"{quantity.name} = {value:g} {quantity.unit}" for quantity, value in measured]
            raise ValueError(
                f"{task.id}: the start state is out of range: it violates the limit of {violated} ({', '.join(values)})"
            )
        return None, self.params.measurements(x)

    def _draw(self, state: Any, constants: Any) -> tuple[State, State]:
        """Initial state and constants. Those that are not given are drawn."""
        task = self.task
        draws = self.np_random.random(task.constant_draws + task.state_draws).tolist()
        c = _floats(task.draw_constants(tuple(draws[: task.constant_draws]), self.params))
        if constants is not None:
            if isinstance(constants, dict):
                check_constant_names(task, constants)
                constants = [constants.get(name, value) for name, value in zip(task.constant_names, c, strict=True)]
            given = finite_array(constants, (len(task.constant_names),), "constants")
            task.check_constants(given, self.params)
            c = _floats(given)
        x = _floats(task.start(tuple(draws[task.constant_draws :]), c, self.params))
        return x if state is None else _floats(finite_array(state, (self.params.state_size,), "state")), c

    def _force(self, action: Sequence[float] | np.ndarray) -> tuple[tuple[float, ...], bool]:
        """The force, N, of an action, and whether it was clipped."""
        parts = real_array(action, "action", self._action_shape).tolist()
        limit = self._force_limit
        if max(parts) <= 1.0 and min(parts) >= -1.0 and math.isfinite(sum(parts)):  # max and min may pass over a NaN
            return tuple([limit * part for part in parts]), False
        if not all(map(math.isfinite, parts)):
            raise ValueError(f"action must be finite, not {parts}")
        return tuple([limit * min(max(part, -1.0), 1.0) for part in parts]), True

    def _observed(self) -> tuple[float, ...]:
        """(no) observation of the present state, with the sensors' noise."""
        x, c = self._state, self.task.at(self._constants, self._taken * self.task.control_dt)
        if self._sensors:
            return sensors.seen(self._sensors, c)
        if self._noisy:
            z = tuple(self.np_random.random(Randomization.NOISE_DRAWS).tolist())
            x = self.randomization.sensed(x, z, self._drawn, self._taken * self.task.control_dt)
        return self.task.seen(x, c, self.params)

    def _shown(
        self,
        judge: step_code.Judge | None,
        did: State,
        survive: float,
        force: tuple[float, ...],
        clipped: bool = False,
        grip: tuple[float, ...] = _NO_GRIP,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Observation and `info` of what a step did, an `Outcome` and measurements; who judged it, unless Python did."""
        seen = np.array(self._observed(), np.float32) if judge is None or self._noisy else judge.seen.astype(_FLOAT32)
        if self._remembers:
            own, old = len(seen), self._past
            if self._taken:
                self._past = np.concatenate((seen, old[:own], self._tried, old[own:]))[: len(old)]
            else:
                still = np.zeros(self.params.action_size, np.float32)
                self._past = np.append(seen, np.tile(np.append(seen, still), self.history))
            seen = self._past.copy()
        cost, running, goal, _, _, succeeded, failed, violated, *measured = did
        success = succeeded > 0
        info = {
            "state": np.array(self._state) if judge is None else judge.x.copy(),
            "cost": cost,
            "reward_survive": survive,
            "reward_cost": -running,
            "reward_goal": goal,
            **self.params.named_measurements(measured),
            "success": success,
            "is_success": success,
            "failure": failed > 0,
            "violated": int(violated),
            "constraint_cost": failed,
            "force": np.array(force) if judge is None else judge.force.copy(),
            "clipped": clipped,
            "constants": self._constants_array.copy(),
        }
        if self._grips:
            info["grip"] = np.array(grip)
        if self._varies:
            info["drawn"] = np.array(self._drawn)
        return seen, info


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
    return TASKS[task](**(own_fields(robot, task) | task_fields))


def robot_of(task: str | Task, robot: Any = PAPER, params: Any = None) -> Robot:
    """The robot that was given, see `checked_robot`; by default the one that the task names as its own."""
    if params is None and isinstance(robot, str) and robot == PAPER:
        robot = (type(task) if isinstance(task, Task) else TASKS[named_task(task)]).ROBOT
    return checked_robot(robot, params)


def _floats(vector: Sequence[Any] | np.ndarray) -> State:
    return tuple(map(float, vector))
