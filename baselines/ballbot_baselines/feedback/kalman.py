"""Extended Kalman filters: for the hidden parameters of a track, and for the state of a robot with wheels from its sensors.

`TrackFilter` estimates z = (x, factors of body mass, height of the centre of mass and force, odometry's drift, biases of
leans and of lean rates), which is 17 numbers, on a track that varies them. Its model is the env's control step, and CasADi
computes the Jacobian. The sensor readings are linear in z. The track gives the initial variance of each number and the
noise of the sensors. A number that the track does not vary stays constant.

Delays are whole control steps, so there is one filter for each delay that the track may draw. The estimates are those of the
filter with the likeliest predictions.

`SensorFilter` estimates the state and the gyroscope's biases, which is 14 numbers, from the readings of
`ballbot_gym.robot.sensors`. Readings are means over a whole control step. So they correct the state at the start of the step,
and the model then predicts the state at its end. Before the first reading the filter assumes the mean and the deviations of
the task's initial states, at the start position of the episode.
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import casadi
import gymnasium
import numpy as np

from ballbot_baselines.solvers.compiled import LANES, InPlace
from ballbot_baselines.solvers.stage import Stage
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import ROBOT_FACTORS, Randomization, Robot, Sensors
from ballbot_gym.step import observation_space
from ballbot_gym.tasks import Task

_X, _FACTORS = slice(0, 8), slice(8, 11)
_SIZE = 17
_WIDE = 10.0  # standard deviation of the state before it is first observed, SI units
_LEAST_NOISE = 1e-4  # of sensors, SI units: no filter converges on exact ones
_MODEL_ERROR = (1e-4,) * 4 + (1e-3,) * 4  # of the state per control step, SI units: what no robot of the track explains
_FACTOR_WALK = 1e-3  # per control step: lets factors recover from errors of the linearization
_EVIDENCE = 3.0  # of a longer delay over a shorter one, as a difference of log-likelihoods


class TrackFilter:
    """Estimates the hidden parameters of a track from reported states and commanded forces, in one episode or in B at once.

    | attribute | shape | meaning |
    |---|---|---|
    | `x` | (8,), or (B, 8) as that of `reset` | the state |
    | `factors` | (..., 3) | on the nominal values of what `ROBOT_FACTORS` names |
    | `covariance` | (..., 17, 17) | of all that is estimated |
    | `deviations` | (..., 3) | standard deviations of `factors` |
    | `delay` | (...) | control steps from a command to its force |
    """

    disturbance = 0.0  # it has factors instead

    def __init__(self, task: Task, params: Robot, track: Randomization):
        if not params.TRACK_FILTERS:
            raise ValueError("filters for tracks do not support robots with wheels; give lqr, trajopt or nmpc")
        self._params, self._track, self._dt = params, track, task.control_dt
        low, high = track.delay_steps(task.control_dt)
        self._delays = np.arange(low, high + 1)
        self._low, self._high = np.array([getattr(track, name) for name in ROBOT_FACTORS]).T
        errors = np.repeat((track.odometry_drift, track.lean_bias, track.lean_rate_bias), 2)
        self._prior = np.concatenate([np.full(8, _WIDE), (self._high - self._low) / np.sqrt(12), errors]) ** 2
        self._walk = np.array([*_MODEL_ERROR, *[_FACTOR_WALK] * 3, *[0] * 6]) ** 2
        self._noise = np.diag(np.maximum(track.noise, _LEAST_NOISE)) ** 2

    def reset(self, x: np.ndarray, c: np.ndarray | None = None) -> None:
        """Starts an episode whose first sensor reading is state x (8,), or B episodes (B, 8). It ignores c."""
        one_for_each = (*x.shape[:-1], len(self._delays))
        calls = -(-int(np.prod(one_for_each)) // LANES)
        count = calls * LANES
        steps = _control_steps(self._params, self._dt)
        self._before, self._held = np.zeros((count, steps.width)), np.zeros((count, 2))
        self._after, self._slopes = np.zeros((count, 8)), np.zeros((count, steps.jacobian_at.nnz()))
        self._slopes_at = steps.jacobian_at.get_triplet()
        self._step = InPlace(steps.jacobian.map(calls), [self._before, self._held], [self._after, self._slopes])
        middle = np.concatenate([np.zeros(8), (self._low + self._high) / 2, np.zeros(6)])
        self._z, self._p = np.tile(middle, (*one_for_each, 1)), np.tile(np.diag(self._prior), (*one_for_each, 1, 1))
        self._z[..., _X] = x[..., None, :]
        self._likelihood = np.zeros(one_for_each)
        self._best = np.zeros(x.shape[:-1], np.int64)
        self._commands = [np.zeros((*x.shape[:-1], 2))] * (self._delays[-1] + 1)  # the latest first
        self._correct(x, 0.0)

    def update(self, t: float, x: np.ndarray, u: np.ndarray) -> None:
        """Takes the reported state x (..., 8) at the episode's time t, s, and the force u (..., 2), N, asked for before."""
        self._commands = [np.asarray(u, np.float64), *self._commands[:-1]]
        forces = np.stack([self._commands[delay] for delay in self._delays], -2)
        count = self._likelihood.size
        self._before[:count] = self._z[..., : _FACTORS.stop].reshape(count, -1)
        self._held[:count] = forces.reshape(-1, 2)
        self._step()
        slopes = np.zeros((*forces.shape[:-1], 8, _SIZE))
        rows, columns = self._slopes_at
        slopes[..., rows, columns] = self._slopes[:count].reshape(*forces.shape[:-1], -1)
        # Factors multiply each other: what they move x by is wrong by about the share that they are uncertain by.
        of_factors, moved = self._p[..., _FACTORS, _FACTORS], slopes[..., _FACTORS]
        share = np.trace(of_factors, axis1=-2, axis2=-1)[..., None]
        second_order = share * np.einsum("...ij,...jl,...il->...i", moved, of_factors, moved)
        self._z[..., _X] = self._after[:count].reshape(*forces.shape[:-1], 8)
        self._p[..., _X, :] = slopes @ self._p
        self._p[..., _X] = self._p @ slopes.swapaxes(-1, -2)
        spread = np.diagonal(self._p, axis1=-2, axis2=-1)
        index = np.arange(_SIZE)
        self._p[..., index, index] += np.where(spread < self._prior, self._walk, 0.0)
        self._p[..., index[_X], index[_X]] += second_order
        self._likelihood += self._correct(x, t)
        likely = self._likelihood >= self._likelihood.max(-1, keepdims=True) - _EVIDENCE
        self._best = np.argmax(likely, -1)

    def _correct(self, x: np.ndarray, t: float) -> np.ndarray:
        """Corrects all filters by what sensors report, and says how likely each found it."""
        h = np.eye(8, _SIZE)
        h[range(8), [11, 12, 13, 14, 11, 12, 15, 16]] = [t, t, 1, 1, 1, 1, 1, 1]
        missed = np.asarray(x, np.float64)[..., None, :] - self._z @ h.T
        self._z, self._p, spread = _corrected(self._z, self._p, h, missed, self._noise)
        self._z[..., _FACTORS] = np.clip(self._z[..., _FACTORS], self._low, self._high)
        whitened = np.einsum("...i,...i->...", missed, np.linalg.solve(spread, missed[..., None])[..., 0])
        return -0.5 * (whitened + np.linalg.slogdet(spread)[1])

    def _believed(self, each: np.ndarray) -> np.ndarray:
        """The values of the likeliest filter, from the values (..., filters, n) of all filters."""
        return np.take_along_axis(each, self._best[..., None, None], -2)[..., 0, :]

    @property
    def x(self) -> np.ndarray:
        return self._believed(self._z)[..., _X]

    @property
    def factors(self) -> np.ndarray:
        return self._believed(self._z)[..., _FACTORS]

    @property
    def covariance(self) -> np.ndarray:
        return np.take_along_axis(self._p, self._best[..., None, None, None], -3)[..., 0, :, :]

    @property
    def deviations(self) -> np.ndarray:
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)[..., _FACTORS])

    @property
    def delay(self) -> np.ndarray:
        return self._delays[self._best]

    def when_free(self) -> np.ndarray:
        """The state (..., 8) in which the next command will begin to act."""
        x, share = self.x, self.factors[..., 2:]
        robot = self.robot
        for age in range(self._delays[-1], 0, -1):  # of commands that have not begun to act, the earliest first
            if (waits := self.delay >= age).any():
                forces = share * self._commands[age - 1]
                after = robot.step(x, forces, self._dt, robot.substeps(self._dt))
                x = np.where(waits[..., None], after, x)
        return x

    @property
    def robot(self) -> Robot:
        """The estimated robot, on the slipperiest floor of the track; of B episodes its numbers are (B,)."""
        mass, height, force = self.factors.T if self.factors.ndim > 1 else self.factors.tolist()
        return self._track.robot(self._params, (mass, 1.0, height, 1.0, 1.0, 0.0, force, self._track.friction[0]))


