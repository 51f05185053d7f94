"""A robot that three omni-wheels drive: its body yaws, its ball spins, and its motors weaken with speed.

The wheels touch the ball at 45° of zenith angle and at azimuths α of 0, 120 and 240° about the body's axis. In the body's
frame wheel i has the contact normal n_i = (s cos α, s sin α, c), and drives the ball along t_i = (−sin α, cos α, 0), with
s = sin 45° and c = cos 45°; its rollers let the ball pass across. The state has three components more than that of
`ballbot`: ψ, by which the body is turned about its own axis after γ and θ, ψ̇, and the ball's spin ω_z about the vertical.

The ball turns at ω = (−ẏ/r, ẋ/r, ω_z). Seen from the frame B of the leans, in which the body turns by ψ alone, it turns
relative to the body at

    w₁ = −cos γ ẏ/r − sin γ ω_z + θ̇
    w₂ = sin γ sin θ ẏ/r + cos θ ẋ/r − cos γ sin θ ω_z − cos θ γ̇
    w₃ = −sin γ cos θ ẏ/r + sin θ ẋ/r + cos γ cos θ ω_z − sin θ γ̇ − ψ̇,

which is w = J v for the speeds v = (ẋ, ẏ, γ̇, θ̇, ψ̇, ω_z). With a_i = r (n_i × t_i) and w in the body's own frame, the
surface of wheel i moves at s_i = a_i · w, and pulls the ball with the force

    f_i = u_i − d s_i − m ṡ_i,    d = (τ/ω₀ + b)/R²,    m = I/R².

u_i is the motor's pull at standstill, N, in proportion to the voltage that is applied. R is the wheel's radius, τ = R max u_i
the stall torque, ω₀ the no-load speed, b viscous friction, and I the inertia of rotor, gear and wheel, all at the wheel's
axis. So the torque falls linearly with speed, from the stall torque to 0 at the no-load speed. The ball feels the torque
Σ a_i f_i, and the body the opposite one. Their power is that torque times w, so the generalized forces are Jᵀ Σ a_i f_i. In
every frame that turns about the body's axis Σ a_i a_iᵀ = r² D with D = 3/2 diag(c², c², 2 s²). So with ẇ, as an observer on
the body sees it,

    Σ a_i f_i = Σ a_i u_i − d r² D w − m r² D ẇ,    ẇ = J v̇ + (J̇ v − ψ̇ e₃ × w).

The other terms are those of `point_ball`, with the body's spin γ̇ sin θ + ψ̇ about its axis instead of γ̇ sin θ, the ball's
energy ½ I_b ω_z², and a torque of the floor against the ball's spin, which is smooth where dry friction jumps. All that makes
six linear equations M v̇ = q. The body and D are the same about all axes across the body's, so that ψ matters to u alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, as_float, is_number
from ballbot_gym.robot.ballbot import FloorForce
from ballbot_gym.robot.base import Quantity
from ballbot_gym.robot.rolling_ball import RollingBall

_SIN = _COS = math.sqrt(0.5)  # of the zenith angle of the wheels' contacts
_AZIMUTHS = tuple(math.radians(degrees) for degrees in (0, 120, 240))
ACROSS, ALONG = 1.5 * _COS**2, 3 * _SIN**2
"""D, across and along the body's axis."""
_SPIN_SPEED = 1.0  # rad/s: a slower spin meets friction in proportion to it


