"""The controller protocol, and running a controller in an environment."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, cast

import gymnasium
import numpy as np

from ballbot_gym.checks import real_array
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Moving, Trajectory


class PlanError(RuntimeError):
    """A controller found no plan for the episode. The message gives each attempt's solver, status and violation."""


class Controller(Protocol):
    """Anything that turns states into forces: LQR, a tracked plan, MPC, a learned policy."""

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        """Starts at the episode's time t, s, in state x (8,) with constants c (nc,)."""

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        """Force (2,) N to hold until the next control step. The robot clips it to its limit."""
        ...


class ActionController:
    """A function from observation to action as a Controller. It computes the observations that the env would return.

    `action` is the function, and `history` the number of earlier observations that it takes. It acts in B episodes at once,
    given states (B, 8) and constants (B, nc), if the function takes observations (B, no). If `estimates` is set, (..., 3),
    these estimates of the three factors in `ROBOT_FACTORS` are appended to the observation.
    """

    def __init__(self, task: Task, params: Robot, action: Callable[[np.ndarray, bool], np.ndarray], history: int = 0):
        """Wraps a function.

        Args:
            task: what is observed.
            params: the robot, whose force limit is the unit of actions.
            action: gets an observation (no,) float32 and whether an episode begins; returns an action (2,) in [−1, 1].
            history: of the observations, same as in `BallbotEnv`.
        """
        self._task, self._params, self.action, self.history = task, params, action, history
        self._c: tuple[float, ...] = ()
        self._begins = True
        self.estimates: np.ndarray | None = None

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._c, self._begins = _components(c), True

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        own = np.array(self._task.seen(_components(x), self._task.at(self._c, t), self._params), np.float32).T
        if self._begins:
            still = np.zeros((*own.shape[:-1], self._params.action_size), np.float32)
            self._past = np.tile(np.concatenate([own, still], -1), self.history)
        observation = np.concatenate([own, self._past], -1) if self.history else own
        if self.estimates is not None:
            observation = np.concatenate([observation, self.estimates.astype(np.float32)], -1)
        action = real_array(self.action(observation, self._begins), "action").astype(np.float64)
        self._begins = False
        if self.history:
            tried = action.clip(-1.0, 1.0).astype(np.float32)
            self._past = np.concatenate([own, tried, self._past], -1)[..., : self._past.shape[-1]]
        return self._params.force_limit * action


def _components(vector: np.ndarray) -> tuple[Any, ...]:
    """The components of a vector (n,), or of B of them (B, n), which are (B,) then."""
    vector = np.asarray(vector, np.float64)
    return tuple(vector.tolist() if vector.ndim == 1 else vector.T)


@dataclass(frozen=True, repr=False)
class Episode(Moving):
    """One episode under one controller.

    `trajectory` contains the applied forces. `cost` includes the price of a failure. `settle_time`, s, is the time after
    which the robot stayed in the goal; it is NaN if the robot was not there at the end. `reset_seconds` is the wall time of
    the controller's `reset`, and `act_seconds` the median wall time of its `act`. `goal_error` is `Task.goal_error` of the
    last state: how far from the goal the episode ended, in units of the goal's tolerances. `violated` is the name of the
    limit that was violated, or "". `markers` are what the task adds to pictures.
    """

    trajectory: Trajectory
    constants: np.ndarray
    cost: float
    success: bool
    failure: bool
    settle_time: float
    reset_seconds: float
    act_seconds: float
    goal_error: float = math.nan
    violated: str = ""
    markers: tuple[Marker, ...] = ()

    def facts(self) -> dict[str, str]:
        end = f"failure: {self.violated}" if self.failure else "success" if self.success else "goal missed"
        settled = "never" if math.isnan(self.settle_time) else f"{self.settle_time:.2f} s"
        return {"end": end, "cost": f"{self.cost:.4g}", "settled": settled}

    @property
    def peak_tilt(self) -> float:
        """rad."""
        return float(self.trajectory.tilt.max())


def rollout(
    env: gymnasium.Env,
    controller: Controller,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    watch: Callable[[np.ndarray], object] = lambda seen: None,
) -> Episode:
    """Runs one episode.

    Args:
        env: a BallbotEnv, wrapped or not; its wrappers are bypassed.
        controller: receives the state as the env's sensors report it, which is the true state without sensor noise. In an
            env with observation="sensors" it receives the sensor readings, and must have an attribute `senses` that is true.
        seed: as for `env.reset`.
        options: as for `env.reset`.
        watch: called before each control step with the observation of the controller, while the env is still in the state
            where the step starts.

    Raises:
        ValueError: the env observes sensors, and the controller needs states.
        Exception: whatever the controller's `reset` raises, for instance a PlanError if it found no plan.
    """
    ballbot = cast(BallbotEnv, env.unwrapped)
    task, dt, limit = ballbot.task, ballbot.task.control_dt, ballbot.params.force_limit
    senses = ballbot.observation == "sensors"
    if senses and not getattr(controller, "senses", False):
        raise ValueError(
            f'{type(controller).__name__} needs states; give it a filter, for example "lqr-ekf", to control from sensors'
        )
    observation, info = ballbot.reset(seed=seed, options=options)
    x, c = info["state"], info["constants"]
    seen = observation if senses else sensed(ballbot, x, 0.0)
    start = time.perf_counter()
    controller.reset(0.0, seen, c)
    reset_seconds = time.perf_counter() - start
    states, forces, act_seconds, settled = [x], [], [], [task.is_goal(tuple(x), task.at(tuple(c), 0.0))]
    cost, done = 0.0, False
    while not done:
        watch(seen)
        start = time.perf_counter()
        u = controller.act(len(forces) * dt, seen)
        act_seconds.append(time.perf_counter() - start)
        observation, _, terminated, truncated, info = ballbot.step(np.asarray(u) / limit)
        x, done = info["state"], terminated or truncated
        seen = observation if senses else sensed(ballbot, x, (len(forces) + 1) * dt)
        cost += info["cost"]
        states.append(x)
        forces.append(info["force"])
        settled.append(task.is_goal(tuple(x), task.at(tuple(c), len(forces) * dt)))
    last_unsettled = max((k for k, inside in enumerate(settled) if not inside), default=-1)
    return Episode(
        trajectory=Trajectory(dt * np.arange(len(states)), np.array(states), np.array(forces)),
        constants=c,
        cost=cost,
        success=info["success"],
        failure=info["failure"],
        settle_time=(last_unsettled + 1) * dt if settled[-1] else math.nan,
        reset_seconds=reset_seconds,
        act_seconds=float(np.median(act_seconds)),
        goal_error=float(task.goal_error(tuple(x.tolist()), task.at(tuple(c.tolist()), len(forces) * dt))),
        violated=ballbot.limit_names[info["violated"]] if info["failure"] else "",
        markers=tuple(task.markers(c)),
    )


def sensed(env: BallbotEnv, x: np.ndarray, t: float) -> np.ndarray:
    """State x (8,) as the env's sensors report it at time t, s. Each call draws new noise from the env's generator."""
    if not env.randomization.is_noisy:
        return x
    z = tuple(env.np_random.random(Randomization.NOISE_DRAWS).tolist())
    return np.array(env.randomization.sensed(tuple(x.tolist()), z, env.get_state().drawn, t))
