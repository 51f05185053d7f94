"""A ballbot whose ball rolls without slipping and does not spin about the vertical, driven by a torque.

The ball turns at ω = e_z × ṗ / r. This adds ½ (I_b/r²) |ṗ|² to the kinetic energy of `point_ball`, with the ball's inertia
I_b: the mass M + m becomes M + m + I_b/r², but not in the weight. The ball is driven by a torque T = r e_z × F between it and
the body; the action is the equivalent force F. On the ball T does the work T·ω = F·ṗ, as the force F would. On the body −T
does the work −T·(γ̇ e_y − θ̇ (cos γ e_x − sin γ e_z)). So the generalized forces are

    Q_x = Fx,   Q_y = Fy,   Q_γ = −r Fx,   Q_θ = −r Fy cos γ,

where the paper's ball has Q_γ = Q_θ = 0: the paper's robot is r = 0, I_b = 0.

The ball's rolling, I_b ω̇ = T − r e_z × f, gives the floor's horizontal force f = F − (I_b/r²) p̈.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.robot.ballbot import FloorForce
from ballbot_gym.robot.point_ball import PointBall


@dataclass(frozen=True)
class RollingBall(PointBall):
    """A ballbot whose ball rolls. Its fields are those of `Ballbot` and

    | field | meaning | unit |
    |---|---|---|
    | ball_inertia | of the ball about its centre | kg·m² |

    A force F on the ball represents the torque r e_z × F that the body applies to it.
    """

    ball_inertia: float = field(kw_only=True)

    CONTACT: ClassVar[bool] = True
    TOGETHER: ClassVar[dict[str, tuple[str, ...]]] = {**PointBall.TOGETHER, "ball_mass": ("ball_inertia",)}

    def on_floor(self, friction: float) -> "RollingBall":
        return replace(self, friction=friction)

    @property
    def rolling_mass(self) -> Any:
        return self.ball_inertia / self.ball_radius**2

    @property
    def drive_radius(self) -> Any:
        return self.ball_radius

    def number_names(self) -> tuple[str, ...]:
        return (*super().number_names(), "ball_radius")

    def driven(self, f1: Any, f2: Any, fx: Any, fy: Any, cos_g: Any) -> tuple[Any, Any]:
        """The generalized forces on γ and θ, N·m, with those of the torque that drives the ball, which turns the body too."""
        return f1 - self.ball_radius * fx, f2 - self.ball_radius * fy * cos_g

    def floor_force(self, x: Vector, u: Vector, acceleration: tuple[Any, ...]) -> FloorForce:
        fx, fy = ops.components(u)
        rolling = self.moving_mass - self.total_mass
        ax, ay, *_ = acceleration
        return fx - rolling * ax, fy - rolling * ay, self.vertical_force(x, acceleration)

    def steady_speed(self, radius: Any, tilt: Any) -> Any:
        """Speed, m/s, at which a steady circle of this radius, m, leans inwards by this tilt, rad.

        The torque that drives the ball tilts the body too: Ω² = hg sin(tilt) / (cos(tilt) (hR − J sin(tilt)) +
        r (m R − h sin(tilt))) with the ball's radius r and the moving mass m.
        """
        h, inertia = self.first_moment, self.pivot_inertia
        sin_tilt, cos_tilt = ops.sin(tilt), ops.cos(tilt)
        torque = self.ball_radius * (self.moving_mass * radius - h * sin_tilt)
        resistance = cos_tilt * (h * radius - inertia * sin_tilt) + torque
        return radius * ops.sqrt(h * self.gravity * sin_tilt / resistance)
