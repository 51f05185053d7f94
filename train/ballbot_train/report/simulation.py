"""The simulation of the live playground, independent of its page: a ballbot, ghosts, pushes, hidden changes, costs.

Ghosts are further robots with other controllers. They get the same start and the same pushes as the main robot.
"""

import contextlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ballbot_gym import certified
from ballbot_gym.drawing import GHOST_OPACITY, Drawing, Drawn, GroundPath
from ballbot_gym.engines import State, default_physics
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import PAPER, ROBOTS, Randomization, default_params, named_robot, tilt
from ballbot_gym.rollout import Controller, sensed
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.controllers import ControllerName, _senses
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.evaluation.runner import _showing
from ballbot_train.policy.files import BEST
from ballbot_train.report import labels
from ballbot_train.work.console import check_names

LARGEST_PUSH = 250.0
"""N·s, of a push; larger ones are cut to this length."""

FIRST_PUSH = (79.0, 43.1)
"""N·s: the push with which an episode at rest begins fells LQR. Its length is 90 N·s, as on the page of `ballbot page`."""
_FIRST_PUSH_AFTER = 1.0  # s

_PAUSE = 1.5  # s, between the end of a robot and its next episode
_PUSH_SHOWN = 0.3  # s, for which a push is drawn
_TRACE_STEPS, _TRACE_EVERY = 400, 4  # control steps that the trace on the floor goes back, and between its points

Start = int | Literal["rest", "random"]
"""The index of a certified episode, one that stands at the origin until it is pushed, or one with another start."""


class _World:
    """A task for a robot, and what can be chosen there."""

    def __init__(self, task: str, robot: str):
        """A task and a robot by name.

        Raises:
            ValueError: an unknown task or robot.
        """
        check_names("task", [task], TASKS)
        check_names("robot", [robot], ROBOTS)
        self.task_name, self.robot, self.params = task, robot, named_robot(robot)
        self.task = make_task(task, robot)
        known = ControllerName.known(self.task, robot)
        experts = [name for name in known if ControllerName(name).is_expert]
        self.controllers = [*experts, "nmpc-offset-free", *(name for name in known if name not in experts)]
        """What can be chosen, experts first."""
        best = BEST.get(task, "")
        self.best = best if best in known else "nmpc"
        """The controller to begin with: the shipped policy with the least regret, or else NMPC."""
        self.certified: certified.EvaluationSet | None = None
        with contextlib.suppress(certified.CertificateError):
            self.certified = certified.load(self.task, robot)


@dataclass(eq=False)
class Runner:
    """A ballbot under one controller in an environment, and its episode so far."""

    name: str
    controller: Controller
    env: BallbotEnv
    states: list[State] = field(default_factory=list)
    forces: list[tuple[float, ...]] = field(default_factory=list)
    cost: float = 0.0
    peak: float = 0.0
    """Largest tilt, rad."""
    violated: str = ""
    arrived: bool = False
    seen: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(no,) what the environment shows."""

    def __post_init__(self) -> None:
        self.env = _showing(self.env, self.controller)

    @property
    def x(self) -> State:
        """(n,) the state."""
        return self.states[-1]

    @property
    def force(self) -> tuple[float, ...]:
        """(m,) the last force, N."""
        return self.forces[-1] if self.forces else (0.0,) * self.env.params.action_size

    @property
    def failed(self) -> str:
        """How it failed, in words; "" while it has not."""
        return _failure_word(self.violated)

    @property
    def stands_still(self) -> bool:
        """Whether its episode is over."""
        return self.violated != "" or self.arrived

    def begin(self, start: tuple[np.ndarray, np.ndarray], seed: int) -> None:
        """Begins an episode in a state (n,) with constants (nc,). The seed is of all that is drawn in it."""
        self.seen, _ = self.env.reset(seed=seed, options={"state": start[0], "constants": start[1]})
        self.states, self.forces = [tuple(start[0].tolist())], []
        self.cost, self.peak, self.violated, self.arrived = 0.0, float(tilt(self.x)), "", False

    def move_to(self, env: BallbotEnv) -> None:
        """Continues the episode in another environment."""
        before = self.env.get_state()
        self.env.close()
        self.env = _showing(env, self.controller)
        where = None if self.stands_still else {"state": self.x, "constants": before.constants}
        self.seen, _ = self.env.reset(seed=0, options=where)
        kept = {name: getattr(before, name) for name in ("constants", "steps_left", "rng")}
        self.env.set_state(self.env.get_state()._replace(x=self.x, memory=(), **kept))

    def prepare(self, seconds: float) -> None:
        """The controller begins at a time of the episode, s, or raises what its `reset` raises."""
        self.controller.reset(seconds, self._shown(seconds), np.array(self.env.get_state().constants))

    def _shown(self, seconds: float) -> np.ndarray:
        """What the controller is shown at a time of the episode, s: what the sensors read, or the state."""
        if _senses(self.controller):
            return self.seen
        return sensed(self.env, np.array(self.x), seconds)

    def command(self, seconds: float) -> np.ndarray:
        """(m,) the force, N, that the controller commands at that time of the episode, s.

        Raises:
            FloatingPointError: a force that is not finite.
        """
        u = np.asarray(self.controller.act(seconds, self._shown(seconds)), np.float64)
        if u.shape != (self.env.params.action_size,) or not np.isfinite(u).all():
            raise FloatingPointError(f"it commands {u} N")
        return u

    def push(self, impulse: np.ndarray) -> None:
        """Pushes the body's centre of mass by an impulse (2,), N·s."""
        pushed = self.env.episode_params.pushed(self.x, tuple(impulse.tolist()))
        self.states[-1] = tuple(map(float, pushed))
        self.env.set_state(self.env.get_state()._replace(x=self.x, memory=()))

    def step(self, command: np.ndarray) -> None:
        """Holds a command (m,), N, for one control step."""
        self.seen, _, terminated, _, info = self.env.step(command / self.env.params.force_limit)
        self.states.append(tuple(info["state"].tolist()) if np.isfinite(info["state"]).all() else self.x)
        self.forces.append(tuple(info["force"].tolist()))
        self.cost += info["cost"]
        self.peak = max(self.peak, float(tilt(self.x)))
        self.violated = self.env.limit_names[info["violated"]] if info["failure"] else ""
        self.arrived = terminated and info["success"]


