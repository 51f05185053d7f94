"""Speeds of this checkout and of another one, side by side: each runs in processes of its own, in turns.

    git worktree add ../before COMMIT
    python benchmarks/side_by_side.py ../before

Time is that of the processor, on one thread, so that a busy machine does not spoil it. The first round fills caches and is
not counted.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro

_HERE = Path(__file__).resolve().parent
_ENGINES = ("bullet", "mujoco", "rk4")
_SIZES = (1, 1024, 16384)
_VECTORS: dict[str, dict[str, Any]] = {"native": {}, "torch": {"compile": False}}
_STEPS = 400  # of one environment, between looks at the clock
_GRADIENTS = (256, 20)  # environments, and control steps through which the cost is differentiated
_MADE = "import gymnasium, ballbot_gym; env = gymnasium.make{}; env.reset(seed=0); env.step(env.action_space.sample())"
START_UPS = {
    "start-up: import": "import ballbot_gym",
    "start-up: one environment, PyBullet": _MADE.format("('BallbotStabilize-v0')"),
    "start-up: 1,024 environments in machine code": _MADE.format("_vec('BallbotStabilize-v0', num_envs=1024)"),
}
"""What whole processes do."""


def main(other: Path, /, rounds: int = 9, out: Path = Path("runs/side_by_side")) -> None:
    """Measures both, prints medians, and writes side_by_side.csv.

    Args:
        other: another checkout, whose code this Python can run.
        rounds: how often each is measured.
        out: folder of the result.
    """
    from ballbot_gym import files  # here, because the other checkout's processes import this file too

    checkouts = {"before": other.resolve(), "now": _HERE.parent}
    figures: dict[str, dict[str, list[float]]] = {}
    for turn in range(rounds + 1):
        for which in sorted(checkouts, reverse=bool(turn % 2)):
            found = {name: _seconds(checkouts[which], code) for name, code in START_UPS.items()}
            found |= json.loads(_run(checkouts[which], "import side_by_side; side_by_side.measure()"))
            for name, value in found.items():
                if turn:
                    figures.setdefault(name, {}).setdefault(which, []).append(value)
    rows = []
    for name, values in figures.items():
        whole = name in START_UPS
        pairs = zip(values["now"], values["before"], strict=True)
        ratios = sorted(before / now if whole else now / before for now, before in pairs)
        before, now = (statistics.median(values[which]) for which in ("before", "now"))
        row: dict[str, str | float] = {"what": name, "unit": "s" if whole else "steps/s"}
        row |= {"before": round(before, 2 if whole else 0), "now": round(now, 2 if whole else 0)}
        row |= {"ratio of speeds": round(statistics.median(ratios), 2)}
        row |= {"least ratio": round(ratios[0], 2), "greatest ratio": round(ratios[-1], 2)}
        rows.append(row)
        print(*row.values(), sep=", ", flush=True)
    print(f"written: {files.write_csv(out / 'side_by_side.csv', rows)}")


def _run(checkout: Path, code: str) -> str:
    """What a process prints that runs code of a checkout."""
    path = os.pathsep.join(map(str, (_HERE, checkout, checkout / "baselines", checkout / "train")))
    world = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    world.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-c", code]  # which imports from its folder first
    return subprocess.run(command, cwd=checkout, env=world, stdout=subprocess.PIPE, text=True, check=True).stdout


def _seconds(checkout: Path, code: str) -> float:
    """Processor time of such a process, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    _run(checkout, code)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure() -> None:
    """Prints control steps per second by name, as JSON."""
    print(json.dumps(dict(_measured())))


def _measured() -> Iterator[tuple[str, float]]:
    import gymnasium

    import ballbot_gym

    assert Path(ballbot_gym.__file__).is_relative_to(Path.cwd()), "another checkout is imported"
    for physics in _ENGINES:
        env = gymnasium.make("BallbotStabilize-v0", physics=physics).unwrapped
        yield f"1 environment, {physics}", _speed(lambda env=env: _episodes(env), _STEPS)
    for size in _SIZES:
        for engine, more in _VECTORS.items():
            env = gymnasium.make_vec("BallbotStabilize-v0", num_envs=size, engine=engine, **more)
            env.reset(seed=0)
            actions = np.random.default_rng(0).uniform(-0.3, 0.3, (16, size, 2)).astype(np.float32)
            yield (
                f"{size:,} environments, {engine}",
                _speed(lambda env=env, actions=actions: [env.step(each) for each in actions], 16 * size),
            )
    yield f"gradients, {_GRADIENTS[0]} environments", _speed(_gradients(), int(np.prod(_GRADIENTS)))


def _episodes(env: Any) -> None:
    """`_STEPS` control steps with random actions, resets included."""
    env.reset(seed=0)
    for action in np.random.default_rng(0).uniform(-0.3, 0.3, (_STEPS, 2)).astype(np.float32):
        *_, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


def _gradients() -> Callable[[], object]:
    import torch

    try:
        from ballbot_gym.vector.batch import BallbotBatch
    except ImportError:  # until November 2026
        from ballbot_gym.batch import BallbotBatch
    size, steps = _GRADIENTS
    batch = BallbotBatch("stabilize", size, compile=False)

    def backwards() -> None:
        actions = torch.zeros(size, 2, requires_grad=True)
        batch.state = None  # which has gradients
        batch.reset(0)
        sum(batch.step(actions).cost.sum() for _ in range(steps)).backward()

    return backwards


def _speed(work: Callable[[], object], steps: int, seconds: float = 0.3) -> float:
    """Control steps per second of work that takes `steps` of them."""
    work()
    work()
    count, begin = 0, time.process_time()
    while (elapsed := time.process_time() - begin) < seconds:
        work()
        count += steps
    return count / elapsed


if __name__ == "__main__":
    tyro.cli(main)
