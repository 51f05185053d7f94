import csv
import json
import math

import numpy as np
import pytest

from ballbot_baselines.controller import FunctionController
from ballbot_gym.env import BallbotEnv
from ballbot_train import evaluate
from ballbot_train.evaluate import Result


def result(**changes):
    fields = {
        "task": "stabilize",
        "controller": "lqr",
        "episode": 0,
        "physics": "rk4",
        "cost": 12.0,
        "optimum": 10.0,
        "success": True,
        "failure": False,
        "peak_tilt": 30.0,
        "settle_time": 2.0,
        "duration": 8.0,
        "plan_seconds": 0.1,
        "step_seconds": 1e-5,
    }
    return Result(**(fields | changes))


def test_regret_is_the_cost_above_the_optimum_and_failed_episodes_have_none():
    assert result().regret == pytest.approx(0.2)
    assert math.isnan(result(failure=True, success=False).regret)


def test_a_row_counts_falls_and_takes_regret_over_standing_episodes():
    row = evaluate.summarize(
        [
            result(),
            result(episode=1, cost=14.0, success=False),
            result(episode=2, cost=1010.0, success=False, failure=True),
        ]
    )
    assert (row.episodes, row.falls) == (3, 1)
    assert row.success == pytest.approx(1 / 3)
    assert row.regret_mean == pytest.approx(0.3)
    assert row.cost_mean == pytest.approx((12 + 14 + 1010) / 3)


def test_the_episodes_of_every_controller_are_the_certified_ones():
    env = BallbotEnv("stabilize", physics="rk4")
    idle = FunctionController(lambda t, x: np.zeros(2))
    results = evaluate.run_episodes(env, idle, "idle", "stabilize", range(3))
    assert [r.episode for r in results] == [0, 1, 2]
    assert all(r.failure and r.cost > env.task.failure_cost for r in results)  # without a force the robot falls


def test_an_interrupted_benchmark_continues_without_running_anything_again(tmp_path, monkeypatch):
    arguments = (["stabilize"], ["lqr"], 4, "rk4", tmp_path, 1)
    monkeypatch.setattr(evaluate, "_CHUNK", 2)
    first = evaluate.benchmark(*arguments, on_progress=lambda task, count: None)
    (tmp_path / "episodes" / "stabilize-lqr-rk4-002-004.json").unlink()  # as if killed after the first chunk
    untouched = tmp_path / "episodes" / "stabilize-lqr-rk4-000-002.json"
    kept = json.loads(untouched.read_text())
    kept[0]["cost"] = 123.0  # would be overwritten if the episode ran again
    untouched.write_text(json.dumps(kept))
    again = evaluate.benchmark(*arguments, on_progress=lambda task, count: None)
    assert [r.episode for r in again] == [0, 1, 2, 3]
    assert again[0].cost == 123.0
    assert [r.cost for r in again[1:]] == [r.cost for r in first[1:]]


def test_the_leaderboard_files_hold_what_was_measured(tmp_path):
    results = [result(), result(controller="trajopt", cost=10.0, settle_time=math.nan)]
    rows = evaluate.leaderboard(results)
    evaluate.write_leaderboard(rows, results, {"commit": "none"}, tmp_path)
    with (tmp_path / "leaderboard.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [entry["controller"] for entry in table] == ["lqr", "trajopt"]
    assert float(table[0]["regret_mean"]) == pytest.approx(0.2)
    document = json.loads((tmp_path / "leaderboard.json").read_text())
    assert document["rows"][1]["settle_time_median"] is None  # NaN is no JSON
    assert document["about"] == {"commit": "none"}


def test_an_unknown_controller_is_an_error_that_names_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown controller pid; known: lqr, trajopt"):
        evaluate.check_names("controller", ["pid"], ["lqr", "trajopt"])
