"""`ballbot transfer`: controllers made for one robot, run on another, in one physics engine or in several."""

from pathlib import Path

from ballbot_gym.robots import PAPER, ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import WorkersOption
from ballbot_train.console import Physics, RobotName, check_some, console, physics_or_default
from ballbot_train.evaluation import transfer as matrix
from ballbot_train.evaluation.benchmark import controllers_by_robot, open_run, policy_digests, publish, run_groups
from ballbot_train.evaluation.evaluate import checked_episodes
from ballbot_train.evaluation.results import leaderboard, write_results
from ballbot_train.executors import Workers


def transfer(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    made_for: tuple[RobotName, ...] = (PAPER, "rolling"),
    robot: RobotName = "rolling",
    frictions: tuple[float, ...] = (),
    episodes: int = 20,
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
        physics: "bullet", "mujoco" or "rk4", with contact where the ball rolls except in the last; default, the first that is
            installed.
        seed: of the bootstrap intervals.
        out: folder of the results; an interrupted run continues here.
        workers: who does the work.
    """
    check_some("robot", made_for, ROBOTS)
    floors = frictions or (None,)
    for friction in floors:
        matrix.floor(robot, friction)
    chosen = controllers_by_robot(tasks, controllers, made_for)
    if len(set(physics)) < len(physics):
        raise ValueError(f"a physics is given more than once: {' '.join(physics)}")
    engines, episodes = [physics_or_default(one, robot) for one in physics or (None,)], checked_episodes(episodes)
    digests = {f"{name}/{key}": d for name, group in chosen.items() for key, d in policy_digests(group, name).items()}
    settings = {"controllers": chosen, "frictions": frictions, "physics": engines, "episodes": episodes, "seed": seed}
    facts = open_run(out, workers, digests, robot, **settings)
    groups = matrix.groups_of(chosen, robot, floors, engines)
    results = run_groups(groups, episodes, out, workers, seed)
    rows = leaderboard(results, "made_for", "robot", "friction", "physics", seed=seed)
    write_results("transfer", rows, results, facts, out, matrix.COLUMNS, regret=matrix.REGRET)
    publish(out, "transfer", f"{episodes} certified episodes of {robot} per task", matrix.TABLE, rows)
    console.print(f"matrix: {out / 'transfer.csv'}")
