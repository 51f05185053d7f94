"""On which side a policy passes each obstacle: a small network that knows only where the obstacles lie.

A choice of sides is the best of several basins, and a network that averages basins hits what lies between them. So the choice
is made apart, as a classification. It depends on the layout of the obstacles alone, which stays the same throughout an
episode, so it does not waver.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import Any

from ballbot_gym.lazy import imports_of
from ballbot_gym.tasks.symmetry import Route
from ballbot_train.weights import linear_layers

with imports_of(__name__):
    import torch


class Routes(torch.nn.Module):
    """From observations to the sides on which obstacles are passed.

    Its outputs, before the greatest is taken, belong to the 2^n choices of obstacles that are passed on the farther side.
    """

    def __init__(self, route: Route, hidden: tuple[int, ...], device: str = "cpu"):
        """Args: route: of a frame; hidden: units of the hidden layers; device: of the weights."""
        super().__init__()
        own: dict[str, Any] = {"device": device, "dtype": torch.float32}
        self.route = route
        self.mlp = linear_layers((3 * route.obstacles, *hidden, 2**route.obstacles), torch.nn.Tanh, **own)
        self._choices: torch.Tensor
        self.register_buffer("_choices", torch.tensor(farther_choices(route.obstacles), **own), persistent=False)

    def layout(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 3 n) x, y and radius of every obstacle as seen from the goal, of observations (..., no)."""
        return torch.stack(self.route.layout(observation.unbind(-1)), -1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., n) 1 for every obstacle that is passed on its left, −1 on its right, of observations (..., no)."""
        return torch.stack(self.sides(observation.unbind(-1)), -1)

    def sides(self, seen: tuple[Any, ...]) -> tuple[Any, ...]:
        """The same (n) for the numbers of an observation (no), which are tensors or plain ones. No gradient reaches them."""
        with torch.no_grad():
            best = self.mlp(stacked(self.route.layout(seen), self._choices)).argmax(-1)
            if isinstance(seen[0], torch.Tensor):
                return self.route.sides(seen, self._choices[best].unbind(-1))
            return self.route.sides(seen, farther_choices(self.route.obstacles)[int(best)])


def stacked(values: Sequence[Any], like: torch.Tensor) -> torch.Tensor:
    """(..., n) of n tensors (...), or of n plain numbers a tensor as another one is."""
    return torch.stack(tuple(values), -1) if isinstance(values[0], torch.Tensor) else like.new_tensor(values)


@functools.cache
def farther_choices(obstacles: int) -> tuple[tuple[float, ...], ...]:
    """Every choice of obstacles that are passed on their farther side, −1, in the order of the outputs."""
    return tuple(itertools.product((1.0, -1.0), repeat=obstacles))
