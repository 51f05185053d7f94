"""Gymnasium's own environments with their optima: for Stable-Baselines3, vector environments and Minari."""

import csv

import gymnasium
import minari
import numpy as np
import pytest
from builders import CLASSIC, classic_systems, script
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ballbot_gym import certified
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.rollout import PlanError
from ballbot_train import RegretWrapper, evaluate
from ballbot_train.evaluation import counterparts

EXPERIMENTS = CLASSIC.parent.parent / "docs" / "experiments"
KEYS = ("optimum", "gap", "regret")
SMALL = {"n_steps": 200, "batch_size": 200, "n_epochs": 1, "device": "cpu"}


@pytest.fixture(scope="module", autouse=True)
def classic(tmp_path_factory):
    """The systems of the example, and a folder of optima that only these tests use."""
    folder = tmp_path_factory.mktemp("optima")
    folder.chmod(0o700)
    with pytest.MonkeyPatch.context() as patched, classic_systems() as package:
        patched.setenv("BALLBOT_OPTIMA", str(folder))
        yield package


def make():
    return RegretWrapper(gymnasium.make("Pendulum-v1"))


def best(seed):
    task = make_task("pendulum")
    return task.survival_pay - certified.load(task, robot_of("pendulum")).costs[seed]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments_report_the_regret_of_every_env(mode):
    many = gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode=mode, wrappers=[RegretWrapper])
    many.reset(seed=4)
    returns = np.zeros(2)
    for _ in range(200):
        _, rewards, *_, infos = many.step(np.zeros((2, 1), np.float32))
        returns += rewards
    many.close()
    expected = [best(4), best(5)]
    np.testing.assert_allclose(infos["optimum"], expected, rtol=1e-6)
    np.testing.assert_allclose(infos["gap"], expected - returns, rtol=1e-5)


def test_an_episode_without_an_optimum_has_the_same_keys(monkeypatch):
    def find_none(*problem):
        raise PlanError("no feasible episode")

    monkeypatch.setattr("ballbot_baselines.find_optimum", find_none)
    counterparts._optimal_cost.cache_clear()
    env = Monitor(make(), info_keywords=KEYS)
    env.reset(seed=77_001)
    for _ in range(200):
        *_, info = env.step(np.zeros(1, np.float32))
    assert np.isnan([info["episode"][key] for key in KEYS]).all()


def test_stable_baselines_monitors_evaluates_and_logs_the_gap(tmp_path):
    class LogGap(BaseCallback):
        def _on_step(self):
            for info in self.locals["infos"]:
                if "episode" in info:
                    self.logger.record_mean("rollout/gap", info["episode"]["gap"])
            return True

    envs = make_vec_env(make, n_envs=2, seed=0, monitor_kwargs={"info_keywords": KEYS})
    judge = Monitor(make(), str(tmp_path / "judge"), info_keywords=KEYS)
    judge.reset(seed=3)
    model = PPO("MlpPolicy", envs, tensorboard_log=str(tmp_path), seed=0, **SMALL)
    evaluates = EvalCallback(judge, eval_freq=200, n_eval_episodes=1, verbose=0)
    model.learn(400, [LogGap(), evaluates], log_interval=1)
    envs.close()
    gaps = [found["gap"] for found in model.ep_info_buffer]
    assert [found["optimum"] - found["r"] for found in model.ep_info_buffer] == pytest.approx(gaps, abs=1e-5)
    (logged,) = tmp_path.glob("PPO_1/events*")
    events = EventAccumulator(str(logged)).Reload()
    assert events.Scalars("rollout/gap")[-1].value == pytest.approx(np.mean(gaps), rel=1e-5)
    with (tmp_path / "judge.monitor.csv").open() as file:
        next(file)
        (row,) = csv.DictReader(file)
    assert float(row["gap"]) == pytest.approx(float(row["optimum"]) - float(row["r"]), abs=1e-5)
    assert evaluates.last_mean_reward == pytest.approx(float(row["r"]), abs=1e-5)


@pytest.mark.parametrize(("kind", "options"), [(PPO, SMALL | {"use_sde": True}), (SAC, {"buffer_size": 10})])
def test_a_model_its_file_and_its_function_have_the_same_regret(kind, options, tmp_path):
    model = kind("MlpPolicy", gymnasium.make("Pendulum-v1"), seed=1, **options)
    model.save(tmp_path / "model.zip")

    def function(observation):
        return model.predict(observation, deterministic=True)[0]

    rows = [evaluate(policy, "Pendulum-v1", 2) for policy in (model, tmp_path / "model.zip", function)]
    costs = [row.cost_mean for row in rows]
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-4)
    assert rows[0].episodes == 2
    assert [row.controller for row in (rows[0], rows[2])] == [kind.__name__.lower(), "function"]
    with gymnasium.make("Pendulum-v1") as env:
        total = 0.0
        for seed in range(2):
            observation, _ = env.reset(seed=seed)
            for _ in range(200):
                observation, reward, *_ = env.step(function(observation))
                total += reward
    assert costs[0] == pytest.approx(-total / 2, rel=1e-4)


def test_agents_are_trained_with_the_settings_of_the_zoo_and_measured(tmp_path, capsys):
    agents = script(CLASSIC / "agents.py")
    agents.train("MountainCarContinuous-v0", "ppo", out=tmp_path, steps=8)
    model = agents.loaded(tmp_path / "MountainCarContinuous-v0-ppo-0.zip", "MountainCarContinuous-v0", "ppo")
    assert (model.gamma, model.use_sde, model.n_steps) == (0.9999, True, 8)
    statistics = model.get_vec_normalize_env()
    assert statistics.gamma == model.gamma
    assert statistics.obs_rms.count > 8
    for agent in ("sac", "td3"):
        agents.train("Pendulum-v1", agent, out=tmp_path, steps=1)
    agents.measure("Pendulum-v1", tmp_path, episodes=1, controllers=("random", "energy shaping"))
    with (tmp_path / "Pendulum-v1.csv").open() as file:
        rows = {row["agent"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["optimum", "random", "energy shaping", "sac", "td3"]
    assert float(rows["optimum"]["return_mean"]) == pytest.approx(best(0), abs=1e-3)
    assert float(rows["optimum"]["gap_mean"]) == pytest.approx(0, abs=1e-3)
    assert float(rows["energy shaping"]["gap_mean"]) < float(rows["random"]["gap_mean"])


@pytest.mark.parametrize("system", ["pendulum", "mountain-car"])
def test_the_page_of_agents_shows_the_tables_of_its_data(system):
    data = EXPERIMENTS / f"classic-{system}.csv"
    assert script(CLASSIC / "agents.py").markdown(data) in (EXPERIMENTS / "classic-agents.md").read_text()


def test_datasets_hold_the_optimum_of_every_seed_and_its_score(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.warns(UserWarning, match="is set to None"):
        script(CLASSIC / "minari_dataset.py").main("Pendulum-v1", episodes=2)
    dataset = minari.load_dataset("pendulum/optimum-v0")
    returns = np.array([float(each.rewards.sum()) for each in dataset])
    np.testing.assert_allclose(returns, [best(0), best(1)], atol=1e-5)
    assert minari.get_normalized_score(dataset, returns).mean() == pytest.approx(1, abs=1e-6)
    assert dataset.storage.metadata["ref_min_score"] < -500
    env = dataset.recover_environment()
    first = next(iter(dataset))
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation, first.observations[0])
    assert env.step(first.actions[0])[1] == first.rewards[0]
