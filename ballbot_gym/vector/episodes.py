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
    device: Any = "cpu" if isinstance(batch, BallbotArrays) else batch.device
    observation = _begun(batch, x, c, drawn)
    running = torch.ones(batch.num_envs, dtype=torch.bool, device=device)
    success = torch.zeros_like(running)
    cost = torch.zeros(batch.num_envs, dtype=torch.float64, device=device)
    steps = torch.zeros(batch.num_envs, dtype=torch.int64, device=device)
    violated = torch.full_like(steps, -1)
    assert batch.state is not None
    task, end, constants = batch.task, torch.as_tensor(batch.state.x), torch.as_tensor(batch.state.c).unbind(0)
    margin = torch.full_like(end[0], torch.inf)
    for _ in range(task.steps):
        result = _stepped(batch, policy(observation))
        observation = result.observation
        cost += torch.where(running, result.cost, 0.0)
        steps += running
        success |= running & result.success
        violated = torch.where(running & result.failure, result.violated, violated)
        end = torch.where(running, result.x, end)
        if margins:
            now = task.at(constants, steps.to(end.dtype) * task.control_dt)
            margin = functools.reduce(torch.minimum, task.margins(end.unbind(0), now), margin)
        running &= ~result.ended
        if not running.any():
            break
    c_end = task.at(constants, steps.to(end.dtype) * task.control_dt)
    goal_error = task.goal_error(end.unbind(0), c_end)
    return BatchEpisodes(cost, success, violated >= 0, violated, steps, goal_error, margin)


class _Stepped(NamedTuple):
    """What a step did in B environments, before those that ended began anew."""

    observation: torch.Tensor
    """(B, no), of the next episode where one ended."""
    x: torch.Tensor
    """(n, B)."""
    cost: torch.Tensor
    """(B,)."""
    success: torch.Tensor
    """(B,) bool."""
    failure: torch.Tensor
    """(B,) bool."""
    violated: torch.Tensor
    """(B,) int64."""
    ended: torch.Tensor
    """(B,) bool."""


def _begun(batch: BallbotBatch | BallbotArrays, x: Any, c: Any, drawn: Any) -> torch.Tensor:
    """Observations (B, no) of given starts (B, 8), constants (B, nc) and draws."""
    if isinstance(batch, BallbotArrays):
        if drawn is not None:
            raise ValueError("nothing is drawn in machine code; make a BallbotBatch")
        starts, constants = (np.asarray(part, batch.dtype).T for part in (x, c))
        batch.state = batch.initial_state(0, c=constants)._replace(x=starts)
        return torch.from_numpy(batch.observe(batch.state))
    kind: Any = {"dtype": batch.dtype, "device": batch.device}
    return batch.reset(0, None, *(None if part is None else torch.as_tensor(part.T, **kind) for part in (x, c, drawn)))


def _stepped(batch: BallbotBatch | BallbotArrays, actions: torch.Tensor) -> _Stepped:
    if isinstance(batch, BallbotBatch):
        did = batch.step(actions)
        ended = did.terminated | did.truncated
        return _Stepped(did.observation, did.final_x, did.cost, did.success, did.failure, did.violated, ended)
    observation, _, terminated, truncated, infos = batch.step(actions.numpy().astype(batch.dtype))
    ended = terminated | truncated
    # what a step did is in final_info for the episodes that it ended, and else in the info
    end = infos.get("final_info", infos)
    did = {
        name: torch.from_numpy(np.where(ended, end[name].T, infos[name].T))
        for name in ("cost", "success", "failure", "violated")
    }
    x = torch.from_numpy(np.where(ended, end["state"].T, infos["state"].T))
    return _Stepped(torch.from_numpy(observation), x, **did, ended=torch.from_numpy(ended))
