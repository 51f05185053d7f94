"""Fresh episodes: they are fresh, what is said of them is what happened in them, and nothing hides in a mean."""

import csv
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ballbot_gym import certified
from ballbot_gym.robot import default_params
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.orbit import Orbit
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.turn import Turn
from ballbot_gym.tasks.weave import Weave
from ballbot_gym.trajectory import Trajectory
from ballbot_train import evaluate_fresh
from ballbot_train.commands.evaluate import evaluate
from ballbot_train.evaluation import fresh
from ballbot_train.evaluation.statistics import Interval
from ballbot_train.learning import training
from ballbot_train.policy.files import shipped_policies
from ballbot_train.policy.network import load_policy


def idle(observation):
    return torch.zeros(len(observation), 2)


@pytest.fixture(scope="module")
def turns():
    """The shipped policy on 200 turns."""
    return evaluate_fresh("dagger", "turn", 200)


def test_fresh_episodes_are_neither_certified_nor_for_validation_nor_of_another_seed(task):
    count = 200
    sets = [
        fresh.draw(task, range(count), 0),
        fresh.draw(task, range(count), 1),
        fresh.draw(task, range(count), 0, "validation"),
    ]
    episodes = certified.load(task, "paper")
    sets.append((episodes.states, episodes.constants))
    starts = np.concatenate([np.column_stack(group) for group in sets])
    assert len(np.unique(starts, axis=0)) == 3 * count + len(episodes)


def test_processes_find_what_one_does(monkeypatch):
    monkeypatch.setattr(fresh, "_BATCH", 20)
    one, two = (evaluate_fresh("dagger", "turn", 50, workers=workers) for workers in (1, 2))
    assert np.array_equal(one.costs, two.costs)
    assert np.array_equal(one.states, two.states)
    assert all(np.array_equal(one.measures[name], two.measures[name]) for name in one.measures)


def test_every_task_measures_its_episodes_in_finite_numbers(task):
    for x, c, _ in zip(*fresh.draw(task, range(20), 0), strict=True):
        assert all(math.isfinite(value) for value in task.measures(x, c, default_params()).values())


def test_measures_are_what_their_names_say(params):
    x = np.array([3.0, 4.0, 0.2, 0.0, 2.0, 1.0, 0.5, 0.0])  # leans along x, and moves and tilts that way
    assert Stabilize().measures(x, np.zeros(0), params) == pytest.approx(
        {
            "distance, m": 5.0,
            "speed, m/s": math.sqrt(5),
            "tilt, degrees": math.degrees(0.2),
            "speed along the lean, m/s": 2.0,
            "tilt rate, rad/s": 0.5,
        }
    )
    speed = params.steady_speed(2.0, math.radians(30))
    measured = Orbit().measures(x, np.array([2.0, -speed]), params)
    assert measured["steady tilt, degrees"] == pytest.approx(30)
    assert measured["direction, 1 is counter-clockwise"] == -1
    obstacles = [(2.0, 0.3, 0.3), (4.0, 0.3, 0.4), (4.0, 0.3, 0.4), (4.0, 0.3, 0.4), (4.0, 0.3, 0.4)]
    measured = Weave().measures(np.zeros(8), np.array([6.0, 0.0, *np.ravel(obstacles)]), params)
    assert measured["obstacles"] == 2
    assert measured["tightest gap, m"] == pytest.approx(2.0 - 0.3 - 0.4 - 0.2)
    assert measured["widest obstacle, m"] == 0.4


def test_a_fresh_episode_costs_what_it_costs_in_the_environment(turns, make_env):
    env = make_env("turn", physics="rk4")
    policy = load_policy(shipped_policies(Turn())["dagger"])
    for i in turns.worst(3):
        run = rollout(env, policy, options={"state": turns.states[i], "constants": turns.constants[i]})
        assert run.success == turns.success[i]
        if run.success:
            assert run.cost == pytest.approx(turns.costs[i], rel=1e-3)  # the policy's sums are in single precision


def test_every_failure_names_its_limit():
    result = evaluate_fresh(idle, "stabilize", 40)
    assert result.failure.all()
    assert set(result.violated) <= {"tilt", "arena"}
    assert result.summary().failed_by == {name: result.violated.count(name) for name in sorted(set(result.violated))}
    weaving = evaluate_fresh(lambda o: torch.tensor([[0.02, 0.0]]).expand(len(o), 2), "weave", 20)
    assert sum(weaving.summary().failed_by.values()) == weaving.failure.sum()


def test_every_way_to_give_a_policy_gives_the_same_result(turns):
    path = shipped_policies(Turn())["dagger"]
    for policy in (path, load_policy(path)):
        again = evaluate_fresh(policy, "turn", 20)
        np.testing.assert_allclose(again.costs, turns.costs[:20], rtol=1e-3)


def test_a_function_of_one_observation_acts_as_one_of_all_of_them():
    gain = np.array([[0.3, 0, 1.3, 0, 0.7, 0, 1.3, 0], [0, 0.3, 0, 1.3, 0, 0.7, 0, 1.3]], np.float32)
    of_all = evaluate_fresh(lambda seen: (seen @ torch.as_tensor(gain.T)).clip(-1, 1), "stabilize", 5)
    of_one = evaluate_fresh(lambda seen: np.clip(gain @ seen, -1, 1), "stabilize", 5)
    np.testing.assert_allclose(of_one.costs, of_all.costs, rtol=1e-4)
    with pytest.raises(ValueError, match=r"gives \(5, 3\).*give actions \(5, 2\) for all of them, or \(2,\) for one"):
        evaluate_fresh(lambda seen: seen[..., :3], "stabilize", 5)
    with pytest.raises(ZeroDivisionError):
        evaluate_fresh(lambda seen: 1 / 0, "stabilize", 5)


