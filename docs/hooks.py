"""What mkdocs does for the site besides its pages.

`<!-- file: README.md -->` in a page is replaced by that file of the repository's root. `from SOME WORDS` after the name omits
what precedes these words. `<!-- settings -->` is replaced by the tables of the learners' settings. Every module that a
page of the API names gets a page of its own. Pictures are loaded when they come into view. Links to films in tables show the
films. Notebooks are pages with their outputs. The playground's page is written. The script that sorts the report's tables
sorts the site's too.
"""

import ast
import importlib
import inspect
import itertools
import json
import re
import textwrap
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast

from mkdocs.structure.files import File

from ballbot_gym.tasks import TASKS
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.report.playground import playground_page

_ROOT = Path(__file__).parent.parent
_SORTS = _ROOT / "train" / "ballbot_train" / "report" / "assets" / "table.js"
_FILE = re.compile(r"<!-- file: (\S+)(?: from (.+?))? -->")
_MODULE = re.compile(r"^::: (\S+)$", flags=re.MULTILINE)
_FILM = re.compile(r'<a href="([^"]+\.webp)">(\d+)</a>')
_NOTEBOOK = re.compile(r"\]\((notebooks/[\w-]+)\.ipynb\)")
_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs for each page.

    Raises:
        FileNotFoundError: a page names a file that does not exist.
        ValueError: the file does not contain the words from which on it is shown.
    """
    markdown = markdown.replace("<!-- settings -->", settings_tables()) if "<!-- settings -->" in markdown else markdown
    if page.file.src_uri.startswith("api/") and page.file.generated_by is None:
        markdown = _MODULE.sub(_module_link, markdown)
    markdown = _NOTEBOOK.sub(r"](\1.md)", markdown)
    return _FILE.sub(lambda match: _part_of(match[1], match[2] or ""), markdown)


def _part_of(file: str, begin: str) -> str:
    """The text of a file of the root from some words on, with links of the site."""
    text = (_ROOT / file).read_text(encoding="utf-8")
    return _with_links_of_the_site(text[text.index(begin) :])


def on_page_content(html: str, **_: Any) -> str:
    """Called by mkdocs with each page as HTML: links to films show them, and pictures are loaded when they come into view."""
    html = _FILM.sub(r'<a href="\1"><img alt="film of episode \2" src="\1"><br>\2</a>', html)
    return html.replace("<img ", '<img loading="lazy" ')


def on_config(config: Any, **_: Any) -> Any:
    """Called by mkdocs with its settings: the navigation lists the modules of the API below their packages."""
    config["nav"] = _with_modules(config["nav"], Path(config["docs_dir"]))
    return config


def _with_modules(entry: Any, docs: Path) -> Any:
    """An entry of the navigation in which every page of the API is followed by the pages of its modules."""
    if isinstance(entry, list):
        return [_with_modules(each, docs) for each in entry]
    if not isinstance(entry, dict):
        return entry
    ((title, inside),) = entry.items()
    if isinstance(inside, str) and inside.startswith("api/"):
        modules = _MODULE.findall((docs / inside).read_text(encoding="utf-8"))
        return {title: [inside, *({module: f"api/{module}.md"} for module in modules)]}
    return {title: _with_modules(inside, docs)}


def _module_link(match: re.Match[str]) -> str:
    """A module of the API as an entry of a list: a link to its page, and the first line of its docstring."""
    about = (inspect.getdoc(importlib.import_module(match[1])) or "").partition("\n")[0]
    return f"- [`{match[1]}`]({match[1]}.md): {about}"


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Called by mkdocs with the site's files."""
    for page in sorted((Path(config["docs_dir"]) / "api").glob("*.md")):
        for module in _MODULE.findall(page.read_text(encoding="utf-8")):
            content = f"::: {module}\n    options:\n      heading_level: 1\n"
            files.append(File.generated(config, f"api/{module}.md", content=content))
    files.append(File.generated(config, "table.js", abs_src_path=str(_SORTS)))
    for path in sorted((Path(config["docs_dir"]) / "notebooks").glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=notebook_page(path)))
    return files


def on_post_build(config: Any, **_: Any) -> None:
    """Called by mkdocs after the pages: writes the playground that docs/playground.md shows."""
    folder = Path(config["site_dir"]) / "playground"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "page.html").write_text(playground_page(), encoding="utf-8")


def notebook_page(path: Path) -> str:
    """A notebook with its outputs, as Markdown."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source.replace(".ipynb)", ".md)"))
        else:
            parts += [f"```python\n{source}\n```", *map(_output, cell["outputs"])]
    return "\n\n".join([*parts, f"[This page as a notebook]({path.name})"])


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {"text/plain": output.get("text", "")})
    if "text/html" in data:  # in one line, so that nothing in it is Markdown
        return f"<div>{''.join(data['text/html'])}</div>".replace("\n", "&#10;")
    if "image/png" in data:
        return f'<img alt="the figure" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    return f"```text\n{''.join(data['text/plain']).rstrip()}\n```"


def settings_tables() -> str:
    """A table per learner, and one more of settings after a warm start, of every setting, its meaning and its values."""
    parts = []
    for (learner, algorithm), warm in itertools.product(LEARNERS.items(), (False, True)):
        columns = {task: algorithm.settings(task, warm) for task in TASKS}
        if warm and columns == {task: algorithm.settings(task) for task in TASKS}:
            continue
        rows = [f"| setting | meaning | {' | '.join(columns)} |", f"|---|---|{'---|' * len(columns)}"]
        meanings = _meanings_of(type(columns["turn"]))
        for field in fields(columns["turn"]):
            values = " | ".join(_shown(getattr(settings, field.name)) for settings in columns.values())
            name = field.name.replace("_", "\\_<wbr>")  # a narrow column breaks it there
            rows.append(f"| {name} | {meanings[field.name]} | {values} |")
        title = f"`{learner}`, from demonstrations or a policy" if warm else f"`{learner}`"
        parts.append(f"## {title}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _meanings_of(config: type) -> dict[str, str]:
    """What the docstrings under the fields of a dataclass and its bases say, by field."""
    found: dict[str, str] = {}
    for kind in reversed(config.__mro__[:-1]):
        body = cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]).body
        for field, after in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                found[cast(ast.Name, field.target).id] = " ".join(ast.literal_eval(after.value).split())
    return found


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if is_dataclass(value):
        return ", ".join(f"{field.name} {getattr(value, field.name):g}" for field in fields(value))
    return " ".join(map(str, value)) if isinstance(value, tuple) else f"{value}"


def _with_links_of_the_site(text: str) -> str:
    """The text of a file of the root, with links that hold between the site's pages."""
    text = text.replace("](docs/", "](")
    for file, page in _PAGES.items():
        text = text.replace(f"]({file}", f"]({page}")
    return text
