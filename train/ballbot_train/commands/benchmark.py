"""`ballbot benchmark`: controllers by their regret on the certified episodes."""

from pathlib import Path
from typing import Any

from ballbot_gym import certified, files
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Ballbot, Randomization, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import Filter, WorkersOption
from ballbot_train.evaluation import robustness
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.evaluation.results import TABLE, leaderboard, table_cells
from ballbot_train.evaluation.runner import Group, MeasuredRun, checked_episodes
from ballbot_train.report import figures
from ballbot_train.report.page import report_page
from ballbot_train.report.replay import Take, certified_replay, telling_episode
from ballbot_train.work.console import Physics, RobotName, console, physics_or_default
from ballbot_train.work.executors import Workers


def benchmark(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    episodes: int = certified.EPISODES,
    physics: Physics | None = None,
    seed: int = 0,
    out: Path = Path("runs/benchmark"),
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    randomization: tuple[str, ...] = (),
    filter: Filter | None = None,
) -> None:
    """Compares controllers by their regret on the certified episodes, and writes a leaderboard with figures.

    Args:
        tasks: names of tasks.
        controllers: names of experts and policies, or files of policies; default, all experts and all policies that come
            with the package. A policy runs only on the task that it was trained for.
        episodes: number of certified episodes of each task, from the first.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        seed: seed of the bootstrap intervals, and of noise and pushes in the episodes.
        out: folder of the results; an interrupted run continues here.
        workers: where the work is done; with one process, other processes disturb the measured times least.
        robot: name of the robot, with its episodes and controllers; default, the robot that each task names.
        randomization: names of tracks, "unknown", "late", "noisy" or "real". Their robots, delays and sensor errors are
            hidden from the controllers. The result is then one table of controllers by tracks, with the parts of their
            regret, and the default controllers are the experts for each track.
        filter: filter in front of every controller: it estimates the robot, the delay, or the state from sensors.
    """
    made_for = controllers_of(tasks, controllers, [robot], filter, tracks=bool(randomization))
    chosen = made_for[robot]
    robots = {task: own_robot(task, robot) for task in tasks}
    physics = physics_or_default(physics, robots[tasks[0]])
    episodes = checked_episodes(episodes)
    settings: dict[str, Any] = {"physics": physics, "episodes": episodes, "seed": seed}
    if randomization:
        for track in randomization:
            Randomization.checked(track)
        settings["tracks"] = list(randomization)
    run = MeasuredRun.open(out, workers, made_for, robot, **settings)
    if randomization:
        experts = {} if controllers else robustness.EXPERTS
        groups = robustness.groups_of(chosen, randomization, physics, robot, experts)
        results = run.measure(groups, episodes, seed)
        rows = robustness.track_rows(results, robot, seed)
        title = f"{episodes} certified episodes per task and track, physics={physics}"
        run.publish("tracks", title, robustness.TRACK_TABLE, rows, results)
        return
    groups = [Group(task, name, physics, robots[task]) for task, names in chosen.items() for name in names]
    done = run.measure(groups, episodes, seed, record=True)
    rows = leaderboard(done, seed)
    regrets = figures.save(figures.regret_figure(done, run.ways), out / "figures" / "regret.png")
    replays, pictures = [], []
    for task, names in chosen.items():
        episode = telling_episode(task, done)
        replays.append(certified_replay(task, names, episode, physics, skip_planless=True, robot=robots[task]))
        kept = certified.load(task, robots[task], episodes=range(episode + 1)).trajectories  # of the first episodes
        optimum = [Take("optimum", each, "0.35", style="--") for each in kept[episode : episode + 1]]
        takes = [*optimum, *replays[-1].takes]
        figure = figures.trajectory_figure(replays[-1].title, takes, replays[-1].markers, named_robot(robots[task]))
        pictures.append(figures.save(figure, out / "figures" / f"{task}.png"))
    title = "ballbot-gym: leaderboard" if robot == PAPER else f"ballbot-gym: leaderboard of the robot {robot}"
    shown = {"How close to the optimum": [regrets], "One certified episode of each task": pictures}
    drawn = [each for each, name in zip(replays, chosen, strict=True) if isinstance(named_robot(robots[name]), Ballbot)]
    report = report_page(title, drawn, [*TABLE], table_cells(TABLE, rows, run.ways), shown, run.facts)
    page = files.write(out / "report.html", report)
    title = f"{episodes} certified episodes per task, physics={physics}"
    run.publish("leaderboard", title, TABLE, rows, done)
    for result in done:
        if result.note:
            console.print(f"no plan: {result.task} episode {result.episode}: {result.note}")
    console.print(f"report: {page}")
