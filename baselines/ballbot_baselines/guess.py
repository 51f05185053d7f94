"""Initial guesses for trajectory optimization."""

import numpy as np

from ballbot_gym import omni
from ballbot_gym.params import BallbotParams

_SMOOTHING = 0.15  # s: shorter turns of a guessed path are rounded off, because the body cannot follow them


def along_path(
    params: BallbotParams, path: np.ndarray, dt: float, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """States and forces that approximately follow a ground path.

    The lean balances the path's acceleration, tan γ = ẍ/g, and the force accelerates both masses. This is exact for constant
    acceleration. For other paths the solver corrects it.

    Args:
        path: (n+1, 2) ball positions, m, one every dt s.
        dt: s.
        start: (8,) the true initial state, put in place of the first guessed one.

    Returns:
        x: (n+1, 8) and u: (n, 2), clipped to the force limit.
    """
    velocity = np.gradient(path, dt, axis=0)
    acceleration = _smoothed(np.gradient(velocity, dt, axis=0), dt)
    gamma = np.arctan2(acceleration[:, 0], params.gravity)
    theta = np.arctan2(acceleration[:, 1], np.hypot(params.gravity, acceleration[:, 0]))
    lean = np.clip(np.column_stack([gamma, theta]), -1.0, 1.0)
    x = np.column_stack([path, lean, velocity, np.gradient(lean, dt, axis=0)])
    u = np.clip(params.moving_mass * acceleration[:-1], -params.force_limit, params.force_limit)
    x, u = omni.with_wheels(params, x, u)
    if start is not None:
        x[0] = start
    return x, u


def resampled(values: np.ndarray, intervals: int) -> np.ndarray:
    """(n+1, k) values at equal times as (intervals+1, k), linearly interpolated."""
    old, new = np.linspace(0, 1, len(values)), np.linspace(0, 1, intervals + 1)
    return np.column_stack([np.interp(new, old, column) for column in values.T])


def _smoothed(values: np.ndarray, dt: float) -> np.ndarray:
    width = max(1, round(_SMOOTHING / dt))
    kernel = np.ones(width) / width
    padded = np.pad(values, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(column, kernel, mode="valid") for column in padded.T])
