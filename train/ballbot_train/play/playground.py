"""The simulation of the playground, which knows nothing of pages: a ballbot, ghosts, pushes, hidden changes, costs.

The robot that counts is the main one. Ghosts get the same start and the same pushes under other controllers. Controllers are
made and plans are found in the background, while the robots go on under those that they have.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ballbot_baselines import CONTROLLERS, VARIANTS
from ballbot_gym import certified
from ballbot_gym.drawing import GHOST_OPACITY, Drawing, GroundPath, Robot
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import PAPER, ROBOTS, named_robot
from ballbot_gym.rollout import Controller
from ballbot_gym.simulator import default_physics
from ballbot_gym.tasks import TASKS, Task
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.controllers import (
    is_expert,
    is_file,
    is_made_for,
    is_saved_model,
    made_for,
    make_controller,
    names,
)
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.play.background import Background
from ballbot_train.play.driving import DriveController, Stick
from ballbot_train.play.runner import Runner, Sample
from ballbot_train.play.tunable import Tunable, weight_names
from ballbot_train.policy_files import PolicyError
from ballbot_train.report import labels
from ballbot_train.report.replay import Replay, Take

DRIVERS: dict[str, Literal["force", "speed"]] = {"you": "speed", "you (force)": "force"}
"""Controllers that are human: by name, what the stick commands."""

AtEnd = Literal["go on", "again", "next", "stop"]
"""What comes after an episode: another one from where the robot is, the same one, another one, or nothing."""

LARGEST_PUSH = 30.0
"""N·s, of a push; larger ones are cut to this length."""

WEIGHT_FACTOR = 100.0
"""How far a weight may be from the task's own, as a factor, up and down."""


class Span(NamedTuple):
    """What a slider allows."""

    low: float
    high: float
    step: float


PLANT: dict[str, Span] = {
    "mass": Span(-50.0, 100.0, 5.0),
    "com": Span(-30.0, 50.0, 5.0),
    "delay": Span(0.0, 120.0, 20.0),
    "lag": Span(0.0, 100.0, 5.0),
    "noise": Span(0.0, 5.0, 0.25),
    "push": Span(0.0, 12.0, 0.5),
}
"""What the controllers do not know, by the name of the stress in `robustness.STRESSES`, which says the unit. 0 is nothing."""

_PAUSE = 1.5  # s, between the end of an episode and the next
_PUSH_SHOWN = 0.3  # s, for which a push is drawn
_AHEAD = 1.0  # s before the end of an episode at which the plan for the next one is begun
_PLAN_POINTS = 60  # of a drawn plan
_SETTLE = 900.0  # s: the first time in a task, solvers are compiled
_EPISODES_KEPT = 100
_FROM_ELSEWHERE = ("lqr", "trajopt")  # controllers that are data, so that they can come from another process
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
        who = self.controller
        of = " to the optimum of the unchanged robot" * self.changed
        regret = "" if math.isnan(self.regret) else f", regret {100 * self.regret:.1f} %{of}"
        if self.failure:
            return f"{who}: {_failure_word(self.failure)} after {self.seconds:.1f} s{regret}"
        return f"{who}: {self.seconds:.1f} s, cost {self.cost:.1f}{regret}"


class History(NamedTuple):
    """What the plots show. A robot that joined later or has failed keeps its first and last values."""

    seconds: np.ndarray
    """(n,) since the playground was opened."""
    lines: dict[str, np.ndarray]
    """(n, 4) tilt, rad, force, N, cost so far and computing time of the controller, s, by the name of the controller."""
    optimum: np.ndarray
    """(n,) what the optimum has cost so far; 0 where that is not known."""


