"""Every controller of every task on the certified episodes, in parallel processes and resumably."""

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_baselines import VARIANTS
from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import PAPER, named_robot, robot_setting
from ballbot_gym.tasks import TASKS
from ballbot_train import jobs
from ballbot_train.console import check_least, check_names, check_some
from ballbot_train.evaluation import controllers as registry
from ballbot_train.evaluation import optima, recordings
from ballbot_train.evaluation.evaluate import iterate_episodes
from ballbot_train.evaluation.results import Result
from ballbot_train.executors import Workers
from ballbot_train.policy_files import paths_of
from ballbot_train.provenance import provenance

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
    check_some("task", tasks, TASKS)
    known = {task: registry.names(make_task(task, robot), robot, None if tracks or names else "") for task in tasks}
    if not names:
        return known
    known = {task: [*group, *VARIANTS] for task, group in known.items()}
    # two spellings of one path are one policy
    identities = [_identity(name) for name in names]
    repeated = [name for i, name in enumerate(names) if identities[i] in identities[:i]]
    if repeated:
        raise ValueError(f"controller {', '.join(repeated)} is given more than once; give each once")
    from_files = {name: registry.made_for(name) for name in names if registry.is_file(name)}
    chosen = {
        task: [
            name
            for name in names
            if (
                registry.is_made_for(name, make_task(task, robot), robot) if name in from_files else name in known[task]
            )
        ]
        for task in tasks
    }
    unused = [name for name in names if not any(name in group for group in chosen.values())]
    if unused:
        if unused[0] in from_files:
            raise ValueError(f"{unused[0]} was made for {from_files[unused[0]]}, which is none of {', '.join(tasks)}")
        check_names("controller", unused, dict.fromkeys(name for group in known.values() for name in group))
    return {task: group for task, group in chosen.items() if group}


def _identity(name: str) -> str:
    """The path of a policy's file, whichever of its files is named; of anything else the name."""
    if not registry.is_file(name):
        return name
    return str((Path(name) if registry.is_saved_model(name) else paths_of(name)[1]).resolve())


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
    controllers: Mapping[str, Sequence[str]],
    workers: int | Workers,
    physics: str,
    seed: int | None = None,
    robot: str = PAPER,
    **settings: Any,
) -> dict[str, Any]:
    """Claims a folder for a run of controllers by task with some settings; `jobs.release` ends the run.

    The optima of the episodes of a run with `episodes` are computed, where the package has none.

    Args:
        out: the folder.
        controllers: names by task.
        workers: a number of processes, or `Workers`; they change no result.
        physics: "bullet", "mujoco" or "rk4".
        seed: of whatever is drawn, if anything is.
        robot: by name.
        settings: whatever else decides the results.

    Returns:
        The facts that the results name.

    Raises:
        ValueError: the folder holds an unfinished run with other settings, policies or code; another process is using it;
            or a number is out of its range.
    """
    settings["physics"] = physics
    if seed is not None:
        check_least(0, seed=seed)
        settings["seed"] = seed
    settings |= robot_setting(robot)
    settings["policies"] = policy_digests(controllers, robot)
    facts = provenance() | settings | {"workers": Workers.of(workers).named}
    jobs.claim(out, {key: facts[key] for key in ("version", "commit", *settings)})
    for task in controllers if "episodes" in settings else ():
        optima.known(task, robot, range(settings["episodes"]), workers)
    return facts


def checked_episodes(episodes: int, quick: bool, few: int) -> int:
    """How many certified episodes to run: `few` at most if quick.

    Raises:
        ValueError: there are not so many.
    """
    if not 1 <= episodes <= certified.EPISODES:
        raise ValueError(f"episodes must be 1 to {certified.EPISODES}, not {episodes}")
    return min(episodes, few) if quick else episodes


