"""Closed-form equations of motion of the ballbot, its contact with the floor, and their RK4 discretization.

State x = [x, y, γ, θ, ẋ, ẏ, γ̇, θ̇]: ball position, then leans. γ turns the body about the global y axis, then θ about
the local −x axis, so the body's axis points along n = (sin γ cos θ, sin θ, cos γ cos θ). Input u = [Fx, Fy]: the force on
the ball. With total mass M + m, h = m·l, J = I + m·l² the energies are

    T = ½(M+m)|ṗ|² + ṗ·d/dt(h n_xy) + ½(J cos²θ + Iz sin²θ) γ̇² + ½ J θ̇²,    V = h g cos γ cos θ,

and the accelerations below are Lagrange's equations with ẍ and ÿ eliminated. Reference: "High lean angle trajectory
optimization for ball balancing robots", whose linearization (5), (6) they reproduce.

A ball that rolls without slipping and does not spin about the vertical turns at ω = e_z × ṗ / r, so T gains
½ (I_b/r²) |ṗ|² with its inertia I_b: the mass M + m becomes M + m + I_b/r², but not in the weight. It is driven by a torque
T = r e_z × F between the body and the ball, which F stands for. On the ball T does the work T·ω = F·ṗ, as the force F
would. On the body −T does the work −T·(γ̇ e_y − θ̇ (cos γ e_x − sin γ e_z)). So the generalized forces are

    Q_x = Fx,   Q_y = Fy,   Q_γ = −r Fx,   Q_θ = −r Fy cos γ,

where the paper's ball has Q_γ = Q_θ = 0: the paper's robot is r = 0, I_b = 0.

The floor acts on the ball with the horizontal force f and the normal force N. The ball's rolling, I_b ω̇ = T − r e_z × f,
gives f = F − (I_b/r²) p̈. The height of the body's centre, with h n_z = m·height, gives N = (M + m) g + h n̈_z.

`omni` has the equations of a robot with wheels. Its state has 11 components, the 8 above first, and its input three, the
forces of its wheels on the ball, N.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

from ballbot_gym import omni, ops
from ballbot_gym.ops import Vector
from ballbot_gym.params import BallbotParams

STATE = (
    ("x", "m"),
    ("y", "m"),
    ("γ", "rad"),
    ("θ", "rad"),
    ("ẋ", "m/s"),
    ("ẏ", "m/s"),
    ("γ̇", "rad/s"),
    ("θ̇", "rad/s"),
)
"""Name and unit of each state component, in order."""

OMNI_STATE = (*STATE, ("ψ", "rad"), ("ψ̇", "rad/s"), ("ω_z", "rad/s"))
"""The same of a robot with wheels: the body's turn about its axis, its speed, and the ball's spin about the vertical."""

LEAST_NORMAL_FORCE = 0.02
"""Least normal force of a robot that has to grip, as a fraction of its weight."""

RK4_STEP = 0.01
"""Longest RK4 step, s. At 10 ms the model follows the exact solution to 1e-6 over 0.3 s at high lean."""


def accelerations(params: BallbotParams, x: Vector, u: Vector) -> tuple[Any, ...]:
    """(ẍ, ÿ, γ̈, θ̈) in m/s² and rad/s² for state x (..., 8) and force u (..., 2); with wheels as `omni.accelerations`."""
    if params.wheels is not None:
        return omni.accelerations(params, x, u)
    _, _, gamma, theta, _, _, gamma_dot, theta_dot = ops.components(x)
    fx, fy = ops.components(u)
    sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
    mass, h, inertia = params.moving_mass, params.first_moment, params.pivot_inertia
    ratio = h / mass

    # ẍ = ax − ratio·(nx_g γ̈ − nx_t θ̈) and ÿ = ay − ratio·cos θ θ̈
    nx_g, nx_t = cos_g * cos_t, sin_g * sin_t
    rate_product = gamma_dot * theta_dot
    gamma_rate2, theta_rate2 = gamma_dot * gamma_dot, theta_dot * theta_dot
    ax = (fx + h * (sin_g * cos_t * (gamma_rate2 + theta_rate2) + 2 * cos_g * sin_t * rate_product)) / mass
    ay = (fy + h * sin_t * theta_rate2) / mass

    # the 2×2 system [m11 m12; m12 m22] [γ̈; θ̈] = [f1; f2] that is left
    lean_inertia = inertia * cos_t * cos_t + params.axial_inertia * sin_t * sin_t
    half_slope = (params.axial_inertia - inertia) * sin_t * cos_t  # ½ d(lean_inertia)/dθ
    weight = h * params.gravity
    m11 = lean_inertia - h * ratio * nx_g * nx_g
    m12 = h * ratio * nx_g * nx_t
    m22 = inertia - h * ratio * (nx_t * nx_t + cos_t * cos_t)
    f1 = weight * sin_g * cos_t - h * nx_g * ax - 2 * half_slope * rate_product
    f2 = weight * cos_g * sin_t + h * nx_t * ax - h * cos_t * ay + half_slope * gamma_rate2
    if params.rolls:
        f1 = f1 - params.ball_radius * fx
        f2 = f2 - params.ball_radius * fy * cos_g
    determinant = m11 * m22 - m12 * m12
    gamma_ddot = (m22 * f1 - m12 * f2) / determinant
    theta_ddot = (m11 * f2 - m12 * f1) / determinant
    return (
        ax - ratio * (nx_g * gamma_ddot - nx_t * theta_ddot),
        ay - ratio * cos_t * theta_ddot,
        gamma_ddot,
        theta_ddot,
    )


def contact(params: BallbotParams, x: Vector, u: Vector) -> tuple[Any, Any, Any]:
    """The floor's force on the ball, (f_x, f_y, N) in N, for state x (..., 8) and force u (..., 2).

    A floor pushes only, N ≥ 0, and a coefficient of friction µ gives |f| ≤ µN. The paper's model asks of its floor whatever
    this says. So does a rolling robot's, which rolls without slipping in this model; see `limits`.
    """
    return _contact(params, x, u, accelerations(params, x, u))


def _contact(params: BallbotParams, x: Vector, u: Vector, acceleration: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    _, _, gamma, theta, _, _, gamma_dot, theta_dot, *_ = ops.components(x)
    ax, ay, gamma_ddot, theta_ddot, *_ = acceleration
    sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
    n_z_ddot = (
        2 * sin_g * sin_t * gamma_dot * theta_dot
        - sin_g * cos_t * gamma_ddot
        - cos_g * sin_t * theta_ddot
        - cos_g * cos_t * (gamma_dot * gamma_dot + theta_dot * theta_dot)
    )
    normal = params.weight + params.first_moment * n_z_ddot
    if params.wheels is not None:  # whatever drives it, the floor's force moves the whole robot
        rates2 = gamma_dot * gamma_dot + theta_dot * theta_dot
        n_x_ddot = (
            cos_g * cos_t * gamma_ddot
            - sin_g * sin_t * theta_ddot
            - sin_g * cos_t * rates2
            - 2 * cos_g * sin_t * gamma_dot * theta_dot
        )
        n_y_ddot = cos_t * theta_ddot - sin_t * theta_dot * theta_dot
        mass, h = params.total_mass, params.first_moment
        return mass * ax + h * n_x_ddot, mass * ay + h * n_y_ddot, normal
    fx, fy = ops.components(u)
    if not params.rolls:
        return fx, fy, normal
    rolling = params.moving_mass - params.total_mass
    return fx - rolling * ax, fy - rolling * ay, normal


def held_contact(
    params: BallbotParams, x: Vector, u: Vector, hold: Any
) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any]]:
    """The floor's force, as `contact`, when force u begins in state x and after it was held for so many seconds.

    The leans at the end are extrapolated with their accelerations, so that nothing is integrated for them. In between, a
    force that is held while the robot falls or rises needs up to twice the friction that it needs at first. With wheels the
    end counts as the beginning does, because the derivatives of both together take minutes to compile.
    """
    if params.wheels is not None:
        begin = contact(params, x, u)
        return begin, begin
    _, _, gamma, theta, vx, vy, gamma_dot, theta_dot = parts = ops.components(x)
    acceleration = accelerations(params, x, u)
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
    return _contact(params, x, u, acceleration), contact(params, end, u)


def limits(params: BallbotParams, x: Vector, u: Vector, backoff: Any = 0.0, hold: Any = None) -> tuple[Any, ...]:
    """The robot grips the floor iff every entry is ≥ 0; () where friction is unlimited. See `grip_limits`.

    Args:
        params: the robot.
        x: (..., 8) state.
        u: (..., 2) force, N.
        backoff: as of `grip_limits`.
        hold: s that the force is held: then the robot must grip at the end of this time too, see `held_contact`. Default, at
            the start alone.
    """
    if not params.grips:
        return ()
    both = hold is not None and params.wheels is None
    forces = held_contact(params, x, u, hold) if both else (contact(params, x, u),)
    return tuple([limit for force in forces for limit in grip_limits(params, force, backoff)])


def grip_limits(params: BallbotParams, force: tuple[Any, Any, Any], backoff: Any = 0.0) -> tuple[Any, Any]:
    """N/W − 0.02 and (N/W)² − (|f|/µW)² of the floor's force (f_x, f_y, N), N, with the robot's weight W.

    Both are smooth. The second is that of a cone, whose squares solvers converge on, and not on µN − |f|; by itself it would
    allow N < 0.

    Args:
        params: the robot.
        force: as `contact` gives it.
        backoff: reserve of normal force, as a fraction of the weight: the floor counts as if it pressed less by this.
    """
    fx, fy, normal = force
    weight = params.weight
    load = normal / weight - backoff
    slip = ops.squared(fx, fy) / (weight * params.friction) ** 2
    return load - LEAST_NORMAL_FORCE, ops.squared(load) - slip


def keeps_grip(params: BallbotParams, forces: Iterable[tuple[float, float, float]]) -> bool:
    """Whether the floor can give all of these forces (f_x, f_y, N), N, on a ball."""
    return all(limit >= 0 for force in forces for limit in grip_limits(params, force))


def grip_reserve(params: BallbotParams, force: tuple[Any, Any, Any]) -> Any:
    """The greatest `backoff` of `grip_limits` with which the floor's force (f_x, f_y, N) keeps the cone: (N − |f|/µ)/W."""
    fx, fy, normal = force
    return (normal - ops.sqrt(ops.squared(fx, fy)) / params.friction) / params.weight


