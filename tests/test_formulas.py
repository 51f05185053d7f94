"""Tasks of users whose formulas no optimizer can use are refused at once, with the method's name and what to do."""

import math

import numpy as np
import pytest

from ballbot_baselines import find_optima, find_optimum
from ballbot_gym import ops
from ballbot_gym.robots import named_robot
from ballbot_gym.tasks.stabilize import Stabilize

BAD = {
    "if": (lambda cost, px: cost if px > 0 else 2 * cost, "cost cannot be differentiated .*ballbot_gym.ops"),
    "math": (lambda cost, px: cost + math.sin(px), "cost (is not finite|cannot be differentiated).*not with if"),
    "step": (lambda cost, px: cost + ops.where(px > 0.1, 50.0, 0.0), "cost jumps near .*Blend"),
    "kink": (lambda cost, px: cost + 5 * abs(px), "cost has a kink near .*sqrt"),
    "nan": (lambda cost, px: cost * math.nan, "cost is not finite at the start"),
    "unbounded": (lambda cost, px: -cost, "cost is -.* must not be negative"),
}


@pytest.mark.parametrize("name", BAD)
def test_the_optimum_of_a_cost_that_no_optimizer_can_use_is_refused(name):
    change, message = BAD[name]

    class Bad(Stabilize):
        id = f"Bad{name.title()}-v0"

        def cost(self, x, u, c):
            return change(super().cost(x, u, c), ops.components(x)[0])

    task, robot = Bad(), named_robot("paper")
    x, c = task.sample(np.random.default_rng(0), robot)
    with pytest.raises(ValueError, match=f"{task.id}: {message}"):
        find_optimum(task, robot, x, c)
    with pytest.raises(ValueError, match=f"{task.id}: {message}"):
        find_optima(task, robot, x[np.newaxis], c[np.newaxis])


def test_goals_and_margins_are_checked_as_well():
    class Jumping(Stabilize):
        id = "Jumping-v0"

        def margins(self, x, c):
            return (*super().margins(x, c), ops.where(ops.components(x)[0] > 0.1, 1.0, 0.5))

        margin_names = ("tilt", "step")

    task, robot = Jumping(), named_robot("paper")
    with pytest.raises(ValueError, match="margins jumps"):
        find_optimum(task, robot, *task.sample(np.random.default_rng(0), robot))
