"""What MuJoCo's simulators do beyond what holds for every physics."""

from dataclasses import replace

import numpy as np
import pytest

from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym.engines import make_simulator
from ballbot_gym.robot import named_robot
from ballbot_gym.tasks import Stabilize

pytest.importorskip("mujoco")

SPREAD = np.array([0.5, 0.5, 0.2, 0.2, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5])
"""Of drawn starts, as `Omni.STATE`."""


def drawn(robot, rng, steps=25):
    """Forces of half a second in grip from a drawn start, and the exact states under them, the start first."""
    rest = np.zeros(robot.state_size), np.zeros(robot.action_size)
    gain = discrete_lqr(Stabilize(), robot, *rest, np.zeros(0))[0]
    exact = make_simulator("rk4", robot, 0.02, 0.0005)
    while True:
        states, forces = [SPREAD[: robot.state_size] * rng.uniform(-1, 1, robot.state_size)], []
        exact.reset(tuple(states[0]))
        for _ in range(steps):
            u = np.clip(-gain @ states[-1] + rng.normal(0, 5, robot.action_size), -robot.force_limit, robot.force_limit)
            if min(robot.held(states[-1], u, 0.02)[1], default=0.0) < 0:
                break
            forces.append(tuple(u.tolist()))
            states.append(np.array(exact.step(forces[-1])))
        else:
            return states, forces


@pytest.mark.parametrize("name", ["paper", "rolling", "kugle"])
def test_in_grip_it_follows_the_closed_form(name, rng):
    robot = named_robot(name)
    simulator = make_simulator("mujoco", robot, 0.02)
    errors = []
    for _ in range(12):
        states, forces = drawn(robot, rng)
        simulator.reset(tuple(states[0]))
        end = [simulator.step(u) for u in forces][-1]
        errors.append(np.hypot(*(np.array(end) - states[-1])[:2]))
        assert abs(simulator.height()) < 1e-6
        assert np.hypot(*simulator.slip()) < 1e-5
        if robot.CONTACT:
            expected = robot.contact(states[-1], np.array(forces[-1]))
            np.testing.assert_allclose(simulator.floor_force(), expected, atol=1e-4 * robot.weight)
        else:
            assert simulator.floor_force() is None
    # measured: median 6e-8 m for the paper's, 1e-6 m with contact
    assert np.median(errors) < (1e-5 if robot.CONTACT else 1e-6)


@pytest.mark.parametrize("force", [125.0, 200.0])
def test_its_ball_slips_as_fast_as_bullets(force):
    """MuJoCo's friction is convex: it lifts a ball that slips a little, so that the two differ a little."""
    pytest.importorskip("pybullet")
    robot, slips = named_robot("rolling"), []
    for physics in ("bullet", "mujoco"):
        simulator = make_simulator(physics, robot, 0.02)
        simulator.reset((0.0,) * 8)
        slips.append([])
        for k in range(5):
            simulator.step((force if k < 2 else 0.0, 0.0))
            slips[-1].append(np.hypot(*simulator.slip()))
            assert abs(simulator.height()) < 1e-4
        simulator.close()
    assert max(slips[0]) > 1
    np.testing.assert_allclose(
        slips[1], slips[0], atol=0.2 + 0.06 * max(slips[0])
    )  # measured: 0.3 of 2.5, 0.8 of 17.8 m/s


def test_a_ball_that_is_thrown_up_flies_and_comes_down_with_its_energy_but_what_landing_takes():
    robot = named_robot("rolling")
    simulator = make_simulator("mujoco", robot, 0.02)
    simulator.reset((0.0, 0.0, 1.2, 0.0, 0.0, 0.0, -9.0, 0.0))  # the body swings up and pulls the ball off
    heights, normals = [], []
    for _ in range(75):
        simulator.step((0.0, 0.0))
        heights.append(simulator.height())
        normals.append(simulator.floor_force()[2])
    assert max(heights) > 0.5
    assert {n for n, h in zip(normals, heights, strict=True) if h > 0.01} == {0.0}
    assert min(heights) > -1e-3  # it lands on the floor


def test_an_instability_leaves_no_file_in_the_current_folder(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    robot = replace(named_robot("paper"), force_limit=1e30)
    simulator = make_simulator("mujoco", robot, 0.02)
    simulator.reset((0.0,) * 8)
    for _ in range(10):
        simulator.step((1e25, 1e25))
    assert simulator.is_unstable()
    assert list(tmp_path.iterdir()) == []
    assert "MuJoCo: Nan, Inf or huge value" in caplog.text
