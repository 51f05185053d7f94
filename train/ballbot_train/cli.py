"""The command line `ballbot`, whose commands are in `ballbot_train.commands`.

`ballbot --help` imports no command; any other call imports only its own.
"""

import ast
import difflib
import logging
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

try:
    from rich.table import Table

    from ballbot_train.work.console import PlainConsole, console, print_table
except ModuleNotFoundError as error:
    from ballbot_gym.lazy import missing

    sys.exit(str(missing("ballbot", error.name, "train")))

from ballbot_train.commands import COMMANDS, GROUPS, MOVED, RESUMABLE

_DESCRIPTION = "Ballbot control, measured by its regret against the best that physics allows."
_LEAST_WIDTH = 60
_NO_READER = 141  # the exit status of a process that the signal SIGPIPE ended
_NAMING = ("", "--task", "--tasks", "--robot", "--made-for", "--physics")
"""Flags that are followed by names; "" stands for the place before the first flag."""
_MODULE_AND_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[a-z][a-z0-9_]*")


def main() -> None:
    """Runs the command line; errors a user can cause end with one line and exit status 1, misused commands with 2.

    It ends silently when the reader of its output has closed the pipe, for example behind `| head`.
    """
    try:
        try:
            status = _run(sys.argv[1:])
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains when it ends
        status = _NO_READER
    sys.exit(status)


def _run(arguments: list[str]) -> int:
    """Runs what was typed after `ballbot`, and gives the exit status."""
    errors = PlainConsole(stderr=True, highlight=False, soft_wrap=True)
    if not arguments:
        _print_help()
        return 2
    command, *options = arguments
    if command in ("-h", "--help"):
        _print_help()
        return 0
    if command == "--version":
        from importlib.metadata import version

        sys.stdout.write(f"ballbot {version('ballbot-gym')}\n")
        return 0
    if command in MOVED:
        errors.print(MOVED[command], style="red")
        return 2
    if command not in COMMANDS:
        close = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"the commands are {', '.join(COMMANDS)}"
        errors.print(f"ballbot: no command {command!r}; {hint}", style="red")
        return 2
    try:
        with _terminated_as_interrupted() as terminated:
            _call(command, options)
    except KeyboardInterrupt:
        errors.print(f"interrupted; {_again(command, options)}")
        return 128 + (signal.SIGTERM if terminated else signal.SIGINT)
    except ModuleNotFoundError as error:
        from ballbot_gym.lazy import install

        hint = (
            ""
            if "pip install" in str(error) or not _imported_by_us(error)
            else f"; the commands need {install('train')}"
        )
        errors.print(f"ballbot: {error}{hint}", style="red")
        return 1
    except (ValueError, TypeError, ImportError, OSError, *_expected()) as error:
        if isinstance(error, BrokenPipeError):
            print(flush=True)  # raises it again if it was that of what we print, and not that of a worker
        errors.print(f"ballbot: {error}", style="red")
        return 1
    return 0


