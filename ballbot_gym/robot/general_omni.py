"""A robot with three omni-wheels as it was built: its wheels may be anywhere, and its centre of mass off the axis.

The model is that of `omni` with four differences. Frame B and the other names are those of its docstring.

1. The wheels touch the ball at any zenith angle ζ and at azimuths α_i. So n_i = (s cos α_i, s sin α_i, c) with s = sin ζ
   and c = cos ζ, and a_i = r (−c cos α_i, −c sin α_i, s). In frame B the azimuths are α_i + ψ. The sums over wheels are
   computed wheel by wheel, because Σ a_i a_iᵀ is no diagonal matrix in general.
2. There is dry friction T in each axle: wheel i pulls the ball less by (T/R) ω_i / √(ω_i² + ω_f²), where ω_i = s_i/R is the
   wheel's speed. Friction jumps at ω_i = 0. Here it is proportional to the speed below ω_f, because optimizers and filters
   need derivatives.
3. The body's centre of mass is at (c_x, c_y, l) in the body's own frame, so at (d_x, d_y, l) in frame B, with d = R_z(ψ) c.
   Let µ = m (d_x, d_y, 0). The body turns at Ω = (−θ̇, cos θ γ̇, sin θ γ̇ + ψ̇), and Ω̇ = Σ Ω_k v̇_k + α₀ in frame B with the
   columns Ω_k of Ω. The force that accelerates the centre of mass grows by Ω̇ × µ + Ω × (Ω × µ), the body's inertia about the
   ball's centre by

       ΔJ = [m d_y², −m d_x d_y, −l µ_x; −m d_x d_y, m d_x², −l µ_y; −l µ_x, −l µ_y, m (d_x² + d_y²)],

   and its weight has the torque −g µ × e_z about the ball's centre. Kane's equations give what that adds to M and q.
4. At rest the centre of mass is above the ball's centre, so that the body leans by about (−c_x, −c_y)/l: see `rest`.

The inertias `inertia` and `axial_inertia` are still those about all axes across the body's, and along it.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, is_number
from ballbot_gym.robot.ballbot import FloorForce
from ballbot_gym.robot.omni import Omni, _dot

_SLOW = 0.5  # rad/s, ω_f
_LEAST_VOLUME = 0.05  # of the wheels' axes, which spans from 0, where they lie in a plane, to 1

_Three = tuple[Any, Any, Any]


@dataclass(frozen=True)
class GeneralOmni(Omni):
    """A ballbot that three omni-wheels drive, as it was built. Its fields are those of `Omni` and

    | field | meaning | unit |
    |---|---|---|
    | com_x, com_y | of the body's centre of mass, in the body's frame, away from its axis | m |
    | zenith | angle between the body's axis and the wheels' contacts with the ball | rad |
    | azimuth_1, azimuth_2, azimuth_3 | of these contacts, from the body's x axis towards its y axis | rad |
    | axle_friction | dry friction in each axle | N·m |

    The axis goes through the ball's centre. Where it points in the body is a convention: the axis about which the wheels have
    one zenith angle.
    """

    DRY_FRICTION: ClassVar[bool] = True

    com_x: float = field(default=0.0, kw_only=True)
    com_y: float = field(default=0.0, kw_only=True)
    zenith: float = field(default=math.radians(45), kw_only=True)
    azimuth_1: float = field(default=0.0, kw_only=True)
    azimuth_2: float = field(default=math.radians(120), kw_only=True)
    azimuth_3: float = field(default=math.radians(240), kw_only=True)
    axle_friction: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        first, second, third = self._axes()
        volume = _dot(_cross(first, second), third) / self.ball_radius**3
        if is_number(volume) and abs(volume) < _LEAST_VOLUME:
            raise ValueError(
                f"{type(self).__name__}: the axes of the wheels lie in a plane, or nearly; give a zenith between 0 and 90° "
                "and azimuths that are apart"
            )

    @classmethod
    def of(cls, robot: Omni) -> "GeneralOmni":
        """A robot with wheels as one whose numbers include those of this class."""
        return cls(**{each.name: getattr(robot, each.name) for each in fields(robot)})

    def check_number(self, name: str, value: Any) -> None:
        if name not in _OWN or not is_number(value):
            super().check_number(name, value)
        elif not math.isfinite(value):
            raise ValueError(f"{type(self).__name__}: {name} must be finite, not {value}")
        elif name == "axle_friction" and value < 0:
            raise ValueError(f"{type(self).__name__}: axle_friction must be at least 0, not {value}")

    @property
    def centre_of_mass(self) -> _Three:
        return self.com_x, self.com_y, self.com_height

    def number_names(self) -> tuple[str, ...]:
        return (*super().number_names(), "body_mass", *_OWN)

    def displaced(self, com_x: Any, com_y: Any, zenith: Any, *azimuths: Any) -> "GeneralOmni":
        """The same robot with its centre of mass and its wheels moved by this much, m and rad."""
        moved = dict(zip(_OWN[:6], (com_x, com_y, zenith, *azimuths), strict=True))
        return self._replaced(**{name: getattr(self, name) + by for name, by in moved.items()})

    def _replaced(self, **numbers: Any) -> "GeneralOmni":
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return type(self)(**(own | numbers))

    def rest(self) -> np.ndarray:
        """(11,) the state of rest at the origin, in which the centre of mass is above the ball's centre."""
        gamma = -math.asin(self.com_x / math.hypot(self.com_x, self.com_y, self.com_height))
        return np.array([0.0, 0.0, gamma, -math.atan2(self.com_y, self.com_height), *[0.0] * 7])

    def extended(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As that of `Omni`. The centre of mass, and not the axis, leans as x (n, 8) says."""
        states, _ = super().extended(x, u)
        states = states + self.rest()
        return states, self.turning_ball(states[: len(u)], u).clip(-self.force_limit, self.force_limit)

    def without_dry_friction(self) -> "GeneralOmni":
        return self._replaced(axle_friction=0.0)

    def overcoming(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """Friction is that of the speeds that the wheels will have after dt: it also holds wheels that have yet to move."""
        free, state, force = self.without_dry_friction(), tuple(x.tolist()), tuple(u.tolist())
        after = free.step(state, force, dt, free.substeps(dt))
        speeds = self.wheels.radius * np.array(self.readings(after, force)[6:])
        return u + self.axle_drag(speeds) * speeds

    def floor_force(self, x: Vector, u: Vector, acceleration: tuple[Any, ...]) -> FloorForce:
        fx, fy, normal = super().floor_force(x, u, acceleration)
        body = _Body.of(self, x)
        rows = zip(*body.turns, strict=True)
        faster = [_dot(row, acceleration[2:5]) + own for row, own in zip(rows, body.bias, strict=True)]
        more = _plus(_cross(faster, body.moment), body.centripetal)
        ax, ay, az = (_dot(column, more) for column in zip(*body.axes, strict=True))
        return fx + ax, fy + ay, normal + az

    def energy(self, x: Vector) -> Any:
        body = _Body.of(self, x)
        return super().energy(x) + self.gravity * _dot(body.moment, body.upwards)

    def pushed(self, x: Vector, impulse: Vector) -> Vector:
        raise NotImplementedError("a push on a robot whose centre of mass is off its axis is not computed")

    def turning_ball(self, x: Vector, force: Vector) -> Vector:
        _, _, gamma, theta, *_, psi, _, _ = ops.components(x)
        fx, fy = ops.components(force)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        r = self.ball_radius
        wanted = -cos_g * fy * r, (sin_g * sin_t * fy + cos_t * fx) * r, (sin_t * fx - sin_g * cos_t * fy) * r
        w, _ = self.relative_turning(x)
        axes = self._axes(psi)
        volume = _dot(_cross(axes[0], axes[1]), axes[2])
        parts = []
        for i, axis in enumerate(axes):
            pull = _dot(_cross(axes[(i + 1) % 3], axes[(i + 2) % 3]), wanted) / volume
            parts.append(pull + self._resistance(_dot(axis, w)))
        return ops.stack(tuple(parts), like=force)

    def torque(self, u: Vector, psi: Any = None) -> _Three:
        axes = self._axes(psi)
        return tuple([_dot(column, ops.components(u)) for column in zip(*axes, strict=True)])  # pyright: ignore

    def rotor_torque(self, turning: np.ndarray, frame: np.ndarray) -> np.ndarray:
        axes = frame @ np.array(self._axes()).T
        return -self.wheels.mass * axes @ (axes.T @ turning)

    def axle_drag(self, speed: Any) -> Any:
        radius = self.wheels.radius
        return self.axle_friction / radius / ops.sqrt(speed * speed + (_SLOW * radius) ** 2)

    def equations(self, x: Vector, u: Vector) -> tuple[list[list[Any]], list[Any]]:
        m, q = super().equations(x, u)
        body = _Body.of(self, x)
        spun = body.of_inertia(body.turning)
        force = _plus(_cross(body.bias, body.moment), body.centripetal)
        torque = _plus(_plus(body.of_inertia(body.bias), _cross(body.turning, spun)), body.weight)
        for i, column in enumerate(body.moves):
            q[i] = q[i] - _dot(column, force)
        for i, column in enumerate(body.turns, 2):
            q[i] = q[i] - _dot(column, torque)
        return m, q

    def _mass_matrix(self, x: Vector, columns: tuple[tuple[Any, ...], ...]) -> list[list[Any]]:
        m = super()._mass_matrix(x, columns)
        body = _Body.of(self, x)
        for j, turn in enumerate(body.turns, 2):
            swing, spun = _cross(turn, body.moment), body.of_inertia(turn)
            for i, move in enumerate(body.moves):
                m[i][j] = m[j][i] = m[i][j] + _dot(move, swing)
            for i, other in enumerate(body.turns[: j - 1], 2):
                m[i][j] = m[i][j] + _dot(other, spun)
                m[j][i] = m[i][j]
        return m

    def _rotor_matrix(self, x: Vector, columns: tuple[tuple[Any, ...], ...]) -> list[list[Any]]:
        psi, mass = ops.components(x)[8], self.wheels.mass
        felt = [[_dot(axis, column) for column in columns] for axis in self._axes(psi)]
        return [
            [mass * _dot(a, b) if i <= j else 0.0 for j, b in enumerate(zip(*felt, strict=True))]
            for i, a in enumerate(zip(*felt, strict=True))
        ]

    def _pulls(self, x: Vector, u: Vector, w: _Three) -> _Three:
        axes, bias, mass = self._axes(ops.components(x)[8]), self._turning_bias(x, w), self.wheels.mass
        forces = [
            own - self._resistance(_dot(axis, w)) - mass * _dot(axis, bias)
            for axis, own in zip(axes, ops.components(u), strict=True)
        ]
        return tuple([_dot(column, forces) for column in zip(*axes, strict=True)])  # pyright: ignore

    def _rotors_of(self, x: Vector, turned: _Three) -> tuple[Any, ...]:
        axes, mass = self._axes(ops.components(x)[8]), self.wheels.mass
        felt = [mass * _dot(axis, turned) for axis in axes]
        return tuple([_dot(column, felt) for column in zip(*axes, strict=True)])

    def _wheel_speeds(self, w: _Three) -> tuple[Any, ...]:
        return tuple([_dot(axis, w) / self.wheels.radius for axis in self._axes()])

    def _resistance(self, speed: Any) -> Any:
        """N, by which a wheel pulls less whose surface moves at a speed, m/s."""
        return (self.wheels.drag(self.force_limit) + self.axle_drag(speed)) * speed

    def _axes(self, psi: Any = 0.0) -> list[_Three]:
        """a_i, m, in the body's own frame, and with psi, rad, in frame B."""
        r, psi = self.ball_radius, 0.0 if psi is None else psi
        across, along = -r * ops.cos(self.zenith), r * ops.sin(self.zenith)
        return [
            (across * ops.cos(a + psi), across * ops.sin(a + psi), along)
            for a in (self.azimuth_1, self.azimuth_2, self.azimuth_3)
        ]


_OWN = tuple(each.name for each in fields(GeneralOmni) if each.name not in {own.name for own in fields(Omni)})


@dataclass(frozen=True)
class _Body:
    """How the body moves in a state, and what its centre of mass adds to that being off the axis; vectors in frame B."""

    axes: tuple[_Three, _Three, _Three]
    """Of frame B, in the world."""
    moves: tuple[_Three, _Three]
    """How ẋ and ẏ move the ball."""
    turns: tuple[_Three, _Three, _Three]
    """Ω_k: how γ̇, θ̇ and ψ̇ turn the body."""
    turning: _Three
    """Ω, rad/s."""
    bias: _Three
    """α₀, rad/s²."""
    moment: _Three
    """µ, kg·m."""
    inertia: tuple[_Three, _Three, _Three]
    """ΔJ, kg·m²."""
    gravity: Any

    @classmethod
    def of(cls, robot: GeneralOmni, x: Vector) -> "_Body":
        """Of a robot in state x (..., 11)."""
        _, _, gamma, theta, _, _, gamma_dot, theta_dot, psi, psi_dot, _ = ops.components(x)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        cos, sin, m = ops.cos(psi), ops.sin(psi), robot.body_mass
        dx, dy = cos * robot.com_x - sin * robot.com_y, sin * robot.com_x + cos * robot.com_y
        mx, my, height = m * dx, m * dy, robot.first_moment / m
        axes = (cos_g, 0.0, -sin_g), (-sin_g * sin_t, cos_t, -cos_g * sin_t), (sin_g * cos_t, sin_t, cos_g * cos_t)
        return cls(
            axes,
            (tuple(axis[0] for axis in axes), tuple(axis[1] for axis in axes)),  # pyright: ignore
            ((0.0, cos_t, sin_t), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            (-theta_dot, cos_t * gamma_dot, sin_t * gamma_dot + psi_dot),
            (
                psi_dot * cos_t * gamma_dot,
                theta_dot * (psi_dot - sin_t * gamma_dot),
                cos_t * theta_dot * gamma_dot,
            ),
            (mx, my, 0.0),
            (
                (my * dy, -mx * dy, -height * mx),
                (-mx * dy, mx * dx, -height * my),
                (-height * mx, -height * my, mx * dx + my * dy),
            ),
            robot.gravity,
        )

    @property
    def upwards(self) -> _Three:
        """The vertical."""
        return tuple(axis[2] for axis in self.axes)  # pyright: ignore

    @property
    def centripetal(self) -> _Three:
        """Ω × (Ω × µ), N."""
        return _cross(self.turning, _cross(self.turning, self.moment))

    @property
    def weight(self) -> _Three:
        """g µ × e_z, N·m."""
        return tuple(self.gravity * each for each in _cross(self.moment, self.upwards))  # pyright: ignore

    def of_inertia(self, turning: _Three) -> _Three:
        """ΔJ times a vector."""
        return tuple(_dot(row, turning) for row in self.inertia)  # pyright: ignore


def _cross(a: Any, b: Any) -> _Three:
    (a1, a2, a3), (b1, b2, b3) = a, b
    return (
        _dot((a2, -a3), (b3, b2)),
        _dot((a3, -a1), (b1, b3)),
        _dot((a1, -a2), (b2, b1)),
    )


def _plus(a: _Three, b: _Three) -> _Three:
    return tuple(p + q for p, q in zip(a, b, strict=True))  # pyright: ignore
