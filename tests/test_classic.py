"""Gymnasium's classic systems as robots and tasks from outside of the packages, with their optima."""

import math
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from builders import CLASSIC, classic_systems, script

import ballbot_baselines
import ballbot_gym
import ballbot_train
from ballbot_baselines import VARIANTS, certified_optimum, find_optimum, regret
from ballbot_baselines.solvers.shooting import Backoff, Shooting
from ballbot_gym import BallbotBatch, BallbotEnv, BallbotVectorEnv, certified, named_robot, rollout
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.tasks.checks import check_methods
from ballbot_train import RegretWrapper, evaluate
from ballbot_train.report.film import film_frames
from ballbot_train.report.replay import Replay, Take

COUNTERPARTS = ("pendulum", "mountain_car")


@pytest.fixture(scope="module", autouse=True)
def classic():
    """The tasks and robots of the example, which are gone after these tests."""
    with classic_systems() as package:
        yield package


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """A folder of optima that only this test uses."""
    folder = tmp_path / "optima"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("BALLBOT_OPTIMA", str(folder))
    return folder


def optimum_of_seed(name, seed):
    """The certified optimum of the episode that the environment draws from a seed, or else the one that is found."""
    task, robot = make_task(name), robot_of(name)
    problem = task, robot, *task.sample(np.random.default_rng(seed), robot)
    return certified_optimum(*problem) or find_optimum(*problem)


@pytest.mark.parametrize("name", COUNTERPARTS)
def test_it_moves_and_pays_as_gymnasiums_own(name):
    task, rng = make_task(name), np.random.default_rng(0)
    with BallbotEnv(name) as env, gymnasium.make(task.counterpart) as other:
        high = other.action_space.high
        for seed in range(3):
            seen, _info = env.reset(seed=seed)
            expected, _ = other.reset(seed=seed)
            np.testing.assert_array_equal(seen, expected)
            ended = False
            while not ended:
                action = rng.uniform(-1, 1, 1).astype(np.float32)
                seen, reward, *ends, _ = env.step(action)
                expected, paid, *expected_ends, _ = other.step(action * high)
                np.testing.assert_allclose(seen, expected, atol=1e-4)  # it computes in part with float32
                assert reward == pytest.approx(paid, abs=1e-4)
                assert ends == expected_ends
                ended = any(ends)


@pytest.mark.parametrize("name", COUNTERPARTS)
def test_the_certified_episodes_are_gymnasiums_resets_by_seed(name):
    from ballbot_gym.certified import cache

    task, robot = make_task(name), robot_of(name)
    with gymnasium.make(task.counterpart) as env:
        for seed in (0, 1, 199):
            env.reset(seed=seed)
            np.testing.assert_array_equal(task.counterpart_state(env.unwrapped)[0], cache.episode(task, robot, seed)[0])


@pytest.mark.parametrize(("name", "seed"), [("pendulum", 1), ("pendulum", 2), ("pendulum", 8), ("mountain_car", 4)])
def test_the_optimums_actions_earn_its_return_in_gymnasiums_own(name, seed):
    from ballbot_classic.replay import followed, returned

    optimum, task = optimum_of_seed(name, seed), make_task(name)
    assert optimum.is_optimal
    earned, *_ = returned(task.counterpart, followed(name, optimum, seed), seed)
    assert earned == pytest.approx(task.survival_pay - optimum.cost, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "seed"),
    [("pendulum", 53), ("mountain_car", 139), pytest.param("mountain_car", 176, marks=pytest.mark.slow)],
)
def test_the_search_finds_the_certified_optimum(name, seed):
    """In these episodes the best motion is close to other local optima, or starts from none of the cheapest guesses."""
    task, robot = make_task(name), robot_of(name)
    found = find_optimum(task, robot, *task.sample(np.random.default_rng(seed), robot))
    assert found.is_optimal
    assert found.cost == pytest.approx(certified.load(task, robot).costs[seed], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTERPARTS)
def test_dynamic_programming_on_coarse_grids_nears_the_optima_and_finds_nothing_cheaper(name):
    lines, *_ = script(CLASSIC / "exhaustive.py").compared(name, finer=0.25, episodes=3)
    for line in lines[::2]:
        assert abs(line["finer_grid"] - line["optimum"]) < abs(line["grid"] - line["optimum"])
        assert line["finer_grid"] == pytest.approx(line["optimum"], rel=0.06)
        assert line["followed"] > line["optimum"] * (1 - 1e-5)
        assert line["improved"] > line["optimum"] * (1 - 1e-6)


