"""A robot with three omni-wheels: its equations, its contact, and its engines."""

import copy
import dataclasses
import math

import casadi
import numpy as np
import pytest

from ballbot_baselines import TrajoptController
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym.engines import make_simulator
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import Randomization, Wheels, named_robot, omni
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import Stabilize
from ballbot_gym.vector.batch import BallbotBatch
from ballbot_train import evaluate
from ballbot_train.evaluation import recordings
from ballbot_train.evaluation.submissions import SubmissionError, verify
from ballbot_train.learning import dagger
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.learning.rsl import RslVecEnv
from ballbot_train.policy.files import PolicySpec
from ballbot_train.policy.network import PolicyController, PolicyNetwork

SPREAD = np.array([1, 1, 0.8, 0.8, 2, 2, 2, 2, 3, 3, 5.0])


@pytest.fixture
def robot():
    return named_robot("omni")


def random_states(rng, n=5):
    return zip(rng.uniform(-1, 1, (n, 11)) * SPREAD, rng.uniform(-40, 40, (n, 3)), strict=True)


def lagrange(p):
    """Lagrange's equations with a multiplier for every constraint, by differentiation.

    Coordinates are x, y, γ, θ, ψ, three Euler angles of the ball, and the angles of the wheels relative to the body. The ball
    rolls, and no wheel slips in its driving direction.
    """
    q, v, u = casadi.SX.sym("q", 11), casadi.SX.sym("v", 11), casadi.SX.sym("u", 3)
    x, y, gamma, theta, psi, *ball, _, _, _ = casadi.vertsplit(q)

    def turn(axis, angle):
        kernel = casadi.skew(casadi.DM(axis))
        return casadi.SX.eye(3) + casadi.sin(angle) * kernel + (1 - casadi.cos(angle)) * kernel @ kernel

    def turning(matrix):
        """Angular velocity in the world's frame."""
        return casadi.inv_skew(casadi.reshape(casadi.jtimes(casadi.vec(matrix), q, v), 3, 3) @ matrix.T)

    body = turn((0, 1, 0), gamma) @ turn((-1, 0, 0), theta) @ turn((0, 0, 1), psi)
    of_ball = turning(turn((0, 0, 1), ball[0]) @ turn((0, 1, 0), ball[1]) @ turn((1, 0, 0), ball[2]))
    of_body = turning(body)
    centre = casadi.vertcat(x, y, 0) + p.com_height * body[:, 2]
    speed, own = casadi.jtimes(centre, q, v), body.T @ of_body
    inertia = casadi.DM([p.inertia, p.inertia, p.axial_inertia])
    kinetic = p.ball_mass * casadi.sumsqr(v[:2]) + p.body_mass * casadi.sumsqr(speed) + casadi.dot(inertia, own**2)
    kinetic = (kinetic + p.ball_inertia * casadi.sumsqr(of_ball) + p.wheels.inertia * casadi.sumsqr(v[8:])) / 2
    lagrangian = kinetic - p.body_mass * p.gravity * centre[2]

    surfaces = []
    for azimuth in np.radians((0, 120, 240)):
        drive = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        normal = np.array([np.cos(azimuth), np.sin(azimuth), 1]) / np.sqrt(2)
        surfaces.append(p.ball_radius * np.cross(normal, drive))
    relative = casadi.DM(np.array(surfaces)) @ (body.T @ (of_ball - of_body))
    r = p.ball_radius
    kept = casadi.vertcat(v[0] - r * of_ball[1], v[1] + r * of_ball[0], p.wheels.radius * v[8:] - relative)
    stall = p.force_limit * p.wheels.radius
    motors = p.wheels.radius * u - (stall / p.wheels.no_load_speed + p.wheels.damping) * v[8:]
    spin = of_ball[2]
    friction = -p.wheels.spin_friction * spin / casadi.sqrt(spin**2 + 1)
    forces = casadi.vertcat(casadi.SX(8, 1), motors) + casadi.jacobian(spin, v).T * friction

    momentum, a = casadi.gradient(lagrangian, v), casadi.jacobian(kept, v)
    right = forces + casadi.gradient(lagrangian, q) - casadi.jtimes(momentum, q, v)
    matrix = casadi.blockcat(casadi.jacobian(momentum, v), a.T, a, casadi.SX(5, 5))
    found = casadi.solve(matrix, casadi.vertcat(right, -casadi.jtimes(kept, q, v)))[:11]
    spin_rate = casadi.jtimes(spin, q, v) + casadi.jtimes(spin, v, found)
    outputs = [casadi.vertcat(found[:5], spin_rate), casadi.jacobian(of_ball, v[5:8]), relative / p.wheels.radius]
    return casadi.Function("lagrange", [q, v, u], outputs)


