"""`ballbot transfer`: controllers made for one robot, run on another, in one physics engine or in several."""

from pathlib import Path

from ballbot_gym import files
from ballbot_gym.robots import PAPER, ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_train import jobs
from ballbot_train.commands.options import WorkersOption
from ballbot_train.console import (
    Physics,
    RobotName,
    check_least,
    check_some,
    console,
    markdown,
    physics_or_default,
    print_table,
    progress_bars,
)
from ballbot_train.evaluation import optima
from ballbot_train.evaluation import transfer as matrix
from ballbot_train.evaluation.benchmark import checked_episodes, policy_digests
from ballbot_train.evaluation.results import rows_of
from ballbot_train.executors import Workers
from ballbot_train.provenance import provenance
from ballbot_train.report import figures


def transfer(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    made_for: tuple[RobotName, ...] = (PAPER, "rolling"),
    robot: RobotName = "rolling",
    frictions: tuple[float, ...] = (),
    episodes: int = 20,
    quick: bool = False,
    physics: tuple[Physics, ...] = (),
    seed: int = 0,
    out: Path = Path("runs/transfer"),
    workers: WorkersOption = Workers(),
) -> None:
    """Runs controllers that were made for one robot on another: success, falls and cost over that robot's optimum.

    Args:
        tasks: names of tasks.
        controllers: names of experts and policies; default all that the robots have.
        made_for: names of the robots that they were made for: what they plan for, and what policies learnt on.
        robot: what they run on, with its certified episodes.
        frictions: coefficients of friction of the floor, for a robot whose ball rolls; default, the robot's own.
        episodes: how many of each task's certified episodes.
        quick: only 3 episodes of each task.
        physics: "bullet", "mujoco" or "rk4", with contact where the ball rolls except in the last; default, the first that is
            installed. With several, each row is of one.
        seed: of the bootstrap intervals.
        out: folder of the results; an interrupted run continues here.
        workers: who does the work.
    """
    check_some("robot", made_for, ROBOTS)
    check_least(0, seed=seed)
    floors = frictions or (None,)
    for friction in floors:
        matrix.floor(robot, friction)
    chosen = matrix.controllers_of(tasks, controllers, made_for)
    if len(set(physics)) < len(physics):
        raise ValueError(f"a physics is given more than once: {' '.join(physics)}")
    engines = [physics_or_default(one) for one in physics or (None,)]
    episodes = checked_episodes(episodes, quick, few=3)
    settings = {
        "controllers": chosen,
        "policies": {name: policy_digests(group, name) for name, group in chosen.items()},
        "robot": robot,
        "frictions": frictions,
        "episodes": episodes,
        "physics": engines,
        "seed": seed,
    }
    facts = provenance() | settings | {"workers": Workers.of(workers).named}
    jobs.claim(out, {key: facts[key] for key in ("version", "commit", *settings)})
    for task in tasks:
        optima.known(task, robot, range(episodes), workers)
    totals = dict.fromkeys(tasks, 0)
    for group in chosen.values():
        for task, names in group.items():
            totals[task] += len(names) * len(floors) * len(engines) * matrix.episodes_of(task, robot, episodes)
    with progress_bars(totals) as bars:
        results = matrix.run(chosen, robot, floors, episodes, engines, out, workers, bars.advance, seed)
    rows = rows_of(results, matrix.TransferRow, "made_for", "robot", "friction", "physics", seed=seed)
    matrix.write(rows, results, facts, out)
    table = [matrix.cells(row) for row in rows]
    files.write(out / "transfer.md", markdown(matrix.HEADER, table))
    figures.save(figures.transfer_figure(rows), out / "transfer.png")
    print_table(f"{episodes} certified episodes of {robot} per task", matrix.HEADER, table)
    console.print(f"matrix: {out / 'transfer.png'}, {out / 'transfer.csv'}")
    jobs.release(out)
