"""`show` and `plot` of trajectories, episodes and optima: 3D replays, below a notebook's cell too, and figures."""

import html
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from matplotlib.figure import Figure

from ballbot_gym import files
from ballbot_gym.robot import Robot, checked_robot
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Moving
from ballbot_train.report import figures, labels
from ballbot_train.report.page import report_page
from ballbot_train.report.replay import Replay, Take

_HEIGHT = 520  # px of a replay below a cell


def show_motions(shown: Sequence[Moving], names: Sequence[str], robot: str | Robot) -> Path | None:
    """See `ballbot_gym.trajectory.Moving.show`."""
    takes = tuple(take.playable() for take in _takes(shown, names))
    title = " and ".join(take.label for take in takes)
    page = report_page(title, [Replay(title, takes, _markers(shown), checked_robot(robot))])
    if _in_notebook():
        style = f"width:100%;height:{_HEIGHT}px;border:0"
        frame = f'<iframe srcdoc="{html.escape(page)}" title="replay" style="{style}"></iframe>'
        display = import_module("IPython.display")
        display.display(display.HTML(f"<div>{frame}</div>"))  # IPython warns of an iframe alone
        return None
    path = files.write(Path(tempfile.mkdtemp(prefix="ballbot-")) / "replay.html", page)
    webbrowser.open(path.as_uri())
    return path


def plot_motions(shown: Sequence[Moving], names: Sequence[str]) -> Figure:
    """See `ballbot_gym.trajectory.Moving.plot`."""
    figure = figures.trajectory_figure("", _takes(shown, names), _markers(shown))
    if _in_notebook():  # so that it shows figures as pictures, also those that pyplot did not make
        import_module("matplotlib_inline.backend_inline")
    return figure


def _takes(shown: Sequence[Moving], names: Sequence[str]) -> list[Take]:
    if names and len(names) != len(shown):
        raise ValueError(f"labels names {len(names)} of {len(shown)} motions; give one for each")
    kinds = [type(one).__name__ for one in shown]
    alone = len(kinds) == len(set(kinds))
    names = names or [kind if alone else f"{kind} {i}" for i, kind in enumerate(kinds, 1)]
    return [
        Take(name, one.motion, labels.color(name.lower(), i))
        for i, (name, one) in enumerate(zip(names, shown, strict=True))
    ]


def _markers(shown: Sequence[Moving]) -> tuple[Marker, ...]:
    return tuple(dict.fromkeys(marker for one in shown for marker in getattr(one, "markers", ())))


def _in_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")
