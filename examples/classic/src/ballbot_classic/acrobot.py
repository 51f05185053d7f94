"""An acrobot: two links like a gymnast on a bar, who has a motor in the hip alone."""

import itertools
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

_TURN = 2 * math.pi
# of guessed swing-ups: how hard they pump, side to which the hip bends first, and for how long, s
_FAMILY = ((0.5, 1.0, 2.0, 4.0), (1.0, -1.0), (0.0, 0.2, 0.4, 0.8))
_SOLVED = 12  # guesses
_SAME = 1e-3  # relative: guesses whose costs differ by less are the same


@dataclass(frozen=True)
class Acrobot(Robot):
    """Two uniform rods, the first on a fixed hinge, and a motor in the hinge between them.

    | field | meaning | unit |
    |---|---|---|
    | mass1, mass2, length1, length2 | of the rods | kg, m |
    | gravity | | m/s² |
    | force_limit | largest torque of the motor | N·m |
    """

    mass1: float = 1.0
    mass2: float = 1.0
    length1: float = 1.0
    length2: float = 1.0
    gravity: float = 9.81
    force_limit: float = 15.0

    # θ1 is the first rod's angle from upright, θ2 the angle of the second rod to the first
    STATE = (Quantity("θ1", "rad"), Quantity("θ2", "rad"), Quantity("θ̇1", "rad/s"), Quantity("θ̇2", "rad/s"))
    ACTION = (Quantity("torque", "N·m"),)
    MEASUREMENTS = (Quantity("height", "m"),)

    def derivative(self, x: ops.Vector, u: ops.Vector) -> ops.Vector:
        """Lagrange's equations of two rods (Spong, "The swing up control problem for the acrobot", 1995), from upright."""
        first, second, rate1, rate2 = ops.components(x)
        (torque,) = ops.components(u)
        m2, l1, half1, half2 = self.mass2, self.length1, self.length1 / 2, self.length2 / 2
        own1 = self.mass1 * (self.length1 * self.length1 / 12 + half1 * half1) + m2 * l1 * l1
        own2 = m2 * (self.length2 * self.length2 / 12 + half2 * half2)
        between = m2 * l1 * half2
        cos, sin = ops.cos(second), ops.sin(second)
        m11, m12, m22 = own1 + own2 + 2 * between * cos, own2 + between * cos, own2
        fall2 = m2 * self.gravity * half2 * ops.sin(first + second)
        fall1 = (self.mass1 * half1 + m2 * l1) * self.gravity * ops.sin(first) + fall2
        right1 = between * sin * (2 * rate1 * rate2 + rate2 * rate2) + fall1
        right2 = torque - between * sin * rate1 * rate1 + fall2
        determinant = m11 * m22 - m12 * m12
        turn1 = (m22 * right1 - m12 * right2) / determinant
        turn2 = (m11 * right2 - m12 * right1) / determinant
        return ops.stack((rate1, rate2, turn1, turn2), like=x)

    def energy(self, x: ops.Vector) -> Any:
        """J, of both rods, 0 at rest at the height of the fixed hinge."""
        first, second, rate1, rate2 = ops.components(x)
        both, half2 = rate1 + rate2, self.length2 / 2
        turning = self.mass1 * self.length1**2 / 6 * rate1**2 + self.mass2 * self.length2**2 / 24 * both**2
        speed2 = (self.length1 * rate1) ** 2 + (half2 * both) ** 2
        speed2 = speed2 + 2 * self.length1 * half2 * rate1 * both * ops.cos(second)
        high2 = self.length1 * ops.cos(first) + half2 * ops.cos(first + second)
        high = self.mass1 * self.length1 / 2 * ops.cos(first) + self.mass2 * high2
        return turning + self.mass2 * speed2 / 2 + self.gravity * high

    def measurements(self, x: ops.Vector) -> tuple[Any, ...]:
        first, second, *_ = ops.components(x)
        return (self.length1 * ops.cos(first) + self.length2 * ops.cos(first + second),)

    def shapes(self, x: np.ndarray) -> list[Shape]:
        bar, both = (0.0, 0.0, 1.3), x[0] + x[1]
        hip = (self.length1 * math.sin(x[0]) / 2, 0.0, 1.3 + self.length1 * math.cos(x[0]) / 2)
        tip = (hip[0] + self.length2 * math.sin(both) / 2, 0.0, hip[2] + self.length2 * math.cos(both) / 2)
        return [Cylinder(bar, hip, 0.03), Cylinder(hip, tip, 0.03, "#b03a2e"), Sphere(bar, 0.05, "#292e3b")]


