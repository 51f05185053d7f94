"""The command line: `ballbot benchmark`, `paper`, `optimize`, `replay`, `certify`."""

import importlib.metadata
import json
import math
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from ballbot_baselines import CONTROLLERS
from ballbot_baselines import certify as certification
from ballbot_baselines.controller import rollout, simulate
from ballbot_baselines.optimum import Optimum, PlanError, find_optimum
from ballbot_baselines.paper import EFFORT_WEIGHT, PAPER_PROBLEMS, REST_WEIGHT, PaperProblem
from ballbot_baselines.transcription import Plan
from ballbot_baselines.tvlqr import TvlqrController
from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.params import default_params
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.base import Marker
from ballbot_train import evaluate, figures
from ballbot_train.report import write_report

_PAPER_CONTROL_DT = 0.01  # s, at which the paper's plans are tracked
_PAPER_LQR_DT = 0.001  # s: the paper's LQR is continuous

# A file or pipe has no width of its own: give it one that holds the widest table.
console = Console(width=None if sys.stdout.isatty() else 160)


def benchmark(
    tasks: tuple[str, ...] = tuple(TASKS),
    controllers: tuple[str, ...] = tuple(CONTROLLERS),
    episodes: int = certified.EPISODES,
    quick: bool = False,
    physics: Literal["bullet", "rk4"] = "bullet",
    out: Path = Path("runs/benchmark"),
    workers: int = os.cpu_count() or 1,
) -> None:
    """Compares controllers by their regret on the certified episodes, and writes a leaderboard with figures.

    Args:
        tasks: names of tasks.
        controllers: names of controllers.
        episodes: how many of each task's certified episodes.
        quick: only 10 episodes of each task.
        physics: "bullet" or "rk4".
        out: folder of the results; an interrupted run continues here.
        workers: processes; 1 gives the cleanest times per control step.
    """
    evaluate.check_names("task", list(tasks), TASKS)
    evaluate.check_names("controller", list(controllers), CONTROLLERS)
    if not 1 <= episodes <= certified.EPISODES:
        raise ValueError(f"episodes must be 1 to {certified.EPISODES}, not {episodes}")
    episodes = min(episodes, 10) if quick else episodes
    about = _about() | {"physics": physics, "episodes": episodes, "workers": workers}
    _claim(out, {key: about[key] for key in ("version", "commit", "physics", "episodes")})
    with _progress() as progress:
        bars = {task: progress.add_task(task, total=episodes * len(controllers)) for task in tasks}
        results = evaluate.benchmark(
            list(tasks),
            list(controllers),
            episodes,
            physics,
            out,
            workers,
            lambda task, count: progress.advance(bars[task], count),
        )
    rows = evaluate.leaderboard(results)
    evaluate.write_leaderboard(rows, results, about, out)
    pictures = [figures.save(figures.regret_figure(results), out / "figures" / "regret.png")]
    pictures += [_episode_figure(task, list(controllers), physics, out) for task in tasks]
    table = [_cells(row) for row in rows]
    files.write(out / "leaderboard.md", _markdown(_HEADER, table))
    report = write_report("ballbot-gym: leaderboard", _HEADER, table, pictures, about, out / "report.html")
    shutil.rmtree(out / "episodes", ignore_errors=True)  # only needed to resume: episodes.csv has it all
    (out / "unfinished.json").unlink(missing_ok=True)
    _print_table(f"{episodes} certified episodes per task, physics={physics}", _HEADER, table)
    for result in results:
        if result.note:
            console.print(f"no plan: {result.task} episode {result.episode}: {result.note}")
    console.print(f"report: {report}")


