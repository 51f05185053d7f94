"""The robots of a playground under their controllers: the main one, which counts, and its ghosts."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, wait
from typing import Any

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_gym.engines import State
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.controllers import is_expert, is_file, make_controller
from ballbot_train.play.background import Background
from ballbot_train.play.runner import Runner
from ballbot_train.play.world import World
from ballbot_train.report import labels

_SETTLE = 900.0  # s: the first time in a task, solvers are compiled
_FROM_ELSEWHERE = ("lqr", "trajopt")  # controllers that are data, so that they can come from another process


class Crew:
    """Runners and who controls them. A robot waits for its first controller, and goes on while another one is made."""

    def __init__(self, physics: str, other_process: bool):
        """Starts the background, which has another process plan if it is told so."""
        self.runners: list[Runner] = []
        """The main robot, then the ghosts."""
        self.steps = 0
        """Control steps since the playground was opened."""
        self.notice = ""
        """What went wrong last, in words."""
        self._physics, self.background = physics, Background(other_process)
        self._randomization = Randomization()
        self._optimum: Future | None = None

    @property
    def main(self) -> Runner:
        """The main robot."""
        return self.runners[0]

    @property
    def ghosts(self) -> tuple[str, ...]:
        """The names of the ghosts' controllers."""
        return tuple(ghost.wanted for ghost in self.runners[1:])

    @property
    def preparing(self) -> bool:
        """Whether a robot waits for its controller."""
        return any(runner.controller is None for runner in self.runners)

    @property
    def planning(self) -> bool:
        """Whether a controller is being made while the robots go on."""
        return any(runner.making is not None for runner in self.runners)

    @property
    def optimum(self) -> np.ndarray | None:
        """(n + 1,) what the optimum of the episode has cost after each control step; None while it is not known."""
        made = self._optimum
        return made.result() if made is not None and made.done() and made.exception() is None else None

    # --- who is there ---

    def open(self, world: World, names: Iterable[str]) -> None:
        """Replaces all robots by others for another world, under controllers by name. The first is the main one's."""
        for runner in self.runners.copy():
            self._remove(runner)
        self.world = world
        for name in dict.fromkeys(names):
            self._add(name)

    def set_ghosts(self, names: Iterable[str]) -> None:
        """Other ghosts. A new one begins where the main robot is."""
        wanted = [name for name in dict.fromkeys(names) if name != self.main.wanted]
        for runner in self.runners[1:]:
            if runner.wanted not in wanted:
                self._remove(runner)
        for name in wanted:
            if name not in self.ghosts:
                runner = self._add(name)
                runner.begin(self.main.x)
                runner.cost = self.main.cost
                self.order(runner)

    def set_plant(self, randomization: Randomization) -> None:
        """Changes what the controllers do not know."""
        self._randomization = randomization
        for runner in self.runners:
            runner.set_plant(randomization)

    def close(self) -> None:
        """Releases the simulators and the background; may be called again."""
        self.background.close()
        for runner in self.runners:
            runner.close()

    def _add(self, name: str) -> Runner:
        runner = Runner(name, self.world.task, self.world.params, self._physics)
        runner.set_plant(self._randomization)
        self.runners.append(runner)
        return runner

    def _remove(self, runner: Runner) -> None:
        _cancel(runner.making)
        runner.close()
        self.runners.remove(runner)

    # --- time ---

    def begin(self, x: State, c: tuple[float, ...]) -> None:
        """Places all robots in state x (8,) of an episode with constants c. They wait for controllers."""
        self._x, self._c = x, c
        for runner in self.runners:
            runner.begin(x)
            runner.take_controller(None, self.steps)
            runner.name = runner.wanted
            self.order(runner)
        self._order_optimum()

    def step(
        self, noise: tuple[float, ...], push: tuple[float, float], outside: tuple[float, float], seconds_left: float
    ) -> None:
        """Moves all robots by one control step, with that many seconds of the episode left after it; see `Runner.step`."""
        for runner in self.runners:
            if not runner.stands_still:
                try:
                    command = runner.act(self.steps, noise)
                except Exception as error:  # a controller of any kind, such as a policy: the others go on
                    self.notice, command = f"{labels.label(runner.wanted)}: {error}", (0.0, 0.0)
                runner.step(self.steps, command, push, outside, self._c, seconds_left)
        self.steps += 1

    # --- controllers ---

    def order(self, runner: Runner) -> None:
        """Asks for the controller that a robot wants, from now on."""
        name, step, compute = runner.wanted, self.steps, self.background.compute
        problem = self.world.task, self.world.params, np.array(runner.x), np.array(self._c)
        _cancel(runner.making)
        runner.making = self.background.submit(lambda: (name, step, _make(name, *problem, compute)))

    def _order_optimum(self) -> None:
        _cancel(self._optimum)
        problem = self.world.task, self.world.params, np.array(self._x), np.array(self._c)
        self._optimum = self.background.submit(lambda: self.background.compute(_optimum_costs, *problem))

    def poll(self) -> None:
        """Hands out the controllers that are made."""
        for runner in self.runners:
            if runner.making is None or not runner.making.done():
                continue
            future, runner.making = runner.making, None
            if (error := future.exception()) is not None:
                self._do_without(runner, error)
                continue
            runner.name, step, controller = future.result()
            runner.take_controller(controller, step)
            if is_file(runner.name):
                self.world.offer(runner.name)

    def wait(self) -> None:
        """Waits for everything that is being made; raises a TimeoutError if that takes too long."""
        jobs = [self._optimum, *(runner.making for runner in self.runners)]
        if wait([job for job in jobs if job is not None], _SETTLE).not_done:
            raise TimeoutError(f"no plan in {_SETTLE:g} s")

    def plan_again(self) -> None:
        """Has a robot wait for another plan if its plan to a first-exit goal is over, and it is not there.

        NMPC would plan within `act`. But solvers must not run in two threads, so the background plans.
        """
        for runner in self.runners if self.world.task.first_exit else ():
            if runner.has_no_plan_left(self.steps):
                runner.take_controller(None, self.steps)
                self.order(runner)

    def _do_without(self, runner: Runner, error: BaseException) -> None:
        """Leaves a robot under its controller where the wanted one cannot be made. If it has none, it gets LQR."""
        who = labels.label(runner.wanted)
        self.notice = f"{who}: {error}"
        if runner.controller is not None:
            runner.wanted = runner.name
        elif runner.wanted != "lqr":
            self.notice = f"{who} cannot start here, LQR does instead: {error}"
            runner.wanted = "lqr"
            self.order(runner)