class _Score(NamedTuple):
    """How an episode of the main robot ended."""

    controller: str
    seconds: float
    cost: float
    regret: float
    """Cost over the optimum's, less 1; NaN without an optimum. Pushes count: the optimum had none."""
    failure: str
    """The violated limit, or ""."""

    @property
    def text(self) -> str:
        """In words."""
        regret = "" if math.isnan(self.regret) else f", regret {100 * self.regret:.1f} %"
        if self.failure:
            return f"{self.controller}: {_failure_word(self.failure)} after {self.seconds:.1f} s{regret}"
        return f"{self.controller}: {self.seconds:.1f} s, cost {self.cost:.1f}{regret}"


class Playground:
    """A ballbot and its ghosts. `step` moves all of them by one control step; nothing here waits for real time.

    A method that needs a new controller or a new plan returns when it is computed. If a method raises an error, it has
    changed nothing. A ValueError says that a name is unknown or a value is out of bounds; other errors come from a
    controller that cannot be made or finds no plan.
    """

    def __init__(
        self,
        task: str = "stabilize",
        controller: str | None = None,
        ghosts: Sequence[str] = (),
        physics: str | None = None,
        episode: Start = 0,
        seed: int = 0,
        robot: str = PAPER,
        randomization: str | None = None,
    ):
        """Begins an episode.

        Args:
            task: name of a task.
            controller: of the main robot: an expert, a policy that comes with the package, or the path of a policy file or
                of a model that Stable-Baselines3 saved; default, the shipped policy with the least regret, or else NMPC.
            ghosts: controllers of the ghosts.
            physics: "bullet", "mujoco" or "rk4"; default, as for environments.
            episode: see `begin`.
            seed: of random starts, sensor noise and random pushes.
            robot: a name in `ROBOTS`.
            randomization: name of a track, which draws a robot for every episode, hidden from the controllers.

        Raises:
            ValueError: an unknown task, robot, controller, episode or track.
        """
        self.announce: Callable[[str], object] = lambda text: None
        """Is called with a sentence before something that may take long."""
        self.scores: list[_Score] = []
        """Of the main robot's episodes."""
        self.plant = dict.fromkeys(STRESSES, 0.0)
        """Severity of each hidden change."""
        self.runners: list[Runner] = []
        """The main robot, then the ghosts."""
        self.notice = ""
        """What went wrong last, in words."""
        self.episode: Start = episode
        self._rng = np.random.default_rng(seed)
        self._track = Randomization.checked(randomization)
        self._physics = default_physics() if physics is None else physics
        world = _World(task, robot)
        self._open(world, [world.best if controller is None else controller, *ghosts])
        self.begin("random" if world.certified is None and episode != "rest" else episode)

    # --- what it is ---

    @property
    def main(self) -> Runner:
        """The main robot."""
        return self.runners[0]

    @property
    def ghosts(self) -> tuple[str, ...]:
        """The names of the ghosts' controllers."""
        return tuple(ghost.name for ghost in self.runners[1:])

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
        """The optimal cost of the certified episode, without pushes; NaN for other starts and for a changed robot."""
        known, i = self.world.certified, self.episode
        changed = any(self.plant.values()) or self._track.active
        return math.nan if known is None or isinstance(i, str) or changed else float(known.costs[i])

    @property
    def shown_push(self) -> np.ndarray | None:
        """(2,) N·s, the push that pictures show; None if there was none in the last moments."""
        return self._push if self.elapsed < self._push_until else None

    @property
    def colors(self) -> list[str]:
        """Of the robots in pictures."""
        return [labels.color(Path(runner.name).stem, i) for i, runner in enumerate(self.runners)]

    def drawing(self) -> Drawing:
        """The present state of all robots, as the content of a picture."""
        main, robots, paths, colors = self.main, [], [], self.colors
        for i, runner in reversed(list(enumerate(self.runners))):
            alpha = GHOST_OPACITY if i else 1.0
            force = np.array(runner.force) if runner is main and not main.violated else None
            said = runner.failed or f"{math.degrees(tilt(runner.x)):.0f}°"
            label, push = f"{labels.label(runner.name)} {said}", self.shown_push if runner is main else None
            robots.append(Drawn(np.array(runner.x), colors[i], force, alpha, push, label))
            trace = np.array(runner.states[:-_TRACE_STEPS:-_TRACE_EVERY])[:, :2]
            paths += [GroundPath(trace, colors[i])] * (len(trace) > 1)
        return Drawing(self.world.params, tuple(robots), tuple(paths), tuple(self.world.task.markers(self.start[1])))

    # --- time ---

    def step(self) -> None:
        """Moves everything by one control step. After an end everything stands still for a while, then the next begins."""
        if self.ended:
            self._pause_left -= 1
            if not self.ended:
                self.restart()
            return
        dt = self.world.task.control_dt
        if self.episode == "rest" and self.elapsed == round(_FIRST_PUSH_AFTER / dt):
            self.push(
                *(
                    part * getattr(self.world.params, "total_mass", 1.0) / default_params().total_mass
                    for part in FIRST_PUSH
                )
            )
        for runner in self.runners:
            if not runner.stands_still:
                try:
                    command = runner.command(self.seconds)
                except Exception as error:  # a controller of any kind, such as a policy: the others continue
                    self.notice = f"{labels.label(runner.name)}: {error}"
                    command = np.zeros(self.world.params.action_size)
                runner.step(command)
        self.elapsed += 1
        if self.elapsed >= self.world.task.steps or self.main.stands_still:
            self._end()

    def close(self) -> None:
        """Releases the simulators; may be called again."""
        for runner in self.runners:
            runner.env.close()

    # --- what a user does ---

    def push(self, x: float, y: float) -> None:
        """Pushes every robot by an impulse along x and y, N·s, on its body's centre of mass."""
        length = math.hypot(x, y)
        if not math.isfinite(length):
            raise ValueError(f"a push must be finite numbers, not {x} and {y}")
        self._push = np.array([x, y]) * (LARGEST_PUSH / max(length, LARGEST_PUSH))
        self._push_until = self.elapsed + round(_PUSH_SHOWN / self.world.task.control_dt)
        for runner in self.runners:
            if not runner.stands_still:
                runner.push(self._push)

    def set_world(self, task: str | None = None, robot: str | None = None) -> None:
        """Another task, or another robot, under the same controllers where they are made for it."""
        world = _World(task or self.world.task_name, robot or self.world.robot)
        main = self.main.name if self.main.name in world.controllers else world.best
        self._open(world, [main, *(ghost for ghost in self.ghosts if ghost in world.controllers)])
        self.begin("random" if world.certified is None else 0)

    def set_controller(self, name: str) -> None:
        """Another controller for the main robot, which continues where it is."""
        main, controller = self.main, self._made(name, self.world)
        before, main.controller = main.controller, controller
        try:
            if _senses(controller) != _senses(before):
                main.move_to(self._env(self.world))
            if not self.ended:
                main.prepare(self.seconds)
        except Exception:
            main.controller = before
            raise
        main.name = name
        if self.ended:
            self.restart()

    def set_ghosts(self, ghosts: Sequence[str]) -> None:
        """Other ghosts. The episode begins again, because all have the same start."""
        self._open(self.world, [self.main.name, *ghosts])
        self.restart()

    def set_plant(self, stress: str, value: float) -> None:
        """Changes what the controllers do not know, for every robot. The value is one of the choices of `STRESSES`."""
        check_names("change", [stress], STRESSES)
        low, high, step = STRESSES[stress].choices
        if not low <= value <= high:
            raise ValueError(f"{stress} must be {low:g} to {high:g}, not {value:g}")
        before = self.plant[stress]
        self.plant[stress] = step * round(value / step)
        try:
            made = [self._env(self.world) for _ in self.runners]
        except ValueError:
            self.plant[stress] = before
            raise
        for runner, env in zip(self.runners, made, strict=True):
            runner.move_to(env)

    def restart(self) -> None:
        """Begins the same episode again."""
        self._begin(self.start, self.episode)

    def begin(self, episode: Start) -> None:
        """Begins a certified episode, by its index, a random one, or one that stands at the origin until it is pushed, which
        happens by itself.
        """
        task, known = self.world.task, self.world.certified
        if episode in ("rest", "random"):
            x, c = task.sample(self._rng, self.world.params)
            self._begin((np.zeros(self.world.params.state_size) if episode == "rest" else x, c), episode)
        elif known is None:
            raise ValueError(
                f"{self.world.task_name} has no certified episodes for {self.world.robot}; begin a random one"
            )
        elif not 0 <= episode < len(known):
            raise ValueError(f"episode must be 0 to {len(known) - 1}, not {episode}")
        else:
            self._begin((known.states[episode], known.constants[episode]), episode)

    # --- inside ---

    def _open(self, world: _World, controllers: Iterable[str]) -> None:
        made = [(name, self._made(name, world)) for name in controllers]
        self.close()
        self.world = world
        self.runners = [Runner(*each, self._env(world)) for each in made]

    def _made(self, name: str, world: _World) -> Controller:
        """A controller by name, which is offered from then on."""
        self.announce(f"preparing {labels.label(name)} … the first time in a task, solvers are compiled")
        controller = ControllerName(name).make(world.task, world.params)
        if name not in world.controllers:  # a file
            world.controllers.append(name)
        return controller

    def _begin(self, start: tuple[np.ndarray, np.ndarray], episode: Start) -> None:
        """Begins an episode. A controller that finds no plan is replaced by LQR."""
        self.start, self.episode = start, episode
        self.elapsed = self._pause_left = self._push_until = 0
        seed = int(self._rng.integers(2**32))  # the same for all, so that they meet the same robot, noise and pushes
        for runner in self.runners:
            runner.begin(start, seed)
        for runner in self.runners:
            self.announce(f"preparing {labels.label(runner.name)} …")
            try:
                runner.prepare(0.0)
            except Exception as error:
                self.notice = f"{labels.label(runner.name)} cannot start here, LQR does instead: {error}"
                runner.name = "lqr"
                runner.controller = ControllerName("lqr").make(self.world.task, self.world.params)
                runner.prepare(0.0)

    def _env(self, world: _World) -> BallbotEnv:
        """With what the controllers do not know: the true robot, its actuator, sensors and pushes.

        Changes by hand take the track's place.
        """
        changes = [STRESSES[stress].at(value) for stress, value in self.plant.items() if value]
        changed = {
            f.name: value for each in changes for f in fields(each) if (value := getattr(each, f.name)) != f.default
        }
        hidden = replace(Randomization(), **changed) if changes else self._track
        return BallbotEnv(world.task, self._physics, robot=world.params, randomization=hidden)

    def _end(self) -> None:
        """Notes the score. The same episode begins again after a pause; if only time is over, another where the robot is."""
        task, main = self.world.task, self.main
        regret = main.cost / self.optimum_cost - 1
        self.scores.append(_Score(labels.label(main.name), self.seconds, main.cost, regret, main.violated))
        if task.first_exit or main.stands_still:
            self._pause_left = round(_PAUSE / task.control_dt)
        else:
            self._begin((np.array(main.x), self.start[1]), "random")


def _failure_word(limit: str) -> str:
    """What a violated limit means, in words; "" for none."""
    return {
        "": "",
        "tilt": "fell",
        "arena": "left the arena",
        "grip": "lost its grip",
        "engine": "cannot be simulated on",
    }.get(limit, f"touched {limit}")
