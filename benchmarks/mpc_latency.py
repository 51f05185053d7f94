"""How long NMPC's `act` takes: median, 99th percentile and maximum per task, over horizons, nodes and control rates.

Times are of one process, and include everything between state and force. Run it on a quiet machine: the largest times of a
busy one are the scheduler's.
"""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from ballbot_baselines import NmpcController, find_optimum
from ballbot_gym import files
from ballbot_gym.certified.cache import episode
from ballbot_gym.env import BallbotEnv
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import TASKS


@dataclass(frozen=True)
class Setting:
    """One configuration of the controller, times in s."""

    task: str
    nodes: int = 40
    horizon: float = 1.0
    control_dt: float = 0.02
    iterations: int = 1
    duration: float = 8.0


@dataclass(frozen=True)
class Latency:
    """What one setting took, ms per control step, and what it cost: median of cost / optimum − 1, %."""

    task: str
    mode: str
    nodes: int
    horizon: float
    control_dt: float
    steps: int
    median_ms: float
    p99_ms: float
    max_ms: float
    regret_percent: float
    failed: int
    falls: int


class Timed:
    """A controller whose `act` is timed, step by step, in s."""

    def __init__(self, controller: NmpcController):
        self.controller, self.seconds = controller, []

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self.controller.reset(t, x, c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        start = time.perf_counter()
        u = self.controller.act(t, x)
        self.seconds.append(time.perf_counter() - start)
        return u


def settings(tasks: tuple[str, ...], quick: bool) -> Iterator[Setting]:
    """The default for every task, converged too; then sweeps over horizon, nodes and control rate on the first."""
    for task in tasks:
        yield Setting(task)
        yield Setting(task, iterations=20)
    first = Setting(tasks[0])
    sweeps = [{"horizon": h} for h in (0.5, 2.0)] if quick else [{"horizon": h} for h in (0.4, 0.8, 1.5, 2.0)]
    sweeps += [{"nodes": n} for n in ((20,) if quick else (10, 20, 30, 50))]
    sweeps += [{"control_dt": dt} for dt in ((0.01,) if quick else (0.01, 0.005))]
    if not quick:  # plans of whole episodes would take minutes
        sweeps.append({"nodes": 20, "horizon": 0.5, "control_dt": 0.001, "duration": 2.0})
    for change in sweeps:
        yield replace(first, **change)


def measure(setting: Setting, episodes: int) -> Latency:
    """Runs the first certified episodes in PyBullet."""
    env = BallbotEnv(TASKS[setting.task](control_dt=setting.control_dt, duration=setting.duration))
    nmpc = NmpcController(env.task, env.params, setting.nodes, setting.horizon, setting.iterations)
    timed, regrets, falls = Timed(nmpc), [], 0
    for i in range(episodes):
        x, c = episode(env.task, env.params, i)
        run = rollout(env, timed, options={"state": x, "constants": c})
        falls += run.failure
        regrets.append(run.cost / find_optimum(env.task, env.params, x, c, twice=True).cost - 1)
    env.close()
    milliseconds = 1e3 * np.array(timed.seconds)
    return Latency(
        task=setting.task,
        mode="real-time iteration" if setting.iterations == 1 else "converged",
        nodes=setting.nodes,
        horizon=setting.horizon,
        control_dt=setting.control_dt,
        steps=len(milliseconds),
        median_ms=float(np.median(milliseconds)),
        p99_ms=float(np.percentile(milliseconds, 99)),
        max_ms=float(milliseconds.max()),
        regret_percent=100 * float(np.median(regrets)),
        failed=nmpc.counts.failed,
        falls=falls,
    )


def main(
    out: Path = Path("runs/mpc_latency"), tasks: tuple[str, ...] = tuple(TASKS), episodes: int = 10, quick: bool = False
) -> None:
    """Measures, and writes mpc_latency.csv and .png.

    Args:
        out: folder of the results.
        tasks: names of tasks; the sweeps are on the first.
        episodes: per setting.
        quick: two episodes and short sweeps.
    """
    rows = []
    for setting in settings(tasks, quick):
        rows.append(row := measure(setting, 2 if quick else episodes))
        print(
            f"{row.task:10s} {row.mode:20s} {row.nodes:3d} nodes over {row.horizon:.1f} s at {1 / row.control_dt:4.0f} Hz: "
            f"median {row.median_ms:.3f} ms, p99 {row.p99_ms:.3f} ms, max {row.max_ms:.2f} ms, "
            f"regret {row.regret_percent:+.2f} %, {row.failed} failed, {row.falls} falls",
            flush=True,
        )
    files.write_csv(out / "mpc_latency.csv", [asdict(row) for row in rows])
    _figure(rows, out / "mpc_latency.png")
    print(f"written to {out}")


def _figure(rows: list[Latency], path: Path) -> None:
    labels = [
        f"{row.task}, {row.mode}\n{row.nodes} nodes, {row.horizon:.1f} s, {1 / row.control_dt:.0f} Hz" for row in rows
    ]
    places = np.arange(len(rows))[::-1]
    figure = Figure(figsize=(8, 0.5 * len(rows) + 1.2), layout="constrained")
    axis = figure.subplots()
    for name, style in (("median_ms", "o"), ("p99_ms", "|"), ("max_ms", "x")):
        label = name.removesuffix("_ms")
        axis.plot([getattr(row, name) for row in rows], places, style, color="#e08a00", label=label, ms=8)
    axis.set(xscale="log", xlabel="time per control step, ms", yticks=places, yticklabels=labels)
    axis.tick_params(axis="y", labelsize=7)
    axis.axvline(1.0, color="0.6", lw=0.8)
    axis.grid(axis="x", alpha=0.3, which="both")
    axis.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
