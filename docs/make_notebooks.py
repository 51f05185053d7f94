"""`make notebooks`: runs the notebooks of docs/notebooks, or some by their names, and keeps their outputs for the site."""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from ballbot_gym import files

NOTEBOOKS = Path(__file__).parent / "notebooks"
_LIMIT = 1800  # s for a cell, on a busy machine


def run(path: Path, folder: Path) -> nbformat.NotebookNode:
    """A notebook with the outputs of its cells, run in a folder. Raises a CellExecutionError where a cell fails."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook, timeout=_LIMIT, resources={"metadata": {"path": str(folder)}}, record_timing=False
    ).execute()
    for cell in notebook.cells:
        if cell.cell_type == "code":  # what is written to the terminal says nothing of the notebook
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    return notebook


if __name__ == "__main__":
    for made in [NOTEBOOKS / name for name in sys.argv[1:]] or sorted(NOTEBOOKS.glob("*.ipynb")):
        files.write(made, nbformat.writes(run(made, NOTEBOOKS)) + "\n")
