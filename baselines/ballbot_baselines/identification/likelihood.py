"""How likely a log is for many robots at once, by an extended Kalman filter for each.

The filter's state is that of the robot, and the angles of the wheels where the log has them. Readings are

    y_i = h_i(x, u) + bias_i + noise_i,

with independent noise, so the filter takes the readings of one time one by one, and no matrix is inverted. What the equations
of motion do not explain is white noise on the speeds. For every reading the filter gives the innovation ν, which is the
reading less its prediction from all earlier readings, and the variance S that it expects of ν. The log-likelihood of the log
is −½ Σ (ln 2πS + ν²/S).

A *lane* is one set of numbers for robot, drive and sensors. All lanes are computed together, in machine code where a compiler
is installed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import casadi
import numpy as np
import scipy.interpolate

from ballbot_baselines.solvers.compiled import LANES, InPlace, in_lanes
from ballbot_gym.robot import Ballbot, Kind
from ballbot_gym.tasks.paths import hermite_basis

_STATES = {
    "position_x": "m", "position_y": "m", "lean_x": "rad", "lean_y": "rad",
    "speed_x": "m/s", "speed_y": "m/s", "lean_rate_x": "rad/s", "lean_rate_y": "rad/s",
    "heading": "rad", "heading_rate": "rad/s", "ball_spin": "rad/s",
}  # fmt: skip
_READINGS = {
    "gyro_x": "rad/s", "gyro_y": "rad/s", "gyro_z": "rad/s", "accel_x": "m/s²", "accel_y": "m/s²", "accel_z": "m/s²",
    "wheel_speed_1": "rad/s", "wheel_speed_2": "rad/s", "wheel_speed_3": "rad/s",
}  # fmt: skip
_ANGLES = {"wheel_angle_1": "rad", "wheel_angle_2": "rad", "wheel_angle_3": "rad"}
_COMMANDS = {2: ("command_x", "command_y"), 3: ("command_1", "command_2", "command_3")}
"""Names of the commands of robots by their number of actuators."""
_POSES = {0, 1, 2, 3, 8}  # components of a state without noise of their own: their rates have it
_START = np.array([0.1, 0.1, 0.1, 0.1, 1.0, 1.0, 0.5, 0.5, 0.1, 0.5, 0.5])
"""Standard deviation of each component of a state that is not read, before the first reading, SI units."""
_MOST_LEAD = 0.3  # of a step


@dataclass(frozen=True)
class Readings:
    """What a log holds, in SI units, on its clock.

    | field | shape | meaning |
    |---|---|---|
    | names | m | what is read, see `Readings.readable` |
    | t | (n,) | s, growing |
    | y | (n, m) | readings; NaN where there is none |
    | commands | (n, k) | in units of the robot's action, each from its time until the next |
    | delays | m | s, by which readings are about an earlier time than theirs; () for none |
    | windows | m | s, over which readings are means, about that earlier time; () for none |
    | restarts | | indices of the first readings after gaps |
    | guessed | (n, k) | standard deviation of commands that are not in the log; None where all are |
    """

    names: tuple[str, ...]
    t: np.ndarray
    y: np.ndarray
    commands: np.ndarray
    delays: tuple[float, ...] = ()
    restarts: tuple[int, ...] = ()
    guessed: np.ndarray | None = None
    windows: tuple[float, ...] = ()

    @staticmethod
    def readable(robot: Ballbot) -> dict[str, str]:
        """The quantities that a log of a robot may have, by name, with their units.

        `lean_x` is γ and `lean_y` is θ, so a positive lean is towards positive x or y. `gyro` and `accel` are in the body's
        axes at its centre of mass, as `ballbot_gym.robot.sensors` describes them; they and the wheels are for robots with
        wheels.
        """
        states = dict(list(_STATES.items())[: robot.state_size])
        return states | (_READINGS | _ANGLES if robot.SENSORS else {})

    @staticmethod
    def commanded(robot: Ballbot) -> tuple[str, ...]:
        """Names of the commands of a robot: of the force on the ball along x and y, or of each wheel."""
        return _COMMANDS[robot.action_size]

    @staticmethod
    def group_of(name: str) -> str:
        """The kind of a quantity, whose sensors have one noise: "lean" of "lean_x"."""
        return name[:-2]

    def between(self, first: int, last: int) -> "Readings":
        """The readings from index `first` until before `last`."""
        cut, restarts = slice(first, last), tuple(i - first for i in self.restarts if first < i < last)
        guessed = None if self.guessed is None else self.guessed[cut]
        return Readings(
            self.names, self.t[cut], self.y[cut], self.commands[cut], self.delays, restarts, guessed, self.windows
        )

    @property
    def dt(self) -> float:
        """The median time between two readings, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def units(self) -> dict[str, str]:
        """The SI units of readings and commands by name."""
        every, commands = _STATES | _READINGS | _ANGLES, _COMMANDS[self.commands.shape[1]]
        return {name: every[name] for name in self.names} | dict.fromkeys(commands, "N")

    def predicted(
        self, robot: Ballbot, x: np.ndarray, forces: np.ndarray, starts: np.ndarray, steps: list[int]
    ) -> np.ndarray:
        """(len(steps), s, m) what perfect sensors without a bias read later, by the equations of motion alone.

        Args:
            robot: whose equations they are.
            x: (s, ...) states of its filter at the starts.
            forces: (n, k) that it applies, N.
            starts: (s,) indices of readings.
            steps: numbers of readings after the starts, at least 1.
        """
        rates, state, later = _rates_with_angles(robot, self.names), tuple(x.T), {}
        for j in range(max(steps)):
            u, dt = tuple(forces[starts + j].T), self.t[starts + j + 1] - self.t[starts + j]
            with np.errstate(all="ignore"):  # some robots fall beyond all bounds
                state = robot.step(state, u, dt, robot.substeps(self.dt), rates)
                if j + 1 in steps:
                    expected = _expected_readings(robot, self.names, state, u)
                    later[j + 1] = np.stack(np.broadcast_arrays(*expected), axis=-1)
        return np.stack([later[each] for each in steps])