@dataclass(frozen=True)
class Wheels:
    """Three omni-wheels and their motors. `Omni.force_limit` is the force of a wheel on the ball at stall, N.

    | field | meaning | unit |
    |---|---|---|
    | radius | of a wheel | m |
    | no_load_speed | of a wheel, at which its motor has no torque left | rad/s |
    | inertia | of rotor, gear and wheel, at the wheel's axis | kg·m² |
    | damping | viscous friction of motor, gear and wheel, at the wheel's axis | N·m·s |
    | spin_friction | torque of the floor on a ball that spins about the vertical | N·m |

    Raises:
        ValueError: a field is no number or out of its range; the message names it.
    """

    radius: float
    no_load_speed: float
    inertia: float
    damping: float
    spin_friction: float

    def __post_init__(self) -> None:
        for each in fields(self):
            value = as_float(getattr(self, each.name))
            object.__setattr__(self, each.name, value)
            if isinstance(value, str | bool | None):
                raise ValueError(f"Wheels: {each.name} must be a number, not {value!r}")
            if not is_number(value):
                continue  # a symbol
            positive = each.name in ("radius", "no_load_speed")
            if not (0 < value < math.inf if positive else 0 <= value < math.inf):
                raise ValueError(
                    f"Wheels: {each.name} must be {'positive' if positive else 'at least 0'} and finite, not {value}"
                )

    def drag(self, force_limit: Any) -> Any:
        """d, N·s/m: by how much a wheel's pull falls per speed of its surface, of a motor with this pull at standstill, N."""
        return force_limit / (self.radius * self.no_load_speed) + self.damping / self.radius**2

    def floor_torque(self, spin: Any) -> Any:
        """Of the floor on a ball that spins about the vertical, rad/s: N·m."""
        return -self.spin_friction * spin / ops.sqrt(spin * spin + _SPIN_SPEED**2)

    @property
    def mass(self) -> float:
        """m, kg: the inertia as felt at the wheel's surface."""
        return self.inertia / self.radius**2


