"""Every controller of every task on the certified episodes, in parallel processes and resumably."""

import base64
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import certified, files
from ballbot_gym.certified import version
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.identity import named_problem_digest
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import PAPER, named_robot, robot_setting
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import TASKS, Task
from ballbot_train import jobs
from ballbot_train.console import check_least, check_names, check_some, markdown, print_table
from ballbot_train.evaluation import controllers as registry
from ballbot_train.evaluation import optima, recordings
from ballbot_train.evaluation.evaluate import as_controller, run_episodes, shown_to
from ballbot_train.evaluation.results import Result, columns, table_cells
from ballbot_train.executors import Workers
from ballbot_train.policy_files import shipped_ways
from ballbot_train.provenance import provenance

_TABLES = ("leaderboard", "tracks", "robustness", "transfer", "basins")
"""What runs write as NAME.json when they end."""
CHUNK = 5
"""Episodes of a job."""


def controllers_of(
    tasks: Sequence[str], names: Sequence[str] = (), robot: str = PAPER, tracks: bool = False
) -> dict[str, list[str]]:
    """The controllers to run on each task: those named that the task has; without names, all it has but for variants.

    Policies that were trained on tracks are among the latter if tracks are run.

    A policy is made for one task, and is left out for the others; tasks left without a controller are left out too.

    Raises:
        ValueError: a name that none of the tasks has, a name that is given twice, or no task.
        PolicyError: a policy file that is missing or damaged.
    """
    return controllers_by_robot(tasks, names, [robot], tracks)[robot]


def controllers_by_robot(
    tasks: Sequence[str], names: Sequence[str], robots: Sequence[str], tracks: bool = False
) -> dict[str, dict[str, list[str]]]:
    """As `controllers_of`, by the robots that controllers were made for. A name is of the robots that have it."""
    check_some("task", tasks, TASKS)
    track = None if tracks or names else ""
    known = {robot: {task: registry.names(make_task(task, robot), robot, track) for task in tasks} for robot in robots}
    if not names:
        return known
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"controller {', '.join(repeated)} is given more than once; give each once")
    chosen: dict[str, dict[str, list[str]]] = {}
    for robot, task in itertools.product(robots, tasks):
        if found := [name for name in names if registry.acts_in(name, make_task(task, robot), robot)]:
            chosen.setdefault(robot, {})[task] = found
    used = {name for by_task in chosen.values() for group in by_task.values() for name in group}
    unused = [name for name in names if name not in used]
    if unused and registry.is_file(unused[0]):
        made_for = registry.made_for(unused[0])
        raise ValueError(f"{unused[0]} was made for {made_for}, which is none of {', '.join(tasks)}")
    for task in tasks if unused else ():
        if hint := registry.of_other_robot(unused[0], make_task(task, robots[0])):
            raise ValueError(f"unknown controller {unused[0]} for the robot {robots[0]}; {hint}")
    check_names("controller", unused, dict.fromkeys(name for group in known[robots[0]].values() for name in group))
    return chosen


def policy_digests(controllers: Mapping[str, Sequence[str]], robot: str = PAPER) -> dict[str, str]:
    """SHA-256 of the weights of every learned policy among controllers by task, under "TASK/NAME"."""
    return {
        f"{task}/{name}": registry.policy_digest(name, make_task(task, robot), robot)
        for task, group in controllers.items()
        for name in group
        if not registry.is_expert(name)
    }


def open_run(
    out: Path,
    workers: int | Workers,
    chosen: Mapping[str, Mapping[str, Sequence[str]]],
    robot: str = PAPER,
    **settings: Any,
) -> dict[str, Any]:
    """Claims a folder for a run with some settings; `publish` or `jobs.release` ends the run.

    Args:
        out: the folder.
        workers: a number of processes, or `Workers`; they change no result.
        chosen: the controllers that are run by task, by the robot that they were made for, as `controllers_by_robot` gives.
        robot: on which they run, by name.
        settings: whatever else decides the results.

    Returns:
        The facts that the results name.

    Raises:
        ValueError: the folder holds results, or an unfinished run, with other settings, problems, policies or code; another
            process is using it; or the seed is negative.
    """
    check_least(0, seed=settings.get("seed", 0))
    policies = {
        name if made_for == robot else f"{made_for}/{name}": digest
        for made_for, by_task in chosen.items()
        for name, digest in policy_digests(by_task, made_for).items()
    }
    problems = {
        task if name == robot else f"{name}/{task}": named_problem_digest(task, name)
        for made_for, by_task in chosen.items()
        for task in by_task
        for name in (robot, made_for)
    }
    settings |= robot_setting(robot) | {"policies": policies, "problems": problems}
    settings["controllers"] = chosen
    for path in (out / f"{name}.json" for name in _TABLES):
        if path.exists():
            about = files.read_json(path).get("about")
            held = {key: value for key, value in about.items() if key in settings} if isinstance(about, dict) else {}
            jobs.check_same(held, settings, out, "results")
    facts = {"benchmark": version.BENCHMARK} | provenance() | settings
    facts["workers"] = Workers.of(workers).here or "a Ray cluster"
    ways = {name: shipped_ways()[found] for name, found in policies.items() if found in shipped_ways()}
    facts |= {"trained_by": ways} if ways else {}
    jobs.claim(out, {key: facts[key] for key in ("benchmark", "version", "commit", *settings)})
    return facts