def test_bins_hold_every_episode_once(turns):
    bins = turns.bins()
    assert len(bins) == 4
    assert sum(entry["episodes"] for entry in bins) == len(turns)
    assert sum(entry["failures"] for entry in bins) == turns.failure.sum()
    assert np.dot([e["episodes"] for e in bins], [e["cost_mean"] for e in bins]) == pytest.approx(turns.costs.sum())
    few = replace(turns, measures={"kind": np.where(np.arange(len(turns)) < 2, 5.0, 2.0)}).bins()
    assert [(e["low"], e["high"], e["episodes"]) for e in few] == [(2.0, 2.0, len(turns) - 2), (5.0, 5.0, 2)]


def test_the_worst_episodes_are_those_without_success_and_then_the_dearest(turns):
    order = turns.worst(len(turns))
    missed = int((~turns.success).sum())
    assert not turns.success[order[:missed]].any()
    assert (np.diff(turns.costs[order[missed:]]) <= 0).all()


def test_wilson_s_interval_is_not_empty_where_nothing_failed():
    low, high = Interval.of_share(0, 10_000)
    assert low == pytest.approx(0, abs=1e-12)
    assert high == pytest.approx(1.96**2 / (10_000 + 1.96**2), rel=1e-3)


def test_regret_on_fresh_episodes_is_found_once_and_is_not_negative(monkeypatch):
    result = evaluate_fresh("apg", "stabilize", 2)
    optima = result.with_optima(2, 1).optima
    from ballbot_baselines.optimum import certification

    monkeypatch.setattr(certification, "optimum_of", None)  # whoever calls it again fails
    np.testing.assert_array_equal(optima, result.with_optima(2, 1).optima)
    assert (result.costs / optima - 1 > -1e-6).all()


def test_the_command_writes_summary_bins_worst_episodes_and_their_films(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    evaluate("dagger", task="turn", fresh=60, optima=1, workers=1)
    out = tmp_path / "runs" / "evaluate" / "turn-dagger"
    document = json.loads((out / "fresh.json").read_text())
    assert document["summary"][0]["episodes"] == 60
    assert len(document["bins"]) == 4
    assert document["about"]["policies"].keys() == {"turn/dagger"}
    worst = document["worst"][0]
    file = worst["replay"].removeprefix("ballbot replay ")
    np.testing.assert_allclose(Trajectory.load(file).x[0], worst["start"])
    for name, lines in (("bins", 4), ("worst", 10), ("fresh", 60)):
        with (out / f"{name}.csv").open() as opened:
            assert len(list(csv.DictReader(opened))) == lines
    assert worst["replay"] in capsys.readouterr().out


def test_what_does_not_act_is_refused():
    with pytest.raises(TypeError, match="is not a policy"):
        evaluate_fresh(3, "turn", 1)
    with pytest.raises(ValueError, match="trajopt is an expert"):
        evaluate_fresh("trajopt", "turn", 1)
    with pytest.raises(ValueError, match="unknown controller 'shac'"):
        evaluate_fresh("shac", "turn", 1)


def test_fresh_episodes_and_training_say_how_many_stand_beside_the_goal():
    task = TASKS["stabilize"]()
    policy = load_policy(shipped_policies(task)["apg"])
    beside = torch.zeros(8)
    beside[0] = 0.12 / task.observation_scale[0]  # m; the goal is a circle of 0.1 m
    found = evaluate_fresh(lambda seen: policy.network(seen - beside), "stabilize", 20)
    assert not found.success.any()
    assert found.summary().near == 1.0
    assert found.goal_errors == pytest.approx(np.full(20, 1.2), rel=0.1)
    figures = training.score_and_validate(lambda seen: policy.network(seen - beside), task, episodes=1)
    assert (figures["certified/success"], figures["certified/near"]) == (0.0, 1.0)


def test_validation_prices_an_episode_without_success_as_failing_at_once():
    task = TASKS["stabilize"]()
    figures = training.score_and_validate(idle, task)
    assert figures["validation/success"] == 0
    assert figures["validation/cost"] >= task.survival_pay


def test_results_of_another_policy_are_not_replaced(tmp_path):
    few: dict[str, Any] = {"task": "stabilize", "workers": 1, "optima": 0, "out": tmp_path}
    evaluate("apg", fresh=2, **few)
    before = (tmp_path / "fresh.json").read_bytes()
    for policy, other in (("ppo", {}), ("apg", {"robot": "rolling"}), ("apg", {"randomization": "late"})):
        changed = next(iter(other), "policy")
        with pytest.raises(ValueError, match=f"holds results of {changed} .*; give another --out"):
            evaluate(policy, fresh=2, **few, **other)
    assert (tmp_path / "fresh.json").read_bytes() == before
    evaluate("apg", fresh=3, **few)
    assert (tmp_path / "fresh.json").read_bytes() != before
