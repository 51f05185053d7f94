"""An estimate of how a robot's accelerations differ from the model's."""

import numpy as np

_FORGETTING = 0.98  # per control step: the estimate remembers about a second
_TRUST = np.array([1e-1, 1e1, 1e-3])  # variances of its constant, lean and force parts before the first step; SI units


class DisturbanceEstimator:
    """Estimates what to add to the model's accelerations: for each axis a constant, a part of its lean, and of its force.

    `coefficients` (2 axes, 3, 2) say how much the constant, the lean (rad) and the force (as a fraction of its limit) add to
    the ball's acceleration, m/s², and to the lean's, rad/s². They are fitted by recursive least squares, and start at 0.
    """

    def __init__(self, force_limit: float):
        self.coefficients = np.zeros((2, 3, 2))
        self._limit = force_limit
        self._covariance = np.tile(np.diag(_TRUST * [1.0, 1.0, force_limit**2 / 100]), (2, 1, 1))

    def fit(self, x: np.ndarray, u: np.ndarray, errors: np.ndarray) -> None:
        """Takes the errors (4,) of the accelerations over a control step from state x (8,) under force u (2,), N."""
        for axis in range(2):
            features = np.array([1.0, x[2 + axis], u[axis] / self._limit])
            covariance = self._covariance[axis]
            gain = covariance @ features / (_FORGETTING + features @ covariance @ features)
            missed = errors[[axis, 2 + axis]] - features @ self.coefficients[axis]
            self.coefficients[axis] += np.outer(gain, missed)
            # Forgetting is limited: at rest nothing is learned, and the covariance must not grow.
            updated = covariance - np.outer(gain, features @ covariance)
            self._covariance[axis] = updated / _FORGETTING if np.trace(updated) < _TRUST.sum() else updated

    def rates(self, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is added to the rates of states x (n, 8) under actions a (n, 2): (n, 8), and its slopes (10, 8)."""
        added, slopes = np.zeros(x.shape), np.zeros((10, 8))
        for axis in range(2):
            constant, lean, force = self.coefficients[axis]
            places = [4 + axis, 6 + axis]
            added[:, places] = constant + x[:, 2 + axis, None] * lean + a[:, axis, None] * force
            slopes[2 + axis, places], slopes[8 + axis, places] = lean, force
        return added, slopes