def paper(out: Path = Path("runs/paper"), only: tuple[str, ...] = ()) -> None:
    """Regenerates the paper's Figs 2 to 5: each optimum beside its execution in PyBullet.

    Args:
        out: folder of the figures and plans.
        only: names of some of the problems; default all.
    """
    evaluate.check_names("problem", list(only), PAPER_PROBLEMS)
    params = default_params()
    rows = []
    for name in only or PAPER_PROBLEMS:
        entry = PAPER_PROBLEMS[name]
        plan = entry.solve(params)
        plan.trajectory.save(out / f"{name}.npz")
        q = np.diag([1.0, 1.0, *[REST_WEIGHT] * 6])
        tracker = TvlqrController.for_weights(params, plan.trajectory, _PAPER_CONTROL_DT, q, EFFORT_WEIGHT * np.eye(2))
        seconds = round(plan.trajectory.duration / _PAPER_CONTROL_DT) * _PAPER_CONTROL_DT
        done = simulate(tracker, params, plan.trajectory.x[0], seconds, _PAPER_CONTROL_DT)
        planned = np.array([plan.trajectory.state(t) for t in done.t])
        error = float(np.hypot(*(done.x - planned)[:, :2].T).max())
        curves = [
            figures.Curve("plan", plan.trajectory.resampled(_PAPER_CONTROL_DT), "0.35", "--"),
            figures.Curve("PyBullet under TVLQR", done, figures.COLORS["trajopt"]),
        ]
        figure = figures.trajectory_figure(f"{entry.figure}: {entry.title}", curves, _paper_circles(entry, plan))
        figures.save(figure, out / f"{_slug(entry.figure)}-{name}.png")
        tilt = math.degrees(np.abs(plan.trajectory.x[:, 2:4]).max())
        rows.append(
            [
                entry.figure,
                name,
                f"{plan.cost:.4f}",
                f"{plan.trajectory.duration:.3f}",
                f"{tilt:.2f}",
                f"{np.abs(plan.trajectory.u).max():.0f}",
                f"{plan.collocation_error:.1e}",
                f"{100 * error:.1f}",
                plan.status,
            ]
        )
    header = [
        "figure",
        "problem",
        "J*",
        "final time, s",
        "peak lean, deg",
        "peak force, N",
        "collocation error",
        "tracked within, cm",
        "status",
    ]
    _print_table("The paper's problems: 40 intervals, Hermite–Simpson", header, rows)
    stabilizations = [name for name in only or PAPER_PROBLEMS if name.startswith("stabilize")]
    if stabilizations:
        _compare_stabilizations(stabilizations, out)
    console.print(f"figures: {out}")


def optimize(
    task: str,
    /,
    state: tuple[float, float, float, float, float, float, float, float] | None = None,
    constants: dict[str, float] = {},  # noqa: B006 (tyro's default; never changed)
    seed: int = 0,
    duration: float | None = None,
    max_tilt: float | None = None,
    force_limit: float | None = None,
    out: Path = Path("runs/optimize"),
) -> None:
    """Finds the optimum of one episode, and writes its trajectory and figure.

    Args:
        task: name of a task.
        state: x y γ θ ẋ ẏ γ̇ θ̇ at the start, in m, rad, m/s, rad/s; default drawn with the seed.
        constants: constants of the episode by name, e.g. --constants speed 3; others are drawn with the seed.
        seed: of what is drawn.
        duration: longest episode, s.
        max_tilt: degrees.
        force_limit: N.
        out: folder of trajectory.npz and figure.png.
    """
    evaluate.check_names("task", [task], TASKS)
    fields = {"duration": duration, "max_tilt": None if max_tilt is None else math.radians(max_tilt)}
    params = default_params()
    if force_limit is not None:
        if force_limit <= 0:
            raise ValueError(f"force_limit must be positive, not {force_limit} N")
        params = replace(params, force_limit=force_limit)
    env = BallbotEnv(
        make_task(task, **{key: value for key, value in fields.items() if value is not None}),
        physics="rk4",
        params=params,
    )
    options = {"constants": constants} | ({} if state is None else {"state": state})
    _, info = env.reset(seed=seed, options=options)
    optimum = find_optimum(env.task, params, info["state"], info["constants"])
    trajectory = optimum.trajectory
    path = trajectory.save(out / "trajectory.npz")
    circles = _task_circles(env.task.markers(info["constants"]))
    curve = figures.Curve("optimum", trajectory, figures.COLORS["trajopt"])
    picture = figures.save(figures.trajectory_figure(env.task.id, [curve], circles), out / "figure.png")
    rows = [
        ["cost", f"{optimum.cost:.6f}"],
        ["duration, s", f"{trajectory.duration:.2f}"],
        ["peak tilt, deg", f"{math.degrees(trajectory.tilt.max()):.2f}"],
        ["peak force, N", f"{np.abs(trajectory.u).max():.1f}"],
        ["status", f"{optimum.solver}: {optimum.status}, {optimum.iterations} iterations"],
        ["constraint violation", f"{optimum.violation:.1e}"],
        ["solver time, s", f"{optimum.seconds:.3f}"],
    ]
    _print_table(env.task.id, ["", ""], rows)
    console.print(f"trajectory: {path}\nfigure: {picture}")


