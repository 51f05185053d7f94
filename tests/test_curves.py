"""Trainings on several seeds, and their learning curves."""

import json

import numpy as np
import pytest

from ballbot_gym import files
from ballbot_train.commands.curves import curves
from ballbot_train.report import curves as report


def a_run(folder, seed, regrets, learner="ppo", task="stabilize", settings=None, cpu=True, steps=1000):
    files.write(
        folder / "config.json",
        json.dumps({"learner": learner, "task": task, "seed": seed, "settings": settings or {}, "about": {}}),
    )
    rows = [
        {
            "iteration": i,
            "seconds": 120.0 * i,
            **({"cpu_seconds": 60.0 * i, "env_steps": float(steps * i)} if cpu else {}),
            "cost_ratio": 1 + regret,
            "success": 0.5,
            "failures": 3,
        }
        for i, regret in enumerate(regrets)
    ]
    files.write_csv(folder / "evaluations.csv", rows)


def test_the_interquartile_mean_leaves_out_the_best_and_the_worst_of_five():
    values = np.array([[1.0], [2.0], [3.0], [10.0], [-50.0]])
    assert report.interquartile_mean(values)[0] == pytest.approx(2.0)
    assert report.interquartile_mean(values[:2])[0] == pytest.approx(1.5)


def test_a_curve_is_of_all_seeds_and_ends_where_the_first_of_them_ends(tmp_path):
    a_run(tmp_path / "seed-0", 0, [4.0, 2.0, 0.0])
    a_run(tmp_path / "seed-1", 1, [4.0, 4.0])
    (curve,) = report.read_curves([tmp_path])
    x, middle, low, high = curve.against("env_steps")
    assert (x[0], x[-1]) == (0.0, 1000.0)
    assert (middle[0], middle[-1]) == pytest.approx((4.0, 3.0))
    assert (low[-1], high[-1]) == pytest.approx((2.0, 4.0))
    assert curve.against("minutes")[0][-1] == pytest.approx(1.0)


def test_settings_of_one_learner_are_curves_of_their_own(tmp_path):
    for seed in (0, 1):
        a_run(tmp_path / "with" / f"seed-{seed}", seed, [1.0, 0.5])
        a_run(tmp_path / "without" / f"seed-{seed}", seed, [1.0, 0.9], settings={"products": False})
    a_run(tmp_path / "sac", 0, [1.0, 0.7], learner="sac")
    made = report.read_curves([tmp_path / "with", tmp_path / "without", tmp_path / "sac"])
    assert [(curve.label, len(curve.runs)) for curve in made] == [("PPO, with", 2), ("PPO, without", 2), ("SAC", 1)]


def test_the_command_writes_figure_points_and_table(tmp_path, capsys):
    for task in ("stabilize", "turn"):
        a_run(tmp_path / task, 0, [1.0, 0.5], task=task)
    curves((tmp_path / "stabilize", tmp_path / "turn"), out=tmp_path / "out")
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")
    table = (tmp_path / "out" / "curves.csv").read_text()
    assert 'turn,PPO,1,"1,000",1.0,"0.5 [0.5, 0.5]",0.5,0.5,50.0%,3' in table
    assert "where the curves end" in capsys.readouterr().out


def test_folders_without_trainings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no training"):
        curves((tmp_path,))
    a_run(tmp_path, 0, [1.0])
    (tmp_path / "evaluations.csv").write_text("iteration\n1\n")
    with pytest.raises(ValueError, match="or a damaged one"):
        curves((tmp_path,))
