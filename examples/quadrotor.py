"""A planar quadrotor that rights itself and returns: `ballbot benchmark --tasks quadrotor:quadrotor` in this folder.

`ballbot new system quadrotor` made the file to start from.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_gym import Cylinder, Quantity, Reference, Robot, Shape, Task, ops, register_robot, register_task


@dataclass(frozen=True)
class Quadrotor(Robot):
    """A rigid body in a vertical plane with two rotors, an arm to either side of its centre (Tedrake, Underactuated
    Robotics, section 3.3). Each rotor gives half of the weight and an action, so that without actions it hovers.
    """

    mass: float = 0.5
    inertia: float = 0.005
    arm: float = 0.15
    gravity: float = 9.81
    force_limit: float = 2.4
    """What an action of 1 adds to each rotor, N: just less than half of the weight, so that no rotor ever pulls down."""

    STATE = tuple(Quantity(name, "rad" if "θ" in name else "m") for name in ("x", "z", "θ")) + (
        Quantity("ẋ", "m/s"),
        Quantity("ż", "m/s"),
        Quantity("θ̇", "rad/s"),
    )
    ACTION = (Quantity("left", "N"), Quantity("right", "N"))

    def derivative(self, x: ops.Vector, u: ops.Vector) -> ops.Vector:
        _, _, theta, *rates = ops.components(x)
        left, right = ops.components(u)
        thrust = self.mass * self.gravity + left + right
        turn = self.arm * (right - left) / self.inertia
        across, up = -thrust * ops.sin(theta) / self.mass, thrust * ops.cos(theta) / self.mass - self.gravity
        return ops.stack((*rates, across, up, turn), like=x)

    def position(self, x: np.ndarray) -> np.ndarray:
        return np.array([x[0], 0.0])

    def shapes(self, x: np.ndarray) -> list[Shape]:
        wing = self.arm * np.array([math.cos(x[2]), 0.0, math.sin(x[2])])
        centre = np.array([x[0], 0.0, 2.0 + x[1]])
        return [Cylinder(tuple(centre - wing), tuple(centre + wing), 0.03)]


@dataclass(frozen=True)
class QuadrotorTask(Task):
    """From any angle, moving, to rest at the origin."""

    duration: float = 3.0
    start_position: float = 1.0
    start_speed: float = 2.0
    start_angle: float = math.pi

    id = "PlanarQuadrotor-v0"
    ROBOT = "quadrotor"
    state_draws = 5
    observation_scale = (1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 5.0)

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        limits = (self.start_position, self.start_position, self.start_angle, self.start_speed, self.start_speed)
        return (*(ops.between(part, -most, most) for part, most in zip(z, limits, strict=True)), 0.0 * z[0])

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        px, pz, theta, vx, vz, rate = ops.components(x)
        upright = 2 * (1 - ops.cos(theta))
        moving = 0.1 * ops.squared(vx, vz) + 0.01 * rate * rate
        return ops.squared(px, pz) + upright + moving + 0.05 * ops.squared(*ops.components(u))

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        px, pz, theta, vx, vz, _ = ops.components(x)
        upright = (1 - ops.cos(theta)) / (1 - math.cos(0.1)) - 1
        return ops.squared(px, pz) / 0.1**2 - 1, upright, ops.squared(vx, vz) / 0.2**2 - 1

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        px, pz, theta, *rates = ops.components(x)
        return ops.scaled((px, pz, ops.cos(theta), ops.sin(theta), *rates), self.observation_scale, like=x)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Any) -> Reference:
        """Hovering, by the nearer turn."""
        return Reference(
            np.array([[0.0, 0.0, 2 * math.pi * round(x[2] / (2 * math.pi)), 0.0, 0.0, 0.0]]), np.zeros((1, 2))
        )

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """To the origin within 1.5 s, while it turns upright to either side."""
        share = np.minimum(np.linspace(0, self.duration / 1.5, self.steps + 1), 1.0)[:, None]
        ends = (np.array([0, 0, 2 * math.pi * turn, 0, 0, 0]) for turn in (0, math.copysign(1, x[2])))
        return [((1 - share) * x + share * end, np.zeros((self.steps, 2))) for end in ends]


register_robot("quadrotor", Quadrotor())
register_task(QuadrotorTask, "quadrotor")
