"""The cart-pole swing-up of Kelly, "An introduction to trajectory optimization" (SIAM Review 2017), section 6."""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_classic.cart_pole import CartPole
from ballbot_gym import Reference, Robot, Task, ops, register_robot, register_task


@dataclass(frozen=True)
class KellySwingUp(Task):
    """From rest, hanging at 0, to rest, upright at `distance`, in `duration`, with the least ∫ F² dt.

    Kelly's end is exact. Here it is reached within `tolerance` of every component of the state, in m, rad and per second.
    """

    duration: float = 2.0
    distance: float = 1.0
    track: float = 2.0
    tolerance: float = 1e-4

    id = "KellyCartPole-v0"
    ROBOT = "kelly_cart_pole"
    observation_scale = (2.0, 3.0, 5.0, 10.0)
    margin_names = ("track",)
    first_exit = True

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        return 0.0, math.pi, 0.0, 0.0

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        return ops.squared(*ops.components(u))

    def margins(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        place = ops.components(x)[0]
        return (self.track - place * place / self.track,)

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        place, theta, speed, rate = ops.components(x)
        square = self.tolerance * self.tolerance
        ends = ((place - self.distance) ** 2, 2 * (1 - ops.cos(theta)), speed * speed, rate * rate)
        return tuple(end / square - 1 for end in ends)

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        return ops.scaled(ops.components(x), self.observation_scale, like=x)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Robot) -> Reference:
        return Reference(np.array([[self.distance, 0.0, 0.0, 0.0]]), np.zeros((1, 1)))

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """To the end by either turn of the pole: straight lines, as Kelly guesses, and a swing back before the pole rises."""
        share = np.linspace(0, 1, self.steps + 1)
        found = []
        for back, turn in itertools.product((0.0, 1.0), (-math.pi, math.pi)):
            theta = (
                math.pi
                + turn * share ** (1 + back)
                - back * math.copysign(1.0, turn) * np.sin(math.pi * share) * (1 - share)
            )
            states = np.stack([self.distance * share, theta, 0 * share, 0 * share], axis=-1)
            found.append((states, np.zeros((self.steps, 1))))
        return found


register_robot("kelly_cart_pole", CartPole(cart_mass=1.0, pole_mass=0.3, length=0.5, gravity=9.81, force_limit=20.0))
register_task(KellySwingUp, "kelly_cart_pole")
