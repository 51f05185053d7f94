"""The same training on several seeds, as a queue of one-core runs in processes of their own.

Each seed has a run folder of its own, OUT/seed-K, and prints into OUT/seed-K.log. A queue that is killed goes on when it is
started again: finished runs stay, and interrupted ones resume.
"""

import math
import os
import shlex
import statistics
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from ballbot_gym import files
from ballbot_train import jobs
from ballbot_train.policy_files import PolicyError, read_description

_MOST_SEEDS = 1000


def parse_seeds(text: str) -> tuple[int, ...]:
    """The seeds that "0:5" (0 to 4) or "0,3,7" names.

    Raises:
        ValueError: it names none, or one twice.
    """
    try:
        first, colon, end = text.partition(":")
        seeds = tuple(range(int(first), int(end))) if colon else tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f'seeds must be like "0:5", which is 0 to 4, or "0,3,7", not {text!r}') from None
    if not 1 <= len(seeds) <= _MOST_SEEDS or len(set(seeds)) < len(seeds) or min(seeds) < 0 or max(seeds) >= 2**32:
        raise ValueError(f"seeds must be 1 to {_MOST_SEEDS} different numbers from 0 to {2**32 - 1}, not {text!r}")
    return seeds


def folder_of(out: Path, seed: int) -> Path:
    """The run folder of a seed."""
    return out / f"seed-{seed}"


def run(
    command_of: Callable[[int], str],
    expected: Mapping[str, Any],
    seeds: Sequence[int],
    out: Path,
    workers: int = 1,
    on_seed: Callable[[int], None] = lambda seed: None,
) -> list[dict[str, float]]:
    """Runs what is not finished.

    Args:
        command_of: the command of a seed, with --out and --resume.
        expected: what the record of a finished run must say besides its seed, by name.
        seeds: in this order.
        out: folder of all runs.
        workers: how many run at once, each on one core.
        on_seed: called with a seed when its run is finished.

    Returns:
        What the policy of each seed measures in PyBullet on the certified episodes: "success", their share; "failures";
        "regret_mean", of the others; and "minutes" of training.

    Raises:
        ValueError: a run failed, or a folder holds the finished run of something else.
    """
    failed: dict[int, int] = {}
    with ThreadPoolExecutor(workers) as pool:
        running = {}
        for seed in seeds:
            if _finished(folder_of(out, seed), {**expected, "seed": seed}):
                on_seed(seed)
            else:
                running[pool.submit(_run, command_of(seed), out / f"seed-{seed}.log")] = seed
        try:
            for done in as_completed(running):
                if status := done.result():
                    failed[running[done]] = status
                else:
                    on_seed(running[done])
        except KeyboardInterrupt:  # the terminal has interrupted the runs too, and they save
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    if failed:
        seed = min(failed)
        log = out / f"seed-{seed}.log"
        last = next((line for line in reversed(log.read_text(errors="replace").splitlines()) if line.strip()), "")
        raise ValueError(
            f"seeds {', '.join(map(str, sorted(failed)))} did not finish (exit status {failed[seed]}: {last}); see {log}. "
            "The same command goes on with them"
        )
    return [_measured(files.read_json(folder_of(out, seed) / "policy.json")) for seed in seeds]


def _measured(described: Mapping[str, Any]) -> dict[str, float]:
    measured = described["measured"]
    regret = {"success": measured["success"], "failures": measured["falls"], "regret_mean": measured["regret_mean"]}
    return regret | {"minutes": described["training_seconds"] / 60}


def middle_and_worst(trained: Sequence[Mapping[str, float]]) -> tuple[dict[str, float], dict[str, float]]:
    """Median and worst of the seeds, by name as of `run`. A regret of no episode counts as infinite."""
    columns = {
        name: [math.inf if math.isnan(each[name]) else each[name] for each in trained]
        for name in ("success", "failures", "regret_mean", "minutes")
    }
    worst = {name: (min if name == "success" else max)(values) for name, values in columns.items()}
    return {name: statistics.median(values) for name, values in columns.items()}, worst


_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def _run(command: str, log: Path) -> int:
    """Runs a command of `ballbot` on one core, with this Python and the packages of this process; its exit status."""
    words = [sys.executable, "-m", "ballbot_train.cli", *shlex.split(command)[1:]]
    packages = {"PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path if path)}
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        return subprocess.Popen(
            words, stdout=file, stderr=subprocess.STDOUT, env=os.environ | _ONE_CORE | packages
        ).wait()


def _finished(folder: Path, expected: Mapping[str, Any]) -> bool:
    """Whether a folder holds a finished run; raises a ValueError where that is one of something else."""
    try:
        described = read_description(folder / "policy")
    except PolicyError:
        return False
    if "measured" not in described:
        return False
    jobs.check_same({name: described["training"].get(name) for name in expected}, expected, folder, "a run")
    return True
