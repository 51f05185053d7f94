"""The playground in real time: how well it keeps it, and whether its memory grows.

    python benchmarks/playground.py --minutes 10

NMPC runs beside a ghost, is pushed every few seconds, and a page that somebody watches is drawn 30 times per second. Run it
on a quiet machine. Controllers are made, and solvers compiled, before time counts. A thread plans the next episode every 8 s,
and that counts. Beside it, a loop that does nothing but wait counts how often the machine itself is late. The growth of
memory is counted from the first minute on, because traces are full by then. Exit status 1 says that the real-time factor is
below 0.99, that more than 0.1 % of the steps began later than 20 ms after their time, or that memory grew by more than
`--growth` MiB.
"""

import math
import multiprocessing
import multiprocessing.process
import resource
import sys
import time
from array import array
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import tyro

from ballbot_gym import files
from ballbot_gym.viewer import Viewer
from ballbot_train.play.clock import PATIENCE, Clock
from ballbot_train.play.live_page import PlayPage
from ballbot_train.play.simulation import Playground

_LATE = 0.020  # s after its time: a step that begins later counts as late
_LEAST_FACTOR = 0.99
_MOST_LATE = 0.001  # of the steps
_PUSH_EVERY, _PUSH = 5.0, 40.0  # s, N·s
_MINUTE = 60.0  # s, between two looks at memory


@dataclass(frozen=True)
class Result:
    """What was measured; times in s, memory in MiB."""

    task: str
    controller: str
    ghosts: str
    physics: str
    seconds: float
    steps: int
    real_time_factor: float
    late_percent: float
    worst_lateness_ms: float
    idle_late_percent: float
    """Of the loop that only waits."""
    idle_worst_lateness_ms: float
    cpu_share: float
    memory_before: float
    memory_after: float
    failures: int


@dataclass
class TimedClock(Clock):
    """A clock that keeps how late each step began, s."""

    late: "array[float]" = field(default_factory=lambda: array("d"))

    def take(self) -> float | None:
        late = super().take()
        if late is not None:
            self.late.append(late)
        return late


def memory() -> float:
    """Memory that this process takes now, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def watch(port: int) -> None:
    """Receives what a browser would, in a process of its own."""
    import viser
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as client:
        while True:
            client.recv()


def idle(dt: float, there: Connection) -> None:
    """Waits for steps that do nothing until it is asked, then sends how late they were."""
    clock = TimedClock(dt)
    while not there.poll():
        clock.take()
        time.sleep(clock.wait())
    there.send(np.array(clock.late))


def measure(
    minutes: float = 10.0,
    task: str = "stabilize",
    controller: str = "nmpc",
    ghosts: tuple[str, ...] = ("lqr",),
    physics: str = "bullet",
    growth: float = 10.0,
    out: Path = Path("runs/playground"),
) -> None:
    """Runs the playground and writes playground.csv, and the memory of each minute into memory.csv.

    Args:
        minutes: how long.
        task: name of a task.
        controller: of the robot.
        ghosts: controllers beside it.
        physics: "bullet", "mujoco" or "rk4".
        growth: MiB that memory may grow after the first minute.
        out: folder of the tables.
    """
    playground = Playground(task, controller, ghosts, physics, episode=0)
    viewer = Viewer(port=0)
    page = PlayPage(playground, viewer)
    clock = page.clock = TimedClock(page.clock.dt)
    page.visitors.add(-1)  # `watch` does not say where its camera is, so viser does not count it
    watcher = multiprocessing.get_context("spawn").Process(target=watch, args=(viewer.port,), daemon=True)
    watcher.start()
    playground.settle()
    page.run(_PUSH_EVERY)  # the watcher has come
    del clock.late[:]
    here, there = multiprocessing.get_context("spawn").Pipe()
    waiter = multiprocessing.get_context("spawn").Process(
        target=idle, args=(playground.world.task.control_dt, there), daemon=True
    )
    waiter.start()
    began, cpu = time.perf_counter(), time.process_time()
    end, count, sizes = began + 60 * minutes, 0, [memory()]
    while (left := end - time.perf_counter()) > 0:
        page.run(min(_PUSH_EVERY, left))
        count += 1
        playground.push(_PUSH * math.cos(count), _PUSH * math.sin(count))
        if time.perf_counter() - began > _MINUTE * len(sizes):
            sizes.append(memory())
            steps = int(np.sum(np.array(clock.late) > _LATE))
            print(f"minute {len(sizes) - 1}: {sizes[-1]:.0f} MiB, {steps} late steps", flush=True)
    sizes.append(memory())
    seconds, late = time.perf_counter() - began, np.array(clock.late)
    here.send(None)
    waited: np.ndarray = here.recv()
    result = Result(
        task=task,
        controller=controller,
        ghosts=" ".join(ghosts),
        physics=physics,
        seconds=seconds,
        steps=len(late),
        real_time_factor=1 - float(late[late > PATIENCE].sum()) / seconds,
        late_percent=100 * float(np.mean(late > _LATE)),
        worst_lateness_ms=1e3 * float(late.max()),
        idle_late_percent=100 * float(np.mean(waited > _LATE)),
        idle_worst_lateness_ms=1e3 * float(waited.max()),
        cpu_share=(time.process_time() - cpu) / seconds,
        memory_before=sizes[1],
        memory_after=sizes[-1],
        failures=sum(score.failure != "" for score in playground.scores),
    )
    watcher.terminate()
    viewer.close()
    playground.close()
    for name, value in asdict(result).items():
        print(f"{name:>18}: {value:.4g}" if isinstance(value, float) else f"{name:>18}: {value}")
    print(f"late is more than {1e3 * _LATE:g} ms; table: {files.write_csv(out / 'playground.csv', [asdict(result)])}")
    files.write_csv(out / "memory.csv", [{"minute": i, "memory": size} for i, size in enumerate(sizes)])
    grew = result.memory_after - result.memory_before > growth
    sys.exit(result.real_time_factor < _LEAST_FACTOR or result.late_percent > 100 * _MOST_LATE or grew)


if __name__ == "__main__":
    tyro.cli(measure)
