"""Episodes of a policy in a `BallbotBatch` or a `BallbotArrays`: one of each environment, all at once."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ballbot_gym.lazy import imports_of
from ballbot_gym.vector.arrays import BallbotArrays

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
    margin: torch.Tensor
    """(B,) the least of the `Task.margins` that the episode had, which are negative where a limit is violated; infinite if
    `run_episodes` was not asked for it."""


@torch.no_grad()
def run_episodes(
    batch: BallbotBatch | BallbotArrays,
    policy: Callable[[torch.Tensor], torch.Tensor],
    x: np.ndarray | torch.Tensor,
    c: np.ndarray | torch.Tensor,
    drawn: np.ndarray | None = None,
    margins: bool = False,
) -> BatchEpisodes:
    """Runs one episode of each environment, all at once and without gradients, until the last one has ended.

    Args:
        batch: where to run; it is reset with seed 0. A `BallbotArrays` is on the CPU, and nothing is drawn there.
        policy: from observations (B, no) to actions (B, 2).
        x: (B, 8) initial states.
        c: (B, nc) constants of the episodes.
        drawn: (B, 6 or 14) what the batch's randomization draws for the episodes; default, by its seed.
        margins: whether to find `BatchEpisodes.margin`, which takes up to a sixth longer.
    """
    envs: Any = batch
    given = (None if part is None else envs._own(part.T) for part in (x, c, drawn))
    envs.state = state = envs.initial_state(0, None, *given)
    observation = torch.as_tensor(envs.observe(state))
    task, end, constants = batch.task, torch.as_tensor(state.x), torch.as_tensor(state.c).unbind(0)
    steps = torch.zeros_like(end[0], dtype=torch.int64)
    running, cost = torch.ones_like(steps, dtype=torch.bool), torch.zeros_like(steps, dtype=torch.float64)
    success, violated = ~running, torch.full_like(steps, -1)
    margin = torch.full_like(end[0], torch.inf)
    for _ in range(task.steps):
        did = envs.step(envs._own(policy(observation)))
        result = did._make(map(torch.as_tensor, did))
        observation = result.observation
        cost += torch.where(running, result.cost, 0.0)
        steps += running
        success |= running & result.success
        violated = torch.where(running & result.failure, result.violated, violated)
        end = torch.where(running, result.final_x, end)
        if margins:
            now = task.at(constants, steps.to(end.dtype) * task.control_dt)
            margin = functools.reduce(torch.minimum, task.margins(end.unbind(0), now), margin)
        running &= ~(result.terminated | result.truncated)
        if not running.any():
            break
    c_end = task.at(constants, steps.to(end.dtype) * task.control_dt)
    goal_error = task.goal_error(end.unbind(0), c_end)
    return BatchEpisodes(cost, success, violated >= 0, violated, steps, goal_error, margin)
