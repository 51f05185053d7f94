"""Solve time against the number of intervals, 20 to 640: with stage-wise structure it grows linearly."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from ballbot_baselines.collocation import solve
from ballbot_baselines.optimum import find_optimum
from ballbot_baselines.paper_problems import between_states, hermite_guess, state
from ballbot_gym import files
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.tasks.stabilize import Stabilize

_START, _END = state(x=-1.0, vy=1.0), state()
_SECONDS = 2.0  # given: with a free step fatrop stalls at 160 intervals


@dataclass(frozen=True)
class Point:
    """The median of several solves."""

    problem: str
    intervals: int
    seconds: float
    iterations: int

    @property
    def per_iteration(self) -> float:
        """s."""
        return self.seconds / self.iterations


def episode_of(params: BallbotParams, intervals: int, repeats: int) -> Point:
    """Stabilize on the env's grid: as many control steps of 0.02 s."""
    task = Stabilize(duration=0.02 * intervals)
    optima = [find_optimum(task, params, _START, np.zeros(0)) for _ in range(repeats)]
    seconds = float(np.median([optimum.seconds for optimum in optima]))
    return Point("Stabilize, shooting", intervals, seconds, optima[0].iterations)


def collocation_of(params: BallbotParams, intervals: int, repeats: int) -> Point:
    """The paper's stabilization on ever finer knots, in a given time."""
    problem = between_states(f"scaling-{intervals}", _START, _END, intervals=intervals)
    summed, share = problem.cost, 40 / intervals  # so that the cost stays what it is with 40 intervals
    problem = replace(problem, step=(_SECONDS / intervals,) * 2, cost=lambda *knot: share * summed(*knot))
    guess = hermite_guess(params, _START, _END, _SECONDS, intervals)
    plans = [solve(problem, params, guess, "fatrop") for _ in range(repeats)]
    seconds = float(np.median([plan.seconds for plan in plans]))
    return Point("paper's problem, Hermite–Simpson", intervals, seconds, plans[0].iterations)


def main(out: Path = Path("runs/scaling"), repeats: int = 5, quick: bool = False) -> None:
    """Measures, and writes scaling.csv and .png.

    Args:
        out: folder of the results.
        repeats: solves of which the median is taken, which leaves out the first with its compilation.
        quick: fewer sizes, three solves each.
    """
    params, points = default_params(), []
    for intervals in (20, 80, 320) if quick else (20, 40, 80, 160, 320, 640):
        for measure in (episode_of, collocation_of):
            points.append(point := measure(params, intervals, min(repeats, 3) if quick else repeats))
            print(
                f"{point.problem:34s} {intervals:4d} intervals: {1e3 * point.seconds:8.2f} ms, {point.iterations:3d} "
                f"iterations, {1e6 * point.per_iteration / intervals:6.1f} µs per interval and iteration",
                flush=True,
            )
    for name in dict.fromkeys(point.problem for point in points):
        print(f"{name}: time per iteration grows as intervals^{exponent(points, name):.2f}")
    files.write_csv(out / "scaling.csv", [asdict(point) for point in points])
    _figure(points, out / "scaling.png")
    print(f"written to {out}")


def exponent(points: list[Point], problem: str) -> float:
    """Of the power law through the times per iteration; 1 is linear."""
    chosen = [point for point in points if point.problem == problem]
    logs = np.log([(point.intervals, point.per_iteration) for point in chosen])
    return float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])


def _figure(points: list[Point], path: Path) -> None:
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    for name in dict.fromkeys(point.problem for point in points):
        chosen = [point for point in points if point.problem == name]
        n = [point.intervals for point in chosen]
        axes[0].loglog(n, [1e3 * point.seconds for point in chosen], "o-", label=name)
        (line,) = axes[1].loglog(n, [1e3 * point.per_iteration for point in chosen], "o-", label=name)
        linear = 1e3 * chosen[-1].per_iteration * np.array(n) / n[-1]
        axes[1].loglog(n, linear, ":", color=line.get_color(), lw=1)
    axes[0].set(xlabel="intervals", ylabel="ms per solve")
    axes[1].set(xlabel="intervals", ylabel="ms per iteration (dotted: linear)")
    for axis in axes:
        axis.grid(alpha=0.3, which="both")
    axes[0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
