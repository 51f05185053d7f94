import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from builders import stress_result as result

from ballbot_gym.robot import Randomization
from ballbot_train.evaluation import robustness, runner
from ballbot_train.evaluation.results import leaderboard, write_results
from ballbot_train.evaluation.robustness import NONE, STRESSES
from ballbot_train.report import figures


@pytest.mark.parametrize("name", STRESSES)
def test_severity_0_is_no_disturbance_and_every_level_is_one(name):
    stress = STRESSES[name]
    assert stress.at(0.0) == replace(Randomization(), push_interval=stress.at(0.0).push_interval)
    for level in stress.levels:
        assert level != 0
        assert stress.at(level).active


def run(stress, episodes, out, seed=0):
    groups = robustness.groups_of({"stabilize": ["lqr"]}, [stress], "rk4")
    return runner.MeasuredRun(out).measure(groups, episodes, seed)


def test_the_undisturbed_rows_are_those_of_the_leaderboard(tmp_path):
    results = run("delay", 3, tmp_path)
    plain = runner.MeasuredRun(tmp_path / "plain").measure([runner.Group("stabilize", "lqr", "rk4")], 3)
    rows = leaderboard(results)
    assert [tuple(row.labels.values()) for row in rows] == [(NONE, 0), ("delay", 20), ("delay", 40), ("delay", 60)]
    assert rows[0].cost_mean == leaderboard(plain)[0].cost_mean
    costs = [row.cost_mean for row in rows]
    assert costs[0] == min(costs)


def test_the_same_seed_draws_the_same_pushes(tmp_path):
    def costs(name, seed):
        return [result.cost for result in run("push", 1, tmp_path / name, seed)]

    first, again, other = costs("a", 0), costs("b", 0), costs("c", 1)
    assert first == again
    assert first[0] == other[0]  # undisturbed
    assert first[1:] != other[1:]


def test_files_hold_the_rows_and_the_figure_is_drawn(tmp_path):
    failed = {"failure": True, "success": False}
    results = [result(NONE, 0.0), result("mass", -20.0), result("mass", 20.0, **failed), result("lag", 20.0)]
    rows = leaderboard(results)
    write_results(rows, results, {"commit": "none"}, tmp_path, "robustness")
    document = json.loads((tmp_path / "robustness.json").read_text())
    assert [(row["stress"], row["level"]) for row in document["rows"]] == [tuple(r.labels.values()) for r in results]
    assert document["rows"][2]["regret_mean"] is None
    with (tmp_path / "robustness.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4
    curve = robustness.curve_of(rows, "stabilize", "lqr", "mass")
    np.testing.assert_array_equal([row.labels["level"] for row in curve], [-20, 0, 20])
    figure = figures.robustness_figure(rows, "stabilize")
    assert figures.save(figure, tmp_path / "curves.png").exists()
    ticks = [tick.get_text() for axis in figure.axes for tick in (*axis.get_xticklabels(), *axis.get_yticklabels())]
    assert "100" in ticks
    assert not any(
        "$" in tick for tick in ticks
    )  # logarithmic axes label their ticks by formulas, which are not parsed
