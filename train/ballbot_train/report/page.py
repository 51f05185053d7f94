"""One self-contained HTML page: tables that sort, figures, and a replay in 3D.

Everything is embedded, so the file opens offline and can be moved. The templates, scripts and styles are in `assets/`. The
templates escape all text.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from markupsafe import Markup

from ballbot_gym import files
from ballbot_gym.drawing import page
from ballbot_train.report.replay import Replay, Take
from ballbot_train.work.templates import render

_ASSETS = Path(__file__).parent / "assets"
_REPLAY_DT = 0.02  # s, between the states in the page


def report_page(
    title: str,
    replays: Sequence[Replay],
    header: Sequence[str] = (),
    rows: Sequence[Sequence[str]] = (),
    pictures: Mapping[str, Sequence[Path]] = {},
    facts: Mapping[str, object] = {},
) -> str:
    """The page of a leaderboard, or of replays alone, as HTML. What has no data is left out.

    Args:
        title: heading of the page.
        replays: episodes in 3D, one scene for each take, with play, pause and scrubbing.
        header: names of the table's columns.
        rows: of the table, which the reader can sort by any column.
        pictures: PNGs by the title above them, captioned with their names.
        facts: what the results depend on, such as versions; shown at the foot of the page.
    """
    episodes = [_episode_data(replay) for replay in replays if replay.takes]
    text = render(
        _ASSETS / "page.html.j2",
        title=title,
        header=header,
        rows=rows,
        data=page.look(replays[0].params) | {"episodes": episodes} if episodes else {},
        pictures={
            name: [{"name": each.stem, "base64": base64.b64encode(files.read(each)).decode()} for each in group]
            for name, group in pictures.items()
        },
        facts=facts,
        style=asset("style.css"),
        scripts=[asset("table.js"), Markup(page.asset("scene.js")), asset("replay.js")],
    )
    return str(text)


def asset(name: str) -> Markup:
    """The text of one of this package's own scripts or styles."""
    return Markup((_ASSETS / name).read_text(encoding="utf-8"))


def _episode_data(replay: Replay) -> dict[str, object]:
    """With the moment that is shown first: that of the greatest lean of a robot that does not fall."""
    standing = [take for take in replay.takes if not take.failed] or replay.takes
    leaning = max((take.trajectory for take in standing), key=lambda trajectory: trajectory.tilt.max())
    return {
        "title": replay.title,
        "dt": _REPLAY_DT,
        "poster": float(leaning.t[leaning.tilt.argmax()]),
        "markers": [asdict(marker) for marker in replay.markers],
        "takes": [_take_data(take) for take in replay.takes],
    }


def _take_data(take: Take) -> dict[str, object]:
    """Poses and forces at every `_REPLAY_DT`: 0.1 mm, 0.1 mrad and 1 N are enough to look at."""
    times = _REPLAY_DT * np.arange(math.floor(take.trajectory.duration / _REPLAY_DT + 1e-6) + 1)
    x = np.array([take.trajectory.state(t) for t in times])
    u = np.array([take.trajectory.force(t) for t in times])
    return {
        "label": take.label,
        "color": take.color,
        "note": take.note,
        "x": np.hstack([x[:, :4], x[:, 8:9]]).round(4).tolist(),  # with the heading of a robot with wheels
        "u": u.round().astype(int).tolist(),
    }
