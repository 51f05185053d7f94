"""What mkdocs does for the site besides its pages.

`<!-- file: README.md -->` in a page stands for that file of the repository's root. The playground's page is written anew.
The script that sorts the report's tables sorts the site's too.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from ballbot_train.report.playground import write_playground

_ROOT = Path(__file__).parent.parent
_SORTS = _ROOT / "train" / "ballbot_train" / "report" / "assets" / "table.js"
_FILE = re.compile(r"<!-- file: (\S+) -->")
_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for each page.

    Raises:
        FileNotFoundError: a page names a file that does not exist.
    """
    return _FILE.sub(lambda match: _with_links_of_the_site((_ROOT / match[1]).read_text(encoding="utf-8")), markdown)


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Called by mkdocs with the site's files."""
    files.append(File.generated(config, "table.js", abs_src_path=str(_SORTS)))
    return files


def on_post_build(config: Any, **_: Any) -> None:
    """Called by mkdocs after the pages: writes the playground that docs/playground.md shows."""
    write_playground(Path(config["site_dir"]) / "playground" / "page.html")


def _with_links_of_the_site(text: str) -> str:
    """The text of a file of the root, with links that hold between the site's pages."""
    text = text.replace("](docs/", "](")
    for file, page in _PAGES.items():
        text = text.replace(f"]({file}", f"]({page}")
    return text
