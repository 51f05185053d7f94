"""What Gymnasium's vector envs return: a step of a batch, with the infos and masks of each autoreset mode."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ballbot_gym.vector.state import BatchStep

if TYPE_CHECKING:
    from ballbot_gym.vector.arrays import BallbotArrays
    from ballbot_gym.vector.batch import BallbotBatch
    from ballbot_gym.vector.state import BatchState

Info = dict[str, np.ndarray]
"""What an info says of B environments, with the keys of `BallbotEnv`'s: of a step, or of the start of an episode."""

Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]
"""What `BallbotVectorEnv.step` returns."""


def _gymnasium_step(batch: BallbotBatch | BallbotArrays, before: BatchState, did: BatchStep) -> Step:
    """What Gymnasium's `step` returns, with masks in its infos.

    Args:
        batch: after the step. If its `restarts` is true, the next episode has started where one ended: `final_info` and
            `final_obs` tell of the step, and the info of a start, as after `reset`. Otherwise these envs have stayed in their
            final states.
        before: its state before the step.
        did: the step.
    """
    state: Any = batch.state
    step: Any = did if isinstance(did.reward, np.ndarray) else _in_numpy(did)
    infos, done, begun = {}, step.terminated | step.truncated, None
    if batch.restarts and np.count_nonzero(done):
        begun = done.nonzero()[0]
        last = step.final_observation.astype(np.float32, copy=False)
        end = _info(batch, before._replace(x=step.final_x), step.final_measured, step)
        infos = {"final_info": _masked(end, done), "final_obs": last, "_final_info": done, "_final_obs": done}
    infos |= _masked(_info(batch, state, step.measured, step, begun), _filled(True, len(done)))
    seen = step.observation.astype(np.float32, copy=False)
    return seen, step.reward, step.terminated, step.truncated, infos


def _gymnasium_reset(batch: BallbotBatch | BallbotArrays, mask: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """What Gymnasium's `reset` returns of a batch, in which the envs of the mask (B,) have just begun."""
    state: Any = batch.state
    size, rows = batch.num_envs, (batch.params.action_size, 4 * batch.params.grips)
    force, grip = (np.zeros((count, size), _as_array(state.x).dtype) for count in rows)
    seen, measured = _as_array(batch.observe(state)), _as_array(batch.measurements(state))
    nothing: Any = {
        **dict.fromkeys(("reward", "cost", "violated"), np.zeros(size)),
        **dict.fromkeys(("terminated", "truncated", "success", "failure", "clipped"), np.zeros(size, bool)),
        "reward_parts": np.zeros((3, size)),
        "force": force,
        "grip": grip,
    }
    shown: Any = {"observation": seen, "final_observation": seen, "measured": measured, "final_measured": measured}
    did = BatchStep(**nothing, **shown, final_x=state.x)
    return seen.astype(np.float32, copy=False), _masked(_info(batch, state, measured, did), mask)


def _masked(info: Info, mask: np.ndarray) -> dict[str, Any]:
    """An info with Gymnasium's masks (B,) of valid entries."""
    return info | dict.fromkeys(_names_of_masks(tuple(info)), mask)


@lru_cache
def _names_of_masks(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"_{name}" for name in names)


def _info(
    batch: BallbotBatch | BallbotArrays, state: Any, measured: np.ndarray, did: Any, begun: np.ndarray | None = None
) -> Info:
    """An info. Arrays that share memory with the arguments' state are read-only.

    Args:
        batch: of which the info is.
        state: a `BatchState` with the states, constants and draws that the info reports. Its arrays may be of any kind.
        measured: (nm, B) what the robot measures there.
        did: a `BatchStep` of arrays with what the step did.
        begun: indices of the envs that have begun another episode since, in which they did nothing yet.
    """
    x, c, drawn = _as_array(state.x).T, _as_array(state.c).T, _as_array(state.drawn)
    done = did.cost, *did.reward_parts, did.success, did.failure, did.force, did.clipped, did.grip
    if begun is not None:
        done = [_zeroed(part, begun) for part in done]
    cost, survive, running, goal, success, failure, force, clipped, grip = done
    failed = np.count_nonzero(failure)
    violated = did.violated if failed else _filled(-1, len(cost))
    x.flags.writeable = c.flags.writeable = violated.flags.writeable = False
    info = {
        "state": x,
        "cost": cost,
        "reward_survive": survive,
        "reward_cost": running,
        "reward_goal": goal,
        **batch.params.named_measurements(measured),
        "success": success,
        "is_success": success,
        "failure": failure,
        "violated": violated,
        "constraint_cost": failure.astype(np.float64) if failed else _filled(0.0, len(cost)),
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


def _in_numpy(did: BatchStep) -> BatchStep:
    """A step of tensors with arrays, and with pay in float64."""
    arrays: Any = did._make(map(_as_array, did))
    pay = {name: getattr(arrays, name).astype(np.float64) for name in ("reward", "reward_parts", "cost")}
    return arrays._replace(**pay)


def _zeroed(part: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """A copy of (B,) or (n, B) numbers with 0 in some columns."""
    copied = part.copy()
    for row in copied if part.ndim == 2 else (copied,):  # one after the other, which takes NumPy less time
        row[indices] = 0
    return copied
