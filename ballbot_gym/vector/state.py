"""What batches of environments remember, and what a step of them gives: tensors, or NumPy arrays."""

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


class BatchStep(NamedTuple):
    """The result of one control step of B environments. Environments whose episode ended have started the next one."""

    observation: torch.Tensor
    """(B, no) observations. Where an episode ended, the first one of the next episode."""
    reward: torch.Tensor
    """(B,) reward of the step: survival_reward · control_dt minus the running cost, plus the reward at a first exit."""
    reward_parts: torch.Tensor
    """(3, B) parts of the reward, which add up to it: for living, for the cost, and at the goal."""
    cost: torch.Tensor
    """(B,) cost of the step, the price of a failure included."""
    terminated: torch.Tensor
    """(B,) bool."""
    truncated: torch.Tensor
    """(B,) bool."""
    final_observation: torch.Tensor
    """(B, no) observations after the step and before any reset."""
    final_x: torch.Tensor
    """(8, B) states after the step and before any reset."""
    success: torch.Tensor
    """(B,) bool: the episode ended in the goal."""
    failure: torch.Tensor
    """(B,) bool: the episode ended at a violated limit."""
    violated: torch.Tensor
    """(B,) int64 index in the batch's `limit_names` of the first limit violated, else −1."""
    force: torch.Tensor
    """(2, B) N, what the actuator applied."""
    clipped: torch.Tensor
    """(B,) bool: the action was outside [−1, 1]."""
    grip: torch.Tensor
    """(4, B) the floor's force on the ball when the step began, f_x, f_y and N, and the friction that the step needs; (0, B)
    where friction is unlimited. It carries no gradient."""
    measured: torch.Tensor
    """(nm, B) what the robot measures, as its `MEASUREMENTS` name it; where an episode ended, at the start of the next one.
    It carries no gradient."""
    final_measured: torch.Tensor
    """(nm, B) the same after the step and before any reset."""


def _check_starts(task: Task, x: tuple, c: tuple, mask: Any) -> None:
    """Raises a ValueError if states in 8 rows (B,) violate a limit of the task where the mask holds."""
    violated = first_violated(task.limits(x, task.at(c, 0 * x[0])), like=x)
    bad = [i for i, is_bad in enumerate((mask & (violated >= 0)).tolist()) if is_bad]
    if bad:
        raise ValueError(
            f"start states of envs {bad[:8]} violate limits of {task.id}: the start state of env {bad[0]} violates the limit "
            f"of {task.limit_names[int(violated[bad[0]])]}"
        )
