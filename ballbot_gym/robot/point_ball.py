"""The paper's ballbot: its ball translates like a point mass, on which the force acts.

State and leans are those of `ballbot`. Input u = [Fx, Fy]: the force on the ball. With total mass M + m, h = m·l,
J = I + m·l² the energies are

    T = ½(M+m)|ṗ|² + ṗ·d/dt(h n_xy) + ½(J cos²θ + Iz sin²θ) γ̇² + ½ J θ̇²,    V = h g cos γ cos θ,

and the accelerations below are Lagrange's equations with ẍ and ÿ eliminated. Reference: "High lean angle trajectory
optimization for ball balancing robots", whose linearization (5), (6) they reproduce.

The floor acts on the ball with the horizontal force f = F and the normal force N.
"""

from dataclasses import dataclass
from typing import Any

from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.robot.ballbot import Ballbot, FloorForce


@dataclass(frozen=True)
class PointBall(Ballbot):
    """A ballbot whose ball translates, as the paper's. Its fields are those of `Ballbot`."""

    def derivative(self, x: Vector, u: Vector) -> Vector:
        parts = ops.components(x)
        return ops.stack(parts[4:8] + self.accelerations(x, u), like=x)

    def accelerations(self, x: Vector, u: Vector) -> tuple[Any, ...]:
        """(ẍ, ÿ, γ̈, θ̈) in m/s² and rad/s² for state x (..., 8) and force u (..., 2)."""
        _, _, gamma, theta, _, _, gamma_dot, theta_dot = ops.components(x)
        fx, fy = ops.components(u)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        mass, h, inertia = self.moving_mass, self.first_moment, self.pivot_inertia
        ratio = h / mass

        # ẍ = ax − ratio·(nx_g γ̈ − nx_t θ̈) and ÿ = ay − ratio·cos θ θ̈
        nx_g, nx_t = cos_g * cos_t, sin_g * sin_t
        rate_product = gamma_dot * theta_dot
        gamma_rate2, theta_rate2 = gamma_dot * gamma_dot, theta_dot * theta_dot
        ax = (fx + h * (sin_g * cos_t * (gamma_rate2 + theta_rate2) + 2 * cos_g * sin_t * rate_product)) / mass
        ay = (fy + h * sin_t * theta_rate2) / mass

        # the 2×2 system [m11 m12; m12 m22] [γ̈; θ̈] = [f1; f2] that is left
        lean_inertia = inertia * cos_t * cos_t + self.axial_inertia * sin_t * sin_t
        half_slope = (self.axial_inertia - inertia) * sin_t * cos_t  # ½ d(lean_inertia)/dθ
        weight = h * self.gravity
        m11 = lean_inertia - h * ratio * nx_g * nx_g
        m12 = h * ratio * nx_g * nx_t
        m22 = inertia - h * ratio * (nx_t * nx_t + cos_t * cos_t)
        f1 = weight * sin_g * cos_t - h * nx_g * ax - 2 * half_slope * rate_product
        f2 = weight * cos_g * sin_t + h * nx_t * ax - h * cos_t * ay + half_slope * gamma_rate2
        f1, f2 = self.driven(f1, f2, fx, fy, cos_g)
        determinant = m11 * m22 - m12 * m12
        gamma_ddot = (m22 * f1 - m12 * f2) / determinant
        theta_ddot = (m11 * f2 - m12 * f1) / determinant
        return (
            ax - ratio * (nx_g * gamma_ddot - nx_t * theta_ddot),
            ay - ratio * cos_t * theta_ddot,
            gamma_ddot,
            theta_ddot,
        )

    def driven(self, f1: Any, f2: Any, fx: Any, fy: Any, cos_g: Any) -> tuple[Any, Any]:
        """The generalized forces on γ and θ, N·m, with those of what drives the ball: none, for a force from outside."""
        return f1, f2

    def floor_force(self, x: Vector, u: Vector, acceleration: tuple[Any, ...]) -> FloorForce:
        fx, fy = ops.components(u)
        return fx, fy, self.vertical_force(x, acceleration)

    def energy(self, x: Vector) -> Any:
        """Total mechanical energy, J, of state x (..., 8); zero potential at the height of the ball's centre."""
        _, _, gamma, theta, vx, vy, gamma_dot, theta_dot, *_ = ops.components(x)
        sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
        h, inertia = self.first_moment, self.pivot_inertia
        com_vx = cos_g * cos_t * gamma_dot - sin_g * sin_t * theta_dot  # of n, 1/s
        com_vy = cos_t * theta_dot
        lean_inertia = inertia * cos_t * cos_t + self.axial_inertia * sin_t * sin_t
        kinetic = (
            0.5 * self.moving_mass * (vx * vx + vy * vy)
            + h * (vx * com_vx + vy * com_vy)
            + 0.5 * lean_inertia * gamma_dot * gamma_dot
            + 0.5 * inertia * theta_dot * theta_dot
        )
        return kinetic + h * self.gravity * cos_g * cos_t

    def pushed(self, x: Vector, impulse: Vector) -> Vector:
        """The state (..., 8) just after a horizontal impulse (..., 2), N·s, on the body's centre of mass in state x (..., 8).

        M Δq̇ = Jᵀ p, with the mass matrix M of `energy` and the Jacobian J of the centre of mass's horizontal position.
        """
        px, py = ops.components(impulse)
        *place, gamma, theta, vx, vy, gamma_dot, theta_dot = ops.components(x)
        a, b, d = ops.cos(gamma) * ops.cos(theta), -ops.sin(gamma) * ops.sin(theta), ops.cos(theta)  # of n
        h, mass, inertia = self.first_moment, self.moving_mass, self.pivot_inertia
        lean_inertia = inertia * d * d + self.axial_inertia * (1 - d * d)
        # the ball's speeds eliminated, two equations for the lean rates are left
        lever, coupling = self.com_height - h / mass, h * h / mass
        gg, gt, tt = lean_inertia - coupling * a * a, -coupling * a * b, inertia - coupling * (b * b + d * d)
        torque_g, torque_t = lever * a * px, lever * (b * px + d * py)
        determinant = gg * tt - gt * gt
        dg, dt = (tt * torque_g - gt * torque_t) / determinant, (gg * torque_t - gt * torque_g) / determinant
        dvx, dvy = (px - h * (a * dg + b * dt)) / mass, (py - h * d * dt) / mass
        return ops.stack((*place, gamma, theta, vx + dvx, vy + dvy, gamma_dot + dg, theta_dot + dt), like=x)

    def steady_speed(self, radius: Any, tilt: Any) -> Any:
        """Speed, m/s, at which a steady circle of this radius, m, leans inwards by this tilt, rad.

        With J = I + ml², h = ml and Ω = v/R: tan(tilt)·(hg + JΩ² cos(tilt)) = hΩ² R. The body's axial inertia, 1.1 % of J
        here, is left out: with it the circle is steady to 2 % of the ball's and 4.5 % of the leans' accelerations at 45°.
        """
        h, inertia = self.first_moment, self.pivot_inertia
        sin_tilt, cos_tilt = ops.sin(tilt), ops.cos(tilt)
        return radius * ops.sqrt(h * self.gravity * sin_tilt / cos_tilt / (h * radius - inertia * sin_tilt))
