"""The computation time of a rolling ball: the batch's throughput and NMPC's control step, of each robot in one run.

Times are of the processor and of one thread, so that a busy machine spoils them less; runs of the robots alternate. Run it
with OMP_NUM_THREADS=1.
"""

import statistics
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from ballbot_baselines import NmpcController
from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import PAPER, ROBOTS
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import TASKS
from ballbot_gym.vector.batch import BallbotBatch


@dataclass(frozen=True)
class Row:
    """A figure of a robot, and its ratio to that of the paper's."""

    what: str
    task: str
    robot: str
    value: float
    unit: str
    ratio: float


def main(
    robots: tuple[str, ...] = ("rolling",),
    tasks: tuple[str, ...] = tuple(TASKS),
    count: int = 16_384,
    seconds: float = 2.0,
    runs: int = 5,
    episodes: int = 5,
    compile: bool = True,
    out: Path = Path("runs/robots"),
) -> None:
    """Measures, and writes robots.csv.

    Args:
        robots: names; the paper's is measured too.
        tasks: names.
        count: envs of the batch.
        seconds: of each run of the batch.
        runs: of the batch; the median counts.
        episodes: certified episodes of each task under NMPC, in the closed form.
        compile: the batch's steps are compiled.
        out: folder of the results.
    """
    unknown = [robot for robot in robots if robot not in ROBOTS]
    if unknown:
        raise SystemExit(f"unknown robot {unknown[0]!r}; known: {', '.join(ROBOTS)}")
    names, rows = [PAPER, *(robot for robot in robots if robot != PAPER)], []
    for task in tasks:
        batches = {robot: BallbotBatch(make_task(task, robot), count, compile=compile, robot=robot) for robot in names}
        speeds: dict[str, list[float]] = {robot: [] for robot in names}
        for batch in batches.values():
            speed(batch, 0.0)  # compiles
        for _ in range(runs):
            for robot, batch in batches.items():
                speeds[robot].append(speed(batch, seconds))
        rows += _report("batch", task, {robot: statistics.median(found) for robot, found in speeds.items()}, "steps/s")
        del batches
        rows += _report("nmpc, median", task, nmpc_steps(task, names, episodes), "ms")
    files.write_csv(out / "robots.csv", [asdict(row) for row in rows])
    print(f"written to {out}")


def speed(batch: BallbotBatch, seconds: float) -> float:
    """Control steps per second of all envs together, with random actions; ends of episodes included."""
    batch.reset(0)
    actions = [0.6 * torch.rand(batch.num_envs, 2) - 0.3 for _ in range(8)]
    steps, begin = 0, time.process_time()
    with torch.no_grad():
        while steps == 0 or time.process_time() - begin < seconds:
            for action in actions:
                batch.step(action)
            steps += len(actions)
    return steps * batch.num_envs / (time.process_time() - begin)


def nmpc_steps(task: str, robots: list[str], episodes: int) -> dict[str, float]:
    """Median time of NMPC's `act` by robot, ms, on the first certified episodes in the closed form; robots alternate."""
    envs = {robot: BallbotEnv(task, robot=robot, physics="rk4") for robot in robots}
    controllers = {robot: _Timed(env) for robot, env in envs.items()}
    for i in range(episodes):
        for robot, env in envs.items():
            sets = certified.load(env.task, robot)
            rollout(env, controllers[robot], options={"state": sets.states[i], "constants": sets.constants[i]})
    return {robot: 1e3 * statistics.median(nmpc.spent) for robot, nmpc in controllers.items()}


class _Timed(NmpcController):
    """NMPC that notes how long each of its steps takes, s of the processor."""

    def __init__(self, env: BallbotEnv):
        super().__init__(env.task, env.params)
        self.spent: list[float] = []

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        begin = time.thread_time()
        u = super().act(t, x)
        self.spent.append(time.thread_time() - begin)
        return u


def _report(what: str, task: str, found: dict[str, float], unit: str) -> list[Row]:
    rows = [Row(what, task, robot, value, unit, value / found[PAPER]) for robot, value in found.items()]
    for row in rows:
        print(f"{what:14s} {task:10s} {row.robot:8s} {row.value:14,.3f} {unit}, {row.ratio:.2f} of paper's", flush=True)
    return rows


if __name__ == "__main__":
    tyro.cli(main)
