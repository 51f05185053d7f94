"""What a result depends on besides its settings: versions of the code and its libraries, and the machine."""

import importlib.metadata
import json
import math
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from ballbot_train import jobs
from ballbot_train.executors import Workers

_PACKAGES = ("gymnasium", "numpy", "pybullet", "casadi", "scipy")


def provenance() -> dict[str, object]:
    """Version, commit, Python, libraries and machine; "none" for what is not there."""
    return {
        "version": _version("ballbot-gym"),
        "commit": commit_of(Path(__file__)),
        "python": platform.python_version(),
        **{name: _version(name) for name in _PACKAGES},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


BUSY = 1.25
"""Load per core from which times are no longer those of the code alone."""

_LOAD_SECONDS = 10.0


def load() -> float:
    """Processes that ran or waited for a core in the last minute; NaN where the system does not say."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):
        return math.nan


def load_facts(starts: Iterable[tuple[float, int]], later: Iterable[float]) -> dict[str, object]:
    """Whether a run was timed on a busy machine, and the loads that say so.

    Args:
        starts: `load()` before every part of the run, which its own workers had not raised, and the number of workers.
        later: `load()` while the run worked and at its end.

    Returns:
        "busy", "load_start" and "load_end", the largest of each; null where the system does not say, and then it is not busy.
    """
    starts, later, limit = list(starts), list(later), BUSY * (os.cpu_count() or 1)
    busy = any(start + workers > limit for start, workers in starts) or any(end > limit for end in later)
    return {"busy": busy, "load_start": _largest(start for start, _ in starts), "load_end": _largest(later)}


def _largest(loads: Iterable[float]) -> float | None:
    return max((round(value, 2) for value in loads if math.isfinite(value)), default=None)


class LoadRecord:
    """The loads during all parts of a run: an interrupted run goes on in another process, perhaps on a quieter machine."""

    def __init__(self, out: Path, workers: int | Workers):
        """Begins a part of the run whose folder is `out`, which `jobs.claim` has locked."""
        self._path = jobs.unfinished(out) / "loads.jsonl"
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._add(load(), Workers.of(workers).here)

    def watched(self, on_progress: Callable[[str, int], None]) -> Callable[[str, int], None]:
        """The function, which then notes the load too, now and then."""

        def call(name: str, count: int) -> None:
            if time.monotonic() - self._noted > _LOAD_SECONDS:
                self._add(load())
            on_progress(name, count)

        return call

    def facts(self) -> dict[str, object]:
        """`load_facts` of all parts of the run, which ends now."""
        self._add(load())
        starts, later = [], []
        for line in self._path.read_text().splitlines():
            try:
                value, workers = json.loads(line)
                (later if workers is None else starts).append(
                    float(value) if workers is None else (float(value), workers)
                )
            except (ValueError, TypeError):
                continue
        return load_facts(starts, later)

    def _add(self, value: float, workers: int | None = None) -> None:
        self._noted = time.monotonic()
        with self._path.open("a") as file:
            file.write("\n" + json.dumps([value, workers]))  # a kill may have left half a line


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def commit_of(file: Path) -> str:
    """The commit of the checkout that tracks a file, as `git describe --always --dirty` says it.

    "none" where no folder above it is a checkout, where the checkout does not track it (an installed package in somebody
    else's repository), and where git is missing.
    """
    file = file.resolve()
    if not any((folder / ".git").exists() for folder in file.parents):
        return "none"
    try:
        _git(file.parent, "ls-files", "--error-unmatch", file.name)
        return _git(file.parent, "describe", "--always", "--dirty") or "none"
    except (OSError, subprocess.SubprocessError):
        return "none"


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.strip()