def test_the_equations_are_lagranges_with_a_multiplier_for_every_constraint(robot, rng):
    exact = lagrange(robot)
    for x, u in random_states(rng):
        q = np.concatenate([x[[0, 1, 2, 3, 8]], rng.uniform(-1, 1, 6)])
        turning = np.array([-x[5] / robot.ball_radius, x[4] / robot.ball_radius, x[10]])
        v = np.concatenate([x[[4, 5, 6, 7, 9]], np.zeros(6)])
        v[5:8] = np.linalg.solve(np.array(exact(q, v, u)[1]), turning)
        v[8:] = np.array(exact(q, v, u)[2]).ravel()
        expected = np.array(exact(q, v, u)[0]).ravel()
        scale = 1 + np.abs(expected).max()
        np.testing.assert_allclose(robot.accelerations(x, u), expected, rtol=0, atol=1e-9 * scale)


def test_with_ideal_motors_and_yaw_held_it_is_the_robot_without_wheels(robot, rng):
    ideal = dataclasses.replace(robot, wheels=Wheels(0.05, 1e15, 0.0, 0.0, 0.0))
    rolling = robot.ideal()
    for x, force in random_states(rng):
        x = np.concatenate([x[:9], np.zeros(2)])
        u = ideal.turning_ball(x, force[:2])
        # without the last two equations, because something else holds the body's yaw and the ball's spin
        matrix, right = (np.array(part, float) for part in ideal.equations(x, u))
        expected = rolling.accelerations(x[:8], force[:2])
        np.testing.assert_allclose(np.linalg.solve(matrix[:4, :4], right[:4]), expected, rtol=0, atol=1e-9)


def test_energy_changes_by_the_power_of_motors_and_friction(robot, rng):
    x, u = casadi.SX.sym("x", 11), casadi.SX.sym("u", 3)
    rate = casadi.jtimes(robot.energy(x), x, robot.derivative(x, u))
    w, _ = robot.relative_turning(x)
    pull, drag = robot.torque(u, x[8]), robot.wheels.drag(robot.force_limit) * robot.ball_radius**2
    lost = drag * (omni.ACROSS * (w[0] ** 2 + w[1] ** 2) + omni.ALONG * w[2] ** 2)
    power = sum(a * b for a, b in zip(pull, w, strict=True)) - lost + robot.wheels.floor_torque(x[10]) * x[10]
    function = casadi.Function("powers", [x, u], [rate, power])
    for state, force in random_states(rng):
        found, expected = map(float, function(state, force))
        assert found == pytest.approx(expected, rel=1e-9)


def test_a_wheel_at_its_no_load_speed_has_no_torque_left(robot):
    """A body held still over a ball that spins about the vertical, without friction."""
    free = dataclasses.replace(robot, wheels=dataclasses.replace(robot.wheels, damping=0.0, spin_friction=0.0))
    x = np.zeros(11)
    x[10] = free.wheels.no_load_speed * free.wheels.radius / (free.ball_radius * math.sqrt(0.5))
    assert np.abs(free.accelerations(x, np.full(3, free.force_limit))).max() < 1e-9


def test_the_floor_gives_what_moves_the_whole_robot(robot, rng):
    """Without wheels the closed form finds the same force from the ball's rolling."""
    rolling = robot.ideal()
    ideal = dataclasses.replace(robot, wheels=Wheels(0.05, 1e15, 0.0, 0.0, 0.0))
    for x, force in random_states(rng):
        x = np.concatenate([x[:2], [x[2], 0.0, x[4], 0.0, x[6], 0.0], np.zeros(3)])  # in a plane it does not yaw
        u = ideal.turning_ball(x, (force[0], 0.0))
        expected = rolling.contact(x[:8], (force[0], 0.0))
        np.testing.assert_allclose(ideal.contact(x, u), expected, atol=1e-9)


