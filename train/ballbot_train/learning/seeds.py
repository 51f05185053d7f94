"""The same training on several seeds, as a queue of one-core runs in processes of their own.

Each seed has a run folder of its own, OUT/seed-K, and prints into OUT/seed-K.log. A queue that is killed goes on when it is
started again: finished runs stay, and interrupted ones resume.

On a Ray cluster each run works in an empty folder of its worker, and what it writes comes back every half minute. So a run
whose node dies goes on elsewhere from its last checkpoint.
"""

import math
import os
import shlex
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ballbot_gym import files
from ballbot_train import jobs
from ballbot_train.executors import WorkerError, Workers, open_pool
from ballbot_train.policy_files import PolicyError, read_description

_MOST_SEEDS = 1000
_SEND_SECONDS = 30.0  # how often a worker of a cluster sends what a run has written


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
    workers: int | Workers,
    on_seed: Callable[[int], None] = lambda seed: None,
    inputs: Sequence[Path] = (),
) -> list[Trained]:
    """Runs what is not finished.

    Args:
        command_of: the command of a seed, with --out and --resume.
        expected: what the record of a finished run must say besides its seed, by name.
        seeds: in this order.
        out: folder of all runs.
        workers: how many run at once, each on one core, or `Workers`; one by default.
        on_seed: called with a seed when its run is finished.
        inputs: files and folders that a run reads. A cluster gets them, under the same relative paths.

    Returns:
        What each seed reached.

    Raises:
        ValueError: a run failed, or a folder holds the finished run of something else.
    """
    waiting = [seed for seed in seeds if not _is_finished(folder_of(out, seed), {**expected, "seed": seed})]
    for seed in seeds:
        if seed not in waiting:
            on_seed(seed)
    workers = Workers.of(workers)
    if workers.ray is not None:
        failed = _run_on_cluster(command_of, waiting, out, workers, on_seed, inputs)
    else:
        failed = _run_here(command_of, waiting, out, workers.workers or 1, on_seed)
    if failed:
        seed, status = min(failed)
        log = _log_of(out, seed)
        last = next((line for line in reversed(log.read_text(errors="replace").splitlines()) if line.strip()), "")
        raise ValueError(
            f"seeds {', '.join(str(seed) for seed, _ in sorted(failed))} did not finish (exit status {status}: {last}); "
            f"see {log}. The same command goes on with them"
        )
    return [_trained(folder_of(out, seed), seed) for seed in seeds]


def _run_here(
    command_of: Callable[[int], str], waiting: Sequence[int], out: Path, workers: int, on_seed: Callable[[int], None]
) -> list[tuple[int, int]]:
    """Runs seeds on this machine; gives those that failed with their exit status."""

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


def _run_on_cluster(
    command_of: Callable[[int], str],
    waiting: Sequence[int],
    out: Path,
    workers: Workers,
    on_seed: Callable[[int], None],
    inputs: Sequence[Path],
) -> list[tuple[int, int]]:
    """As `_run_here`, on a Ray cluster."""
    for path in (out, *inputs):
        if path.is_absolute() or ".." in path.parts:
            raise ValueError(
                f"with --ray give a path below the working folder, not {path}: it is the same on the workers, which have "
                "folders of their own"
            )
    given, failed, queue = _packed(inputs), [], list(reversed(waiting))
    deaths: Counter[int] = Counter()

    with open_pool(workers, per_core=1) as pool:
        running = 0
        while queue or running:
            while queue and pool.has_room():
                seed = queue.pop()
                held = _packed([folder_of(out, seed), _log_of(out, seed)])
                pool.start(seed, _train_away, command_of(seed), given | held, out, _log_of(out, seed))
                running += 1
            for event in pool.events():
                assert isinstance(event.key, int)
                if event.kind == "yielded":
                    status, made = event.value
                    for name, content in made.items():
                        files.write(out / name, content)
                    if status == 0:
                        on_seed(event.key)
                    elif status is not None:
                        failed.append((event.key, status))
                    continue
                running -= 1
                if event.kind != "ended":
                    deaths[event.key] += event.kind == "worker died"
                    if deaths[event.key] > 1:
                        raise WorkerError(
                            f"the worker of seed {event.key} died twice, most likely out of memory; the same command goes on"
                        )
                    queue.append(event.key)
    return failed


def _packed(paths: Sequence[Path]) -> dict[str, bytes]:
    """The files at some paths and in folders there, by their path; hidden ones are locks and temporary files."""
    found = [each for path in paths for each in ([path] if path.is_file() else sorted(path.rglob("*")))]
    return {str(path): path.read_bytes() for path in found if path.is_file() and not path.name.startswith(".")}


def _train_away(
    command: str, given: Mapping[str, bytes], out: Path, log: Path
) -> Iterator[tuple[int | None, dict[str, bytes]]]:
    """Runs a command in an empty folder with the given files.

    Yields:
        The exit status, None while it runs, and the files below `out` that have changed, by their path there.
    """
    with TemporaryDirectory() as name:
        folder = Path(name)
        for path, content in given.items():
            files.write(folder / path, content)
        sent: dict[str, int] = {}
        process = _start(command, folder / log, folder)
        try:
            ended = False
            while not ended:
                try:
                    process.wait(_SEND_SECONDS)
                    ended = True
                except subprocess.TimeoutExpired:
                    pass
                stamps = {
                    str(path.relative_to(folder / out)): path.stat().st_mtime_ns
                    for path in (folder / out).rglob("*")
                    if path.is_file() and not path.name.startswith(".")
                }
                changed = [path for path, stamp in stamps.items() if sent.get(path) != stamp]
                sent = stamps
                yield process.poll() if ended else None, {path: (folder / out / path).read_bytes() for path in changed}
        finally:
            process.kill()


def middle_and_worst(trained: Sequence[Trained]) -> tuple[dict[str, float], dict[str, float]]:
    """Median and worst of the seeds, of each quantity by its name in `Trained`. A regret of no episode counts as infinite."""
    names = ("success", "failures", "regret_mean", "minutes")
    columns = {name: [float(getattr(run, name)) for run in trained] for name in names}
    columns = {name: [math.inf if math.isnan(value) else value for value in values] for name, values in columns.items()}
    worst = {name: (min if name == "success" else max)(values) for name, values in columns.items()}
    return {name: statistics.median(values) for name, values in columns.items()}, worst


_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def _start(command: str, log: Path, folder: Path | None = None) -> "subprocess.Popen[bytes]":
    """Starts a command of `ballbot` on one core, with this Python and the packages of this process, in another folder."""
    words = [sys.executable, "-m", "ballbot_train.cli", *shlex.split(command)[1:]]
    packages = {"PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path if path)}
    environment = os.environ | _ONE_CORE | packages
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        return subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT, env=environment, cwd=folder)


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
