"""Supervised fitting: labelled observations, and a policy network that is fitted to them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch.nn.functional import huber_loss

from ballbot_train.learning.state import load_state, state_of


@dataclass
class Samples:
    """n labelled observations, to which others can be added.

    | field | shape | meaning |
    |---|---|---|
    | observations | (n, no) float32 | |
    | actions | (n, 2) float32 | the labels, in [−1, 1] |
    | weights | (n,) float32 | of the squared errors |
    """

    observations: torch.Tensor
    actions: torch.Tensor
    weights: torch.Tensor

    @classmethod
    def of(cls, observations: np.ndarray, actions: np.ndarray, weights: np.ndarray | None = None) -> "Samples":
        """Makes samples of arrays; weights default to 1."""
        weights = np.ones(len(actions)) if weights is None else weights
        return cls(*(torch.as_tensor(np.asarray(part, np.float32)) for part in (observations, actions, weights)))

    def __len__(self) -> int:
        return len(self.actions)

    def tensors(self) -> dict[str, torch.Tensor]:
        """The fields that have a row for each sample."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, torch.Tensor)}

    def add(self, *others: "Samples") -> None:
        """Appends other samples."""
        for name, tensor in self.tensors().items():
            setattr(self, name, torch.cat([tensor, *(other.tensors()[name] for other in others)]))

    def draw(self, count: int, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Observations, actions and weights of `count` samples, drawn with replacement."""
        rows = torch.as_tensor(rng.integers(len(self), size=count))
        return self.observations[rows], self.actions[rows], self.weights[rows]


class Fit:
    """Fits a network to samples: Adam on the weighted mean squared error of its actions."""

    def __init__(
        self,
        network: torch.nn.Module,
        act: Callable[[torch.Tensor], torch.Tensor] | None = None,
        large: float = math.inf,
    ):
        """Makes a fit.

        Args:
            network: to fit.
            act: with it, from observations (n, no) to actions (n, 2); default, what it gives.
            large: errors beyond it count linearly (Huber).
        """
        self.network, self._act, self._large = network, act or network, large
        self._optimizer = torch.optim.Adam(network.parameters(), fused=True)

    def run(
        self, samples: Samples, gradient_steps: int, batch_size: int, learning_rate: float, rng: np.random.Generator
    ) -> float:
        """Takes gradient steps on batches that rng draws; returns their mean loss."""
        self._optimizer.param_groups[0]["lr"] = learning_rate
        size, total = min(batch_size, len(samples)), 0.0
        for first in range(0, gradient_steps, _DRAWN_AT_ONCE):
            some = min(_DRAWN_AT_ONCE, gradient_steps - first)
            batches = (part.split(size) for part in samples.draw(some * size, rng))
            for observations, actions, weights in zip(*batches, strict=True):
                error = 2 * huber_loss(self._act(observations), actions, reduction="none", delta=self._large)
                loss = (weights * error.mean(1)).sum() / weights.sum()
                self._optimizer.zero_grad()
                loss.backward()
                self._optimizer.step()
                total += float(loss.detach())
        return total / gradient_steps

    def state_dict(self) -> dict[str, Any]:
        """Weights and the optimizer's state: tensors and plain values."""
        return state_of(self, _STATE)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""
        load_state(self, _STATE, state)


_STATE = ("network", "_optimizer")
_DRAWN_AT_ONCE = 16  # batches, because drawing takes about as long for 16 as for one