class Lanes(NamedTuple):
    """B sets of numbers."""

    numbers: np.ndarray
    """(B, ...) of the robots, see `Lanes.numbers_of`."""
    strength: np.ndarray
    """(B,) ratio of the applied force to the command."""
    delay: np.ndarray
    """(B,) s, by which the force follows the command later than the readings do, on average, the lag included."""
    lag: np.ndarray
    """(B,) s, the part of it by which a first-order response follows; below 0 it is ahead, by 0.3 of a step at most."""
    bias: np.ndarray
    """(B, m) of the readings."""
    noise: np.ndarray
    """(B, m) standard deviation of the readings' noise."""
    drift: np.ndarray
    """(B, 3) standard deviation of what is added to speeds, to turning rates and to the impulse of each wheel in a second,
    m/s, rad/s and N·s."""

    @staticmethod
    def numbers_of(robot: Ballbot) -> list[float]:
        """The numbers of a robot that filters compute with."""
        return [*robot.numbers(), *(getattr(robot, name) for name in robot.SENSORS)]

    def applied(self, readings: Readings) -> np.ndarray:
        """(n, B, k) the force that the lanes apply from each time of a log to the next.

        It is the mean of the delayed command over that time, followed with a first-order lag as `Randomization.actuate` has
        it.
        """
        t, commands = readings.t, readings.commands
        ends = np.append(t, t[-1] + readings.dt)
        most = _MOST_LEAD * readings.dt
        # below 0 without a kink, where a search would stop
        lag = np.where(self.lag < 0, most * np.tanh(self.lag / most), self.lag)
        impulses = _impulses(ends, commands, ends[:, None] - (self.delay - lag))
        forces = np.diff(impulses, axis=0) / np.diff(ends)[:, None, None]
        dt = np.diff(ends)[:, None]
        share = dt / (dt + np.maximum(lag, -_MOST_LEAD * dt))  # of a response that lags by this time on average
        for i in range(1, len(forces)):
            forces[i] = forces[i - 1] + share[i][:, None] * (forces[i] - forces[i - 1])
        return forces * self.strength[:, None]

    def uncertain(self, readings: Readings) -> np.ndarray:
        """(n, B, k) variance of these forces, N², where commands are `guessed`.

        Each variance is shared among the steps about its delayed time by a cubic B-spline. So it is never negative, as it
        would be after the spline of the commands, and it is as much for all delays: else a log would be likelier for the
        delays that have less of it.
        """
        t, guessed = readings.t, readings.guessed
        if guessed is None:
            return np.zeros((len(t), len(self.delay), readings.commands.shape[1]))
        n = len(t)
        spline = scipy.interpolate.BSpline(np.arange(-2.0, n + 2), guessed**2, 3)
        steps = np.interp(t[:, None] - self.delay, t, np.arange(n))
        return spline(steps.clip(1, n - 2)) * self.strength[:, None] ** 2


