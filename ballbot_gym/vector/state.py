"""What batches of environments remember, in torch or in NumPy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from ballbot_gym.step import first_violated
from ballbot_gym.tasks import Task

if TYPE_CHECKING:
    import torch


class BatchState(NamedTuple):
    """Everything that a batch of B environments remembers."""

    x: torch.Tensor
    """(n, B) states; order and units in the robot's `STATE`."""
    c: torch.Tensor
    """(nc, B) constants of the running episodes."""
    steps: torch.Tensor
    """(B,) int64, control steps taken in the running episodes."""
    episode: torch.Tensor
    """(B,) int64, number of the running episode since the env was seeded."""
    seed: torch.Tensor
    """(B,) int64."""
    drawn: torch.Tensor
    """(6 or 14, B) what `Randomization.draw` drew for the running episodes; (0, B) where it draws nothing."""
    actuator: torch.Tensor
    """(2 + 2d, B) N, the force last applied, then the last d commands; (0, B) where the actuator is ideal."""
    past: torch.Tensor
    """(history (no + 2), B) the last observations, each with the action that followed, the latest first; before the
    episode began the first one, with no force."""
    sensors: torch.Tensor
    """(17, B) what sensors remember; (0, B) where the state is observed."""


def _check_starts(task: Task, x: tuple, c: tuple, mask: Any) -> None:
    """Raises a ValueError if states in 8 rows (B,) violate a limit of the task where the mask holds."""
    violated = first_violated(task.limits(x, task.at(c, 0 * x[0])), like=x)
    bad = [i for i, is_bad in enumerate((mask & (violated >= 0)).tolist()) if is_bad]
    if bad:
        raise ValueError(
            f"start states of envs {bad[:8]} violate limits of {task.id}: the start state of env {bad[0]} violates the limit "
            f"of {task.limit_names[int(violated[bad[0]])]}"
        )
