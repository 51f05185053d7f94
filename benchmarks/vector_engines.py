"""Control steps per second of vector environments by batch size: Gymnasium's sync, machine code and torch.

Sync is left out from 1024 envs on, which take it seconds. Every figure is the median of several runs, whose order
alternates. Time is that of the processor, so that a busy machine does not spoil it; run it with OMP_NUM_THREADS=1.
"""

import math
import statistics
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tyro

from ballbot_gym import files
from ballbot_gym.tasks import TASKS


def main(
    task: str = "stabilize",
    sizes: tuple[int, ...] = (1, 2, 4, 8, 16, 33, 64, 128, 256, 1024, 4096, 16384, 65536),
    runs: int = 5,
    seconds: float = 0.5,
    out: Path = Path("runs/vector_engines"),
) -> None:
    """Measures, prints steps per second, and writes vector_engines.csv.

    Args:
        task: name of the task.
        sizes: numbers of envs.
        runs: number of runs; their median is taken.
        seconds: of each run.
        out: folder of the result.
    """
    rows = []
    print(f"{'envs':>5} {'native':>12} {'torch':>12} {'sync':>12}   steps/s, median of {runs} runs")
    for size in sizes:
        kinds: dict[str, dict[str, Any]] = {
            "native": {"engine": "native"},
            "torch": {"engine": "torch", "compile": False},
        }
        if size < 1024:
            kinds |= {"sync": {"vectorization_mode": "sync", "physics": "rk4"}}
        envs = {name: gymnasium.make_vec(TASKS[task].id, num_envs=size, **kind) for name, kind in kinds.items()}
        speeds: dict[str, list[float]] = {name: [] for name in envs}
        for _ in range(runs):
            for name, env in envs.items():
                speeds[name].append(speed(env, seconds))
        medians = {name: statistics.median(values) for name, values in speeds.items()}
        print(f"{size:5}", *(f"{value:12,.0f}" for value in medians.values()), flush=True)
        rows.append({"envs": size, **{name: medians.get(name, math.nan) for name in ("native", "torch", "sync")}})
        for env in envs.values():
            env.close()
    files.write_csv(out / "vector_engines.csv", rows)


def speed(env: gymnasium.vector.VectorEnv, seconds: float) -> float:
    """Control steps per second of all envs together, with random actions, ends of episodes included."""
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (64, env.num_envs, 2)).astype(np.float32)
    count, begin = 0, time.process_time()
    while time.process_time() - begin < seconds:
        for action in actions[count % 64 : count % 64 + 8]:
            env.step(action)
        count += 8
    return count * env.num_envs / (time.process_time() - begin)


if __name__ == "__main__":
    tyro.cli(main)
