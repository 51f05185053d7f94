"""What learners remember, as tensors and plain values: their `state_dict` and the way back."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch

from ballbot_gym.vector.batch import BallbotBatch, BatchState


def state_of(owner: object, names: Sequence[str]) -> dict[str, Any]:
    """What attributes of these names hold: of modules and optimizers their states, of batches those of their envs."""
    return {name: _saved(getattr(owner, name)) for name in names}


def load_state(owner: object, names: Sequence[str], state: Mapping[str, Any]) -> None:
    """Goes back to what `state_of` gave."""
    for name in names:
        value = getattr(owner, name)
        if hasattr(value, "load_state_dict"):
            value.load_state_dict(state[name])
        elif isinstance(value, torch.Generator):
            value.set_state(state[name])
        elif isinstance(value, BallbotBatch):
            value.state = BatchState(*state[name])
        else:
            setattr(owner, name, state[name])


def _saved(value: Any) -> Any:
    if hasattr(value, "load_state_dict"):
        return value.state_dict()
    if isinstance(value, torch.Generator):
        return value.get_state()
    return list(cast(BatchState, value.state)) if isinstance(value, BallbotBatch) else value
