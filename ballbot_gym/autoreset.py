"""What vector envs do where episodes end: a step of a `BallbotBatch` in each of Gymnasium's modes, and what infos say."""

from typing import NamedTuple

import gymnasium
import numpy as np

from ballbot_gym.batch import BallbotBatch, BatchState, BatchStep, tilt_of

# isort: split
import torch  # after our modules, whose errors name the extra that brings it


class StepInfo(NamedTuple):
    """What an info says of B environments, in NumPy arrays: of the step, or of the start of an episode."""

    x: np.ndarray
    """(8, B) states."""
    cost: np.ndarray
    """(B,) float64, of the step."""
    reward_parts: np.ndarray
    """(3, B) float64, `env.REWARD_PARTS`; their sum is the reward."""
    tilt: np.ndarray
    """(B,) rad."""
    force: np.ndarray
    """(2, B) N."""
    success: np.ndarray
    """(B,) bool."""
    failure: np.ndarray
    """(B,) bool."""
    violated: np.ndarray
    """(B,) int64, as of `BatchStep`, where `failure` holds."""
    clipped: np.ndarray
    """(B,) bool."""
    c: np.ndarray
    """(nc, B) constants."""
    grip: np.ndarray
    """(4, B), as of `BatchStep`; (0, B) where friction is unlimited."""
    drawn: np.ndarray = np.zeros((0, 0))
    """(6 or 14, B), as of `BatchState`; (0, B) where nothing is drawn."""


def advance(batch: BallbotBatch, actions: torch.Tensor, waiting: np.ndarray | None, restart: bool) -> BatchStep:
    """One control step of a batch.

    Args:
        batch: which goes on.
        actions: (B, 2).
        waiting: (B,) bool, the envs that ignore their action and begin their next episode; None where there are none.
        restart: whether episodes that end are followed by the next ones at once. Else the batch stays at their ends, and
            `observation` and `tilt` are those of the end.
    """
    if batch.state is None:
        raise gymnasium.error.ResetNeeded("step() before reset()")
    wait = None if waiting is None else torch.from_numpy(waiting).to(batch.device)
    if wait is not None:
        batch.state = batch.initial_state(None, wait)
    before = batch.state
    result = batch.step(actions)
    after = batch.state
    if restart or after is None:
        return result
    ended = result.terminated | result.truncated
    if wait is not None:
        ended = ended & ~wait
        no = ~wait
        result = result._replace(
            reward=result.reward * no,
            cost=result.cost * no,
            terminated=result.terminated & no,
            truncated=result.truncated & no,
            success=result.success & no,
            failure=result.failure & no,
            violated=torch.where(wait, -1, result.violated),
            force=result.force * no,
            clipped=result.clipped & no,
            grip=torch.where(no, result.grip, 0.0),
        )
    held = ended if wait is None else ended | wait
    if not held.any():
        return result
    x = torch.where(ended, result.final_x, before.x)
    old = before._replace(x=x, steps=before.steps + ended)
    batch.state = BatchState(*(torch.where(held, a, b) for a, b in zip(old, after, strict=True)))
    observation = torch.where(ended[:, None], result.final_observation, result.observation)
    if wait is not None:
        observation = torch.where(wait[:, None], batch.observe(batch.state), observation)
    return result._replace(observation=observation, tilt=tilt_of(batch.state.x.unbind(0)))


def begun(now: StepInfo, which: np.ndarray) -> StepInfo:
    """What infos say where episodes have begun in place of ended ones, as after `reset`."""
    cleared = ("cost", "reward_parts", "force", "success", "failure", "clipped", "grip")
    return now._replace(**{name: _without(getattr(now, name), which) for name in cleared})


def _without(rows: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """A copy of (B,) or (n, B) numbers with 0 in some columns."""
    copied = rows.copy(order="K")
    for row in np.atleast_2d(copied):  # one after the other, which NumPy does three times as fast
        row[indices] = 0
    return copied
