"""What vector envs do where episodes end: a step of a `BallbotBatch` in each of Gymnasium's modes, and what infos say."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ballbot_gym.checks import check_finite
from ballbot_gym.vector.state import BatchState

if TYPE_CHECKING:
    import torch

    from ballbot_gym.vector.batch import BallbotBatch, BatchStep

_NOTHING_DONE = (
    *("reward", "reward_parts", "cost", "terminated", "truncated", "success", "failure"),
    *("force", "clipped", "grip"),
)
"""Fields of a `BatchStep` that are 0 of an env that waits."""


Info = dict[str, np.ndarray]
"""What an info says of B environments, with the keys of `BallbotEnv`'s: of a step, or of the start of an episode."""


Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]
"""What `BallbotVectorEnv.step` returns."""


def step(batch: BallbotBatch, actions: np.ndarray, waiting: np.ndarray | None) -> Step:
    """One control step of a batch, with NumPy arrays in and out.

    Args:
        batch: the envs that take the step. If its `restarts` is true, the next episode starts at once where one ends.
            Otherwise the envs stay in their final states.
        actions: (B, 2).
        waiting: (B,) bool, the envs that ignore their action and start their next episode; None if there are none.

    Raises:
        ValueError: an action is not finite; the envs stay as they are.
        gymnasium.error.ResetNeeded: before the first reset.
    """
    import torch  # there is a batch, so it is there

    check_finite(actions)
    actions = np.asarray(actions, order="F")  # components contiguous, as everything in the batch
    before: Any = batch.state
    with torch.no_grad():
        result: Any = _advance(batch, torch.from_numpy(actions).to(batch.device), waiting)
        state: Any = batch.state
        measured, last_measured = map(batch.measurements, (state, state._replace(x=result.final_x)))
    result = result._make(map(_as_array, result))
    numbers = result.reward, result.reward_parts, result.cost
    reward, parts, cost = (number.astype(np.float64, copy=False) for number in numbers)
    ended = (result.terminated | result.truncated).nonzero()[0]
    seen, last = (part.astype(np.float32, copy=False) for part in (result.observation, result.final_observation))
    violated, end = result.violated, None
    now = cost, parts, result.force, result.success, violated >= 0, result.clipped, result.grip
    if batch.restarts and ended.size:
        end = _info_of(before._replace(x=result.final_x), last_measured, violated, *now)
        now = tuple(_without(part, ended) for part in now)
    info = _info_of(state, measured, violated, *now)
    return _as_gymnasium(seen, reward, result.terminated, result.truncated, info, end, last[ended])


def _as_gymnasium(
    observation: np.ndarray,
    reward: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    now: Info,
    end: Info | None,
    last: np.ndarray,
) -> Step:
    """What Gymnasium's `step` returns, with masks in its infos.

    Args:
        observation: (B, no) float32.
        reward: (B,) float64.
        terminated, truncated: (B,) bool.
        now: of the envs now; where an episode ended and another began, of the start, as after `reset`.
        end: of the step itself, where such episodes ended; else None.
        last: (n, no) float32, what the n envs whose episodes ended saw at the end.
    """
    infos: dict[str, Any] = {}
    if end is not None:
        done = terminated | truncated
        infos = {"final_info": _masked(end, done), "final_obs": np.full(observation.shape, np.nan, np.float32)}
        infos["final_obs"][np.flatnonzero(done)] = last
        infos["_final_info"] = infos["_final_obs"] = done
    return observation, reward, terminated, truncated, infos | _masked(now, _filled(True, len(reward)))


def _masked(info: Info, mask: np.ndarray) -> dict[str, Any]:
    """An info with Gymnasium's masks (B,) of valid entries."""
    return info | dict.fromkeys([f"_{name}" for name in info], mask)


def _advance(batch: BallbotBatch, actions: torch.Tensor, waiting: np.ndarray | None) -> BatchStep:
    import torch

    if waiting is None:
        return batch.step(actions)
    wait = torch.from_numpy(waiting).to(batch.device)
    batch.state = begun = batch.initial_state(None, wait)
    result = batch.step(actions)
    batch.state = BatchState(*(torch.where(wait, a, b) for a, b in zip(begun, batch.state, strict=True)))
    return result._replace(
        **{name: getattr(result, name).masked_fill(wait, 0) for name in _NOTHING_DONE},
        violated=result.violated.masked_fill(wait, -1),
        observation=torch.where(wait[:, None], batch.observe(batch.state), result.observation),
    )


def _info_of(
    state: Any,
    measured: dict[str, np.ndarray],
    violated: np.ndarray,
    cost: np.ndarray,
    reward_parts: np.ndarray,
    force: np.ndarray,
    success: np.ndarray,
    failure: np.ndarray,
    clipped: np.ndarray,
    grip: np.ndarray,
) -> Info:
    """An info. Arrays that share memory with the arguments' state are read-only.

    Args:
        state: a `BatchState` with the states, constants and draws that the info reports. Its arrays may be of any kind.
        measured: (B,) what the robot measures, by name.
        violated: (B,) int64, same as in `BatchStep`, where `failure` is true.
        cost: (B,) float64, of the step.
        reward_parts: (3, B) float64, which add up to the reward.
        force: (2, B) N.
        success, failure, clipped: (B,) bool.
        grip: (4, B), same as in `BatchStep`; (0, B) where friction is unlimited.
    """
    x, c, drawn = _as_array(state.x).T, _as_array(state.c).T, _as_array(state.drawn)
    size = len(cost)
    failed = np.count_nonzero(failure)
    violated = violated if failed else _filled(-1, size)
    x.flags.writeable = c.flags.writeable = violated.flags.writeable = False
    info = {
        "state": x,
        "cost": cost,
        "reward_survive": reward_parts[0],
        "reward_cost": reward_parts[1],
        "reward_goal": reward_parts[2],
        **measured,
        "success": success,
        "is_success": success,
        "failure": failure,
        "violated": violated,
        "constraint_cost": failure.astype(np.float64) if failed else _filled(0.0, size),
        "force": force.T,
        "clipped": clipped,
        "constants": c,
    }
    if len(grip):
        info["grip"] = grip.T
    if len(drawn):
        info["drawn"] = drawn.T.copy()
    return info


@lru_cache(maxsize=16)
def _filled(value: Any, size: int) -> np.ndarray:
    """A read-only array (size,) of one value."""
    array = np.full(size, value)
    array.flags.writeable = False
    return array


def _as_array(part: Any) -> np.ndarray:
    """A tensor, or an array, as an array."""
    return part if isinstance(part, np.ndarray) else part.detach().cpu().numpy()


def _without(rows: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """A copy of (B,) or (n, B) numbers with 0 in some columns."""
    copied = rows.copy(order="K")
    for row in np.atleast_2d(copied):  # one after the other, which NumPy does three times as fast
        row[indices] = 0
    return copied
