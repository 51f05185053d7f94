"""Control steps per second: ours, single and batched, against the raw loops of the engines, EnvPool and Gymnasium's MuJoCo.

Random actions, resets included, one measurement after another, each in a process of its own. EnvPool and MuJoCo come with
the extra `[bench]`; the table says which of them are not installed.
"""

import importlib.util
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tyro
from matplotlib import colormaps
from matplotlib.figure import Figure

from ballbot_gym import TASKS, BallbotEnv, files
from ballbot_gym.engines.mujoco import import_mujoco

_TURNS = 41  # in which raw loop and env are compared
_GAIN = np.array([[0.3, 0, 1.3, 0, 0.7, 0, 1.3, 0], [0, 0.3, 0, 1.3, 0, 0.7, 0, 1.3]])
_UPRIGHT = 1  # seed of a start that this gain brings to rest


@dataclass
class Row:
    """One measurement: control steps of one robot per second of wall time, all robots together."""

    what: str
    env: str
    batch: int
    device: str = "cpu"
    steps_per_second: float = float("nan")
    first_step_seconds: float = float("nan")
    note: str = ""


def main(
    batches: tuple[int, ...] = (1, 16, 256, 1024, 4096, 16384, 65536),
    seconds: float = 3.0,
    tasks: tuple[str, ...] = tuple(TASKS),
    peers: bool = True,
    soak: int = 0,
    threads: int = os.cpu_count() or 1,
    out: Path = Path("runs/throughput"),
) -> None:
    """Measures throughput, prints the table, and writes throughput.csv and throughput.png.

    Args:
        batches: batch sizes at which BallbotStabilize-v0 is measured, in machine code and in eager torch.
        seconds: how long each measurement runs, after its first step.
        tasks: which other tasks are measured at 16,384, in machine code.
        peers: also measure EnvPool and Gymnasium's MuJoCo envs.
        soak: if not 0, as many steps are taken at 16,384 and the growth of the process's memory is reported.
        threads: of torch and EnvPool. On a machine that others use too, fewer than its cores may be much faster: every
            operation waits for the slowest thread.
        out: folder of the results.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for measure, args in _plan(batches, tasks, peers, soak):
        # a new process for each, so that none inherits another's threads, caches or memory
        context = get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=context, initializer=_use_threads, initargs=(threads,)) as pool:
            row = pool.submit(_guarded, measure, args, seconds).result()
        rows.append(row)
        print(
            f"{row.what:28} {row.env:28} {row.batch:6} {row.device:5} {row.steps_per_second:14,.0f} steps/s"
            f" {row.first_step_seconds:7.2f} s to the first step  {row.note}",
            flush=True,
        )
        files.write_csv(out / "throughput.csv", [asdict(row) for row in rows])
    _plot(rows, out / "throughput.png")
    print(f"written: {out / 'throughput.csv'}, {out / 'throughput.png'}")


def _plan(batches: tuple[int, ...], tasks: tuple[str, ...], peers: bool, soak: int) -> list[tuple[Callable, tuple]]:
    import torch

    plan: list[tuple[Callable, tuple]] = [(raw, (physics,)) for physics in _RAW]
    plan += [(single, (physics,)) for physics in _RAW]
    if peers:
        plan += [(envpool, ("InvertedPendulum-v4", count)) for count in (16, 256, 1024)]
        plan += [(envpool, ("InvertedDoublePendulum-v4", 256))]
        plan += [(mujoco, (name, 1)) for name in ("InvertedPendulum-v5", "InvertedDoublePendulum-v5")]
    for device in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        fast = "native" if device == "cpu" else "compiled"
        plan += [(batched, ("stabilize", count, device, mode)) for mode in ("eager", fast) for count in batches]
        plan += [(batched, (task, 16384, device, fast)) for task in tasks if task != "stabilize"]
        if soak:
            plan.append((batched, ("stabilize", 16384, device, fast, soak)))
    return plan


def _use_threads(threads: int) -> None:
    import torch

    torch.set_num_threads(threads)


def _guarded(measure: Callable[..., Row], args: tuple, seconds: float) -> Row:
    try:
        return measure(*args, seconds=seconds)
    except ImportError as error:
        return Row(measure.__name__, str(args[0]), args[1], note=f"not installed: {error}")


def raw(physics: str, seconds: float) -> Row:
    """What an engine itself needs for a control step: forces in, its steps of the default length, joint states out."""
    loop, _, steps = _episode(physics)
    return _timed(Row(f"raw loop, {physics}", "paper", 1), loop, seconds, steps)


def single(physics: str, seconds: float) -> Row:
    """One BallbotEnv, and its share of its engine's raw speed, in turns with that loop."""
    loop, episode, steps = _episode(physics)
    row = _timed(Row(f"BallbotEnv, {physics}", TASKS["stabilize"].id, 1), episode, seconds, steps)
    shares = [_seconds(loop) / _seconds(episode) for _ in range(_TURNS)]
    row.note = f"{np.median(shares):.1%} of the raw loop, median of {_TURNS} turns, of processor time"
    return row