@contextmanager
def _terminated_as_interrupted() -> Iterator[list[int]]:
    """SIGTERM, as schedulers and `timeout` send it, interrupts as Ctrl-C does, so that nothing half-written is left behind.

    Yields a list that is not empty after a SIGTERM.
    """
    received: list[int] = []

    def on_signal(number: int, frame: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if ours:
        signal.signal(signal.SIGTERM, on_signal)
    try:
        yield received
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _call(command: str, options: list[str]) -> Any:
    import tyro

    from ballbot_gym.lazy import load

    # This must happen before torch, NumPy or CasADi are imported, here and in child processes. These networks and batches are
    # too small for a second thread, and on a busy machine threads wait for each other at every operation.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _announce_compilation()
    options = _registered(options)
    function = load(COMMANDS[command])
    # the options of some commands depend on what is typed, so these commands parse it themselves
    if parse := getattr(sys.modules[function.__module__], "command_line", None):
        return parse(options)
    return tyro.cli(function, args=options, prog=f"ballbot {command}")


class _Lines(logging.Handler):
    """Prints what is logged."""

    def emit(self, record: logging.LogRecord) -> None:
        console.print(record.getMessage(), soft_wrap=True)


def _announce_compilation() -> None:
    """Says what is compiled: the first call of a task takes long, and no bar moves meanwhile."""
    log = logging.getLogger("ballbot_gym.machine_code.libraries")
    if not any(isinstance(handler, _Lines) for handler in log.handlers):
        log.addHandler(_Lines(logging.INFO))
        log.setLevel(logging.INFO)
        log.propagate = False


def _registered(options: list[str]) -> list[str]:
    """The options with the names of tasks, robots and physics that they bring."""
    named, flag = [], ""
    for option in options:
        given, equals, word = option.partition("=") if option.startswith("--") else ("", "", option)
        flag = given or flag
        named.append(f"{given}{equals}{_registered_word(flag, word) if word and flag in _NAMING else word}")
    return named


def _registered_word(flag: str, word: str) -> str:
    """The name that a word after a flag means: of MODULE:NAME the module is imported, from this folder too, a path after
    --robot is registered under its file's name, and other names become ours: the id of a task or of its counterpart, a task
    with hyphens, and "pybullet".
    """
    from ballbot_gym.engines import PHYSICS_ALIASES
    from ballbot_gym.registry import named_task
    from ballbot_gym.robot import short_name

    if _MODULE_AND_NAME.fullmatch(word):
        if os.getcwd() not in sys.path:
            sys.path.append(os.getcwd())  # last, so that no file here takes the place of a library
        return short_name(word)
    if flag == "--robot" and word.endswith((".urdf", ".xml", ".mjcf")):
        return _registered_file(Path(word))
    if flag == "--physics":
        return PHYSICS_ALIASES.get(word, word)
    try:
        return named_task(word)
    except ValueError:  # it names something else
        return word


def _registered_file(path: Path) -> str:
    """The name under which the robot of a URDF or an MJCF was registered. The numbers that MuJoCo read are printed.

    Robots whose wheels and centre of mass may be anywhere have the episodes of "omni", which are gentle.
    """
    from ballbot_gym.robot import ROBOTS, GeneralOmni, read_urdf, register_robot

    name = re.sub("[^a-z0-9_]", "_", path.stem.lower())
    name = name if name[:1].isalpha() else f"robot_{name}"
    if path.suffix == ".urdf":
        robot = read_urdf(path)
    else:
        from ballbot_gym.engines.mjcf import MujocoModel

        robot = MujocoModel(path).robot
        rows = [(key, f"{value:.5g}") for key, value in _numbers(asdict(robot))]
        print_table(f"{path}, as MuJoCo reads it, in SI units", ("number", "value"), rows)
    register_robot(name, robot, ROBOTS["omni"].fields if isinstance(robot, GeneralOmni) else None)
    return name


def _numbers(given: dict[str, Any], outer: str = "") -> Iterator[tuple[str, float]]:
    for key, value in given.items():
        yield from _numbers(value, f"{key}.") if isinstance(value, dict) else [(f"{outer}{key}", value)]


def _imported_by_us(error: BaseException) -> bool:
    """Whether the import that failed is in a file of ours, and not in one of the user's or of a library."""
    while error.__cause__ is not None:
        error = error.__cause__
    modules = [str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    *_, last = [name for name in modules if not name.startswith("importlib")]
    return last == "__main__" or last.partition(".")[0] in ("ballbot_gym", "ballbot_baselines", "ballbot_train")


def _again(command: str, options: list[str]) -> str:
    """What to type after an interruption."""
    if command == "train" and "--resume" not in options:
        options = [*options, "--resume"]
    program = [sys.argv[0]] if Path(sys.argv[0]).name == "ballbot" else [sys.executable, "-m", "ballbot_train.cli"]
    if program == [shutil.which("ballbot")]:
        program = ["ballbot"]
    does = "this continues where it stopped" if command in RESUMABLE else "this starts again"
    return f"{does}:\n{shlex.join([*program, command, *options])}"


def _expected() -> tuple[type[RuntimeError], ...]:
    """The other errors that a user can cause. An `except` asks for them when there is an error."""
    from ballbot_gym.rollout import PlanError
    from ballbot_train.work.executors import WorkerError

    return PlanError, WorkerError


def _print_help() -> None:
    console = PlainConsole(highlight=False)
    console.width = max(console.width, _LEAST_WIDTH)
    console.print(f"usage: ballbot COMMAND [OPTIONS]\n\n{_DESCRIPTION}")
    widest = max(map(len, COMMANDS))
    for group, names in GROUPS.items():
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 2))
        table.add_column(style="bold", no_wrap=True, min_width=widest)
        table.add_column(overflow="fold")
        for name in names:
            table.add_row(name, _help_of(name))
        console.print(f"\n{group}:")
        console.print(table)
    console.print("\n`ballbot COMMAND --help` lists the options of a command; `ballbot --version` says the version.")


def _help_of(name: str) -> str:
    """The first line of a command's docstring, read from its file without importing it."""
    module, _, function = COMMANDS[name].partition(":")
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == function:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return ""


if __name__ == "__main__":
    main()