def needed_friction(force: tuple[Any, Any, Any]) -> Any:
    """The coefficient of friction that the floor's force (f_x, f_y, N) needs: |f|/N, and inf where N ≤ 0."""
    fx, fy, normal = force
    return ops.where(normal > 0, ops.sqrt(ops.squared(fx, fy)) / ops.where(normal > 0, normal, 1.0), math.inf)


def derivative(params: BallbotParams, x: Vector, u: Vector) -> Vector:
    """dx/dt (..., 8) of state x (..., 8) under force u (..., 2)."""
    parts, found = ops.components(x), accelerations(params, x, u)
    return ops.stack(parts[4:8] + found[:4] + parts[9:10] + found[4:], like=x)


def step(
    params: BallbotParams,
    x: Vector,
    u: Vector,
    dt: Any,
    substeps: int = 2,
    slope: Callable[[BallbotParams, Any, Any], Any] = derivative,
) -> Vector:
    """The state after dt seconds with the force held, by RK4.

    Args:
        params: the robot.
        x: (..., 8) state.
        u: (..., 2) force, N, held over the step.
        dt: s.
        substeps: RK4 steps taken; `substeps_for(dt)` keeps each within RK4_STEP.
        slope: what gives `derivative`, compiled perhaps.

    Returns:
        (..., 8) state, of the same kind as x.
    """
    parts, force = ops.components(x), ops.components(u)
    for _ in range(substeps):
        parts = _rk4(slope, params, parts, force, dt / substeps)
    return ops.stack(parts, like=x)


