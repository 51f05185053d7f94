"""What all ballbots share: masses and lengths, leans, and the contact between ball and floor.

The first eight components of a state are x = [x, y, γ, θ, ẋ, ẏ, γ̇, θ̇]: ball position, then leans. γ turns the body about
the global y axis, then θ about the local −x axis, so the body's axis points along n = (sin γ cos θ, sin θ, cos γ cos θ).
Equations of motion are in `point_ball`, `rolling_ball` and `omni`.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, is_number
from ballbot_gym.robot.base import Quantity, Robot
from ballbot_gym.robot.shapes import DARK, Cylinder, Shape, Sphere

STANDARD_GRAVITY = 9.81  # m/s²; a URDF carries no gravity

LEAST_NORMAL_FORCE = 0.02
"""Least normal force of a robot that has to grip, as a fraction of its weight."""

OwnBallbot = TypeVar("OwnBallbot", bound="Ballbot")

FloorForce = tuple[Any, Any, Any]
"""The floor's force on the ball, (f_x, f_y, N) in N."""

_BODY_SHARE = 0.94  # of the body's length has the controller's colour, the rest is a cap


class _Derived:
    """What follows from the fields. It is computed once, because equations of motion read it all the time."""

    total_mass: float
    """Ball and body, kg."""
    moving_mass: float
    """What a horizontal acceleration of the upright robot moves: ball and body, and what the ball's rolling adds, kg."""
    first_moment: float
    """m·l, the body's mass times its centre's height above the ball's, kg·m."""
    pivot_inertia: float
    """I + m·l², the body's transverse inertia about the ball's centre, kg·m²."""


