"""What is needed to install the package is said alike everywhere, and is there on every machine."""

import itertools
import re
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
MACHINES = {
    "Linux x86-64": ("linux", "x86_64"),
    "Linux ARM": ("linux", "aarch64"),
    "Windows": ("win32", "AMD64"),
    "macOS Apple": ("darwin", "arm64"),
    "macOS Intel": ("darwin", "x86_64"),
}
WITH_PYBULLET = {("Linux x86-64", "3.10"), ("Linux x86-64", "3.11")}
"""Where PyBullet has a wheel."""


def wanted(requirements, machine, python):
    """The distributions that are installed on a machine under a Python."""
    system, processor = MACHINES[machine]
    where = {"sys_platform": system, "platform_machine": processor, "python_version": python}
    found = [Requirement(text) for text in requirements]
    return [each.name for each in found if each.marker is None or each.marker.evaluate(where)]


@pytest.mark.parametrize(("machine", "python"), itertools.product(MACHINES, PYTHONS))
def test_every_machine_gets_one_engine_with_contact_that_has_a_wheel_there(machine, python):
    has_core = python != "3.10" and machine != "macOS Intel"
    mujoco = "mujoco-core" if has_core else "mujoco"
    engines = {"pybullet", "mujoco", "mujoco-core"}
    installed = [name for name in wanted(PROJECT["dependencies"], machine, python) if name in engines]
    assert installed == (["pybullet"] if (machine, python) in WITH_PYBULLET else [mujoco])
    assert wanted(PROJECT["optional-dependencies"]["mujoco"], machine, python) == [mujoco]


def test_the_pythons_and_systems_are_the_same_in_classifiers_readme_tutorial_and_makefile():
    named = [text.rpartition(" ")[2] for text in PROJECT["classifiers"] if "Python :: 3." in text]
    assert named == list(PYTHONS)
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"
    makefile = (ROOT / "Makefile").read_text()
    tested = re.search(r"^PYTHONS := (.*)$", makefile, re.MULTILINE)[1].split()
    usual = re.search(r"^PYTHON \?= python(.*)$", makefile, re.MULTILINE)[1]
    assert sorted([*tested, usual]) == list(PYTHONS)
    needs = [
        re.search(r"^You need Python .*?\n\n", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)[0]
        for page in ("README.md", "docs/start.md")
    ]
    assert needs[0] == needs[1]
    assert needs[0].startswith(f"You need Python {PYTHONS[0]} to {PYTHONS[-1]} on Linux, Windows or macOS")
    systems = {text.rpartition(" ")[2] for text in PROJECT["classifiers"] if "Operating System" in text}
    assert systems == {"Linux", "Windows", "MacOS"}
    assert "PyBullet is installed on Linux x86-64 with\nPython 3.10 or 3.11, and MuJoCo in its place" in needs[0]


def test_on_a_package_index_every_link_and_picture_of_readme_is_absolute_and_of_a_file_that_exists():
    hook = PYPROJECT["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    (fragment,) = hook["fragments"]
    text = (ROOT / fragment["path"]).read_text()
    for each in hook["substitutions"]:
        text = re.sub(each["pattern"], each["replacement"], text)
    repository = PROJECT["urls"]["Homepage"]
    raw = repository.replace("//github.com", "//raw.githubusercontent.com")
    links = re.findall(r"(!?)\[[^\[\]]*\]\(([^)]*)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    assert {link for picture, link in links if picture} == {
        f"{raw}/main/docs/pictures/{name}"
        for name in ("logo.svg", "lean.webp", "playground.webp", "learning-curves.png")
    }
    for picture, link in links:
        if link.startswith("#"):  # a place in the page itself
            assert f"## {link[1:].replace('-', ' ')}" in text.lower()
            continue
        assert link.startswith("https://")
        start = f"{raw}/main/" if picture else f"{repository}/blob/main/"
        if link.startswith((repository, raw)):
            assert link.startswith(start)
            assert (ROOT / link.removeprefix(start).partition("#")[0]).is_file(), link
