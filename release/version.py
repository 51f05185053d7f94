"""The version in all places where it is written, and the notes of a version.

python release/version.py set 1.0.0   writes it everywhere, with today's date
python release/version.py check       exits with 1 and says where something else is written
python release/version.py notes       prints the changelog's first section, for the tag
"""

import json
import re
import sys
from datetime import date
from importlib.metadata import version as installed
from pathlib import Path

ROOT = Path(__file__).parent.parent

PLACES = {
    "pyproject.toml": r'^version = "(.*)"$',
    "CITATION.cff": r"^version: (.*)$",
    "README.md": r"^  version = \{(.*)\}$",
    ".zenodo.json": r'^  "version": "(.*)"',
}
"""The files in which the version stands, and how."""
DATED = r"^date-released: (.*)$"
SECTION = r"^## \[?([^]\s]+)\]?(?: - (\d{4}-\d{2}-\d{2}))?\n(.*?)(?=^## |\Z)"
"""A section of the changelog: its version, its date, and its text."""


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def written(name: str, pattern: str) -> str:
    """What a file says, or a SystemExit where it says nothing."""
    found = re.search(pattern, text_of(name), re.MULTILINE)
    return found[1] if found else sys.exit(f"{name} has no line like {pattern}")


def first_section() -> tuple[str, str, str]:
    """Version, date and text of the changelog's first section."""
    found = re.search(SECTION, text_of("CHANGELOG.md"), re.MULTILINE | re.DOTALL)
    return (found[1], found[2] or "", found[3].strip()) if found else sys.exit("CHANGELOG.md has no section")


def problems() -> list[str]:
    """What keeps this version from being published."""
    named, day, notes = first_section()
    if not re.fullmatch(r"\d+\.\d+\.\d+", named):
        return [f"the changelog begins with {named}: `python release/version.py set X.Y.Z` names that section"]
    versions = {name: written(name, pattern) for name, pattern in PLACES.items()}
    versions["the installed package"] = installed("ballbot-gym")
    found = [f"{place} says {said}, and the changelog {named}" for place, said in versions.items() if said != named]
    if day != (cited := written("CITATION.cff", DATED)):
        found.append(f"CITATION.cff says {cited}, and the changelog {day or 'no date'}")
    if len(notes) < 100:
        found.append("the changelog's first section says nothing")
    json.loads(text_of(".zenodo.json"))
    return found


def put(name: str, pattern: str, value: str) -> None:
    """Replaces what the group of a pattern matches in a file."""

    def replaced(match: re.Match[str]) -> str:
        begin, end = match.start(1) - match.start(), match.end(1) - match.start()
        return match[0][:begin] + value + match[0][end:]

    path = ROOT / name
    path.write_text(re.sub(pattern, replaced, text_of(name), count=1, flags=re.MULTILINE), encoding="utf-8")


def name_version(version: str) -> None:
    """Writes the version and today's date in all places; the changelog's section of what is not released gets its name."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        sys.exit(f"a version is three numbers, such as 1.0.0, not {version!r}")
    today = date.today().isoformat()
    for name, pattern in PLACES.items():
        put(name, pattern, version)
    put("CITATION.cff", DATED, today)
    path = ROOT / "CHANGELOG.md"
    text = re.sub(
        r"^## \[?Unreleased\]?$", f"## [{version}] - {today}", text_of("CHANGELOG.md"), count=1, flags=re.MULTILINE
    )
    path.write_text(text, encoding="utf-8")


def main() -> None:
    match sys.argv[1:]:
        case ["set", version]:
            name_version(version)
        case ["check"]:
            if found := problems():
                sys.exit("\n".join(found))
            print(f"version {first_section()[0]} is the same everywhere")
        case ["notes"]:
            print(first_section()[2])
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
