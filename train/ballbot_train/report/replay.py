"""The same episode under several controllers, as trajectories with labels. `film` draws them."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ballbot_gym import certified, seeding
from ballbot_gym.drawing import Drawing, Drawn, GroundPath
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import PAPER, Robot, default_params, named_robot
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation import optima
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.evaluation.names import shortened
from ballbot_train.evaluation.results import Result
from ballbot_train.evaluation.runner import _showing, floor
from ballbot_train.policy.files import PolicyFile, shipped_policies, shipped_ways
from ballbot_train.report import labels

LEAST_SLIP = 0.02
"""m/s: what is less is the simulation's error."""
SKID = "#c01818"
"""The colour of a path where the ball slips."""
_FILE_DT = 0.02  # s, between the states of a trajectory that is interpolated


@dataclass(frozen=True)
class Take:
    """One trajectory of a replay.

    `note` says how it ended, and `failed` whether the robot fell or touched an obstacle. `style` is of its lines in figures.
    """

    label: str
    trajectory: Trajectory
    color: str
    note: str = ""
    failed: bool = False
    style: str = "-"
    slip: np.ndarray | None = None
    """(n,) speed of the ball's lowest point over the floor as each force begins, m/s, where contact is simulated."""

    def playable(self, name: str = "") -> "Take":
        """The same from time 0 on, with states that a replay can join by straight lines.

        Raises:
            ValueError: it holds a single state; the message says the name, or else the label.
        """
        moved = self.trajectory
        if not len(moved.u):
            raise ValueError(f"{name or self.label} holds a single state: nothing moves")
        if moved.xdot is not None or not moved.held:
            moved = moved.resampled(_FILE_DT)
        return replace(self, trajectory=replace(moved, t=moved.t - moved.t[0]))

    def slip_at(self, t: float) -> float:
        """The slip at time t, s; 0 after the end."""
        if self.slip is None or t >= self.trajectory.duration:
            return 0.0
        return float(self.slip[np.searchsorted(self.trajectory.t[:-1], t + 1e-9) - 1])


@dataclass(frozen=True)
class Replay:
    """Takes of the same episode, and the markers on the floor."""

    title: str
    takes: tuple[Take, ...]
    markers: tuple[Marker, ...] = ()
    params: Robot = field(default_factory=default_params)

    @classmethod
    def of_files(cls, paths: Sequence[Path]) -> "Replay":
        """Trajectory files side by side.

        Raises:
            TrajectoryError: a file is missing or holds no trajectory.
        """
        takes, names = [], shortened(map(str, paths))
        for i, path in enumerate(paths):
            label = names[str(path)].removesuffix(path.suffix)
            takes.append(Take(label, Trajectory.load(path), labels.color(path.stem, i)).playable(str(path)))
        return cls(", ".join(take.label for take in takes), tuple(takes))

    @property
    def duration(self) -> float:
        """The duration of the longest take, s."""
        return max(take.trajectory.duration for take in self.takes)

    def drawing(self, take: Take, t: float) -> Drawing:
        """One of the takes at time t, s, with its path so far. After its end a robot stands still."""
        u = take.trajectory.force(t) if t < take.trajectory.duration else None
        driven, skids = take.trajectory, ()
        if take.slip is not None:
            slips = np.flatnonzero((take.slip > LEAST_SLIP) & (driven.t[1:] <= t))
            skids = (GroundPath(driven.x[i : i + 2, :2], SKID) for i in slips)
        places = np.array([self.params.position(x) for x in driven.states_until(t)])
        paths = GroundPath(places, take.color), *skids
        return Drawing(self.params, (Drawn(take.trajectory.state(t), take.color, u),), paths, self.markers)


def certified_replay(
    task: str,
    controllers: Sequence[str],
    episode: int,
    physics: str = "bullet",
    skip_planless: bool = False,
    robot: str = PAPER,
    frictions: Sequence[float] = (),
) -> Replay:
    """A certified episode under controllers by name, on one floor or on several.

    Args:
        task: name of a task.
        controllers: names of controllers, or paths of policy files.
        episode: index of the episode.
        physics: "bullet", "mujoco" or "rk4".
        skip_planless: leave out controllers that find no plan.
        robot: by name.
        frictions: coefficients of friction of the floors, for a robot whose ball rolls; default, the robot's own. Controllers
            always assume the robot's own.

    Raises:
        ValueError: an unknown task, controller or episode, or frictions for a robot whose ball does not roll.
        PlanError: a controller finds no plan, unless `skip_planless`.
    """
    problem, params = make_task(task, robot), named_robot(robot)
    own_floor = getattr(params, "friction", None)
    if not 0 <= episode < certified.EPISODES:
        raise ValueError(f"episode must be 0 to {certified.EPISODES - 1}, not {episode}")
    episode_set = optima.known(problem, robot, [episode])
    takes, shipped = [], shipped_policies(problem, robot, None)
    ways = {
        f"{task}/{name}": shipped_ways().get(PolicyFile(path).weights_digest(), "") for name, path in shipped.items()
    }
    named = labels.labels(controllers, task, ways)
    for name, friction in itertools.product(controllers, frictions or (None,)):
        controller, slips = ControllerName(name).make(problem, params), list[float]()
        env = _showing(BallbotEnv(problem, physics=physics, robot=floor(robot, friction)), controller)
        try:
            seed, options = seeding.of_episode(0, episode), episode_set.options(episode)
            run = rollout(env, controller, seed, options, lambda _, env=env, slips=slips: slips.append(env.slip))
        except PlanError:
            if not skip_planless:
                raise
            continue
        finally:
            env.close()
        label, color, slip = named[name], labels.color(Path(name).stem, len(takes)), np.array(slips)
        note = f"fails at {run.trajectory.duration:.2f} s"
        if not run.failure:
            regret = round(100 * (run.cost / episode_set.costs[episode] - 1), 1) + 0  # no −0.0
            of = "" if friction in (None, own_floor) else f" to the optimum of friction {own_floor:g}"
            note = f"regret {regret:.1f} %{of}"
        if slip.max() > LEAST_SLIP:
            note += f"; slips for {problem.control_dt * np.count_nonzero(slip > LEAST_SLIP):.2f} s"
        if friction is not None:  # the floor gives the colour, because one controller runs on several
            label = f"{label}, friction {friction:g}" if len(controllers) > 1 else f"friction {friction:g}"
            color = labels.color("", len(takes))
        takes.append(Take(label, run.trajectory, color, note, run.failure, slip=slip))
    markers = tuple(problem.markers(episode_set.constants[episode]))
    return Replay(f"{task}, certified episode {episode}", tuple(takes), markers, params)


def telling_episode(task: str, results: Sequence[Result]) -> int:
    """The first episode of a task in which one controller fails and another does not, else the first of all."""
    failures: dict[int, set[bool]] = {}
    for result in results:
        if result.task == task:
            failures.setdefault(result.episode, set()).add(result.failure)
    return next((episode for episode, seen in sorted(failures.items()) if len(seen) == 2), min(failures))
