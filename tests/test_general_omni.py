"""A robot with wheels as it was built: wheels anywhere, centre of mass off the axis, dry friction in its axles."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ballbot_baselines import LqrController, NmpcController
from ballbot_baselines.feedback.adaptive import FilteredController
from ballbot_baselines.feedback.kalman import SensorFilter
from ballbot_baselines.identification.estimate import Problem
from ballbot_baselines.identification.likelihood import Innovations
from ballbot_baselines.identification.record import record
from ballbot_gym import BallbotEnv, GeneralOmni, Randomization, named_robot, read_urdf, rollout
from ballbot_gym.engines import installed_physics, make_simulator
from ballbot_gym.env import make_task
from ballbot_gym.robot import Omni, urdf_text

OMNI: Any = named_robot("omni")
SAME = GeneralOmni.of(OMNI)
ROBOT = replace(
    SAME, com_x=0.03, com_y=-0.02, zenith=0.7, azimuth_1=0.1, azimuth_2=2.0, azimuth_3=4.4, axle_friction=0.2
)
LOSSLESS = replace(
    ROBOT, axle_friction=0.0, wheels=replace(ROBOT.wheels, damping=0.0, spin_friction=0.0, no_load_speed=1e9)
)


@pytest.fixture
def motions():
    """(20, 11) states and (20, 3) forces."""
    rng = np.random.default_rng(0)
    return 0.5 * rng.normal(size=(20, 11)), 20 * rng.normal(size=(20, 3))


def test_wheels_at_the_usual_places_and_a_centred_mass_are_the_usual_robot(motions):
    x, u = motions
    np.testing.assert_allclose(SAME.derivative(x, u), OMNI.derivative(x, u), atol=1e-11)
    np.testing.assert_allclose(SAME.turning_ball(x, u[:, :2]), OMNI.turning_ball(x, u[:, :2]), atol=1e-11)
    for state, force in zip(x, u, strict=True):
        np.testing.assert_allclose(SAME.readings(state, force), OMNI.readings(state, force), atol=1e-11)
        np.testing.assert_allclose(SAME.contact(state, force), OMNI.contact(state, force), atol=1e-10)
        np.testing.assert_allclose(
            SAME.torque_on_ball(state, tuple(force), force), OMNI.torque_on_ball(state, tuple(force), force), atol=1e-11
        )


def test_energy_grows_by_the_power_of_the_motors_where_nothing_rubs(motions):
    h = 1e-6
    for x, u in zip(*motions, strict=True):
        slope = LOSSLESS.derivative(x, u)
        gained = (LOSSLESS.energy(x + h * slope) - LOSSLESS.energy(x - h * slope)) / (2 * h)
        speeds = LOSSLESS.wheels.radius * np.array(LOSSLESS.readings(x, u)[6:])
        assert gained == pytest.approx(u @ speeds, rel=1e-5)


def test_the_floor_gives_the_force_that_moves_ball_and_centre_of_mass(motions):
    h = 1e-4
    for x, u in zip(*motions, strict=True):
        before, now, after = (LOSSLESS.step(x, u, t, 1) for t in (-h, 0.0, h))
        body = [_centre_of_mass(LOSSLESS, state) for state in (before, now, after)]
        ball = [np.array([*state[:2], 0.0]) for state in (before, now, after)]
        faster = [(a - 2 * b + c) / h**2 for a, b, c in (body, ball)]
        wanted = LOSSLESS.body_mass * faster[0] + LOSSLESS.ball_mass * faster[1] + [0, 0, LOSSLESS.weight]
        np.testing.assert_allclose(LOSSLESS.contact(x, u), wanted, rtol=1e-3, atol=1e-2)


def _centre_of_mass(robot, x):
    gamma, theta, psi = x[2], x[3], x[8]
    cos, sin = np.cos, np.sin
    lean = np.array([[cos(gamma), 0, sin(gamma)], [0, 1, 0], [-sin(gamma), 0, cos(gamma)]])
    lean = lean @ np.array([[1, 0, 0], [0, cos(theta), sin(theta)], [0, -sin(theta), cos(theta)]])
    turned = lean @ np.array([[cos(psi), -sin(psi), 0], [sin(psi), cos(psi), 0], [0, 0, 1]])
    return np.array([*x[:2], 0.0]) + turned @ np.array(robot.centre_of_mass)


def test_it_rests_with_its_centre_of_mass_above_the_ball():
    rest = ROBOT.rest()
    assert np.abs(ROBOT.derivative(rest, np.zeros(3))).max() < 1e-12
    np.testing.assert_allclose(_centre_of_mass(ROBOT, rest)[:2], 0.0, atol=1e-12)


@pytest.mark.parametrize("physics", [name for name in installed_physics() if name != "rk4"])
def test_engines_move_it_as_the_closed_form_does(physics):
    robot = replace(ROBOT, friction=5.0)
    simulator = make_simulator(physics, robot, 0.02)
    x = np.array([0, 0, 0.05, -0.04, 0.1, 0.2, 0.1, 0, 0.5, 0.3, 0.4])
    simulator.reset(tuple(x.tolist()))
    found = x
    for k in range(15):
        u = np.array([3, -2, 1.0]) * np.cos(0.3 * k)
        found, x = simulator.step(tuple(u)), robot.step(x, u, 0.02, 8)
    np.testing.assert_allclose(found[:4], x[:4], atol=2e-3)
    np.testing.assert_allclose(found[8:9], x[8:9], atol=2e-3)


def test_its_urdf_is_read_back(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(ROBOT))
    assert read_urdf(path) == ROBOT
    assert type(named_robot("omni")) is Omni  # whose URDF has none of these numbers


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"zenith": 0.0}, "lie in a plane"),
        ({"azimuth_2": 0.1}, "lie in a plane"),
        ({"axle_friction": -1.0}, "axle_friction must be at least 0"),
        ({"com_x": np.nan}, "com_x must be finite"),
    ],
)
def test_numbers_out_of_range_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        replace(ROBOT, **wrong)


def test_randomization_moves_the_centre_of_mass_and_the_wheels():
    varied = Randomization(com_offset=0.01, wheel_error=0.02)
    env = BallbotEnv(make_task("stabilize", "omni"), "rk4", robot=SAME, randomization=varied)
    _, info = env.reset(seed=0)
    drawn = dict(zip((*varied.DRAWN, *varied.DISPLACED), env.get_state().drawn, strict=True))
    assert 0 < abs(drawn["com_x"]) < 0.05
    robot: Any = varied.robot(SAME, env.get_state().drawn)
    assert robot.zenith == pytest.approx(SAME.zenith + drawn["zenith"])
    after = env.step(np.zeros(3))[4]["state"]
    np.testing.assert_allclose(after, robot.step(info["state"], np.zeros(3), 0.02), atol=1e-9)
    with pytest.raises(ValueError, match="give a GeneralOmni"):
        BallbotEnv("stabilize", "rk4", robot="omni", randomization=varied).reset(seed=0)


def test_lqr_brings_it_to_rest_despite_dry_friction():
    task = make_task("stabilize", "omni")
    robot = replace(SAME, com_x=0.01, com_y=-0.005, axle_friction=0.3)
    controller = LqrController(task, robot)
    x = robot.rest() + np.array([0.3, -0.2, 0.04, 0.02, *[0.0] * 7])
    run = rollout(BallbotEnv(task, "rk4", robot=robot), controller, options={"state": x})
    assert len(run.trajectory.u) == 400
    np.testing.assert_allclose(run.trajectory.x[-1, :2], 0.0, atol=0.01)


def test_identification_estimates_what_the_usual_robot_does_not_have():
    names = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
    own = {each.name for each in Problem(ROBOT, names).parameters} - {
        each.name for each in Problem(OMNI, names).parameters
    }
    assert own == {"com_x", "com_y", "zenith", "axle_friction", "force drift"}
    moved = replace(ROBOT, com_x=0.02, axle_friction=0.3)
    problem = Problem(ROBOT, names)
    z = problem.z_of(moved, 0.0, np.zeros(len(problem.parameters)))
    values = {name: float(value[0]) for name, value in problem.values(z[None]).items()}
    found: Any = problem.robot_of(values)
    assert (found.com_x, found.axle_friction) == (pytest.approx(0.02), pytest.approx(0.3))


def test_the_first_reading_of_a_filter_does_not_take_unknown_friction_for_a_lean():
    task, robot, known = (
        make_task("stabilize", "omni"),
        replace(SAME, axle_friction=0.6),
        replace(SAME, axle_friction=0.1),
    )
    env = BallbotEnv(task, "rk4", robot=robot, observation="sensors")
    seen, _ = env.reset(seed=1, options={"state": np.array([0.0, 0.0, 0.0, 0.0, 0.5, -0.4, *[0.0] * 5])})
    controller = FilteredController(task, known, "-ekf", LqrController(task, known))
    controller.reset(0.0, seen, np.zeros(0))
    assert np.abs(controller.filter.x[2:4]).max() < 0.1
    np.testing.assert_allclose(controller.filter.x[4:6], [0.5, -0.4], atol=0.05)


def test_the_first_lean_of_a_robot_that_moves_is_not_that_of_a_model_linear_about_rest():
    task, robot = make_task("stabilize", "omni"), replace(SAME, axle_friction=0.3)
    env = BallbotEnv(task, "rk4", robot=robot, observation="sensors")
    x = np.array([0.0, 0.0, 0.1, -0.05, 0.5, -0.4, *[0.0] * 5])
    seen, _ = env.reset(seed=1, options={"state": x})
    controller = FilteredController(task, robot, "-ekf", LqrController(task, robot))
    controller.reset(0.0, seen, np.zeros(0))
    np.testing.assert_allclose(controller.filter.x[2:4], x[2:4], atol=0.1)  # 0.06; 0.20 if linear about rest


@pytest.mark.slow
def test_behind_its_filter_lqr_brings_a_robot_to_rest_whose_friction_and_centre_of_mass_it_does_not_know():
    task = make_task("stabilize", "omni")
    robot = replace(SAME, com_x=0.004, axle_friction=0.3)
    known = replace(SAME, axle_friction=0.1)
    env = BallbotEnv(task, "rk4", robot=robot, observation="sensors")
    seen, info = env.reset(seed=1, options={"state": np.array([0.3, -0.2, 0.03, 0.02, *[0.0] * 7])})
    controller = FilteredController(task, known, "-ekf", LqrController(task, known))
    controller.reset(0.0, seen, np.zeros(0))
    for k in range(400):
        seen, *_, info = env.step(controller.act(0.02 * k, seen) / known.force_limit)
    np.testing.assert_allclose(info["state"][:2], 0.0, atol=0.05)


def test_nmpc_plans_without_dry_friction_and_overcomes_it(interpreted):
    task, robot = make_task("stabilize", "omni", duration=2.0), replace(SAME, axle_friction=0.3)
    x, forces = np.array([0.3, -0.2, 0.03, 0.02, 0.1, *[0.0] * 6]), []
    for model in (robot, robot.without_dry_friction()):
        nmpc = NmpcController(task, model)
        nmpc.reset(0.0, x, np.zeros(0))
        forces.append(nmpc.act(0.0, x))
    np.testing.assert_allclose(forces[0], robot.overcoming(x, forces[1], task.control_dt))
    assert np.abs(forces[0] - forces[1]).max() > 1.0


def test_forces_that_a_log_took_for_drifts_do_not_hide_the_lean():
    task, robot, known = (
        make_task("stabilize", "omni"),
        replace(SAME, axle_friction=0.3),
        replace(SAME, axle_friction=0.1),
    )
    env = BallbotEnv(task, "rk4", robot=robot, observation="sensors")
    seen, info = env.reset(seed=1, options={"state": np.array([0.3, -0.2, 0.05, 0.04, *[0.0] * 7])})
    drifts = {"accel_x bias": 0.0, "accel_y bias": 0.0, "speed drift": 0.2, "lean rate drift": 0.35}
    controller, errors = FilteredController(task, known, "-ekf", LqrController(task, known), drifts), []
    controller.reset(0.0, seen, np.zeros(0))
    for k in range(200):
        u = controller.act(0.02 * k, seen)
        errors.append(controller.filter.x[2:4] - info["state"][2:4])
        seen, *_, info = env.step(u / known.force_limit)
    assert np.sqrt(np.mean(np.square(errors[25:]))) < 0.001  # rad; 0.005 if speeds drift and forces do not
    np.testing.assert_allclose(info["state"][:2], 0.0, atol=0.03)


def test_logs_of_robots_with_dry_friction_have_unknown_forces_of_wheels():
    robot = replace(SAME, axle_friction=0.2)
    log = record(robot, 6.0, randomization=None, physics="rk4").readings
    problem = Problem(robot, log.names)
    names = [each.name for each in problem.parameters]
    assert "force drift" not in [each.name for each in Problem(SAME, log.names).parameters]
    z = np.zeros((2, len(names)))
    z[0, names.index("force drift")] = -5.0
    none, forces = Innovations.of(robot, log, problem.lanes(z)).variance[25:].mean(axis=0)
    assert (forces[6:] > none[6:]).all()  # angles of wheels
    known = Problem(robot, log.names, tuple(name for name in names if name not in ("axle_friction", "force drift")))
    found = known.most_likely([log])
    assert found.robot.axle_friction == pytest.approx(0.2, rel=0.1)  # pyright: ignore[reportAttributeAccessIssue]
    assert found.estimates[-1].value < 0.5  # N·s in a second: the wheels do what the equations say


def test_a_filter_expects_no_less_noise_than_its_sensors_have():
    task = make_task("stabilize", "omni")
    usual = SensorFilter(task, SAME).reading_variance
    log = {"gyro noise": 1e-6, "accel noise": 0.3, "wheel_angle noise": 1e-6}
    found = SensorFilter(task, SAME, log).reading_variance
    np.testing.assert_array_equal(found[[0, 1, 2, 6, 7, 8]], usual[[0, 1, 2, 6, 7, 8]])
    np.testing.assert_allclose(found[3:6], 0.09)


def test_a_filter_of_a_robot_with_dry_friction_believes_the_gyroscope_across_the_axis_after_some_steps():
    task, robot = make_task("stabilize", "omni"), replace(SAME, axle_friction=0.1)
    usual, log = SensorFilter(task, SAME).reading_variance, {"gyro noise": 0.05}
    controller = FilteredController(task, robot, "-ekf", LqrController(task, robot), log)
    seen = BallbotEnv(task, "rk4", robot=robot, observation="sensors").reset(seed=0)[0]
    controller.reset(0.0, seen, np.zeros(0))
    noises = []
    for k in range(201):
        noises.append(controller.filter._noise.diagonal()[:3].copy())  # pyright: ignore[reportAttributeAccessIssue]
        controller.act(0.02 * k, seen)
    np.testing.assert_allclose(noises[0], 0.05**2)
    np.testing.assert_allclose(noises[-1], [*usual[:2], 0.05**2], rtol=0.2)
    np.testing.assert_allclose(SensorFilter(task, SAME, log).reading_variance[:3], 0.05**2)


def test_a_filter_lets_the_force_of_each_wheel_jump_as_much_as_in_the_log():
    task, robot = make_task("stabilize", "omni"), replace(SAME, axle_friction=0.1)
    seen, spreads = BallbotEnv(task, "rk4", robot=robot, observation="sensors").reset(seed=0)[0], []
    for drift in (0.0, 2.0):
        log = {"speed drift": 0.0, "lean rate drift": 0.0, "force drift": drift}
        controller = FilteredController(task, robot, "-ekf", LqrController(task, robot), log)
        controller.reset(0.0, seen, np.zeros(0))
        for t in (0.0, 0.02):
            controller.act(t, seen)
        spreads.append(controller.filter._p[9, 9])  # pyright: ignore[reportAttributeAccessIssue]
    assert spreads[1] > 1.5 * spreads[0]
