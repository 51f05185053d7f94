"""The commands, as a user runs them."""

import json
import subprocess
import sys

import numpy as np
import pytest

from ballbot_gym.trajectory import Trajectory
from ballbot_train.commands import COMMANDS
from ballbot_train.commands.compare import compare
from ballbot_train.evaluation import evaluate
from ballbot_train.evaluation.evaluate import Result


def ballbot(*arguments, cwd):
    command = [sys.executable, "-m", "ballbot_train.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def test_benchmark_prints_a_leaderboard_and_writes_table_figures_and_report(tmp_path):
    run = ballbot(
        "benchmark",
        "--tasks",
        "stabilize",
        "--controllers",
        "lqr",
        "trajopt",
        "--episodes",
        6,
        "--workers",
        1,
        cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    assert "regret mean" in run.stdout
    out = tmp_path / "runs" / "benchmark"
    rows = {row["controller"]: row for row in json.loads((out / "leaderboard.json").read_text())["rows"]}
    assert rows["trajopt"]["falls"] == 0
    assert rows["trajopt"]["cost_mean"] < rows["lqr"]["cost_mean"]
    assert {path.name for path in (out / "figures").iterdir()} == {"regret.png", "stabilize.png"}
    assert "data:image/png;base64" in (out / "report.html").read_text()
    assert not (out / "unfinished").exists()  # it only serves an interrupted run


def test_robustness_writes_tables_and_curves(tmp_path):
    arguments = ("--tasks", "turn", "--controllers", "lqr", "--episodes", 2, "--workers", 1)
    run = ballbot("robustness", *arguments, "--stresses", "delay", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "0 · 20 · 40 · 60" in run.stdout
    out = tmp_path / "runs" / "robustness"
    assert {path.name for path in out.iterdir()} == {
        "episodes.csv",
        "figures",
        "robustness.csv",
        "robustness.json",
        "robustness.md",
    }


def test_compare_says_whether_b_is_better(tmp_path, capsys):
    for name, cost in (("a", 12.0), ("b", 11.0)):
        results = [Result("turn", "lqr", i, "rk4", cost, 10.0, True, False, 30, 2, 2, 0, 0) for i in range(20)]
        evaluate.write_leaderboard(evaluate.leaderboard(results), results, {"commit": name}, tmp_path / name)
    compare(tmp_path / "a", tmp_path / "b", out=tmp_path / "compared.json")
    assert "better" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "compared.json").read_text())["rows"]
    assert (row["verdict"], row["regret"]) == ("better", pytest.approx(-0.1))


def test_compare_refuses_what_is_no_benchmark(tmp_path):
    with pytest.raises(ValueError, match="holds no episodes of a benchmark"):
        compare(tmp_path, tmp_path)


def test_a_folder_with_another_unfinished_run_is_refused(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "unfinished.json").write_text('{"episodes": 3}')
    run = ballbot("benchmark", "--tasks", "stabilize", "--episodes", 1, "--out", "out", cwd=tmp_path)
    assert run.returncode == 1
    assert "unfinished run" in run.stderr


def test_paper_writes_plans_and_figures(tmp_path):
    run = ballbot("paper", "--only", "stabilize-1", "--out", "figures", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "106.3652" in run.stdout
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"fig2-stabilize-1.png", "fig2-stabilize-1-lqr-and-trajopt.png", "stabilize-1.npz"}


def test_optimize_writes_a_trajectory_that_starts_where_it_was_told(tmp_path):
    state = [-1, 0, 0, 0, 0, 1, 0, 0]
    run = ballbot("optimize", "stabilize", "--state", *state, "--duration", 4, "--out", "plan", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    trajectory = Trajectory.load(tmp_path / "plan" / "trajectory.npz")
    np.testing.assert_array_equal(trajectory.x[0], state)
    assert trajectory.duration == pytest.approx(4)
    assert (tmp_path / "plan" / "figure.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["optimize", "dance"], "unknown task dance"),
        (["optimize", "turn", "--constants", "sped", "3"], "no constants ['sped']"),
        (["optimize", "turn", "--constants", "speed", "30"], "speed must be in"),
        (["benchmark", "--episodes", "0"], "episodes must be 1 to 200"),
        (["paper", "--only", "fig9"], "unknown problem fig9"),
    ],
)
def test_a_wrong_argument_ends_with_one_line_that_says_so(arguments, message, tmp_path):
    run = ballbot(*arguments, cwd=tmp_path)
    assert run.returncode == 1
    assert message in " ".join(run.stderr.split())
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("benchmark", {"controllers": ("pid",)}, "unknown controller pid"),
        ("benchmark", {"controllers": ("mine.json",)}, "mine.json is not a policy"),
        ("robustness", {"stresses": ("wind",)}, "unknown stress wind"),
        ("basins", {"points": 4}, "points must be odd"),
    ],
)
def test_a_wrong_name_is_refused_before_anything_is_written(command, arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        COMMANDS[command](**arguments)
    assert not any(tmp_path.iterdir())
