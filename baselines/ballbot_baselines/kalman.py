"""Extended Kalman filters: for what a track does not tell, and for the state of a robot with wheels from its sensors.

`TrackFilter` estimates z = (x, factors of body mass, height of the centre of mass and force, odometry's drift, biases of
leans and of lean rates), which is 17 numbers, on a track that varies them. Its model is the env's control step, and its
Jacobian is CasADi's. What sensors report is linear in z. How far each number may be from what is expected, and how noisy
sensors are, is the track's: a number that the track does not vary stays what it is.

A delay is whole control steps, so there is one filter for each delay that the track may draw. The one whose predictions were
likeliest is believed.

`SensorFilter` estimates the state and the gyroscope's biases, which is 14 numbers, from what `ballbot_gym.sensors` shows.
Readings are of a control step as a whole, so they correct the state in which the step began, and from there the model goes
on. Before the first of them the filter expects what the task draws, at the place where the episode begins.
"""

from functools import lru_cache
from typing import Any

import casadi
import gymnasium
import numpy as np

from ballbot_gym import dynamics, sensors
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.rollout import Controller
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
        if params.wheels is not None:
            raise ValueError(
                "what a track does not tell is not estimated of a robot with wheels; give lqr, trajopt or nmpc"
            )
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
        self._z, self._p, spread = _corrected(self._z, self._p, h, missed, self._noise)
        self._z[:, _FACTORS] = np.clip(self._z[:, _FACTORS], self._low, self._high)
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


