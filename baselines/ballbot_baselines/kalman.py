"""An extended Kalman filter for the state, the robot, its delay and the errors of its sensors, on a track that varies them.

The filter estimates z = (x, factors of body mass, height of the centre of mass and force, odometry's drift, biases of leans
and of lean rates), which is 17 numbers. Its model is the env's control step, and its Jacobian is CasADi's. What sensors
report is linear in z. How far each number may be from what is expected, and how noisy sensors are, is the track's: a number
that the track does not vary stays what it is.

A delay is whole control steps, so there is one filter for each delay that the track may draw. The one whose predictions were
likeliest is believed.
"""

from functools import lru_cache

import casadi
import numpy as np

from ballbot_gym import dynamics
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.tasks import Task

FACTORS = ("body_mass", "com_height", "force")
"""What is estimated of the robot: factors on the nominal values."""

_X, _FACTORS = slice(0, 8), slice(8, 11)
_SIZE = 17
_WIDE = 10.0  # standard deviation of the state before it is first observed, SI units
_LEAST_NOISE = 1e-4  # of sensors, SI units: no filter converges on exact ones
_MODEL_ERROR = 1e-3  # m/s and rad/s per control step that no robot of the track explains
_FACTOR_WALK = 5e-3  # per control step: lets factors recover from errors of the linearization
_EVIDENCE = 3.0  # of a longer delay over a shorter one, as a difference of log-likelihoods


class TrackFilter:
    """Estimates what a track does not tell, from reported states and commanded forces.

    | attribute | shape | meaning |
    |---|---|---|
    | `x` | (8,) | the state |
    | `factors` | (3,) | on the nominal values of what `FACTORS` names |
    | `covariance` | (17, 17) | of all that is estimated |
    | `deviations` | (3,) | standard deviations of `factors` |
    | `delay` | | control steps from a command to its force |
    """

    def __init__(self, task: Task, params: BallbotParams, track: Randomization):
        self._params, self._track = params, track
        low, high = track.delay_steps(task.control_dt)
        self._delays = range(low, high + 1)
        self._step = _step_function(params, task.control_dt).map(len(self._delays))
        self._low, self._high = np.array([getattr(track, name) for name in FACTORS]).T
        errors = np.repeat((track.odometry_drift, track.lean_bias, track.lean_rate_bias), 2)
        self._prior = np.concatenate([np.full(8, _WIDE), (self._high - self._low) / np.sqrt(12), errors]) ** 2
        self._walk = np.array([0] * 4 + [_MODEL_ERROR] * 4 + [_FACTOR_WALK] * 3 + [0] * 6) ** 2
        self._noise = np.diag(np.maximum(track.noise, _LEAST_NOISE)) ** 2

    def reset(self, x: np.ndarray) -> None:
        """Starts an episode, of which sensors report state x (8,) at first."""
        count = len(self._delays)
        middle = np.concatenate([np.zeros(8), (self._low + self._high) / 2, np.zeros(6)])
        self._z, self._p = np.tile(middle, (count, 1)), np.tile(np.diag(self._prior), (count, 1, 1))
        self._z[:, _X] = x
        self._likelihood = np.zeros(count)
        self._steps, self._best = 0, 0
        self._commands = [np.zeros(2)] * (self._delays[-1] + 1)  # the latest first
        self._correct(x, 0.0)

    def update(self, t: float, x: np.ndarray, u: np.ndarray) -> None:
        """Takes the reported state x (8,) at the episode's time t, s, and the force u (2,), N, that was asked for before."""
        self._commands = [np.asarray(u, np.float64), *self._commands[:-1]]
        forces = np.array([self._commands[delay] for delay in self._delays])
        after, slopes = (np.array(each) for each in self._step(self._z.T, forces.T))
        a = slopes.reshape(_SIZE, len(forces), _SIZE).transpose(1, 0, 2)
        # Factors multiply each other: what they move x by is wrong by about the share that they are uncertain by.
        of_factors, moved = self._p[:, _FACTORS, _FACTORS], a[:, _X, _FACTORS]
        share = np.trace(of_factors, axis1=1, axis2=2)[:, None]
        second_order = share * np.einsum("kij,kjl,kil->ki", moved, of_factors, moved)
        self._z = after.T.copy()
        self._p = a @ self._p @ a.transpose(0, 2, 1)
        spread = np.diagonal(self._p, axis1=1, axis2=2)
        index = np.arange(_SIZE)
        self._p[:, index, index] += np.where(spread < self._prior, self._walk, 0.0)
        self._p[:, index[_X], index[_X]] += second_order
        self._likelihood += self._correct(x, t)
        self._best = int(np.argmax(self._likelihood >= self._likelihood.max() - _EVIDENCE))

    def _correct(self, x: np.ndarray, t: float) -> np.ndarray:
        """Corrects all filters by what sensors report, and says how likely each found it."""
        h = np.eye(8, _SIZE)
        h[range(8), [11, 12, 13, 14, 11, 12, 15, 16]] = [t, t, 1, 1, 1, 1, 1, 1]
        missed = np.asarray(x, np.float64) - self._z @ h.T
        spread = h @ self._p @ h.T + self._noise
        gain = np.linalg.solve(spread, h @ self._p).transpose(0, 2, 1)
        self._z = self._z + np.einsum("kij,kj->ki", gain, missed)
        self._z[:, _FACTORS] = np.clip(self._z[:, _FACTORS], self._low, self._high)
        kept = np.eye(_SIZE) - gain @ h
        self._p = kept @ self._p @ kept.transpose(0, 2, 1) + gain @ self._noise @ gain.transpose(0, 2, 1)
        whitened = np.einsum("ki,ki->k", missed, np.linalg.solve(spread, missed[..., None])[..., 0])
        return -0.5 * (whitened + np.linalg.slogdet(spread)[1])

    @property
    def x(self) -> np.ndarray:
        return self._z[self._best, _X].copy()

    @property
    def factors(self) -> np.ndarray:
        return self._z[self._best, _FACTORS].copy()

    @property
    def covariance(self) -> np.ndarray:
        return self._p[self._best].copy()

    @property
    def deviations(self) -> np.ndarray:
        return np.sqrt(np.diagonal(self.covariance)[_FACTORS])

    @property
    def delay(self) -> int:
        return self._delays[self._best]

    @property
    def under_way(self) -> list[np.ndarray]:
        """The commanded forces (2,), N, that have not begun to act, the earliest first."""
        return self._commands[: self.delay][::-1]

    @property
    def robot(self) -> BallbotParams:
        """The estimated robot, on the slipperiest floor of the track."""
        mass, height, force = self.factors.tolist()
        return self._track.robot(self._params, (mass, 1.0, height, 1.0, 1.0, 0.0, force, self._track.friction[0]))


@lru_cache(maxsize=16)
def _step_function(params: BallbotParams, dt: float) -> casadi.Function:
    """(z, commanded force) -> z after a control step of dt, s, in which the force acts, and its Jacobian."""
    z, u = casadi.SX.sym("z", _SIZE), casadi.SX.sym("u", 2)
    mass, height, force = (z[8 + i] for i in range(3))
    robot = Randomization().robot(params, (mass, 1.0, height, 1.0))
    x = dynamics.step(robot, z[_X], force * u, dt, dynamics.substeps_for(dt))
    after = casadi.vertcat(x, z[8:])
    return casadi.Function("step", [z, u], [after, casadi.densify(casadi.jacobian(after, z))], {"cse": True})
