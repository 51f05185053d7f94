"""What a critic sees, and the value that it starts from.

The value of a control problem is nearly a quadratic form. A tanh network alone fits it badly near the goal, so the robot
would rest off the goal. A linear path over the products of all pairs of observed quantities fits it exactly.
"""

from collections.abc import Callable, Sequence
from typing import cast

import torch

from ballbot_gym.tasks import Task
from ballbot_train.policy.weights import linear_layers

_LEAST_COST = 0.02  # of the mean cost to go; advantages are relative to no less


class QuadraticCritic(torch.nn.Module):
    """The sum of a network and a linear path, both on what is seen and on the products of all its pairs, squares included."""

    def __init__(
        self,
        entries: int,
        hidden: Sequence[int],
        activation: type[torch.nn.Module],
        past: int = 0,
        shown: Callable[[torch.Tensor], torch.Tensor] = lambda observation: observation,
    ):
        """Args:
        entries: numbers that are seen.
        hidden: units of the network's hidden layers.
        activation: after each of them.
        past: numbers behind the entries, without products, of earlier observations and actions.
        shown: from observations to both, as `PolicyNetwork.shown`.
        """
        super().__init__()
        self._shown, self._entries, self._pairs = shown, entries, torch.triu_indices(entries, entries)
        size = entries + self._pairs.shape[1] + past
        self.mlp = linear_layers((size, *hidden, 1), activation)
        self.linear = torch.nn.Linear(size, 1)
        self.start_flat()

    def start_flat(self) -> None:
        """Makes all values about the linear path's bias."""
        with torch.no_grad():
            self.linear.weight.zero_()
            cast(torch.nn.Linear, self.mlp[-1]).weight.mul_(0.1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(B, observations) to values (B, 1)."""
        shown, (first, second) = self._shown(observation), self._pairs
        seen, past = shown[:, : self._entries], shown[:, self._entries :]
        inputs = torch.cat([seen, seen[:, first] * seen[:, second], past], -1)
        return self.mlp(inputs) + self.linear(inputs)


def value_of_living(task: Task, reward_scale: float, gamma: float) -> float:
    """Discounted sum of scaled rewards of living indefinitely without cost; without a discount, for the task's duration.

    Critics start from it, because the values of good policies are near it and far from 0.
    """
    paid = reward_scale * task.survival_reward * task.control_dt
    return paid / (1 - gamma) if gamma < 1 else paid * task.steps


def highest_value(task: Task, reward_scale: float, gamma: float) -> float:
    """The most that a discounted sum of scaled rewards can be, because costs are not negative.

    Where an episode ends at its goal, the time that is left is paid at once, without a discount.
    """
    living = value_of_living(task, reward_scale, gamma)
    return max(living, value_of_living(task, reward_scale, 1.0)) if task.first_exit else living


def relative_advantages(returns: torch.Tensor, values: torch.Tensor, living: float) -> torch.Tensor:
    """Advantages relative to the cost to go, normalized, of returns and values of any one shape.

    Args:
        returns: estimates of the return.
        values: what the critic expects.
        living: value of a state without any cost, so that the cost to go is `living` minus the value.
    """
    relative = (returns - values) / _cost_to_go(values, living)
    return (relative - relative.mean()) / (relative.std() + 1e-8)


def weigh_gradients(values: Sequence[torch.Tensor], living: float) -> None:
    """Divides gradients that flow back into the values (n, 1) of several critics by the cost to go, as the lowest say it.

    The mean of all n factors is 1. For `living` see `relative_advantages`.
    """
    if not values[0].requires_grad:
        return
    lowest = torch.stack([value.detach() for value in values]).amin(0)
    weights = _cost_to_go(lowest, living) ** -1
    weights /= weights.mean()
    for value in values:
        value.register_hook(lambda gradient: gradient * weights)


def _cost_to_go(values: torch.Tensor, living: float) -> torch.Tensor:
    """The costs to go that values of any shape stand for, but no less than a share of their mean.

    Args:
        values: what the critic expects.
        living: value of a state without any cost.
    """
    cost = living - values
    return torch.maximum(cost, _LEAST_COST * cost.mean().clamp_min(1e-6))
