"""Runs controllers on the certified episodes of a task, or from given states, with any robot and engine.

`run_episodes` runs one controller in one environment. `MeasuredRun` runs many in parallel processes, resumably. Everything
that measures episodes one by one does so through these: `evaluate`, and the commands benchmark, evaluate, robustness,
transfer and basins.
"""

import base64
import math
import numbers
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import certified, files, seeding
from ballbot_gym.certified import version
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import PAPER, Randomization, Robot, named_robot, robot_setting
from ballbot_gym.rollout import Controller, PlanError, rollout
from ballbot_gym.tasks import Task
from ballbot_train.evaluation import optima
from ballbot_train.evaluation.controllers import ControllerName, _senses, as_controller, policy_digests
from ballbot_train.evaluation.recordings import Recording
from ballbot_train.evaluation.results import Result, Row, table_cells, write_results
from ballbot_train.policy.files import PolicyFile, shipped_ways
from ballbot_train.work import jobs
from ballbot_train.work.console import check_least, markdown, print_table
from ballbot_train.work.executors import Workers
from ballbot_train.work.provenance import provenance

_TABLES = ("leaderboard", "tracks", "robustness", "transfer", "basins")
"""What runs write as NAME.json when they end."""
CHUNK = 5
"""Episodes of a job."""


def floor(robot: str, friction: float | None) -> Robot:
    """A robot by name on a floor with this friction; None is the robot's own.

    Raises:
        ValueError: a friction for a robot whose ball does not roll.
    """
    params = named_robot(robot)
    if friction is None:
        return params
    try:
        return params.on_floor(friction)
    except ValueError as error:
        raise ValueError(f"{robot!r}: {error}") from None


@dataclass(frozen=True)
class Group:
    """One controller on the certified episodes of a task, or from states of its own, in one world."""

    task: str
    controller: str
    physics: str
    robot: str = PAPER
    """Whose episodes they are, by name."""
    made_for: str | None = None
    """Name of the robot that the controller is made for; default, `robot`. It plans and observes as for that one."""
    friction: float | None = None
    """Of the floor, see `floor`. Regret is then still measured against the optimum on the robot's own floor."""
    randomization: Randomization = Randomization()
    own_optima: bool = False
    """Whether regret is over the optimum of each episode's own robot, and not over the undisturbed one."""
    starts: np.ndarray | None = field(default=None, compare=False)
    """(n, state size) initial states that replace the certified episodes; there is no regret then."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Fields of the task that are not its defaults."""
    labels: Mapping[str, Any] = field(default_factory=dict)
    """Labels of its results, see `Result.labels`."""
    counts_for: str = ""
    """What its progress counts for; default, the task."""

    @property
    def problem(self) -> tuple[str, str, Randomization]:
        """Whose optima its regret is over."""
        return self.task, self.robot, self.randomization if self.own_optima else Randomization()

    @property
    def believed(self) -> tuple[Task, Robot]:
        """What the controller is made for."""
        made_for = self.made_for or self.robot
        return make_task(self.task, made_for, **self.fields), named_robot(made_for)


