"""BallbotEnv: Gymnasium's interface to a task and a simulator."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ballbot_gym import dynamics
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.randomization import Disturbance, Randomization
from ballbot_gym.scene import Scene
from ballbot_gym.simulator import PHYSICS, State
from ballbot_gym.tasks import TASKS, Task


class BallbotEnv(gymnasium.Env):
    """A ballbot that does one task. The task's docstring lists observation, action, cost and ends of episodes.

    The reward of a step is −cost rate · control_dt, less the task's failure cost when a margin is violated, so an
    episode's return is exactly minus its cost.

    `info` has, after `reset` and each `step`:

    | key | meaning |
    |---|---|
    | state | (8,) float64 state x; order and units in `dynamics.STATE` |
    | cost | what this step cost: −reward (0 after `reset`) |
    | tilt | rad, between the body's axis and the vertical |
    | success | the task's goal holds at the end of the episode |
    | failure | a margin is violated: the robot fell or touched something |
    | force | (2,) N, applied in this step (0 after `reset`) |
    | clipped | the action was outside [−1, 1] and was clipped |
    | constants | (nc,) the episode's constants, named in the task's `constant_names` |
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 50}

    def __init__(
        self,
        task: str | Task = "stabilize",
        physics: str = "bullet",
        render_mode: str | None = None,
        params: BallbotParams | None = None,
        physics_dt: float | None = None,
        randomization: Randomization | None = None,
        **task_fields: Any,
    ):
        """Makes the environment; usually through `gymnasium.make("BallbotStabilize-v0", ...)`.

        Args:
            task: a name in `TASKS`, or a Task.
            physics: "bullet", the URDF in PyBullet, or "rk4", the closed-form model.
            render_mode: None, "rgb_array" or "human".
            params: the robot; default, the paper's.
            physics_dt: s, the simulator's step; default 1 ms for Bullet and 10 ms for rk4.
            randomization: what varies; default, nothing. In Bullet each new `com_height` loads a URDF, which takes 2 ms
                and 5 kB of memory that PyBullet never frees.
            **task_fields: fields of the task that replace its defaults, as `duration=4.0`.

        Raises:
            ValueError: an unknown task, physics or render mode, or a task field out of its range.
            TypeError: a keyword that is no field of the task.
            ImportError: physics="bullet" without a usable PyBullet.
        """
        self._scene: Scene | None = None
        self._state: State = ()  # until the first reset
        if physics not in PHYSICS:
            raise ValueError(f"unknown physics {physics!r}; known: {', '.join(map(repr, PHYSICS))}")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"unknown render_mode {render_mode!r}; known: None, 'human', 'rgb_array'")
        self.task = make_task(task, **task_fields)
        self.params = default_params() if params is None else params
        self.physics = physics
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1 / self.task.control_dt)}
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        limit = self.task.OBSERVATION_LIMIT
        self.randomization = Randomization() if randomization is None else randomization
        self._disturbance = (
            Disturbance(self.randomization, self.params, self.task.control_dt) if self.randomization.active else None
        )
        self.observation_space = spaces.Box(-limit, limit, (len(self.task.observation_scale),), np.float32)
        self._simulator = PHYSICS[physics](self.params, self.task.control_dt, physics_dt)
        self._constants: tuple[float, ...] = ()
        self._constants_array = np.zeros(0)
        self._steps_left = 0
        self._closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: seeds the draw of this and the following episodes.
            options: may hold "state", the (8,) initial state, and "constants", the (nc,) constants of the episode or a
                dict of some of them by name. Everything else is drawn.

        Raises:
            ValueError: an unknown option, or a state or constants of the wrong shape, not finite, or unsafe.
        """
        self._check_open()
        super().reset(seed=seed)
        x, c = self._draw(dict(options or {}))
        self._constants, self._constants_array = tuple(c.tolist()), c
        self._state = tuple(x.tolist())
        if self._disturbance is not None:
            self._disturbance.reset(self.np_random)
            if self.randomization.varies_robot:
                self._simulator.set_params(self._disturbance.params)
        self._simulator.reset(self._state)
        self._steps_left = self.task.steps
        if self._scene is not None:
            self._scene.set_markers(self.task.markers(self._constants_array))
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info(0.0, (0.0, 0.0), False, False, False)

    def step(self, action: Sequence[float] | np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds a force for one control step.

        Args:
            action: (2,) force in units of the robot's force limit; clipped to [−1, 1].

        Raises:
            ValueError: an action that is not finite or not of shape (2,).
            gymnasium.error.ResetNeeded: before `reset`, or after the end of an episode.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        if self._steps_left <= 0:
            self._check_open()
            raise gymnasium.error.ResetNeeded(
                "the episode has ended; call reset()" if self._state else "step() before reset()"
            )
        force, clipped = self._force(action)
        task, c, total = self.task, self._constants, force
        if self._disturbance is not None:
            force = self._disturbance.actuate(force)
            total = self._disturbance.pushed(force, self.np_random)
        cost = task.cost(self._state, force, c) * task.control_dt
        self._state = x = self._simulator.step(total)
        self._steps_left -= 1
        failure = not task.is_safe(x, c)
        if failure:
            cost += task.failure_cost
        last = self._steps_left == 0
        success = not failure and (last or task.first_exit) and task.is_goal(x, c)
        terminated = failure or (success and task.first_exit)
        if terminated:
            self._steps_left = 0
        if self.render_mode == "human":
            self.render()
        return (
            self._observation(),
            -cost,
            terminated,
            last and not terminated,
            self._info(cost, force, success, failure, clipped),
        )

    @property
    def episode_params(self) -> BallbotParams:
        """The robot of the running episode: `params`, unless randomized."""
        return self.params if self._disturbance is None else self._disturbance.params

    def render(self) -> np.ndarray | None:
        """The current state as an image (height, width, 3), uint8, or in the window of render_mode="human"."""
        self._check_open()
        if self.render_mode is None:
            gymnasium.logger.warn('render() without a render mode; make the environment with render_mode="rgb_array"')
            return None
        if not self._state:
            raise gymnasium.error.ResetNeeded("render() before reset()")
        return self.render_state(self._state)

    def render_state(self, x: Sequence[float] | np.ndarray) -> np.ndarray | None:
        """Draws any state x (8,) with this episode's markers, for instance one of a recorded trajectory."""
        if self._scene is None:
            self._scene = Scene(self.params, human=self.render_mode == "human")
            self._scene.set_markers(self.task.markers(self._constants_array))
        return self._scene.draw(tuple(map(float, x)))

    def close(self) -> None:
        """Releases the physics client and the window; may be called again."""
        self._closed = True
        self._steps_left = 0
        self._simulator.close()
        if self._scene is not None:
            self._scene.close()
            self._scene = None

    def _check_open(self) -> None:
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError("this environment was closed; make a new one")

    def _draw(self, options: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Initial state and constants. Those that the options do not give are drawn."""
        state, constants = options.pop("state", None), options.pop("constants", None)
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; known: 'state', 'constants'")
        task = self.task
        draws = self.np_random.random(task.constant_draws + task.state_draws).tolist()
        c = np.array(task.draw_constants(tuple(draws[: task.constant_draws]), self.params), np.float64)
        if constants is not None:
            if isinstance(constants, dict):
                constants = self._replaced(c, constants)
            c = _finite_vector(constants, len(task.constant_names), "constants")
            task.check_constants(c, self.params)
        x = np.array(task.draw_state(tuple(draws[task.constant_draws :]), tuple(c.tolist()), self.params), np.float64)
        if state is not None:
            x = _finite_vector(state, 8, "state")
        margins = task.margins(tuple(x.tolist()), tuple(c.tolist()))
        violated = [name for name, margin in zip(task.margin_names, margins, strict=True) if not margin >= 0]
        if violated:
            values = ", ".join(f"{name} = {value:g}" for (name, _), value in zip(dynamics.STATE, x, strict=True))
            raise ValueError(
                f"{task.id}: the start state is out of range: it violates the limit of {', '.join(violated)} ({values}; "
                f"tilt {math.degrees(dynamics.tilt(x)):.1f}° of at most {math.degrees(task.max_tilt):.1f}°)"
            )
        return x, c

    def _replaced(self, c: np.ndarray, named: dict[str, float]) -> list[Any]:
        """The drawn constants c, of which some are replaced by name."""
        names = self.task.constant_names
        unknown = sorted(set(named) - set(names))
        if unknown:
            raise ValueError(f"{self.task.id} has no constants {unknown}; it has {list(names)}")
        return [named.get(name, value) for name, value in zip(names, c, strict=True)]

    def _force(self, action: Sequence[float] | np.ndarray) -> tuple[tuple[float, float], bool]:
        if np.shape(action) != (2,):
            raise ValueError(f"action must have shape (2,), not {np.shape(action)}")
        ax, ay = float(action[0]), float(action[1])
        if not (math.isfinite(ax) and math.isfinite(ay)):
            raise ValueError(f"action must be finite, not {[ax, ay]}")
        clipped = not (-1.0 <= ax <= 1.0 and -1.0 <= ay <= 1.0)
        if clipped:
            ax, ay = min(max(ax, -1.0), 1.0), min(max(ay, -1.0), 1.0)
        limit = self.params.force_limit
        return (limit * ax, limit * ay), clipped

    def _observation(self) -> np.ndarray:
        x = self._state
        if self._disturbance is not None:
            x = self._disturbance.sensed(x, self.np_random)
        return np.array(self.task.observe(x, self._constants), np.float32)

    def _info(
        self, cost: float, force: tuple[float, float], success: bool, failure: bool, clipped: bool
    ) -> dict[str, Any]:
        return {
            "state": np.array(self._state),
            "cost": cost,
            "tilt": dynamics.tilt(self._state),
            "success": success,
            "failure": failure,
            "force": np.array(force),
            "clipped": clipped,
            "constants": self._constants_array.copy(),
        }


def make_task(task: str | Task, **task_fields: Any) -> Task:
    """The task named, with some fields replaced.

    Raises:
        ValueError: no task of that name, or fields given together with a Task.
        TypeError: a keyword that is no field of the task.
    """
    if isinstance(task, Task):
        if task_fields:
            raise ValueError(f"fields {sorted(task_fields)} cannot be given together with a Task; use replace()")
        return task
    if task not in TASKS:
        raise ValueError(f"unknown task {task!r}; known: {', '.join(map(repr, TASKS))}")
    known = {field.name for field in fields(TASKS[task])}
    unknown = sorted(set(task_fields) - known)
    if unknown:
        raise TypeError(f"{TASKS[task].id} has no argument {', '.join(unknown)}; it has {', '.join(sorted(known))}")
    return TASKS[task](**task_fields)


def _finite_vector(value: Any, size: int, what: str) -> np.ndarray:
    try:
        vector = np.array(value, np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(())
    if vector.shape != (size,) or not np.isfinite(vector).all():
        raise ValueError(f"{what} must be {size} finite numbers, not {value!r}")
    return vector