def pushed(params: BallbotParams, x: Vector, impulse: Vector) -> Vector:
    """The state (..., 8) just after a horizontal impulse (..., 2), N·s, on the body's centre of mass in state x (..., 8).

    M Δq̇ = Jᵀ p, with the mass matrix M of `energy` and the Jacobian J of the centre of mass's horizontal position.
    """
    px, py = ops.components(impulse)
    *place, gamma, theta, vx, vy, gamma_dot, theta_dot = ops.components(x)[:8]
    a, b, d = ops.cos(gamma) * ops.cos(theta), -ops.sin(gamma) * ops.sin(theta), ops.cos(theta)  # of n, as in `energy`
    h, mass, inertia = params.first_moment, params.moving_mass, params.pivot_inertia
    if params.wheels is not None:
        psi, psi_dot, spin = ops.components(x)[8:]
        height, columns = params.com_height, omni.relative_turning(params, x)[1]
        moved = [px, py, height * a * px, height * (b * px + d * py), 0.0 * px, 0.0 * px]
        changes = omni.solved(omni.mass_matrix(params, x, columns), moved)
        speeds = [v + change for v, change in zip((vx, vy, gamma_dot, theta_dot), changes, strict=False)]
        return ops.stack((*place, gamma, theta, *speeds, psi, psi_dot + changes[4], spin + changes[5]), like=x)
    lean_inertia = inertia * d * d + params.axial_inertia * (1 - d * d)
    # the ball's speeds eliminated, two equations for the lean rates are left
    lever, coupling = params.com_height - h / mass, h * h / mass
    gg, gt, tt = lean_inertia - coupling * a * a, -coupling * a * b, inertia - coupling * (b * b + d * d)
    torque_g, torque_t = lever * a * px, lever * (b * px + d * py)
    determinant = gg * tt - gt * gt
    dg, dt = (tt * torque_g - gt * torque_t) / determinant, (gg * torque_t - gt * torque_g) / determinant
    dvx, dvy = (px - h * (a * dg + b * dt)) / mass, (py - h * d * dt) / mass
    return ops.stack((*place, gamma, theta, vx + dvx, vy + dvy, gamma_dot + dg, theta_dot + dt), like=x)


