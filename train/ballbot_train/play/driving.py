"""A human as a controller: a stick that commands the force itself, or the speed of a robot that keeps its own balance."""

import math
from typing import Literal

import numpy as np

from ballbot_baselines.linearize import discretize
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task

DRIVERS: dict[str, Literal["force", "speed"]] = {"you": "speed", "you (force)": "force"}
"""Controllers that are human: by name, what the stick commands."""

DRIVE_FORCE = 100.0
"""N, of a stick that is fully out."""
DRIVE_SPEED = 2.5
"""m/s, of a stick that is fully out."""
_WEIGHTS = np.diag([0.5, 0.5, 2.0, 2.0, 0.2, 0.2])  # of leans, velocities and lean rates, 1/s
_EFFORT = 1e-4  # of squared force, 1/(N² s)


class Stick:
    """What the human commands."""

    def __init__(self) -> None:
        self.value = (0.0, 0.0)
        """Along x and y; the length is at most 1."""

    def move(self, x: float, y: float) -> None:
        """Moves it; more than a length of 1 counts as 1, and what is not finite as 0."""
        length = math.hypot(x, y)
        if not math.isfinite(length):
            x, y, length = 0.0, 0.0, 0.0
        self.value = (x / max(length, 1.0), y / max(length, 1.0))


class DriveController:
    """Turns the stick into a force, or into a velocity that LQR of leans and velocities follows."""

    def __init__(self, task: Task, params: BallbotParams, stick: Stick, mode: Literal["force", "speed"]):
        self._stick, self._mode = stick, mode
        self._gain = _velocity_gain(params, task.control_dt) if mode == "speed" else np.zeros((2, 6))

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        pass

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        stick = np.array(self._stick.value)
        if self._mode == "force":
            return DRIVE_FORCE * stick
        error = np.array(x[2:], np.float64)
        error[2:4] -= DRIVE_SPEED * stick
        return -self._gain @ error


def _velocity_gain(params: BallbotParams, dt: float) -> np.ndarray:
    """(2, 6) LQR of leans, velocities and lean rates. Upright motion at any speed is an equilibrium of these."""
    import scipy.linalg

    a, b = (matrix[0] for matrix in discretize(params, np.zeros((1, 8)), np.zeros((1, 2)), dt))
    a, b = a[2:, 2:], b[2:]
    r = _EFFORT * dt * np.eye(2)
    p = scipy.linalg.solve_discrete_are(a, b, _WEIGHTS * dt, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
