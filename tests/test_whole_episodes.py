"""Analytic policy gradient through whole episodes: its gradient is that of whole episodes, on every task."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from resuming import goes_on_as_if_never_stopped

from ballbot_gym.env import make_task
from ballbot_gym.robot import named_robot
from ballbot_gym.tasks import TASKS
from ballbot_train.learning import apg
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import shipped_policies
from ballbot_train.policy.network import PolicyNetwork


def made(name, seed=0, robot="paper", start=None, **settings):
    small = {"iterations": 4, "num_envs": 4, "episode_seconds": 0.2, "hidden": (8,), "symmetry": "none"}
    settings = replace(LEARNERS["apg"].settings(name), **(small | settings))
    return LEARNERS["apg"].make(make_task(name, robot), named_robot(robot), settings, seed, None, start)


def test_it_goes_on_from_its_state_as_if_never_stopped():
    assert goes_on_as_if_never_stopped(lambda seed: made("turn", seed))


@pytest.mark.parametrize(("name", "symmetry"), [*((name, "none") for name in TASKS), ("weave", "routes")])
def test_the_gradient_is_the_slope_of_the_cost_of_whole_episodes(name, symmetry):
    learner = made(name, num_envs=3, symmetry=symmetry, margin_clearance=0.2, margin_penalty=10.0)
    weight = learner._trained.mlp[-1].bias
    state = learner._batch.state
    costs = []
    for change in (0.0, 1e-3, -1e-3):  # of the force along x, in units of its limit
        learner._batch.state = state
        with torch.no_grad():
            weight[0] += change
        costs.append(learner._episodes()[0].sum())
        with torch.no_grad():
            weight[0] -= change
    costs[0].backward()
    slope = (costs[1] - costs[2]).item() / 2e-3
    assert weight.grad is not None
    assert weight.grad[0].item() == pytest.approx(slope, rel=0.03, abs=0.01)


def test_costs_are_those_of_the_policy_s_episodes(monkeypatch):
    monkeypatch.setattr(apg, "_GOAL_PENALTY", 1e4)
    monkeypatch.setattr(apg, "_GOAL_CLEARANCE", 0.0)
    start = PolicyNetwork.load(shipped_policies(make_task("turn"))["ppo"], make_task("turn"))
    learner = made("turn", start=start, num_envs=16, episode_seconds=4.6)
    state = learner._batch.state
    with torch.no_grad():
        costs, reached = learner._episodes()
    assert reached.all()
    batch = learner._batch
    batch.state, total, running = state, torch.zeros(16), torch.ones(16, dtype=torch.bool)
    batch.reset()
    while running.any():
        with torch.no_grad():
            result = batch.step(learner._trained(batch.observe(batch.state)))
        total += torch.where(running, result.cost, 0.0)
        running &= ~(result.terminated | result.truncated)
    np.testing.assert_allclose(costs, total, rtol=1e-4)


def test_an_episode_that_fails_has_a_price_and_finite_gradients():
    learner = made("stabilize", episode_seconds=1.5)
    with torch.no_grad():
        learner._trained.linear.weight.mul_(-1)  # away from the equilibrium
    costs, ended_well = learner._episodes()
    assert not ended_well.any()
    assert (costs > 1000).all()
    figures = learner.iterate()
    assert figures["train/failure_rate"] == 1
    assert np.isfinite(figures["train/gradient"])


def test_a_ball_that_slips_has_a_price_and_does_not_end_its_episode():
    learner = made("stabilize", robot="rolling", symmetry="odd", num_envs=32, episode_seconds=0.1)
    gentle, fine = learner._episodes()
    learner._batch.reset(seed=0)
    with torch.no_grad():
        learner._trained.linear.weight.mul_(-3)  # asks for more friction than there is
    slipping, still_fine = learner._episodes()
    assert fine.all()
    assert still_fine.all()
    assert slipping.mean() > 2 * gentle.mean()
