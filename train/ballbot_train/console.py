"""What every command shares: the console, its progress bar and tables, and what a result says about its making."""

import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

# A file or pipe has no width of its own: give it one that holds the widest table.
console = Console(width=None if sys.stdout.isatty() else 160)


def progress_bar() -> Progress:
    """A bar per task: description, share, times."""
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console)


def print_table(title: str, header: list[str], rows: list[list[str]]) -> None:
    """Prints a table; the first two columns are words."""
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < 2 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """The same as a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def check_names(kind: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raises a ValueError for a name that is not registered, and for one that is given twice."""
    names, known = list(names), list(known)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"unknown {kind} {', '.join(unknown)}; known: {', '.join(known)}")
    repeated = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if repeated:
        raise ValueError(f"{kind} {', '.join(repeated)} is given more than once; give each once")


def about() -> dict[str, object]:
    """What a result depends on besides its settings."""
    packages = ("gymnasium", "numpy", "pybullet", "casadi", "scipy")
    return {
        "version": importlib.metadata.version("ballbot-gym"),
        "commit": _commit(),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in packages},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def _commit() -> str:
    """The checkout's commit, or "none" where the package runs without one."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return "none"
    command = ["git", "-C", str(root), "describe", "--always", "--dirty"]
    result = subprocess.run(command, capture_output=True, text=True)
    return result.stdout.strip() or "none"
