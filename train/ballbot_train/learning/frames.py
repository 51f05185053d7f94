"""Observations, actions and demonstrations as seen in a task's frame, for learners whose networks know nothing of frames.

Actions of a frame are within ±1, as those of the world are. Times `REACH` and turned they include all of the world's, and the
others are clipped, as `PolicyNetwork` does with the squash "tanh_in_frame". So a small error of an action is small in both.
"""

from dataclasses import replace

import numpy as np

from ballbot_gym.tasks.symmetry import REACH, Frame
from ballbot_train.learning.datasets import Demos


def demos_in_frame(demos: Demos, frame: Frame) -> Demos:
    """Demonstrations with features in place of observations, and actions as the frame has them."""
    observations, axes = seen_in(frame, demos.observations)
    next_observations, _ = seen_in(frame, demos.next_observations)
    turned = {
        name: np.einsum("nji,nj->ni", axes, getattr(demos, name)) / np.float32(REACH)
        for name in ("actions", "executed")
    }
    return replace(demos, observations=observations, next_observations=next_observations, **turned)


def seen_in(frame: Frame, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a frame shows of observations (n, no), and where its axes are.

    Returns:
        Features (n, size) float32; and (n, 2, 2) float32, the frame's two directions as columns, which are orthonormal.
    """
    features, back = frame.features(tuple(observations.T))
    one, zero = np.ones(len(observations), np.float32), np.zeros(len(observations), np.float32)
    return _columns(features), np.stack([_columns(back(unit)) for unit in ((one, zero), (zero, one))], -1)


def _columns(parts: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*parts), -1).astype(np.float32)


def to_world(axes: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Actions (n, 2) in [-1, 1] of the frame whose directions are the columns of axes (n, 2, 2), as actions of the world."""
    return np.clip(REACH * np.einsum("nij,nj->ni", axes, actions), -1.0, 1.0)
