"""One ballbot of the playground: a simulator, a controller, what happened so far."""

import math
import time
from collections import deque
from concurrent.futures import Future
from typing import NamedTuple

import numpy as np

from ballbot_gym import dynamics
from ballbot_gym.engines import State, make_simulator
from ballbot_gym.env import GRIP
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Disturbance, Randomization
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.transition import outcome
from ballbot_gym.trajectory import Trajectory

TRACE_STEPS = 400
"""Control steps that the trace on the floor and the plots go back."""


class Sample(NamedTuple):
    """What a step looks like in the plots."""

    seconds: float
    """Since the playground was opened or restarted."""
    tilt: float
    """rad."""
    force: float
    """N, its length."""
    cost: float
    """Of the episode so far, without the price of a failure."""
    act: float
    """s, computing time of the controller."""


class Runner:
    """A ballbot under one controller. Its controller counts time from the step in which it was reset."""

    def __init__(self, name: str, task: Task, params: BallbotParams, physics: str):
        self.name = self.wanted = name
        """Under which controller it runs, and which it shall have as soon as that is made."""
        self.making: Future | None = None
        self.following: Future | None = None
        """What makes the wanted controller, and the one for the next episode."""
        self.controller: Controller | None = None
        self.x: State = (0.0,) * 8
        self.force = (0.0, 0.0)
        self.cost = 0.0
        self.violated = ""
        """The limit that was violated, or ""."""
        self.arrived = False
        """Whether the goal of a first-exit task is reached."""
        self.trace: deque[tuple[float, float]] = deque(maxlen=TRACE_STEPS)
        self.samples: deque[Sample] = deque(maxlen=TRACE_STEPS)
        self._task, self._nominal = task, params
        self._controller_start = 0
        self._act_seconds = 0.0
        self._simulator = make_simulator(physics, params, task.control_dt)
        self.set_plant(Randomization())
        self.begin(self.x)

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

    def begin(self, x: State) -> None:
        """Starts an episode in state x (8,)."""
        self.place(x)
        self.trace.clear()
        self.samples.clear()
        self._disturbance.begin(self._drawn)
        self.restart_cost()

    def restart_cost(self) -> None:
        """Starts an episode where the robot is."""
        self.cost = 0.0
        self._states: list[State] = [self.x]
        self._forces: list[tuple[float, float]] = []

    def place(self, x: State) -> None:
        """Puts the robot upright, or however x (8,) says."""
        self.x, self.force = x, (0.0, 0.0)
        self.violated, self.arrived = "", False
        self._simulator.reset(x)

    def take_controller(self, controller: Controller | None, step: int) -> None:
        """Goes on under another controller, that was reset for this step, counted from the opening of the playground."""
        self.controller, self._controller_start = controller, step

    def seconds_of_controller(self, step: int) -> float:
        """How long ago the controller was reset, s, at a step."""
        return (step - self._controller_start) * self._task.control_dt

    def rest_of_plan(self, step: int) -> np.ndarray | None:
        """(n, 8) states of the plan that its controller tracks, from a step on; None if it tracks none."""
        plan = getattr(self.controller, "plan", None)
        return None if plan is None else plan.trajectory.x[min(step - self._controller_start, len(plan.trajectory.u)) :]

    def expected(self, step: int, ahead: int) -> State:
        """The state (8,) in which it will be some control steps after a step, as far as its controller knows."""
        rest = self.rest_of_plan(step)
        return self.x if rest is None else tuple(rest[min(ahead, len(rest) - 1)].tolist())

    def has_no_plan_left(self, step: int) -> bool:
        """Whether it is on its way, but its controller has come to the end of the plan within which it predicts."""
        rest = self.rest_of_plan(step)
        return not self.stands_still and hasattr(self.controller, "predicted") and rest is not None and len(rest) < 2

    def set_plant(self, randomization: Randomization) -> None:
        """Changes what the controller does not know: the true robot, its actuator and its sensors."""
        dt = self._task.control_dt
        self._plant = randomization
        self._drawn = randomization.draw((0.5,) * randomization.episode_draws, dt)
        self._disturbance = Disturbance(randomization, self._nominal, dt)
        self._disturbance.begin(self._drawn)
        self.true = randomization.robot(self._nominal, self._drawn)
        """The robot that is simulated."""
        self._simulator.set_params(self.true)
        self._simulator.reset(self.x)

    def act(self, step: int, noise: tuple[float, ...]) -> tuple[float, float]:
        """The force that the controller commands, N, within the robot's limit; the numbers are those of the sensors' noise.

        Raises:
            FloatingPointError: a force that is not finite.
        """
        assert self.controller is not None
        seen = self._plant.sensed(self.x, noise, self._drawn, 0.0) if self._plant.is_noisy else self.x
        began = time.perf_counter()
        u = np.asarray(self.controller.act(self.seconds_of_controller(step), np.array(seen)), np.float64)
        self._act_seconds = time.perf_counter() - began
        if u.shape != (2,) or not np.isfinite(u).all():
            raise FloatingPointError(f"{self.name} commands {u} N")
        limit = self._nominal.force_limit
        a = u / limit
        return limit * min(max(float(a[0]), -1.0), 1.0), limit * min(max(float(a[1]), -1.0), 1.0)

    def step(
        self,
        step: int,
        command: tuple[float, float],
        push: tuple[float, float],
        outside: tuple[float, float],
        c: tuple[float, ...],
        seconds_left: float,
    ) -> None:
        """Holds a command, N, for one control step, after a push.

        Args:
            step: counted from the opening of the playground.
            command: (2,) N.
            push: (2,) N·s, an impulse on the body's centre of mass.
            outside: (2,) N, a force on the ball during the step.
            c: constants of the episode.
            seconds_left: s, of the episode after this step: what a failure costs.
        """
        task, dt = self._task, self._task.control_dt
        if any(push):
            self.x = self._states[-1] = tuple(map(float, dynamics.pushed(self.true, self.x, push)))
            self._simulator.reset(self.x)
        self.force = self._disturbance.actuate(command)
        total = (self.force[0] + outside[0], self.force[1] + outside[1])
        kept = -1.0 if self._slips(total) else 0.0
        x = self._simulator.step(total)
        did = outcome(task, self.x, self.force, x, c, step + 1, (kept,))
        self.cost += did.running
        self.violated = (*task.limit_names, GRIP, "")[int(did.violated)]
        self.arrived = task.first_exit and did.success > 0
        if all(map(math.isfinite, x)):
            self.x = x
        sample = Sample((step + 1) * dt, dynamics.tilt(self.x), math.hypot(*self.force), self.cost, self._act_seconds)
        self.samples.append(sample)
        self.trace.append((self.x[0], self.x[1]))
        self._states.append(self.x)
        self._forces.append(self.force)
        if self.violated:
            self.cost += task.survival_reward * seconds_left

    def _slips(self, total: tuple[float, float]) -> bool:
        """Whether a force, N, asks the floor for more than it can give, where contact is not simulated."""
        if not self.true.grips or self._simulator.floor_force() is not None:
            return False
        asked = dynamics.held_contact(self.true, self.x, total, self._task.control_dt)
        return not dynamics.keeps_grip(self.true, asked)

    def close(self) -> None:
        """Releases the simulator; may be called again."""
        self._simulator.close()


def failure_word(limit: str) -> str:
    """What a violated limit means, in words; "" for none."""
    return {"": "", "tilt": "fell", "arena": "left the arena"}.get(limit, f"touched {limit}")
