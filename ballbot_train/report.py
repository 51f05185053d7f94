"""One self-contained HTML page of a table and figures."""

import base64
import html
from collections.abc import Sequence
from pathlib import Path

from ballbot_gym import files

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2rem auto; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums }
th, td { padding: .35rem .6rem; border-bottom: 1px solid #ddd; text-align: right }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left }
img { width: 100%; margin: 1rem 0 } .about { color: #666; font-size: .85rem }
"""


def write_report(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    figures: Sequence[Path],
    about: dict[str, object],
    path: Path,
) -> Path:
    """Writes the page; images are embedded, so that it can be moved and opened offline."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    images = "".join(
        f'<img alt="{html.escape(figure.stem)}" src="data:image/png;base64,'
        f'{base64.b64encode(figure.read_bytes()).decode()}">'
        for figure in figures
    )
    facts = ", ".join(f"{html.escape(key)}: {html.escape(str(value))}" for key, value in about.items())
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1>"
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{images}"
        f'<p class="about">{facts}</p></html>'
    )
    return files.write(path, page)
