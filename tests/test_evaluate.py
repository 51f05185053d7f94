import csv
import io
import json
import math
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from builders import FunctionController, result
from rich.console import Console

import ballbot_train
from ballbot_baselines import CONTROLLERS
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, Registered, default_params, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation import controllers, evaluate, runner
from ballbot_train.evaluation.comparison import compare
from ballbot_train.evaluation.results import TABLE, leaderboard, read_results, table_cells, write_results
from ballbot_train.policy.files import PolicySpec, shipped_policies
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.work import console


def test_a_row_counts_falls_and_takes_regret_over_standing_episodes():
    (row,) = leaderboard(
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


def test_a_row_says_how_many_stand_beside_the_goal():
    lqr = CONTROLLERS["lqr"](make_task("stabilize"), named_robot("paper"))

    def standing_at(place):
        offset = np.r_[place, 0.0, np.zeros(6)]
        return SimpleNamespace(reset=lqr.reset, act=lambda t, x: lqr.act(t, x - offset))

    row = ballbot_train.evaluate(standing_at(0.12), "stabilize", 3, physics="rk4")  # the goal is a circle of 0.1 m
    assert (row.success, row.near) == (0.0, 1.0)
    assert row.facts()["in or near the goal"] == "100 %"
    assert TABLE["success"](row) == "0.0 % (100.0 % near)"
    assert ballbot_train.evaluate(standing_at(0.4), "stabilize", 3, physics="rk4").near == 0.0
    row = ballbot_train.evaluate(standing_at(0.0), "stabilize", 3, physics="rk4")
    assert (row.success, row.near) == (1.0, 1.0)
    assert TABLE["success"](row) == "100.0 %"


def test_a_row_warns_where_an_optimum_is_nearly_zero_and_has_the_excess():
    ordinary = [result(episode=i, cost=11.0, optimum=10.0) for i in range(3)]
    assert leaderboard(ordinary)[0].excess_mean == pytest.approx(1.0)
    with pytest.warns(UserWarning, match="in 1 of 4 episodes the optimum costs less than 1% of the mean optimum"):
        (row,) = leaderboard([*ordinary, result(episode=3, cost=1.0, optimum=1e-3)])
    assert row.regret_mean > 200
    assert row.excess_mean == pytest.approx(3.999 / 4)


def test_a_failure_is_not_near_the_goal_and_an_end_that_is_not_known_gives_no_share():
    ends = [result(goal_error=1.2, success=False), result(goal_error=2.0, success=False, failure=True)]
    assert leaderboard(ends)[0].near == 0.5
    assert math.isnan(leaderboard([*ends, result()])[0].near)


def test_an_interrupted_benchmark_continues_without_running_anything_again(tmp_path):
    def run():
        return runner.MeasuredRun(tmp_path).measure([runner.Group("stabilize", "lqr", "rk4")], 7, record=True)

    first = run()
    path, last = sorted(tmp_path.rglob("unfinished/*.json"))
    kept = json.loads(path.read_text())
    kept[0]["cost"] = 123.0  # would be overwritten if the episode ran again
    path.write_text(json.dumps(kept))
    last.unlink()  # as if killed after the first job
    again = run()
    assert [r.episode for r in again] == list(range(7))
    assert again[0].cost == 123.0
    assert [r.cost for r in again[1:]] == [r.cost for r in first[1:]]


def test_a_rerun_in_other_processes_gives_the_same_but_for_times(tmp_path):
    def rows(out, workers):
        results = runner.MeasuredRun(out, workers).measure([runner.Group("stabilize", "lqr", "rk4")], 7, record=True)
        return [replace(row, plan_ms_median=0, step_us_median=0) for row in leaderboard(results)]

    assert rows(tmp_path / "a", 1) == rows(tmp_path / "b", 2)


def test_the_leaderboard_files_hold_what_was_measured(tmp_path):
    results = [result(), result(controller="trajopt", cost=10.0, settle_time=math.nan)]
    rows = leaderboard(results)
    write_results(rows, results, {"commit": "none"}, tmp_path)
    with (tmp_path / "leaderboard.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [entry["controller"] for entry in table] == ["lqr", "trajopt"]
    assert float(table[0]["regret_mean"]) == pytest.approx(0.2)
    document = json.loads((tmp_path / "leaderboard.json").read_text())
    assert document["rows"][1]["settle_time_median"] is None  # NaN is no JSON
    assert document["about"] == {"benchmark": "2", "commit": "none"}


@pytest.mark.parametrize("name", ["", "leaderboard.json"])
def test_episodes_are_read_back_as_they_were_written(name, tmp_path):
    results = [result(effort=20.0, note="no plan"), result(controller="trajopt", settle_time=math.nan, success=False)]
    write_results(leaderboard(results), results, {"commit": "none"}, tmp_path)
    about, read = read_results(tmp_path / name)
    assert repr(read) == repr(results)  # NaN is not equal to itself
    assert about == {"benchmark": "2", "commit": "none"}


@pytest.mark.parametrize(
    "name", ["=cmd|' /C calc'!A0.json", "+1+1", "@SUM(A1)", "-x", "'=x", "\tx", "plain", 'a,"b"', "'x"]
)
def test_a_name_is_no_formula_in_csv(name, tmp_path):
    results = [result(controller=name, note=name, effort=1.0)]
    write_results(leaderboard(results), results, {}, tmp_path)
    with (tmp_path / "episodes.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["controller"][0] not in "=+-@\t\r"
    assert float(row["cost"]) == results[0].cost


class Standing:
    """Upright by feedback, in every form that `evaluate` takes."""

    gain = np.array([[0.5, 0, 1.3, 0, 0.75, 0, 1.33, 0], [0, 0.5, 0, 1.3, 0, 0.75, 0, 1.33]])

    def __call__(self, observation):
        return self.gain @ observation

    def as_model(self):
        return SimpleNamespace(predict=lambda o, state, episode_start, deterministic: (self(o), state))

    def as_controller(self, env):
        limit = env.params.force_limit
        return FunctionController(lambda t, x: limit * self(np.array(env.task.observe(tuple(x), ()), np.float32)))


def test_a_function_a_model_and_a_controller_that_do_the_same_cost_the_same(make_env):
    standing = Standing()
    policies = (standing, standing.as_model(), standing.as_controller(make_env(physics="rk4")))
    rows = [evaluate.evaluate(policy, "stabilize", 3, "rk4", name="mine") for policy in policies]
    assert rows[0].episodes == 3
    assert rows[0].success > 0
    for row in rows[1:]:
        assert replace(row, plan_ms_median=0, step_us_median=0) == replace(rows[0], plan_ms_median=0, step_us_median=0)


def test_a_policy_file_and_an_expert_by_name_are_evaluated(tmp_path):
    task = make_task("stabilize")
    path = PolicyNetwork(PolicySpec.of(task, hidden=(8,))).save(tmp_path / "mine", {})
    assert evaluate.evaluate(path, "stabilize", 1, "rk4").controller == f"{path.parent.name}/{path.name}"
    assert evaluate.evaluate("lqr", "stabilize", 1, "rk4").success == 1


def test_a_policy_is_benchmarked_on_the_task_it_was_made_for(tmp_path):
    path = str(PolicyNetwork(PolicySpec.of(make_task("turn"), hidden=(8,))).save(tmp_path / "mine", {}))
    chosen = controllers.controllers_of(["stabilize", "turn"], ["lqr", path])
    assert chosen == {"paper": {"stabilize": ["lqr"], "turn": ["lqr", path]}}
    assert controllers.controllers_of(["stabilize", "turn"], [path]) == {"paper": {"turn": [path]}}
    assert set(runner.MeasuredRun.open(tmp_path / "run", 1, chosen).facts["policies"]) == {f"turn/{path}"}
    with pytest.raises(ValueError, match="which is none of stabilize"):
        controllers.controllers_of(["stabilize"], [path])


def test_without_names_every_expert_and_shipped_policy_is_benchmarked():
    for task, names in controllers.controllers_of(list(TASKS))["paper"].items():
        assert names == [*CONTROLLERS, *shipped_policies(make_task(task))]


IMPORTS = [
    ("import ballbot_baselines", []),
    ("import ballbot_train.evaluation.runner, ballbot_train.evaluation.comparison", []),
    ("import ballbot_train.evaluation.robustness, ballbot_train.evaluation.basins", []),
    ("from ballbot_train import evaluate, shipped_policies", []),
    (
        "evaluate(Idle(), 'stabilize', 1, 'rk4')",
        ["casadi"],
    ),  # it prints the C of the environment, which is in no cache yet
    ("import ballbot_train.learning.demonstrations", ["casadi", "scipy"]),
]


def test_an_import_loads_only_what_it_needs(monkeypatch, tmp_path):
    monkeypatch.setenv("BALLBOT_CACHE", str(tmp_path))
    code = "import sys\nclass Idle:\n    reset = act = lambda *given: (0.0, 0.0)\n"
    heavy = "torch", "casadi", "scipy", "stable_baselines3", "tyro", "matplotlib"
    code += "".join(f"{line}\nprint(sorted(set({heavy}) & set(sys.modules)))\n" for line, _ in IMPORTS)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == [str(loaded) for _, loaded in IMPORTS]


def test_a_worker_needs_no_file_of_a_policy(tmp_path, monkeypatch):
    source, folder = shipped_policies(make_task("turn"))["dagger"], tmp_path / "policies"
    folder.mkdir()
    for ending in (".json", ".safetensors"):
        shutil.copy(source.with_suffix(ending), folder / f"mine{ending}")

    def run_elsewhere(jobs, *_):
        sent = pickle.dumps(jobs)
        shutil.rmtree(folder)
        return [list(job.function(*job.arguments, job.items)) for job in pickle.loads(sent)]

    monkeypatch.setattr(runner.jobs, "run", run_elsewhere)
    groups = [runner.Group("turn", name, "rk4") for name in (str(folder / "mine.json"), "dagger")]
    own, shipped = runner.MeasuredRun(tmp_path).measure(groups, 1)
    assert own.cost == shipped.cost


def test_fresh_episodes_are_of_the_robot_that_is_given(monkeypatch):
    heavy = replace(default_params(), body_mass=30.0)

    def costs(robot):
        return evaluate.evaluate(lambda seen: 0 * seen[:, :2], "stabilize", robot=robot, fresh=5).costs

    with pytest.raises(ValueError, match=r"this robot has no name.*register_robot"):
        costs(heavy)
    monkeypatch.setitem(ROBOTS, "heavy", Registered(heavy, {}))
    assert (costs(heavy) != costs(default_params())).all()


def test_whatever_is_evaluated_can_be_compared(tmp_path):
    for gain in (0.0, 0.5):
        row = ballbot_train.evaluate(
            lambda seen, gain=gain: gain * seen[2:4], "turn", 8, "rk4", f"gain {gain}", out=tmp_path / str(gain)
        )
        about, results = read_results(tmp_path / str(gain))
        assert about["physics"] == "rk4"
        assert [(one.controller, one.episode) for one in results] == [(f"gain {gain}", i) for i in range(8)]
        assert sum(one.failure for one in results) == row.falls
    (compared,) = compare(read_results(tmp_path / "0.0"), read_results(tmp_path / "0.5"))
    assert compared.controller == "gain 0.0 → gain 0.5"
    assert compared.episodes == 8


def test_an_evaluation_runs_torch_on_one_thread_and_gives_the_others_back():
    seen = []

    def fails(observation):
        seen.append(torch.get_num_threads())
        raise RuntimeError("as a policy may")

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with pytest.raises(RuntimeError, match="as a policy may"):
            evaluate.evaluate(fails, "stabilize", 1, "rk4")
        assert (seen, torch.get_num_threads()) == ([1], 2)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("terminal", "after", "is_shown"), [(True, 0.0, True), (True, 60.0, False), (False, 0.0, False)]
)
def test_an_evaluation_that_takes_long_shows_a_bar_on_a_terminal(terminal, after, is_shown, monkeypatch):
    printed = Console(file=io.StringIO(), width=100, force_terminal=terminal, force_interactive=terminal)
    monkeypatch.setattr(console, "console", printed)
    monkeypatch.setattr(console, "LATE_SECONDS", after)
    evaluate.evaluate(lambda observation: np.zeros(2), "stabilize", 3, "rk4")
    assert ("3/3" in printed.file.getvalue()) == is_shown


def test_rows_and_files_say_their_engine(tmp_path):
    results = [result(), result(physics="mujoco")]
    rows = leaderboard(results)
    assert [(row.physics, row.episodes, row.facts()["physics"]) for row in rows] == [
        ("rk4", 1, "rk4"),
        ("mujoco", 1, "mujoco"),
    ]
    assert [dict(zip(TABLE, line, strict=True))["physics"] for line in table_cells(TABLE, rows)] == ["rk4", "mujoco"]
    write_results(rows, results, {}, tmp_path)
    for name in ("leaderboard.csv", "episodes.csv"):
        with (tmp_path / name).open() as file:
            assert [entry["physics"] for entry in csv.DictReader(file)] == ["rk4", "mujoco"]


@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("benchmark --controllers lqr", "leaderboard.md"),
        ("benchmark --controllers lqr --randomization late", "tracks.md"),
        ("robustness --controllers lqr --stresses delay", "robustness.md"),
    ],
)
def test_tables_of_commands_say_their_engine(command, file, tmp_path, typed):
    words = ["--tasks", "turn", "--episodes", "1", "--workers", "1", "--physics", "rk4", "--out", "out"]
    ended, printed = typed(*command.split(), *words)
    assert ended == 0, printed
    header, _, first = (tmp_path / "out" / file).read_text().splitlines()[:3]
    told = dict(zip(header.split(" | "), first.split(" | "), strict=True))
    assert told["physics"] == "rk4"


class Predicts:
    """Objects with the usual signatures of `predict`, all of which stand still."""

    class Alone:
        def predict(self, observation):
            return np.zeros(2)

    class WithState:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            assert deterministic
            return np.zeros(2), None

    class Deterministic:
        def predict(self, obs, deterministic=False):
            assert deterministic
            return np.zeros(2), {"more": 1}, 3

    class Anything:
        def predict(self, observation, **options):
            assert options["deterministic"]
            return (np.zeros(2),)


def test_objects_with_any_usual_predict_and_torch_modules_are_policies():
    still = torch.nn.Linear(8, 2, dtype=torch.float64)
    torch.nn.init.zeros_(still.weight)
    torch.nn.init.zeros_(still.bias)
    policies = [Predicts.Alone(), Predicts.WithState(), Predicts.Deterministic(), Predicts.Anything(), still]
    costs = {evaluate.evaluate(policy, "stabilize", episodes=2, physics="rk4").cost_mean for policy in policies}
    assert costs == {
        evaluate.evaluate(lambda observation: np.zeros(2), "stabilize", episodes=2, physics="rk4").cost_mean
    }