def substeps_for(dt: float) -> int:
    """RK4 steps per control step of dt seconds."""
    return max(1, math.ceil(dt / RK4_STEP - 1e-9))


def _rk4(slope: Callable[..., Any], params: BallbotParams, x: tuple, u: tuple, dt: Any) -> tuple:
    half, sixth = dt / 2, dt / 6
    k1 = slope(params, x, u)
    k2 = slope(params, _advance(x, half, k1), u)
    k3 = slope(params, _advance(x, half, k2), u)
    k4 = slope(params, _advance(x, dt, k3), u)
    return tuple([a + sixth * (b + 2 * (c + d) + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)])


def _advance(x: tuple, dt: Any, slope: tuple) -> tuple:
    return tuple([a + dt * b for a, b in zip(x, slope, strict=True)])


def energy(params: BallbotParams, x: Vector) -> Any:
    """Total mechanical energy, J, of state x (..., 8); zero potential at the height of the ball's centre."""
    _, _, gamma, theta, vx, vy, gamma_dot, theta_dot, *_ = ops.components(x)
    sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
    h, inertia = params.first_moment, params.pivot_inertia
    if params.wheels is not None:
        return omni.kinetic_energy(params, x) + h * params.gravity * cos_g * cos_t
    com_vx = cos_g * cos_t * gamma_dot - sin_g * sin_t * theta_dot  # of n, 1/s
    com_vy = cos_t * theta_dot
    lean_inertia = inertia * cos_t * cos_t + params.axial_inertia * sin_t * sin_t
    kinetic = (
        0.5 * params.moving_mass * (vx * vx + vy * vy)
        + h * (vx * com_vx + vy * com_vy)
        + 0.5 * lean_inertia * gamma_dot * gamma_dot
        + 0.5 * inertia * theta_dot * theta_dot
    )
    return kinetic + h * params.gravity * cos_g * cos_t


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