def test_the_goal_pays_and_missing_it_costs_as_much():
    task, robot = make_task("mountain_car"), named_robot("mountain_car")
    rewards, costs = [], []
    with BallbotEnv("mountain-car") as env:
        for place, speed, action in ((0.4, 0.03, 0.5), (-0.5, 0.0, 0.1)):
            env.reset(seed=0, options={"state": np.array([place, speed])})
            ended, infos = False, []
            while not ended:
                *_, terminated, truncated, info = env.step(np.array([action], np.float32))
                infos.append(info)
                ended = terminated or truncated
            rewards.append(sum(info["reward_survive"] + info["reward_cost"] + info["reward_goal"] for info in infos))
            costs.append(sum(info["cost"] for info in infos))
            assert terminated == (action == 0.5)
            assert info["reward_goal"] == (100.0 if terminated else 0.0)
    np.testing.assert_allclose(np.add(rewards, costs), task.survival_pay)
    assert costs[1] == pytest.approx(100 + 999 * 0.1 * 0.1**2)
    assert task.survival_pay == 100
    endless = type("Endless", (type(task),), {"first_exit": False})()
    with pytest.raises(ValueError, match="goal_reward"):
        check_methods(endless, robot, np.array([-0.5, 0.0]), np.zeros(0))


@pytest.mark.parametrize("engine", ["native", "numpy", "torch"])
def test_many_cars_report_what_one_does(engine):
    short, states = replace(make_task("mountain_car"), duration=1.0), np.array([[0.44, 0.03], [-1.19, -0.02]])
    names = ("reward_survive", "reward_cost", "reward_goal", "cost", "success")
    many = BallbotVectorEnv(2, short, dtype="float64", engine=engine, compile=False, autoreset_mode="Disabled")
    many.reset(seed=0, options={"state": states})
    _, rewards, terminated, truncated, infos = many.step(np.full((2, 1), 0.5, np.float32))
    for n, start in enumerate(states):  # one arrives in its only step, and the other does not
        with BallbotEnv(short) as env:
            env.reset(seed=0, options={"state": start})
            _, reward, *ends, info = env.step(np.array([0.5], np.float32))
        assert ends == [n == 0, n == 1] == [bool(terminated[n]), bool(truncated[n])]
        assert rewards[n] == pytest.approx(reward, abs=1e-9)
        assert [float(infos[name][n]) for name in names] == pytest.approx([float(info[name]) for name in names])
        np.testing.assert_allclose(infos["state"][n], info["state"], atol=1e-12)


@pytest.mark.parametrize("name", ["pendulum", "mountain_car", "cart_pole", "acrobot"])
def test_the_package_brings_certified_sets(name, own_cache):
    task, robot = make_task(name), robot_of(name)
    known = certified.load(task, robot)
    assert certified.path_of(task, name).parent == CLASSIC / "src" / "ballbot_classic" / "certified"
    assert len(known) == 200
    assert len(known.trajectories) == (200 if name in COUNTERPARTS else 20)
    assert known.violations.max() < 1e-6
    for seed in (0, 199):
        np.testing.assert_array_equal(known.states[seed], certified.cache.episode(task, robot, seed)[0])


def test_the_angle_may_wrap_and_the_rate_be_clipped_along_the_optimum():
    hanging, fast = optimum_of_seed("pendulum", 2).trajectory.x, optimum_of_seed("pendulum", 8).trajectory.x
    assert abs(hanging[-1, 0]) == pytest.approx(2 * math.pi)
    assert np.abs(fast[:, 1]).max() == pytest.approx(8.0, abs=1e-4)


def test_swings_of_either_side_and_number_are_compared(classic):
    task, robot = make_task("pendulum"), named_robot("pendulum")
    x, c = task.sample(np.random.default_rng(3), robot)
    found = sorted(each.cost for each in task.search_cases(Shooting(task, robot, x, c, Backoff())) if each.is_optimal)
    assert found[-1] > 1.01 * found[0]
    assert optimum_of_seed("pendulum", 3).cost == pytest.approx(found[0], rel=1e-9)


def test_controllers_reach_the_optimum_of_the_pendulum_and_lqr_does_not(own_cache):
    from ballbot_classic.pendulum import EnergyShaping

    shaping = EnergyShaping(make_task("pendulum"), named_robot("pendulum"))
    rows = {name: evaluate(name, "Pendulum-v1", episodes=3) for name in ("optimum", "nmpc", "lqr")}
    assert 0 < evaluate(shaping, "Pendulum-v1", episodes=3).regret_mean < 1
    assert abs(rows["optimum"].regret_mean) < 1e-9
    assert rows["nmpc"].regret_mean < 0.01
    assert rows["lqr"].regret_mean > 1


def test_a_function_acts_in_the_units_of_the_counterpart(own_cache):
    seen = []

    def push(observation):
        seen.append(observation)
        return np.array([2.0])

    evaluate(push, "Pendulum-v1", episodes=1)
    with BallbotEnv("pendulum"), gymnasium.make("Pendulum-v1") as other:
        expected, _ = other.reset(seed=0)
        np.testing.assert_array_equal(seen[0], expected)
        cost = sum(-other.step(np.array([2.0], np.float32))[1] for _ in range(200))
        row = evaluate(push, "pendulum", episodes=1)  # an action of 2 is clipped to 1, which is as much
    assert row.regret_mean == pytest.approx(cost / optimum_of_seed("pendulum", 0).cost - 1, rel=1e-5)


