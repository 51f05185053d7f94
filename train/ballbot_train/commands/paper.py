"""`ballbot paper`: the paper's figures."""

import math
from pathlib import Path

import numpy as np

from ballbot_baselines import Optimum
from ballbot_baselines.paper.collocation import collocation_error
from ballbot_baselines.paper.problems import (
    PAPER_PROBLEMS,
    TRACKING_DT,
    PaperProblem,
)
from ballbot_gym.engines import PHYSICS_NAMES
from ballbot_gym.robot import default_params
from ballbot_gym.tasks.marker import Marker
from ballbot_train.report import figures, labels
from ballbot_train.work.console import check_names, console, physics_or_default, print_table

_GREY = (0.75, 0.75, 0.75, 1.0)


def paper(out: Path = Path("runs/paper"), only: tuple[str, ...] = ()) -> None:
    """Draws the paper's Figs 2 to 5 with solutions of this package: each plan, and the plan tracked in PyBullet.

    Args:
        out: folder of the figures and plans.
        only: names of the problems to solve; default, all.
    """
    check_names("problem", list(only), PAPER_PROBLEMS)
    params, simulator = default_params(), PHYSICS_NAMES[physics_or_default(None)]
    rows = []
    for name in only or PAPER_PROBLEMS:
        entry = PAPER_PROBLEMS[name]
        plan = entry.solve(params)
        executed, error = entry.track(plan, params)
        plan.trajectory.save(out / f"{name}.npz")
        takes = [
            figures.Take("plan", plan.trajectory.resampled(TRACKING_DT), "0.35", style="--"),
            figures.Take(f"{simulator} under TVLQR", executed, labels.color("trajopt")),
        ]
        figure = figures.trajectory_figure(f"{entry.figure}: {entry.title}", takes, _paper_markers(entry, plan))
        figures.save(figure, out / f"{_slug(entry.figure)}-{name}.png")
        tilt = math.degrees(np.abs(plan.trajectory.x[:, 2:4]).max())
        rows.append(
            {
                "figure": entry.figure,
                "problem": name,
                "J*": f"{plan.cost:.4f}",
                "final time, s": f"{plan.trajectory.duration:.3f}",
                "peak lean, deg": f"{tilt:.2f}",
                "peak force, N": f"{np.abs(plan.trajectory.u).max():.0f}",
                "collocation error": f"{collocation_error(default_params(), plan.trajectory):.1e}",
                "tracked within, cm": f"{100 * error:.1f}",
                "status": plan.solver_status,
            }
        )
    print_table("The paper's problems: 40 intervals, Hermite–Simpson", [*rows[0]], [[*row.values()] for row in rows])
    stabilizations = [name for name in only or PAPER_PROBLEMS if name.startswith("stabilize")]
    if stabilizations:
        _compare_stabilizations(stabilizations, out, simulator)
    console.print(f"figures: {out}")


def _compare_stabilizations(names: list[str], out: Path, simulator: str) -> None:
    """Table and figures of LQR against trajectory optimization."""
    rows = []
    for name in names:
        entry = PAPER_PROBLEMS[name]
        takes = []
        for controller, episode in entry.compare().items():
            rate = f"{len(episode.trajectory.u) / episode.trajectory.duration:.0f} Hz"
            label = f"{labels.label(controller)}, {rate}"
            takes.append(figures.Take(label, episode.trajectory, labels.color(controller)))
            peak = math.degrees(np.abs(episode.trajectory.x[:, 2:4]).max())
            rows.append(
                {
                    "figure": entry.figure,
                    "controller": controller,
                    "feedback": rate,
                    "cost": f"{episode.cost:.2f}",
                    "peak lean, deg": f"{peak:.1f}",
                    "settle time, s": f"{episode.settle_time:.2f}",
                    "fell": str(episode.failure),
                }
            )
        title = f"{entry.figure}: {entry.title}, LQR against trajectory optimization"
        figure = figures.trajectory_figure(title, takes)
        figures.save(figure, out / f"{_slug(entry.figure)}-{name}-lqr-and-trajopt.png")
    print_table(
        f"Stabilization in {simulator}, both with Stabilize's weights", [*rows[0]], [[*row.values()] for row in rows]
    )


def _paper_markers(entry: PaperProblem, plan: Optimum) -> list[Marker]:
    if entry.problem.periodic:
        return [Marker((0.0, 0.0), float(np.hypot(*plan.trajectory.x[0, :2])), 0.0, _GREY, ring=True)]
    ball = default_params().ball_radius
    return [Marker((x, y), distance - ball, 0.0, _GREY) for x, y, distance in entry.obstacles]


def _slug(text: str) -> str:
    return text.lower().replace(". ", "").replace(" ", "-")