@lru_cache(maxsize=16)
def _control_steps(params: Robot, dt: float) -> Stage:
    """The state x after a control step of dt, s, of z = (x, factors) and the commanded force p."""
    z, force = casadi.SX.sym("z", _FACTORS.stop), casadi.SX.sym("u", 2)
    mass, height, share = casadi.vertsplit(z[_FACTORS])
    robot = Randomization().robot(params, (mass, 1.0, height, 1.0))
    rates = casadi.densify(dt * casadi.SX(robot.derivative(z[_X], share * force)))
    return Stage.of_steps("filter", casadi.Function("rates", [z, force], [rates], {"cse": True}), robot.substeps(dt), 1)


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


_SHARE = 0.1  # of the force limit: what the force of a wheel may differ by, if no log says it
_FAST = 100.0  # m/s, at which dry friction has its full size
_LASTS = 0.5  # s after which little of this difference is left
_ACCELEROMETER_BIAS = 0.2  # m/s², standard deviation of its bias
_LEFT = 0.03  # m/s², the same of what is left of a bias that was identified
_OF_GYROSCOPE, _OF_BOTH = np.eye(9, 3), np.eye(9, 5)
"""Which of the sensors feel each bias: the gyroscope's three, and two of the accelerometer."""
_DRAWN = 256  # starts that tell what to expect of one
_KNOWN = 1e-3  # standard deviation of what they all share, SI units


