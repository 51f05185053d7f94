"""`ballbot new`: creates a package for your own task."""

import builtins
import keyword
import os
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import Literal

import gymnasium

from ballbot_gym import files
from ballbot_gym.robot import check_name
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.evaluate import evaluate
from ballbot_train.evaluation.results import TABLE, table_cells
from ballbot_train.work.console import check_least, console, markdown, physics_or_default
from ballbot_train.work.templates import render

_TEMPLATES = Path(__file__).parent / "template"
_FIRST = ("lqr", "trajopt")
_OURS = ("ballbot_gym", "ballbot_baselines", "ballbot_train")


def new(kind: Literal["task"], name: str, /, out: Path | None = None, episodes: int = 8) -> None:
    """Creates a package for your own task: the task, its test, pyproject.toml, README and a first leaderboard.

    Args:
        kind: task.
        name: of the task: small letters, digits and underscores.
        out: its folder; default the name.
        episodes: of the first leaderboard; 0 for none.
    """
    del kind  # there is one
    check_name(name, "task")
    check_least(0, episodes=episodes)
    if name in TASKS or _id_of(name) in gymnasium.registry or _module_of(name) in _OURS:
        raise ValueError(f"there is a task {name!r} already, or a package of ours of that name; give another name")
    texts = _files_of(name)
    if (called := _kind_of(name)) in _names_in(texts[f"{_module_of(name)}.py"]):
        raise ValueError(f"the task's class would be {called!r}, which means something else there; give another name")
    out = Path(name) if out is None else out
    if there := [path for path in (*texts, "leaderboard.md") if (out / path).exists()]:
        raise ValueError(f"{out / there[0]} exists; give another --out")
    for path, text in texts.items():
        files.write(out / path, text)
    if episodes:
        files.write(out / "leaderboard.md", _leaderboard(name, out, episodes))
    console.print(f"made: {out}\nwhat to do next: {out / 'README.md'}")


def _files_of(name: str) -> dict[str, str]:
    """The files of a task's package by their names, as text."""
    module = _module_of(name)
    values = {"name": name, "kind": _kind_of(name), "module": module, "id": _id_of(name)}
    templates = {
        "pyproject.toml": "pyproject.toml",
        f"{module}.py": "task.py",
        f"test_{module}.py": "test_task.py",
        "README.md": "README.md",
    }
    return {path: str(render(_TEMPLATES / f"{template}.j2", **values)) for path, template in templates.items()}


def _module_of(name: str) -> str:
    """The module of a task's package."""
    return f"ballbot_{name}"


def _kind_of(name: str) -> str:
    """The class of a task's package."""
    return "".join(part.capitalize() for part in name.split("_"))


def _id_of(name: str) -> str:
    """The Gymnasium id of a task's package."""
    return f"Ballbot{_kind_of(name)}-v0"


def _names_in(source: str) -> set[str]:
    """Words that a module cannot give to a class of its own: Python's, and what the module imports."""
    # not by a parser, because a source with a bad name may not parse
    imported = re.findall(r"import (\([^)]*\)|.*)", source)
    return {*keyword.kwlist, *dir(builtins), *re.findall(r"\w+", " ".join(imported))}


def _leaderboard(name: str, out: Path, episodes: int) -> str:
    """What experts reach in the task, as Markdown."""
    sys.path.append(os.path.abspath(out))
    import_module(_module_of(name))
    physics = physics_or_default(None)
    rows = table_cells(TABLE, [evaluate(expert, name, episodes, physics) for expert in _FIRST])
    command = f"ballbot benchmark --tasks {name} --controllers {' '.join(_FIRST)} --episodes {episodes}"
    return f"The first {episodes} episodes, physics={physics}: `{command}`\n\n{markdown([*TABLE], rows)}"
