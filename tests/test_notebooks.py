"""The notebooks of the documentation are valid, hold outputs, and run."""

import sys
from pathlib import Path

import nbformat
import pytest

DOCS = Path(__file__).parent.parent / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])


@pytest.fixture
def docs(monkeypatch):
    """Makes the scripts of the documentation importable."""
    monkeypatch.syspath_prepend(str(DOCS))
    yield
    for name in ("hooks", "make_notebooks"):
        sys.modules.pop(name, None)


@every_notebook
def test_a_notebook_is_valid_and_small_and_every_cell_compiles(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            compile(cell.source, str(path), "exec", dont_inherit=True)
            assert not [output for output in cell.outputs if output.output_type == "error"]
    assert path.stat().st_size < 1e6


def test_the_site_shows_a_notebook_with_its_outputs(docs, tmp_path):
    import hooks

    outputs = [
        nbformat.v4.new_output("stream", text="regret 59%\n"),
        nbformat.v4.new_output("display_data", {"text/html": "<table>\n\n</table>", "text/plain": "Episode()"}),
        nbformat.v4.new_output("display_data", {"image/png": "aGk=\n", "text/plain": "<Figure>"}),
    ]
    cells = [
        nbformat.v4.new_markdown_cell("# Title\n[next](2-b.ipynb)"),
        nbformat.v4.new_code_cell("1 + 1", outputs=outputs),
    ]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "1-a.ipynb")
    assert hooks.notebook_page(tmp_path / "1-a.ipynb").split("\n\n") == [
        "# Title\n[next](2-b.md)",
        "```python\n1 + 1\n```",
        "```text\nregret 59%\n```",
        "<div><table>&#10;&#10;</table></div>",
        '<img alt="the figure" src="data:image/png;base64,aGk=">',
        "[This page as a notebook](1-a.ipynb)",
    ]


def test_a_notebook_shows_progress_as_lines_without_control_characters(docs, tmp_path):
    import make_notebooks

    code = """
import time
from ballbot_train.work import console

console.LATE_SECONDS, console.LINE_SECONDS = 0.0, 0.2
with console.progress_bars({"episodes": 2}, late=True) as advance:
    advance("episodes", 1)
    time.sleep(0.5)
    advance("episodes", 1)
"""
    path = tmp_path / "progress.ipynb"
    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]), path)
    (cell,) = make_notebooks.run(path, tmp_path).cells
    text = "".join(output["text"] for output in cell.outputs)
    assert set(text.splitlines()) == {"0:00:00 episodes: 1 of 2"}


def test_the_site_says_of_every_setting_what_it_is(docs):
    import hooks

    rows = [line.split(" | ") for line in hooks.settings_tables().splitlines() if line.startswith("| ")]
    assert len(rows) > 60
    assert all(row[1] for row in rows)


def test_the_task_of_the_notebook_is_that_of_the_page():
    _, _, task = (DOCS / "own.md").read_text().partition("@register_task")
    code = "".join(
        cell.source for cell in nbformat.read(DOCS / "notebooks" / "3-your-own-task.ipynb", as_version=4).cells
    )
    assert task.partition("```")[0].strip() in code


@pytest.mark.slow
@every_notebook
def test_a_notebook_runs(path, docs, tmp_path):
    import make_notebooks

    assert make_notebooks.run(path, tmp_path).cells
