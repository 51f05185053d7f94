"""The paper's four point-to-point problems, by this package and by the paper's tools, Drake with SNOPT.

The same URDF, the same problem and the same transcription (Hermite–Simpson, forces linear between knots, one free step,
cost summed over knots). Both start from a cubic, and Drake also from the paper's straight line. Equal optima are asserted.
Building and compiling are timed apart from solving, for both. Needs the [bench] extra: `pip install -e ".[bench]"`.
"""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.planning import DirectCollocation
from pydrake.solvers import SnoptSolver

from ballbot_baselines.paper.collocation import Problem
from ballbot_baselines.paper.problems import PAPER_PROBLEMS
from ballbot_baselines.solvers.ocp import OcpSolver
from ballbot_gym import files
from ballbot_gym.robot import URDF_PATH, Robot, default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.trajectory import Trajectory

PROBLEMS = ("stabilize-1", "stabilize-5", "turn-3", "turn-10")
_EQUAL = 1e-3  # relative difference of optima that counts as none


@dataclass(frozen=True)
class Timing:
    """One problem from one guess by one program; seconds are medians, NaN where it found no optimum."""

    problem: str
    guess: str
    program: str
    cost: float
    build_s: float
    cold_s: float
    warm_s: float


def main(out: Path = Path("runs/trajopt_vs_drake"), repeats: int = 5, quick: bool = False) -> None:
    """Times both programs side by side in one run.

    Args:
        out: folder of trajopt_vs_drake.csv and .png.
        repeats: number of solves; their median is taken.
        quick: two problems, one solve each.
    """
    params, rows = default_params(), []
    repeats = 1 if quick else repeats
    for name in PROBLEMS[:2] if quick else PROBLEMS:
        entry = PAPER_PROBLEMS[name]
        problem, smooth = entry.problem, entry.guess(params)
        line = np.linspace(problem.initial[0], problem.final[0], problem.intervals + 1)
        straight = Trajectory(smooth.t, line, np.zeros((len(line), 2)))
        for label, program, timing in (
            ("straight line", "Drake + SNOPT", time_drake(problem, params, straight, repeats)),
            ("cubic Hermite", "Drake + SNOPT", time_drake(problem, params, smooth, repeats)),
            ("cubic Hermite", "ballbot, fatrop", time_ours(problem, params, smooth, repeats)),
        ):
            rows.append(Timing(name, label, program, *timing))
            print(_line(rows[-1]), flush=True)
    compile_seconds = time_compilation(params)
    print(f"compiling one problem's derivatives, once per machine: {compile_seconds:.1f} s")
    check_equal_optima(rows)
    summary = ratios(rows)
    for line in summary:
        print(line)
    files.write_csv(out / "trajopt_vs_drake.csv", [asdict(row) for row in rows])
    files.write(out / "trajopt_vs_drake.txt", "\n".join([*map(_line, rows), *summary]) + "\n")
    _figure(rows, out / "trajopt_vs_drake.png")
    print(f"written to {out}")


def time_ours(problem: Problem, params: Robot, guess: Trajectory, repeats: int) -> tuple[float, ...]:
    """Cost, and seconds to build, to solve from the guess, and to solve again from the solution."""
    start = time.perf_counter()
    OcpSolver(problem.hermite_simpson(params), problem.intervals, "fatrop")
    built = time.perf_counter() - start
    try:
        plans = [problem.solve(params, guess, "fatrop") for _ in range(repeats)]
    except PlanError:
        return np.nan, built, np.nan, np.nan
    warm = [problem.solve(params, plans[0].trajectory, "fatrop").seconds for _ in range(repeats)]
    return plans[0].cost, built, float(np.median([plan.seconds for plan in plans])), float(np.median(warm))


def time_drake(problem: Problem, params: Robot, guess: Trajectory, repeats: int) -> tuple[float, ...]:
    """The same of Drake's DirectCollocation with SNOPT."""
    start = time.perf_counter()
    collocation = drake_collocation(problem, params)
    built = time.perf_counter() - start
    program = collocation.prog()
    _set_guess(collocation, guess)
    first = program.initial_guess().copy()
    solver = SnoptSolver()
    cold, result = _median_seconds(lambda: solver.Solve(program, first, None), repeats)
    if not result.is_success():
        return np.nan, built, np.nan, np.nan
    found = result.GetSolution()
    warm, _ = _median_seconds(lambda: solver.Solve(program, found, None), repeats)
    return result.get_optimal_cost(), built, cold, warm


