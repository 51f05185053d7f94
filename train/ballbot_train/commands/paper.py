"""`ballbot paper`: the paper's figures."""

import math
from pathlib import Path

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_baselines.collocation import Plan
from ballbot_baselines.paper import EFFORT_WEIGHT, PAPER_PROBLEMS, REST_WEIGHT, PaperProblem
from ballbot_baselines.tvlqr import TvlqrController
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import default_params
from ballbot_gym.rollout import rollout, simulate
from ballbot_train.console import check_names, console, print_table
from ballbot_train.report import figures

_PAPER_CONTROL_DT = 0.01  # s, at which the paper's plans are tracked
_PAPER_LQR_DT = 0.001  # s: the paper's LQR is continuous


def paper(out: Path = Path("runs/paper"), only: tuple[str, ...] = ()) -> None:
    """Regenerates the paper's Figs 2 to 5: each optimum beside its execution in PyBullet.

    Args:
        out: folder of the figures and plans.
        only: names of some of the problems; default all.
    """
    check_names("problem", list(only), PAPER_PROBLEMS)
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
    print_table("The paper's problems: 40 intervals, Hermite–Simpson", header, rows)
    stabilizations = [name for name in only or PAPER_PROBLEMS if name.startswith("stabilize")]
    if stabilizations:
        _compare_stabilizations(stabilizations, out)
    console.print(f"figures: {out}")


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
    print_table("Stabilization in PyBullet, both with Stabilize's weights", header, rows)


def _paper_circles(entry: PaperProblem, plan: Plan) -> list[figures.Circle]:
    if entry.problem.periodic:
        return [figures.Circle(0, 0, float(plan.q[0]), filled=False)]
    ball = default_params().ball_radius  # what is drawn filled touches the ball at the distance kept
    return [figures.Circle(x, y, distance - ball) for x, y, distance in entry.obstacles]


def _slug(text: str) -> str:
    return text.lower().replace(". ", "").replace(" ", "-")
