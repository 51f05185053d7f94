"""A robot and a task that are not part of the packages: a cart-pole, and its swing-up.

Importing this file registers both. Then all commands for ballbots work here too:

    ballbot benchmark --tasks ballbot_classic.cart_pole:cart_pole --controllers trajopt nmpc
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_gym import (
    Cylinder,
    Quantity,
    Reference,
    Robot,
    Shape,
    Sphere,
    Task,
    ops,
    register_robot,
    register_task,
)


@dataclass(frozen=True)
class CartPole(Robot):
    """A cart on a rail, pushed by a force, with a pole of a point mass on a hinge.

    | field | meaning | unit |
    |---|---|---|
    | cart_mass, pole_mass | | kg |
    | length | of the pole | m |
    | gravity | | m/s² |
    | force_limit | largest force on the cart | N |
    """

    cart_mass: float = 1.0
    pole_mass: float = 0.3
    length: float = 0.5
    gravity: float = 9.81
    force_limit: float = 20.0

    # θ is the pole's angle from upright, positive towards x
    STATE = (Quantity("x", "m"), Quantity("θ", "rad"), Quantity("ẋ", "m/s"), Quantity("θ̇", "rad/s"))
    ACTION = (Quantity("F", "N"),)
    MEASUREMENTS = (Quantity("height", "m"),)

    def derivative(self, x: ops.Vector, u: ops.Vector) -> ops.Vector:
        """Kelly, "An introduction to trajectory optimization" (2017), (6.1) and (6.2), with the angle from upright."""
        _, theta, speed, rate = ops.components(x)
        (force,) = ops.components(u)
        sin, cos, m = ops.sin(theta), ops.cos(theta), self.pole_mass
        moved = self.cart_mass + m * sin * sin
        pull = force + m * self.length * sin * rate * rate
        acceleration = (pull - m * self.gravity * sin * cos) / moved
        turn = ((self.cart_mass + m) * self.gravity * sin - cos * pull) / (self.length * moved)
        return ops.stack((speed, rate, acceleration, turn), like=x)

    def measurements(self, x: ops.Vector) -> tuple[Any, ...]:
        return (self.length * ops.cos(ops.components(x)[1]),)

    def position(self, x: np.ndarray) -> np.ndarray:
        return np.array([x[0], 0.0])

    def shapes(self, x: np.ndarray) -> list[Shape]:
        hinge = (float(x[0]), 0.0, 0.6)
        tip = (hinge[0] + self.length * math.sin(x[1]), 0.0, hinge[2] + self.length * math.cos(x[1]))
        cart = Cylinder((hinge[0] - 0.15, 0.0, 0.6), (hinge[0] + 0.15, 0.0, 0.6), 0.06, "#292e3b")
        return [cart, Cylinder(hinge, tip, 0.02), Sphere(tip, 0.05)]


@dataclass(frozen=True)
class SwingUp(Task):
    """Swing the pole up from hanging, and bring the cart to rest in the middle of the rail.

    Start: the pole hangs within `start_angle` of straight down, and the cart stands within `start_position` of the middle.
    """

    duration: float = 4.0
    start_position: float = 0.5
    start_angle: float = 0.3
    rail: float = 2.0

    id = "CartPoleSwingUp-v0"
    ROBOT = "cart_pole"
    state_draws = 2
    observation_scale = (2.0, 1.0, 5.0, 10.0)
    margin_names = ("rail",)

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        place = ops.between(z[0], -self.start_position, self.start_position)
        angle = math.pi + ops.between(z[1], -self.start_angle, self.start_angle)
        return place, angle, 0.0 * z[0], 0.0 * z[0]

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        place, theta, speed, rate = ops.components(x)
        upright = 2 * (1 - ops.cos(theta))
        return place * place + 5 * upright + 0.1 * ops.squared(speed, rate) + 0.01 * ops.squared(*ops.components(u))

    def margins(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        place = ops.components(x)[0]
        return (self.rail - place * place / self.rail,)

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        place, theta, speed, rate = ops.components(x)
        upright = (1 - ops.cos(theta)) / (1 - math.cos(0.1)) - 1
        return place * place / 0.1**2 - 1, upright, ops.squared(speed, rate) / 0.3**2 - 1

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        return ops.scaled(ops.components(x), self.observation_scale, like=x)

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """The pole goes round to either side in a second, and stays upright."""
        found = []
        for upright in (0.0, 2 * math.pi):
            share = np.minimum(np.linspace(0, self.duration, self.steps + 1), 1.0)[:, None]
            states = (1 - share) * x + share * np.array([0.0, upright, 0.0, 0.0])
            found.append((states, np.zeros((self.steps, 1))))
        return found

    def reference(self, x: np.ndarray, c: np.ndarray, params: Any) -> Reference:
        """Upright, by the nearer turn."""
        upright = 2 * math.pi * round(x[1] / (2 * math.pi) - 1e-9)
        return Reference(np.array([[0.0, upright, 0.0, 0.0]]), np.zeros((1, 1)))


register_robot("cart_pole", CartPole())
register_task(SwingUp, "cart_pole")