def _cancel(job: Future | None) -> None:
    if job is not None:
        job.cancel()


def _make(
    name: str,
    task: Task,
    params: BallbotParams,
    x: np.ndarray,
    c: np.ndarray,
    compute: Callable[..., Any],
) -> Controller:
    """The controller of a name, at the start of an episode in state x (8,) with constants c (nc,).

    What takes long is called by `compute`, that may have another process do it.
    """
    if name in _FROM_ELSEWHERE:
        return compute(_expert, name, task, params, x, c)
    controller = make_controller(name, task, params)
    if is_expert(name):
        from ballbot_baselines.nmpc import NmpcController, prepared_plan  # it imports CasADi

        if isinstance(controller, NmpcController):  # its solver stays in this process
            controller.start(0.0, c, compute(prepared_plan, task, params, x, c, controller.backoff))
            return controller
    controller.reset(0.0, x, c)
    return controller


def _optimum_costs(task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(n + 1,) what the optimum has cost after each control step."""
    from ballbot_baselines import find_optimum

    trajectory = find_optimum(task, params, x, c, twice=True).trajectory
    rates = task.cost(tuple(trajectory.x[:-1].T), tuple(trajectory.u.T), task.at(tuple(c), trajectory.t[:-1]))
    return np.concatenate([[0.0], np.cumsum(rates * task.control_dt)])


def _expert(name: str, task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> Controller:
    """An expert at the start of an episode."""
    controller = CONTROLLERS[name](task, params)
    controller.reset(0.0, x, c)
    return controller
