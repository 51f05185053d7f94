"""Saved models of other libraries: they act as their libraries make them act, and nothing in their files is executed."""

import io
import json
import pickle
import re
import zipfile

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import (
    DiscretizeAction,
    FlattenObservation,
    FrameStackObservation,
    NormalizeObservation,
    RescaleAction,
)
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from ballbot_gym import TASKS, Stabilize, certified, ops
from ballbot_gym.env import make_task
from ballbot_gym.robot import default_params
from ballbot_train import BallbotVecEnv, RegretCallback
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.evaluation.evaluate import evaluate
from ballbot_train.evaluation.fresh import evaluate_fresh
from ballbot_train.policy.files import PolicyError
from ballbot_train.policy.saved_models import SavedModel

TASK = make_task("stabilize")
OBSERVATIONS = np.random.default_rng(0).normal(size=(50, 8)).astype(np.float32)


def envs():
    return DummyVecEnv([lambda: gymnasium.make("BallbotStabilize-v0", physics="rk4")])


def acts(path):
    with torch.no_grad():
        return SavedModel.read(path).actor(TASK, default_params())(torch.as_tensor(OBSERVATIONS)).numpy()


def louder(model):
    """The model with larger outputs, so that squashing and clipping show."""
    with torch.no_grad():
        for name, part in model.policy.named_parameters():
            if "action_net" in name or "mu" in name:
                part.mul_(100)
    return model


