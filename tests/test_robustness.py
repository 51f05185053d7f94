import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from ballbot_gym.randomization import Randomization
from ballbot_train.evaluation import evaluate, robustness
from ballbot_train.evaluation.robustness import NONE, STRESSES, StressResult
from ballbot_train.report import figures


@pytest.mark.parametrize("name", STRESSES)
def test_severity_0_is_no_disturbance_and_every_level_is_one(name):
    stress = STRESSES[name]
    assert stress.at(0.0) == replace(Randomization(), push_interval=stress.at(0.0).push_interval)
    for level in stress.levels:
        assert level != 0
        assert stress.at(level).active


def test_the_undisturbed_rows_are_those_of_the_leaderboard(tmp_path):
    results = robustness.run({"stabilize": ["lqr"]}, ["delay"], 3, "rk4", tmp_path, 1, lambda name, count: None)
    plain = evaluate.benchmark({"stabilize": ["lqr"]}, 3, "rk4", tmp_path / "plain", 1, lambda name, count: None)
    rows = robustness.rows_of(results)
    assert [(row.stress, row.level) for row in rows] == [(NONE, 0), ("delay", 20), ("delay", 40), ("delay", 60)]
    assert rows[0].cost_mean == evaluate.summarize(plain).cost_mean
    costs = [row.cost_mean for row in rows]
    assert costs[0] == min(costs)


def test_the_same_seed_draws_the_same_pushes(tmp_path):
    def costs(name, seed):
        results = robustness.run(
            {"stabilize": ["lqr"]}, ["push"], 1, "rk4", tmp_path / name, 1, lambda name, count: None, seed
        )
        return [result.cost for result in results]

    first, again, other = costs("a", 0), costs("b", 0), costs("c", 1)
    assert first == again
    assert first[0] == other[0]  # undisturbed
    assert first[1:] != other[1:]


def result(stress, level, **changes):
    fields = {
        "task": "turn",
        "controller": "lqr",
        "episode": 0,
        "physics": "rk4",
        "cost": 12.0,
        "optimum": 10.0,
        "success": True,
        "failure": False,
        "peak_tilt": 30.0,
        "settle_time": math.nan,
        "duration": 2.0,
        "plan_seconds": 0.1,
        "step_seconds": 1e-5,
        "stress": stress,
        "level": level,
    }
    return StressResult(**(fields | changes))


def test_files_hold_the_rows_and_the_figure_is_drawn(tmp_path):
    failed = {"failure": True, "success": False}
    results = [result(NONE, 0.0), result("mass", -20.0), result("mass", 20.0, **failed), result("lag", 20.0)]
    rows = robustness.rows_of(results)
    robustness.write(rows, results, {"commit": "none"}, tmp_path)
    document = json.loads((tmp_path / "robustness.json").read_text())
    assert [(row["stress"], row["level"]) for row in document["rows"]] == [(r.stress, r.level) for r in results]
    assert document["rows"][2]["regret_mean"] is None
    with (tmp_path / "robustness.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4
    curve = robustness.curve_of(rows, "turn", "lqr", "mass")
    np.testing.assert_array_equal([row.level for row in curve], [-20, 0, 20])
    assert figures.save(figures.robustness_figure(rows, "turn"), tmp_path / "curves.png").exists()
