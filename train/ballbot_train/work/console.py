"""What every command shares: the console, its progress bars and tables, and checks of what was typed.

Names and messages that come from files are data, and stay text in a terminal and in Markdown. The templates of the report
escape HTML, `files.write_csv` what a spreadsheet takes for a formula.
"""

import sys
import threading
import time
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, Literal, cast

try:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Table
    from rich.text import Text
except ModuleNotFoundError as error:
    from ballbot_gym.lazy import missing  # which brings NumPy along: `ballbot --help` needs none

    raise missing(__name__, error.name) from error

Physics = Literal["bullet", "mujoco", "rk4"]
"""What options called --physics take."""

RobotName = str
"""What options called --robot take: names in `ROBOTS`, among them those that the command line registers first."""

_MARKDOWN = str.maketrans({sign: f"&#{ord(sign)};" for sign in "&<>|{}`\\*"} | {"\n": " ", "\r": " "})


def printable(text: str) -> str:
    """Text without control characters, which could rewrite the screen or turn the writing around; they are spelt out."""
    return "".join(
        sign if sign in "\n\t" or unicodedata.category(sign) not in ("Cc", "Cf", "Cs") else ascii(sign)[1:-1]
        for sign in text
    )


def _markdown_text(text: str) -> str:
    """Text as Markdown shows it in a table or a line: no markup, link, HTML or expression of MDX."""
    return printable(text.translate(_MARKDOWN)).replace("](", "]&#40;")


class PlainConsole(Console):
    """A console that prints text as it is: no markup, no emoji, no control characters."""

    def __init__(self, **options: Any):
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


_IS_NOTEBOOK = Console().is_jupyter

# A file or pipe has no width of its own: give it one that holds the widest table. Notebooks get lines of text as well: bars
# need widgets there, and FORCE_COLOR, which kernels set, does not make them terminals.
console = PlainConsole(
    width=None if sys.stdout.isatty() else 160, force_jupyter=False, force_terminal=False if _IS_NOTEBOOK else None
)


LINE_SECONDS = 10.0
"""How often progress is printed into a file or a pipe."""
LATE_SECONDS = 2.0
"""After how long bars show that come late."""


class _SpeedColumn(ProgressColumn):
    """Steps per second of late."""

    def render(self, task: Task) -> Text:
        return Text(_speed(task), style="progress.data.speed")


def _speed(task: Task) -> str:
    """Steps per second, empty before there are any."""
    return f"{task.speed:.3g}/s" if task.speed else ""


class _LineProgress(Progress):
    """Progress for a file, a pipe or a notebook, which cannot show a bar: now and then a line per bar that is not full."""

    def start(self) -> None:
        super().start()
        threading.Thread(target=self._print_lines, daemon=True).start()

    def stop(self) -> None:
        if _IS_NOTEBOOK:
            self.live.stop()  # alone: the full bar is not shown, and rich would end its line
        else:
            super().stop()

    def _print_lines(self) -> None:
        while not time.sleep(LINE_SECONDS) and self.live.is_started:
            for task in self.tasks:
                if not task.finished:
                    elapsed = timedelta(seconds=int(task.elapsed or 0))
                    speed = f", {_speed(task)}" if task.speed else ""
                    self.console.print(
                        f"{elapsed} {task.description}: {task.completed:.0f} of {task.total or 0:.0f}{speed}"
                    )


def physics_or_default(physics: Physics | None, robot: str = "paper") -> Physics:
    """The physics that was typed; else the default for a robot by name, with a line if it needs one.

    Raises:
        ImportError: it is not installed; the message says how to get it.
    """
    from ballbot_gym.engines import checked_physics, default_physics
    from ballbot_gym.robot import named_robot

    if physics is not None:
        return cast(Physics, checked_physics(physics))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        chosen = default_physics(named_robot(robot))
    for warning in caught:
        console.print(str(warning.message), soft_wrap=True)
    return cast(Physics, chosen)


def progress_bar() -> Progress:
    """A bar per task: description, share, times. Where output is no terminal, a line per task now and then."""
    columns = (
        TextColumn("{task.description:>10}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        _SpeedColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    kind = Progress if console.is_terminal else _LineProgress
    return kind(*columns, console=console, transient=_IS_NOTEBOOK)  # no full bar below the lines of a notebook


@contextmanager
def progress_bars(totals: Mapping[str, int], late: bool = False) -> Iterator[Callable[[str, int], None]]:
    """Shows a bar for every name while the block runs; the numbers are how many steps each has. Gives what moves one on.

    Late bars show on terminals and in notebooks alone, when the block has taken `LATE_SECONDS`.
    """
    begin, progress = time.monotonic(), progress_bar()
    bars = {name: progress.add_task(printable(name), total=total) for name, total in totals.items()}

    def advance(name: str, count: int) -> None:
        is_due = late and (console.is_terminal or _IS_NOTEBOOK) and time.monotonic() - begin >= LATE_SECONDS
        if is_due and not progress.live.is_started:
            progress.start()
        progress.advance(bars[name], count)

    try:
        if not late:
            progress.start()
        yield advance
    finally:
        if progress.live.is_started:
            progress.stop()


def print_table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Prints a table; the first two columns are words."""
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i < 2 else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The same as a Markdown table; cells are text."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(map(_markdown_text, line))} |\n" for line in lines)


def check_names(kind: str, names: Iterable[str], known: Iterable[str], least: int = 0) -> None:
    """Raises a ValueError for a name that is not registered, for one given twice, and for fewer than `least`, 0 or 1."""
    names, known = list(names), list(known)
    if len(names) < least:
        raise ValueError(f"give at least one {kind}: {', '.join(known)}")
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"unknown {kind} {', '.join(unknown)}; known: {', '.join(known)}")
    repeated = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if repeated:
        raise ValueError(f"{kind} {', '.join(repeated)} is given more than once; give each once")


def check_least(least: int, **numbers: int) -> None:
    """Raises a ValueError that names the first of the numbers that is less than `least`."""
    for name, number in numbers.items():
        if number < least:
            raise ValueError(f"{name} must be at least {least}, not {number}")


def option(name: str, value: Any) -> list[str]:
    """A setting as words of a command."""
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    if isinstance(value, dict):
        return [word for part, each in value.items() for word in option(f"{name}.{part}", each)]
    return [f"--{name}", *map(str, value if isinstance(value, tuple | list) else [value])]
