"""Control steps per second of vector environments by batch size: Gymnasium's sync, the loop and torch.

`ballbot_gym.vector.LOOP_BELOW` follows from this table. Every figure is the median of several runs, whose order alternates.
Time is that of the processor, so that a busy machine does not spoil it; run it with OMP_NUM_THREADS=1.
"""

import argparse
import statistics
import time

import gymnasium
import numpy as np

from ballbot_gym.tasks import TASKS

SIZES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=TASKS, default="stabilize")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5, help="of each run")
    args = parser.parse_args()
    print(f"{'envs':>5} {'sync':>12} {'loop':>12} {'torch':>12}   steps/s, median of {args.runs} runs")
    for size in args.sizes:
        sync = {"vectorization_mode": "sync", "physics": "rk4"}
        kinds = {"sync": sync, "loop": {"engine": "loop"}, "torch": {"engine": "torch", "compile": False}}
        envs = {name: gymnasium.make_vec(TASKS[args.task].id, num_envs=size, **kind) for name, kind in kinds.items()}
        speeds: dict[str, list[float]] = {name: [] for name in envs}
        for _ in range(args.runs):
            for name, env in envs.items():
                speeds[name].append(speed(env, args.seconds))
        medians = (f"{statistics.median(values):12,.0f}" for values in speeds.values())
        print(f"{size:5}", *medians, flush=True)
        for env in envs.values():
            env.close()


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
    main()