def _impulses(ends: np.ndarray, commands: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n + 1, B, k) impulses up to the times `at` (n + 1, B) of commands (n, k), each from one of the ends to the next.

    Held commands make an impulse with kinks, and a likelihood with kinks in the delay, at which a search would stop. So it is
    a cubic spline, which is exact at the ends. A force depends on no later command, because a controller has answered later
    readings with these. So in the last step before its end, and after it, row i of the result extrapolates from the commands
    before.
    """
    dt = np.diff(ends)
    total = np.concatenate([np.zeros((1, commands.shape[1])), np.cumsum(commands * dt[:, None], axis=0)])
    rate = np.concatenate([commands[:1], (commands[1:] + commands[:-1]) / 2, commands[-1:]])
    newest = np.concatenate([commands[:1], commands[:1], commands[1:] + (commands[1:] - commands[:-1]) / 2])
    rows = np.arange(len(ends))[:, None]
    first = np.clip(np.searchsorted(ends, at, side="right") - 1, 0, np.maximum(rows - 1, 0))
    later = np.minimum(first + 1, len(ends) - 1)
    step = dt[np.minimum(first, len(dt) - 1)][..., None]
    s = np.clip((at - ends[first])[..., None] / step, 0.0, 1.0)
    end_rate = np.where((later >= rows)[..., None], newest[np.broadcast_to(rows, at.shape)], rate[later])
    start, start_slope, end, end_slope = hermite_basis(s)
    slopes = start_slope * rate[first] + end_slope * end_rate
    inside = start * total[first] + end * total[later] + step * slopes
    early = np.minimum(at - ends[0], 0.0)[..., None] * commands[0]  # the first command is taken for those before
    return inside + early + np.maximum(at - ends[later], 0.0)[..., None] * end_rate


class Innovations(NamedTuple):
    """What the filters of B lanes found."""

    missed: np.ndarray
    """(n, B, m) ν; 0 where there is no reading."""
    variance: np.ndarray
    """(n, B, m) S; 1 where there is no reading."""
    states: np.ndarray
    """(n, B, s) the states, after the readings of their time."""

    @classmethod
    def of(cls, robot: Ballbot, readings: Readings, lanes: Lanes, factors: np.ndarray | None = None) -> "Innovations":
        """Runs the filters of B lanes over a log.

        Args:
            robot: of the lanes' kind.
            readings: of n times.
            lanes: B of them.
            factors: (B, m + k) on the readings and the commands; default, 1.
        """
        n, lane_count, m = len(readings.t), len(lanes.delay), len(readings.names)
        delays, windows = readings.delays or (0.0,) * m, readings.windows or (0.0,) * m
        times = tuple(zip(delays, windows, strict=True))
        step, size = _step(robot.kind, readings.names, times, robot.substeps(readings.dt))
        packed = 2 * size + size * (size + 1) // 2
        calls = -(-lane_count // LANES)
        count = calls * LANES
        factors = np.ones((lane_count, m + readings.commands.shape[1])) if factors is None else factors
        forces, y = lanes.applied(readings) * factors[:, m:], readings.y[:, None, :] * factors[:, :m]
        uncertain = lanes.uncertain(readings)
        used = np.isfinite(readings.y)
        steps = np.zeros((n, count, 2 * m + 3 * forces.shape[2] + 1))
        steps[:, :lane_count] = np.concatenate(
            [
                np.where(used[:, None, :], y, 0.0),
                np.broadcast_to(used[:, None, :], y.shape),
                np.concatenate([forces[:1], forces[:-1]]),
                forces,
                uncertain,
                np.broadcast_to(
                    np.diff(readings.t, append=readings.t[-1] + readings.dt)[:, None, None], (n, lane_count, 1)
                ),
            ],
            axis=-1,
        )
        constants = np.zeros((count, lanes.numbers.shape[1] + 2 * m + 3))
        constants[:lane_count] = np.hstack([lanes.numbers, lanes.bias, lanes.noise**2, lanes.drift**2])
        constants[lane_count:], steps[:, lane_count:] = constants[:1], steps[:, :1]  # what fills the last call
        now, found = np.zeros_like(steps[0]), np.zeros((count, 2 * m + size))
        pair = np.zeros((count, packed)), np.zeros((count, packed))
        run = [InPlace(step.map(calls), [a, constants, now], [b, found]) for a, b in (pair, pair[::-1])]
        every = np.empty((n, lane_count, 2 * m + size))
        restarts = {0, *readings.restarts}
        for i in range(n):
            if i in restarts:
                pair[i % 2][:] = _starts(readings, i, y, size, count)
            now[:] = steps[i]
            run[i % 2]()
            every[i] = found[:lane_count]
        return cls(every[..., :m], every[..., m : 2 * m], every[..., 2 * m :])


def _starts(readings: Readings, i: int, y: np.ndarray, size: int, count: int) -> np.ndarray:
    """(count, ...) what filters hold that begin at index i, of a log with y (n, B, m); see `_step`."""
    x, spread = np.zeros((count, size)), np.full(size, 0.1)
    spread[: min(size, len(_START))] = _START[:size]
    places = _places(readings.names, size)
    for j, name in enumerate(readings.names):
        later = i + int(np.argmax(np.isfinite(readings.y[i:, j])))  # the first reading, which may come later
        if name in places and np.isfinite(readings.y[later, j]):
            x[: y.shape[1], places[name]], x[y.shape[1] :, places[name]] = y[later, :, j], y[later, 0, j]
    upper = np.diag(spread**2)[np.triu_indices(size)]
    return np.hstack([x, np.broadcast_to(upper, (count, len(upper))), x])


def _places(names: tuple[str, ...], size: int) -> dict[str, int]:
    """Components of the filter's state that are read directly."""
    angles = _angles(names)
    states = list(_STATES)[: size - len(angles)]
    return {name: i for i, name in enumerate([*states, *angles])}


