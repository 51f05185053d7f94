"""What a result depends on besides its settings: versions of the code and its libraries, and the machine."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

_PACKAGES = ("gymnasium", "numpy", "pybullet", "casadi", "scipy")


def provenance() -> dict[str, object]:
    """Version, commit, Python, libraries, machine and how much it has to do; "none" for what is not there."""
    return {
        "version": _version("ballbot-gym"),
        "commit": _commit_of(Path(__file__)),
        "python": platform.python_version(),
        **{name: _version(name) for name in _PACKAGES},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else "unknown",  # Windows has none
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "none"


def _commit_of(file: Path) -> str:
    """The commit of the checkout that tracks a file, as `git describe --always --dirty` says it.

    "none" where no folder above it is a checkout, where the checkout does not track it (an installed package in somebody
    else's repository), and where git is missing.
    """
    said = ""
    for command in (["ls-files", "--error-unmatch", file.name], ["describe", "--always", "--dirty"]):
        try:
            words = ["git", "-C", str(file.resolve().parent), *command]
            said = subprocess.run(words, capture_output=True, text=True, check=True, timeout=30).stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return "none"
    return said or "none"
