"""The simulation of the live playground, which knows nothing of pages: a ballbot, ghosts, pushes, hidden changes, costs.

The robot that counts is the main one. Ghosts get the same start and the same pushes under other controllers. Controllers are
made and plans are found in the background. A robot waits for its first controller, and goes on while another one is made.
"""

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, wait
from typing import Literal, NamedTuple

import numpy as np

from ballbot_gym.engines import default_physics
from ballbot_gym.params import default_params
from ballbot_gym.randomization import checked_randomization
from ballbot_gym.robots import PAPER
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.controllers import is_file
from ballbot_train.play import background
from ballbot_train.play.runner import Runner, failure_word
from ballbot_train.play.world import PLANT, World, randomization, severity
from ballbot_train.report import labels

LARGEST_PUSH = 250.0
"""N·s, of a push; larger ones are cut to this length."""

FIRST_PUSH = (79.0, 43.1)
"""N·s: the push with which an episode at rest begins fells LQR. Its length is 90 N·s, as on the page of `ballbot page`."""
_FIRST_PUSH_AFTER = 1.0  # s

_PAUSE = 1.5  # s, between the end of a robot and its next episode
_PUSH_SHOWN = 0.3  # s, for which a push is drawn
_EPISODES_KEPT = 100
_SETTLE = 900.0  # s: the first time in a task, solvers are compiled
_LEAST_COST = 0.01  # of an optimum to which a cost is compared; one that starts at rest costs nothing


class Score(NamedTuple):
    """How an episode of the main robot ended."""

    controller: str
    seconds: float
    cost: float
    regret: float
    """Cost over the optimum's, less 1; NaN without an optimum. Pushes and hidden changes count: the optimum had none."""
    failure: str
    """The violated limit, or ""."""
    changed: bool = False
    """Whether something was hidden from the controllers, and from the optimum."""

    @property
    def text(self) -> str:
        """In words."""
        of = " to the optimum of the unchanged robot" * self.changed
        regret = "" if math.isnan(self.regret) else f", regret {100 * self.regret:.1f} %{of}"
        if self.failure:
            return f"{self.controller}: {failure_word(self.failure)} after {self.seconds:.1f} s{regret}"
        return f"{self.controller}: {self.seconds:.1f} s, cost {self.cost:.1f}{regret}"


