"""Layers in machine code compute what torch's do."""

from dataclasses import replace

import pytest
import torch

from ballbot_gym.machine_code import compiler
from ballbot_gym.tasks import Stabilize, Turn
from ballbot_train.learning.actors import spec_for
from ballbot_train.policy.layers import with_compiled_layers
from ballbot_train.policy.network import PolicyNetwork

pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")


@pytest.mark.parametrize("activation", ["tanh", "relu", "silu"])
@pytest.mark.parametrize("hidden", [(), (5,), (32, 7), (130, 128)])
@pytest.mark.parametrize(("task", "symmetry"), [(Stabilize(), "mirrors"), (Turn(), "frame")])
@pytest.mark.parametrize("count", [1, 16, 37])
def test_actions_are_those_of_torch(activation, hidden, task, symmetry, count):
    network = PolicyNetwork(replace(spec_for(task, symmetry, hidden), activation=activation))
    seen = 2 * torch.randn(count, network.spec.observations)
    with torch.no_grad():
        assert torch.allclose(with_compiled_layers(network)(seen), network(seen), atol=2e-6)


def test_the_policy_itself_stays_as_it_is():
    network = PolicyNetwork(spec_for(Stabilize(), "odd", (8,)))
    with_compiled_layers(network)
    assert isinstance(network.mlp, torch.nn.Sequential)
    assert network(torch.ones(1, network.spec.observations)).requires_grad


def test_activations_stay_finite_and_within_their_bounds_far_out():
    network = PolicyNetwork(spec_for(Stabilize(), "none", (8,)))
    with torch.no_grad():
        network.mlp[0].weight.mul_(1e20)
        seen = torch.randn(50, network.spec.observations)
        assert torch.allclose(with_compiled_layers(network)(seen), network(seen), atol=2e-6)