def test_the_wrapper_reports_the_regret_of_every_episode(own_cache):
    env = RegretWrapper(gymnasium.make("Pendulum-v1"))
    for seed in (0, 10_001):
        env.reset(seed=seed)
        total, ended = 0.0, False
        while not ended:
            _, reward, _terminated, ended, info = env.step(np.zeros(1, np.float32))
            total += reward
            assert ended == ("regret" in info)
        best = optimum_of_seed("pendulum", seed).cost
        assert info["optimum"] == pytest.approx(-best)
        assert info["gap"] == pytest.approx(-best - total)
        assert info["regret"] == pytest.approx(-total / best - 1)
    assert len(list(own_cache.rglob("starts/*.json"))) == 1  # the other is in the certified set


def test_the_wrapper_takes_own_environments_and_many_at_once(own_cache):
    env = RegretWrapper(gymnasium.make("ClassicPendulum-v0"))
    env.reset(seed=1)
    for _ in range(200):
        *_, info = env.step(np.zeros(1, np.float32))
    many = gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync", wrappers=[RegretWrapper])
    many.reset(seed=1)
    for _ in range(200):
        *_, infos = many.step(np.zeros((2, 1), np.float32))
    assert infos["regret"][0] == pytest.approx(info["regret"], rel=1e-5)
    with pytest.raises(ValueError, match="unknown task 'Acrobot-v1'"):
        RegretWrapper(gymnasium.make("Acrobot-v1"))


def test_a_system_without_limits_or_position_is_measured_batched_and_drawn(classic):
    optimum, task, robot = optimum_of_seed("pendulum", 1), make_task("pendulum"), named_robot("pendulum")
    found = regret(optimum.trajectory, task, robot)
    assert (found.violated, found.success) == ("", True)
    assert found.regret == pytest.approx(0, abs=1e-9)
    assert np.abs(found.defects).max() < 1e-9
    batch = BallbotBatch("pendulum", 2, compile=False)
    batch.reset(seed=0)
    assert batch.step(torch.zeros(2, 1)).violated.tolist() == [-1, -1]
    replay = Replay("", (Take("", optimum.trajectory, "#000000"),), params=robot)
    frames = list(film_frames(replay, [0.0, 1.0], 128))
    assert (frames[0] != frames[1]).any()


def test_kellys_cart_pole_costs_what_others_publish():
    """58.84 N²·s is what the tests of OpenMDAO's Dymos expect of Kelly's problem, with forces that vary linearly."""
    task, robot = replace(make_task("kelly_cart_pole"), control_dt=0.01), named_robot("kelly_cart_pole")
    optimum = find_optimum(task, robot, np.array([0.0, math.pi, 0.0, 0.0]), np.zeros(0))
    x, effort = optimum.trajectory.x, optimum.trajectory.u[:, 0]
    assert optimum.is_optimal
    assert optimum.cost == pytest.approx(task.control_dt * np.sum(effort**2))
    assert optimum.cost == pytest.approx(58.84, rel=1e-3)  # measured: 3e-4
    np.testing.assert_allclose(x[-1], [1, 0, 0, 0], atol=1.01e-4)
    assert np.abs(x[:, 0]).max() <= task.track


def test_without_a_torque_the_acrobots_energy_stays():
    robot, x = named_robot("acrobot"), np.array([2.0, 0.5, 1.0, -1.0])
    before = robot.energy(x)
    for _ in range(100):
        x = robot.step(x, np.zeros(1), 0.01, 1)
    assert robot.energy(x) == pytest.approx(before, rel=1e-6)


def test_an_acrobots_swing_ups_of_other_sides_cost_more_than_the_optimum():
    task, robot = make_task("acrobot"), named_robot("acrobot")
    x, c = task.sample(np.random.default_rng(0), robot)
    optimum = find_optimum(task, robot, x, c)
    assert optimum.is_optimal
    assert task.is_goal(optimum.trajectory.x[-1], c)
    found = task.search_cases(Shooting(task, robot, x, c, Backoff()))
    assert max(each.cost for each in found if each.is_optimal) > 1.2 * optimum.cost
    with BallbotEnv("acrobot") as env:
        run = rollout(env, VARIANTS["optimum"](task, robot), options={"state": x})
    assert run.success
    assert run.cost == pytest.approx(optimum.cost, rel=1e-6)


def test_the_packages_do_not_name_them():
    folders = [Path(package.__file__).parent for package in (ballbot_gym, ballbot_baselines, ballbot_train)]
    words = ("mountain", "acrobot", "angle_normalize")
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        assert not [word for word in words if word in path.read_text().lower()], path