class Playground:
    """A ballbot, its ghosts and their world. `step` moves everything by one control step; nothing here waits for real time.

    Whatever asks for something unknown, or for a value outside of its bounds, gets a ValueError and changes nothing. It is
    for one thread.
    """

    def __init__(
        self,
        task: str = "stabilize",
        controller: str | None = None,
        ghosts: Sequence[str] = (),
        physics: str | None = None,
        episode: int | Literal["rest"] | None = 0,
        seed: int = 0,
        robot: str = PAPER,
        randomization: str | None = None,
    ):
        """Begins an episode.

        Args:
            task: name of a task.
            controller: of the main robot: an expert, a policy that comes with the package, or the path of a policy file or
                of a model that Stable-Baselines3 saved; default, `World.best`.
            ghosts: controllers of the ghosts.
            physics: "bullet", "mujoco" or "rk4"; default, as for environments.
            episode: index of a certified episode; "rest" for standing at the origin; None for a random start.
            seed: of random starts, sensor noise and random pushes.
            robot: name in `robots.ROBOTS`.
            randomization: name of a track: every episode has a robot of it, which the controllers are not told.

        Raises:
            ValueError: an unknown task, robot, controller, episode or track.
        """
        world = World(task, robot)
        controller = world.best if controller is None else controller
        world.check_controllers(controller, *ghosts)
        self.scores: list[Score] = []
        """Of the last episodes of the main robot."""
        self.plant = dict.fromkeys(PLANT, 0.0)
        """Severity of each hidden change."""
        self.runners: list[Runner] = []
        """The main robot, then the ghosts."""
        self.steps = 0
        """Control steps since the playground was opened."""
        self.notice = ""
        """What went wrong last, in words."""
        self._rng = np.random.default_rng(seed)
        self._track = checked_randomization(randomization)
        self._physics = default_physics() if physics is None else physics
        self._background = background.Background()
        self._optimum: Future | None = None
        self._open(world, controller, ghosts, episode)

    # --- what it is ---

    @property
    def main(self) -> Runner:
        """The main robot."""
        return self.runners[0]

    @property
    def ghosts(self) -> tuple[str, ...]:
        """The names of the ghosts' controllers."""
        return tuple(ghost.wanted for ghost in self.runners[1:])

    @property
    def controllers(self) -> list[str]:
        """What can be chosen in this task, and what is in use; policy files that were not used yet come to it."""
        return list(dict.fromkeys([*self.world.controllers, *(runner.wanted for runner in self.runners)]))

    @property
    def preparing(self) -> bool:
        """Whether a robot waits for its controller."""
        return any(runner.controller is None for runner in self.runners)

    @property
    def planning(self) -> bool:
        """Whether a controller is being made while the robots go on."""
        return any(runner.making is not None for runner in self.runners)

    @property
    def seconds(self) -> float:
        """Since the episode began."""
        return self.elapsed * self.world.task.control_dt

    @property
    def ended(self) -> bool:
        """Whether the episode is over, and everything stands still."""
        return self._pause_left > 0

    @property
    def optimum_cost(self) -> float:
        """The best cost of an episode from this start without pushes; NaN while it is not known."""
        costs, known = self._optimum_costs, self.world.certified
        if costs is None and known is not None and self.episode is not None:
            return float(known.costs[self.episode])
        return math.nan if costs is None else float(costs[-1])

    @property
    def optimum_cost_so_far(self) -> float:
        """What the optimum has cost until now; NaN while it is not known."""
        costs = self._optimum_costs
        return math.nan if costs is None else float(costs[min(self.elapsed, len(costs) - 1)])

    @property
    def _optimum_costs(self) -> np.ndarray | None:
        made = self._optimum
        return made.result() if made is not None and made.done() and made.exception() is None else None

    @property
    def shown_push(self) -> np.ndarray | None:
        """(2,) the push that is drawn, N·s; None if there was none lately."""
        return self._push if self.steps < self._push_until else None

    def trajectory(self) -> Trajectory:
        """The main robot's episode so far.

        Raises:
            ValueError: it has not begun.
        """
        if self.main.trajectory is None:
            raise ValueError("the episode has not begun: there is nothing to save")
        return self.main.trajectory

    # --- time ---

    def step(self) -> bool:
        """Moves everything by one control step; False while the episode waits for its controllers."""
        self._hand_out()
        if self.preparing:
            return False
        if self.ended:
            self._pause_left -= 1
            if not self.ended:
                self.restart()
            return True
        self._plan_again()
        if self.preparing:
            return False
        if self.elapsed == self._first_push_at:
            self._first_push_at = -1
            self.push(*(part * self.world.params.total_mass / default_params().total_mass for part in FIRST_PUSH))
        push = self._take_push()
        for runner in self.runners:
            if not runner.stands_still:
                try:
                    command = runner.act(self.steps, self.seconds)
                except Exception as error:  # a controller of any kind, such as a policy: the others go on
                    self.notice, command = f"{labels.label(runner.wanted)}: {error}", np.zeros(2)
                runner.step(command, push)
        self.steps += 1
        self.elapsed += 1
        self._after_step()
        return True

    def settle(self) -> None:
        """Waits until every plan is found; for scripts and tests. A TimeoutError says that it took too long."""
        for _ in range(2):  # a plan that is not found asks for another controller
            jobs = [self._optimum, *(runner.making for runner in self.runners)]
            if wait([job for job in jobs if job is not None], _SETTLE).not_done:
                raise TimeoutError(f"no plan in {_SETTLE:g} s")
            self._hand_out()

    def close(self) -> None:
        """Releases simulators and the background; may be called again."""
        self._background.close()
        for runner in self.runners:
            runner.close()

    # --- what a user does ---

    def push(self, x: float, y: float) -> None:
        """Pushes every robot by an impulse along x and y, N·s, on its body's centre of mass, before the next control step."""
        length = math.hypot(x, y)
        if not math.isfinite(length):
            self.notice = "a push must be finite numbers"
            return
        factor = min(1.0, LARGEST_PUSH / length) if length else 0.0
        self._pending_push = self._pending_push + factor * np.array([x, y])

    def set_task(self, task: str) -> None:
        """Another task, under the same controllers where it has them."""
        self._change(task, self.world.robot)

    def set_robot(self, robot: str) -> None:
        """Another robot, in the same task, under the same controllers where it has them."""
        self._change(self.world.task_name, robot)

    def set_controller(self, name: str) -> None:
        """Another controller for the main robot, as soon as it is made. The robot goes on where it is."""
        self.world.check_controllers(name)
        self.set_ghosts([ghost for ghost in self.ghosts if ghost != name])
        self.main.wanted = name
        if self.main.controller is not None and not self.main.violated:
            self._order(self.main)
        else:
            self.restart()

    def set_ghosts(self, ghosts: Sequence[str]) -> None:
        """Other ghosts. A new one begins where the main robot is."""
        self.world.check_controllers(*ghosts)
        wanted = [name for name in dict.fromkeys(ghosts) if name != self.main.wanted]
        for runner in self.runners[1:]:
            if runner.wanted not in wanted:
                runner.close()
                self.runners.remove(runner)
        for name in wanted:
            if name not in self.ghosts:
                runner = self._add(name)
                runner.join(self.main)
                self._order(runner)

    def set_plant(self, stress: str, value: float) -> None:
        """Changes what the controllers do not know, for every robot. The value is a severity within its `Span`."""
        self.plant[stress] = severity(stress, value)
        for runner in self.runners:
            runner.set_plant(randomization(self.plant))

    def restart(self) -> None:
        """Begins the same episode again."""
        self._begin(self.start, self.episode, self._at_rest)

    def start_certified(self, episode: int) -> None:
        """Begins a certified episode."""
        self._begin(self.world.certified_start(episode), episode)

    def start_random(self) -> None:
        """Begins an episode with a random start."""
        self._begin(self.world.task.sample(self._rng, self.world.params), None)

    def start_at_rest(self) -> None:
        """Begins an episode that stands at the origin until it is pushed, which happens by itself."""
        self._begin((np.zeros(8), self.world.task.sample(self._rng, self.world.params)[1]), None, True)

    # --- inside ---

    def _change(self, task: str, robot: str) -> None:
        """Opens a task for a robot, with the present controllers that are made for them."""
        world = World(task, robot)
        world.offer(*self.world.policies)
        ghosts = [ghost for ghost in self.ghosts if ghost in world.controllers]
        self._open(world, self.main.wanted if self.main.wanted in world.controllers else world.best, ghosts, 0)

    def _open(self, world: World, controller: str, ghosts: Iterable[str], episode: int | str | None) -> None:
        start = world.certified_start(episode) if isinstance(episode, int) and world.certified is not None else None
        for runner in self.runners:
            runner.close()
        self.world, self.runners = world, []
        for name in dict.fromkeys([controller, *ghosts]):
            self._add(name)
        if episode == "rest":
            self.start_at_rest()
        elif start is None:
            self.start_random()
        else:
            self._begin(start, int(episode or 0))

    def _add(self, name: str) -> Runner:
        self.runners.append(Runner(name, self.world.task, self.world.params, self._physics))
        return self.runners[-1]

    def _begin(self, start: tuple[np.ndarray, np.ndarray], episode: int | None, at_rest: bool = False) -> None:
        """Starts an episode; the robots wait for their controllers."""
        self.start, self.episode, self._at_rest = start, episode, at_rest
        self.elapsed = self._pause_left = self._push_until = 0
        self._pending_push = self._push = np.zeros(2)
        hidden = (
            randomization(self.plant) if any(self.plant.values()) else self._track
        )  # a slider takes the track's place
        self._first_push_at = -1 if not at_rest else round(_FIRST_PUSH_AFTER / self.world.task.control_dt)
        seed = int(self._rng.integers(2**32))  # the same for all, so that they meet the same robot, noise and pushes
        for runner in self.runners:
            runner.begin(tuple(start[0].tolist()), tuple(start[1].tolist()), hidden, seed)
            runner.take_controller(None, self.steps)
            runner.name = runner.wanted
            self._order(runner)
        if self._optimum is not None:
            self._optimum.cancel()
        self._optimum = self._background.submit(
            background.optimum_costs, self.world.task, self.world.params, *map(np.array, start)
        )

    def _order(self, runner: Runner) -> None:
        """Asks for the controller that a robot wants, from now on."""
        name, step = runner.wanted, self.steps
        problem = self.world.task, self.world.params, np.array(runner.x), np.array(self.start[1])
        if runner.making is not None:
            runner.making.cancel()
        runner.making = self._background.submit(lambda: (name, step, background.begun(name, *problem)))

    def _hand_out(self) -> None:
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

    def _plan_again(self) -> None:
        """Has a robot wait for another plan if its plan to a first-exit goal is over, and it is not there.

        NMPC would plan within `act`. But solvers must not run in two threads, so the background plans.
        """
        for runner in self.runners if self.world.task.first_exit else ():
            if runner.has_no_plan_left(self.steps):
                runner.take_controller(None, self.steps)
                self._order(runner)

    def _do_without(self, runner: Runner, error: BaseException) -> None:
        """Leaves a robot under its controller where the wanted one cannot be made. If it has none, it gets LQR."""
        who = labels.label(runner.wanted)
        self.notice = f"{who}: {error}"
        if runner.controller is not None:
            runner.wanted = runner.name
        elif runner.wanted != "lqr":
            self.notice = f"{who} cannot start here, LQR does instead: {error}"
            runner.wanted = "lqr"
            self._order(runner)

    def _after_step(self) -> None:
        task, main = self.world.task, self.main
        if self.elapsed < task.steps and not main.stands_still:
            return
        best = self.optimum_cost
        regret = main.cost / best - 1 if best > _LEAST_COST else math.nan
        changed = any(self.plant.values()) or self._track.active
        score = Score(labels.label(main.name), self.seconds, main.cost, regret, main.violated, changed)
        self.scores = [*self.scores, score][-_EPISODES_KEPT:]
        if task.first_exit or main.stands_still:
            self._pause_left = round(_PAUSE / task.control_dt)
        else:  # another one from where the robot is
            self._begin((np.array(main.x), self.start[1]), None)

    def _take_push(self) -> np.ndarray:
        """(2,) the push that was asked for, N·s."""
        push, self._pending_push = self._pending_push, np.zeros(2)
        if push.any():
            self._push = push
            self._push_until = self.steps + round(_PUSH_SHOWN / self.world.task.control_dt)
        return push