def _episode(physics: str) -> tuple[Callable[[], None], Callable[[], None], int]:
    """The start and the forces of an episode in the engine alone, that episode in BallbotEnv, and its steps."""
    env = BallbotEnv("stabilize", physics=physics)
    actions: list[np.ndarray] = []

    def episode() -> None:
        env.reset(seed=_UPRIGHT)
        for action in actions:
            env.step(action)

    seen, info = env.reset(seed=_UPRIGHT)
    start, forces, ended = tuple(info["state"].tolist()), [], False
    while not ended:
        actions.append(np.clip(_GAIN @ seen, -1, 1).astype(np.float32))
        seen, _, terminated, truncated, info = env.step(actions[-1])
        forces.append(tuple(info["force"].tolist()))
        ended = terminated or truncated
    until = time.perf_counter() + 1.0
    while time.perf_counter() < until:  # until machine code is made, if it is not in the cache
        episode()
    simulator: Any = env._simulator
    step = _RAW[physics](simulator)

    def loop() -> None:
        simulator.reset(start)
        for force in forces:
            step(force)

    return loop, episode, len(forces)


def _raw_bullet(simulator: Any) -> Callable[[tuple[float, float]], object]:
    bullet, client, robot, joints = simulator._bullet, simulator._client, simulator._robot, simulator._joints
    hold, advance, states = bullet.setJointMotorControlArray, bullet.stepSimulation, bullet.getJointStates
    moved, kind, zero = joints[:2], bullet.TORQUE_CONTROL, (0.0, 0.0)

    def step(force: tuple[float, float]) -> object:
        hold(robot, moved, kind, zero, zero, force, zero, zero, client)
        advance(client)
        return states(robot, joints, client)

    return step


def _raw_mujoco(simulator: Any) -> Callable[[tuple[float, float]], object]:
    model, data, substeps, advance = simulator._model, simulator._data, simulator._substeps, import_mujoco().mj_step
    positions, velocities, pushed = data.qpos, data.qvel, data.qfrc_applied

    def step(force: tuple[float, float]) -> object:
        pushed[0], pushed[1] = force
        advance(model, data, substeps)
        return positions.tolist(), velocities.tolist()

    return step


_RAW = {"bullet": _raw_bullet, "mujoco": _raw_mujoco, "rk4": lambda simulator: simulator.step}


def _seconds(work: Callable[[], object]) -> float:
    """Time of the processor: what others do meanwhile does not count."""
    start = time.process_time()
    work()
    return time.process_time() - start


def batched(task: str, count: int, device: str, mode: str, soak: int = 0, *, seconds: float) -> Row:
    """BallbotVectorEnv, NumPy in and out; with `soak`, that many steps, and what the process grew by."""
    kwargs: dict[str, Any] = (
        {"engine": "native"} if mode == "native" else {"engine": "torch", "compile": mode == "compiled"}
    )
    start = time.perf_counter()
    env = gymnasium.make_vec(TASKS[task].id, num_envs=count, device=device, **kwargs)
    env.reset(seed=0)
    making = time.perf_counter() - start
    row = Row(f"BallbotVectorEnv, {mode}", TASKS[task].id, count, device)
    rng = np.random.default_rng(0)
    actions = iter(_forever([rng.uniform(-1, 1, (count, 2)).astype(np.float32) for _ in range(8)]))
    row = _timed(row, lambda: env.step(next(actions)), seconds)
    row.first_step_seconds += making  # machine code is made with the env
    if soak:
        before = _resident()
        for _ in range(soak // count):
            env.step(next(actions))
        row.what = "soak"
        row.note = f"{soak:.0e} steps, resident memory {before:.1f} -> {_resident():.1f} MiB"
    return row


def envpool(name: str, count: int, seconds: float) -> Row:
    """EnvPool's MuJoCo env."""
    import envpool
    import torch

    env = envpool.make_gymnasium(name, num_envs=count, num_threads=torch.get_num_threads())
    env.reset()
    rng = np.random.default_rng(0)
    actions = iter(_forever([rng.uniform(-1, 1, (count, 1)) for _ in range(8)]))
    return _timed(Row("EnvPool", name, count), lambda: env.step(next(actions)), seconds)


def mujoco(name: str, count: int, seconds: float) -> Row:
    """Gymnasium's MuJoCo env, single."""
    if importlib.util.find_spec("mujoco") is None:
        raise ImportError("mujoco")
    env = gymnasium.make(name)
    env.reset(seed=0)
    actions = iter(_forever(np.random.default_rng(0).uniform(-1, 1, (1000, 1))))

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    return _timed(Row("Gymnasium MuJoCo", name, count), step, seconds)


def _timed(row: Row, step: Callable[[], object], seconds: float, steps: int = 1) -> Row:
    """The row with the speed of step. One call takes `steps` control steps."""
    start = time.perf_counter()
    step()
    row.first_step_seconds = time.perf_counter() - start
    for _ in range(3):
        step()
    taken, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        for _ in range(10):
            step()
        taken += 10 * steps
    row.steps_per_second = taken * row.batch / elapsed
    return row


def _forever(items: object) -> object:
    while True:
        yield from items


def _resident() -> float:
    """Memory of this process, MiB: what is resident now, or where the system does not say, its peak."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 2**20
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def _plot(rows: list[Row], path: Path) -> None:
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    axes.set_prop_cycle(color=colormaps["tab20"](np.arange(20)))  # the default has fewer colours than there are curves
    curves: dict[str, list[Row]] = {}
    for row in rows:
        if row.what != "soak" and row.steps_per_second > 0:
            curves.setdefault(f"{row.what}, {row.env}" + (f", {row.device}" if row.device != "cpu" else ""), []).append(
                row
            )
    for label, points in curves.items():
        axes.loglog([p.batch for p in points], [p.steps_per_second for p in points], "o-", label=label, ms=4)
    axes.set(xlabel="environments in the batch", ylabel="control steps per second")
    axes.grid(which="major", alpha=0.3)
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    tyro.cli(main)
