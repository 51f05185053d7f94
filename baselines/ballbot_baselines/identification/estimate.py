"""The numbers of a robot that make a log most likely, with intervals, and what the log does not determine.

Every parameter has a prior: the nominal robot, with the spread that drawings and data sheets usually have. In units z of
these spreads, with z = 0 for the nominal robot, the estimate minimizes

    ½ |z|² − log-likelihood(z),

where the likelihood is that of `likelihood`. Its second derivative is I + H with the Fisher information H of the log, and
the inverse of that is the covariance of z. If an eigenvalue of H is far above 1, the log determines the combination of
parameters that is its eigenvector. If an eigenvalue is below 1, the prior has more information than the log, and the
combination stays near that of the nominal robot.

Intervals are wider than this covariance for two reasons. Innovations of a robot that differs from the equations of motion may
be correlated in time. Then the log says less than H. So the estimate is repeated without each of the blocks of the log in
turn, one Newton step each (the jackknife over blocks, as in Künsch, "The jackknife and the bootstrap for general stationary
observations", 1989), and deviations are those of that spread where it is larger. And a robot may follow the equations very
well with other numbers than those that it has. No log shows that. So every number has an error of the model besides.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize

from ballbot_baselines.identification.likelihood import Innovations, Lanes, Readings
from ballbot_gym.robot import Ballbot

_SPREADS = {
    "body_mass": 0.3, "ball_mass": 0.2, "com_height": 0.2, "inertia": 0.3, "axial_inertia": 0.3, "force_limit": 0.2,
    "wheels.no_load_speed": 0.2, "wheels.inertia": 0.4, "wheels.damping": 0.7, "wheels.spin_friction": 0.7,
    "axle_friction": 1.5,
}  # fmt: skip
"""Standard deviation of the logarithm of a robot's number: 0.2 is about 20 %."""
_SIGNED_SPREADS = {"com_x": 0.01, "com_y": 0.01, "zenith": 0.03}
"""Standard deviation of a robot's number that may have any sign, m and rad; of a `GeneralOmni` alone."""
_MODEL_ERRORS = {
    "com_height": 0.002, "inertia": 0.005, "axial_inertia": 0.005, "force_limit": 0.001, "body_mass": 0.002,
    "ball_mass": 0.002, "wheels.no_load_speed": 0.01, "wheels.inertia": 0.015, "wheels.damping": 0.05,
    "wheels.spin_friction": 0.005,
}  # fmt: skip
"""How far, as a share, the numbers with which the equations follow a robot are from its own. This is about what PyBullet and
MuJoCo, in steps of 1 and 2 ms, differ from the equations; see docs/identify.md."""
_DELAY_ERROR = 3e-4  # s, the same of the delay
_BLOCK = 2.0  # s
_BEGINNING = (
    10.0  # s at the start of each log; the search for the estimate of whole logs starts from that of these parts
)
_DELAY, _LAG = 0.03, 0.005  # s; a lag below 0 has no meaning, but a search needs no end there
_BIASES = {"lean": 0.03, "lean_rate": 0.02, "gyro": 0.02, "accel": 0.2}  # rad, rad/s, rad/s, m/s²
_NOISES = {
    "position": 0.005, "lean": 0.005, "speed": 0.03, "lean_rate": 0.02, "heading": 0.01, "heading_rate": 0.02,
    "ball_spin": 0.05, "gyro": 0.01, "accel": 0.1, "wheel_speed": 0.1, "wheel_angle": 0.002,
}  # fmt: skip
"""Standard deviation of a reading's noise, SI units, at the start of the estimate."""
_DRIFTS = {"speed drift": 0.05, "lean rate drift": 0.05}  # m/s and rad/s in a second
_FORCE_DRIFT = {"force drift": 2.0}  # N·s in a second, of each wheel
_LEAST_DRIFT = 1e-3  # the same: no robot follows equations better
_NOISE_SPREAD = 2.0  # of the logarithm of noises and drifts: next to nothing is known before
_OUTLIER = 5.0  # deviations: one in two million readings is this far by chance
_DIFFERENCE = 0.01  # of z, for derivatives
_ROUNDS = 60
_NEAR = 1e-3  # the squared distance to the minimum, in standard deviations of the estimate, at which the search ends
_DETERMINED = 0.25  # the log determines a parameter if it narrows the prior's interval to this share
_WITHIN_95 = 1.96


