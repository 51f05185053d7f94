"""Demonstrations: what a dataset promises, and that a kill neither loses nor doubles an episode."""

import json
import random
import shlex
import subprocess
import sys
import time
from pathlib import Path

import minari
import numpy as np
import pytest

from ballbot_baselines.feedback import trajopt
from ballbot_baselines.feedback.trajopt import EXECUTED
from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.rollout import PlanError
from ballbot_train.cli import main
from ballbot_train.learning.datasets import command_of, load_demos
from ballbot_train.learning.demonstrations import DemoConfig, Expert, write_demos
from ballbot_train.policy.files import shipped_policies
from ballbot_train.policy.network import load_policy
from ballbot_train.work.executors import Workers


def make(out, **changes):
    fields = {"task": "stabilize", "expert": "lqr", "episodes": 3, "physics": "rk4"} | changes
    return write_demos(DemoConfig(**fields), out, workers=1)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make(tmp_path_factory.mktemp("demos") / "tiny-v0", expert="trajopt")


def content(folder):
    """All that a dataset holds, comparable."""
    data = minari.MinariDataset(folder / "data")
    episodes = [
        (e.observations.tolist(), e.actions.tolist(), e.rewards.tolist(), e.infos["expert_action"].tolist())
        for e in data
    ]
    return episodes, [str(sorted(m.items())) for m in data.storage.get_episode_metadata(data.episode_indices)]


def test_a_dataset_loads_by_its_id_and_recovers_its_environment(dataset, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(dataset.parent))
    data = minari.load_dataset(dataset.name)
    assert data.total_episodes == 3
    env = data.recover_environment()
    assert env.spec.id == "BallbotStabilize-v0"
    assert env.unwrapped.physics == "rk4"
    assert list(minari.list_local_datasets()) == [dataset.name]
    env.close()


def test_seeds_and_actions_replay_the_episodes(dataset):
    data = minari.MinariDataset(dataset / "data")
    env = data.recover_environment()
    for episode, metadata in zip(data, data.storage.get_episode_metadata(data.episode_indices), strict=True):
        observation, _ = env.reset(seed=metadata["seed"])
        assert np.array_equal(observation, episode.observations[0])
        for action, after, reward in zip(episode.actions, episode.observations[1:], episode.rewards, strict=True):
            observation, again, *_ = env.step(action)
            assert np.array_equal(observation, after)
            assert again == reward
    env.close()


def test_scores_are_normalized_between_random_actions_and_the_optima(dataset):
    metadata = minari.MinariDataset(dataset / "data").storage.metadata
    optimal = 800 - certified.load("stabilize", "paper").costs.mean()  # return + cost = 800
    assert metadata["ref_max_score"] == pytest.approx(optimal, abs=1e-3)
    assert 0 < metadata["ref_min_score"] < 50


def test_every_episode_says_who_showed_it_and_what_it_cost(dataset):
    data, pay = minari.MinariDataset(dataset / "data"), make_task("stabilize").survival_pay
    for episode, metadata in zip(data, data.storage.get_episode_metadata(data.episode_indices), strict=True):
        assert metadata["expert"] == "trajopt"
        assert metadata["cost"] == pytest.approx(pay - episode.rewards.sum())
        assert not metadata["failure"]
        assert metadata["plans"] >= 1


def test_labels_are_the_experts_and_not_what_was_executed(dataset):
    demos = load_demos(dataset, make_task("stabilize"))
    noise = demos.executed - demos.actions
    assert 0 < np.median(np.abs(noise)) < 0.05
    assert np.abs(noise).max() > 0.3  # a push
    assert np.abs(demos.actions).max() <= 1


def test_loaded_steps_follow_each_other(dataset):
    demos = load_demos(dataset, make_task("stabilize"))
    assert len(demos) == 3 * 400
    assert demos.observations.dtype == demos.actions.dtype == demos.rewards.dtype == np.float32
    inside = ~(demos.terminations | demos.truncations)[:-1]
    assert np.array_equal(demos.next_observations[:-1][inside], demos.observations[1:][inside])
    assert (demos.terminations | demos.truncations).sum() == 3


def test_a_dataset_of_another_task_is_refused(dataset, tmp_path):
    with pytest.raises(ValueError, match=r"holds demonstrations of Stabilize.*not of Turn"):
        load_demos(dataset, make_task("turn"))
    with pytest.raises(ValueError, match="not of Stabilize"):
        load_demos(dataset, make_task("stabilize", duration=4.0))
    with pytest.raises(ValueError, match="not a dataset"):
        load_demos(tmp_path, make_task("stabilize"))


