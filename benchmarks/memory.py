"""Peak resident memory of what users do, each in a process of its own: importing, one environment, a batch, an optimum.

It needs Linux, whose kernel reports the peak.
"""

import subprocess
import sys
from pathlib import Path

import tyro

from ballbot_gym import files

_ENV = "env = gymnasium.make('BallbotStabilize-v0'); env.reset(seed=0); env.step(env.action_space.sample())"
_BATCH = (
    "batch = BallbotBatch(Stabilize(), {count}, compile=False); batch.reset(0); batch.step(torch.zeros({count}, 2))"
)
_OPTIMUM = "task = make_task({task!r}); find_optimum(task, default_params(), *episode(task, default_params(), 0))"
_FROM = {
    "env": "import gymnasium, ballbot_gym",
    "batch": "import torch; from ballbot_gym import BallbotBatch, Stabilize",
    "optimum": "from ballbot_baselines import find_optimum; from ballbot_gym.certified.cache import episode; "
    "from ballbot_gym.env import make_task; from ballbot_gym import default_params",
}
# the kernel's own peak of this program; getrusage's is that of the process that started it, where that one was larger
_REPORT = """
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
PROGRAMS = {
    "Python alone": "",
    "import ballbot_gym": "import ballbot_gym",
    "import torch": "import torch",
    "one environment, PyBullet": f"{_FROM['env']}; {_ENV}",
    "batch of 1,024, a step": f"{_FROM['batch']}; {_BATCH.format(count=1024)}",
    "batch of 65,536, a step": f"{_FROM['batch']}; {_BATCH.format(count=65536)}",
    "find_optimum, Stabilize": f"{_FROM['optimum']}; {_OPTIMUM.format(task='stabilize')}",
    "find_optimum, Weave": f"{_FROM['optimum']}; {_OPTIMUM.format(task='weave')}",
}
"""What is measured, and the program that does it."""


def peak(program: str) -> float:
    """Peak resident memory of a Python process that runs a program, MiB."""
    run = subprocess.run([sys.executable, "-c", program + _REPORT], capture_output=True, text=True, check=True)
    return int(run.stdout.split()[-1]) / 2**10


def main(out: Path = Path("runs/memory")) -> None:
    """Measures, and writes memory.csv.

    Args:
        out: folder of the result.
    """
    rows = []
    for what, program in PROGRAMS.items():
        rows.append({"what": what, "peak_mib": round(peak(program), 1)})
        print(f"{what:30} {rows[-1]['peak_mib']:8.1f} MiB", flush=True)
    files.write_csv(out / "memory.csv", rows)


if __name__ == "__main__":
    tyro.cli(main)
