"""One self-contained HTML page: tables that sort, figures, curves, and a replay in 3D.

A page is a list of `Section`s; whatever makes a section plugs in. Everything is embedded, Plotly's JavaScript included,
so the file opens offline and can be moved. What is drawn in the page's own scripts is in `page/`.
"""

import base64
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects
import plotly.offline
from plotly.utils import PlotlyJSONEncoder

from ballbot_gym import files
from ballbot_gym.tasks.marker import Marker
from ballbot_train.report.replay import Replay, Take

_PAGE = Path(__file__).parent / "page"
_REPLAY_DT = 0.02  # s, between the states that the page holds


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    body: str
    """HTML."""
    lead: str = ""
    """A sentence or two above it, plain text."""
    scripts: tuple[str, ...] = ()
    """What it needs: "plotly", and files of `page/`."""


@dataclass(frozen=True)
class Line:
    """A curve over x (n,), with a band between `low` and `high` (n,) if given."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    color: str
    low: Sequence[float] | np.ndarray | None = None
    high: Sequence[float] | np.ndarray | None = None
    steps: bool = False
    """Whether y jumps at each x instead of running straight to the next."""


@dataclass(frozen=True)
class Panel:
    """Axes with curves."""

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    log_x: bool = False
    log_y: bool = False


def write_report(title: str, sections: Iterable[Section | None], about: Mapping[str, object], path: Path) -> Path:
    """Writes the page.

    Args:
        title: its heading.
        sections: in their order; None, for what has no data, is left out.
        about: what the results depend on, for the foot of the page.
        path: of the file.
    """
    parts = [section for section in sections if section is not None]
    scripts = list(dict.fromkeys(name for section in parts for name in section.scripts))
    if "plotly" in scripts:
        scripts = ["plotly", *(name for name in scripts if name != "plotly")]  # the others call it
    links = "".join(f'<a href="#section-{i}">{html.escape(part.title)}</a>' for i, part in enumerate(parts))
    facts = ", ".join(f"{html.escape(key)}: {html.escape(str(value))}" for key, value in about.items())
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{html.escape(title)}</title>'
        f"<style>{(_PAGE / 'style.css').read_text()}</style>"
        f"{_script(scripts[0]) if scripts[:1] == ['plotly'] else ''}</head><body>"
        f"<header><h1>{html.escape(title)}</h1><nav>{links}</nav></header>"
        f"<main>{''.join(_section(i, part) for i, part in enumerate(parts))}</main><footer>{facts}</footer>"
        f"{''.join(_script(name) for name in scripts if name != 'plotly')}</body></html>\n"
    )
    return files.write(path, page)


def table_section(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], lead: str = "") -> Section:
    """A table that sorts by the column pressed; its first two columns are words, and the first can be filtered."""

    def cell(tag: str, i: int, content: str) -> str:
        return f"<{tag}{' class=word' if i < 2 else ''}>{content}</{tag}>"

    heads = "".join(
        cell("th", i, f'<button type="button">{html.escape(name)}</button>') for i, name in enumerate(header)
    )
    body = "".join(
        "<tr>" + "".join(cell("td", i, html.escape(text)) for i, text in enumerate(row)) + "</tr>" for row in rows
    )
    table = f'<table class="sortable"><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>'
    return Section(title, f'<div class="scroll">{table}</div>', lead, ("table.js",))


def pictures_section(title: str, pictures: Iterable[Path], lead: str = "") -> Section | None:
    """Embedded PNGs one under another, captioned with their names; None where there are none."""
    figures = "".join(
        f'<figure><div class="scroll"><img alt="{html.escape(picture.stem)}" src="data:image/png;base64,'
        f'{base64.b64encode(picture.read_bytes()).decode()}"></div>'
        f"<figcaption>{html.escape(picture.stem.replace('-', ' '))}</figcaption></figure>"
        for picture in pictures
    )
    return Section(title, f'<div class="pictures">{figures}</div>', lead) if figures else None


def folder_section(title: str, folder: Path, lead: str = "") -> Section | None:
    """The PNGs that another command left in a folder; None where there are none."""
    return pictures_section(title, sorted(folder.glob("*.png")), lead)


def curves_section(title: str, panels: Sequence[Panel], lead: str = "") -> Section | None:
    """Curves that can be zoomed and read off: robustness, learning, shares of episodes; None where there are none."""
    if not panels:
        return None
    figures = "".join(f'<div class="curves">{_json_script(_panel(panel).to_plotly_json())}</div>' for panel in panels)
    labels = dict.fromkeys((line.label, line.color) for panel in panels for line in panel.lines)
    legend = "".join(
        f'<span><i style="background:{html.escape(color)}"></i>{html.escape(label)}</span>' for label, color in labels
    )
    return Section(
        title, f'<div class="legend">{legend}</div><div class="panels">{figures}</div>', lead, ("plotly", "curves.js")
    )


def replay_section(title: str, replays: Sequence[Replay], lead: str = "") -> Section | None:
    """Episodes in 3D, one scene per take, with play, pause, scrubbing and traces; None where there are none."""
    replays = [replay for replay in replays if replay.takes]
    if not replays:
        return None
    robot = replays[0].params
    sizes = ("ball_radius", "body_radius", "body_length", "com_height")
    data = {
        "robot": {name: getattr(robot, name) for name in sizes},
        "episodes": [_replay_data(replay) for replay in replays],
    }
    body = (
        '<div class="replay"><div class="filter episodes"></div><div class="controls">'
        '<button type="button" class="play">Play</button>'
        '<input type="range" class="scrub" min="0" max="1" step="0.01" value="0" aria-label="time">'
        '<span class="clock">0.00 s</span>'
        '<label>speed <select class="speed"><option value="0.25">¼</option><option value="0.5">½</option>'
        '<option value="1" selected>1</option><option value="2">2</option></select></label>'
        '<label><input type="checkbox" class="follow" checked> follow</label>'
        '<label><input type="checkbox" class="link" checked> link cameras</label></div>'
        '<div class="stages"></div><div class="panels"><div class="tilts"></div><div class="forces"></div></div>'
        f"{_json_script(data)}</div>"
    )
    return Section(title, body, lead, ("plotly", "replay.js"))


def _section(i: int, section: Section) -> str:
    lead = f'<p class="lead">{html.escape(section.lead)}</p>' if section.lead else ""
    return f'<section id="section-{i}"><h2>{html.escape(section.title)}</h2>{lead}{section.body}</section>'


def _script(name: str) -> str:
    text = plotly.offline.get_plotlyjs() if name == "plotly" else (_PAGE / name).read_text()
    # its names stay its own
    return f"<script>{text}</script>" if name == "plotly" else f"<script>(() => {{\n{text}\n}})();</script>"


def _json_script(data: object) -> str:
    """Data for a page's script to read."""
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False, cls=PlotlyJSONEncoder).replace("<", "\\u003c")
    return f'<script type="application/json">{text}</script>'


