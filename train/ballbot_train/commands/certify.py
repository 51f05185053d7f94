"""`ballbot certify`: recomputes the certified evaluation sets."""

from functools import partial
from pathlib import Path

import numpy as np

from ballbot_baselines.optimum import certification
from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Randomization, named_robot, robot_setting
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import WorkersOption
from ballbot_train.evaluation import optima
from ballbot_train.work import jobs
from ballbot_train.work.console import RobotName, check_least, check_names, console
from ballbot_train.work.executors import Workers
from ballbot_train.work.provenance import provenance

_MOST_EPISODES = 100_000


def certify(
    tasks: tuple[str, ...] = tuple(TASKS),
    episodes: int = certified.EPISODES,
    shards: str | None = None,
    out: Path = Path("runs/certify"),
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    randomization: str | None = None,
    trajectories: int | None = None,
) -> None:
    """Computes the certified evaluation sets: the optimum of every episode.

    Every optimum is stored in the user's cache folder as soon as it is found. Evaluations read from there the optima that
    do not come with the package.

    Args:
        tasks: names of tasks.
        episodes: number of episodes, from the first.
        shards: URL or folder for a set of shards, SHARDS/TASK, instead of the .npz files; for more episodes than fit into
            memory. See `ballbot_train.work.shards`.
        out: folder of the .npz files.
        workers: where the work is done.
        robot: name of the robot; default, the robot that each task names.
        randomization: name of the track that draws the robot and the delay of each episode; default, none.
        trajectories: optimal motions in each .npz file, those of the first episodes; default, 20, or 5 of tracks and of
            robots with wheels.
    """
    check_names("task", tasks, TASKS, least=1)
    check_least(1, episodes=episodes, **({} if trajectories is None else {"trajectories": trajectories}))
    if shards is None and episodes > _MOST_EPISODES:
        raise ValueError(f"episodes must be at most {_MOST_EPISODES}, not {episodes}; or give --shards")
    varied = Randomization.checked(randomization)
    if randomization and not varied.moves_optima:
        raise ValueError(
            f"{randomization} changes no optimum, so its episodes have the usual optima; leave out --randomization"
        )
    if shards is not None:
        _certify_shards(tasks, episodes, shards, out, workers, robot)
        return
    jobs.RunFolder(out).make()
    failures = []
    for name in tasks:
        of = own_robot(name, robot)
        task, params = make_task(name, of), named_robot(of)
        try:
            optima.compute(task, params, range(episodes), workers, varied)
        except PlanError as error:
            failures.append(str(error))
            continue
        found = certified.from_cache(task, params, range(episodes), varied)
        assert found is not None
        name = certified.path_of(task, of, randomization or "").name
        path = found.first(episodes).save(task, out / name, of, varied, trajectories)
        console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    if failures:
        raise PlanError("\n".join(failures))


def _certify_shards(tasks: tuple[str, ...], episodes: int, url: str, out: Path, workers: Workers, robot: str) -> None:
    from ballbot_train.work.shards import Shards

    for name in tasks:
        of = own_robot(name, robot)
        about = {
            "certified": make_task(name, of).problem(),
            "version": provenance()["version"],
            "problem": certified.named_problem(name, of),
            **robot_setting(of),
        }
        set_url, function = f"{url.rstrip('/')}/{name}", partial(_optima, name, of)
        made = Shards.make(set_url, about, episodes, function, out / name, workers, name)
        console.print(f"{made.url}: {made.episodes} episodes in {len(made.numbers)} shards")


def _optima(task: str, robot: str, episodes: range) -> dict[str, np.ndarray]:
    found = dict(certification.entries(task, episodes, robot))
    return certification.arrays(found, make_task(task, robot), named_robot(robot))