def _angles(names: tuple[str, ...]) -> list[str]:
    return [name for name in _ANGLES if name in names]


def _rates_with_angles(robot: Any, names: tuple[str, ...]) -> Callable[[Any, Any], tuple[Any, ...]]:
    """The equations of motion of a filter's state, (x, u) -> ẋ: those of the robot, and of wheels whose angles are read."""
    states, angles = len(robot.STATE), _angles(names)

    def rates(x: tuple[Any, ...], u: tuple[Any, ...]) -> tuple[Any, ...]:
        speeds = robot.readings(x[:states], u)[6:] if angles else ()
        return (*robot.derivative(x[:states], u), *(speeds[int(name[-1]) - 1] for name in angles))

    return rates


def _expected_readings(robot: Any, names: tuple[str, ...], x: tuple[Any, ...], u: tuple[Any, ...]) -> list[Any]:
    """What perfect sensors without a bias read in a filter's state x under u."""
    places, sensed = _places(names, len(x)), {}
    if set(names) & set(_READINGS):
        sensed = dict(zip(_READINGS, robot.readings(x[: len(robot.STATE)], u), strict=True))
    return [sensed[name] if name in sensed else x[places[name]] for name in names]


@lru_cache(maxsize=8)
def _step(
    kind: Kind, names: tuple[str, ...], times: tuple[tuple[float, float], ...], substeps: int
) -> tuple[casadi.Function, int]:
    """A step of `LANES` filters, and the size of their state.

    (state and packed covariance before the readings, and the state at the readings before; constants; readings, forces before
    and after, the variance of the latter, and the time until the next readings, s) -> (state and packed covariance before the
    next readings, and the state; innovations, their variances, and the state)

    Dry friction stops a wheel within milliseconds. Backwards in time, that grows without bounds. So for robots with dry
    friction, readings of the past are about states between the last two, and covariances follow the steps of the states.
    """
    symbol, robot = casadi.SX.sym, kind.robot
    states, actions, m = len(robot.STATE), len(robot.ACTION), len(names)
    size, count = states + len(_angles(names)), len(kind.numbers) + len(robot.SENSORS)
    held, constants = symbol("held", 2 * size + size * (size + 1) // 2), symbol("constants", count + 2 * m + 3)
    step = symbol("step", 2 * m + 3 * actions + 1)
    numbers, bias, variance, drift = _split(constants, count, m, m, 3)
    y, used, before, u, uncertain, dt = _split(step, m, m, actions, actions, actions, 1)
    model = Kind(robot, (*kind.numbers, *robot.SENSORS)).model(numbers)
    rates, x = _rates_with_angles(model, names), held[:size]
    stiff = robot.DRY_FRICTION
    past = _between(rates, x, held[-size:], before, dt[0]) if stiff else lambda ago: _ago(rates, x, before, ago)
    read_at = cache(lambda ago: _expected_readings(model, names, _tuple(past(ago)), before))
    means = casadi.vertcat(*[_mean(read_at, i, *each) for i, each in enumerate(times)])
    if stiff:
        slopes = _slopes_at(model, names, before, [past(delay) for delay, _ in times])
    else:
        slopes = casadi.jacobian(casadi.vertcat(*[read_at(delay)[i] for i, (delay, _) in enumerate(times)]), x)
    z, p, missed, expected_variance = _corrected(
        x, _unpacked(held[size:-size], size), (means, slopes), (y, used, bias, variance)
    )
    at = symbol("x, u", size + actions)
    slopes = casadi.jacobian(casadi.vertcat(*rates(_tuple(at[:size]), _tuple(at[size:]))), at)
    slopes = dt[0] * casadi.substitute(slopes, at, casadi.vertcat(z, *u))
    moved, by_force = slopes[:, :size], slopes[:, size:]
    halvings = math.ceil(math.log2(substeps)) if stiff else 0
    part = moved / 2**halvings
    transition = casadi.SX.eye(size) + part + part @ part / 2
    for _ in range(halvings):
        transition = transition @ transition
    speeds = [0.0 if i in _POSES or i >= states else drift[0] if i in (4, 5) else drift[1] for i in range(size)]
    p = transition @ p @ transition.T + dt[0] * casadi.diag(casadi.vertcat(*speeds))
    unknown = casadi.vertcat(*uncertain) + drift[2] / dt[0]
    p = p + by_force @ casadi.diag(unknown) @ by_force.T
    after = model.step(_tuple(z), u, dt[0], substeps, rates)
    packed = casadi.vertcat(*after, *(p[i, j] for i in range(size) for j in range(i, size)), z)
    outputs = [packed, casadi.vertcat(*missed, *expected_variance, z)]
    function = casadi.Function(
        "filter", [held, constants, step], [casadi.densify(each) for each in outputs], {"cse": True}
    )
    return in_lanes("identify", (function,))[0], size


def _ago(rates: Callable[[Any, Any], tuple[Any, ...]], x: Any, u: tuple[Any, ...], ago: float) -> Any:
    """The state that was before x (n,) by `ago`, s, by the midpoint rule; u held."""
    if ago == 0:
        return x
    middle = x - ago / 2 * casadi.vertcat(*rates(_tuple(x), u))
    return x - ago * casadi.vertcat(*rates(_tuple(middle), u))


def _between(rates: Callable[[Any, Any], tuple[Any, ...]], x: Any, last: Any, u: tuple[Any, ...], dt: Any) -> Callable:
    """How x (n,) was some time ago, s, if it was `last` (n,) before dt: a cubic between both, or earlier a line."""
    now, then = (casadi.vertcat(*rates(_tuple(each), u)) for each in (x, last))

    def past(ago: float) -> Any:
        of_last, of_then, of_x, of_now = hermite_basis(1 - casadi.fmin(ago / dt, 1))
        earlier = casadi.fmax(ago - dt, 0)
        return of_x * x + of_last * last + dt * (of_now * now + of_then * then) - earlier * then

    return past


def _slopes_at(robot: Any, names: tuple[str, ...], u: tuple[Any, ...], states: list[Any]) -> Any:
    """(m, n) how each reading changes with the state, at the state (n,) that it is about."""
    at = casadi.SX.sym("at", states[0].shape[0])
    slopes = casadi.jacobian(casadi.vertcat(*_expected_readings(robot, names, _tuple(at), u)), at)
    return casadi.vertcat(*[casadi.substitute(slopes[i, :], at, state) for i, state in enumerate(states)])


def _mean(read_at: Callable[[float], list[Any]], i: int, delay: float, window: float) -> Any:
    """Reading i as a mean over a window, s, about an earlier time, by Simpson's rule."""
    if window == 0:
        return read_at(delay)[i]
    first, last = read_at(delay + window / 2)[i], read_at(max(delay - window / 2, 0.0))[i]
    return (first + 4 * read_at(delay)[i] + last) / 6


def _corrected(
    x: Any, p: Any, expected: tuple[Any, Any], read: tuple[Any, ...]
) -> tuple[Any, Any, list[Any], list[Any]]:
    """The state and covariance after readings one by one, whose `expected` values have a Jacobian; ν and S of each."""
    (value, slopes), (y, used, bias, variance) = expected, read
    z, missed, variances = x, [], []
    for i in range(slopes.shape[0]):
        across = p @ slopes[i, :].T
        spread = slopes[i, :] @ across + variance[i]
        error = used[i] * (y[i] - bias[i] - value[i] - slopes[i, :] @ (z - x))
        missed.append(error)
        variances.append(used[i] * spread + (1 - used[i]))
        z = z + across * error / spread
        p = p - used[i] / spread * across @ across.T
    return z, p, missed, variances


def _split(column: Any, *sizes: int) -> list[tuple[Any, ...]]:
    parts, first = [], 0
    for size in sizes:
        parts.append(_tuple(column[first : first + size]))
        first += size
    return parts


def _tuple(column: Any) -> tuple[Any, ...]:
    return tuple(casadi.vertsplit(column))


def _unpacked(upper: Any, size: int) -> Any:
    """The symmetric matrix of an upper triangle by rows."""
    rows, at = [[upper[0]] * size for _ in range(size)], 0
    for i in range(size):
        for j in range(i, size):
            rows[i][j] = rows[j][i] = upper[at]
            at += 1
    return casadi.vertcat(*[casadi.horzcat(*row) for row in rows])
