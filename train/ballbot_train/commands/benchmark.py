"""`ballbot benchmark`: controllers by their regret on the certified episodes."""

from collections.abc import Sequence
from pathlib import Path

from ballbot_gym import certified, files
from ballbot_gym.robots import PAPER
from ballbot_gym.tasks import TASKS
from ballbot_train import jobs
from ballbot_train.commands.options import WorkersOption
from ballbot_train.console import Physics, RobotName, console, markdown, physics_or_default, print_table, progress_bars
from ballbot_train.evaluation import robustness, tracks
from ballbot_train.evaluation.benchmark import benchmark as run_benchmark
from ballbot_train.evaluation.benchmark import checked_episodes, controllers_of, open_run
from ballbot_train.evaluation.results import HEADER, cells, leaderboard, write_leaderboard, write_results
from ballbot_train.executors import Workers
from ballbot_train.report import figures
from ballbot_train.report.page import write_report
from ballbot_train.report.replay import certified_replay
from ballbot_train.report.sections import leaderboard_sections


def benchmark(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = (),
    episodes: int = certified.EPISODES,
    quick: bool = False,
    physics: Physics | None = None,
    seed: int = 0,
    out: Path = Path("runs/benchmark"),
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    randomization: tuple[str, ...] = (),
) -> None:
    """Compares controllers by their regret on the certified episodes, and writes a leaderboard with figures.

    Args:
        tasks: names of tasks.
        controllers: names of experts and policies, or files of policies; default all experts and all policies that come
            with the package. A policy is run on the task it was made for.
        episodes: how many of each task's certified episodes.
        quick: only 8 episodes of each task.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        seed: of the bootstrap intervals, and of whatever an episode draws.
        out: folder of the results; an interrupted run continues here.
        workers: where the work is done; one process gives the cleanest times per control step.
        robot: whose episodes and controllers.
        randomization: names of tracks, "unknown", "late", "noisy" or "real": robots, delays and sensors that nobody told the
            controllers. Then the result is one table of controllers by tracks, with the parts of their regret; by default
            with the experts that are made for each track.
    """
    if randomization:
        _benchmark_tracks(tasks, controllers, episodes, quick, physics, seed, out, workers, robot, randomization)
        return
    chosen = controllers_of(tasks, controllers, robot)
    physics = physics_or_default(physics)
    episodes = checked_episodes(episodes, quick, few=8)
    facts = open_run(out, chosen, workers, physics, seed, robot, episodes=episodes)
    with progress_bars({task: episodes * len(group) for task, group in chosen.items()}) as bars:
        done = run_benchmark(chosen, episodes, physics, out, workers, bars.advance, seed, robot)
    rows = leaderboard(done, seed)
    write_leaderboard(rows, done, facts, out)
    regrets = figures.save(figures.regret_figure(done), out / "figures" / "regret.png")
    pictures = [_episode_figure(task, group, physics, out, robot) for task, group in chosen.items()]
    table = [cells(row) for row in rows]
    files.write(out / "leaderboard.md", markdown(HEADER, table))
    sections = leaderboard_sections(HEADER, table, done, chosen, regrets, pictures, physics, robot)
    title = "ballbot-gym: leaderboard" if robot == PAPER else f"ballbot-gym: leaderboard of the robot {robot}"
    page = write_report(title, sections, facts, out / "report.html")
    jobs.release(out)
    print_table(f"{episodes} certified episodes per task, physics={physics}", HEADER, table)
    for result in done:
        if result.note:
            console.print(f"no plan: {result.task} episode {result.episode}: {result.note}")
    console.print(f"report: {page}")


def _benchmark_tracks(
    tasks: Sequence[str],
    controllers: Sequence[str],
    episodes: int,
    quick: bool,
    physics: Physics | None,
    seed: int,
    out: Path,
    workers: Workers,
    robot: str,
    names: Sequence[str],
) -> None:
    wanted, chosen = tracks.conditions(names), controllers_of(tasks, controllers, robot, tracks=True)
    if not controllers:
        chosen, wanted = tracks.with_experts(chosen, wanted)
    physics, episodes = physics_or_default(physics), checked_episodes(episodes, quick, few=8)
    facts = open_run(out, chosen, workers, physics, seed, robot, episodes=episodes, tracks=list(names))
    tracks.find_optima(list(chosen), names, episodes, robot, workers)
    with progress_bars(robustness.episodes_to_run(chosen, wanted, episodes)) as bars:
        results = robustness.run(chosen, wanted, episodes, physics, out, workers, bars.advance, seed, robot)
    rows = tracks.rows_of(results, robot, seed)
    write_results("tracks", rows, results, facts, out)
    table = [tracks.cells(row) for row in rows]
    files.write(out / "tracks.md", markdown(tracks.HEADER, table))
    jobs.release(out)
    print_table(f"{episodes} certified episodes per task and track, physics={physics}", tracks.HEADER, table)


def _episode_figure(task: str, controllers: Sequence[str], physics: str, out: Path, robot: str) -> Path:
    """The first certified episode of a task under every controller, with its optimum."""
    replay = certified_replay(task, controllers, 0, physics, skip_planless=True, robot=robot)
    optimum = certified.load(task, robot, episodes=[0]).trajectories[0]
    curves = [figures.Curve("optimum", optimum, "0.35", "--")]
    curves += [figures.Curve(f"{take.label}, {take.note}", take.trajectory, take.color) for take in replay.takes]
    figure = figures.trajectory_figure(replay.title, curves, figures.marker_circles(replay.markers))
    return figures.save(figure, out / "figures" / f"{task}.png")
