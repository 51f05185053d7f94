"""On which side a policy passes each obstacle: a small network that knows only where the obstacles lie.

A choice of sides is the best of several basins, and a network that averages basins hits what lies between them. So the choice
is made apart, as a classification. It depends on the layout of the obstacles alone, which stays the same throughout an
episode, so it does not waver.
"""

import functools
import itertools
from typing import Any

from ballbot_gym.lazy import missing
from ballbot_gym.tasks.symmetry import FRAMES
from ballbot_train.weights import linear_layers

try:
    import torch
except ModuleNotFoundError as error:
    raise missing(__name__, error.name) from error


class Routes(torch.nn.Module):
    """From observations to the sides on which obstacles are passed.

    Its outputs, before the greatest is taken, belong to the 2^n choices of obstacles that are passed on the farther side.
    """

    def __init__(self, frame: str, hidden: tuple[int, ...], device: str = "cpu"):
        """Args: frame: name in `FRAMES` of one with sides; hidden: units of the hidden layers; device: of the weights."""
        super().__init__()
        own: dict[str, Any] = {"device": device, "dtype": torch.float32}
        route = FRAMES[frame].route
        assert route is not None
        self.route = route
        self.mlp = linear_layers((3 * route.obstacles, *hidden, 2**route.obstacles), torch.nn.Tanh, **own)
        self._choices: torch.Tensor
        self.register_buffer("_choices", torch.tensor(farther_choices(route.obstacles), **own), persistent=False)

    def layout(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 3 n) x, y and radius of every obstacle as seen from the goal, of observations (..., no)."""
        return torch.stack(self.route.layout(observation.unbind(-1)), -1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., n) 1 for every obstacle that is passed on its left, −1 on its right, of observations (..., no)."""
        best = self.mlp(self.layout(observation)).argmax(-1)
        return torch.stack(self.route.sides(observation.unbind(-1), self._choices[best].unbind(-1)), -1)

    def alone(self, observation: tuple[float, ...]) -> tuple[float, ...]:
        """The sides (n) of one observation (no), in plain numbers, which take less time than tensors do."""
        best = int(self.mlp(self._choices.new_tensor(self.route.layout(observation))).argmax())
        return self.route.sides(observation, farther_choices(self.route.obstacles)[best])

    def behind(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., no + n) observations with the sides behind them, as the frame's features take them."""
        with torch.no_grad():
            return torch.cat([observation, self(observation)], -1)


@functools.cache
def farther_choices(obstacles: int) -> tuple[tuple[float, ...], ...]:
    """Every choice of obstacles that are passed on their farther side, −1, in the order of the outputs."""
    return tuple(itertools.product((1.0, -1.0), repeat=obstacles))
