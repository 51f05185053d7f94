"""The plots of the live page: tilts, forces, costs and computing times of the last seconds."""

from typing import Any

import numpy as np

from ballbot_train.play import views
from ballbot_train.play.simulation import Playground
from ballbot_train.report import labels

MOST_GHOSTS = 4
"""Ghosts that the plots have lines for."""

_POINTS = 200
_WIDTH, _HEIGHT = 300, 150  # px
_PLOTS = (  # title, column of `History.lines`, factor to the unit shown, and what the scale reaches at least
    ("tilt, °", 0, 180 / np.pi, 10.0),
    ("force, N", 1, 1.0, 50.0),
    ("cost so far, and the optimum's dashed", 2, 1.0, 1.0),
    ("controller time, ms", 3, 1e3, 5.0),
)
_COST = 2  # the column beside which the optimum is drawn


class Plots:
    """Draws the history of a playground.

    Plots always have the same number of lines, because a browser that is late could not tell old plots from new ones.
    """

    def __init__(self, playground: Playground, gui: Any):
        """Adds the plots' panel to viser's page."""
        self._playground = playground
        panel = gui.add_panel(order=10)
        with panel.add_tab("Plots"):
            self._plots = [self._add(gui, *kind) for kind in _PLOTS]
        panel.dock_left()
        panel.set_width(_WIDTH)
        self._shown: dict[str, str] = {}

    def show(self) -> None:
        """Draws the last seconds."""
        history = views.history(self._playground, _POINTS)
        colors = views.colors(self._playground)
        hidden = 1 + MOST_GHOSTS - len(colors)
        lines = [
            history.lines[name] for name in (*colors, *[next(iter(colors))] * hidden)
        ]  # hidden lines repeat the first
        for plot, (_, column, factor, _) in zip(self._plots, _PLOTS, strict=True):
            if self._shown != colors:
                plot.series = _series(colors, column)
            optimum = (history.optimum,) * (column == _COST)
            plot.data = (history.seconds, *(factor * line[:, column] for line in lines), *optimum)
        self._shown = colors

    def _add(self, gui: Any, title: str, column: int, factor: float, least: float) -> Any:
        series = _series({}, column)
        vertical = {"min": {"soft": 0.0, "mode": 1, "pad": 0.0}, "max": {"soft": least, "mode": 1, "pad": 0.1}}
        return gui.add_uplot(
            (np.zeros(2),) * len(series),
            series,
            title=title,
            scales={"x": {"time": False}, "y": {"range": vertical}},
            legend={"show": False},
            height=_HEIGHT,
            padding=(4, 8, 0, 0),
        )


def _series(colors: dict[str, str], column: int) -> tuple[dict[str, Any], ...]:
    """uPlot's description of the lines: times, the robots by name and colour, hidden ones, and the optimum beside costs."""
    lines: list[dict[str, Any]] = [
        {"label": labels.label(name), "stroke": color, "width": 1.0 if i else 2.0}
        for i, (name, color) in enumerate(colors.items())
    ]
    lines += [{"label": " ", "show": False}] * (1 + MOST_GHOSTS - len(colors))
    if column == _COST:
        lines.append({"label": "optimum", "stroke": "#222222", "width": 1.0, "dash": (4, 3)})
    return {"label": "s"}, *lines