def replay(
    task: str,
    /,
    controller: str = "trajopt",
    episode: int = 0,
    physics: Literal["bullet", "rk4"] = "bullet",
    frames: int = 5,
    seconds: float | None = None,
    out: Path = Path("runs/replay"),
) -> None:
    """Draws a certified episode under a controller: a strip of rendered frames.

    Args:
        task: name of a task.
        controller: name of a controller.
        episode: index of the certified episode.
        physics: "bullet" or "rk4".
        frames: how many, at equal times.
        seconds: of the last frame; default the end of the episode.
        out: folder of TASK-CONTROLLER-EPISODE.png.
    """
    evaluate.check_names("task", [task], TASKS)
    evaluate.check_names("controller", [controller], CONTROLLERS)
    env = BallbotEnv(task, physics=physics, render_mode="rgb_array")
    episode_set = certified.load(env.task)
    if not 0 <= episode < len(episode_set):
        raise ValueError(f"episode must be 0 to {len(episode_set) - 1}, not {episode}")
    run = rollout(env, CONTROLLERS[controller](env.task, env.params), options=episode_set.options(episode))
    end = min(seconds or math.inf, run.trajectory.duration)
    steps = np.linspace(0, end / env.task.control_dt, frames).round().astype(int)
    pictures = [env.render_state(run.trajectory.x[k]) for k in steps]
    env.close()
    titles = [f"{k * env.task.control_dt:.2f} s, {math.degrees(run.trajectory.tilt[k]):.0f}°" for k in steps]
    path = figures.save(figures.strip_figure(pictures, titles), out / f"{task}-{controller}-{episode}.png")
    console.print(f"picture: {path}")


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
    with _progress() as progress, get_context("spawn").Pool(workers) as pool:
        for name in tasks:
            bar = progress.add_task(name, total=episodes)
            optima = []
            for index, result in enumerate(pool.imap(_certify_one, [(name, i) for i in range(episodes)], chunksize=5)):
                progress.advance(bar)
                if isinstance(result, str):
                    failed.append(f"{name} episode {index}: {result}")
                else:
                    optima.append(result)
            if len(optima) == episodes:
                task = make_task(name)
                path = certified.path_of(task) if out is None else out / certified.path_of(task).name
                certification.evaluation_set(task, default_params(), optima).save(task, path)
                progress.console.print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
    if failed:
        raise PlanError("no optimum for\n" + "\n".join(failed))


def _certify_one(job: tuple[str, int]) -> Optimum | str:
    """The optimum, or the message of why there is none: an exception would end the pool."""
    task, params = make_task(job[0]), default_params()
    try:
        return find_optimum(task, params, *certification.episode(task, params, job[1]))
    except PlanError as error:
        return str(error)


def main() -> None:
    """Runs the command line; errors a user can cause end with one line and exit status 1."""
    commands = {"benchmark": benchmark, "paper": paper, "optimize": optimize, "replay": replay, "certify": certify}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="ballbot", description="Ballbot control, by its regret.")
    except (ValueError, TypeError, ImportError, PlanError, OSError) as error:
        Console(stderr=True).print(f"ballbot: {error}", style="red", markup=False)
        sys.exit(1)
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted; the same command continues where it stopped")
        sys.exit(130)


_HEADER = [
    "task",
    "controller",
    "success",
    "falls",
    "regret mean",
    "regret median",
    "cost mean",
    "cost median",
    "peak tilt",
    "settle",
    "plan",
    "per step",
]


