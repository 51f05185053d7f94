"""One self-contained HTML page: tables that sort, figures, curves, and a replay in 3D.

A page is a list of `Section`s. Everything is embedded, Plotly's JavaScript included, so the file opens offline and can be
moved. The templates, scripts and styles are in `assets/`. The templates escape all text.
"""

from __future__ import annotations

import base64
import functools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2
import numpy as np
from markupsafe import Markup

from ballbot_gym import drawing, files
from ballbot_gym.params import BallbotParams
from ballbot_train.escaping import plotly_text
from ballbot_train.report.replay import Replay, Take

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_ASSETS = Path(__file__).parent / "assets"
_WORD_COLUMNS = 2  # of a table: the first columns hold words, the others hold numbers
_REPLAY_DT = 0.02  # s, between the states in the page


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    body: Markup | str
    """HTML if it is a `Markup`; a plain string is text, and is escaped."""
    lead: str = ""
    """One or two sentences above the body, plain text."""
    scripts: tuple[str, ...] = ()
    """The scripts that the body needs: "plotly", and names of files in `assets/`."""


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


def write_report(title: str, sections: Iterable[Section | None], facts: Mapping[str, object], path: Path) -> Path:
    """Writes the page.

    Args:
        title: heading of the page.
        sections: the parts in their order; a part without data is None and is left out.
        facts: what the results depend on, such as versions; shown at the foot of the page.
        path: path of the file.

    Returns:
        path.
    """
    shown = [section for section in sections if section is not None]
    names = dict.fromkeys(name for section in shown for name in section.scripts)
    page = _render(
        "page.html.j2",
        title=title,
        sections=shown,
        facts=facts,
        style=_asset("style.css"),
        plotly=_plotly_script() if "plotly" in names else None,
        scripts=[_asset(name) for name in names if name != "plotly"],
    )
    return files.write(path, page)


def table_section(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], lead: str = "") -> Section:
    """A table that the reader can sort by any column, and filter by the words of its first column."""
    table = _render("table.html.j2", header=header, rows=rows, word_columns=_WORD_COLUMNS)
    return Section(title, table, lead, ("table.js",))


def pictures_section(title: str, pictures: Iterable[Path], lead: str = "") -> Section | None:
    """Embedded PNGs one under another, captioned with their names; None if there are none."""
    shown = [{"name": path.stem, "base64": base64.b64encode(files.read(path)).decode()} for path in pictures]
    return Section(title, _render("pictures.html.j2", pictures=shown), lead) if shown else None


def folder_section(title: str, folder: Path, lead: str = "") -> Section | None:
    """The PNGs in a folder that another command has written; None if there are none."""
    return pictures_section(title, sorted(folder.glob("*.png")), lead)


def curves_section(title: str, panels: Sequence[Panel], lead: str = "") -> Section | None:
    """Curves that the reader can zoom and read off, under one legend; None if there are no panels."""
    if not panels:
        return None
    legend = dict.fromkeys((line.label, line.color) for panel in panels for line in panel.lines)
    figures = [_panel(panel).to_plotly_json() for panel in panels]
    return Section(title, _render("curves.html.j2", legend=legend, panels=figures), lead, ("plotly", "curves.js"))


def replay_section(title: str, replays: Sequence[Replay], lead: str = "") -> Section | None:
    """Episodes in 3D, one scene for each take, with play, pause and scrubbing; None if there are no takes."""
    replays = [replay for replay in replays if replay.takes]
    if not replays:
        return None
    return Section(title, _replays(replays, traces=True), lead, ("plotly", "scene.js", "replay.js"))


def replay_page(replay: Replay) -> str:
    """The same without traces and so without Plotly, as a page of its own of some 60 kB."""
    page = _render(
        "frame.html.j2",
        title=replay.title,
        body=_replays([replay], traces=False),
        style=_asset("style.css"),
        scripts=[_asset(name) for name in ("scene.js", "replay.js")],
    )
    return str(page)


def _replays(replays: Sequence[Replay], traces: bool) -> Markup:
    data = scene_data(replays[0].params) | {"episodes": [_replay_data(replay) for replay in replays]}
    return _render("replay.html.j2", data=data, traces=traces)


def scene_data(params: BallbotParams) -> dict[str, object]:
    """How scene.js draws a robot."""
    return {
        "robot": {name: getattr(params, name) for name in ("ball_radius", "body_radius", "body_length", "com_height")},
        "colors": {"ball": drawing.BALL, "force": drawing.FORCE, "push": drawing.PUSH},
        "force_scale": drawing.FORCE_SCALE,
        "least_force": drawing.LEAST_FORCE,
    }


@functools.cache
def _templates() -> jinja2.Environment:
    """The templates of `assets/`, which escape every string that is not a `Markup`."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_ASSETS),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_function"] = _json
    environment.policies["json.dumps_kwargs"] = {}
    return environment


def _render(template: str, **values: object) -> Markup:
    return Markup(_templates().get_template(template).render(values))


def _asset(name: str) -> Markup:
    """The text of one of this package's own scripts or styles."""
    return Markup((_ASSETS / name).read_text(encoding="utf-8"))


def _plotly_script() -> Markup:
    import plotly.offline

    return Markup(plotly.offline.get_plotlyjs())


def _json(data: object) -> str:
    """Compact JSON of figures and replays; the template's `tojson` escapes it afterwards."""
    from plotly.utils import PlotlyJSONEncoder

    return json.dumps(data, separators=(",", ":"), ensure_ascii=False, cls=PlotlyJSONEncoder)


def _panel(panel: Panel) -> Figure:
    from plotly.graph_objects import Figure

    figure = Figure(layout_template="none")
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
            name=plotly_text(line.label),
            mode="lines",
            line={"color": line.color, "width": 2, "shape": "hv" if line.steps else "linear"},
        )
    figure.update_layout(
        title={"text": plotly_text(panel.title), "font": {"size": 14}, "x": 0.02, "y": 0.97},
        plot_bgcolor="rgba(0,0,0,0)",
        paper_bgcolor="rgba(0,0,0,0)",
        margin={"l": 52, "r": 12, "t": 34, "b": 44},
        showlegend=False,
        height=300,
        xaxis=_axis(panel.x_label, panel.log_x),
        yaxis=_axis(panel.y_label, panel.log_y),
    )
    return figure


def _axis(label: str, log: bool) -> dict[str, object]:
    kind = {"type": "log", "dtick": 1} if log else {"type": "linear"}
    return {"title": label, "linecolor": "#8a93a3", **kind}


def _replay_data(replay: Replay) -> dict[str, object]:
    return {
        "title": replay.title,
        "dt": _REPLAY_DT,
        "poster": _poster(replay),
        "markers": [asdict(marker) for marker in replay.markers],
        "takes": [_take_data(take) for take in replay.takes],
    }


def _poster(replay: Replay) -> float:
    """The moment that a replay shows first: that of the greatest lean of a robot that does not fall, s."""
    standing = [take.trajectory for take in replay.takes if not take.failed] or [
        take.trajectory for take in replay.takes
    ]
    leaning = max(standing, key=lambda trajectory: trajectory.tilt.max())
    return float(leaning.t[leaning.tilt.argmax()])


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