def _corrected(
    z: np.ndarray, p: np.ndarray, h: np.ndarray, missed: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimates z (..., n) and covariances (..., n, n), corrected by what h (m, n) missed (..., m), with its noise (m, m).

    The third is the covariance (..., m, m) that was expected of what was missed.
    """
    spread = h @ p @ h.T + noise
    gain = np.linalg.solve(spread, h @ p).swapaxes(-1, -2)
    kept = np.eye(z.shape[-1]) - gain @ h
    p = kept @ p @ kept.swapaxes(-1, -2) + gain @ noise @ gain.swapaxes(-1, -2)
    return z + np.einsum("...ij,...j->...i", gain, missed), p, spread


_WHEELS_SIZE = 14
_DRAWN = 256  # starts that tell what to expect of one
_KNOWN = 1e-3  # standard deviation of what they all share, SI units
_WHEELS_ERROR = (
    np.array([0] * 4 + [1e-3] * 4 + [0] + [1e-3] * 2 + [0] * 3) ** 2
)  # variances that the model does not explain


class SensorFilter:
    """Estimates the state of a robot with wheels from its sensors and the forces of its wheels.

    | attribute | shape | meaning |
    |---|---|---|
    | `x` | (11,) | the state |
    | `covariance` | (14, 14) | of the state and the gyroscope's biases |
    """

    def __init__(self, task: Task, params: BallbotParams):
        self._task, self._params = task, params
        self._functions = _sensor_functions(params, task.control_dt)
        samples = sensors.samples(task.control_dt)
        noise = [sensors.GYROSCOPE_NOISE**2 / samples] * 3 + [sensors.ACCELEROMETER_NOISE**2 / samples] * 3
        self._noise = np.diag([*noise, *[sensors.TICK**2 / 6] * 3])  # of the difference of two roundings

    def reset(self, seen: np.ndarray, c: np.ndarray) -> None:
        """Starts an episode with constants c (nc,), of which sensors show this (no,) at first."""
        rng = np.random.default_rng(0)
        draws = rng.random((_DRAWN, self._task.state_draws))
        starts = np.array([self._task.start(tuple(z), tuple(c), self._params) for z in draws.tolist()])
        starts[:, :2] = seen[9:11]
        self._z = np.concatenate([starts.mean(0), np.zeros(3)])
        self._p = np.diag([*np.maximum(starts.std(0), _KNOWN), *[sensors.GYROSCOPE_BIAS] * 3]) ** 2
        self._correct(seen, *self._functions[0](self._z))

    def update(self, seen: np.ndarray, u: np.ndarray) -> None:
        """Takes what sensors show (no,) after a control step with the wheels' forces u (3,), N."""
        u = np.clip(u, -self._params.force_limit, self._params.force_limit)
        self._correct(seen, *self._functions[1](self._z, u))
        after, slopes = self._functions[2](self._z, u)
        self._z, slopes = np.array(after)[:, 0], np.array(slopes)
        self._p = slopes @ self._p @ slopes.T + np.diag(_WHEELS_ERROR)

    def _correct(self, seen: np.ndarray, expected: casadi.DM, slopes: casadi.DM) -> None:
        missed = np.asarray(seen[:9], np.float64) * sensors.SCALE - np.array(expected)[:, 0]
        self._z, self._p, _ = _corrected(self._z, self._p, np.array(slopes), missed, self._noise)

    @property
    def x(self) -> np.ndarray:
        return self._z[:11].copy()

    @property
    def covariance(self) -> np.ndarray:
        return self._p.copy()


class FilteredController:
    """A controller behind `SensorFilter`, for envs that show sensors; `filter` is what it knows."""

    senses = True

    def __init__(self, task: Task, params: BallbotParams, controller: Controller):
        self.filter, self._controller = SensorFilter(task, params), controller

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        """Starts at the episode's time t, s, where sensors show x (no,)."""
        self.filter.reset(x, c)
        self._u: np.ndarray | None = None
        self._controller.reset(t, self.filter.x, c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        if self._u is not None:
            self.filter.update(x, self._u)
        self._u = np.asarray(self._controller.act(t, self.filter.x))
        return self._u


class StateFromSensors(gymnasium.Wrapper):
    """Shows a policy the observation of the state that `SensorFilter` estimates, in an env that shows sensors."""

    def __init__(self, env: gymnasium.Env):
        """Args: env: a `BallbotEnv` with observation="sensors" and without history, wrapped or not."""
        super().__init__(env)
        ballbot: Any = env.unwrapped
        if not isinstance(ballbot, BallbotEnv) or ballbot.observation != "sensors" or ballbot.history:
            raise ValueError('StateFromSensors takes a BallbotEnv with observation="sensors" and without history')
        self._task = ballbot.task
        self.observation_space = sensors.observation_space(ballbot.task, ballbot.params)
        self.filter = SensorFilter(ballbot.task, ballbot.params)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        seen, info = self.env.reset(seed=seed, options=options)
        self.filter.reset(seen, info["constants"])
        self._steps = 0
        return self._state(info), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = self.env.step(action)
        self.filter.update(seen, info["force"])
        self._steps += 1
        return self._state(info), reward, terminated, truncated, info

    def _state(self, info: dict[str, Any]) -> np.ndarray:
        c = self._task.at(info["constants"], self._steps * self._task.control_dt)
        return np.array(self._task.seen(self.filter.x, c), np.float32)


@lru_cache(maxsize=16)
def _sensor_functions(params: BallbotParams, dt: float) -> list[casadi.Function]:
    """Readings at an episode's start and over a control step of dt, s, and the step itself, of z and the wheels' forces.

    Each gives its Jacobian with respect to z too.
    """
    z, u = casadi.SX.sym("z", _WHEELS_SIZE), casadi.SX.sym("u", 3)
    x, bias = casadi.vertsplit(z[:11]), casadi.vertcat(z[11:], casadi.DM.zeros(6))
    after = dynamics.step(params, z[:11], u, dt, dynamics.substeps_for(dt))
    forces = tuple(casadi.vertsplit(u))
    first = sensors.undriven(params, tuple(x), dt)
    following = sensors.mean(params, tuple(x), forces, tuple(casadi.vertsplit(after)), dt)
    outputs = {
        "first": casadi.vertcat(*first) + bias,
        "following": casadi.vertcat(*following) + bias,
        "step": casadi.vertcat(after, z[11:]),
    }
    return [
        casadi.Function(
            name, [z] if name == "first" else [z, u], [out, casadi.densify(casadi.jacobian(out, z))], {"cse": True}
        )
        for name, out in outputs.items()
    ]
