"""A system from textbook equations, in a file of a hundred lines, has its optimum and controllers."""

import math
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from ballbot_baselines import CONTROLLERS, find_optimum
from ballbot_gym import TASKS, BallbotEnv, named_robot, rollout
from ballbot_gym.certified.cache import episode
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(scope="module", autouse=True)
def quadrotor():
    """The task and the robot of the example, which are gone after these tests."""
    sys.path.insert(0, str(EXAMPLES))
    try:
        import quadrotor

        yield quadrotor
    finally:
        sys.path.remove(str(EXAMPLES))
        TASKS.pop("quadrotor", None)
        ROBOTS.pop("quadrotor", None)
        gymnasium.registry.pop("PlanarQuadrotor-v0", None)
        sys.modules.pop("quadrotor", None)


def test_it_is_a_hundred_lines_and_falls_as_a_body_does():
    assert len((EXAMPLES / "quadrotor.py").read_text().splitlines()) <= 100
    robot, x = named_robot("quadrotor"), np.array([0.0, 0.0, 0.0, 1.0, 0.0, 2.0])
    without_thrust = np.full(2, -robot.mass * robot.gravity / 2)
    for _ in range(50):
        x = robot.step(x, without_thrust, 0.01, 1)
    np.testing.assert_allclose(x, [0.5, -9.81 / 8, 1.0, 1.0, -9.81 / 2, 2.0], atol=1e-12)


@pytest.mark.parametrize("index", [0, 2])
def test_its_optimum_is_found_and_controllers_run(index):
    task, robot = make_task("quadrotor"), named_robot("quadrotor")
    start, c = episode(task, robot, index)
    optimum = find_optimum(task, robot, start, c, twice=True)
    assert optimum.is_optimal
    assert task.is_goal(optimum.trajectory.x[-1], c)
    regrets = {}
    with BallbotEnv("quadrotor") as env:
        for name in ("lqr", "nmpc"):
            run = rollout(env, CONTROLLERS[name](task, robot), options={"state": start})
            regrets[name] = run.cost / optimum.cost - 1
    assert regrets["lqr"] > 0.5
    assert -1e-9 < regrets["nmpc"] < 0.05


def test_from_upside_down_it_turns_on_to_the_side_to_which_it_turns_already():
    task, robot = make_task("quadrotor"), named_robot("quadrotor")
    start = np.array([0.0, 0.0, 3.0, 0.0, 0.0, -3.0])
    ends = [states[-1, 2] for states, _ in task.guesses(start, np.zeros(0), robot)]
    assert ends == pytest.approx([0.0, 2 * math.pi])
    optimum = find_optimum(task, robot, start, np.zeros(0))
    assert optimum.trajectory.x[-1, 2] == pytest.approx(0.0, abs=0.1)
