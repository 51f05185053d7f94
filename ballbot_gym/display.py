"""How trajectories, episodes, optima and leaderboard rows show themselves: a line, and in notebooks a table with a picture.

Their 3D replays and figures are drawn by `ballbot_train.report`, which is imported when it is asked for.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ballbot_gym import drawing, lazy
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks.marker import Marker

if TYPE_CHECKING:
    from ballbot_gym.trajectory import Trajectory

_WIDTH, _HEIGHT, _MARGIN = 310, 220, 38  # px of a panel
_MOST_POINTS = 200  # of a line in a picture


class Displayed:
    """What shows itself by its facts and a picture."""

    def facts(self) -> dict[str, str]:
        """What there is to say in a line: figures with their units, by what they are."""
        raise NotImplementedError

    def _table(self) -> dict[str, str]:
        return self.facts()

    def _picture(self) -> str:
        """An SVG."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name} {value}' for name, value in self.facts().items())})"

    def _repr_html_(self) -> str:
        cell = '<t{0} style="text-align:left">{1}</t{0}>'
        rows = (
            cell.format("h", html.escape(name)) + cell.format("d", html.escape(value))
            for name, value in self._table().items()
        )
        table = "<table>" + "".join(f"<tr>{row}</tr>" for row in rows) + "</table>"
        line = '<div style="display:flex;flex-wrap:wrap;align-items:center;gap:1em">'
        return f"{line}{table}{self._picture()}</div>"


class Moving(Displayed):
    """What shows a motion."""

    @property
    def motion(self) -> Trajectory:
        """The motion that is shown."""
        return getattr(self, "trajectory")  # noqa: B009 (a field of the subclasses)

    def _table(self) -> dict[str, str]:
        return self.facts() | self.motion.facts()

    def _picture(self) -> str:
        return motion_svg(self.motion, getattr(self, "markers", ()))

    def show(self, *others: Moving, labels: Sequence[str] = (), robot: str | BallbotParams = "paper") -> Path | None:
        """The replay in 3D: in a Jupyter notebook below the cell, elsewhere in the browser.

        Args:
            others: trajectories, episodes or optima to show beside it.
            labels: a name for each; default, what they are.
            robot: what is drawn, a name in `ROBOTS` or its parameters.

        Returns:
            The page that was written and opened; None in a notebook.

        Raises:
            ModuleNotFoundError: the extra that draws is not installed; the message names it.
            ValueError: no such robot, another number of labels, or a single state, in which nothing moves.
        """
        return lazy.load("ballbot_train.report.notebook:show_motions")((self, *others), labels, robot)

    def plot(self, *others: Moving, labels: Sequence[str] = ()) -> Any:
        """A matplotlib Figure of positions, velocities, leans, forces and the path. Arguments and errors: as of `show`."""
        return lazy.load("ballbot_train.report.notebook:plot_motions")((self, *others), labels)


def motion_svg(trajectory: Trajectory, markers: Sequence[Marker] = ()) -> str:
    """The path seen from above, and the tilt over time, as an SVG."""
    chosen = np.unique(np.linspace(0, len(trajectory.t) - 1, _MOST_POINTS).astype(int))
    x = trajectory.x[chosen]
    tilt = np.column_stack([trajectory.t, np.degrees(trajectory.tilt)])[chosen]
    seconds = np.array([trajectory.t[[0, -1]], [0, 10]]).T  # what the axes show at least
    panels = _panel(x[:, :2], "from above, m", markers=markers) + (
        f'<g transform="translate({_WIDTH},0)">{_panel(tilt, "tilt, deg, over time, s", least=seconds)}</g>'
    )
    return svg(2 * _WIDTH, _HEIGHT, panels)


def svg(width: int, height: int, body: str) -> str:
    """An SVG in the colours of the page around it."""
    style = f"flex:1 1 {2 * width // 3}px;max-width:{width}px;font:11px sans-serif"
    return f'<svg viewBox="0 0 {width} {height}" style="{style}" fill="none" stroke-width="2" role="img">{body}</svg>'


def text(x: float, y: float, words: str, anchor: str = "start") -> str:
    """A text of an SVG."""
    return f'<text x="{x:.0f}" y="{y:.0f}" fill="currentColor" text-anchor="{anchor}">{html.escape(words)}</text>'


def _panel(line: np.ndarray, title: str, markers: Sequence[Marker] = (), least: np.ndarray | None = None) -> str:
    """A line (n, 2) in a frame that names the ends of its axes. Without `least` (2, 2) both axes have one scale, as a map."""
    rims = [np.array(marker.position) + side * marker.radius for marker in markers for side in (-1, 1)]
    corners = np.array([*line, *rims]) if least is None else np.concatenate([line, least])
    low, high = corners.min(axis=0), corners.max(axis=0)
    space = np.array([_WIDTH, _HEIGHT]) - 2 * _MARGIN
    scale = space / np.maximum(high - low, 1e-3)
    if least is None:
        scale = np.full(2, scale.min())
        low, high = ((low + high) / 2 + side * space / scale / 2 for side in (-1, 1))
    origin = (_MARGIN, _HEIGHT - _MARGIN)
    places = (line - low) * scale * (1, -1) + origin
    parts = [f'<rect x="{_MARGIN}" y="{_MARGIN}" width="{space[0]}" height="{space[1]}" stroke="#8888"/>']
    for marker in markers:
        x, y = (np.array(marker.position) - low) * scale * (1, -1) + origin
        color = "rgb({:.0%},{:.0%},{:.0%})".format(*marker.color[:3])
        kind = f'stroke="{color}" stroke-dasharray="4"' if marker.ring else f'fill="{color}" opacity="0.5"'
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{max(marker.radius * scale[0], 2):.1f}" {kind}/>')
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    parts.append(f'<polyline points="{points}" stroke="{drawing.BODY}"/>')
    parts.append('<circle cx="{:.1f}" cy="{:.1f}" r="4" fill="{}"/>'.format(*places[0], drawing.BODY))
    bottom, right = _HEIGHT - _MARGIN, _WIDTH - _MARGIN
    parts += [text(_WIDTH / 2, _MARGIN - 8, title, "middle")]
    parts += [text(_MARGIN, bottom + 14, f"{low[0]:.3g}"), text(right, bottom + 14, f"{high[0]:.3g}", "end")]
    parts += [
        text(_MARGIN - 3, bottom, f"{low[1]:.3g}", "end"),
        text(_MARGIN - 3, _MARGIN + 9, f"{high[1]:.3g}", "end"),
    ]
    return "".join(parts)


def percent(share: float) -> str:
    """A share in words, "–" where there is none."""
    return f"{100 * share:.2f} %" if math.isfinite(share) else "–"
