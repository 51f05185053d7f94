"""On which side a policy passes each obstacle: a small network that knows only where the obstacles lie.

A choice of sides is the best of several basins, and a network that averages basins hits what lies between them. So the choice
is made apart, as a classification. It depends on the layout of the obstacles alone, which stays the same throughout an
episode, so it does not waver.
"""

import itertools

import torch

from ballbot_gym.tasks.symmetry import FRAMES


class Routes(torch.nn.Module):
    """From observations to the sides on which obstacles are passed.

    Its outputs, before the greatest is taken, belong to the 2^n choices of obstacles that are passed on the farther side.
    """

    def __init__(self, frame: str, hidden: tuple[int, ...]):
        """Args: frame: name in `FRAMES` of one with sides; hidden: units of the hidden layers."""
        super().__init__()
        self._frame = FRAMES[frame]
        assert self._frame.layout is not None
        inputs = 3 * self._frame.sides
        layers: list[torch.nn.Module] = []
        for fan_in, fan_out in itertools.pairwise((inputs, *hidden)):
            layers += [torch.nn.Linear(fan_in, fan_out), torch.nn.Tanh()]
        self.mlp = torch.nn.Sequential(*layers, torch.nn.Linear((inputs, *hidden)[-1], 2**self._frame.sides))
        choices = list(itertools.product((1.0, -1.0), repeat=self._frame.sides))
        self.register_buffer("_choices", torch.tensor(choices), persistent=False)
        self._choices: torch.Tensor

    def layout(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 3 n) x, y and radius of every obstacle as seen from the goal, of observations (..., no)."""
        assert self._frame.layout is not None
        return torch.stack(self._frame.layout(observation.unbind(-1)), -1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., n) 1 for every obstacle that is passed on its left, −1 on its right, of observations (..., no)."""
        layout = self.layout(observation)
        x, y, radius = layout[..., 0::3], layout[..., 1::3], layout[..., 2::3]
        best = self.mlp(layout).argmax(-1)
        farther = self._choices[best]  # −1 where the farther side is chosen
        # the side of the goal's line is the nearer one; in the layout the first obstacle lies on the left
        mirrored = torch.where(observation[..., 9] + observation[..., 1] < 0, -1.0, 1.0)
        sides = mirrored[..., None] * farther * torch.where(y < 0, 1.0, -1.0)
        # unused numbers repeat the last obstacle, and so its side
        kept = [sides[..., 0]]
        for i in range(1, self._frame.sides):
            same = (x[..., i] - x[..., i - 1]).abs() + (y[..., i] - y[..., i - 1]).abs() < 1e-4
            same &= radius[..., i] == radius[..., i - 1]
            kept.append(torch.where(same, kept[-1], sides[..., i]))
        return torch.stack(kept, -1)

    def behind(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., no + n) observations with the sides behind them, as the frame's features take them."""
        with torch.no_grad():
            return torch.cat([observation, self(observation)], -1)
