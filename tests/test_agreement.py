"""Where physics engines disagree."""

import csv
import functools
import math
import re
import sys

import pytest

from ballbot_gym.engines import installed_physics
from ballbot_train.commands.transfer import transfer
from ballbot_train.evaluation.agreement import disagreements, drifts
from ballbot_train.evaluation.results import Result
from ballbot_train.report.film import write_film

OTHERS = [name for name in installed_physics() if name != "rk4"]


def result(episode, physics, cost=110.0, success=True, failure=False):
    measured = dict.fromkeys(("peak_tilt", "settle_time", "duration", "plan_seconds", "step_seconds"), 1.0)
    told = {"made_for": "paper", "robot": "paper", "friction": math.inf}
    return Result("turn", "lqr", episode, physics, cost, 100.0, success, failure, told=told, **measured)


def test_episodes_that_end_otherwise_are_named_and_regret_is_of_those_that_end_well_in_both():
    results = [
        *(result(episode, "rk4") for episode in range(4)),
        result(0, "mujoco", cost=111.0),
        result(1, "mujoco", success=False, failure=True),
        result(2, "mujoco", cost=113.0, success=False),
        result(3, "mujoco"),
    ]
    (found,) = disagreements(results)
    assert (found.first, found.second, found.episodes, found.of, found.both) == ("rk4", "mujoco", (1, 2), 4, 3)
    assert found.regret == pytest.approx((0.01 + 0.03 + 0.0) / 3)


@pytest.mark.skipif(not OTHERS, reason="the closed form is the only physics here")
def test_the_same_forces_lead_farther_apart_the_longer_they_last():
    for other in OTHERS:
        found = drifts("stabilize", "paper", "lqr", ["rk4", other], 2)
        assert [drift["seconds"] for drift in found] == [0.1, 0.25, 0.5, 1.0, 2.0]
        assert found[0]["median"] < found[-1]["median"]
        # derived from the engines' orders: Bullet's error after half a second is millimetres, MuJoCo's nanometres
        assert found[2]["worst"] < {"bullet": 0.05, "mujoco": 1e-5}[other]


@pytest.mark.skipif(not OTHERS, reason="the closed form is the only physics here")
def test_transfer_over_engines_writes_where_they_disagree_and_a_film(tmp_path, monkeypatch):
    monkeypatch.setattr("ballbot_train.commands.transfer.write_film", functools.partial(write_film, fps=2))
    other = OTHERS[-1]
    about = {"tasks": ("stabilize",), "controllers": ("lqr",), "made_for": ("rolling",), "workers": 1}
    transfer(robot="rolling", physics=("rk4", other), episodes=3, out=tmp_path, **about)
    rows = list(csv.DictReader((tmp_path / "transfer.csv").open()))
    assert [row["physics"] for row in rows] == ["rk4", other]
    assert rows[0]["success"] < rows[1]["success"]  # to slip is a failure in the closed form alone
    (differs,) = csv.DictReader((tmp_path / "engines.csv").open())
    assert differs["episodes"] != "()"
    assert (tmp_path / "differs-stabilize-lqr.webp").stat().st_size > 1000
    with pytest.raises(ValueError, match="a physics is given more than once: rk4 rk4"):
        transfer(robot="rolling", physics=("rk4", "rk4"), out=tmp_path, **about)


@pytest.mark.parametrize(
    ("physics", "library", "how"),
    [("bullet", "pybullet", "pip install pybullet"), ("mujoco", "mujoco", "ballbot-gym[mujoco]")],
)
def test_an_engine_that_is_not_installed_is_noticed_before_any_episode(tmp_path, monkeypatch, physics, library, how):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=re.escape(how)):
        transfer(physics=("rk4", physics), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
