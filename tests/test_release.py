"""The version is the same in all places, the changelog's first section has its notes, and code for ARM can be run."""

import shutil
import subprocess
from importlib.metadata import version as installed
from pathlib import Path

import pytest

from ballbot_gym import machine_code
from ballbot_gym.machine_code import codegen
from ballbot_gym.tasks.stabilize import Stabilize

ROOT = Path(__file__).parent.parent


@pytest.fixture
def version(tmp_path, monkeypatch):
    """The module `release/version.py`, which reads and writes copies of the files that have the version."""
    monkeypatch.syspath_prepend(str(ROOT / "release"))
    import version

    for name in (*version.PLACES, "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path / name)
    monkeypatch.setattr(version, "ROOT", tmp_path)
    return version


@pytest.mark.parametrize("heading", ["## Unreleased", "## [Unreleased]"])
def test_what_is_not_released_gets_the_version_that_is_set(heading, version, tmp_path, monkeypatch):
    notes = "- A line that says what this version changes for those who use the package, and what they do about it."
    sections = f"{heading}\n\n{notes}\n\n## [1.0.0] - 2026-01-01\n\n- The first.\n"
    (tmp_path / "CHANGELOG.md").write_text(f"# Changelog\n\n{sections}")
    (problem,) = version.problems()
    assert "begins with Unreleased" in problem
    version.name_version("3.1.4")
    (problem,) = version.problems()
    assert problem == f"the installed package says {installed('ballbot-gym')}, and the changelog 3.1.4"
    monkeypatch.setattr(version, "installed", lambda _: "3.1.4")
    assert not version.problems()
    assert version.first_section()[2] == notes


def test_the_program_that_runs_in_an_emulator_compiles(params, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "release"))
    import cross

    if (compiler := machine_code.compiler()) is None:
        pytest.skip("no C compiler")
    code = tmp_path / "main.c"
    code.write_text(codegen.source(Stabilize(), params, True) + cross.ROLLOUT % 37)
    done = subprocess.run([compiler, "-fsyntax-only", str(code)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