def _cells(row: evaluate.Row) -> list[str]:
    def shown(value: float, form: str, unit: str = "") -> str:
        return format(value, form) + unit if math.isfinite(value) else "–"

    return [
        row.task,
        row.controller,
        f"{100 * row.success:.1f} %",
        f"{row.falls}/{row.episodes}",
        shown(row.regret_mean, ".2%"),
        shown(row.regret_median, ".2%"),
        shown(row.cost_mean, ".2f"),
        shown(row.cost_median, ".2f"),
        shown(row.peak_tilt_median, ".1f", "°"),
        shown(row.settle_time_median, ".2f", " s"),
        shown(row.plan_ms_median, ".0f", " ms"),
        shown(row.step_us_median, ".0f", " µs"),
    ]


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _episode_figure(task: str, controllers: list[str], physics: str, out: Path) -> Path:
    """The first certified episode of a task under every controller."""
    env = BallbotEnv(task, physics=physics)
    episode_set = certified.load(env.task)
    curves = [figures.Curve("optimum", episode_set.trajectories[0], "0.35", "--")]
    for i, name in enumerate(controllers):
        run = rollout(env, CONTROLLERS[name](env.task, env.params), options=episode_set.options(0))
        label = figures.LABELS.get(name, name) + (" (fails)" if run.failure else "")
        curves.append(figures.Curve(label, run.trajectory, figures.color(name, i)))
    circles = _task_circles(env.task.markers(episode_set.constants[0]))
    env.close()
    figure = figures.trajectory_figure(f"{env.task.id}, certified episode 0", curves, circles)
    return figures.save(figure, out / "figures" / f"{task}.png")


def _compare_stabilizations(names: list[str], out: Path) -> None:
    """Figs 2 and 3 as in the paper: LQR against trajectory optimization with the same weights, Stabilize's."""
    rows = []
    slow, fast = (
        BallbotEnv("stabilize"),
        BallbotEnv("stabilize", control_dt=_PAPER_LQR_DT, physics_dt=_PAPER_LQR_DT / 4),
    )
    for name in names:
        entry = PAPER_PROBLEMS[name]
        options = {"state": entry.problem.initial[0]}
        curves = []
        for key, env in (("lqr", fast), ("trajopt", slow)):
            run = rollout(env, CONTROLLERS[key](env.task, env.params), options=options)
            rate = f"{1 / env.task.control_dt:.0f} Hz"
            curves.append(figures.Curve(f"{figures.LABELS[key]}, {rate}", run.trajectory, figures.COLORS[key]))
            peak = math.degrees(np.abs(run.trajectory.x[:, 2:4]).max())
            settle = f"{run.settle_time:.2f}"
            rows.append([entry.figure, key, rate, f"{run.cost:.2f}", f"{peak:.1f}", settle, str(run.failure)])
        figure = figures.trajectory_figure(
            f"{entry.figure}: {entry.title}, LQR against trajectory optimization", curves
        )
        figures.save(figure, out / f"{_slug(entry.figure)}-{name}-lqr-and-trajopt.png")
    header = ["figure", "controller", "feedback", "cost", "peak lean, deg", "settle time, s", "fell"]
    _print_table("Stabilization in PyBullet, both with Stabilize's weights", header, rows)


def _paper_circles(entry: PaperProblem, plan: Plan) -> list[figures.Circle]:
    if entry.problem.periodic:
        return [figures.Circle(0, 0, float(plan.q[0]), filled=False)]
    ball = default_params().ball_radius  # what is drawn filled touches the ball at the distance kept
    return [figures.Circle(x, y, distance - ball) for x, y, distance in entry.obstacles]


def _task_circles(markers: list[Marker]) -> list[figures.Circle]:
    return [figures.Circle(*marker.position, marker.radius, not marker.ring, marker.color[:3]) for marker in markers]


def _slug(text: str) -> str:
    return text.lower().replace(". ", "").replace(" ", "-")


def _claim(out: Path, config: dict[str, object]) -> None:
    """Marks the folder as this run's, so that only the same run continues in it."""
    marker = out / "unfinished.json"
    if marker.exists() and json.loads(marker.read_text()) != config:
        raise ValueError(
            f"{out} holds an unfinished run of {json.loads(marker.read_text())}, this is {config}; "
            "give another --out or delete the folder"
        )
    files.write(marker, json.dumps(config))


def _about() -> dict[str, object]:
    """What a result depends on besides its settings."""
    packages = ("gymnasium", "numpy", "pybullet", "casadi", "scipy")
    return {
        "version": importlib.metadata.version("ballbot-gym"),
        "commit": _commit(),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in packages},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def _commit() -> str:
    """The checkout's commit, or "none" where the package runs without one."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return "none"
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    result = subprocess.run(command, capture_output=True, text=True)
    return result.stdout.strip() or "none"


def _progress() -> Progress:
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console)


def _print_table(title: str, header: list[str], rows: list[list[str]]) -> None:
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < 2 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


if __name__ == "__main__":
    main()
