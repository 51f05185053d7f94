"""Whether the playground keeps real time, and whether its memory grows.

    python benchmarks/playground.py --minutes 10

A robot is pushed every few seconds next to a ghost, and a connected page is drawn 50 times per second. Run it on
a quiet machine. Controllers are made before time counts. Steps after a planner's pause at the start of an episode count as
late. The growth of memory is counted from the first minute on. Exit status 1 says that the real-time factor is below 0.99,
that more than 0.1 % of the steps began later than 20 ms after their time, or that memory grew by more than 10 MiB.
"""

import math
import multiprocessing
import resource
import sys
import time
from array import array
from pathlib import Path

import numpy as np
import tyro

from ballbot_gym import files
from ballbot_gym.drawing.viewer import Viewer
from ballbot_train.report.live_page import PATIENCE, PlayPage
from ballbot_train.report.simulation import Playground

_LATE = 0.020  # s after its time: a step that begins later counts as late
_LEAST_FACTOR, _MOST_LATE, _MOST_GROWTH = 0.99, 0.1, 10.0  # of time, % of the steps, MiB
_PUSH_EVERY, _PUSH = 5.0, 40.0  # s, N·s
_WARM_UP = 60.0  # s, after which memory is looked at first


class TimedPage(PlayPage):
    """A page that notes how late each step began, s."""

    late = array("d")

    def next_due(self, now: float, due: float) -> float:
        self.late.append(now - due)
        return super().next_due(now, due)


def memory() -> float:
    """Memory that this process takes now, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def watch(port: int) -> None:
    """Receives what a browser would, in a process of its own."""
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{port}/stream", max_size=None) as client:
        while True:
            client.recv()


def measure(
    minutes: float = 10.0,
    task: str = "stabilize",
    controller: str = "lqr",
    ghosts: tuple[str, ...] = ("apg",),
    physics: str = "bullet",
    out: Path = Path("runs/playground"),
) -> None:
    """Runs the playground and writes playground.csv.

    Args:
        minutes: how long.
        task: name of a task.
        controller: of the robot.
        ghosts: controllers of further robots.
        physics: "bullet", "mujoco" or "rk4".
        out: folder of the table.
    """
    playground, viewer = Playground(task, controller, ghosts, physics), Viewer(port=0)
    page = TimedPage(playground, viewer)
    watcher = multiprocessing.get_context("spawn").Process(target=watch, args=(viewer.port,), daemon=True)
    watcher.start()
    while not viewer.is_watched:
        time.sleep(0.1)
    page.run(_PUSH_EVERY)
    del page.late[:]
    began, cpu, before = time.perf_counter(), time.process_time(), math.nan
    for k in range(math.ceil(60 * minutes / _PUSH_EVERY)):
        if k * _PUSH_EVERY >= min(_WARM_UP, 30 * minutes) and math.isnan(before):
            before = memory()
        page.run(_PUSH_EVERY)
        playground.push(_PUSH * math.cos(k), _PUSH * math.sin(k))
    seconds, late, after = time.perf_counter() - began, np.array(page.late), memory()
    row = {
        "task": task,
        "controller": controller,
        "ghosts": " ".join(ghosts),
        "physics": physics,
        "seconds": seconds,
        "steps": len(late),
        "real_time_factor": 1 - float((late - PATIENCE).clip(0).sum()) / seconds,
        "late_percent": 100 * float(np.mean(late > _LATE)),
        "worst_lateness_ms": 1e3 * float(late.max()),
        "cpu_share": (time.process_time() - cpu) / seconds,
        "memory": after,
        "memory_growth": after - before,
        "failures": sum(score.failure != "" for score in playground.scores),
    }
    watcher.terminate()
    viewer.close()
    playground.close()
    for name, value in row.items():
        print(f"{name:>18}: {value:.4g}" if isinstance(value, float) else f"{name:>18}: {value}")
    print(f"late is more than {1e3 * _LATE:g} ms; table: {files.write_csv(out / 'playground.csv', [row])}")
    slow = row["real_time_factor"] < _LEAST_FACTOR or row["late_percent"] > _MOST_LATE
    sys.exit(slow or row["memory_growth"] > _MOST_GROWTH)


if __name__ == "__main__":
    tyro.cli(measure)
