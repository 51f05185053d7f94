"""Routes: on which sides a policy passes obstacles, decided by a network that knows where they lie."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballbot_gym.env import make_task
from ballbot_gym.robot import default_params
from ballbot_gym.tasks.weave import Weave
from ballbot_train.evaluation import fresh
from ballbot_train.learning import routing
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import PolicySpec
from ballbot_train.policy.network import PolicyNetwork

TASK, PARAMS = make_task("weave"), default_params()


@pytest.fixture(scope="module")
def slaloms():
    return fresh.draw(TASK, range(40), 0, "training")[:2]


@pytest.fixture
def network():
    torch.manual_seed(0)
    return PolicyNetwork(spec_for(TASK, "routes", (8,)))


def observed(x, c):
    return torch.as_tensor(np.asarray(TASK.observe(x, c)), dtype=torch.float32)


def test_an_episode_keeps_its_sides_wherever_the_robot_is(network, slaloms, rng):
    x, c = slaloms
    moved = x + rng.normal(size=x.shape) * [3, 1, 0.3, 0.3, 2, 2, 1, 1]
    at_start, later = network.routes(observed(x, c)), network.routes(observed(moved, c))
    assert set(at_start.unique().tolist()) == {-1.0, 1.0}
    assert torch.equal(at_start, later)


def test_mirrored_slaloms_are_passed_on_mirrored_sides_and_repeated_obstacles_on_one(network, slaloms):
    x, c = slaloms
    (mirror,) = TASK.mirrors
    given = network.routes(observed(x, c))
    assert torch.equal(network.routes(observed(x * mirror.state, c * mirror.constants)), -given)
    for sides_given, constants in zip(given, c, strict=True):
        _, obstacles = Weave.split_constants(constants)
        assert (sides_given[len(obstacles) - 1 :] == sides_given[len(obstacles) - 1]).all()


@pytest.mark.slow
def test_routes_learn_to_cost_less_than_the_nearer_sides(monkeypatch):
    torch.manual_seed(0)
    network = PolicyNetwork(spec_for(TASK, "routes", (8,)))
    monkeypatch.setattr(routing, "EPISODES", 6000)
    monkeypatch.setattr(routing, "_STEPS", 1000)
    learnt, nearer = routing.fit_routes(network.routes, TASK, PARAMS, 0)
    assert 0 < nearer < 0.01
    assert learnt < 0.8 * nearer


def test_a_spec_with_routes_needs_a_frame_with_a_route():
    for fields in ({"frame": "slalom", "routes": (8,)}, {"frame": "routed_slalom"}):
        with pytest.raises(ValueError, match="routes must be given for a frame with a route"):
            PolicySpec.of(TASK, **fields)
    with pytest.raises(ValueError, match="has no routes"):
        spec_for(make_task("stabilize"), "routes", (8,))


def test_a_learner_teaches_its_routes_first_and_keeps_them(monkeypatch):
    monkeypatch.setattr(routing, "EPISODES", 60)
    monkeypatch.setattr(routing, "_STEPS", 5)
    monkeypatch.setattr(routing, "_DISTANCES", 1)
    tiny = {"num_envs": 4, "episode_seconds": 0.06, "iterations": 2, "hidden": (8,)}
    settings = replace(LEARNERS["apg"].settings("weave"), symmetry="routes", **tiny)
    learner = LEARNERS["apg"].make(TASK, PARAMS, settings, 0, None)
    before = [part.clone() for part in learner.network.routes.parameters()]
    learner.iterate()
    taught = [part.clone() for part in learner.network.routes.parameters()]
    assert not any(torch.equal(a, b) for a, b in zip(before, taught, strict=True))
    resumed = LEARNERS["apg"].make(TASK, PARAMS, settings, 0, None)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    learner.iterate()
    resumed.iterate()
    for kept, again in zip(taught, resumed.network.routes.parameters(), strict=True):
        assert torch.equal(kept, again)
    for ours, theirs in zip(learner.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(ours, theirs)