def test_a_push_gives_its_momentum(robot, rng):
    x, _ = next(random_states(rng))
    impulse = np.array([2.0, -3.0])
    after = robot.pushed(x, impulse)
    np.testing.assert_array_equal(after[[0, 1, 2, 3, 8]], x[[0, 1, 2, 3, 8]])

    # the work of a short force: half the sum of the speeds of the centre of mass before and after
    def speed(x):
        sin_g, cos_g, sin_t, cos_t = np.sin(x[2]), np.cos(x[2]), np.sin(x[3]), np.cos(x[3])
        along = np.array([cos_g * cos_t * x[6] - sin_g * sin_t * x[7], cos_t * x[7]])
        return x[4:6] + robot.com_height * along

    work = impulse @ (speed(x) + speed(after)) / 2
    assert robot.energy(after) - robot.energy(x) == pytest.approx(work, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("radius", 0.0, "radius must be positive"), ("inertia", -1.0, "at least 0"), ("damping", "1", "must be a number")],
)
def test_wheels_that_none_can_be_are_refused(robot, name, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(robot.wheels, **{name: value})


def test_wheels_need_a_ball_that_rolls(robot):
    with pytest.raises(ValueError, match="wheels must be Wheels"):
        dataclasses.replace(robot, wheels=(0.05, 100.0))


def two_force_gain(robot):
    """LQR of the robot without its wheels."""
    return discrete_lqr(Stabilize(), robot.ideal(), np.zeros(8), np.zeros(2), np.zeros(0))[0]


@pytest.mark.parametrize("name", ["omni", "omni_strong"])
@pytest.mark.parametrize(("physics", "module", "most"), [("mujoco", "mujoco", 5e-4), ("bullet", "pybullet", 2e-3)])
def test_in_grip_engines_follow_the_closed_form(name, physics, module, most, rng):
    pytest.importorskip(module)
    robot = named_robot(name)
    gain, errors = two_force_gain(robot), []
    for _ in range(2):
        x = np.array([0.5, 0.5, 0.1, 0.1, 0.5, 0.5, 0.3, 0.3, 3, 1, 1]) * rng.uniform(-1, 1, 11)
        exact, simulator = make_simulator("rk4", robot, 0.02, 0.001), make_simulator(physics, robot, 0.02)
        exact.reset(tuple(x))
        simulator.reset(tuple(x))
        for _ in range(25):
            u = robot.turning_ball(x, -gain @ x[:8]) + rng.normal(0, 3, 3)
            u = tuple(u.clip(-robot.force_limit, robot.force_limit).tolist())
            assert min(robot.held(tuple(x), u, 0.02)[1]) >= 0
            x, found = np.array(exact.step(u)), np.array(simulator.step(u))
        errors.append(np.hypot(*(found - x)[:2]))
        np.testing.assert_allclose(found[[2, 3, 8, 9, 10]], x[[2, 3, 8, 9, 10]], atol=10 * most)
        np.testing.assert_allclose(simulator.floor_force(), robot.contact(x, u), atol=2 * most * robot.weight)
    assert max(errors) < most  # m; measured in 20: MuJoCo 2e-4, PyBullet, which is of first order, 9e-4


def test_mujoco_goes_on_from_what_it_remembers():
    pytest.importorskip("mujoco")
    simulator = make_simulator("mujoco", named_robot("omni"), 0.02)
    simulator.reset((0.0, 0.0, 0.05, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0, 0.5, 0.2))
    x, memory = simulator.step((5.0, -3.0, 1.0)), simulator.memory()
    after = simulator.step((1.0, 2.0, 3.0))
    simulator.reset(x, memory)
    assert simulator.step((1.0, 2.0, 3.0)) == after


@pytest.mark.parametrize("engine", ["torch", "native"])
def test_batches_move_as_single_envs_do(engine, rng):
    torch = pytest.importorskip("torch")
    from ballbot_gym.vector import BallbotVectorEnv

    vector = BallbotVectorEnv(
        3, robot="omni", engine=engine, dtype=torch.float64, compile=False if engine == "torch" else "auto"
    )
    env = BallbotEnv(robot="omni", physics="rk4")
    _, infos = vector.reset(seed=0)
    env.reset(options={"state": infos["state"][0]})
    for actions in rng.uniform(-0.2, 0.2, (5, 3, 3)):
        seen, reward, _, _, infos = vector.step(actions)
        alone, own_reward, _, _, info = env.step(actions[0])
        assert env.observation_space.contains(alone)
        np.testing.assert_allclose(seen[0], alone, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(infos["state"][0], info["state"], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(infos["force"][0], info["force"], rtol=1e-9)
        np.testing.assert_allclose(infos["grip"][0], info["grip"], rtol=1e-9)
        assert reward[0] == pytest.approx(own_reward)
    np.testing.assert_allclose(
        alone[8:], [*np.cos(info["state"][8:9]), *np.sin(info["state"][8:9]), *info["state"][9:] / 5], rtol=1e-6
    )


@pytest.mark.slow  # compiling takes a quarter of a minute
def test_a_batch_whose_equations_are_compiled_agrees_with_an_eager_one():
    torch = pytest.importorskip("torch")
    batches = [
        BallbotBatch("stabilize", 4, compile=compile, robot="omni", observation="sensors") for compile in (True, False)
    ]
    for batch in batches:
        batch.reset(seed=0)
    actions = 0.1 * torch.ones(4, 3)
    batches[0].step(actions), batches[1].step(actions)
    results = [batch.step(actions) for batch in (*batches, copy.deepcopy(batches[0]))]
    for result in results[1:]:
        torch.testing.assert_close(result.final_x, results[0].final_x, rtol=1e-4, atol=1e-5)


def test_a_tracked_plan_comes_to_rest_at_the_cost_that_it_said():
    task = make_task("stabilize", "omni", duration=3.0)
    robot, start = named_robot("omni"), np.array([0.3, -0.2, 0.05, 0.0, 0.1, 0.2, 0.0, 0.0, 0.3, 0.0, 0.0])
    controller = TrajoptController(task, robot)
    episode = rollout(BallbotEnv(task, robot=robot, physics="rk4"), controller, options={"state": start})
    assert episode.success
    assert controller.plan.is_optimal
    assert episode.cost == pytest.approx(controller.plan.cost, rel=1e-3)
    limits = robot.limits(controller.plan.trajectory.x[:-1], controller.plan.trajectory.u)
    assert np.min(limits) >= 0


@pytest.mark.parametrize(
    ("learner", "settings"),
    [
        ("apg", {"num_envs": 16, "episode_seconds": 0.3}),
        ("dagger", {"episodes_per_iteration": 1, "gradient_steps": 2}),
    ],
)
def test_learners_command_three_motors(robot, learner, settings, monkeypatch):
    monkeypatch.setattr(dagger, "_SECONDS", 0.5)  # of each episode
    task = make_task("stabilize", "omni", duration=3.0)
    algorithm = LEARNERS[learner]
    settings = dataclasses.replace(algorithm.settings("stabilize"), iterations=1, hidden=(8,), **settings)
    made = algorithm.make(task, robot, settings, seed=0)
    episode = rollout(BallbotEnv(task, robot=robot, physics="rk4"), PolicyController(task, robot, made.network), seed=0)
    assert episode.success  # it starts as LQR
    before = {name: part.clone() for name, part in made.network.state_dict().items()}
    made.iterate()
    shape = {"activation": "silu", "squash": "clip"} if learner == "dagger" else {}
    assert made.network.spec == PolicySpec.of(task, "omni", hidden=(8,), **shape)
    assert all(part.isfinite().all() for part in made.network.state_dict().values())
    assert any((part != before[name]).any() for name, part in made.network.state_dict().items())
    with pytest.raises(ValueError, match="cannot start"):
        algorithm.make(task, robot, settings, 0, start=PolicyNetwork(PolicySpec.of(task, hidden=(8,))))


def test_rsl_rl_commands_three_motors(robot):
    env = RslVecEnv(BallbotBatch("stabilize", 2, robot="omni"))
    assert env.num_actions == robot.action_size == 3


def test_a_free_heading_costs_nothing(robot):
    x, held = np.zeros(11), make_task("turn", "omni")
    x[8] = 0.5
    free = make_task("turn", "omni", heading_weight=0.0)
    costs = [task.cost(x, np.zeros(3), np.ones(1)) for task in (held, free)]
    assert costs[0] - costs[1] == pytest.approx(2 * (1 - math.cos(0.5)))
    assert (
        free.problem()
        == "Turn("
        + ", ".join(part for part in held.problem()[5:-1].split(", ") if not part.startswith("heading_weight"))
        + ")"
    )


def test_what_does_not_support_wheels_names_the_property_that_is_missing(robot):
    task = make_task("stabilize", "omni")
    with pytest.raises(ValueError, match="pushes add to an action Fx, Fy, which Omni does not have"):
        BallbotEnv(robot="omni", physics="rk4", randomization=Randomization(push_impulse=(1.0, 2.0)))
    with pytest.raises(ValueError, match="omni has no symmetry"):
        PolicySpec.of(task, robot="omni", frame="orbit")


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_model_free_learners_train_wheels(robot, name):
    settings = dataclasses.replace(LEARNERS[name].settings("stabilize"), num_envs=4, num_steps=2, batch_size=4)
    learner = LEARNERS[name].make(make_task("stabilize", "omni"), robot, settings, 0)
    learner.iterate()
    assert learner.network.spec.actions == 3


def test_a_motion_on_wheels_is_verified_from_its_states_and_actions(tmp_path):
    strong = named_robot("omni_strong")
    evaluate("lqr", "stabilize", 2, "rk4", robot="omni_strong", out=tmp_path)
    (path,) = (tmp_path / "recordings").glob("*.npz")
    held = recordings.Recording.read(path)
    mine = dataclasses.replace(held, about=held.about | {"name": "mine", "link": ""})
    assert mine.states.shape[1] == strong.state_size
    row = verify("mine.npz", episodes=2, content=mine.to_bytes())
    assert row.success == 1.0
    turned = mine.states.copy()
    turned[50, 8] += 1e-4  # the heading of one moment
    with pytest.raises(SubmissionError, match="step 50"):
        verify("mine.npz", episodes=2, content=dataclasses.replace(mine, states=turned).to_bytes())
