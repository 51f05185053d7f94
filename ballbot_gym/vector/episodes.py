"""Episodes of a policy in a `BallbotBatch`: one of each environment, all at once."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ballbot_gym.lazy import imports_of

with imports_of(__name__):
    import torch

    from ballbot_gym.vector.batch import BallbotBatch


class BatchEpisodes(NamedTuple):
    """One episode of each of B environments."""

    cost: torch.Tensor
    """(B,) float64, a failure's price included."""
    success: torch.Tensor
    """(B,) bool: the episode ended in the goal."""
    failure: torch.Tensor
    """(B,) bool: the episode ended at a violated limit."""
    violated: torch.Tensor
    """(B,) int64 index in the batch's `limit_names` of the limit at which the episode ended, else −1."""
    steps: torch.Tensor
    """(B,) int64, control steps taken."""
    goal_error: torch.Tensor
    """(B,) how far from the goal the episode ended, in units of the goal's tolerances; see `Task.goal_error`."""


@torch.no_grad()
def run_episodes(
    batch: BallbotBatch,
    policy: Callable[[torch.Tensor], torch.Tensor],
    x: np.ndarray | torch.Tensor,
    c: np.ndarray | torch.Tensor,
    drawn: np.ndarray | None = None,
) -> BatchEpisodes:
    """Runs one episode of each environment, all at once and without gradients, until the last one has ended.

    Args:
        batch: where to run; it is reset with seed 0.
        policy: from observations (B, no) to actions (B, 2).
        x: (B, 8) initial states.
        c: (B, nc) constants of the episodes.
        drawn: (B, 6 or 14) what the batch's randomization draws for the episodes; default, by its seed.
    """
    given = (
        None if part is None else torch.as_tensor(part.T, dtype=batch.dtype, device=batch.device)
        for part in (x, c, drawn)
    )
    observation = batch.reset(0, None, *given)
    running = torch.ones(batch.num_envs, dtype=torch.bool, device=batch.device)
    success = torch.zeros_like(running)
    cost = torch.zeros(batch.num_envs, dtype=torch.float64, device=batch.device)
    steps = torch.zeros(batch.num_envs, dtype=torch.int64, device=batch.device)
    violated = torch.full_like(steps, -1)
    assert batch.state is not None
    end, constants = batch.state.x, batch.state.c
    for _ in range(batch.task.steps):
        result = batch.step(policy(observation))
        observation = result.observation
        cost += torch.where(running, result.cost, 0.0)
        steps += running
        success |= running & result.success
        violated = torch.where(running & result.failure, result.violated, violated)
        end = torch.where(running, result.final_x, end)
        running &= ~(result.terminated | result.truncated)
        if not running.any():
            break
    c_end = batch.task.at(constants.unbind(0), steps.to(batch.dtype) * batch.task.control_dt)
    goal_error = batch.task.goal_error(end.unbind(0), c_end)
    return BatchEpisodes(cost, success, violated >= 0, violated, steps, goal_error)
