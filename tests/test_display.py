"""How trajectories, episodes, optima and rows show themselves."""

import math
import re
import sys
import types
import webbrowser
from dataclasses import replace

import numpy as np
import pytest
from browser import start_chromium
from builders import result
from matplotlib.figure import Figure
from selenium.webdriver.support.ui import WebDriverWait

from ballbot_baselines import Optimum
from ballbot_gym.rollout import Episode
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.results import leaderboard

GATE = Marker((1.0, 0.5), 0.3, 0.9, (0.8, 0.1, 0.1, 1.0))


def ride(n=1000):
    """A long ride that leans to 0.5 rad, at 2 m/s."""
    x = np.zeros((n + 1, 8))
    x[:, 0], x[:, 4] = np.linspace(0, 2e-3 * n, n + 1), 2.0
    x[:, 2] = 0.5 * np.sin(np.linspace(0, math.pi, n + 1))
    return Trajectory(1e-3 * np.arange(n + 1), x, np.full((n, 2), 30.0))


def episode(motion):
    return Episode(motion, np.zeros(0), 12.345, True, False, 0.8, 0.1, 1e-3, (GATE,))


def optimum(motion):
    return Optimum(10.0, motion, "optimal", "solved", 1e-9, 12, "ipopt", 0.5, np.zeros((1001, 8)))


SHOWN = {
    "trajectory": (ride(), "peak tilt 28.6°"),
    "episode": (episode(ride()), "cost 12.35"),
    "optimum": (optimum(ride()), "status optimal"),
    "row": (
        *leaderboard([replace(result(controller="<b>mine", cost=12.0 + i), episode=i) for i in range(5)]),
        "mean regret",
    ),
}


@pytest.mark.parametrize("name", SHOWN)
def test_what_is_shown_is_a_short_line(name):
    shown, line = SHOWN[name]
    assert line in repr(shown)
    assert len(repr(shown)) < 140


def test_what_is_plotted_is_a_figure_of_all():
    shown = episode(ride())
    figure = shown.plot(shown)
    assert isinstance(figure, Figure)
    texts = " ".join(text.get_text() for text in figure.findobj(match=lambda artist: hasattr(artist, "get_text")))
    assert all(f"Episode {i}" in texts for i in (1, 2))


def test_a_replay_opens_in_the_browser_and_is_small(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    page = episode(ride()).show(optimum(ride()), labels=("mine", "<i>best"))
    assert opened == [page.as_uri()]
    assert page.stat().st_size < 100_000
    chromium = start_chromium(tmp_path, "900,600")
    try:
        chromium.get(page.as_uri())
        ready = "return document.querySelector('.replay').dataset.ready === 'true'"
        WebDriverWait(chromium, 60).until(lambda browser: browser.execute_script(ready))
        names = [element.text for element in chromium.find_elements("css selector", ".caption b")]
        assert names == ["mine", "<i>best"]
        assert [entry for entry in chromium.get_log("browser") if entry["level"] == "SEVERE"] == []
    finally:
        chromium.quit()


def test_in_a_notebook_a_replay_is_a_frame_below_the_cell(monkeypatch):
    shown = []
    display = types.SimpleNamespace(display=shown.append, HTML=str)
    shell = types.SimpleNamespace(kernel=None)
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    assert ride().show(robot="kugle") is None
    assert re.search(r'<iframe srcdoc="&lt;!doctype html.*style="width:100%;height:\d+px', shown[0], flags=re.DOTALL)


@pytest.mark.parametrize(
    ("show", "message"),
    [
        (lambda: ride().show(labels=("a", "b")), "labels names 2 of 1 motions; give one for each"),
        (lambda: ride().plot(ride(), labels=("a",)), "labels names 1 of 2 motions"),
        (lambda: Trajectory(np.zeros(1), np.zeros((1, 8)), np.zeros((0, 2))).show(), "a single state: nothing moves"),
        (lambda: ride().show(robot="none"), "unknown robot 'none'"),
    ],
)
def test_what_cannot_be_shown_says_why(show, message):
    with pytest.raises(ValueError, match=message):
        show()
