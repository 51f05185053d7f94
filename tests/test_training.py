"""Training runs: they learn, are written as promised, and go on after an interruption as if there had been none."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballbot_baselines.lqr import discrete_lqr
from ballbot_gym.params import default_params
from ballbot_gym.tasks import TASKS
from ballbot_train.learning import training
from ballbot_train.learning.learners import LEARNERS, shac
from ballbot_train.policy import PolicyNetwork, PolicySpec

SETTINGS = [
    "--total-iterations",
    "6",
    "--evaluations",
    "3",
    "--num-envs",
    "4",
    "--horizon",
    "3",
    "--hidden",
    "8",
    "--no-compile",
]


def parameters(learner):
    return torch.cat([value.flatten() for value in learner.network.state_dict().values()])


def run(*arguments, **keywords):
    command = [sys.executable, "-m", "ballbot_train.cli", "train", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **keywords)


def finishes(*arguments):
    process = run(*arguments)
    printed, _ = process.communicate()
    assert process.returncode == 0, printed


@pytest.mark.parametrize("name", TASKS)
def test_shac_goes_on_from_its_state_as_if_never_stopped(name):
    task, params = TASKS[name](), default_params()
    config = replace(
        LEARNERS["shac"].settings(name), total_iterations=4, num_envs=4, horizon=3, hidden=(8,), compile=False
    )
    whole = shac.Shac(task, params, config)
    for _ in range(4):
        whole.iterate()
    first = shac.Shac(task, params, config)
    for _ in range(2):
        first.iterate()
    second = shac.Shac(task, params, config, seed=5)
    second.load_state_dict(first.state_dict())
    for _ in range(2):
        second.iterate()
    assert torch.equal(parameters(whole), parameters(second))
    assert not torch.equal(parameters(whole), parameters(shac.Shac(task, params, config)))


def test_shac_starts_at_lqr_and_lowers_the_cost():
    """From LQR's start a few iterations of small envs already save cost on the certified episodes."""
    task, params = TASKS["stabilize"](), default_params()
    config = replace(
        LEARNERS["shac"].settings("stabilize"),
        total_iterations=30,
        num_envs=64,
        horizon=25,
        hidden=(32,),
        compile=False,
    )
    learner = shac.Shac(task, params, config)
    before = training.score(learner.network, task)
    assert before.success > 0.5  # LQR within the limits of tanh
    for _ in range(config.total_iterations):
        learner.iterate()
    assert training.score(learner.network, task).cost_ratio < 0.7 * before.cost_ratio


def test_shac_starts_from_a_policy_and_says_from_what_it_cannot():
    task, params = TASKS["turn"](), default_params()
    config = shac.ShacConfig(
        total_iterations=2, num_envs=4, horizon=3, hidden=(8,), critic_warmup_iterations=1, compile=False
    )
    donor, learner = (shac.Shac(task, params, config, seed) for seed in (1, 2))
    learner.start_from(donor.network)
    assert torch.equal(parameters(learner), parameters(donor))
    learner.iterate()  # only the critic learns
    assert torch.equal(parameters(learner), parameters(donor))
    learner.iterate()
    assert not torch.equal(parameters(learner), parameters(donor))
    with pytest.raises(ValueError, match="cannot start"):
        shac.Shac(task, params, replace(config, hidden=(9,))).start_from(donor.network)


def test_a_critic_that_does_not_learn_stays_lqr_s_cost():
    task, params = TASKS["stabilize"](), default_params()
    learner = shac.Shac(
        task, params, shac.ShacConfig(num_envs=4, horizon=3, hidden=(8,), critic_gradient_steps=0, compile=False)
    )
    learner.iterate()
    x = 0.01 * torch.arange(8.0)
    _, p = discrete_lqr(task, params, np.zeros(8), np.zeros(2), np.zeros(0))
    observation = torch.as_tensor(task.observe(x.numpy(), ()), dtype=torch.float32)
    expected = x.double().numpy() @ p @ x.double().numpy()
    assert float(learner.critic(observation).detach()) == pytest.approx(expected, rel=0.05)


def test_odd_policies_are_odd():
    task = TASKS["stabilize"]()
    network = PolicyNetwork(PolicySpec.of(task, hidden=(8,), odd=True))
    observation = torch.randn(5, 8)
    assert torch.equal(network(-observation), -network(observation))


def test_a_killed_run_resumes_to_the_same_result(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    common = ["shac", "--threads", 1, *SETTINGS]
    finishes(*common, "--out", whole)
    process = run(*common, "--out", killed, env=os.environ | {"BALLBOT_CHECKPOINT_SECONDS": "0"})
    while not (killed / "checkpoint.pt").exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    refused = run(*common, "--out", killed)
    assert refused.wait() == 1
    assert "--resume" in refused.stdout.read()
    finishes(*common, "--out", killed, "--resume")
    assert (killed / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()
    measured = [json.loads((out / "policy.json").read_text())["measured"] for out in (whole, killed)]
    assert measured[0] == measured[1]
    assert measured[0]["physics"] == "bullet"
    different = run(*common, "--seed", 1, "--out", killed, "--resume")
    assert different.wait() == 1
    assert "another seed" in " ".join(different.stdout.read().split())


def test_bad_settings_are_named(tmp_path):
    for arguments, message in (
        (["shac", "--set", "wings", "2"], "unknown setting wings"),
        (["shac", "--set", "envs", "many"], "setting envs cannot be 'many'"),
        (["sorcery"], "unknown learner sorcery"),
        (["shac", "--demos", tmp_path], "shac uses no demonstrations"),
    ):
        process = run(*arguments, "--out", tmp_path / "run")
        assert process.wait() == 1
        assert message in " ".join(process.stdout.read().split())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("learner", LEARNERS)
def test_every_learner_has_settings_for_every_task(learner):
    assert set(LEARNERS[learner].tuned) == set(TASKS)
