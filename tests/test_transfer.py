"""`ballbot transfer` in several physics engines."""

import csv
import re
import sys

import pytest

from ballbot_gym.engines import installed_physics
from ballbot_train.commands.transfer import transfer

OTHERS = [name for name in installed_physics() if name != "rk4"]


@pytest.mark.skipif(not OTHERS, reason="the closed form is the only physics here")
def test_transfer_over_engines_has_a_row_for_each(tmp_path):
    other = OTHERS[-1]
    about = {"tasks": ("stabilize",), "controllers": ("lqr",), "made_for": ("rolling",), "workers": 1}
    transfer(robot="rolling", physics=("rk4", other), episodes=3, out=tmp_path, **about)
    rows = list(csv.DictReader((tmp_path / "transfer.csv").open()))
    assert [row["physics"] for row in rows] == ["rk4", other]
    assert rows[0]["success"] < rows[1]["success"]  # to slip is a failure in the closed form alone
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
