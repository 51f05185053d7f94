"""Soak: millions of control steps and a thousand environments, with the memory that the process takes at start and end.

    python benchmarks/soak.py --steps 1e7 --batched-steps 1e9 --envs 1000

Exit status 1 says that memory grew by more than `--growth` MiB in one of the parts.
"""

import argparse
import gc
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

_grown: list[str] = []


def memory() -> float:
    """Memory that the process takes now, MiB."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


@contextmanager
def watched(name: str, count: float, growth: float) -> Iterator[None]:
    """Prints time and memory of a block that does `count` things."""
    before, start = memory(), time.monotonic()
    yield
    seconds, after = time.monotonic() - start, memory()
    print(f"{name}: {count:,.0f} in {seconds:.0f} s, {before:.0f} MiB before, {after:.0f} MiB after", flush=True)
    if after - before > growth:
        _grown.append(f"{name} by {after - before:.0f} MiB")


def soak_env(physics: str, steps: int, growth: float) -> None:
    """Random actions in one environment, episode after episode."""
    from ballbot_gym import BallbotEnv

    env, rng = BallbotEnv("turn", physics=physics), np.random.default_rng(0)
    env.reset(seed=0)
    with watched(f"{physics}, control steps", steps, growth):
        for _ in range(steps):
            observation, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 2))
            if not (np.isfinite(observation).all() and np.isfinite(reward)):
                sys.exit(f"{physics}: an observation or a reward is not finite")
            if terminated or truncated:
                env.reset()
    env.close()


def soak_batch(steps: int, envs: int, growth: float) -> None:
    """Random actions in a batch of environments."""
    from ballbot_gym.vector import BallbotVectorEnv

    vector, rng = BallbotVectorEnv(envs, "turn", compile=False), np.random.default_rng(0)
    vector.reset(seed=0)
    actions = rng.uniform(-1, 1, (16, envs, 2)).astype(np.float32)
    for i in range(20):  # torch takes its buffers
        vector.step(actions[i % 16])
    rounds = max(1, steps // envs)
    with watched(f"batch of {envs}, control steps", rounds * envs, growth):
        for i in range(rounds):
            observation, reward, *_ = vector.step(actions[i % 16])
            if i % 1000 == 0 and not (np.isfinite(observation).all() and np.isfinite(reward).all()):
                sys.exit("batch: an observation or a reward is not finite")
    vector.close()


def soak_envs(envs: int, growth: float) -> None:
    """Makes and closes environments one after the other."""
    from ballbot_gym import BallbotEnv

    def once(i: int) -> None:
        env = BallbotEnv("stabilize", physics="bullet")
        env.reset(seed=i)
        env.step([0.0, 0.0])
        env.close()

    for i in range(20):  # PyBullet takes its buffers
        once(i)
    with watched("environments made and closed", envs, growth):
        for i in range(envs):
            once(i)


def main() -> None:
    parser = argparse.ArgumentParser(description="Millions of steps and a thousand environments.")
    parser.add_argument("--steps", type=float, default=1e7, help="control steps in PyBullet")
    parser.add_argument("--batched-steps", type=float, default=1e9, help="control steps of all environments of a batch")
    parser.add_argument("--batch", type=int, default=4096, help="environments of the batch")
    parser.add_argument("--envs", type=int, default=1000, help="environments made and closed")
    parser.add_argument("--growth", type=float, default=20.0, help="MiB by which a part may grow")
    options = parser.parse_args()
    soak_envs(options.envs, options.growth)
    soak_env("bullet", int(options.steps), options.growth)
    soak_batch(int(options.batched_steps), options.batch, options.growth)
    if _grown:
        sys.exit(f"memory grew: {', '.join(_grown)}")


if __name__ == "__main__":
    main()
