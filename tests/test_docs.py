"""What README and documentation say runs as it stands, as a reader would paste it, page by page."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from ballbot_train.policy import SHIPPED

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "example"}
    for block in blocks(page, "python"):
        exec(compile(block, str(page), "exec", dont_inherit=True), namespace)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_run(page, tmp_path):
    makefile = (ROOT / "Makefile").read_text()
    for line in "\n".join(blocks(page, "sh")).splitlines():
        command = shlex.split(line, comments=True)
        if not command:
            continue
        if command[0] == "make":  # what CI runs, this test within it
            assert re.search(rf"^{command[1]}:", makefile, flags=re.MULTILINE), line
            continue
        assert command[0] == "ballbot", f"{line}: how is this tested?"
        done = subprocess.run(
            [sys.executable, "-m", "ballbot_train.cli", *command[1:]], cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"


def test_no_block_is_of_a_kind_that_nothing_runs():
    kinds = {kind for page in PAGES for kind in re.findall(r"^```(\w+)$", page.read_text(), flags=re.MULTILINE)}
    assert kinds <= {"python", "sh", "bibtex"}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_pictures_and_commands_that_it_names_exist(page):
    from ballbot_train.commands import COMMANDS

    for picture in re.findall(r"!\[[^]]*\]\(([^)]*)\)", page.read_text()):
        assert (page.parent / picture).exists(), picture
    for command in re.findall(r"`ballbot (\w+)", page.read_text()):
        assert command in COMMANDS


def test_the_readme_says_of_every_shipped_policy_what_its_file_says():
    text = (ROOT / "README.md").read_text()
    for path in sorted(SHIPPED.glob("*.json")):
        about = json.loads(path.read_text())
        measured, training = about["measured"], about["training"]
        seconds = about["training_seconds"]
        row = (
            f"| {training['task']} | {training['learner']} | {seconds / 60:.0f} min | {measured['success']:.1%} | "
            f"{measured['falls']} | {measured['regret_mean']:.2%} | {measured['regret_median']:.2%} |"
        )
        assert row in text, row


def test_the_site_builds_without_a_warning(tmp_path):
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    start = (tmp_path / "index.html").read_text()
    assert "<!-- README" not in start
    assert "Two commands" in start
    assert "discrete_lqr" in (tmp_path / "api" / "baselines" / "index.html").read_text()
