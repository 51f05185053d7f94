"""`RegretCallback`: a Stable-Baselines3 model of anybody's is measured while it trains."""

import csv
from typing import Any, cast

import pytest
from stable_baselines3 import PPO

from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_train import BallbotVecEnv, RegretCallback, evaluate, load_policy, shipped_policies


@pytest.fixture
def shipped():
    return next(iter(shipped_policies(make_task("turn")).values()))


def envs():
    return BallbotVecEnv(BallbotVectorEnv(8, "orbit"))


def ppo(env):
    return PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1, seed=0, device="cpu")


def test_it_measures_at_equal_distances_and_at_the_end_and_keeps_the_best(tmp_path):
    model, callback = ppo(envs()), RegretCallback("orbit", eval_freq=64, save_path=tmp_path, validation_episodes=20)
    model.learn(8 * 80, callback)
    assert [figures["timesteps"] for figures in callback.evaluations] == [512, 640]
    best = min(callback.evaluations, key=lambda figures: (figures["validation/cost"], figures["validation/mean_cost"]))
    assert callback.best == best
    with (tmp_path / "evaluations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["certified/success"]) for row in rows] == [
        figures["certified/success"] for figures in callback.evaluations
    ]
    assert (tmp_path / "best_model.zip").exists()
    assert evaluate(tmp_path / "best_model.zip", "orbit", episodes=2, physics="rk4").episodes == 2


def test_its_figures_are_those_of_evaluate(shipped, monkeypatch):
    callback, policy = RegretCallback("turn", validation_episodes=1), load_policy(shipped)
    callback.model = cast(Any, policy)
    some = certified.load("turn", "paper").first(30)
    monkeypatch.setattr(certified, "load", lambda *problem, **more: some)
    figures = callback.evaluate()
    row = evaluate(policy, "turn", 30, physics="rk4")
    assert figures["certified/failures"] == row.falls == 0
    assert figures["certified/success"] == row.success == 1
    assert figures["certified/regret_mean"] == pytest.approx(row.regret_mean, rel=1e-3)
    assert figures["certified/regret_median"] == pytest.approx(row.regret_median, rel=1e-3)
    assert figures["certified/regret_worst"] > row.regret_mean


def test_numbers_below_one_are_refused():
    with pytest.raises(ValueError, match="eval_freq must be at least 1, not 0"):
        RegretCallback("stabilize", eval_freq=0)
    with pytest.raises(ValueError, match="validation_episodes must be at least 1, not 0"):
        RegretCallback("stabilize", validation_episodes=0)