@dataclass(frozen=True)
class Omni(RollingBall):
    """A ballbot that three omni-wheels drive. Its fields are those of `RollingBall` and

    | field | meaning |
    |---|---|
    | wheels | the wheels and their motors |

    An action has a component for each wheel: the force, N, that it exerts on the ball at standstill, at most force_limit.
    """

    wheels: Wheels = field(kw_only=True)

    STATE = (*RollingBall.STATE, Quantity("ψ", "rad"), Quantity("ψ̇", "rad/s"), Quantity("ω_z", "rad/s"))
    ACTION = (Quantity("u1", "N"), Quantity("u2", "N"), Quantity("u3", "N"))
    OUTPUTS = (
        Quantity("cos ψ", "1"),
        Quantity("sin ψ", "1"),
        Quantity("ψ̇", "rad/s"),
        Quantity("ω_z", "rad/s"),
    )
    OUTPUT_SCALE = (1.0, 1.0, 5.0, 5.0)
    OUTPUT_STATES = 3
    PARTS: ClassVar[dict[str, type]] = {"wheels": Wheels}
    SYMMETRIES = frozenset()
    LONG_EQUATIONS = True
    BATCHED_OPTIMA = False
    PUSHABLE = False
    SENSORS = ("com_height",)
    TRACK_FILTERS = False
    FORCE_SHARE = math.sqrt(3) * _COS  # of the three wheels together, at standstill

    def __post_init__(self) -> None:
        if isinstance(self.wheels, dict):  # as `dataclasses.asdict` makes it
            object.__setattr__(self, "wheels", Wheels(**self.wheels))
        super().__post_init__()

    def check_number(self, name: str, value: Any) -> None:
        if name != "wheels":
            super().check_number(name, value)
        elif not isinstance(value, Wheels):
            raise ValueError(f"Omni: wheels must be Wheels, not {value!r}")

    def ideal(self) -> RollingBall:
        """The same robot, driven by a torque in any direction instead of the wheels."""
        return RollingBall(**{each.name: getattr(self, each.name) for each in fields(RollingBall)})

    @property
    def wheel_radius(self) -> Any:
        return self.wheels.radius

    def number_names(self) -> tuple[str, ...]:
        return (*super().number_names(), "ball_inertia", *(f"wheels.{each.name}" for each in fields(Wheels)))

    def derivative(self, x: Vector, u: Vector) -> Vector:
        parts, found = ops.components(x), self.accelerations(x, u)
        return ops.stack(parts[4:8] + found[:4] + parts[9:10] + found[4:], like=x)

    def accelerations(self, x: Vector, u: Vector) -> tuple[Any, ...]:
        """(ẍ, ÿ, γ̈, θ̈, ψ̈, ω̇_z) in m/s² and rad/s² for state x (..., 11) and the wheels' forces u (..., 3), N."""
        return _solved(*self.equations(x, u))

    def floor_force(self, x: Vector, u: Vector, acceleration: tuple[Any, ...]) -> FloorForce:
        """The floor's force is the only external force on the whole robot, besides its weight."""
        _, _, gamma, theta, _, _, gamma_dot, theta_dot, *_ = ops.components(x)
        ax, ay, gamma_ddot, theta_ddot, *_ = acceleration
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        rates2 = gamma_dot * gamma_dot + theta_dot * theta_dot
        n_x_ddot = (
            cos_g * cos_t * gamma_ddot
            - sin_g * sin_t * theta_ddot
            - sin_g * cos_t * rates2
            - 2 * cos_g * sin_t * gamma_dot * theta_dot
        )
        n_y_ddot = cos_t * theta_ddot - sin_t * theta_dot * theta_dot
        mass, h = self.total_mass, self.first_moment
        return mass * ax + h * n_x_ddot, mass * ay + h * n_y_ddot, self.vertical_force(x, acceleration)

    def energy(self, x: Vector) -> Any:
        """Total mechanical energy, J, of ball, body, rotors and wheels in state x (..., 11)."""
        _, _, gamma, theta, *_ = parts = ops.components(x)
        speeds = (*parts[4:8], *parts[9:])
        m = self._mass_matrix(x, self.relative_turning(x)[1])
        kinetic = 0.5 * _dot([_dot(row, speeds) for row in m], speeds)
        return kinetic + self.first_moment * self.gravity * ops.cos(gamma) * ops.cos(theta)

    def pushed(self, x: Vector, impulse: Vector) -> Vector:
        """The state (..., 11) just after a horizontal impulse (..., 2), N·s, on the body's centre of mass."""
        px, py = ops.components(impulse)
        *place, gamma, theta, vx, vy, gamma_dot, theta_dot = ops.components(x)[:8]
        psi, psi_dot, spin = ops.components(x)[8:]
        a, b, d = ops.cos(gamma) * ops.cos(theta), -ops.sin(gamma) * ops.sin(theta), ops.cos(theta)  # of n
        height, columns = self.com_height, self.relative_turning(x)[1]
        moved = [px, py, height * a * px, height * (b * px + d * py), 0.0 * px, 0.0 * px]
        changes = _solved(self._mass_matrix(x, columns), moved)
        speeds = [v + change for v, change in zip((vx, vy, gamma_dot, theta_dot), changes, strict=False)]
        return ops.stack((*place, gamma, theta, *speeds, psi, psi_dot + changes[4], spin + changes[5]), like=x)

    def outputs(self, x: Vector) -> tuple[Any, ...]:
        psi, psi_dot, spin = ops.components(x)[8:]
        return ops.cos(psi), ops.sin(psi), psi_dot, spin

    def extended(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n, 8) and forces (m, 2), m ≤ n, N, of an ideal ball's motion as (n, 11) and (m, 3) of this robot.

        It does not turn, and the wheels' forces are clipped.
        """
        x = np.column_stack([x, np.zeros((len(x), 3))])
        return x, self.turning_ball(x[: len(u)], u).clip(-self.force_limit, self.force_limit)

    def turning_ball(self, x: Vector, force: Vector) -> Vector:
        """u (..., 3), N, that turns the ball as the force (..., 2), N, of a rolling robot without wheels: by r e_z × force.

        It makes up for the motors' loss of torque at the present speeds, and is not clipped.
        """
        _, _, gamma, theta, *_, psi, _, _ = ops.components(x)
        fx, fy = ops.components(force)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        # in the frame of the leans, N
        t1, t2, t3 = -cos_g * fy, sin_g * sin_t * fy + cos_t * fx, -sin_g * cos_t * fy + sin_t * fx
        (w1, w2, w3), _ = self.relative_turning(x)
        drag = self.ball_radius * self.wheels.drag(self.force_limit)
        t1, t2, t3 = t1 + ACROSS * drag * w1, t2 + ACROSS * drag * w2, t3 + ALONG * drag * w3
        cos, sin = ops.cos(psi), ops.sin(psi)
        t1, t2 = cos * t1 + sin * t2, cos * t2 - sin * t1
        parts = [t3 / (3 * _SIN) - 2 / (3 * _COS) * (math.cos(a) * t1 + math.sin(a) * t2) for a in _AZIMUTHS]
        return ops.stack(tuple(parts), like=force)

    def axle_drag(self, speed: Any) -> Any:
        """N·s/m, by which dry friction in an axle slows a wheel whose surface moves at a speed, m/s; there is none."""
        return 0.0

    def torque(self, u: Vector, psi: Any = None) -> tuple[Any, Any, Any]:
        """Σ a_i u_i, N·m, of the wheels' forces u (..., 3), N, in the body's frame.

        With psi, rad, in frame B, in which the body turns.
        """
        a, b, c = ops.components(u)
        radius = self.ball_radius
        across = -_COS * radius
        t1, t2, t3 = across * (a - 0.5 * (b + c)), across * math.sqrt(0.75) * (b - c), _SIN * radius * (a + b + c)
        if psi is None:
            return t1, t2, t3
        cos, sin = ops.cos(psi), ops.sin(psi)
        return cos * t1 - sin * t2, sin * t1 + cos * t2, t3

    def torque_on_ball(self, x: Vector, turning: tuple[Any, Any, Any], u: Vector) -> tuple[Any, ...]:
        """Σ a_i f_i in the world, N·m, of the wheels on a ball that turns in the world, rad/s, and may slip on the floor.

        The rotors' part is that of the acceleration that the robot has in state x (..., 11) where its ball does not slip.
        """
        _, _, gamma, theta, _, _, gamma_dot, theta_dot, _, psi_dot, _ = ops.components(x)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        axes = (cos_g, 0.0, -sin_g), (-sin_g * sin_t, cos_t, -cos_g * sin_t), (sin_g * cos_t, sin_t, cos_g * cos_t)
        own = -theta_dot, cos_t * gamma_dot, sin_t * gamma_dot + psi_dot
        w = tuple(_dot(axis, turning) - body for axis, body in zip(axes, own, strict=True))
        faster = self.accelerations(x, u)
        turned = tuple(_dot(row, faster) for row in zip(*self.relative_turning(x)[1], strict=True))
        felt = [pull - own for pull, own in zip(self._pulls(x, u, w), self._rotors_of(x, turned), strict=True)]
        return tuple(_dot(column, felt) for column in zip(*axes, strict=True))

    def _rotors_of(self, x: Vector, turned: tuple[Any, Any, Any]) -> tuple[Any, ...]:
        """m Σ a_i (a_i · ẇ), N·m, in frame B, of a turning relative to the body that changes by `turned`, rad/s²."""
        rotors = self.ball_radius**2 * self.wheels.mass
        return tuple([share * rotors * each for share, each in zip((ACROSS, ACROSS, ALONG), turned, strict=True)])

    def rotor_torque(self, turning: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """(3,) N·m, of the rotors on a ball whose turning relative to the body changes by `turning` (3,), rad/s².

        Both that and the body's axes, the columns of `frame` (3, 3), are in one frame.
        """
        axis = frame[:, 2]
        felt = ACROSS * turning + (ALONG - ACROSS) * (axis @ turning) * axis
        return -self.wheels.mass * self.ball_radius**2 * felt

    def relative_turning(self, x: Vector) -> tuple[tuple[Any, Any, Any], tuple[tuple[Any, ...], ...]]:
        """w, rad/s, of a state x (..., 11), and J by columns: six of three entries."""
        _, _, gamma, theta, *_ = parts = ops.components(x)
        r = self.ball_radius
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        columns = (
            (0.0, cos_t / r, sin_t / r),
            (-cos_g / r, sin_g * sin_t / r, -sin_g * cos_t / r),
            (0.0, -cos_t, -sin_t),
            (1.0, 0.0, 0.0),
            (0.0, 0.0, -1.0),
            (-sin_g, -cos_g * sin_t, cos_g * cos_t),
        )
        speeds = (*parts[4:8], *parts[9:])
        return tuple(_dot(row, speeds) for row in zip(*columns, strict=True)), columns

    def readings(self, x: Vector, u: Vector) -> tuple[Any, ...]:
        """What perfect sensors read (9) in state x (..., 11) under u (..., 3), N; see `ballbot_gym.robot.sensors`.

        That is the body's turning (3), rad/s, its specific force (3), m/s², and the wheels' speeds (3), rad/s.
        """
        _, _, gamma, theta, _, _, gamma_dot, theta_dot, psi, psi_dot, _ = ops.components(x)
        ax, ay, gamma_ddot, theta_ddot, *_ = self.accelerations(x, u)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        rates2, product = gamma_dot * gamma_dot + theta_dot * theta_dot, gamma_dot * theta_dot
        height = self.com_height
        ax = ax + height * (
            cos_g * cos_t * gamma_ddot
            - sin_g * sin_t * theta_ddot
            - sin_g * cos_t * rates2
            - 2 * cos_g * sin_t * product
        )
        ay = ay + height * (cos_t * theta_ddot - sin_t * theta_dot * theta_dot)
        az = self.gravity + height * (
            2 * sin_g * sin_t * product
            - sin_g * cos_t * gamma_ddot
            - cos_g * sin_t * theta_ddot
            - cos_g * cos_t * rates2
        )
        # in the frame of the leans; the body is turned by ψ in this frame
        turning = -theta_dot, cos_t * gamma_dot, sin_t * gamma_dot + psi_dot
        along = cos_g * ax - sin_g * az
        upright = sin_g * ax + cos_g * az
        force = along, cos_t * ay - sin_t * upright, sin_t * ay + cos_t * upright
        relative, _ = self.relative_turning(x)
        cos, sin = ops.cos(psi), ops.sin(psi)
        turning, force, relative = ((cos * a + sin * b, cos * b - sin * a, c) for a, b, c in (turning, force, relative))
        return (*turning, *force, *self._wheel_speeds(relative))

    def equations(self, x: Vector, u: Vector) -> tuple[list[list[Any]], list[Any]]:
        """M (6, 6) and q (6) of M v̇ = q for state x (..., 11) and the wheels' forces u (..., 3), N."""
        _, _, gamma, theta, _, _, gamma_dot, theta_dot, _, psi_dot, spin = ops.components(x)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        w, columns = self.relative_turning(x)
        pulls = self._pulls(x, u, w)
        h, axial = self.first_moment, self.axial_inertia
        half_slope = (axial - self.pivot_inertia) * sin_t * cos_t
        rates2, product = gamma_dot * gamma_dot + theta_dot * theta_dot, gamma_dot * theta_dot
        q = (
            h * (sin_g * cos_t * rates2 + 2 * cos_g * sin_t * product),
            h * sin_t * theta_dot * theta_dot,
            h * self.gravity * sin_g * cos_t - 2 * half_slope * product - axial * cos_t * theta_dot * psi_dot,
            h * self.gravity * cos_g * sin_t + gamma_dot * (half_slope * gamma_dot + axial * cos_t * psi_dot),
            -axial * cos_t * product,
            self.wheels.floor_torque(spin),
        )
        q = [own + _dot(column, pulls) for own, column in zip(q, columns, strict=True)]
        return self._mass_matrix(x, columns), q

    def _mass_matrix(self, x: Vector, columns: tuple[tuple[Any, ...], ...]) -> list[list[Any]]:
        """M (6, 6) at state x (..., 11), with J by columns."""
        _, _, gamma, theta, *_ = ops.components(x)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        mass, h, inertia, axial = self.moving_mass, self.first_moment, self.pivot_inertia, self.axial_inertia
        m = self._rotor_matrix(x, columns)
        lean_inertia = inertia * cos_t * cos_t + axial * sin_t * sin_t
        own = {
            (0, 0): mass, (0, 2): h * cos_g * cos_t, (0, 3): -h * sin_g * sin_t, (1, 1): mass, (1, 3): h * cos_t,
            (2, 2): lean_inertia, (2, 4): axial * sin_t, (3, 3): inertia, (4, 4): axial, (5, 5): self.ball_inertia,
        }  # fmt: skip
        for (i, j), value in own.items():
            m[i][j] = m[i][j] + value
        return [[m[min(i, j)][max(i, j)] for j in range(6)] for i in range(6)]

    def _rotor_matrix(self, x: Vector, columns: tuple[tuple[Any, ...], ...]) -> list[list[Any]]:
        """The rotors' part of the upper triangle of M (6, 6), with J by columns."""
        rotors = self.wheels.mass * self.ball_radius**2
        weighted = [(ACROSS * rotors * a, ACROSS * rotors * b, ALONG * rotors * c) for a, b, c in columns]
        return [[_dot(a, b) if i <= j else 0.0 for j, b in enumerate(columns)] for i, a in enumerate(weighted)]

    def _pulls(self, x: Vector, u: Vector, w: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        """Σ a_i f_i, N·m, of a ball that turns at w, rad/s, in frame B, less what the rotors take of it for J v̇."""
        r, wheels, (w1, w2, w3) = self.ball_radius, self.wheels, w
        bias1, bias2, bias3 = self._turning_bias(x, w)
        t1, t2, t3 = self.torque(u, ops.components(x)[8])
        drag, rotors = r * r * wheels.drag(self.force_limit), r * r * wheels.mass
        return (
            t1 - ACROSS * (drag * w1 + rotors * bias1),
            t2 - ACROSS * (drag * w2 + rotors * bias2),
            t3 - ALONG * (drag * w3 + rotors * bias3),
        )

    @staticmethod
    def _turning_bias(x: Vector, w: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        """ẇ, rad/s², without J v̇: the ball's turning, constant in the world, seen from frame B, less that of the body."""
        *_, theta, _, _, gamma_dot, theta_dot, _, psi_dot, _ = ops.components(x)
        sin_t, cos_t, (w1, w2, w3) = ops.sin(theta), ops.cos(theta), w
        rate2, rate3 = cos_t * gamma_dot, sin_t * gamma_dot  # of frame B, whose rate about its first axis is −θ̇
        b1, b2, b3 = w1 - theta_dot, w2 + rate2, w3 + rate3 + psi_dot  # the ball's turning
        bias1 = rate3 * b2 - rate2 * b3 + psi_dot * w2
        bias2 = -rate3 * b1 - theta_dot * b3 + gamma_dot * sin_t * theta_dot - psi_dot * w1
        bias3 = rate2 * b1 + theta_dot * b2 - gamma_dot * cos_t * theta_dot
        return bias1, bias2, bias3

    def _wheel_speeds(self, w: tuple[Any, Any, Any]) -> tuple[Any, ...]:
        """The wheels' speeds (3), rad/s, against the body, over which the ball turns at w, rad/s, in the body's own frame."""
        w1, w2, w3 = w
        ratio = self.ball_radius / self.wheels.radius
        return tuple([ratio * (_SIN * w3 - _COS * (math.cos(a) * w1 + math.sin(a) * w2)) for a in _AZIMUTHS])


def _solved(m: list[list[Any]], q: list[Any]) -> tuple[Any, ...]:
    """v with M v = q, for a symmetric and positive definite M; both are overwritten."""
    n = len(q)
    for k in range(n):
        for i in range(k + 1, n):
            factor = m[k][i] / m[k][k]
            for j in range(i, n):
                m[i][j] = m[i][j] - factor * m[k][j]
            q[i] = q[i] - factor * q[k]
    for i in reversed(range(n)):
        q[i] = (q[i] - _dot(m[i][i + 1 :], q[i + 1 :])) / m[i][i]
    return tuple(q)


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """The sum of products, from left to right, without those with a factor that is always 0."""
    total: Any = 0.0
    for p, q in zip(a, b, strict=True):
        if not _is_zero(p) and not _is_zero(q):
            total = p * q if _is_zero(total) else total + p * q
    return total


def _is_zero(value: Any) -> bool:
    return isinstance(value, float) and value == 0