def test_a_finished_dataset_is_kept_and_another_never_overwrites_it(tmp_path):
    folder = make(tmp_path / "kept-v0")
    before = content(folder)
    assert content(make(tmp_path / "kept-v0")) == before
    with pytest.raises(ValueError, match=r"holds a dataset of .*; give another --out"):
        make(tmp_path / "kept-v0", seed=1)
    with pytest.raises(ValueError, match="NAME-vNUMBER"):
        make(tmp_path / "unversioned")
    assert [path.name for path in tmp_path.iterdir()] == ["kept-v0"]


def test_a_policy_that_comes_with_the_package_can_demonstrate(tmp_path):
    task = make_task("orbit")
    folder = make(tmp_path / "orbits-v0", task="orbit", expert="dagger", episodes=1)
    demos = load_demos(folder, task)
    policy = load_policy(shipped_policies(task)["dagger"], task)
    np.testing.assert_allclose(policy.predict(demos.observations)[0], demos.actions, atol=1e-5)
    with pytest.raises(ValueError, match=f"unknown expert apg; known: lqr, .*{', '.join(shipped_policies(task))}$"):
        DemoConfig("orbit", "apg")


def test_its_command_makes_it_anew(dataset, tmp_path, monkeypatch):
    words = shlex.split(command_of(dataset))
    assert words[:2] == ["ballbot", "demos"]
    made = Path(words[words.index("--out") + 1])
    assert made == dataset
    words[words.index("--out") + 1] = str(tmp_path / "again-v0")
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(Workers, "here", 1)  # and so in this process
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert content(tmp_path / "again-v0") == content(dataset)


def test_the_expert_recovers_from_pushes():
    """With a push every half second NMPC's own plan from where it was pushed keeps what LQR's region cannot."""
    env = BallbotEnv("stabilize", physics="rk4")
    expert = Expert("nmpc", env.task, env.params, EXECUTED)
    start = {"state": [1, 0, 0, 0, 0, 3, 0, 0]}
    recording, info = expert.record(env, np.random.default_rng(1), noise=0.02, pushes=2.0, options=start)
    assert expert.plans > 5
    assert not info["failure"]
    assert len(recording["actions"]) == env.task.steps
    env.close()


def test_an_expert_without_a_plan_keeps_its_last_one(monkeypatch):
    env = BallbotEnv("stabilize", physics="rk4")
    expert = Expert("trajopt", env.task, env.params)
    x = np.array([1.0, 0, 0, 0, 0, 1, 0, 0])
    expert.reset(0.0, x, np.zeros(0))
    before = expert.label(0.0, x)

    def find_none(*arguments, **keywords):
        raise PlanError("no feasible episode")

    monkeypatch.setattr(trajopt, "plan_to_track", find_none)
    expert.replan(0.0, np.array([0, 0, 1.39, 0, 0, 0, 9.0, 0]))  # falling: no force could help
    assert expert.plans_failed == 1
    assert np.array_equal(expert.label(0.0, x), before)
    with pytest.raises(PlanError):
        expert.reset(0.0, np.array([0, 0, 1.39, 0, 0, 0, 9.0, 0]), np.zeros(0))
    env.close()


def test_killed_at_any_time_it_resumes_to_the_identical_dataset(tmp_path, typed):
    """SIGKILL while episodes are being recorded in two processes, then to the end in one."""
    command = ["demos", "--expert", "lqr", "--physics", "rk4", "--episodes", "20"]
    killed, whole = tmp_path / "killed-v0", tmp_path / "whole-v0"
    assert typed(*command, "--workers", 1, "--out", whole)[0] == 0
    unfinished = tmp_path / ".killed-v0.unfinished"
    process = subprocess.Popen(
        [sys.executable, "-m", "ballbot_train.cli", *command, "--workers", "2", "--out", killed],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while process.poll() is None and not any(unfinished.rglob("*.npz")):
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.3))
    process.kill()
    process.wait()
    assert typed(*command, "--workers", 1, "--out", killed)[0] == 0
    assert content(killed) == content(whole)
    seeds = [json.loads(str(m["seed"])) for m in _metadata(killed)]
    assert seeds == [1_000_000 + i for i in range(20)]
    assert not unfinished.exists()


def _metadata(folder):
    data = minari.MinariDataset(folder / "data")
    return data.storage.get_episode_metadata(data.episode_indices)