@dataclass(frozen=True)
class AcrobotUp(Task):
    """Swing both rods up and hold them there.

    Start: both hang within `start_angle` of straight down, at rest. The hip may turn by `hip` to either side.
    """

    duration: float = 5.0
    start_angle: float = 0.3
    hip: float = 3.0

    id = "AcrobotSwingUp-v0"
    ROBOT = "acrobot"
    state_draws = 2
    observation_scale = (1.0, 1.0, 1.0, 1.0, 5.0, 5.0)
    margin_names = ("hip",)

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        first = math.pi + ops.between(z[0], -self.start_angle, self.start_angle)
        return first, ops.between(z[1], -self.start_angle, self.start_angle), 0.0 * z[0], 0.0 * z[0]

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        first, second, rate1, rate2 = ops.components(x)
        up = 4 - 2 * ops.cos(first) - 2 * ops.cos(first + second)
        return 5 * up + 0.05 * ops.squared(rate1, rate2) + 0.02 * ops.squared(*ops.components(u))

    def margins(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        second = ops.components(x)[1]
        return (self.hip - second * second / self.hip,)

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        first, second, *rates = ops.components(x)
        up = 2 - ops.cos(first) - ops.cos(first + second)
        return up / (2 - 2 * math.cos(0.1)) - 1, ops.squared(*rates) / 0.5**2 - 1

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        first, second, *rates = ops.components(x)
        seen = (ops.cos(first), ops.sin(first), ops.cos(second), ops.sin(second), *rates)
        return ops.scaled(seen, self.observation_scale, like=x)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Any) -> Reference:
        """Upright, by the nearer turn."""
        return Reference(np.array([[_TURN * round(x[0] / _TURN - 1e-9), 0.0, 0.0, 0.0]]), np.zeros((1, 1)))

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """The hip pumps in the rhythm of the upper rod, at first to either side; the cheapest motions come first."""
        pump, side, wait = np.array(list(itertools.product(*_FAMILY))).T
        states, torques = [np.tile(x, (len(pump), 1))], []
        for k in range(self.steps):
            now = states[-1]
            ahead = 0.8 * np.tanh(pump * now[:, 2] + np.where(k * self.control_dt < wait, side, 0.0))
            torque = np.clip(30 * (ahead - now[:, 1]) - 5 * now[:, 3], -params.force_limit, params.force_limit)[:, None]
            states.append(params.step(now, torque, self.control_dt))
            torques.append(torque)
        moved, applied = np.stack(states, axis=1), np.stack(torques, axis=1)
        free = np.abs(moved[..., 1]).max(axis=1) < 0.97 * self.hip
        costs = self.control_dt * self.cost(moved[:, :-1], applied, np.zeros(0)).sum(axis=1)
        order = [i for i in np.argsort(costs, kind="stable").tolist() if free[i]]
        new = [i for n, i in enumerate(order) if all(abs(costs[i] - costs[j]) > _SAME * costs[i] for j in order[:n])]
        return [(moved[i], applied[i]) for i in new]

    def search_cases(self, episode: Any) -> list[Any]:
        """From more guesses than usual: swing-ups of other sides and numbers of swings are far apart."""
        limit, motions = episode.params.force_limit, self.guesses(episode.x0, episode.c, episode.params)
        return [episode.solve(x, u / limit, barrier=1e-3) for x, u in motions[:_SOLVED]]


register_robot("acrobot", Acrobot())
register_task(AcrobotUp, "acrobot")