class Playground:
    """A ballbot, its ghosts and their world. `step` moves everything by one control step; nothing here waits for real time.

    Except for `stick`, everything is for one thread.
    """

    def __init__(
        self,
        task: str = "stabilize",
        controller: str = "nmpc",
        ghosts: Sequence[str] = (),
        physics: str | None = None,
        episode: int | None = 0,
        seed: int = 0,
        robot: str = PAPER,
        policies: Sequence[str] = (),
        other_process: bool = False,
    ):
        """Begins an episode.

        Args:
            task: name of a task.
            controller: of the main robot: an expert, a policy that comes with the package, the path of a policy file or of a
                model that Stable-Baselines3 or rsl_rl saved, or one of `DRIVERS`.
            ghosts: controllers of the ghosts.
            physics: "bullet" or "rk4"; default, as for environments.
            episode: index of a certified episode; None for a random start.
            seed: of random starts, sensor noise and random pushes.
            robot: name in `robots.ROBOTS`.
            policies: paths of more policies that can be chosen in the tasks that they are made for.
            other_process: whether another process plans, so that planning takes no time from a simulation in real time. A
                script that asks for it needs the guard `if __name__ == "__main__":`.

        Raises:
            ValueError: an unknown task, robot, controller or episode.
            PolicyError: one of `policies` is missing or damaged.
        """
        self.physics = default_physics() if physics is None else physics
        self.robot = _known("robot", robot, ROBOTS)
        self.params = named_robot(robot)
        self.stick = Stick()
        self.at_end: AtEnd = "go on"
        self.scores: list[Score] = []
        """Of the last episodes of the main robot."""
        self.notice = ""
        """What went wrong last, in words."""
        self.plant = dict.fromkeys(PLANT, 0.0)
        """Severity of each hidden change."""
        self._policies = list(dict.fromkeys(policies))
        for policy in self._policies:
            made_for(policy)  # whether it can be read
        self._rng = np.random.default_rng(seed)
        self._background = Background(other_process)
        self._randomization = Randomization()
        self._runners: dict[str, Runner] = {}
        self._step = 0
        self._open_task(task, controller, ghosts, episode)

    # --- what it is ---

    @property
    def controller(self) -> str:
        """The name of the main robot's controller; the wanted one, while it is being made."""
        return self._wanted["main"]

    @property
    def ghosts(self) -> tuple[str, ...]:
        """The names of the ghosts' controllers."""
        return tuple(self._wanted[key] for key in self._wanted if key != "main")

    @property
    def controllers(self) -> list[str]:
        """What can be chosen in this task; policy files that were not used yet come to it."""
        return self._fitting

    @property
    def main(self) -> Runner:
        """The main robot."""
        return self._runners["main"]

    @property
    def seconds(self) -> float:
        """Since the episode began."""
        return self._elapsed * self.task.control_dt

    @property
    def seconds_in_all(self) -> float:
        """Simulated since the playground was opened, s."""
        return self._step * self.task.control_dt

    @property
    def preparing(self) -> bool:
        """Whether the episode waits for its controllers."""
        return any(runner.controller is None for runner in self._runners.values())

    @property
    def planning(self) -> bool:
        """Whether a controller is being made while the robots go on."""
        return any(self._background.pending(key) for key in self._wanted)

    @property
    def ended(self) -> bool:
        """Whether the episode is over, and everything stands still."""
        return self._pause_left > 0

    @property
    def optimum_cost(self) -> float:
        """The best cost of an episode from this start without pushes; NaN while it is not known."""
        if self._optimum_costs is not None:
            return float(self._optimum_costs[-1])
        own = self.episode is not None and not self.weights
        return float(self._episodes.costs[self.episode]) if own and self._episodes is not None else math.nan

    @property
    def optimum_cost_so_far(self) -> float:
        """What the optimum has cost until now; NaN while it is not known."""
        if self._optimum_costs is None:
            return math.nan
        return float(self._optimum_costs[min(self._elapsed, len(self._optimum_costs) - 1)])

    @property
    def other_pid(self) -> int | None:
        """The number of the process that plans; None if there is none."""
        return self._background.other_pid

    @property
    def episodes(self) -> int:
        """How many certified episodes the task has."""
        return 0 if self._episodes is None else len(self._episodes)

    # --- time ---

    def step(self) -> bool:
        """Moves everything by one control step; False while the episode waits for its controllers."""
        self._poll()
        if self.preparing:
            return False
        if self._pause_left > 0:
            self._pause_left -= 1
            if self._pause_left == 0:
                self._begin_next()
            return True
        if self._plan_again():
            return False
        dt = self.task.control_dt
        noise = tuple(self._rng.random(Randomization.NOISE_DRAWS).tolist())
        push = self._take_push()
        left = (self.task.steps - self._elapsed - 1) * dt
        for key, runner in self._runners.items():
            if not runner.stands_still:
                runner.step(self._step, self._command(key, runner, noise), push, self._c, left)
        self._step += 1
        self._elapsed += 1
        self._push_shown = max(0, self._push_shown - 1)
        self._after_step()
        return True

    def settle(self, seconds: float = _SETTLE) -> None:
        """Waits until every plan is found; for scripts and tests.

        Raises:
            TimeoutError: it took too long.
        """
        for _ in range(2):  # a plan that is not found asks for another controller
            if not self._background.wait(seconds):
                raise TimeoutError(f"no plan in {seconds:g} s")
            self._poll()

    def close(self) -> None:
        """Releases simulators and the background thread; may be called again."""
        self._background.close()
        for runner in self._runners.values():
            runner.close()

    # --- what a user does ---

    def push(self, x: float, y: float) -> None:
        """Pushes every robot's ball by an impulse along x and y, N·s, in the next control step."""
        length = math.hypot(x, y)
        if not math.isfinite(length):
            self.notice = "a push must be finite numbers"
            return
        factor = min(1.0, LARGEST_PUSH / length) if length else 0.0
        self._pending_push = (self._pending_push[0] + factor * x, self._pending_push[1] + factor * y)

    def set_task(self, task: str) -> None:
        """Another task, under the same controllers where it has them.

        Raises:
            ValueError: no task of this name.
        """
        self._change(_known("task", task, TASKS), self.robot)

    def set_robot(self, robot: str) -> None:
        """Another robot, in the same task, under the same controllers where it has them.

        Raises:
            ValueError: no robot of this name.
        """
        self._change(self.task_name, _known("robot", robot, ROBOTS))

    def set_controller(self, name: str) -> None:
        """Another controller for the main robot, as soon as it is made. The robot goes on where it is.

        Raises:
            ValueError: no controller of this name, or a policy file of another task.
        """
        self._check_controller(name)
        if name in self.ghosts:
            self.set_ghosts([ghost for ghost in self.ghosts if ghost != name])
        self._wanted["main"] = name
        if self.main.controller is not None and not self.main.violated:
            self._request("main", self.main.x)
        else:
            self.restart()

    def set_ghosts(self, ghosts: Sequence[str]) -> None:
        """Other ghosts. A new one begins where the main robot is.

        Raises:
            ValueError: no controller of one of these names.
        """
        for name in ghosts:
            self._check_controller(name)
        wanted = [name for name in dict.fromkeys(ghosts) if name != self.controller]
        for name in set(self.ghosts) - set(wanted):
            self._background.cancel(name)
            self._runners.pop(name).close()
            del self._wanted[name]
        for name in wanted:
            if name not in self._wanted:
                self._add_runner(name, name)
                self._runners[name].begin(self.main.x)
                self._runners[name].cost = self.main.cost
                self._request(name, self.main.x)

    def set_weight(self, name: str, value: float) -> None:
        """Changes a weight of the cost; LQR, trajectory optimization and NMPC reckon with it as soon as they can.

        Raises:
            ValueError: no weight of this name, or a value too far from the task's own.
        """
        _known("weight", name, weight_names(self.base))
        own = getattr(self.base, name)
        if not own / WEIGHT_FACTOR <= value <= own * WEIGHT_FACTOR:
            raise ValueError(f"{name} must be {own / WEIGHT_FACTOR:g} to {own * WEIGHT_FACTOR:g}, not {value:g}")
        self.weights[name] = value
        if value == own:
            del self.weights[name]
        self._set_constants()
        for key, runner in self._runners.items():
            runner.weigh_again(self._c)
            if is_expert(self._wanted[key]):
                self._request(key, runner.x)
        self._request_optimum()

    def set_plant(self, stress: str, severity: float) -> None:
        """Changes what the controllers do not know, for every robot.

        Raises:
            ValueError: no stress of this name, or a severity outside of its `Span`.
        """
        span = PLANT[_known("change", stress, PLANT)]
        if not span.low <= severity <= span.high:
            raise ValueError(f"{stress} must be {span.low:g} to {span.high:g}, not {severity:g}")
        self.plant[stress] = span.step * round(severity / span.step)
        self._randomization = _randomization(self.plant)
        for runner in self._runners.values():
            runner.set_plant(self._randomization)

    def restart(self) -> None:
        """Begins the same episode again."""
        self._begin(self._start, self.episode)

    def start_certified(self, episode: int) -> None:
        """Begins a certified episode.

        Raises:
            ValueError: no episode of this index.
        """
        if self._episodes is None or not 0 <= episode < len(self._episodes):
            raise ValueError(f"episode must be 0 to {self.episodes - 1}, not {episode}")
        self._begin((self._episodes.states[episode], self._episodes.constants[episode]), episode)

    def start_random(self) -> None:
        """Begins an episode with a random start."""
        self._begin(self.base.sample(self._rng, self.params), None)

    # --- what there is to see ---

    def drawing(self) -> Drawing:
        """The present moment."""
        robots, paths = [], []
        shown_push = self._shown_push if self._push_shown else None
        for key, runner in reversed(self._runners.items()):
            is_main = key == "main"
            color, name = self.color(key), "robot" if is_main else f"ghost {key}"
            alpha = 1.0 if is_main else GHOST_OPACITY
            force = np.array(runner.force) if is_main and not runner.violated else None
            robots.append(Robot(np.array(runner.x), color, force, alpha, name, shown_push if is_main else None))
            if len(runner.trace) > 1:
                paths.append(GroundPath(np.array(runner.trace), color, name=name))
        plan = self.plan()
        if plan is not None:
            paths.append(GroundPath(plan, self.color("main"), dashed=True, name="plan"))
        return Drawing(self.params, tuple(robots), tuple(paths), tuple(self.base.markers(self._start[1])))

    def plan(self) -> np.ndarray | None:
        """(n, 2) where the main robot's controller plans to go, m; None if it does not plan."""
        controller, main = self.main.controller, self.main
        if main.violated or self.ended:
            return None
        predicted = getattr(controller, "predicted", None)
        if predicted is not None:
            return predicted[:, :2]
        plan = getattr(controller, "plan", None)
        if plan is None or hasattr(controller, "predicted"):
            return None
        ahead = plan.trajectory.x[round(main.seconds_of_controller(self._step) / self.task.control_dt) :, :2]
        return ahead[:: max(1, len(ahead) // _PLAN_POINTS)] if len(ahead) > 1 else None

    def color(self, key: str) -> str:
        """The colour of a runner, by its key."""
        name = self._runners[key].name
        return "#2e8b57" if name in DRIVERS else labels.color(Path(name).stem, list(self._runners).index(key))

    @property
    def is_driven(self) -> bool:
        """Whether a human drives the main robot."""
        return self.main.name in DRIVERS

    def robot_names(self) -> tuple[str, ...]:
        """The names of the robots' controllers, the main robot's first."""
        return tuple(dict.fromkeys(runner.name for runner in self._runners.values()))

    def color_of(self, name: str) -> str:
        """The colour of the robot under this controller."""
        return self.color(next(key for key, runner in self._runners.items() if runner.name == name))

    def history(self, points: int) -> History:
        """The last seconds of every robot, at this many times at most."""
        grid = np.array([sample.seconds for sample in self.main.samples])
        grid = (
            grid[np.linspace(0, len(grid) - 1, min(points, len(grid))).round().astype(int)]
            if len(grid)
            else np.zeros(1)
        )
        lines = {}
        for runner in self._runners.values():
            rows = np.array(runner.samples or [Sample(grid[0], 0.0, 0.0, 0.0, 0.0)])
            ahead = [np.interp(grid, rows[:, 0], column) for column in rows.T[1:]]
            lines.setdefault(runner.name, np.stack(ahead, axis=1))
        optimum = np.zeros(len(grid))
        if self._optimum_costs is not None:
            steps = np.round(grid / self.task.control_dt).astype(int) - (self._step - self._elapsed)
            inside = (steps >= 0) & (self._elapsed > 0)
            optimum[inside] = self._optimum_costs[np.minimum(steps[inside], len(self._optimum_costs) - 1)]
        return History(grid, lines, optimum)

    def status(self) -> str:
        """What goes on, in a line."""
        if self.preparing:
            waiting = [
                labels.label(name) for key, name in self._wanted.items() if self._runners[key].controller is None
            ]
            return f"preparing {', '.join(waiting)} … the first time in a task, solvers are compiled"
        if self.ended and self.scores:
            return self.scores[-1].text
        return f"{labels.label(self.main.name)}, {self.seconds:.1f} s of {self.task.duration:g} s"

    # --- what is kept ---

    def trajectory(self) -> Trajectory:
        """The main robot's episode so far.

        Raises:
            ValueError: it has not begun.
        """
        trajectory = self.main.trajectory
        if trajectory is None:
            raise ValueError("the episode has not begun: there is nothing to save")
        return trajectory

    def replay(self) -> Replay:
        """The episode so far, of every robot, as a film shows it.

        Raises:
            ValueError: it has not begun.
        """
        self.trajectory()
        takes = []
        for key, runner in self._runners.items():
            if (trajectory := runner.trajectory) is not None:
                note = _failure_word(runner.violated) if runner.violated else f"cost {runner.cost:.1f}"
                takes.append(Take(labels.label(runner.name), trajectory, self.color(key), note, runner.violated != ""))
        markers = tuple(self.base.markers(self._start[1]))
        return Replay(f"{self.task_name}, played", tuple(takes), markers, self.params)

    def optimize_command(self) -> str:
        """The command that finds the optimum from where the main robot is."""
        state = " ".join(f"{value:.9g}" for value in self.main.x)
        constants = " ".join(
            f"{name} {value:.9g}" for name, value in zip(self.base.constant_names, self._start[1], strict=True)
        )
        return f"ballbot optimize {self.task_name} --state {state}" + (f" --constants {constants}" if constants else "")

    # --- inside ---

    def _open_task(self, task: str, controller: str, ghosts: Sequence[str], episode: int | None) -> None:
        self.task_name = _known("task", task, TASKS)
        self.base: Task = make_task(task, self.robot)
        self._fitting = self._controllers_of(self.base)
        self._check_controller(controller)
        for name in ghosts:
            self._check_controller(name)
        for key, runner in self._runners.items():
            self._background.cancel(key)
            runner.close()
        self.task = Tunable.of(self.base)
        self.weights: dict[str, float] = {}
        """Those that differ from the task's own."""
        known = certified.path_of(self.base, self.robot).exists()
        self._episodes = certified.load(self.base, self.robot) if known else None
        self._runners, self._wanted = {}, {}
        self._next: dict[str, Controller] = {}
        self._add_runner("main", controller)
        for name in dict.fromkeys(ghosts):
            if name != controller:
                self._add_runner(name, name)
        if episode is None or self._episodes is None:
            self.start_random()
        else:
            self.start_certified(episode)

    def _change(self, task: str, robot: str) -> None:
        """Opens a task for a robot, with the present controllers that are made for them."""
        self.robot, self.params = robot, named_robot(robot)
        known = self._controllers_of(make_task(task, robot))
        ghosts = [ghost for ghost in self.ghosts if ghost in known]
        self._open_task(task, self.controller if self.controller in known else "nmpc", ghosts, 0)

    def _add_runner(self, key: str, name: str) -> None:
        self._wanted[key] = name
        runner = self._runners[key] = Runner(name, self.task, self.params, self.physics)
        runner.set_plant(self._randomization)

    def _controllers_of(self, task: Task) -> list[str]:
        """What can be chosen in a task."""
        own = []
        for policy in self._policies:
            with contextlib.suppress(PolicyError):  # a file that is gone by now
                own += [policy] * is_made_for(policy, task, self.robot)
        known = names(task, self.robot)
        experts = [name for name in known if is_expert(name)]
        return [*experts, *VARIANTS, *(name for name in known if name not in experts), *own, *DRIVERS]

    def _check_controller(self, name: str) -> None:
        """Raises a ValueError where nothing has this name. What is in a policy file is found out when it is loaded."""
        if name in self._fitting:
            return
        readable = is_saved_model(name) or Path(name).suffix in (".json", ".safetensors")
        if not (readable and Path(name).is_file()):
            raise ValueError(
                f"unknown controller {name!r}; {self.base.id} has {', '.join(self.controllers)}, or give a policy's .json, "
                "or a model saved by Stable-Baselines3 (.zip) or rsl_rl (.pt)"
            )

    def _begin(self, start: tuple[np.ndarray, np.ndarray], episode: int | None) -> None:
        """Starts an episode; the robots wait for their controllers."""
        self._start, self.episode = start, episode
        self._set_constants()
        self._elapsed = self._pause_left = self._push_shown = 0
        self._pending_push, self._shown_push = (0.0, 0.0), np.zeros(2)
        x = tuple(map(float, start[0]))
        for key, runner in self._runners.items():
            runner.begin(x)
            runner.take_controller(None, self._step)
            runner.name = self._wanted[key]
            self._request(key, x)
        self._request_optimum()

    def _set_constants(self) -> None:
        self._c = tuple(self.task.constants(self._start[1], self.weights).tolist())

    def _request(self, key: str, x: tuple[float, ...], at_step: int | None = None) -> None:
        """Asks for the controller of a runner, from state x at a step, by default now."""
        name, step, c = self._wanted[key], self._step if at_step is None else at_step, self._c
        job_key = key if at_step is None else f"next {key}"
        if at_step is None:
            self._background.cancel(f"next {key}")
            self._next.pop(key, None)
        task, params, stick, compute = self.task, self.params, self.stick, self._background.compute

        def job() -> tuple[str, int, Controller]:
            return name, step, _made(name, task, params, stick, np.array(x), np.array(c), compute)

        self._background.submit(job_key, job)

    def _request_optimum(self) -> None:
        self._optimum_costs: np.ndarray | None = None
        task, params, (x, _), c = self.task, self.params, self._start, np.array(self._c)
        self._background.submit("optimum", lambda: self._background.compute(_optimum_costs, task, params, x, c))

    def _poll(self) -> None:
        """Takes what the background has finished."""
        for key, value in self._background.finished().items():
            if key == "optimum":
                self._optimum_costs = None if isinstance(value, Exception) else value
            elif key.startswith("next "):
                if not isinstance(value, Exception):
                    self._next[key.removeprefix("next ")] = value[2]
            elif key in self._runners:
                self._take(key, value)

    def _take(self, key: str, value: Any) -> None:
        """Hands a controller to its runner. If there is none, the runner keeps the one it has, or gets LQR."""
        runner = self._runners[key]
        if isinstance(value, Exception):
            who = labels.label(self._wanted[key])
            self.notice = f"{who}: {value}"
            if runner.controller is not None:
                self._wanted[key] = runner.name
            elif self._wanted[key] != "lqr":
                self.notice = f"{who} cannot start here, LQR does instead: {value}"
                self._wanted[key] = "lqr"
                self._request(key, runner.x)
            return
        runner.name, step, controller = value
        if is_file(runner.name) and runner.name not in self._policies:
            self._policies.append(runner.name)
            self._fitting = self._controllers_of(self.base)
        runner.take_controller(controller, step)

    def _plan_again(self) -> bool:
        """Whether a robot waits because its plan to a first-exit goal is over, and it is not there.

        NMPC would plan within `act`. But solvers must not run in two threads, so the background plans.
        """
        if not self.task.first_exit:
            return False
        for key, runner in self._runners.items():
            plan = getattr(runner.controller, "plan", None)
            if plan is None or runner.stands_still or not hasattr(runner.controller, "predicted"):
                continue
            if runner.seconds_of_controller(self._step) > plan.trajectory.duration - 0.5 * self.task.control_dt:
                runner.take_controller(None, self._step)
                self._request(key, runner.x)
        return self.preparing

    def _command(self, key: str, runner: Runner, noise: tuple[float, ...]) -> tuple[float, float]:
        try:
            return runner.act(self._step, noise)
        except Exception as error:  # a controller of any kind, such as a policy: the others go on
            self.notice = f"{labels.label(self._wanted[key])}: {error}"
            return 0.0, 0.0

    def _take_push(self) -> tuple[float, float]:
        """The push of this control step, N, drawn and asked for."""
        dt = self.task.control_dt
        (x, y), self._pending_push = self._pending_push, (0.0, 0.0)
        fx, fy = x / dt, y / dt
        if self._randomization.pushes:
            z = tuple(self._rng.random(Randomization.PUSH_DRAWS).tolist())
            drawn = self._randomization.push(z, dt)
            fx, fy = fx + float(drawn[0]), fy + float(drawn[1])
        if fx or fy:
            self._shown_push, self._push_shown = np.array([fx, fy]), round(_PUSH_SHOWN / dt)
        return fx, fy

    def _after_step(self) -> None:
        main, steps = self.main, self.task.steps
        if main.stands_still:
            self._end()
            return
        ahead = round(_AHEAD / self.task.control_dt)
        if self._goes_on and self._elapsed == steps - ahead:
            for key, runner in self._runners.items():
                self._request(key, self._expected(runner, ahead), self._step + ahead)
        if self._elapsed == steps:
            if self._goes_on:
                self._score()
                self._go_on()
            else:
                self._end()

    @property
    def _goes_on(self) -> bool:
        return self.at_end == "go on" and not self.task.first_exit

    def _expected(self, runner: Runner, steps: int) -> tuple[float, ...]:
        """The state in which a robot will be in some control steps, as far as its controller knows."""
        plan = getattr(runner.controller, "plan", None)
        if plan is None:
            return runner.x
        states = plan.trajectory.x
        at = round(runner.seconds_of_controller(self._step) / self.task.control_dt) + steps
        return tuple(states[min(at, len(states) - 1)].tolist())

    def _go_on(self) -> None:
        """Begins another episode where the robots are. A ghost that has failed begins where the main robot is."""
        self._start, self.episode, self._elapsed = (np.array(self.main.x), self._start[1]), None, 0
        for key, runner in self._runners.items():
            if runner.violated:
                runner.place(self.main.x)
                self._next.pop(key, None)
            runner.restart_cost()
            if (controller := self._next.pop(key, None)) is not None and self._wanted[key] == runner.name:
                runner.take_controller(controller, self._step)
            else:
                self._request(key, runner.x)
        self._request_optimum()

    def _end(self) -> None:
        self._score()
        self._pause_left = round(_PAUSE / self.task.control_dt)

    def _score(self) -> None:
        best = self.optimum_cost
        regret = self.main.cost / best - 1 if best > _LEAST_COST else math.nan
        score = Score(
            labels.label(self.main.name),
            self.seconds,
            self.main.cost,
            regret,
            self.main.violated,
            any(self.plant.values()),
        )
        self.scores = [*self.scores, score][-_EPISODES_KEPT:]

    def _begin_next(self) -> None:
        if self.at_end == "stop":
            self._pause_left = 1  # until the user asks for something
        elif self.at_end == "next" and self.episode is not None:
            self.start_certified((self.episode + 1) % self.episodes)
        elif self.at_end == "next":
            self.start_random()
        else:
            self.restart()


AT_END: tuple[AtEnd, ...] = get_args(AtEnd)


def _made(
    name: str,
    task: Tunable,
    params: BallbotParams,
    stick: Stick,
    x: np.ndarray,
    c: np.ndarray,
    compute: Callable[..., Any],
) -> Controller:
    """The controller of a name, at the start of an episode in state x with constants c of the tunable task.

    What takes long is called by `compute`, that may have another process do it.
    """
    if name in DRIVERS:
        return DriveController(task, params, stick, DRIVERS[name])
    if name in _FROM_ELSEWHERE:
        return compute(_expert, name, task, params, x, c)
    if not is_expert(name):
        controller = make_controller(name, task.base, params)
        controller.reset(0.0, x, c[: len(task.base.constant_names)])
        return controller
    from ballbot_baselines.nmpc import NmpcController, prepared_plan  # it imports CasADi

    controller = make_controller(name, task, params)
    if isinstance(controller, NmpcController):  # its solver stays in this process
        controller.start(0.0, c, compute(prepared_plan, task, params, x, c, controller.backoff))
    else:
        controller.reset(0.0, x, c)
    return controller


def _expert(name: str, task: Tunable, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> Controller:
    """An expert at the start of an episode."""
    controller = CONTROLLERS[name](task, params)
    controller.reset(0.0, x, c)
    return controller


def _optimum_costs(task: Tunable, params: BallbotParams, x: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(n + 1,) what the optimum has cost after each control step."""
    from ballbot_baselines import find_optimum

    trajectory = find_optimum(task, params, x, c).trajectory
    rates = task.cost(tuple(trajectory.x[:-1].T), tuple(trajectory.u.T), tuple(c))
    return np.concatenate([[0.0], np.cumsum(rates * task.control_dt)])


def _randomization(plant: dict[str, float]) -> Randomization:
    """All hidden changes together: of each stress the fields that it changes."""
    merged = Randomization()
    for stress, severity in plant.items():
        if severity:
            changed = STRESSES[stress].at(severity)
            merged = replace(
                merged,
                **{f.name: getattr(changed, f.name) for f in fields(changed) if getattr(changed, f.name) != f.default},
            )
    return merged


def _failure_word(limit: str) -> str:
    return {"tilt": "fell", "arena": "left the arena"}.get(limit, f"touched {limit}")


def _known(kind: str, name: Any, known: Any) -> Any:
    """The name, if it is known.

    Raises:
        ValueError: it is not.
    """
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(known)}")
    return name
