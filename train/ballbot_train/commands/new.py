"""`ballbot new`: creates a package for your own task, or for your own system."""

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
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import ROBOTS, check_name
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.evaluate import evaluate
from ballbot_train.evaluation.results import TABLE, table_cells
from ballbot_train.work.console import check_least, console, markdown, physics_or_default
from ballbot_train.work.templates import render

_TEMPLATES = Path(__file__).parent / "template"
_FIRST = ("lqr", "trajopt")
_OURS = ("ballbot_gym", "ballbot_baselines", "ballbot_train")
_ABOUT = {
    "task": "A task of ballbot-gym: from rest to rest at a target.",
    "system": "A system and its task, with the optimum of every episode: from anywhere on a rail to rest in its middle.",
}
"""What the READMEs of the kinds say."""

Kind = Literal["task", "system"]


def new(kind: Kind, name: str, /, out: Path | None = None, episodes: int = 8) -> None:
    """Creates a package for your own task of a ballbot, or for your own system: equations of motion and a task in one file.

    The package has a test, pyproject.toml, README and a first leaderboard.

    Args:
        kind: task or system.
        name: name of the task, and of the system: small letters, digits and underscores.
        out: folder of the package; default, the name.
        episodes: number of episodes of the first leaderboard; 0 for no leaderboard.
    """
    check_name(name, kind)
    check_least(0, episodes=episodes)
    taken = name in TASKS or (kind == "system" and name in ROBOTS) or _id_of(kind, name) in gymnasium.registry
    if taken or _module_of(name) in _OURS:
        what = "task" if kind == "task" else "task or robot"
        raise ValueError(f"a {what}, or a package that ballbot-gym uses, is called {name!r} already; give another name")
    texts = _files_of(kind, name)
    if called := [each for each in _classes_of(kind, name) if each in _names_in(texts[f"{_module_of(name)}.py"])]:
        raise ValueError(
            f"the {kind}'s class would be called {called[0]!r}, which its file uses for something else; give another name"
        )
    out = Path(name) if out is None else out
    if there := [path for path in (*texts, "leaderboard.md") if (out / path).exists()]:
        raise ValueError(f"{out / there[0]} exists; give another --out")
    for path, text in texts.items():
        files.write(out / path, text)
    if episodes:
        files.write(out / "leaderboard.md", _leaderboard(name, out, episodes))
    console.print(f"made: {out}\nwhat to do next: {out / 'README.md'}")


def _files_of(kind: Kind, name: str) -> dict[str, str]:
    """The files of a package by their names, as text."""
    module, classes = _module_of(name), _classes_of(kind, name)
    values = {"name": name, "kind": classes[0], "task": classes[-1], "module": module, "id": _id_of(kind, name)}
    values |= {"what": kind, "about": _ABOUT[kind]}
    templates = {
        "pyproject.toml": "pyproject.toml",
        f"{module}.py": f"{kind}.py",
        f"test_{module}.py": f"test_{kind}.py",
        "README.md": "README.md",
    }
    return {path: str(render(_TEMPLATES / f"{template}.j2", **values)) for path, template in templates.items()}


def _module_of(name: str) -> str:
    """The module of a package."""
    return f"ballbot_{name}"


def _classes_of(kind: Kind, name: str) -> tuple[str, ...]:
    """The classes of a package; the last one is its task."""
    called = "".join(part.capitalize() for part in name.split("_"))
    return (called,) if kind == "task" else (called, f"{called}Task")


def _id_of(kind: Kind, name: str) -> str:
    """The Gymnasium id of a package's task."""
    called = _classes_of(kind, name)[0]
    return f"Ballbot{called}-v0" if kind == "task" else f"{called}-v0"


def _names_in(source: str) -> set[str]:
    """Words that a module cannot give to a class of its own: Python's, and what the module imports."""
    # not by a parser, because a source with a bad name may not parse
    imported = re.findall(r"import (\([^)]*\)|.*)", source)
    return {*keyword.kwlist, *dir(builtins), *re.findall(r"\w+", " ".join(imported))}


def _leaderboard(name: str, out: Path, episodes: int) -> str:
    """What experts reach in the task, as Markdown."""
    sys.path.append(os.path.abspath(out))
    import_module(_module_of(name))
    physics = physics_or_default(None, own_robot(name))
    rows = table_cells(TABLE, [evaluate(expert, name, episodes, physics) for expert in _FIRST])
    command = f"ballbot benchmark --tasks {name} --controllers {' '.join(_FIRST)} --episodes {episodes}"
    return f"The first {episodes} episodes, physics={physics}: `{command}`\n\n{markdown([*TABLE], rows)}"
