"""Controllers on robots that nobody told them."""

import csv

import numpy as np
import pytest

pytest.importorskip("casadi")
pytest.importorskip("torch")

from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.randomization import TRACKS
from ballbot_gym.tasks import TASKS
from ballbot_train import evaluate
from ballbot_train.commands.benchmark import benchmark
from ballbot_train.evaluation.fresh import evaluate_fresh
from ballbot_train.policy import load_network
from ballbot_train.policy_files import read_description, shipped_policies, track_in


def test_table_of_tracks_splits_regret_and_says_what_evaluate_says(tmp_path):
    options = {"tasks": ("orbit",), "controllers": ("trajopt", "lqr"), "episodes": 2, "physics": "rk4", "workers": 1}
    benchmark(**options, randomization=("unknown", "late"), out=tmp_path)
    table = csv.DictReader((tmp_path / "tracks.csv").read_text().splitlines())
    rows = {(row["track"], row["controller"]): row for row in table}
    assert len(rows) == 4
    for (track, controller), row in rows.items():
        same = evaluate(controller, "orbit", 2, "rk4", randomization=track)
        assert float(row["regret_mean"]) == pytest.approx(same.regret_mean, nan_ok=True)
        if row["falls"] == "0" and rows[track, row["best"]]["falls"] == "0":
            parts = float(row["not_knowing_costs"]) + float(row["controller_loses"])
            assert parts == pytest.approx(same.regret_mean)
        known = certified.load("orbit", "paper", randomization=TRACKS[track])
        delay = (1 - known.ideal[:2] / known.costs[:2]).mean()
        assert float(row["delay_costs"]) == pytest.approx(delay)
        assert (delay > 0) == (track == "late")
    best = rows["unknown", rows["unknown", "lqr"]["best"]]
    assert float(best["controller_loses"]) == 0 < float(best["not_knowing_costs"])
    assert (tmp_path / "tracks.md").read_text().count("orbit") == 4


def test_unknown_track_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(ValueError, match="unknown randomization 'windy'; known: 'unknown'"):
        benchmark(("orbit",), ("lqr",), randomization=("windy",), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


SHIPPED = [
    (name, learner, track)
    for name in TASKS
    for track in TRACKS
    for learner in shipped_policies(make_task(name), track=track)
    if track_in(learner) == track
]


@pytest.mark.parametrize(("name", "learner", "track"), SHIPPED, ids=["-".join(each[:2]) for each in SHIPPED])
def test_policy_of_a_track_is_what_its_file_says(name, learner, track):
    """It comes with the package, runs on its track alone unless it is named, and does there what it measured."""
    path = shipped_policies(make_task(name), track=track)[learner]
    described = read_description(path)
    assert described["training"]["randomization"] == track
    assert learner not in shipped_policies(make_task(name))
    row = evaluate(learner, name, 10, "rk4", randomization=track)
    assert row.success >= described["measured"]["success"] - 0.3
    assert sum(part.numel() for part in load_network(path, make_task(name)).parameters()) <= 50_000


def test_fresh_episodes_of_a_track_draw_robots_and_say_what_each_costs():
    result = evaluate_fresh("shac", "turn", 20, randomization="unknown")
    plain = evaluate_fresh("shac", "turn", 20)
    np.testing.assert_array_equal(result.states, plain.states)
    assert (result.costs != plain.costs).all()
    assert set(result.measures) > {"body_mass", "com_height", "force"}
    assert 0.7 <= result.measures["body_mass"].min() < result.measures["body_mass"].max() <= 1.4
