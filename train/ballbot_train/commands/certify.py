"""`ballbot certify`: the certified evaluation sets anew."""

import os
from multiprocessing import get_context
from pathlib import Path

from ballbot_baselines import certification
from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_train.console import progress_bar
from ballbot_train.evaluation import evaluate


def certify(
    tasks: tuple[str, ...] = tuple(TASKS),
    episodes: int = certified.EPISODES,
    out: Path | None = None,
    workers: int = os.cpu_count() or 1,
) -> None:
    """Computes the certified evaluation sets: the optimum of every episode.

    Args:
        tasks: names of tasks.
        episodes: how many, from the first.
        out: folder of the .npz files; default, in the package.
        workers: processes.
    """
    evaluate.check_names("task", list(tasks), TASKS)
    failed = []
    with progress_bar() as progress, get_context("spawn").Pool(workers) as pool:
        for name in tasks:
            bar = progress.add_task(name, total=episodes)
            entries = []
            for index, result in enumerate(pool.imap(_certify_one, [(name, i) for i in range(episodes)], chunksize=5)):
                progress.advance(bar)
                if "error" in result:
                    failed.append(f"{name} episode {index}: {result['error']}")
                else:
                    entries.append(result)
            if len(entries) == episodes:
                task = make_task(name)
                path = certified.path_of(task) if out is None else out / certified.path_of(task).name
                certification.evaluation_set(task, default_params(), entries).save(task, path)
                progress.console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    if failed:
        raise PlanError("no optimum for\n" + "\n".join(failed))


def _certify_one(job: tuple[str, int]) -> certification.Entry:
    return next(certification.entries(job[0], [job[1]]))