def benchmark(
    controllers: Mapping[str, Sequence[str]],
    episodes: int,
    physics: str,
    out: Path,
    workers: int | Workers,
    on_progress: Callable[[str, int], None],
    seed: int = 0,
    robot: str = PAPER,
) -> list[Result]:
    """Runs the controllers of every task, in parallel processes, and records what they do for `ballbot submit`.

    What an interrupted run finished is not run again.

    Args:
        controllers: names by task, as `controllers_of` gives.
        episodes: how many of each task's certified ones.
        physics: "bullet", "mujoco" or "rk4".
        out: folder of the results.
        workers: a number of processes, or `Workers`.
        on_progress: called with a task and a number of finished episodes.
        seed: of whatever is drawn.
        robot: by name.
    """
    work = [
        episode_job(task, name, physics, range(start, min(start + CHUNK, episodes)), seed, robot=robot, record=True)
        for task, group in controllers.items()
        for name in group
        for start in range(0, episodes, CHUNK)
    ]
    entries = [entry for done in jobs.run(work, out, workers, on_progress) for entry in done]
    motions = [recordings.from_text(entry.pop("motion")) for entry in entries]
    results = [Result(**entry) for entry in entries]
    for task, group in controllers.items():
        for name in group:
            digest = registry.policy_digest(name, make_task(task, robot), robot)
            about = recordings.about(make_task(task, robot), task, named_robot(robot), physics, name, digest)
            done = [m for r, m in zip(results, motions, strict=True) if (r.task, r.controller) == (task, name)]
            recordings.write_in(out, about, done)
    return results


def episode_job(
    task: str,
    controller: str,
    physics: str,
    episodes: range,
    seed: int,
    randomization: Randomization | None = None,
    label: str = "",
    group: str = "",
    robot: str = PAPER,
    made_for: str | None = None,
    variant: BallbotParams | None = None,
    record: bool = False,
    own_optima: bool = False,
) -> jobs.Job:
    """Some certified episodes of a robot under a controller by name, as a job whose entries are the fields of Results.

    The controller is made for the robot, or for another one by name. A variant of the robot may run in its place; regret is
    over the robot's own optimum then too, or with own_optima over that of each episode's robot. The label tells jobs apart
    that differ in their randomization or robots; progress counts for the group, or else the task. With record each entry also
    has the "motion" as `recordings.to_text` gives it.
    """
    what, packed = f"{task}-{controller}-{physics}-{label}", registry.packed(controller)
    # the optima go along, because workers on other machines do not have this user's cache
    varied = (own_optima and randomization) or Randomization()
    known = certified.load(task, robot, episodes=episodes, randomization=varied)
    known = replace(known, trajectories=(), statuses=np.zeros(0, str))
    slug = "".join(sign if sign.isalnum() else "-" for sign in what)
    return jobs.Job(
        name=f"{slug[-80:]}{zlib.crc32(what.encode()):08x}-{episodes.start:03d}-{episodes.stop:03d}",
        function=_episode_entries,
        arguments=(task, controller, packed, physics, seed, randomization, robot, made_for, variant, known, record),
        items=tuple(episodes),
        group=group or task,
    )


def _episode_entries(
    task: str,
    controller: str,
    packed: Mapping[str, bytes],
    physics: str,
    seed: int,
    randomization: Randomization | None,
    robot: str,
    made_for: str | None,
    variant: BallbotParams | None,
    known: certified.EvaluationSet,
    record: bool,
    episodes: Sequence[int],
) -> Iterator[jobs.Entry]:
    env = BallbotEnv(task, physics=physics, randomization=randomization, robot=variant or robot)
    believed = (env.task, env.params) if made_for is None else (make_task(task, made_for), named_robot(made_for))
    made = registry.make_packed(controller, packed, *believed)
    motions: list[recordings.Motion] = []
    for result in iterate_episodes(
        env, made, controller, task, episodes, seed, known, motions.append if record else None
    ):
        yield asdict(result) | ({"motion": recordings.to_text(motions.pop())} if record else {})
    env.close()
