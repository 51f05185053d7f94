"""`ballbot demos`: demonstrations of an expert as a Minari dataset."""

import shlex
from pathlib import Path

import numpy as np

from ballbot_baselines.optimum import Backoff
from ballbot_baselines.trajopt import EXECUTED
from ballbot_gym.robots import PAPER, file_name
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import WorkersOption
from ballbot_train.console import Physics, RobotName, check_names, console, physics_or_default, progress_bar
from ballbot_train.executors import Workers
from ballbot_train.learning.demonstrations import DemoConfig, write_demos, write_shards


def demos(
    task: str = "stabilize",
    expert: str = "trajopt",
    episodes: int = 200,
    physics: Physics | None = None,
    noise: float = 0.05,
    pushes: float = 0.5,
    backoff: Backoff = EXECUTED,
    seed: int = 0,
    shards: str | None = None,
    out: Path | None = None,
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
) -> None:
    """Records episodes of an expert with exploration as a Minari dataset; a killed run continues when started again.

    Args:
        task: name of a task.
        expert: name of a controller, such as trajopt (a plan, tracked by TVLQR), nmpc or lqr, or of a policy that comes with
            the package.
        episodes: number of episodes, each with a seed of its own.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        noise: each episode draws the standard deviation of its noise from [0, this], in units of the force limit.
        pushes: mean number per second of control steps in which a random force replaces the expert's.
        backoff: what the expert's plans keep from their limits: margins in their units, shares of the goal's tolerance
            and of the force. Experts that take no back-off ignore it.
        seed: seed of the dataset.
        shards: URL or folder for a set of shards in place of a Minari dataset, for more episodes than fit into memory; see
            `ballbot_train.shards`.
        out: folder of the dataset, named NAME-vNUMBER; default runs/demos/TASK-EXPERT-v0.
        workers: who does the work.
        robot: the robot that is shown.
    """
    check_names("task", [task], TASKS)
    physics = physics_or_default(physics, robot)
    config = DemoConfig(task, expert, episodes, physics, noise, pushes, backoff, seed, robot)
    kind = file_name(task, robot)
    named = out
    out = Path("runs") / "demos" / f"{kind}-{expert}-v0" if out is None else out
    with progress_bar() as progress:
        bar = progress.add_task(f"{task} {expert}", total=episodes)
        if shards is not None:
            unfinished = Path("runs") / "demos" / f".{kind}-{expert}.shards" if named is None else named
            made = write_shards(config, shards, unfinished, workers, lambda count: progress.advance(bar, count))
            console.print(f"{made.url}: {made.episodes} episodes in {len(made.numbers)} shards", markup=False)
            return
        folder = write_demos(config, out, workers, lambda count: progress.advance(bar, count))
    import minari

    dataset = minari.MinariDataset(folder / "data")
    facts = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    success = np.mean([fact["success"] for fact in facts])
    load = f"import minari; minari.load_dataset({folder.name!r})"
    console.print(
        f"{len(facts)} episodes, {dataset.total_steps} steps, {100 * success:.1f} % successful in spite of noise and "
        f"pushes\nMINARI_DATASETS_PATH={shlex.quote(str(folder.parent))} python -c {shlex.quote(load)}",
        markup=False,
        soft_wrap=True,
    )
