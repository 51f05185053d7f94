"""The commands, as a user runs them."""

import importlib
import inspect
import json
import shlex
import subprocess
import sys
from importlib import metadata

import numpy as np
import pytest

from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.lazy import load
from ballbot_gym.trajectory import Trajectory
from ballbot_train import cli
from ballbot_train.commands import COMMANDS, RESUMABLE
from ballbot_train.commands.certify import certify
from ballbot_train.work.executors import Workers


def test_benchmark_prints_a_leaderboard_and_writes_table_figures_and_report(tmp_path, typed):
    arguments = ("--tasks", "stabilize", "--controllers", "lqr", "trajopt", "--episodes", 3, "--workers", 1)
    ended, printed = typed("benchmark", *arguments, "--physics", "rk4", "--out", "runs/[red]x[/b]:smile:")
    assert ended == 0, printed
    assert "regret mean" in printed
    assert "report: runs/[red]x[/b]:smile:/report.html" in printed  # as it is
    out = tmp_path / "runs" / "[red]x[/b]:smile:"
    rows = {row["controller"]: row for row in json.loads((out / "leaderboard.json").read_text())["rows"]}
    assert rows["trajopt"]["falls"] == 0
    assert rows["trajopt"]["cost_mean"] < rows["lqr"]["cost_mean"]
    assert {path.name for path in (out / "figures").iterdir()} == {"regret.png", "stabilize.png"}
    assert "data:image/png;base64" in (out / "report.html").read_text()
    assert not (out / "unfinished").exists()  # it only serves an interrupted run


def test_paper_writes_plans_and_figures(tmp_path, typed, interpreted):
    ended, printed = typed("paper", "--only", "stabilize-1", "--out", "figures")
    assert (ended, "106.3652" in printed) == (0, True), printed
    names = {path.name for path in (tmp_path / "figures").iterdir()}
    assert names == {"fig2-stabilize-1.png", "fig2-stabilize-1-lqr-and-trajopt.png", "stabilize-1.npz"}


def test_optimize_writes_a_trajectory_that_starts_where_it_was_told(tmp_path, typed):
    state = [-1, 0, 0, 0, 0, 1, 0, 0]
    ended, printed = typed("optimize", "stabilize", "--state", *state, "--duration", 4, "--out", "plan")
    assert ended == 0, printed
    trajectory = Trajectory.load(tmp_path / "plan" / "trajectory.npz")
    np.testing.assert_array_equal(trajectory.x[0], state)
    assert trajectory.duration == pytest.approx(4)
    assert (tmp_path / "plan" / "figure.png").exists()


def test_optimize_says_what_is_proven_of_a_planar_start_near_rest(typed):
    ended, printed = typed("optimize", "stabilize", "--state", 0.2, 0, 0.05, 0, 0.1, 0, 0, 0, "--out", "plan")
    assert ended == 0
    assert "its regret is at most 2.9%" in printed


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_one_line_of_help_that_is_its_own(name):
    function = load(COMMANDS[name])
    assert cli._help_of(name) == function.__doc__.strip().partition("\n")[0]
    assert cli._help_of(name).endswith(".")


def test_the_commands_that_continue_are_those_that_do_much_work():
    long = {name for name in COMMANDS if "workers" in inspect.signature(load(COMMANDS[name])).parameters}
    assert set(RESUMABLE) == long | {"train"}


WRITTEN = {"episodes.csv", "figures", "robustness.csv", "robustness.json", "robustness.md"}


@pytest.mark.parametrize(
    ("arguments", "how"),
    [
        (
            (
                "robustness",
                "--tasks",
                "turn",
                "--stresses",
                "delay",
                "--controllers",
                "lqr",
                "--episodes",
                1,
                "--out",
                "a run",
            ),
            "continues",
        ),
        (("optimize", "stabilize", "--duration", 1), "starts again"),
    ],
)
def test_an_interruption_is_answered_with_the_command_that_goes_on(arguments, how, tmp_path, typed, monkeypatch):
    monkeypatch.setattr(Workers, "here", 1)  # and so in this process

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("rich.progress.Progress.advance", interrupt)
        patch.setattr("ballbot_train.report.figures.save", interrupt)
        ended, printed = typed(*arguments)
    assert (ended, how in printed) == (130, True), printed
    program, *words = shlex.split(printed.rpartition(": ")[2])
    assert (program, words) == ("ballbot", [str(word) for word in arguments])
    ended, printed = typed(*words)
    assert ended == 0, printed
    if how == "continues":
        assert "0 · 20 · 40 · 60" in printed
        assert {path.name for path in (tmp_path / "a run").iterdir()} == WRITTEN


@pytest.mark.parametrize(
    ("arguments", "option", "help"),
    [
        (("train", "apg", "--taks", "turn"), "--task", "ballbot train apg --help"),
        (("train", "--taks", "turn"), "", "ballbot train --help"),
        (("train", "apg", "--task"), "--task", "ballbot train apg --help"),
        (("benchmark", "--taks", "turn"), "--tasks", "ballbot benchmark --help"),
    ],
)
def test_a_mistyped_option_is_answered_with_the_nearest_and_with_a_help_that_exists(arguments, option, help, typed):
    ended, printed = typed(*arguments)
    assert (ended, option in printed, help in printed) == (2, True, True), printed
    assert typed(*help.split()[1:])[0] == 0