def _panel(panel: Panel) -> plotly.graph_objects.Figure:
    figure = plotly.graph_objects.Figure(layout_template="none")
    for line in panel.lines:
        if line.low is not None and line.high is not None:
            outline = np.concatenate([line.x, np.asarray(line.x)[::-1]])
            band = np.concatenate([line.high, np.asarray(line.low)[::-1]])
            figure.add_scatter(
                x=outline.tolist(),
                y=band.tolist(),
                fill="toself",
                fillcolor=line.color,
                opacity=0.15,
                line={"width": 0},
                mode="lines",
                hoverinfo="skip",
            )
        figure.add_scatter(
            x=np.asarray(line.x).tolist(),
            y=np.asarray(line.y).tolist(),
            name=line.label,
            mode="lines",
            line={"color": line.color, "width": 2, "shape": "hv" if line.steps else "linear"},
        )
    figure.update_layout(
        title={"text": panel.title, "font": {"size": 14}, "x": 0.02, "y": 0.97},
        plot_bgcolor="white",
        margin={"l": 52, "r": 12, "t": 34, "b": 44},
        showlegend=False,
        height=300,
        xaxis=_axis(panel.x_label, panel.log_x),
        yaxis=_axis(panel.y_label, panel.log_y),
    )
    return figure


def _axis(label: str, log: bool) -> dict[str, object]:
    kind = {"type": "log", "dtick": 1} if log else {"type": "linear"}
    return {"title": label, "gridcolor": "#eef0f3", "zerolinecolor": "#d5d9e0", "linecolor": "#c3cad6", **kind}


def _replay_data(replay: Replay) -> dict[str, object]:
    return {
        "title": replay.title,
        "dt": _REPLAY_DT,
        "markers": [_marker_data(marker) for marker in replay.markers],
        "takes": [_take_data(take) for take in replay.takes],
    }


def _marker_data(marker: Marker) -> dict[str, object]:
    red, green, blue, alpha = marker.color
    return {
        "x": round(marker.position[0], 4),
        "y": round(marker.position[1], 4),
        "radius": round(marker.radius, 4),
        "height": marker.height,
        "ring": marker.ring,
        "color": f"rgba({round(255 * red)},{round(255 * green)},{round(255 * blue)},{alpha})",
    }


def _take_data(take: Take) -> dict[str, object]:
    """Columns at every `_REPLAY_DT`: a millimetre, a tenth of a milliradian and a newton are enough to look at."""
    times = _REPLAY_DT * np.arange(math.floor(take.trajectory.duration / _REPLAY_DT + 1e-6) + 1)
    x = np.array([take.trajectory.state(t) for t in times])
    u = np.array([take.trajectory.force(t) for t in times])
    return {
        "label": take.label,
        "color": take.color,
        "note": take.note,
        **{name: x[:, i].round(3).tolist() for i, name in enumerate(("x", "y"))},
        **{name: x[:, 2 + i].round(4).tolist() for i, name in enumerate(("gamma", "theta"))},
        **{name: u[:, i].round(0).tolist() for i, name in enumerate(("fx", "fy"))},
    }
