"""Initial guesses for trajectory optimization."""

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

_SMOOTHING = 0.15  # s: shorter turns of a guessed path are rounded off, because the body cannot follow them


def along_path(
    params: Any, path: np.ndarray, dt: float | np.ndarray, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """States and forces that approximately follow ground paths, one or many of a length.

    The lean balances the path's acceleration, tan γ = ẍ/g, and the force accelerates both masses. This is exact for constant
    acceleration. For other paths the solver corrects it.

    Args:
        path: (..., n+1, 2) ball positions, m, one every dt s.
        dt: s, one or (...,).
        start: (..., 8) the true initial states, which replace the first guessed ones.

    Returns:
        x: (..., n+1, 8) and u: (..., n, 2), clipped to the force limit.
    """
    step = np.asarray(dt)[..., None, None]
    velocity = np.gradient(path, axis=-2) / step
    acceleration = _smoothed(np.gradient(velocity, axis=-2) / step, dt)
    gamma = np.arctan2(acceleration[..., 0], params.gravity)
    theta = np.arctan2(acceleration[..., 1], np.hypot(params.gravity, acceleration[..., 0]))
    lean = np.clip(np.stack([gamma, theta], axis=-1), -1.0, 1.0)
    x = np.concatenate([path, lean, velocity, np.gradient(lean, axis=-2) / step], axis=-1)
    u = np.clip(params.moving_mass * acceleration[..., :-1, :], -params.force_limit, params.force_limit)
    x, u = params.extended(x, u)
    if start is not None:
        x[..., 0, :] = start
    return x, u


def resampled(values: np.ndarray, intervals: int) -> np.ndarray:
    """(..., n+1, k) values at equal times as (..., intervals+1, k), linearly interpolated."""
    n = values.shape[-2] - 1
    old, new = np.linspace(0, 1, n + 1), np.linspace(0, 1, intervals + 1)
    before = np.searchsorted(old, new, side="right") - 1
    after = np.minimum(before + 1, n)
    length = np.where(before < n, old[after] - old[before], 1.0)[:, None]
    first = values[..., before, :]
    return (values[..., after, :] - first) / length * (new - old[before])[:, None] + first


def motion_resampled(x: np.ndarray, a: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States (..., n+1, k) and actions (..., n, m) of motions at another number of equal steps."""
    held = np.concatenate([a, a[..., -1:, :]], axis=-2)
    return resampled(x, steps), resampled(held, steps)[..., :-1, :]


def _smoothed(values: np.ndarray, dt: float | np.ndarray) -> np.ndarray:
    """Means (..., n, k) over `_SMOOTHING` seconds of values every dt s, one or (...,)."""
    widths = np.maximum(1, np.rint(_SMOOTHING / np.broadcast_to(dt, values.shape[:-2])).astype(int))
    means = np.empty_like(values)
    for width in np.unique(widths).tolist():
        some = values[widths == width]
        padded = np.pad(some, ((0, 0), (width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
        means[widths == width] = sliding_window_view(padded, width, axis=-2).mean(axis=-1)
    return means