def drake_collocation(problem: Problem, params: Robot) -> DirectCollocation:
    """A paper problem between two states, on the URDF that this package simulates."""
    plant = MultibodyPlant(time_step=0.0)
    Parser(plant).AddModels(str(URDF_PATH))
    plant.Finalize()
    n = problem.intervals
    collocation = DirectCollocation(
        plant,
        plant.CreateDefaultContext(),
        n + 1,
        *problem.step,
        input_port_index=plant.get_actuation_input_port().get_index(),
    )
    collocation.AddEqualTimeIntervalsConstraints()
    program, limit, lean = collocation.prog(), params.force_limit, problem.lean_limit
    h = collocation.time_step(0)[0]
    for k in range(n + 1):
        x, u = collocation.state(k), collocation.input(k)
        program.AddBoundingBoxConstraint(-limit, limit, u)
        program.AddBoundingBoxConstraint(-lean, lean, x[2:4])
        if k < n:
            program.AddCost(problem.cost(tuple(x), tuple(u), h, ()))
    for knot, (low, high) in ((0, problem.initial), (n, problem.final)):
        program.AddBoundingBoxConstraint(low, high, collocation.state(knot))
    return collocation


def time_compilation(params: Robot) -> float:
    """Seconds that an empty cache costs one problem."""
    problem, kept = PAPER_PROBLEMS[PROBLEMS[0]].problem, os.environ.get("BALLBOT_CACHE")
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["BALLBOT_CACHE"] = folder
        for _ in range(2):  # with an empty cache, then with a full one
            start = time.perf_counter()
            OcpSolver(problem.hermite_simpson(params), problem.intervals, "fatrop")
            seconds.append(time.perf_counter() - start)
    if kept is None:
        del os.environ["BALLBOT_CACHE"]
    else:
        os.environ["BALLBOT_CACHE"] = kept
    return seconds[0] - seconds[1]


def check_equal_optima(rows: list[Timing]) -> None:
    """Raises an AssertionError where both programs found an optimum and it is not the same."""
    for problem in dict.fromkeys(row.problem for row in rows):
        costs = [row.cost for row in rows if row.problem == problem and np.isfinite(row.cost)]
        assert max(costs) <= min(costs) * (1 + _EQUAL), f"{problem}: optima differ: {costs}"


def ratios(rows: list[Timing]) -> list[str]:
    """How many times faster, per problem, than Drake from each guess; geometric means."""
    lines, found, cold = [], [], {(row.problem, row.guess, row.program): row.cold_s for row in rows}
    for problem in dict.fromkeys(row.problem for row in rows):
        ours = cold[problem, "cubic Hermite", "ballbot, fatrop"]
        drake = {g: s for (p, g, program), s in cold.items() if p == problem and program.startswith("Drake")}
        found.append([seconds / ours for seconds in drake.values()])
        each = ", ".join(f"{seconds / ours:.0f} from the {guess}" for guess, seconds in drake.items())
        lines.append(f"{problem}: Drake's time / ours: {each}")
    straight, cubic = np.exp(np.mean(np.log(found), axis=0))  # NaN where a program found no optimum
    return [*lines, f"geometric means: {straight:.0f} from the straight line, {cubic:.0f} from the cubic Hermite"]


def _set_guess(collocation: DirectCollocation, guess: Trajectory) -> None:
    program = collocation.prog()
    for k in range(len(guess.x)):
        program.SetInitialGuess(collocation.state(k), guess.x[k])
        program.SetInitialGuess(collocation.input(k), guess.u[k])
        if k < len(guess.x) - 1:
            program.SetInitialGuess(collocation.time_step(k)[0], guess.t[1])


def _median_seconds(run: Callable, repeats: int) -> tuple:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), result


def _line(row: Timing) -> str:
    return (
        f"{row.problem:12s} {row.guess:14s} {row.program:16s} J* {row.cost:9.4f}  build {1e3 * row.build_s:7.1f} ms  "
        f"cold {1e3 * row.cold_s:8.2f} ms  warm {1e3 * row.warm_s:8.2f} ms"
    )


def _figure(rows: list[Timing], path: Path) -> None:
    problems = list(dict.fromkeys(row.problem for row in rows))
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    groups = list(dict.fromkeys((row.program, row.guess) for row in rows))
    colors = ("#c0392b", "#1f6fb2", "#e6a9a0", "#93bfe0")
    for i, group in enumerate(groups):
        seconds = [next(r.cold_s for r in rows if (r.problem, r.program, r.guess) == (p, *group)) for p in problems]
        places = np.arange(len(problems)) + 0.2 * (i - 1.5)
        axis.bar(places, 1e3 * np.array(seconds), 0.18, label=", ".join(group), color=colors[i])
    axis.set(yscale="log", ylabel="time to solve, cold, ms", xticks=range(len(problems)), xticklabels=problems)
    figure.legend(fontsize=8, loc="outside upper center", ncols=2)
    axis.grid(axis="y", alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
