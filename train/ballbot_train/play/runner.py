"""One ballbot of the playground: a simulator, a controller, what happened so far."""

import math
from collections import deque
from concurrent.futures import Future

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
"""Control steps that the trace on the floor goes back."""


class Runner:
    """A ballbot under one controller. Its controller counts time from the step in which it was reset."""

    def __init__(self, name: str, task: Task, params: BallbotParams, physics: str):
        self.name = self.wanted = name
        """Under which controller it runs, and which it shall have as soon as that is made."""
        self.making: Future | None = None
        """What makes the wanted controller."""
        self.controller: Controller | None = None
        self.x: State = (0.0,) * 8
        self.force = (0.0, 0.0)
        self.cost = 0.0
        self.violated = ""
        """The limit that was violated, or ""."""
        self.arrived = False
        """Whether the goal of a first-exit task is reached."""
        self.trace: deque[tuple[float, float]] = deque(maxlen=TRACE_STEPS)
        self._task, self._nominal = task, params
        self._controller_start = 0
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
        self.x, self.cost = x, 0.0
        self.force = (0.0, 0.0)
        self.violated, self.arrived = "", False
        self._simulator.reset(x)
        self.trace.clear()
        self._disturbance.begin(self._drawn)
        self._states: list[State] = [x]
        self._forces: list[tuple[float, ...]] = []

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
        t = (step - self._controller_start) * self._task.control_dt
        u = np.asarray(self.controller.act(t, np.array(seen)), np.float64)
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
        task = self._task
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