class _Parameter(NamedTuple):
    """What is estimated."""

    name: str
    unit: str
    nominal: float
    spread: float
    """Standard deviation of the prior: of the logarithm for a positive number, else in its unit."""
    positive: bool

    def value(self, z: Any) -> Any:
        """The value for z spreads away from the nominal one."""
        if not self.positive:
            return self.nominal + self.spread * z
        with np.errstate(over="ignore"):  # of a search that tries too much
            return self.nominal * np.exp(self.spread * z)


class _Estimate(NamedTuple):
    """A parameter as a log determines it."""

    parameter: _Parameter
    value: float
    low: float
    high: float
    """The 95 % interval, of log and prior together."""
    determined: bool
    """Whether the log determines it, and not the prior alone."""


class _Direction(NamedTuple):
    """A combination of parameters, with the information of the log about it compared with that of the prior."""

    eigenvalue: float
    shares: dict[str, float]
    """Of each parameter in spreads, the largest of them."""


@dataclass(frozen=True)
class Problem:
    """What is estimated from logs.

    | field | meaning |
    |---|---|
    | robot | the nominal robot |
    | names | of the readings |
    | known | names of parameters that are held at their nominal values |
    """

    robot: Ballbot
    names: tuple[str, ...]
    known: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        every = [each.name for each in self._all_parameters()]
        if unknown := [name for name in self.known if name not in every]:
            raise ValueError(f"unknown parameter {unknown[0]!r}; known: {', '.join(map(repr, every))}")

    @property
    def parameters(self) -> tuple[_Parameter, ...]:
        """All that are estimated: each has its name, its unit, its nominal value, the spread of its prior, and `value(z)`.

        The spread is the standard deviation: of the logarithm for a number that is positive, and in its unit for others.
        """
        return tuple(each for each in self._all_parameters() if each.name not in self.known)

    def _all_parameters(self) -> list[_Parameter]:
        robot = [
            _Parameter(name, _UNITS[name], attrgetter(name)(self.robot), spread, positive=True)
            for name, spread in _SPREADS.items()
            if hasattr(self.robot, name) or name.partition(".")[0] in self.robot.PARTS
        ]
        robot += [
            _Parameter(name, _UNITS[name], getattr(self.robot, name), spread, positive=False)
            for name, spread in _SIGNED_SPREADS.items()
            if hasattr(self.robot, name)
        ]
        drive = [
            _Parameter("delay", "s", 0.0, _DELAY, positive=False),
            _Parameter("lag", "s", 0.0, _LAG, positive=False),
        ]
        biases = [
            _Parameter(f"{name} bias", "", 0.0, _BIASES[Readings.group_of(name)], positive=False)
            for name in self.names
            if Readings.group_of(name) in _BIASES
        ]
        noises = [
            _Parameter(f"{name} noise", "", _NOISES[name], _NOISE_SPREAD, positive=True)
            for name in dict.fromkeys(map(Readings.group_of, self.names))
        ]
        every = _DRIFTS | (_FORCE_DRIFT if self.robot.without_dry_friction() != self.robot else {})
        drifts = [_Parameter(name, "", nominal, _NOISE_SPREAD, positive=True) for name, nominal in every.items()]
        return [each for each in [*robot, *drive, *biases, *noises, *drifts] if each.nominal > 0 or not each.positive]

    @property
    def model_errors(self) -> np.ndarray:
        """(p,) standard deviations in spreads, by which z differs from the robot's own because equations are not exact."""
        errors = _MODEL_ERRORS | {"delay": _DELAY_ERROR}
        return np.array([errors.get(each.name, 0.0) / each.spread for each in self.parameters])

    def values(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Values (B,) by name, of lanes z (B, p); those that are known too."""
        held = {each.name: np.full(len(z), each.nominal) for each in self._all_parameters()}
        return held | {each.name: each.value(z[:, i]) for i, each in enumerate(self.parameters)}

    def robot_of(self, values: dict[str, Any]) -> Ballbot:
        """The robot with values by name. If the values are (B,), so are its numbers."""
        own = {name: values[name] for name in (*_SPREADS, *_SIGNED_SPREADS) if name in values and "." not in name}
        if (inertia := getattr(self.robot, "ball_inertia", None)) is not None:
            own["ball_inertia"] = inertia * (own["ball_mass"] / self.robot.ball_mass)
        for part in self.robot.PARTS:
            inner = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(f"{part}.")}
            own[part] = replace(getattr(self.robot, part), **inner)
        return replace(self.robot, **own)

    def z_of(self, robot: Ballbot, delay: float, like: np.ndarray) -> np.ndarray:
        """(p,) of another robot of the same kind, s of delay, and sensors as in `like` (p,)."""
        z = like.copy()
        for i, each in enumerate(self.parameters):
            if each.name in _SPREADS:
                z[i] = np.log(attrgetter(each.name)(robot) / each.nominal) / each.spread
            elif each.name in _SIGNED_SPREADS:
                z[i] = (getattr(robot, each.name) - each.nominal) / each.spread
            elif each.name == "delay":
                z[i] = (delay - each.nominal) / each.spread
        return z

    def lanes(self, z: np.ndarray) -> Lanes:
        """The lanes of z (B, p)."""
        values = self.values(z)
        numbers, none = Lanes.numbers_of(self.robot_of(values)), np.zeros(len(z))
        return Lanes(
            np.stack([np.broadcast_to(number, len(z)) for number in numbers], axis=1),
            values["force_limit"] / self.robot.force_limit,
            values["delay"],
            values["lag"],
            np.stack([values.get(f"{name} bias", none) for name in self.names], axis=1),
            np.stack([values[f"{Readings.group_of(name)} noise"] for name in self.names], axis=1),
            np.stack(
                [np.hypot(values[name], _LEAST_DRIFT) for name in _DRIFTS] + [values.get("force drift", none)], axis=1
            ),
        )

    def information(self, logs: list[Readings], z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The negative log-likelihood of logs at z (p,), its slope (p,), and their Fisher information (p, p).

        With the innovations ν and their variances S of all readings, H = Σ ν' ν'ᵀ / S + ½ S' S'ᵀ / S². The derivatives ν' and
        S' are central differences.
        """
        count = len(z)
        value, slope, curvature = 0.0, np.zeros(count), np.zeros((count, count))
        with np.errstate(all="ignore"):  # of filters that fail
            for log in logs:
                missed, variance, first, second = self._derivatives(log, z)
                value += 0.5 * float(np.sum(np.log(variance) + missed**2 / variance))
                slope += _slopes(missed, variance, first, second).sum(axis=0)
                curvature += _fisher(first, second)
        if not (np.isfinite(value) and np.isfinite(slope).all() and np.isfinite(curvature).all()):
            return np.inf, np.zeros(count), np.eye(count)
        return value, slope, curvature

    def _derivatives(self, log: Readings, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """ν and S (n, m) of a log at z (p,), and their derivatives ν'/√S and S'/S (n, p, m)."""
        count = len(z)
        around = z + _DIFFERENCE * np.vstack([np.zeros((1, count)), np.eye(count), -np.eye(count)])
        found = Innovations.of(self.robot, log, self.lanes(around))
        missed, variance, moved, widened = _differences(found, count)
        return missed, variance, moved * (1 / np.sqrt(variance))[:, None], widened / variance[:, None]

    def blocks(self, logs: list[Readings], z: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Slopes (K, p) and Fisher information (K, p, p) at z (p,) of K blocks of time of logs, each of about `seconds`."""
        slopes, curvatures = [], []
        for log in logs:
            missed, variance, first, second = self._derivatives(log, z)
            slope = _slopes(missed, variance, first, second)
            count = max(1, round((log.t[-1] - log.t[0]) / seconds))
            for own in np.array_split(np.arange(len(log.t)), count):
                slopes.append(slope[own].sum(axis=0))
                curvatures.append(_fisher(first[own], second[own]))
        return np.array(slopes), np.array(curvatures)

    def most_likely(self, logs: list[Readings], watch: Callable[[int], object] = lambda done: None) -> "Found":
        """The most likely parameters of logs with the same readings.

        Readings whose innovations are too large to be noise are left out, and the estimate is repeated from where it was.

        Args:
            logs: one or more of them.
            watch: called with the number of times that the likelihood was computed.

        Raises:
            ValueError: the logs are so far from what the robot can do that the filter fails.
        """
        z, rounds = np.zeros(len(self.parameters)), 0
        beginnings = [log.between(0, int(np.searchsorted(log.t, log.t[0] + _BEGINNING))) for log in logs]
        for part in (beginnings, logs) if sum(log.t[-1] - log.t[0] for log in logs) > 2 * _BEGINNING else (logs,):
            z, _, rounds = _minimum(self, part, z, watch, rounds)
        kept, outliers = zip(*[_without_outliers(self, log, z) for log in logs], strict=True)
        z, found, rounds = _minimum(self, list(kept), z, watch, rounds)
        return Found(self, z, found, rounds, sum(outliers), _widening(*self.blocks(list(kept), z, _BLOCK)))


_UNITS = {
    "body_mass": "kg", "ball_mass": "kg", "com_height": "m", "inertia": "kg·m²", "axial_inertia": "kg·m²",
    "force_limit": "N", "wheels.no_load_speed": "rad/s", "wheels.inertia": "kg·m²", "wheels.damping": "N·m·s",
    "wheels.spin_friction": "N·m", "axle_friction": "N·m", "com_x": "m", "com_y": "m", "zenith": "rad",
}  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What was found from logs.

    | field | shape | meaning |
    |---|---|---|
    | problem | | what was asked |
    | z | (p,) | the estimate in spreads |
    | information | (p, p) | H, of the log alone, in spreads |
    | rounds | | how often the likelihood was computed |
    | outliers | | readings that were left out because their innovations are too large to be noise |
    | widening | (p,) | by how much the deviations exceed those of uncorrelated innovations, at least 1 |
    """

    problem: Problem
    z: np.ndarray
    information: np.ndarray
    rounds: int
    outliers: int = 0
    widening: np.ndarray | float = 1.0

    @property
    def covariance(self) -> np.ndarray:
        """(p, p) of z, from log, prior and the error of the model."""
        own, widening = np.linalg.inv(self.information + np.eye(len(self.z))), np.ones(len(self.z)) * self.widening
        return widening[:, None] * own * widening + np.diag(self.problem.model_errors**2)

    @property
    def robot(self) -> Ballbot:
        """The estimated robot."""
        return self.problem.robot_of(
            {name: float(value[0]) for name, value in self.problem.values(self.z[None]).items()}
        )

    @property
    def estimates(self) -> list[_Estimate]:
        """Every parameter with its value, the ends low and high of its 95 % interval, and whether the log determines it."""
        deviations = np.sqrt(np.diag(self.covariance))
        return [
            _Estimate(
                each,
                *(float(each.value(z + step * deviation)) for step in (0.0, -_WITHIN_95, _WITHIN_95)),
                determined=bool(deviation < _DETERMINED),
            )
            for each, z, deviation in zip(self.problem.parameters, self.z, deviations, strict=True)
        ]

    @property
    def directions(self) -> list[_Direction]:
        """The combinations of parameters about which the prior has more information than the log, the least first.

        Each has the eigenvalue of the log's information, compared with that of the prior, and the largest shares by name.
        """
        eigenvalues, vectors = np.linalg.eigh(self.information)
        names = [each.name for each in self.problem.parameters]
        found = []
        for value, vector in zip(eigenvalues, vectors.T, strict=True):
            if value < 1:
                vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
                order = np.argsort(-np.abs(vector))
                shares = {names[i]: float(vector[i]) for i in order if abs(vector[i]) > 0.25}
                found.append(_Direction(float(max(value, 0.0)), shares))
        return found


def _minimum(
    problem: Problem, logs: list[Readings], start: np.ndarray, watch: Callable[[int], object], rounds: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """z (p,) and H (p, p) at the minimum, and how often the likelihood was computed in all."""
    known: dict[bytes, tuple[float, np.ndarray, np.ndarray]] = {}

    def at(z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        key = z.tobytes()
        if key not in known:
            value, slope, curvature = problem.information(logs, z)
            known[key] = value + 0.5 * float(z @ z), slope + z, curvature + np.eye(len(z))
            watch(rounds + len(known))
        return known[key]

    def end_near(z: np.ndarray) -> None:
        _, slope, curvature = at(z)
        if slope @ np.linalg.solve(curvature, slope) < _NEAR:
            raise StopIteration

    if not np.isfinite(at(start)[0]):
        raise ValueError(
            "the filter of the nominal robot cannot follow this log; is it of this robot, with these columns?"
        )
    found = scipy.optimize.minimize(
        lambda z: at(z)[0], start, jac=lambda z: at(z)[1], hess=lambda z: at(z)[2], method="trust-exact",
        options={"maxiter": _ROUNDS, "gtol": 0.0, "initial_trust_radius": 2.0, "max_trust_radius": 10.0},
        callback=end_near,
    )  # fmt: skip
    return found.x, at(found.x)[2] - np.eye(len(start)), rounds + len(known)


def _slopes(missed: np.ndarray, variance: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n, p) the part of each time in the slope of the likelihood, by what `Problem._derivatives` returns."""
    slopes = np.einsum("npm,nm->np", first, missed / np.sqrt(variance))
    return slopes + 0.5 * np.einsum("npm,nm->np", second, 1 - missed**2 / variance)


def _fisher(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(p, p) Fisher information of readings whose ν'/√S and S'/S are these (n, p, m)."""
    a, b = (part.transpose(1, 0, 2).reshape(part.shape[1], -1) for part in (first, second))
    return a @ a.T + 0.5 * b @ b.T


def _widening(slopes: np.ndarray, curvatures: np.ndarray) -> np.ndarray:
    """(p,) deviations by the jackknife over blocks, with slopes (K, p) and information (K, p, p), over those by information.

    At least 1: few blocks do not show that intervals are too wide.
    """
    count, prior = len(slopes), np.eye(slopes.shape[1])
    whole = curvatures.sum(axis=0) + prior
    usual = np.linalg.inv(whole)
    moved = np.linalg.solve(whole - curvatures, slopes[..., None])[..., 0]
    spread = (count - 1) / count * moved.T @ moved + usual @ usual  # the prior is not left out
    return np.sqrt(np.maximum(1.0, np.diag(spread) / np.diag(usual)))


def _without_outliers(problem: Problem, log: Readings, z: np.ndarray) -> tuple[Readings, int]:
    """A log without readings that are too far from what the robot z (p,) predicts, and how many those are."""
    found = Innovations.of(problem.robot, log, problem.lanes(z[None]))
    far = found.missed[:, 0] ** 2 > _OUTLIER**2 * found.variance[:, 0]
    return replace(log, y=np.where(far, np.nan, log.y)), int(far.sum())


def _differences(found: Innovations, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """ν and S (n, m) of the first lane, and their derivatives (n, p, m) from those around it."""
    apart = 2 * _DIFFERENCE
    up, down = slice(1, 1 + count), slice(1 + count, None)
    return (
        found.missed[:, 0],
        found.variance[:, 0],
        (found.missed[:, up] - found.missed[:, down]) / apart,
        (found.variance[:, up] - found.variance[:, down]) / apart,
    )
