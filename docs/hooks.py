"""The site quotes the README, so that both say the same: `<!-- README: Title -->` stands for that section of it."""

import re
from pathlib import Path
from typing import Any

_README = Path(__file__).parent.parent / "README.md"
_QUOTE = re.compile(r"<!-- README: (.*?) -->")


def sections(text: str) -> dict[str, str]:
    """The README's second-level sections by title, headings left out; what precedes the first is "Introduction"."""
    introduction, *rest = re.split(r"^## ", text, flags=re.MULTILINE)
    parts = {"Introduction": introduction.partition("\n")[2]}
    for part in rest:
        title, _, body = part.partition("\n")
        parts[title.strip()] = body
    return parts


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for each page.

    Raises:
        KeyError: a page quotes a section that the README does not have.
    """
    quoted = sections(_README.read_text())
    return _QUOTE.sub(lambda match: quoted[match[1]].strip().replace("](docs/", "]("), markdown)
