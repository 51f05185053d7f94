"""Resolves what the package needs, by wheels alone, for every system and Python that it supports; the registry is asked.

    python release/platforms.py UV   with the path of the program `uv`

Each is resolved alone and with the extras, and with the versions of constraints.txt, as users install it.
"""

import itertools
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent

SYSTEMS = {
    "Linux x86-64": "x86_64-manylinux_2_28",
    "Linux ARM": "aarch64-manylinux_2_28",
    "Windows": "x86_64-pc-windows-msvc",
    "macOS Apple": "aarch64-apple-darwin",
    "macOS Intel": "x86_64-apple-darwin",
}
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
EXTRAS = ("", "baselines", "mujoco", "all")
NO_TORCH = {"macOS Intel"}
"""Systems without a wheel of torch, on which nothing learns."""
_MACOS = "14.0"  # the oldest for which torch has wheels


def resolves(uv: str, system: str, python: str, extra: str) -> str:
    """Resolves one of them; returns why it does not resolve, or ""."""
    command = [uv, "pip", "compile", "--quiet", "--no-build", "--no-header", "--python-platform", SYSTEMS[system]]
    command += ["--python-version", python, "-c", "constraints.txt", "pyproject.toml", "-o", os.devnull]
    if extra:
        command += ["--extra", extra]
    environment = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": _MACOS}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    return done.stderr.strip() if done.returncode else ""


def main() -> None:
    """Resolves all, prints a table, and exits with 1 if one fails."""
    uv, failures = sys.argv[1], []
    print(f"{'':14}{''.join(f'{python:>6}' for python in PYTHONS)}")
    for system, extra in itertools.product(SYSTEMS, EXTRAS):
        if extra == "all" and system in NO_TORCH:
            continue
        reasons = [resolves(uv, system, python, extra) for python in PYTHONS]
        cells = "".join(f"{'no' if reason else 'yes':>6}" for reason in reasons)
        print(f"{system:14}{cells}  {f'[{extra}]' if extra else ''}", flush=True)
        failures += [
            f"{system}, Python {p}, [{extra}]: {reason}" for p, reason in zip(PYTHONS, reasons, strict=True) if reason
        ]
    sys.exit("\n\n".join(failures) or 0)


if __name__ == "__main__":
    main()
