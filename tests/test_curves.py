"""Trainings on several seeds, and their learning curves."""

import json
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from ballbot_gym import files
from ballbot_train.commands.curves import curves
from ballbot_train.commands.train import Run, train
from ballbot_train.learning import seeds
from ballbot_train.learning.learners import LEARNERS
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
    (curve,) = report.grouped(report.read_runs([tmp_path]))
    x, middle, low, high = curve.against("env_steps", "regret")
    assert (x[0], x[-1]) == (0.0, 1000.0)
    assert (middle[0], middle[-1]) == pytest.approx((4.0, 3.0))
    assert (low[-1], high[-1]) == pytest.approx((2.0, 4.0))
    assert curve.against("minutes", "regret")[0][-1] == pytest.approx(1.0)


def test_settings_of_one_learner_are_curves_of_their_own(tmp_path):
    for seed in (0, 1):
        a_run(tmp_path / "with" / f"seed-{seed}", seed, [1.0, 0.5])
        a_run(tmp_path / "without" / f"seed-{seed}", seed, [1.0, 0.9], settings={"products": False})
    a_run(tmp_path / "sac", 0, [1.0, 0.7], learner="sac")
    made = report.grouped(report.read_runs([tmp_path / "with", tmp_path / "without", tmp_path / "sac"]))
    assert [(curve.label, len(curve.runs)) for curve in made] == [("PPO, with", 2), ("PPO, without", 2), ("SAC", 1)]


def test_the_command_writes_figure_points_and_table(tmp_path, capsys):
    for task in ("stabilize", "turn"):
        a_run(tmp_path / task, 0, [1.0, 0.5], task=task)
    curves((tmp_path / "stabilize", tmp_path / "turn"), out=tmp_path / "out")
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "out" / "curves.csv").read_text().count("\n") == 401
    table = (tmp_path / "out" / "curves.md").read_text()
    assert "| turn | PPO | 1 | 1,000 | 1.0 | 0.5 [0.5, 0.5] | 0.5 | 0.5 | 50.0% | 3 |" in table
    assert "where the curves end" in capsys.readouterr().out


def test_folders_without_trainings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no training"):
        curves((tmp_path,))
    with pytest.raises(ValueError, match="unknown metric speed; known: regret"):
        curves((tmp_path,), metric="speed")
    a_run(tmp_path, 0, [1.0])
    (tmp_path / "evaluations.csv").write_text("iteration\n1\n")
    with pytest.raises(ValueError, match="or a damaged one"):
        curves((tmp_path,))


@pytest.mark.parametrize(("text", "expected"), [("0:3", (0, 1, 2)), ("4", (4,)), ("7,3", (7, 3))])
def test_seeds_are_named_as_a_range_or_a_list(text, expected):
    assert seeds.parse_seeds(text) == expected


@pytest.mark.parametrize("text", ["", "3:3", "a", "1,1", "-1", "0:5000", "1:2:3"])
def test_seeds_that_make_no_sense_are_refused(text):
    with pytest.raises(ValueError, match="seeds must be"):
        seeds.parse_seeds(text)


@pytest.fixture
def processes(monkeypatch):
    """In place of processes: what they were told, and what they would have written."""
    calls, fails = [], set()

    def run(words, **options):
        calls.append(words)
        seed, out = (words[words.index(name) + 1] for name in ("--seed", "--out"))
        options["stdout"].write(f"seed {seed} says\n")
        if seed in fails:
            return SimpleNamespace(wait=lambda: 1)
        settings = json.loads(json.dumps(asdict(LEARNERS["dagger"].settings("stabilize"))))
        training = {"learner": "dagger", "task": "stabilize", "seed": int(seed), "settings": settings}
        measured = {"success": 0.9 + 0.01 * int(seed), "falls": int(seed), "regret_mean": 0.1}
        described = {"spec": {"task": "x"}, "training": training, "training_seconds": 60.0, "measured": measured}
        files.write(f"{out}/policy.json", json.dumps(described))
        return SimpleNamespace(wait=lambda: 0)

    monkeypatch.setattr(seeds.subprocess, "Popen", run)
    return calls, fails


def test_a_queue_trains_each_seed_in_a_folder_of_its_own_and_does_only_what_is_missing(processes, tmp_path, capsys):
    calls, fails = processes
    fails.add("1")
    with pytest.raises(ValueError, match=r"seeds 1 did not finish \(exit status 1: seed 1 says\)"):
        train("dagger", Run(seeds="0:3", out=tmp_path, workers=2))
    assert sorted(words[words.index("--seed") + 1] for words in calls) == ["0", "1", "2"]
    assert all("--resume" in words for words in calls)
    fails.clear()
    calls.clear()
    train("dagger", Run(seeds="0:3", out=tmp_path))
    assert [words[words.index("--out") + 1] for words in calls] == [str(tmp_path / "seed-1")]
    printed = " ".join(capsys.readouterr().out.split())
    assert "91.0% │ 1 │ 10.00% │ 1.0" in printed  # the median
    assert "worst │ │ 90.0% │ 2" in printed


def test_a_seed_that_fails_everywhere_is_the_worst():
    reached = {"success": 0.5, "failures": 3, "minutes": 1.0}
    trained = [reached | {"regret_mean": regret} for regret in (0.2, float("nan"), 0.1)]
    middle, worst = seeds.middle_and_worst(trained)
    assert (middle["regret_mean"], worst["regret_mean"]) == (0.2, float("inf"))


def test_a_queue_is_not_mixed_with_runs_of_other_settings(processes, tmp_path):
    train("dagger", Run(seeds="0:1", out=tmp_path))
    with pytest.raises(ValueError, match="holds a run of settings"):
        train("dagger", Run(seeds="0:1", out=tmp_path), LEARNERS["dagger"].settings("weave"))