class SensorFilter:
    """Estimates the state `x` (11,) of a robot with wheels from its sensors and the forces of its wheels.

    The robot and its delay are known: `factors` and `delay` are those of a `TrackFilter` that has nothing to estimate.

    | attribute | shape | meaning |
    |---|---|---|
    | `model` | | CasADi function of the state and the wheels' forces; see below |
    | `model_variance` | (14,) | what the model does not explain, per control step |
    | `reading_variance` | (9,) | the noise of what sensors read over a control step |

    `model` takes x (11,) and u (3,), N. It returns the rates of x over ideal readings (9,), and their Jacobian (20, 11) with
    respect to x.
    """

    factors, delay, disturbance = np.ones(3), 0, 0.0
    model_variance = np.array([0] * 4 + [1e-3] * 4 + [0] + [1e-3] * 2 + [0] * 3) ** 2

    def __init__(self, task: Task, params: Robot, errors: Mapping[str, float] | None = None):
        """Makes the filter; `reset` starts it.

        Args:
            task: whose control steps it follows.
            params: the robot.
            errors: what `ballbot identify` found of sensors and model, by the names in its numbers.json: "gyro noise",
                "accel noise", "wheel_angle noise", "accel_x bias", …, "speed drift" and "lean rate drift". Default, and for
                names that are missing, those of `ballbot_gym.robot.sensors`, whose noise is the least that is expected.
        """
        self._task, self._params, self._dt = task, params, task.control_dt
        self.model, (self._after, self._over_step) = _robot_and_sensors(params), _control_step(params, task.control_dt)
        samples = Sensors(params, task.control_dt).samples
        noise = [Sensors.GYROSCOPE_NOISE**2 / samples] * 3 + [Sensors.ACCELEROMETER_NOISE**2 / samples] * 3
        self._sensor_variance = np.array([*noise, *[Sensors.TICK**2 / 6] * 3])  # of the difference of two roundings
        self.reading_variance = self._sensor_variance.copy()
        self._bias = np.zeros(9)
        self._set_errors(errors or {})
        self._noise = np.diag(self.reading_variance)

    def reset(self, seen: np.ndarray, c: np.ndarray) -> None:
        """Starts an episode with constants c (nc,), whose first observation is `seen` (no,)."""
        mean, deviations = self.expected_start(c)
        self._z, self._p = np.concatenate([seen[9:11], mean[2:]]), np.diag(deviations) ** 2
        found, slopes = self.model(self._z[:11], np.zeros(3))
        self._correct(seen, found[11:], slopes[11:, :])

    def update(self, t: float, seen: np.ndarray, u: np.ndarray) -> None:
        """Takes what sensors show (no,) at the time t, s, after a control step with the wheels' forces u (3,), N."""
        u = np.clip(u, -self._params.force_limit, self._params.force_limit)
        expected, slopes = self._over_step(self._z[:11], u)
        self._correct(seen, expected, slopes)
        after, slopes = self._after(self._z[:11], u)
        self._z[:11], slopes = np.array(after)[:, 0], np.array(slopes)
        self._p[:11] = slopes @ self._p[:11]
        self._p[:, :11] = self._p[:, :11] @ slopes.T
        self._p += np.diag(self.model_variance)

    def _set_errors(self, errors: Mapping[str, float]) -> None:
        for i, name in enumerate(("gyro", "accel", "wheel_angle")):
            if (noise := errors.get(f"{name} noise")) is not None:
                # an angle in the control step is the difference of two
                own = noise**2 * (2 if name == "wheel_angle" else 1)
                self.reading_variance[3 * i : 3 * i + 3] = np.maximum(self.reading_variance[3 * i : 3 * i + 3], own)
        self._bias[3:6] = [errors.get(f"accel_{axis} bias", 0.0) for axis in "xyz"]
        if "speed drift" in errors and "lean rate drift" in errors:
            speeds, rates = (self._dt * errors[f"{name} drift"] ** 2 for name in ("speed", "lean rate"))
            self.model_variance = np.array([0] * 4 + [speeds] * 2 + [rates] * 2 + [0] + [rates] * 2 + [0] * 3)

    def expected_start(self, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is expected (14,) where an episode with constants c (nc,) begins, and its standard deviations."""
        draws = np.random.default_rng(0).random((_DRAWN, self._task.state_draws))
        starts = np.array([self._task.start(tuple(z), tuple(c), self._params) for z in draws.tolist()])
        starts[:, :2] = 0.0  # which sensors report
        deviations = [*np.maximum(starts.std(0), _KNOWN), *[Sensors.GYROSCOPE_BIAS] * 3]
        return np.concatenate([starts.mean(0), np.zeros(3)]), np.array(deviations)

    def _correct(self, seen: np.ndarray, expected: Any, slopes: Any, of_biases: np.ndarray = _OF_GYROSCOPE) -> None:
        """Corrects by what sensors show instead of readings, of wheels speeds, and their Jacobian.

        Args:
            seen: (no,) what sensors show.
            expected: (9,) what they would show without biases.
            slopes: (9, 11 or more) its derivatives in the state, and in all that follows the k biases.
            of_biases: (9, k) where the biases are felt.
        """
        turned = np.repeat([1.0, self._dt], (6, 3))
        missed = np.asarray(seen[:9], np.float64) * Sensors.SCALE - self._bias - turned * np.array(expected)[:, 0]
        missed -= of_biases @ self._z[11 : 11 + of_biases.shape[1]]
        slopes = turned[:, None] * np.array(slopes)
        h = np.hstack([slopes[:, :11], of_biases, slopes[:, 11:]])
        self._z, self._p, _ = _corrected(self._z, self._p, h, missed, self._noise)

    @property
    def x(self) -> np.ndarray:
        return self._z[:11].copy()

    def when_free(self) -> np.ndarray:
        """The state (11,) in which the next command will act, which is the present one."""
        return self.x


class _DisturbanceFilter(SensorFilter):
    """A `SensorFilter` that also estimates what a model with dry friction has wrong: two biases, and the wheels' forces.

    No model has dry friction exactly near rest. So the filter estimates by how much the force of each wheel differs from
    that of the model. Controllers subtract this `disturbance` (3,), N, from their forces. It fades: a difference that lasted
    would explain every lean, and so hide a bias. The biases are those of the accelerometer across the body's axis. They
    include errors of where the centre of mass is, because the motion alone shows how far a centre of mass leans.

    `ballbot identify` estimates no forces that last, so what they do to speeds and lean rates is in the drifts that it finds.
    Here these drifts and the dry friction say how large the forces are, and there is no other drift of these speeds: the
    accelerometer feels a force, but it would not feel a drift, and the filter would not believe it. What jumps from step to
    step, such as the resistance of rollers that meet the ball one by one, is the "force drift" of the log.

    Such jumps turn the robot within a control step about its axis, about which it is light. So the "gyro noise" of the log is
    taken for `gyro_z` alone. Across the axis the gyroscope is as exact as its sensor: if it were believed less there, lean
    rates would be wrong for seconds, and a robot would rest away from where it should. At first, however, a lean may be wrong
    by 0.1 rad, and what that misses would be taken for an error of an exact gyroscope. So the noise of the log fades there.
    """

    def __init__(self, task: Task, params: Robot, errors: Mapping[str, float] | None = None):
        errors = errors or {}
        super().__init__(task, params, {name: each for name, each in errors.items() if not name.endswith(" drift")})
        self._first_noise = self._noise
        self.reading_variance[:2] = self._sensor_variance[:2]
        self._force = (_SHARE * params.force_limit) ** 2
        if {"speed drift", "lean rate drift"} <= set(errors):
            robot: Any = params
            friction = _FAST * robot.axle_drag(_FAST)  # no model says in which direction it holds a wheel at rest
            self._force = self._drifting(errors["speed drift"], errors["lean rate drift"]) + friction**2
        self._gust = errors.get("force drift", 0.0) ** 2 / task.control_dt
        identified = {"accel_x bias", "accel_y bias"} <= set(errors)
        self._of_bias = (_LEFT if identified else _ACCELEROMETER_BIAS) ** 2

    def reset(self, seen: np.ndarray, c: np.ndarray) -> None:
        mean, deviations = self.expected_start(c)
        start = np.concatenate([seen[9:11], mean[2:], np.zeros(5)])
        self._noise = self._first_noise.copy()
        # Dry friction is far from linear between rest and the first speeds. So what the encoders say of these comes first.
        for _ in range(2):
            self._z, self._p = start.copy(), np.diag([*deviations**2, *[self._of_bias] * 2, *[self._force] * 3])
            found, slopes = self._with_slopes(self.model, np.zeros(3))
            self._correct(seen, found[11:], slopes[11:], _OF_BOTH)
            start[4:6] = self._z[4:6]
        self.disturbance = self._z[16:].copy()

    def update(self, t: float, seen: np.ndarray, u: np.ndarray) -> None:
        limit, lasts = self._params.force_limit, math.exp(-self._dt / _LASTS)
        u = np.clip(u, -limit, limit)
        self._correct(seen, *self._with_slopes(self._over_step, u), _OF_BOTH)
        after, slopes = self._with_slopes(self._after, u)
        moves = np.diag([*[1.0] * 16, *[lasts] * 3])
        moves[:11, :11], moves[:11, 16:] = slopes[:, :11], slopes[:, 11:]
        self._z[:11], self._z[16:] = after[:, 0], lasts * self._z[16:]
        self._p = moves @ self._p @ moves.T
        self._p[:11, :11] += self._gust * slopes[:, 11:] @ slopes[:, 11:].T
        self._p += np.diag([*self.model_variance, 0.0, 0.0, *[(1 - lasts**2) * self._force] * 3])
        self._noise += (1 - lasts) * (np.diag(self.reading_variance) - self._noise)
        self.disturbance = self._z[16:].copy()

    def _drifting(self, speed: float, lean_rate: float) -> float:
        """Variance of the force of each wheel, N², that makes speeds and lean rates drift at rest, by at least this much."""
        x = np.zeros(11)
        still, *moved = (np.array(self.model(x, u)[0])[4:8, 0] for u in (np.zeros(3), *np.eye(3)))
        per_force = np.sum((np.array(moved) - still) ** 2, axis=0)  # of three independent forces of 1 N
        return float(np.max(np.square([speed, speed, lean_rate, lean_rate]) / per_force) / (2 * _LASTS))

    def _with_slopes(self, function: casadi.Function, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The value (n, 1) of a function at the estimate, and its slopes (n, 14) in the state and in the wheels' forces."""
        x, force, step = self._z[:11], u + self._z[16:], 1e-3 * self._params.force_limit
        value, slopes = function(x, force)
        moved = [np.array(function(x, force + step * unit)[0])[:, 0] for unit in np.eye(3)]
        by_force = (np.stack(moved, axis=1) - np.array(value)) / step
        return np.array(value), np.hstack([np.array(slopes), by_force])


class StateFromSensors(gymnasium.Wrapper):
    """Wrapper of an env that observes sensors: it returns the observation of the state that `SensorFilter` estimates."""

    def __init__(self, env: gymnasium.Env):
        """Args: env: a `BallbotEnv` with observation="sensors" and without history, wrapped or not."""
        super().__init__(env)
        ballbot: Any = env.unwrapped
        if not isinstance(ballbot, BallbotEnv) or ballbot.observation != "sensors" or ballbot.history:
            raise ValueError('StateFromSensors takes a BallbotEnv with observation="sensors" and without history')
        self._task, self._params = ballbot.task, ballbot.params
        self.observation_space = observation_space(ballbot.task, ballbot.params)
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
        self._steps += 1
        self.filter.update(self._steps * self._task.control_dt, seen, info["force"])
        return self._state(info), reward, terminated, truncated, info

    def _state(self, info: dict[str, Any]) -> np.ndarray:
        c = self._task.at(info["constants"], self._steps * self._task.control_dt)
        return np.array(self._task.seen(self.filter.x, c, self._params), np.float32)


@lru_cache(maxsize=16)
def _robot_and_sensors(params: Any) -> casadi.Function:
    """(x, u) -> rates of the state x (11,) over ideal readings (9,), under the wheels' forces u (3,), N, and their Jacobian
    (20, 11) with respect to x.
    """
    x, u = casadi.SX.sym("x", 11), casadi.SX.sym("u", 3)
    state, forces = tuple(casadi.vertsplit(x)), tuple(casadi.vertsplit(u))
    found = casadi.vertcat(*params.derivative(state, forces), *params.readings(state, forces))
    return casadi.Function("robot", [x, u], [found, casadi.densify(casadi.jacobian(found, x))], {"cse": True})


@lru_cache(maxsize=16)
def _control_step(params: Robot, dt: float) -> tuple[casadi.Function, casadi.Function]:
    """(x, u) -> the state after a control step of dt, s, by RK4; and (x, u) -> what `Sensors.mean` gives of it. Each gives
    its Jacobian with respect to x too.
    """
    model, substeps = _robot_and_sensors(params), params.substeps(dt)
    x, u, own = casadi.MX.sym("x", 11), casadi.MX.sym("u", 3), casadi.DM.eye(11)
    after, slopes, h = x, own, dt / substeps
    for _ in range(substeps):
        rates, changes, more, moved = casadi.MX(11, 1), casadi.MX(11, 11), after, slopes
        for weight, share in ((1, 0.5), (2, 0.5), (2, 1.0), (1, 0.0)):
            found, at = model(more, u)
            rate, change = found[:11], at[:11, :] @ moved
            rates, changes = rates + weight / 6 * rate, changes + weight / 6 * change
            more, moved = after + share * h * rate, slopes + share * h * change
        after, slopes = after + h * rates, slopes + h * changes
    (first, at_first), (last, at_last) = model(x, u), model(after, u)
    at_last = at_last @ slopes
    halfway, at_halfway = model(0.5 * (x + after) + dt / 8 * (first - last)[:11], u)
    at_halfway = at_halfway @ (0.5 * (own + slopes) + dt / 8 * (at_first - at_last)[:11, :])
    read, of_read = first + 4 * halfway + last, at_first + 4 * at_halfway + at_last
    return (
        casadi.Function("after", [x, u], [after, slopes]),
        casadi.Function("over", [x, u], [read[11:] / 6, of_read[11:, :] / 6]),
    )