@dataclass(frozen=True)
class MeasuredRun:
    """A run that measures controllers on many episodes, in parallel and resumably, and whose results go into one folder."""

    out: Path
    """The folder."""
    workers: int | Workers = 1
    """A number of processes, or `Workers`; they change no result."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """What the results name; of a run that is opened."""

    @classmethod
    def open(
        cls,
        out: Path,
        workers: int | Workers,
        chosen: Mapping[str, Mapping[str, Sequence[str]]],
        robot: str = PAPER,
        **settings: Any,
    ) -> "MeasuredRun":
        """Claims a folder for a run with some settings; `publish` or `RunFolder.release` ends the run.

        Args:
            out: the folder.
            workers: a number of processes, or `Workers`; they change no result.
            chosen: the controllers that are run by task, by the robot that they were made for, as `controllers_of` gives.
            robot: on which they run, by name.
            settings: whatever else decides the results.

        Raises:
            ValueError: the folder holds results, or an unfinished run, with other settings, problems, policies or code;
                another process is using it; or the seed is negative.
        """
        check_least(0, seed=settings.get("seed", 0))
        digests = PolicyFile.weights_digest, PolicyFile.network_digest
        policies, networks = (policy_digests(chosen, robot, of) for of in digests)
        problems = {
            task if name == robot else f"{name}/{task}": certified.named_problem(task, name)
            for made_for, by_task in chosen.items()
            for task in by_task
            for name in (robot, made_for)
        }
        settings |= robot_setting(robot) | {"policies": policies, "networks": networks, "problems": problems}
        settings["controllers"] = chosen
        for path in (out / f"{name}.json" for name in _TABLES):
            if path.exists():
                about = files.read_json(path).get("about")
                named = about if isinstance(about, dict) else {}
                held = {key: value for key, value in named.items() if key in settings}
                jobs.check_same(held, settings, out, "results")
        facts = {"benchmark": version.BENCHMARK} | provenance() | settings
        facts["workers"] = Workers.of(workers).here or "a Ray cluster"
        ways = {name: shipped_ways()[found] for name, found in policies.items() if found in shipped_ways()}
        facts |= {"trained_by": ways} if ways else {}
        jobs.RunFolder(out).claim({key: facts[key] for key in ("benchmark", "version", "commit", *settings)})
        return cls(out, workers, facts)

    @property
    def ways(self) -> Mapping[str, str]:
        """The whole ways of the training of shipped policies, by "TASK/NAME"."""
        return self.facts.get("trained_by", {})

    def measure(self, groups: Sequence[Group], episodes: int, seed: int = 0, record: bool = False) -> list[Result]:
        """Runs groups in parallel processes, with progress bars. What an interrupted run finished is not run again.

        Optima that the package does not have are computed.

        Args:
            groups: what to run.
            episodes: of each group, from the first; of a group with starts all are run.
            seed: of whatever is drawn: episode i draws the same in every group.
            record: whether to write what the controllers do, for `ballbot submit`.
        """
        # the optima go along, because workers on other machines do not have this user's cache
        known = {
            (task, robot, varied): replace(
                optima.known(task, robot, range(episodes), self.workers, varied),
                trajectories=(),
                statuses=np.zeros(0, str),
            )
            for task, robot, varied in dict.fromkeys(group.problem for group in groups if group.starts is None)
        }
        work = [list(_jobs_of(group, episodes, seed, known, record)) for group in groups]
        done, results = iter(jobs.run([job for some in work for job in some], self.out, self.workers)), []
        for group, some in zip(groups, work, strict=True):
            entries = [entry for _ in some for entry in next(done)]
            if record:
                motions = [Recording.read("a job", base64.b64decode(entry.pop("motion"))) for entry in entries]
                task, params = make_task(group.task, group.robot), named_robot(group.robot)
                policy = ControllerName(group.controller).file(task, group.robot)
                who = group.physics, group.controller, "" if policy is None else policy.weights_digest()
                Recording.of_run(motions, task, group.task, params, *who).write_in(self.out)
            results += [Result(**{**entry, "labels": group.labels}) for entry in entries]
        return results

    def publish(
        self,
        name: str,
        title: str,
        shown: Mapping[str, Callable[[Any], str]],
        rows: Sequence[Row],
        results: Sequence[Result],
        lines: Sequence[Any] | None = None,
        **more: Any,
    ) -> None:
        """Ends a run: writes its results, and its table as NAME.md, which it prints too.

        The table calls shipped policies by the whole way of their training.

        Args:
            name: of the files.
            title: of the table.
            shown: what the table shows of each line, by header.
            rows: see `write_results`, as the results of all episodes and more.
            results: of every episode.
            lines: of the table; default, the rows.
            more: what else the files hold.
        """
        write_results(rows, results, self.facts, self.out, name, **more)
        header, table = list(shown), table_cells(shown, rows if lines is None else lines, self.ways)
        files.write(self.out / f"{name}.md", markdown(header, table))
        jobs.RunFolder(self.out).release()
        print_table(title, header, table)


def _without_optima(states: np.ndarray) -> certified.EvaluationSet:
    """Episodes from these states (n, state size), of a task without constants, whose optima are not known."""
    n = len(states)
    unknown = dict.fromkeys(("costs", "durations", "violations", "ideal"), np.full(n, np.nan))
    none, words = np.zeros((n, 0)), np.zeros(0, str)
    return certified.EvaluationSet(states, constants=none, drawn=none, statuses=words, trajectories=(), **unknown)


def _jobs_of(
    group: Group, episodes: int, seed: int, known: Mapping[Any, certified.EvaluationSet], record: bool
) -> Iterator[jobs.Job]:
    """The jobs of a group, of `CHUNK` episodes each."""
    chosen = known[group.problem] if group.starts is None else _without_optima(group.starts)
    # workers need not have a policy's file, so what it holds goes along
    name = ControllerName(group.controller)
    sent = name.make(*group.believed) if name.is_file else group.controller
    words = "-".join(map(str, (group.task, group.controller, group.physics, *group.labels.values())))
    count = episodes if group.starts is None else len(group.starts)
    group = replace(group, starts=None)  # they are in the set
    for start in range(0, count, CHUNK):
        yield jobs.Job(
            name=f"{words}-{start:03d}",
            function=_episode_entries,
            arguments=(group, sent, seed, chosen, record),
            items=tuple(range(start, min(start + CHUNK, count))),
            group=group.counts_for or group.task,
        )


def _episode_entries(
    group: Group,
    sent: str | Controller,
    seed: int,
    known: certified.EvaluationSet,
    record: bool,
    episodes: Sequence[int],
) -> Iterator[jobs.Entry]:
    robot, varied = floor(group.robot, group.friction), group.randomization
    made = as_controller(sent, *group.believed)
    env = _showing(BallbotEnv(group.task, group.physics, randomization=varied, robot=robot, **group.fields), made)
    motions: list[Recording] | None = [] if record else None
    results = run_episodes(env, made, group.controller, group.task, episodes, seed, known, motions)
    env.close()
    for i, result in enumerate(results):
        moved = {} if motions is None else {"motion": base64.b64encode(motions[i].to_bytes()).decode()}
        yield asdict(result) | moved


def _showing(env: BallbotEnv, controller: Controller) -> BallbotEnv:
    """The env, if it shows what the controller takes. If that is the readings of sensors, and the env shows states, it is
    closed, and another like it that shows the sensors is returned.
    """
    if env.observation == "sensors" or not _senses(controller):
        return env
    env.close()
    world: Any = {"params": env.params, "randomization": env.randomization}
    return BallbotEnv(env.task, env.physics, observation="sensors", **world)


def checked_episodes(episodes: int) -> int:
    """A number of certified episodes; raises a ValueError if there are fewer."""
    if isinstance(episodes, bool) or not isinstance(episodes, numbers.Integral):
        raise TypeError(f"episodes must be a number of episodes, not {episodes!r}")
    if not 1 <= episodes <= certified.EPISODES:
        raise ValueError(f"episodes must be 1 to {certified.EPISODES}, not {episodes}")
    return int(episodes)


def run_episodes(
    env: BallbotEnv,
    controller: Controller,
    name: str,
    task: str,
    episodes: Iterable[int],
    seed: int = 0,
    known: certified.EvaluationSet | None = None,
    motions: list[Recording] | None = None,
    advance: Callable[[int], None] = lambda count: None,
) -> list[Result]:
    """Runs certified episodes under any controller; one that finds no plan has failed the episode. torch computes on one
    thread meanwhile.

    Args:
        env: what to run in.
        controller: what acts.
        name: of the controller, in the results.
        task: the task's name, in the results.
        episodes: their indices.
        seed: of what the env's randomization draws; no two seeds share what an episode draws.
        known: the optima; default, those of the env's task, robot and randomization.
        motions: gets what was done in each episode.
        advance: is called with 1 after each episode.

    Raises:
        PlanError: an episode has no optimum that can be found.
    """
    indices, results = list(episodes), []
    if known is None:
        known = optima.known(env.task, env.params, indices, randomization=env.randomization)
    for i in indices:
        run = None
        try:
            with _one_thread():
                run = rollout(env, controller, seed=seeding.of_episode(seed, i), options=known.options(i))
        except PlanError as error:
            measures: dict[str, Any] = {"cost": env.task.survival_pay, "note": str(error)}
            measures |= {"success": False, "failure": True, "violated": "no plan"}
        else:
            measures = {
                "cost": run.cost,
                "success": run.success,
                "failure": run.failure,
                "peak_tilt": math.degrees(run.peak_tilt),
                "settle_time": run.settle_time,
                "duration": run.trajectory.duration,
                "plan_seconds": run.reset_seconds,
                "step_seconds": run.act_seconds,
                "goal_error": run.goal_error,
                "violated": run.violated,
                "effort": float(np.hypot.reduce(run.trajectory.u, axis=1).mean()),
            }
        if motions is not None:
            motions.append(Recording.of_episode(None if run is None else run.trajectory, env.params))
        results.append(Result(task, name, i, env.physics, optimum=float(known.costs[i]), **measures))
        advance(1)
    return results


@contextmanager
def _one_thread() -> Iterator[None]:
    """torch, if it is imported, computes on one thread within the block: policies are too small for a second one, and threads
    that wait for each other at every control step make an episode ten times slower.
    """
    torch: Any = sys.modules.get("torch")
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
