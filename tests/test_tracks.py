"""Controllers on robots that nobody told them."""

import csv

import pytest

pytest.importorskip("casadi")
pytest.importorskip("torch")

from ballbot_gym import certified
from ballbot_gym.randomization import TRACKS
from ballbot_train import evaluate
from ballbot_train.commands.benchmark import benchmark


def test_table_of_tracks_splits_regret_and_says_what_evaluate_says(tmp_path):
    options = {"tasks": ("orbit",), "controllers": ("trajopt", "lqr"), "episodes": 3, "physics": "rk4", "workers": 1}
    benchmark(**options, randomization=("unknown", "late"), out=tmp_path)
    table = csv.DictReader((tmp_path / "tracks.csv").read_text().splitlines())
    rows = {(row["track"], row["controller"]): row for row in table}
    assert len(rows) == 4
    for (track, controller), row in rows.items():
        same = evaluate(controller, "orbit", 3, "rk4", randomization=track)
        assert float(row["regret_mean"]) == pytest.approx(same.regret_mean, nan_ok=True)
        if row["falls"] == "0" and rows[track, row["best"]]["falls"] == "0":
            parts = float(row["not_knowing_costs"]) + float(row["controller_loses"])
            assert parts == pytest.approx(same.regret_mean)
        known = certified.load("orbit", "paper", randomization=TRACKS[track])
        delay = (1 - known.ideal[:3] / known.costs[:3]).mean()
        assert float(row["delay_costs"]) == pytest.approx(delay)
        assert (delay > 0) == (track == "late")
    best = rows["unknown", rows["unknown", "lqr"]["best"]]
    assert float(best["controller_loses"]) == 0 < float(best["not_knowing_costs"])
    assert (tmp_path / "tracks.md").read_text().count("orbit") == 4


def test_unknown_track_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(ValueError, match="unknown randomization 'windy'; known: 'unknown'"):
        benchmark(("orbit",), ("lqr",), randomization=("windy",), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