def publish(out: Path, name: str, title: str, shown: Mapping[str, Callable[[Any], str]], rows: Sequence[Any]) -> None:
    """Ends a run: writes its table as NAME.md, and prints it. It has what is `shown` of each row, by header."""
    header, table = list(shown), table_cells(shown, rows)
    files.write(out / f"{name}.md", markdown(header, table))
    jobs.release(out)
    print_table(title, header, table)


def floor(robot: str, friction: float | None) -> BallbotParams:
    """A robot by name on a floor with this friction; None is the robot's own.

    Raises:
        ValueError: a friction for a robot whose ball does not roll.
    """
    params = named_robot(robot)
    if friction is None:
        return params
    if not params.rolls:
        raise ValueError(f"the ball of {robot!r} does not roll, so its floor has no friction; give a rolling robot")
    return replace(params, friction=friction)


@dataclass(frozen=True)
class Group:
    """One controller on the certified episodes of a task, in one world."""

    task: str
    controller: str
    physics: str
    robot: str = PAPER
    """Whose episodes they are, by name."""
    made_for: str | None = None
    """Name of the robot that the controller is made for; default, `robot`. It plans and observes as for that one."""
    friction: float | None = None
    """Of the floor, as of `floor`; regret is over the optimum on the robot's own floor then too."""
    randomization: Randomization = Randomization()
    own_optima: bool = False
    """Whether regret is over the optimum of each episode's own robot, and not over the undisturbed one."""
    told: Mapping[str, Any] = field(default_factory=dict)
    """What the results are told by."""
    counts_for: str = ""
    """What its progress counts for; default, the task."""

    @property
    def problem(self) -> tuple[str, str, Randomization]:
        """Whose optima its regret is over."""
        return self.task, self.robot, self.randomization if self.own_optima else Randomization()

    @property
    def believed(self) -> tuple[Task, BallbotParams]:
        """What the controller is made for."""
        made_for = self.made_for or self.robot
        return make_task(self.task, made_for), named_robot(made_for)


def run_groups(
    groups: Sequence[Group],
    episodes: int,
    out: Path,
    workers: int | Workers,
    seed: int = 0,
    record: bool = False,
) -> list[Result]:
    """Runs groups in parallel processes, with progress bars. What an interrupted run finished is not run again.

    Optima that the package does not have are computed.

    Args:
        groups: what to run.
        episodes: of each group, from the first.
        out: folder of the results.
        workers: a number of processes, or `Workers`.
        seed: of whatever is drawn: episode i draws the same in every group.
        record: whether to write what the controllers do, for `ballbot submit`, which knows no robot with wheels.
    """
    recorded = {group.robot: record and named_robot(group.robot).wheels is None for group in groups}
    parts = [range(start, min(start + CHUNK, episodes)) for start in range(0, episodes, CHUNK)]
    # the optima go along, because workers on other machines do not have this user's cache
    known = {
        (task, robot, varied): replace(
            optima.known(task, robot, range(episodes), workers, varied), trajectories=(), statuses=np.zeros(0, str)
        )
        for task, robot, varied in dict.fromkeys(group.problem for group in groups)
    }
    work = [
        jobs.Job(
            name="-".join(
                [*map(str, (group.task, group.controller, group.physics, *group.told.values())), f"{part.start:03d}"]
            ),
            function=_episode_entries,
            arguments=(group, sent, seed, known[group.problem], recorded[group.robot]),
            items=tuple(part),
            group=group.counts_for or group.task,
        )
        for group in groups
        for sent in [registry.portable(group.controller, *group.believed)]
        for part in parts
    ]
    done, results = iter(jobs.run(work, out, workers)), []
    for group in groups:
        entries = [entry for _ in parts for entry in next(done)]
        if recorded[group.robot]:
            motions = [recordings.read("a job", base64.b64decode(entry.pop("motion"))) for entry in entries]
            task, params = make_task(group.task, group.robot), named_robot(group.robot)
            who = group.physics, group.controller, registry.policy_digest(group.controller, task, group.robot)
            recordings.write_in(out, motions, task, group.task, params, *who)
        results += [Result(**entry, told=group.told) for entry in entries]
    return results


def _episode_entries(
    group: Group,
    sent: str | Controller,
    seed: int,
    known: certified.EvaluationSet,
    record: bool,
    episodes: Sequence[int],
) -> Iterator[jobs.Entry]:
    robot = floor(group.robot, group.friction)
    env = BallbotEnv(group.task, physics=group.physics, randomization=group.randomization, robot=robot)
    made = as_controller(sent, *group.believed)
    env = shown_to(made, env)
    motions: list[recordings.Recording] = []
    results = run_episodes(env, made, group.controller, group.task, episodes, seed, known, motions)
    env.close()
    for result, motion in zip(results, motions, strict=True):
        yield columns(result) | ({"motion": base64.b64encode(recordings.to_bytes(motion)).decode()} if record else {})
