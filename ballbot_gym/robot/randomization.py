"""Domain randomization: robots, actuators, sensors and pushes that vary, for one environment and for batches.

`Randomization` draws no random numbers itself. Its methods take uniform numbers in [0, 1), floats or batches, so that
`BallbotEnv` and `BallbotBatch` use the same code.
"""

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

from ballbot_gym import ops
from ballbot_gym.checks import from_fields
from ballbot_gym.ops import between, is_number
from ballbot_gym.robot.base import Robot

_LARGEST = 1e6  # of any number
_LARGEST_FACTOR = 1e3
_MOST_DELAY_STEPS = 1000  # every one of them is remembered, and takes time in every step

_NEWER = ("com_offset", "wheel_error")  # fields that the certified sets and policies were written without

Range = tuple[float, float]
"""(low, high), both included; drawn uniformly."""


@dataclass(frozen=True)
class Randomization:
    """The parameters that vary, and by how much. By default nothing varies. Ranges are (low, high), drawn uniformly.

    Cost, margins, goal and `info["state"]` use the true state and the force that the actuator applies. Tasks draw their
    episodes for the nominal robot. Pushes do not count as effort.

    Raises:
        ValueError: a range that is reversed, not finite or out of its domain; the message names the field.
    """

    body_mass: Range = (1.0, 1.0)
    """Factor on the body's mass, drawn per episode."""
    ball_mass: Range = (1.0, 1.0)
    """Factor on the ball's mass, and on its inertia where it rolls, drawn per episode."""
    com_height: Range = (1.0, 1.0)
    """Factor on the height of the body's centre of mass above the ball's centre, drawn per episode."""
    inertia: Range = (1.0, 1.0)
    """Factor on both of the body's inertias about its centre of mass, drawn per episode."""
    force: Range = (1.0, 1.0)
    """Ratio of the applied force to the command, drawn per episode."""
    friction: Range = (1.0, 1.0)
    """Factor on the coefficient of friction, where it is limited, drawn per episode."""
    actuator_lag: Range = (0.0, 0.0)
    """Time constant of the force's first-order response, s, drawn per episode."""
    actuator_delay: Range = (0.0, 0.0)
    """Dead time before the force responds, s: whole control steps, drawn per episode."""
    position_noise: float = 0.0
    """Standard deviation of observed x and y, m. All noise is independent at each observation."""
    lean_noise: float = 0.0
    """Standard deviation of observed γ and θ, rad."""
    velocity_noise: float = 0.0
    """Standard deviation of observed ẋ and ẏ, m/s."""
    lean_rate_noise: float = 0.0
    """Standard deviation of observed γ̇ and θ̇, rad/s."""
    lean_bias: float = 0.0
    """Standard deviation of a constant error of observed γ and θ, rad, drawn per episode."""
    lean_rate_bias: float = 0.0
    """Standard deviation of a constant error of observed γ̇ and θ̇, rad/s, drawn per episode."""
    odometry_drift: float = 0.0
    """Standard deviation of a constant error of observed ẋ and ẏ, m/s, drawn per episode; x and y drift away with it."""
    push_impulse: Range = (0.0, 0.0)
    """Horizontal impulse on the ball, N·s, in a random direction, spread over one control step."""
    push_interval: float = 1.0
    """Mean time between pushes, s. In each control step there is one with probability control_dt / push_interval."""
    com_offset: float = 0.0
    """Standard deviation of what is added to com_x and to com_y of a `GeneralOmni`, m, drawn per episode."""
    wheel_error: float = 0.0
    """Standard deviation of what is added to the zenith and to each azimuth of the wheels of a `GeneralOmni`, rad, drawn per
    episode."""

    DRAWN = (
        "body_mass", "ball_mass", "com_height", "inertia", "gain", "delay", "force", "friction",
        "drift_x", "drift_y", "bias_gamma", "bias_theta", "bias_gamma_rate", "bias_theta_rate",
    )  # fmt: skip
    """Names of what `draw` draws: factors, the gain and delay of `actuate`, and errors of the sensors in SI units. If none of
    the others is drawn, there are only the first 6."""
    DISPLACED = ("com_x", "com_y", "zenith", "azimuth_1", "azimuth_2", "azimuth_3")
    """Numbers of a `GeneralOmni` to which `draw` adds what follows, m and rad, if any of them varies."""
    PUSH_DRAWS = 3
    """Uniform numbers that `push` takes."""
    NOISE_DRAWS = 8
    """Uniform numbers that `sensed` takes."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, float):
                if not is_number(value):
                    raise ValueError(f"Randomization: {field.name} must be a number, not {value!r}")
                if not 0 <= value <= _LARGEST:
                    raise ValueError(
                        f"Randomization: {field.name} must be finite and at least 0, and at most {_LARGEST:g}, not {value}"
                    )
                continue
            low, high = _pair(field.name, value)
            object.__setattr__(self, field.name, (low, high))  # so that a list, as JSON has it, is the same range
            if not (math.isfinite(high) and low <= high):
                raise ValueError(f"Randomization: {field.name} must be a finite range (low, high), not {value}")
            largest = _LARGEST_FACTOR if field.default == (1.0, 1.0) else _LARGEST
            if high > largest:
                raise ValueError(f"Randomization: {field.name} must be at most {largest:g}, not {value}")
            if low < 0 or (low == 0 and field.default == (1.0, 1.0)):
                bound = "positive factors" if field.default == (1.0, 1.0) else "at least 0"
                raise ValueError(f"Randomization: {field.name} must be {bound}, not {value}")
        if self.push_interval == 0:
            raise ValueError("Randomization: push_interval must be positive, not 0")

    def __repr__(self) -> str:
        """Without newer fields that are at their default, so that files with the text of older randomizations can be read."""
        shown = [each.name for each in fields(self) if each.name not in _NEWER or getattr(self, each.name)]
        return f"Randomization({', '.join(f'{name}={getattr(self, name)!r}' for name in shown)})"

    @classmethod
    def checked(cls, randomization: Any, params: Robot | None = None) -> "Randomization":
        """The randomization that was given, also by its name in `TRACKS` or as the dict of all its fields, or none for None.

        Raises:
            ValueError: no track of that name, or it pushes a robot, params, whose action is no horizontal force.
            TypeError: it is something else, such as a dict of some fields.
        """
        if randomization is None:
            return cls()
        if isinstance(randomization, str):
            if randomization not in TRACKS:
                raise ValueError(f"unknown randomization {randomization!r}; known: {', '.join(map(repr, TRACKS))}")
            return TRACKS[randomization]
        if isinstance(randomization, dict):  # an older version wrote it without the newer fields
            randomization = dict.fromkeys(_NEWER, 0.0) | randomization
        randomization = from_fields(cls, randomization)
        if not isinstance(randomization, cls):
            raise TypeError(
                f"randomization must be a Randomization, for instance Randomization(lean_noise=0.01), not {randomization!r}"
            )
        if params is not None and randomization.pushes and not params.PUSHABLE:
            raise ValueError(
                f"pushes add to an action Fx, Fy, which {type(params).__name__} does not have; leave out push_impulse"
            )
        return randomization

    @property
    def track(self) -> str:
        """Its name in `TRACKS`, or ""."""
        return next((name for name, track in TRACKS.items() if track == self), "")

    @cached_property
    def varies_robot(self) -> bool:
        """Whether robots differ from the nominal one."""
        return any(r != (1.0, 1.0) for r in self._factors) or self._displaces

    @cached_property
    def varies_actuator(self) -> bool:
        """Whether the force lags, is delayed, or differs from the command."""
        return self.actuator_lag[1] > 0 or self.actuator_delay[1] > 0 or self.force != (1.0, 1.0)

    @cached_property
    def is_noisy(self) -> bool:
        """Whether observations have errors."""
        return any(self.noise) or self.is_biased

    @cached_property
    def is_biased(self) -> bool:
        """Whether sensors have errors that stay for an episode."""
        return any(self._biases)

    @cached_property
    def varies_episodes(self) -> bool:
        """Whether `draw` draws anything."""
        return self.varies_robot or self.varies_actuator or self.is_biased

    @cached_property
    def moves_optima(self) -> bool:
        """Whether an episode's optimum differs from that of the nominal robot with an ideal actuator."""
        return self.varies_robot or self.varies_actuator

    @cached_property
    def episode_draws(self) -> int:
        """Uniform numbers that `draw` takes."""
        if self._displaces:
            return len(self.DRAWN) + len(self.DISPLACED)
        every = self.is_biased or self.force != (1.0, 1.0) or self.friction != (1.0, 1.0)
        return len(self.DRAWN) if every else 6

    @cached_property
    def most_draws(self) -> int:
        """The most uniform numbers that `draw` takes, whatever varies; it leaves the last ones out where it needs fewer."""
        return max(len(self.DRAWN), self.episode_draws)

    @cached_property
    def _displaces(self) -> bool:
        """Whether the centre of mass or wheels move."""
        return self.com_offset > 0 or self.wheel_error > 0

    @cached_property
    def _factors(self) -> tuple[Range, ...]:
        return self.body_mass, self.ball_mass, self.com_height, self.inertia, self.force, self.friction

    @cached_property
    def _biases(self) -> tuple[float, ...]:
        return self.odometry_drift, self.lean_bias, self.lean_rate_bias

    @cached_property
    def pushes(self) -> bool:
        """Whether pushes come."""
        return self.push_impulse[1] > 0

    @cached_property
    def active(self) -> bool:
        """Whether anything varies."""
        return self.varies_robot or self.varies_actuator or self.is_noisy or self.pushes

    @cached_property
    def noise(self) -> tuple[float, ...]:
        """Standard deviation of each observed state component, in its unit; order as in `Ballbot.STATE`."""
        groups = (self.position_noise, self.lean_noise, self.velocity_noise, self.lean_rate_noise)
        return tuple(std for std in groups for _ in range(2))

    def delay_steps(self, control_dt: float) -> tuple[int, int]:
        """`actuator_delay` in control steps of control_dt seconds.

        Raises:
            ValueError: it is not whole control steps, or too many.
        """
        low, high = (round(seconds / control_dt) for seconds in self.actuator_delay)
        if high > _MOST_DELAY_STEPS:
            raise ValueError(
                f"Randomization: actuator_delay {self.actuator_delay} s must be at most {_MOST_DELAY_STEPS} control steps "
                f"of {control_dt} s"
            )
        if not all(
            math.isclose(steps * control_dt, seconds, rel_tol=1e-9, abs_tol=1e-12)
            for steps, seconds in zip((low, high), self.actuator_delay, strict=True)
        ):
            raise ValueError(
                f"Randomization: actuator_delay {self.actuator_delay} s must be whole control steps of {control_dt} s"
            )
        return low, high

    def draw(self, z: tuple[Any, ...], control_dt: float) -> tuple[Any, ...]:
        """An episode's robot, actuator and sensors, as `DRAWN` names them, from `episode_draws` uniform numbers."""
        factors = tuple(between(z[i], *self._factors[i]) for i in range(4))
        # The tiny constant makes no lag an exact gain of 1.
        gain = 1.0 - ops.exp(-control_dt / (between(z[4], *self.actuator_lag) + 1e-9))
        low, high = self.delay_steps(control_dt)
        delay = 0.0 * z[5] + low
        for k in range(low, high):
            delay = ops.where(z[5] * (high - low + 1) >= k - low + 1, 0.0 * z[5] + (k + 1), delay)
        if self.episode_draws == 6:
            return (*factors, gain, delay)
        deviations = [std for std in self._biases for _ in range(2)]
        if self._displaces:
            deviations += [self.com_offset] * 2 + [self.wheel_error] * 4
        errors = (std * normal for std, normal in zip(deviations, normals(z[8:]), strict=True))
        return (*factors, gain, delay, between(z[6], *self.force), between(z[7], *self.friction), *errors)

    def robot(self, params: Robot, drawn: tuple[Any, ...]) -> Robot:
        """The robot of an episode for which `draw` drew this."""
        names = ("body_mass", "ball_mass", "com_height", "inertia")
        force, friction = drawn[6:8] or (1.0, 1.0)
        robot = params.varied(**dict(zip(names, drawn[:4], strict=True)), force=force, friction=friction)
        return robot.displaced(*drawn[len(self.DRAWN) :]) if self._displaces else robot

    def resting(self, none: tuple[Any, ...], control_dt: float) -> tuple[Any, ...]:
        """The memory of `actuate` of an actuator at rest, whose earlier commands were `none` (2); () if it is ideal."""
        return none * (1 + self.delay_steps(control_dt)[1]) if self.varies_actuator else ()

    def actuate(
        self, command: tuple[Any, ...], drawn: tuple[Any, ...], memory: tuple[Any, ...]
    ) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """The force (2), N, that the actuator applies in the next control step, and its new memory.

        Args:
            command: (2,) N, of the present control step.
            drawn: what `draw` drew for the episode.
            memory: (2,) N, applied in the last control step, and (2 d) the commands before, the latest first, of as many
                steps d as the longest delay.
        """
        if not memory:
            return command, ()
        gain, delay, size = drawn[4], drawn[5], len(command)
        for strength in drawn[6:7]:
            command = tuple([strength * part for part in command])
        last, past, due = memory[:size], (*command, *memory[size:]), command
        for age in range(1, len(memory) // size):
            old = past[age * size : (age + 1) * size]
            due = tuple([ops.where(delay == age, a, b) for a, b in zip(old, due, strict=True)])
        force = tuple([gain * d + (1.0 - gain) * f for d, f in zip(due, last, strict=True)])
        return force, (*force, *past[: len(memory) - size])

    def push(self, z: tuple[Any, ...], control_dt: float) -> tuple[Any, Any]:
        """The push (2), N, of a control step from 3 uniform numbers; zero in most steps."""
        strength = between(z[1], *self.push_impulse) / control_dt
        force = ops.where(z[0] < control_dt / self.push_interval, strength, 0.0 * strength)
        bearing = 2 * math.pi * z[2]
        return force * ops.cos(bearing), force * ops.sin(bearing)

    def sensed(self, x: tuple[Any, ...], z: tuple[Any, ...], drawn: tuple[Any, ...], time: Any) -> tuple[Any, ...]:
        """State (8) as the sensors report it.

        Args:
            x: (8) the true one.
            z: 8 uniform numbers.
            drawn: what `draw` drew for the episode.
            time: since the episode began, s.
        """
        seen = tuple(
            value + std * normal if std else value
            for value, std, normal in zip(x, self.noise, normals(z), strict=False)
        ) + tuple(x[8:])
        if not self.is_biased:
            return seen
        drift, lean, rate = drawn[8:10], drawn[10:12], drawn[12:14]
        errors = (*(time * part for part in drift), *lean, *drift, *rate)
        return tuple(value + error for value, error in zip(seen, errors, strict=False)) + seen[8:]


def normals(z: tuple[Any, ...]) -> tuple[Any, ...]:
    """An even number of uniform numbers as standard normal ones, by the Box–Muller transform."""
    out: list[Any] = []
    for z1, z2 in zip(z[::2], z[1::2], strict=True):
        radius, bearing = ops.sqrt(-2.0 * ops.log(1.0 - z1)), 2 * math.pi * z2
        out += [radius * ops.cos(bearing), radius * ops.sin(bearing)]
    return tuple(out)


def _pair(name: str, value: Any) -> Range:
    try:
        low, high = value
        if not (is_number(low) and is_number(high)):
            raise TypeError
        return float(low), float(high)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"Randomization: {name} must be a finite range (low, high), not {value!r}") from None


ROBOT_FACTORS = ("body_mass", "com_height", "force")
"""Factors on the nominal values of a robot. Filters estimate them, and informed policies take the estimates as inputs."""

TRACKS: dict[str, Randomization] = {
    "unknown": Randomization(body_mass=(0.7, 1.4), com_height=(0.85, 1.15), force=(0.85, 1.1), friction=(0.6875, 1.25)),
    "late": Randomization(actuator_delay=(0.0, 0.06)),
    "noisy": Randomization(
        position_noise=0.01,
        lean_noise=0.01,
        velocity_noise=0.05,
        lean_rate_noise=0.03,
        lean_bias=0.002,
        lean_rate_bias=0.005,
        odometry_drift=0.003,
    ),
}
"""The tracks: randomizations by name. Controllers do not observe what "unknown" and "late" draw. On "unknown", the friction
of a rolling robot, which is usually 0.8, is 0.55 to 1.0. No track has an actuator that lags, because the optimum would then
have to be computed for another model."""
TRACKS["real"] = replace(
    TRACKS["noisy"],
    **{name: getattr(TRACKS["unknown"], name) for name in ("body_mass", "com_height", "force", "friction")},
    actuator_delay=TRACKS["late"].actuator_delay,
)