LOADED = """
import sys
from ballbot_train.cli import main
sys.argv = ["ballbot", *sys.argv[1:]]
try:
    main()
finally:
    heavy = {"torch", "casadi", "scipy", "gymnasium", "numpy", "tyro", "stable_baselines3", "matplotlib"}
    print(sorted(heavy & set(sys.modules)))
"""


def test_the_help_names_every_command_and_imports_none(tmp_path):
    run = subprocess.run([sys.executable, "-c", LOADED, "--help"], capture_output=True, text=True, check=True)
    lines = run.stdout.splitlines()
    assert lines[-1] == "[]"
    assert lines[0] == "usage: ballbot COMMAND [OPTIONS]"
    for name in COMMANDS:
        assert any(line.split()[:1] == [name] for line in lines)


def test_only_the_command_that_is_called_is_imported():
    run = subprocess.run(
        [sys.executable, "-c", LOADED, "compare", "--help"], capture_output=True, text=True, check=True
    )
    assert "--training-margin" in run.stdout
    loaded = run.stdout.splitlines()[-1]
    assert "tyro" in loaded
    assert not {"torch", "casadi", "scipy", "stable_baselines3", "matplotlib"} & set(
        json.loads(loaded.replace("'", '"'))
    )


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ([], 2, "usage: ballbot COMMAND"),
        (["-h"], 0, "usage: ballbot COMMAND"),
        (["--version"], 0, f"ballbot {metadata.version('ballbot-gym')}"),
        (["trian"], 2, "no command 'trian'; did you mean train?"),
        (["[red]x"], 2, "no command '[red]x'; the commands are benchmark, evaluate, compare"),
        (["compare"], 2, "ballbot compare"),
    ],
)
def test_what_is_no_command_is_answered_with_what_there_is(arguments, status, message, typed):
    ended, printed = typed(*arguments)
    assert (ended, message in printed) == (status, True), printed


def test_certify_resumes_and_makes_the_same_sets_as_before(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    packaged = certified.path_of(make_task("turn")).read_bytes()
    certification = importlib.import_module("ballbot_baselines.optimum.certification")
    solved, again = [], []
    find_optimum = certification.find_optimum

    def find(*arguments, **options):
        if len(solved) == 2:
            raise KeyboardInterrupt
        solved.append(arguments)
        return find_optimum(*arguments, **options)

    def find_again(*arguments, **options):
        again.append(arguments)
        return find_optimum(*arguments, **options)

    monkeypatch.setattr(certification, "find_optimum", find)
    with pytest.raises(KeyboardInterrupt):
        certify(("turn",), 3, workers=1)
    monkeypatch.setattr(certification, "find_optimum", find_again)
    certify(("turn",), 3, workers=1)
    assert (len(solved), len(again)) == (2, 1)
    out = tmp_path / "runs" / "certify"
    assert [path.name for path in out.iterdir()] == ["BallbotTurn-v0.npz"]
    made, known = (
        certified.load(make_task("turn"), "paper", out / "BallbotTurn-v0.npz"),
        certified.load(make_task("turn"), "paper"),
    )
    np.testing.assert_array_equal(made.states, known.states[:3])
    np.testing.assert_allclose(made.costs, known.costs[:3], rtol=1e-9)
    assert len(made.trajectories) == 3
    certify(("turn",), 3, workers=1, trajectories=2)
    assert len(certified.load(make_task("turn"), "paper", out / "BallbotTurn-v0.npz").trajectories) == 2
    assert certified.path_of(make_task("turn")).read_bytes() == packaged


@pytest.mark.parametrize(
    ("typed_as", "means"),
    [
        (("--task", "BallbotTurn-v0"), ["--task", "turn"]),
        (("--tasks=BallbotTurn-v0",), ["--tasks=turn"]),
        (("--tasks", "BallbotStabilize-v0", "weave"), ["--tasks", "stabilize", "weave"]),
        (("--physics", "pybullet"), ["--physics", "bullet"]),
        (("--out", "BallbotTurn-v0"), ["--out", "BallbotTurn-v0"]),
        (("--out=pybullet", "BallbotNone-v0"), ["--out=pybullet", "BallbotNone-v0"]),
        (("--out", "no_module:baseline"), ["--out", "no_module:baseline"]),
        (("runs/a", "--name", "no_module:turn"), ["runs/a", "--name", "no_module:turn"]),
    ],
)
def test_ids_and_names_of_libraries_are_understood(typed_as, means):
    assert cli._registered(list(typed_as)) == means


def test_a_command_takes_the_id_of_a_task(tmp_path, typed):
    words = ("--tasks", "BallbotTurn-v0", "--controllers", "lqr", "--episodes", 1, "--workers", 1, "--physics", "rk4")
    ended, printed = typed("benchmark", *words, "--out", "out")
    assert ended == 0, printed
    (row,) = json.loads((tmp_path / "out" / "leaderboard.json").read_text())["rows"]
    assert row["task"] == "turn"


@pytest.mark.skipif(sys.platform == "win32", reason="pipes break in other words there")
@pytest.mark.parametrize("arguments", [["--help"], ["benchmark", "--help"], ["--version"]])
def test_a_command_that_nobody_reads_ends_without_a_word(arguments):
    code = "from ballbot_train.cli import main; main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        run.stdout.close()  # as `head` does when it has enough
        assert run.stderr.read() == ""
