"""`ballbot certify`: the certified evaluation sets anew."""

from pathlib import Path

from ballbot_baselines import certification
from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_train import jobs
from ballbot_train.commands.options import WorkersOption
from ballbot_train.console import check_least, check_some, console, progress_bars
from ballbot_train.executors import Workers
from ballbot_train.provenance import provenance

_MOST_EPISODES = 100_000
_CHUNK = 5  # episodes of a job


def certify(
    tasks: tuple[str, ...] = tuple(TASKS),
    episodes: int = certified.EPISODES,
    install: bool = False,
    out: Path = Path("runs/certify"),
    workers: WorkersOption = Workers(),
) -> None:
    """Computes the certified evaluation sets: the optimum of every episode.

    Args:
        tasks: names of tasks.
        episodes: how many, from the first.
        install: puts the finished sets into the package too, in place of those that all evaluation reads.
        out: folder of the .npz files; an interrupted run continues here.
        workers: who does the work.
    """
    check_some("task", tasks, TASKS)
    check_least(1, episodes=episodes)
    Workers.of(workers)
    if episodes > _MOST_EPISODES:
        raise ValueError(f"episodes must be at most {_MOST_EPISODES}, not {episodes}")
    if install and episodes < certified.EPISODES:
        raise ValueError(f"the package needs sets of {certified.EPISODES} episodes; give --install without --episodes")
    facts = provenance()
    jobs.claim(out, {"version": facts["version"], "commit": facts["commit"], "tasks": tasks, "episodes": episodes})
    work = [
        jobs.Job(f"{task}-{start:04d}", certification.entries, (task,), items, task)
        for task in tasks
        for start in range(0, episodes, _CHUNK)
        for items in [tuple(range(start, min(start + _CHUNK, episodes)))]
    ]
    with progress_bars(dict.fromkeys(tasks, episodes)) as bars:
        done = jobs.run(work, out, workers, bars.advance)
    failures, sets = [], {}
    for name in tasks:
        found = [entry for job, entries in zip(work, done, strict=True) if job.group == name for entry in entries]
        errors = [f"{name} episode {i}: {entry['error']}" for i, entry in enumerate(found) if "error" in entry]
        failures += errors
        if not errors:
            task = make_task(name)
            sets[name] = certification.evaluation_set(task, default_params(), found)
            path = sets[name].save(task, out / certified.path_of(task).name)
            console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    jobs.release(out)
    if failures:
        raise PlanError("no optimum for\n" + "\n".join(failures))
    if install:
        for name, evaluation_set in sets.items():
            task = make_task(name)
            console.print(f"installed: {evaluation_set.save(task, certified.path_of(task))}")
