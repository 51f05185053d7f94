"""One ballbot of the playground: an environment, a controller, what happened so far."""

import math
from collections import deque
from concurrent.futures import Future

import numpy as np

from ballbot_gym import dynamics
from ballbot_gym.engines import State
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.rollout import Controller, sensed
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

TRACE_STEPS = 400
"""Control steps that the trace on the floor goes back."""


class Runner:
    """A ballbot under one controller. Its controller counts time from the step in which it was reset."""

    def __init__(self, name: str, task: Task, params: BallbotParams, physics: str):
        self.name = self.wanted = name
        """Under which controller it runs, and which it shall have as soon as that is made."""
        self.making: Future | None = None
        """What makes the wanted controller."""
        self.controller: Controller | None = None
        self.trace: deque[tuple[float, float]] = deque(maxlen=TRACE_STEPS)
        self._task, self._params, self._physics = task, params, physics
        self._controller_start = 0
        self.env = self._made(Randomization())
        """Its randomization is what the controller does not know: the true robot, its actuator, sensors and pushes."""

    @property
    def stands_still(self) -> bool:
        """Whether its episode is over."""
        return self.violated != "" or self.arrived

    @property
    def trajectory(self) -> Trajectory | None:
        """The episode so far; None before its first step."""
        if not self._forces:
            return None
        times = self._task.control_dt * np.arange(len(self._states))
        return Trajectory(times, np.array(self._states), np.array(self._forces))

    def begin(self, x: State, c: State, randomization: Randomization, seed: int) -> None:
        """Starts an episode in state x (8,) with constants c. The seed is of all that is drawn in it."""
        if randomization != self.env.randomization:
            self.env.close()
            self.env = self._made(randomization)
        self.env.reset(seed=seed, options={"state": x, "constants": c})
        self._go_from(x)
        self.cost, self.violated, self.arrived = 0.0, "", False

    def join(self, other: "Runner") -> None:
        """Takes the place of another robot in its episode, and all that is drawn for it."""
        self.env.close()
        self.env = self._made(other.env.randomization)
        self.env.reset()
        self.env.set_state(other.env.get_state())
        self._go_from(other.x)
        self.cost, self.violated, self.arrived = other.cost, other.violated, other.arrived

    def set_plant(self, randomization: Randomization) -> None:
        """Changes what the controller does not know, in the middle of an episode."""
        before = self.env.get_state()
        self.env.close()
        self.env = self._made(randomization)
        self.env.reset(seed=0)
        now = self.env.get_state()
        kept = {name: getattr(before, name) for name in ("constants", "steps_left", "rng")}
        self.env.set_state(now._replace(x=self.x, memory=(), **kept))

    def take_controller(self, controller: Controller | None, step: int) -> None:
        """Goes on under another controller, that was reset for this step, counted from the opening of the playground."""
        self.controller, self._controller_start = controller, step

    def rest_of_plan(self, step: int) -> np.ndarray | None:
        """(n, 8) states of the plan that its controller tracks, from a step on; None if it tracks none."""
        plan = getattr(self.controller, "plan", None)
        return None if plan is None else plan.trajectory.x[min(step - self._controller_start, len(plan.trajectory.u)) :]

    def has_no_plan_left(self, step: int) -> bool:
        """Whether it is on its way, but its controller has come to the end of the plan within which it predicts."""
        rest = self.rest_of_plan(step)
        return not self.stands_still and hasattr(self.controller, "predicted") and rest is not None and len(rest) < 2

    def act(self, step: int, seconds: float) -> np.ndarray:
        """(2,) the force, N, that the controller commands in a step, at that time of the episode.

        Raises:
            FloatingPointError: a force that is not finite.
        """
        assert self.controller is not None
        t, seen = (step - self._controller_start) * self._task.control_dt, sensed(self.env, np.array(self.x), seconds)
        u = np.asarray(self.controller.act(t, seen), np.float64)
        if u.shape != (2,) or not np.isfinite(u).all():
            raise FloatingPointError(f"{self.name} commands {u} N")
        return u

    def step(self, command: np.ndarray, push: np.ndarray) -> None:
        """Holds a command (2,), N, for one control step, after a push (2,), N·s, on the body's centre of mass."""
        if push.any():
            pushed = dynamics.pushed(self.env.episode_params, self.x, tuple(push.tolist()))
            self.x = self._states[-1] = tuple(map(float, pushed))
            self.env.set_state(self.env.get_state()._replace(x=self.x, memory=()))
        _, _, terminated, _, info = self.env.step(command / self._params.force_limit)
        x = tuple(info["state"].tolist())
        if all(map(math.isfinite, x)):
            self.x = x
        self.force, self.cost = tuple(info["force"].tolist()), self.cost + info["cost"]
        self.violated = self.env.limit_names[info["violated"]] if info["failure"] else ""
        self.arrived = terminated and info["success"]
        self.trace.append((self.x[0], self.x[1]))
        self._states.append(self.x)
        self._forces.append(self.force)

    def close(self) -> None:
        """Releases the simulator; may be called again."""
        if self.making is not None:
            self.making.cancel()
        self.env.close()

    def _made(self, randomization: Randomization) -> BallbotEnv:
        return BallbotEnv(self._task, self._physics, robot=self._params, randomization=randomization)

    def _go_from(self, x: State) -> None:
        self.x, self.force = x, (0.0, 0.0)
        self.trace.clear()
        self._states: list[State] = [x]
        self._forces: list[tuple[float, ...]] = []


def failure_word(limit: str) -> str:
    """What a violated limit means, in words; "" for none."""
    return {"": "", "tilt": "fell", "arena": "left the arena"}.get(limit, f"touched {limit}")
