"""On which side a policy passes each obstacle: a small network that knows only where the obstacles lie.

A choice of sides is the best of several basins, and a network that averages basins hits what lies between them. So the choice
is made apart, as a classification. It depends on the layout of the obstacles alone, which stays the same throughout an
episode, so it does not waver.
"""

import functools
import itertools
from typing import Any

import torch

from ballbot_gym import ops
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
        self.register_buffer("_choices", torch.tensor(_choices(self._frame.sides)), persistent=False)
        self._choices: torch.Tensor

    def layout(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 3 n) x, y and radius of every obstacle as seen from the goal, of observations (..., no)."""
        assert self._frame.layout is not None
        return torch.stack(self._frame.layout(observation.unbind(-1)), -1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., n) 1 for every obstacle that is passed on its left, −1 on its right, of observations (..., no)."""
        best = self.mlp(self.layout(observation)).argmax(-1)
        return torch.stack(self._sides(observation.unbind(-1), self._choices[best].unbind(-1)), -1)

    def alone(self, observation: tuple[float, ...]) -> tuple[float, ...]:
        """The sides (n) of one observation (no), in plain numbers, which take less time than tensors do."""
        assert self._frame.layout is not None
        best = int(self.mlp(torch.tensor(self._frame.layout(observation))).argmax())
        return self._sides(observation, _choices(self._frame.sides)[best])

    def _sides(self, observation: tuple[Any, ...], farther: tuple[Any, ...]) -> tuple[Any, ...]:
        """Sides, where −1 in `farther` stands for an obstacle that is passed on its farther side."""
        assert self._frame.layout is not None
        layout = self._frame.layout(observation)
        # the side of the goal's line is the nearer one; in the layout the first obstacle lies on the left
        mirrored = ops.where(observation[9] + observation[1] < 0, -1.0, 1.0)
        kept: list[Any] = []
        before: tuple[Any, ...] | None = None
        for (x, y, radius), way in zip(zip(layout[::3], layout[1::3], layout[2::3], strict=True), farther, strict=True):
            side = mirrored * way * ops.where(y < 0, 1.0, -1.0)
            if before is not None:  # unused numbers repeat the last obstacle, and so its side
                same = (abs(x - before[0]) + abs(y - before[1]) < 1e-4) & (radius == before[2])
                side = ops.where(same, kept[-1], side)
            kept.append(side)
            before = (x, y, radius)
        return tuple(kept)

    def behind(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., no + n) observations with the sides behind them, as the frame's features take them."""
        with torch.no_grad():
            return torch.cat([observation, self(observation)], -1)


@functools.cache
def _choices(sides: int) -> tuple[tuple[float, ...], ...]:
    """Every choice of farther sides, −1, in the order of the outputs."""
    return tuple(itertools.product((1.0, -1.0), repeat=sides))