@dataclass(frozen=True)
class Ballbot(_Derived, Robot):
    """A robot that balances on a ball. The subclasses are the kinds of balls.

    | field | meaning | unit |
    |---|---|---|
    | ball_mass, ball_radius | the ball | kg, m |
    | body_mass, body_radius, body_length | the body, a cylinder | kg, m |
    | com_height | body's centre of mass above the ball's centre | m |
    | inertia, axial_inertia | of the body about its centre of mass, across and along its axis | kg·m² |
    | force_limit | largest force on the ball along each axis | N |
    | gravity | | m/s² |
    | friction | coefficient between ball and floor; inf for a floor that gives any force | |

    Raises:
        ValueError: a field is no number, or not positive and finite; the message names it.
    """

    ball_mass: float
    ball_radius: float
    body_mass: float
    body_radius: float
    body_length: float
    com_height: float
    inertia: float
    axial_inertia: float
    force_limit: float
    gravity: float = STANDARD_GRAVITY
    friction: float = math.inf

    STATE: ClassVar[tuple[Quantity, ...]] = (
        Quantity("x", "m"),
        Quantity("y", "m"),
        Quantity("γ", "rad"),
        Quantity("θ", "rad"),
        Quantity("ẋ", "m/s"),
        Quantity("ẏ", "m/s"),
        Quantity("γ̇", "rad/s"),
        Quantity("θ̇", "rad/s"),
    )
    ACTION: ClassVar[tuple[Quantity, ...]] = (Quantity("Fx", "N"), Quantity("Fy", "N"))
    MEASUREMENTS: ClassVar[tuple[Quantity, ...]] = (Quantity("tilt", "rad"),)
    SYMMETRIES: ClassVar[frozenset[str]] = frozenset({"mirrors", "rotation"})
    BATCHED_OPTIMA: ClassVar[bool] = True
    PUSHABLE: ClassVar[bool] = True
    TRACK_FILTERS: ClassVar[bool] = True
    FORCE_SHARE: ClassVar[float] = 1.0
    """The force on the ball in any direction that actuators at their limit give, as a share of `force_limit`."""
    TOGETHER: ClassVar[dict[str, tuple[str, ...]]] = {"inertia": ("axial_inertia",)}
    """Fields that `varied` multiplies along with another one."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if is_number(self.inertia) and is_number(self.axial_inertia) and self.axial_inertia > 2 * self.inertia:
            # Bullet would silently take 0 for both
            raise ValueError(
                f"{type(self).__name__}: axial_inertia must be at most twice inertia, not {self.axial_inertia}"
            )
        derived = {
            "total_mass": self.ball_mass + self.body_mass,
            "first_moment": self.body_mass * self.com_height,
            "pivot_inertia": self.inertia + self.body_mass * self.com_height**2,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "moving_mass", self.total_mass + self.rolling_mass)

    def check_number(self, name: str, value: Any) -> None:
        if name == "friction" and is_number(value) and value == math.inf:
            return
        super().check_number(name, value)

    @property
    def rolling_mass(self) -> Any:
        """What the ball's rolling adds to the moving mass, kg."""
        return 0.0

    @property
    def centre_of_mass(self) -> tuple[Any, Any, Any]:
        """Of the body, in its own frame with the ball's centre as origin, m."""
        return 0.0, 0.0, self.com_height

    @property
    def weight(self) -> Any:
        """Of ball and body, N."""
        return self.total_mass * self.gravity

    @property
    def grips(self) -> bool:
        return not (is_number(self.friction) and self.friction == math.inf)

    @property
    def wheel_radius(self) -> Any:
        """Of the wheels that drive the ball, m; 0 where there are none."""
        return 0.0

    @property
    def drive_radius(self) -> Any:
        """Torque on the body, N·m, for each newton that drives the ball; 0 where nothing drives it but a force."""
        return 0.0

    def number_names(self) -> tuple[str, ...]:
        names = (
            "total_mass",
            "moving_mass",
            "first_moment",
            "pivot_inertia",
            "axial_inertia",
            "gravity",
            "force_limit",
        )
        return (*names, "friction") if self.grips else names

    def on_any_floor(self: OwnBallbot) -> OwnBallbot:
        return replace(self, friction=math.inf)

    def record(self) -> str:
        """The kind and all numbers as text, which is the one that version 0.1 wrote, so that its files can be read."""
        named = {f.name: repr(getattr(self, f.name)) for f in fields(self)}
        order = [*(name for name in named if name not in ("friction", "ball_inertia", "wheels")), "rolls"]
        named = {"rolls": str(self.CONTACT), "ball_inertia": "0.0"} | named
        order += ["ball_inertia", "friction", *(["wheels"] if "wheels" in named else [])]
        return f"BallbotParams({', '.join(f'{name}={named[name]}' for name in order)})"

    def varied(self: OwnBallbot, **factors: Any) -> OwnBallbot:
        """The same robot with some numbers multiplied by factors, along with what `TOGETHER` names."""
        for name, others in self.TOGETHER.items():
            if name in factors:
                factors |= dict.fromkeys(others, factors[name])
        if not self.grips:
            factors.pop("friction", None)
        if "force" in factors:
            factors["force_limit"] = factors.pop("force")
        return super().varied(**factors)

    @abstractmethod
    def accelerations(self, x: Vector, u: Vector) -> tuple[Any, ...]:
        """(ẍ, ÿ, γ̈, θ̈), and of further speeds, in m/s² and rad/s²."""

    @abstractmethod
    def energy(self, x: Vector) -> Any:
        """Total mechanical energy, J, of a state; zero potential at the height of the ball's centre."""

    @abstractmethod
    def steady_speed(self, radius: Any, tilt: Any) -> Any:
        """Speed, m/s, at which a steady circle of this radius, m, leans inwards by this tilt, rad."""

    def steady_tilt(self, radius: float, speed: float) -> float:
        """Steady inward tilt, rad: the inverse of `steady_speed`, by bisection (it grows with speed)."""
        low, high = 0.0, math.atan(1e3)
        for _ in range(60):
            middle = 0.5 * (low + high)
            h, inertia = self.first_moment, self.pivot_inertia
            too_fast = inertia * math.sin(middle) >= h * radius  # sufficient where the ball rolls
            low, high = (low, middle) if too_fast or self.steady_speed(radius, middle) > abs(speed) else (middle, high)
        return 0.5 * (low + high)

    def steady_orbit(self, radius: float, speed: float, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n, 8) and forces (n, 2), N, of the steady circle at ball bearings (n,), rad.

        The circle is counter-clockwise if the speed is positive.
        """
        tilt, rate = self.steady_tilt(radius, speed), speed / radius
        outward = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        along = np.stack([-np.sin(bearings), np.cos(bearings)], axis=1)
        axis, axis_dot = -math.sin(tilt) * outward, -math.sin(tilt) * rate * along  # of n_x, n_y
        theta = np.arcsin(axis[:, 1])
        gamma = np.arctan2(axis[:, 0], math.cos(tilt))
        theta_dot = axis_dot[:, 1] / np.cos(theta)
        gamma_dot = axis_dot[:, 0] * math.cos(tilt) / (math.cos(tilt) ** 2 + axis[:, 0] ** 2)
        states = np.column_stack([radius * outward, gamma, theta, speed * along, gamma_dot, theta_dot])
        com_radius = radius - self.com_height * math.sin(tilt)
        ball_mass = self.ball_mass + (self.moving_mass - self.total_mass)
        pull = rate**2 * (ball_mass * radius + self.body_mass * com_radius)
        return states, -pull * outward

    @abstractmethod
    def floor_force(self, x: Vector, u: Vector, acceleration: tuple[Any, ...]) -> FloorForce:
        """As `contact`, of a state's accelerations."""

    def ideal(self) -> "Ballbot":
        """The same robot, but its ball is driven by a force or a torque in any direction instead of this robot's drive."""
        return self

    def turning_ball(self, x: Vector, force: Vector) -> Vector:
        """The action that drives the ball as a force (..., 2), N, would in state x, not clipped."""
        return force

    def measurements(self, x: Vector) -> tuple[Any, ...]:
        return (tilt(x),)

    def contact(self, x: Vector, u: Vector) -> FloorForce:
        """The floor's force on the ball, (f_x, f_y, N) in N, for state x and action u.

        A real floor can only push, N ≥ 0, and a coefficient of friction µ gives |f| ≤ µN. This model does not limit the
        force: its ball always translates, or rolls without slipping. See `limits`.
        """
        return self.floor_force(x, u, self.accelerations(x, u))

    def held_contact(self, x: Vector, u: Vector, hold: Any) -> tuple[FloorForce, FloorForce]:
        """The floor's force, as `contact`, when u starts in state x, and again after u was held for `hold` seconds.

        The leans at the end are extrapolated with their accelerations, so that nothing is integrated for them. In between, a
        force that is held while the robot falls or rises needs up to twice the friction that it needs at first.
        """
        if self.LONG_EQUATIONS:  # the derivatives of both together take minutes to compile
            begin = self.contact(x, u)
            return begin, begin
        _, _, gamma, theta, vx, vy, gamma_dot, theta_dot = parts = ops.components(x)
        acceleration = self.accelerations(x, u)
        *_, gamma_ddot, theta_ddot = acceleration
        end = ops.stack(
            (
                *parts[:2],
                gamma + hold * (gamma_dot + 0.5 * hold * gamma_ddot),
                theta + hold * (theta_dot + 0.5 * hold * theta_ddot),
                vx,
                vy,
                gamma_dot + hold * gamma_ddot,
                theta_dot + hold * theta_ddot,
            ),
            like=x,
        )
        return self.floor_force(x, u, acceleration), self.contact(end, u)

    def limits(self, x: Vector, u: Vector, backoff: Any = 0.0, hold: Any = None) -> tuple[Any, ...]:
        """The robot grips the floor iff every entry is ≥ 0; () where friction is unlimited. See `grip_limits`.

        Args:
            x: (..., n) state.
            u: (..., m) action, in the units of `ACTION`.
            backoff: same as in `grip_limits`.
            hold: s that the action is held: then the robot must grip at the end of this time too, see `held_contact`.
                Default, at the start alone.
        """
        if not self.grips:
            return ()
        both = hold is not None and not self.LONG_EQUATIONS
        forces = self.held_contact(x, u, hold) if both else (self.contact(x, u),)
        return tuple([limit for force in forces for limit in self.grip_limits(force, backoff)])

    def grip_limits(self, force: FloorForce, backoff: Any = 0.0) -> tuple[Any, Any]:
        """N/W − 0.02 and (N/W)² − (|f|/µW)² of the floor's force (f_x, f_y, N), N, with the robot's weight W.

        Both are smooth. The second is that of a cone, whose squares solvers converge on, and not on µN − |f|; by itself it
        would allow N < 0.

        Args:
            force: as `contact` gives it.
            backoff: reserve of normal force, as a fraction of the weight: the floor counts as if it pressed less by this.
        """
        fx, fy, normal = force
        weight = self.weight
        load = normal / weight - backoff
        slip = ops.squared(fx, fy) / (weight * self.friction) ** 2
        return load - LEAST_NORMAL_FORCE, ops.squared(load) - slip

    @staticmethod
    def needed_friction(force: FloorForce) -> Any:
        """The coefficient of friction that the floor's force (f_x, f_y, N) needs: |f|/N, and inf where N ≤ 0."""
        fx, fy, normal = force
        return ops.where(normal > 0, ops.sqrt(ops.squared(fx, fy)) / ops.where(normal > 0, normal, 1.0), math.inf)

    def held(self, x: Vector, u: Vector, hold: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        if not self.grips:
            return (), ()
        begin, end = self.held_contact(x, u, hold)
        kept = [ops.minimum(*self.grip_limits(force)) for force in (begin, end)]
        needed = ops.maximum(self.needed_friction(begin), self.needed_friction(end))
        return (*begin, needed), (ops.minimum(*kept),)

    def grip_reserve(self, x: Vector, u: Vector, hold: Any) -> Any:
        """The greatest `backoff` with which the floor's forces stay in the cone: (N − |f|/µ)/W."""
        reserves = [
            (normal - ops.sqrt(ops.squared(fx, fy)) / self.friction) / self.weight
            for fx, fy, normal in self.held_contact(x, u, hold)
        ]
        return ops.minimum(*reserves)

    def cone_curvature(self) -> float:
        return (self.force_limit / (self.friction * self.weight)) ** 2

    def vertical_force(self, x: Vector, acceleration: tuple[Any, ...]) -> Any:
        """N, N, of the floor: the height of the body's centre, with h n_z = m·height, gives (M + m) g + h n̈_z."""
        _, _, gamma, theta, _, _, gamma_dot, theta_dot, *_ = ops.components(x)
        _, _, gamma_ddot, theta_ddot, *_ = acceleration
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        n_z_ddot = (
            2 * sin_g * sin_t * gamma_dot * theta_dot
            - sin_g * cos_t * gamma_ddot
            - cos_g * sin_t * theta_ddot
            - cos_g * cos_t * (gamma_dot * gamma_dot + theta_dot * theta_dot)
        )
        return self.weight + self.first_moment * n_z_ddot

    def position(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(x)[:2]

    def placed(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(3,) centre of the ball, m, and (3,) unit vector along the body's axis, of state x (n,)."""
        gamma, theta = x[2], x[3]
        axis = np.array([math.sin(gamma) * math.cos(theta), math.sin(theta), math.cos(gamma) * math.cos(theta)])
        return np.array([x[0], x[1], self.ball_radius]), axis

    def shapes(self, x: np.ndarray) -> list[Shape]:
        ball, axis = self.placed(x)
        low = ball + (self.com_height - self.body_length / 2) * axis
        cap, top = low + _BODY_SHARE * self.body_length * axis, low + self.body_length * axis
        low, cap, top, centre = (tuple(point.tolist()) for point in (low, cap, top, ball))
        return [
            Sphere(centre, self.ball_radius, DARK),
            Cylinder(low, cap, self.body_radius),
            Cylinder(cap, top, 1.02 * self.body_radius, DARK),
        ]


def cos_tilt(x: Vector) -> Any:
    """Cosine of the angle between the body's axis and the vertical: cos γ cos θ."""
    _, _, gamma, theta, *_ = ops.components(x)
    return ops.cos(gamma) * ops.cos(theta)


def tilt(x: Vector) -> Any:
    """Angle between the body's axis and the vertical, rad, of state x (..., 8).

    Its gradient is infinite where the robot stands upright.
    """
    # Libraries round cosines, so that one can lie just outside [−1, 1].
    return ops.arccos(ops.clip(cos_tilt(x), -1.0, 1.0))
