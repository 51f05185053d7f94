"""What a result depends on besides its settings: versions of the code and its libraries, and the machine."""

import importlib.metadata
import math
import os
import platform
import subprocess
from pathlib import Path

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


def load() -> float:
    """Processes that ran or waited for a core in the last minute; NaN where the system does not say."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):
        return math.nan


def load_facts(before: float, workers: int | Workers) -> dict[str, object]:
    """Whether a run that ends now was timed on a busy machine, and the loads that say so.

    Args:
        before: `load()` before the run, which its own workers had not raised.
        workers: a number of processes, or `Workers`.

    Returns:
        "busy", "load_start" and "load_end"; loads are null where the system does not say, and then it is not busy.
    """
    after, limit = load(), BUSY * (os.cpu_count() or 1)
    start, end = (round(value, 2) if math.isfinite(value) else None for value in (before, after))
    busy = before + Workers.of(workers).here > limit or after > limit
    return {"busy": busy, "load_start": start, "load_end": end}


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
