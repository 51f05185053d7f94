"""Routes: on which sides a policy passes obstacles, decided by a network that knows where they lie."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballbot_baselines import sides
from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_gym.tasks.symmetry import FRAMES
from ballbot_gym.tasks.weave import split_constants
from ballbot_train.evaluation import fresh
from ballbot_train.learning import routing
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy import PolicyNetwork
from ballbot_train.policy_files import PolicySpec

TASK, PARAMS = make_task("weave"), default_params()


@pytest.fixture(scope="module")
def slaloms():
    return fresh.draw(TASK, range(40), 0, "training")


@pytest.fixture
def network():
    torch.manual_seed(0)
    return PolicyNetwork(spec_for(TASK, "routes", (8,)))


def observed(x, c):
    return torch.as_tensor(np.asarray(TASK.observe(x, c)), dtype=torch.float32)


def always_nearer(network):
    """Makes the first choice the greatest everywhere, which passes no obstacle on its farther side."""
    torch.nn.init.zeros_(network.routes.mlp[-1].weight)
    torch.nn.init.zeros_(network.routes.mlp[-1].bias)
    network.routes.mlp[-1].bias.data[0] = 1.0
    return network


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
        _, obstacles = split_constants(constants)
        assert (sides_given[len(obstacles) - 1 :] == sides_given[len(obstacles) - 1]).all()


def test_without_a_farther_side_the_frame_is_the_one_of_nearer_sides(network, slaloms):
    x, c = slaloms
    observation = observed(x, c)
    extended = always_nearer(network).routes.behind(observation)
    routed, _ = FRAMES["routed_slalom"].features(extended.unbind(-1))
    nearer, _ = FRAMES["slalom"].features(observation.unbind(-1))
    routed, nearer = torch.stack(routed, -1), torch.stack(nearer, -1)
    routed[:, 10::3] = routed[:, 10::3].abs()  # radii, whose signs tell the sides
    torch.testing.assert_close(routed, nearer)
    own = TASK.one_way_margins(x, c)
    chosen = TASK.one_way_margins(x, c, tuple(extended[:, 23:].numpy().T))
    np.testing.assert_allclose(np.array(chosen), np.array(own))


def test_the_side_that_is_not_chosen_is_closed(slaloms):
    _, c = slaloms
    x = np.zeros((40, 8))
    x[:, 0], x[:, 1] = c[:, 2], c[:, 3] + 3.0  # far on the left of the first obstacle
    left = TASK.one_way_margins(x, c, (1.0,) * 5)[1]
    right = TASK.one_way_margins(x, c, (-1.0,) * 5)[1]
    assert (left > 0).all()
    assert (right < 0).all()


def test_costs_predicted_for_many_slaloms_are_those_predicted_for_each(slaloms):
    x, c = slaloms
    path = np.column_stack([np.linspace(0, 9, TASK.steps + 1), np.zeros(TASK.steps + 1)])
    for start, constants in zip(x[:10], c[:10], strict=True):
        obstacles = TASK.passed_obstacles(constants)
        alone = sides.predict(TASK, PARAMS, start, constants, path, obstacles)
        passed = np.abs(path[:, :1] - obstacles[:, 0]).argmin(0)
        across = start[[1, 3, 5, 7]] - [constants[1], 0, 0, 0]
        relative = obstacles[:, 1:] - [constants[1], 0]
        many = sides.predict_costs(TASK, PARAMS, *(part[None].repeat(3, 0) for part in (across, relative, passed)))
        np.testing.assert_allclose(many, np.tile(alone.costs, (3, 1)), rtol=1e-9, atol=1e-9)
        assert np.array_equal(alone.sides, sides.choices(len(obstacles)))


@pytest.mark.slow
def test_routes_learn_to_cost_less_than_the_nearer_sides():
    torch.manual_seed(0)
    network = PolicyNetwork(spec_for(TASK, "routes", (8,)))
    _, regrets = routing.predicted_regrets(TASK, PARAMS, 0, 300)
    nearer = regrets[:300, 0].mean()
    assert 0 < nearer < 0.01
    assert (regrets.min(1) == 0).all()
    learnt = routing.fit_routes(network.routes, TASK, PARAMS, 0, episodes=6000, gradient_steps=1000)
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
    tiny = {"num_envs": 4, "horizon": 3, "iterations": 2, "one_way": True, "hidden": (8,)}
    settings = replace(LEARNERS["shac"].settings("weave"), symmetry="routes", **tiny)
    learner = LEARNERS["shac"].make(TASK, PARAMS, settings, 0, None)
    before = [part.clone() for part in learner.network.routes.parameters()]
    learner.iterate()
    taught = [part.clone() for part in learner.network.routes.parameters()]
    assert not any(torch.equal(a, b) for a, b in zip(before, taught, strict=True))
    resumed = LEARNERS["shac"].make(TASK, PARAMS, settings, 0, None)
    resumed.load_state_dict(copy.deepcopy(learner.state_dict()))
    learner.iterate()
    resumed.iterate()
    for kept, again in zip(taught, resumed.network.routes.parameters(), strict=True):
        assert torch.equal(kept, again)
    for ours, theirs in zip(learner.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(ours, theirs)
