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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ballbot_gym import files
from ballbot_train import jobs
from ballbot_train.policy_files import PolicyError, read_description

_MOST_SEEDS = 1000


@dataclass(frozen=True)
class Trained:
    """What the policy of one seed measures in PyBullet on the certified episodes."""

    seed: int
    success: float
    """Share of the episodes."""
    failures: int
    """Episodes that failed."""
    regret_mean: float
    """Mean regret of those that did not."""
    minutes: float
    """Of training, wall time."""


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


def _log_of(out: Path, seed: int) -> Path:
    return out / f"seed-{seed}.log"


def run(
    command_of: Callable[[int], str],
    expected: Mapping[str, Any],
    seeds: Sequence[int],
    out: Path,
    workers: int = 1,
    on_seed: Callable[[int], None] = lambda seed: None,
) -> list[Trained]:
    """Runs what is not finished.

    Args:
        command_of: the command of a seed, with --out and --resume.
        expected: what the record of a finished run must say besides its seed, by name.
        seeds: in this order.
        out: folder of all runs.
        workers: how many run at once, each on one core.
        on_seed: called with a seed when its run is finished.

    Returns:
        What each seed reached.

    Raises:
        ValueError: a run failed, or a folder holds the finished run of something else.
    """
    waiting = [seed for seed in seeds if not _is_finished(folder_of(out, seed), {**expected, "seed": seed})]
    for seed in seeds:
        if seed not in waiting:
            on_seed(seed)
    if failed := _run(command_of, waiting, out, workers, on_seed):
        seed, status = min(failed)
        log = _log_of(out, seed)
        last = next((line for line in reversed(log.read_text(errors="replace").splitlines()) if line.strip()), "")
        raise ValueError(
            f"seeds {', '.join(str(seed) for seed, _ in sorted(failed))} did not finish (exit status {status}: {last}); "
            f"see {log}. The same command goes on with them"
        )
    return [_trained(folder_of(out, seed), seed) for seed in seeds]


def _run(
    command_of: Callable[[int], str], waiting: Sequence[int], out: Path, workers: int, on_seed: Callable[[int], None]
) -> list[tuple[int, int]]:
    """Runs seeds; gives those that failed with their exit status."""

    def one(seed: int) -> int:
        return _start(command_of(seed), _log_of(out, seed)).wait()

    failed = []
    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(one, seed): seed for seed in waiting}
        try:
            for done in as_completed(running):
                if status := done.result():
                    failed.append((running[done], status))
                else:
                    on_seed(running[done])
        except KeyboardInterrupt:  # the terminal has interrupted the runs too, and they save
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return failed


def middle_and_worst(trained: Sequence[Trained]) -> tuple[dict[str, float], dict[str, float]]:
    """Median and worst of the seeds, of each quantity by its name in `Trained`. A regret of no episode counts as infinite."""
    names = ("success", "failures", "regret_mean", "minutes")
    columns = {name: [float(getattr(run, name)) for run in trained] for name in names}
    columns = {name: [math.inf if math.isnan(value) else value for value in values] for name, values in columns.items()}
    worst = {name: (min if name == "success" else max)(values) for name, values in columns.items()}
    return {name: statistics.median(values) for name, values in columns.items()}, worst


_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def _start(command: str, log: Path) -> "subprocess.Popen[bytes]":
    """Starts a command of `ballbot` on one core, with this Python and the packages of this process."""
    words = [sys.executable, "-m", "ballbot_train.cli", *shlex.split(command)[1:]]
    packages = {"PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path if path)}
    environment = os.environ | _ONE_CORE | packages
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        return subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT, env=environment)


def _is_finished(folder: Path, expected: Mapping[str, Any]) -> bool:
    """Whether a folder holds a finished run.

    Raises:
        ValueError: it does, of something else.
    """
    try:
        described = read_description(folder / "policy")
    except PolicyError:
        return False
    if "measured" not in described:
        return False
    held = {name: described["training"].get(name) for name in expected}
    jobs.check_same(held, expected, folder, "a run")
    return True


def _trained(folder: Path, seed: int) -> Trained:
    described = files.read_json(folder / "policy.json")
    measured = described["measured"]
    minutes = described["training_seconds"] / 60
    return Trained(seed, measured["success"], measured["falls"], measured["regret_mean"], minutes)
