"""Observations, actions and demonstrations as seen in a task's frame, for learners whose networks know nothing of frames.

Actions are turned before tanh squashes them, as `PolicyNetwork` does, so every action of the frame is one of the world.
"""

from dataclasses import replace

import numpy as np

from ballbot_gym.tasks.symmetry import Frame
from ballbot_train.learning.demonstrations import Demos

_MOST = 1 - 1e-4  # of an action before it is turned: at the limit itself it would be endless


def demos_in_frame(demos: Demos, frame: Frame) -> Demos:
    """Demonstrations with features in place of observations, and actions as the frame has them."""
    observations, axes = seen_in(frame, demos.observations)
    next_observations, _ = seen_in(frame, demos.next_observations)
    back = axes.transpose(0, 2, 1)
    return replace(
        demos,
        observations=observations,
        next_observations=next_observations,
        actions=turned(back, demos.actions),
        executed=turned(back, demos.executed),
    )


def seen_in(frame: Frame, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a frame shows of observations (n, no), and where its axes are.

    Returns:
        Features (n, size) float32; and (n, 2, 2) float32, the frame's two directions as columns. They turn actions of the
        frame into those of the world, and are orthonormal, so their transpose leads back.
    """
    features, back = frame.features(tuple(observations.T))
    one, zero = np.ones(len(observations), np.float32), np.zeros(len(observations), np.float32)
    return _columns(features), np.stack([_columns(back(unit)) for unit in ((one, zero), (zero, one))], -1)


def _columns(parts: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*parts), -1).astype(np.float32)


def turned(axes: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Actions (n, 2) in [-1, 1] from a frame to the world, for its axes (n, 2, 2), or back for their transpose."""
    return np.tanh(np.einsum("nij,nj->ni", axes, np.arctanh(actions.clip(-_MOST, _MOST))))