MODELS = {
    "ppo": lambda: PPO("MlpPolicy", envs(), device="cpu"),
    "relu": lambda: PPO("MlpPolicy", envs(), policy_kwargs={"net_arch": [7, 5], "activation_fn": torch.nn.ReLU}),
    "sac": lambda: SAC("MlpPolicy", envs(), buffer_size=10, device="cpu"),
    "ppo with gSDE": lambda: PPO("MlpPolicy", envs(), use_sde=True, device="cpu"),
    "sac with gSDE": lambda: SAC("MlpPolicy", envs(), buffer_size=10, use_sde=True, device="cpu"),
    "td3": lambda: TD3("MlpPolicy", envs(), buffer_size=10, policy_kwargs={"net_arch": [6]}, device="cpu"),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_saved_model_acts_as_the_model(name, tmp_path):
    model = louder(MODELS[name]())
    model.save(tmp_path / "model.zip")
    expected, _ = model.predict(OBSERVATIONS, deterministic=True)
    assert np.abs(expected).max() > 0.5
    np.testing.assert_allclose(acts(tmp_path / "model.zip"), np.clip(expected, -1, 1), atol=1e-5)


@pytest.fixture
def normalized(tmp_path):
    venv = VecNormalize(envs(), clip_obs=2.0)
    model = PPO("MlpPolicy", venv, n_steps=8, batch_size=8, n_epochs=1, device="cpu").learn(16)
    path = tmp_path / "model.zip"
    louder(model).save(path)
    return model, path


def test_a_saved_model_with_statistics_of_vecnormalize_is_refused(normalized):
    _, path = normalized
    with pytest.raises(
        PolicyError, match=r"has statistics of VecNormalize, which is not read; .* load the model where"
    ):
        acts(path)


def test_a_saved_model_is_evaluated_by_its_path(tmp_path):
    path = tmp_path / "model.zip"
    MODELS["ppo"]().save(path)
    assert controllers_of(["turn", "stabilize"], [str(path)]) == {"paper": {"stabilize": [str(path)]}}
    assert evaluate(path, "stabilize", 1, "rk4").episodes == 1
    assert len(evaluate_fresh(path, "stabilize", 3)) == 3
    with pytest.raises(ValueError, match="was made for a task with 8 observations, which is none of turn"):
        controllers_of(["turn"], [str(path)])
    with pytest.raises(PolicyError, match="takes 8 observations and gives 2 actions; BallbotTurn-v0 has 9 and 2"):
        SavedModel.read(path).actor(make_task("turn"), default_params())


def stacked(env):
    return FlattenObservation(FrameStackObservation(env, 3))


WRAPPERS = {
    "RescaleAction": (
        lambda env: RescaleAction(env, np.float32(-350), np.float32(350)),
        "trained on actions (2,) float32 from -350 to 350",
    ),
    "NormalizeObservation": (NormalizeObservation, "trained on observations (8,) float32 from -inf to inf"),
    "stacked": (stacked, "24"),
    "discrete": (lambda env: DiscretizeAction(env, 5), "2"),
}


def make():
    return gymnasium.make("BallbotStabilize-v0", physics="rk4")


@pytest.mark.filterwarnings("ignore")  # Gymnasium's of dtypes
@pytest.mark.parametrize("name", WRAPPERS)
def test_a_model_of_other_spaces_is_not_scored_without_what_made_them(name, tmp_path):
    wrap, said = WRAPPERS[name]
    venv = DummyVecEnv([lambda: wrap(make())])
    model = PPO("MlpPolicy", venv, policy_kwargs={"net_arch": [4]}, device="cpu")
    model.save(tmp_path / "model.zip")
    for evaluated in (evaluate, evaluate_fresh):
        with pytest.raises(PolicyError, match=r"Where a wrapper changed them, give ballbot_train\.evaluate a function"):
            evaluated(model, "stabilize", 1)
        with pytest.raises(PolicyError, match=re.escape(said)):
            evaluated(tmp_path / "model.zip", "stabilize", 1)
    with pytest.raises(ValueError, match=r"Where a wrapper changed|which is none of stabilize|not a network of linear"):
        controllers_of(["stabilize"], [str(tmp_path / "model.zip")])


def test_a_function_that_does_what_the_wrapper_did_is_scored_as_the_model_in_it():
    venv = DummyVecEnv([lambda: RescaleAction(make(), np.float32(-350), np.float32(350))])
    model = louder(PPO("MlpPolicy", venv, policy_kwargs={"net_arch": [4]}, device="cpu"))
    cost = evaluate(lambda observation: model.predict(observation, deterministic=True)[0] / 350, "stabilize", 1, "rk4")
    env = RescaleAction(make(), np.float32(-350), np.float32(350))
    observation, _ = env.reset(options=certified.load("stabilize", "paper").options(0))
    expected, done = 0.0, False
    while not done:
        observation, _, terminated, truncated, info = env.step(model.predict(observation, deterministic=True)[0])
        expected, done = expected + info["cost"], terminated or truncated
    assert cost.cost_mean == pytest.approx(expected, rel=1e-6)


def test_a_model_that_lost_its_vecnormalize_is_refused(normalized):
    _, path = normalized
    with pytest.raises(
        PolicyError, match=r"PPO was trained with VecNormalize and has none now; load the model with it"
    ):
        evaluate(PPO.load(path, device="cpu"), "stabilize", 1, "rk4")


class Bomb:
    def __reduce__(self):
        return print, ("executed",)


def rewritten(path, change):
    """The model with one member of its archive changed."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def with_data(**changes):
    def change(members):
        members["data"] = json.dumps(json.loads(members["data"]) | changes).encode()

    return change


def bombed(members):
    members["policy.pth"] = pickle.dumps({"action_net.weight": Bomb()})


def with_weights(**changes):
    """A change of some weights, by the last words of their names."""

    def change(members):
        weights = torch.load(io.BytesIO(members["policy.pth"]), weights_only=True)
        for name, made in changes.items():
            weights[f"action_net.{name}"] = made(weights[f"action_net.{name}"])
        buffer = io.BytesIO()
        torch.save(weights, buffer)
        members["policy.pth"] = buffer.getvalue()

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (bombed, "cannot be read as a saved model"),
        (with_weights(weight=lambda weight: weight * float("nan")), "action_net.weight holds NaN or infinity"),
        (with_weights(weight=lambda weight: weight + 1j), "action_net.weight holds torch.complex64"),
        (with_weights(weight=lambda weight: weight.int()), "action_net.weight holds torch.int32"),
        (with_weights(weight=lambda weight: weight + 3e38), "holds numbers beyond ±1e"),
        (with_weights(weight=lambda weight: torch.ones(1).expand(2, 2**28)), "numbers, and stores fewer"),
        (with_weights(bias=lambda bias: torch.zeros(3)), "is not a network of linear layers that ends in actions"),
        (with_data(policy_kwargs={"activation_fn": "a" * 500_000}), "has the activation a{100}, which is not read"),
        (lambda members: members.pop("data"), "it holds no data"),
        (lambda members: members.update(data=b"{}"), "cannot be read as a saved model"),
        (with_data(policy_kwargs={"squash_output": True}), "squashed by tanh"),
        (with_data(policy_class={"__module__": "mine"}), "has a policy of mine, which is not read; give a model with"),
        (with_data(policy_kwargs={"features_extractor_class": "x"}), "a network that extracts features"),
        (with_data(policy_kwargs={"activation_fn": "<class 'Mish'>"}), "has the activation <class 'Mish"),
    ],
)
def test_models_that_are_damaged_or_of_another_kind_are_refused(change, message, tmp_path, capsys):
    path = tmp_path / "model.zip"
    PPO("MlpPolicy", envs(), policy_kwargs={"net_arch": [4]}, device="cpu").save(path)
    rewritten(path, change)
    with pytest.raises(PolicyError, match=message):
        acts(path)
    assert "executed" not in capsys.readouterr().out


def with_history():
    return DummyVecEnv([lambda: gymnasium.make("BallbotStabilize-v0", physics="rk4", history=4)])


def test_a_model_that_sees_the_past_acts_alike_as_object_and_as_file(tmp_path):
    model = louder(PPO("MlpPolicy", with_history(), policy_kwargs={"net_arch": [4]}, device="cpu"))
    model.save(tmp_path / "model.zip")
    rows = [evaluate(policy, "stabilize", 2, "rk4", "row") for policy in (model, tmp_path / "model.zip")]
    assert rows[0].cost_mean == pytest.approx(rows[1].cost_mean, rel=1e-6)
    fresh = [evaluate_fresh(policy, "stabilize", 2) for policy in (model, tmp_path / "model.zip")]
    np.testing.assert_allclose(fresh[0].costs, fresh[1].costs, rtol=1e-5)


def test_a_stack_of_frames_is_not_taken_for_a_history_of_the_same_size(tmp_path):
    model = PPO("MlpPolicy", VecFrameStack(envs(), 6), policy_kwargs={"net_arch": [4]}, device="cpu")
    assert model.observation_space.shape == with_history().observation_space.shape
    model.save(tmp_path / "model.zip")
    for policy in (model, tmp_path / "model.zip"):
        with pytest.raises(PolicyError, match="may be a stack of frames"):
            evaluate(policy, "stabilize", 1, "rk4")


class Tanh(torch.nn.Module):
    """A user's activation with the name of torch's."""

    def forward(self, x):
        return 0.5 * torch.tanh(x)


def test_a_users_activation_is_not_taken_for_that_of_torch(tmp_path):
    PPO("MlpPolicy", envs(), policy_kwargs={"activation_fn": Tanh}, device="cpu").save(tmp_path / "model.zip")
    with pytest.raises(PolicyError, match=r"the activation .*Tanh"):
        acts(tmp_path / "model.zip")


class Halved(Stabilize):
    """Stabilize with another observation, of the same size and bounds."""

    def observe(self, x, c):
        return ops.stack(tuple(0.5 * value for value in ops.components(super().observe(x, c))), like=x)


@pytest.mark.parametrize("marked_by", ["vec env", "callback", "nobody"])
def test_a_model_is_known_by_its_observation_where_its_file_can_hold_it(marked_by, tmp_path, monkeypatch):
    if marked_by == "vec env":
        venv = BallbotVecEnv(gymnasium.make_vec("BallbotStabilize-v0", num_envs=2).unwrapped)
    else:
        venv = envs()
    settings = {"n_steps": 4, "batch_size": 4, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}, "device": "cpu"}
    model = PPO("MlpPolicy", venv, **settings)
    model.learn(4, RegretCallback("stabilize", validation_episodes=2) if marked_by == "callback" else None)
    model.save(tmp_path / "model.zip")
    policies = model, tmp_path / "model.zip", PPO.load(tmp_path / "model.zip", device="cpu")
    assert [evaluate(policy, "stabilize", 1, "rk4").episodes for policy in policies] == [1, 1, 1]
    monkeypatch.setitem(TASKS, "stabilize", Halved)
    for policy in policies:
        if marked_by == "nobody":  # nothing tells it
            evaluate(policy, "stabilize", 1, "rk4")
        else:
            with pytest.raises(PolicyError, match="was trained on other observations"):
                evaluate(policy, "stabilize", 1, "rk4")
