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
    back = axes_of(frame, demos.observations).transpose(0, 2, 1)
    return replace(
        demos,
        observations=features_of(frame, demos.observations),
        next_observations=features_of(frame, demos.next_observations),
        actions=turned(back, demos.actions),
        executed=turned(back, demos.executed),
    )


def features_of(frame: Frame, observation: np.ndarray) -> np.ndarray:
    """(..., size) float32 features of observations (..., no)."""
    features, _ = frame.features(tuple(np.moveaxis(observation, -1, 0)))
    return np.stack(np.broadcast_arrays(*features), -1).astype(np.float32)


def axes_of(frame: Frame, observation: np.ndarray) -> np.ndarray:
    """(n, 2, 2) float32 for observations (n, no): the frame's two directions as columns.

    They are orthonormal, so the transpose leads back from the world to the frame.
    """
    _, back = frame.features(tuple(observation.T))
    one, zero = np.ones(len(observation), np.float32), np.zeros(len(observation), np.float32)
    columns = [np.stack(np.broadcast_arrays(*back(unit)), -1) for unit in ((one, zero), (zero, one))]
    return np.stack(columns, -1).astype(np.float32)


def turned(axes: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Actions (n, 2) in [-1, 1] from a frame to the world, for its axes (n, 2, 2), or back for their transpose."""
    return np.tanh(np.einsum("nij,nj->ni", axes, np.arctanh(actions.clip(-_MOST, _MOST))))
