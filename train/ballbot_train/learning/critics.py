"""What a critic sees, and the cost to go that its values stand for.

The value of a control problem is nearly a quadratic form. A tanh network alone fits it badly near the goal, so the robot
would rest off the goal. A linear path over the products of all pairs of observed quantities fits it exactly.
"""

from collections.abc import Callable, Sequence
from typing import cast

import torch

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
        self._shown, self._entries = shown, entries
        size = entries + entries * (entries + 1) // 2 + past
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
        shown = self._shown(observation)
        rows = shown.t().contiguous()  # products of rows are much faster than those of columns
        seen, past = rows[: self._entries], rows[self._entries :]
        products = (seen[i] * seen[i:] for i in range(self._entries))
        inputs = torch.cat([seen, *products, past]).t()
        return self.mlp(inputs) + self.linear(inputs)


def cost_to_go(values: torch.Tensor, living: float) -> torch.Tensor:
    """The costs to go that values of any shape stand for, but no less than a share of their mean.

    Args:
        values: what the critic expects.
        living: value of a state without any cost.
    """
    cost = living - values
    return torch.maximum(cost, _LEAST_COST * cost.mean().clamp_min(1e-6))
