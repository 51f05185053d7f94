"""A ball that rolls: its dynamics, its contact with the floor, and the robots that have one."""

import csv
import dataclasses
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ballbot_baselines import Backoff, NmpcController, find_optimum
from ballbot_baselines.optimum import certification
from ballbot_baselines.solvers import righting
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import certified
from ballbot_gym.engines import make_simulator
from ballbot_gym.engines.closed_form import Rk4Simulator
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import (
    ROBOTS,
    RollingBall,
    UrdfError,
    checked_robot,
    default_params,
    named_robot,
    read_urdf,
    urdf_text,
)
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks import Orbit, Stabilize
from ballbot_gym.trajectory import Trajectory
from ballbot_train.commands.transfer import transfer
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import PolicyError, PolicySpec, shipped_policies
from ballbot_train.policy.network import PolicyNetwork, load_policy

START = (0.0, 0.0, 0.2, -0.15, 0.5, -1.0, 0.3, -0.4)


@pytest.fixture(params=["rolling", "kugle"])
def robot(request):
    return named_robot(request.param)


@pytest.fixture
def rolling():
    return named_robot("rolling")


def newton_euler(p, x, u):
    """Accelerations (4,) and floor force (3,) from the balance of forces and torques on the ball and on the body.

    Unknown are ẍ, ÿ, γ̈, θ̈, the floor's force (3), the force of the ball on the body (3), and the torque that keeps the
    body from yawing.
    """
    _, _, gamma, theta, _, _, gamma_dot, theta_dot = x
    r, ball, body, g = p.ball_radius, p.ball_mass, p.body_mass, p.gravity
    turned = Rotation.from_rotvec([0, gamma, 0])
    turn = turned * Rotation.from_rotvec([-theta, 0, 0])
    e_y, second, yaw_axis = np.eye(3)[1], -turned.apply([1, 0, 0]), turned.apply([0, 0, 1])
    omega = gamma_dot * e_y + theta_dot * second
    omega_rest = theta_dot * gamma_dot * np.cross(e_y, second)  # of the angular acceleration, without γ̈ and θ̈
    centre = p.com_height * turn.apply([0, 0, 1])
    inertia = turn.as_matrix() @ np.diag([p.inertia, p.inertia, p.axial_inertia]) @ turn.as_matrix().T
    torque = r * np.cross([0, 0, 1], [u[0], u[1], 0])
    a, b = np.zeros((13, 11)), np.zeros(13)
    F, J, YAW = slice(4, 7), slice(7, 10), 10
    e = np.eye(3)
    # the ball: forces, then torques about its centre; rolling gives its angular acceleration e_z × p̈ / r
    a[0:3, 0:2], a[0:3, F], a[0:3, J], b[0:3] = ball * e[:, :2], -e, e, [0, 0, -ball * g]
    arm = np.cross([0, 0, -r], e).T  # of the floor's force about the centre
    a[3:6, 0:2], a[3:6, F], b[3:6] = p.ball_inertia / r * np.cross([0, 0, 1], e).T[:, :2], -arm, torque
    a[5, F] = 0  # nothing turns the ball about the vertical
    # the body: forces, then torques about its centre of mass
    a[6:9, 0:2] = body * e[:, :2]
    for column, axis in ((2, e_y), (3, second)):
        a[6:9, column] = body * np.cross(axis, centre)
        a[9:12, column] = inertia @ axis
    a[6:9, J] = -e
    b[6:9] = [0, 0, -body * g] - body * (np.cross(omega_rest, centre) + np.cross(omega, np.cross(omega, centre)))
    a[9:12, J], a[9:12, YAW] = -np.cross(-centre, e).T, -yaw_axis
    b[9:12] = -torque - inertia @ omega_rest - np.cross(omega, inertia @ omega)
    found, _residual, rank, _ = np.linalg.lstsq(a, b, rcond=None)
    assert rank == 11
    assert np.abs(a @ found - b).max() < 1e-9
    return found[:4], found[F]


def random_states(rng, n=20):
    x = rng.uniform(-1, 1, (n, 8)) * [1, 1, 1.0, 1.0, 5, 5, 6, 6]
    return zip(x, rng.uniform(-200, 200, (n, 2)), strict=True)


def test_accelerations_and_contact_are_those_of_newton_and_euler(robot, rng):
    for x, u in random_states(rng):
        accelerations, floor = newton_euler(robot, x, u)
        scale = 1 + np.abs(accelerations).max()
        np.testing.assert_allclose(robot.accelerations(x, u), accelerations, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(robot.contact(x, u), floor, rtol=0, atol=1e-9 * np.abs(floor).max())


def test_the_papers_robot_is_a_rolling_one_of_no_radius_and_inertia(rng):
    paper = default_params()
    almost = RollingBall(**dataclasses.asdict(paper) | {"ball_radius": 1e-9, "ball_inertia": 1e-40})
    for x, u in random_states(rng, 5):
        np.testing.assert_allclose(almost.accelerations(x, u), paper.accelerations(x, u), rtol=1e-6)
        fx, fy, normal = paper.contact(x, u)
        assert (fx, fy) == tuple(u)
        np.testing.assert_allclose(almost.contact(x, u)[2], normal, rtol=1e-6)


def test_the_contact_at_the_end_of_a_step_is_that_of_its_end_state(rolling, rng):
    """Extrapolated without integration: 2 % of the weight at the rates of a fast lean."""
    for x, u in random_states(rng):
        x = x * [1, 1, 0.6, 0.6, 1, 1, 0.4, 0.4]
        begin, end = rolling.held_contact(x, 0.5 * u, 0.02)
        assert begin == rolling.contact(x, 0.5 * u)
        exact = rolling.contact(rolling.step(x, 0.5 * u, 0.02), 0.5 * u)
        np.testing.assert_allclose(end, exact, atol=0.02 * rolling.weight)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<child link="ball" />', '<child link="body" />', "joint 'roll': child link is body, and must be ball"),
        ('name="roll" type="spherical"', 'name="roll" type="fixed"', "must be spherical"),
        ('iyy="0.002"', 'iyy="0.003"', "inertial/inertia iyy is"),
        ('lateral_friction value="0.8"', 'lateral_friction value="0"', "friction must be positive"),
    ],
)
def test_a_wrong_rolling_chain_is_named(old, new, message, rolling, tmp_path):
    path = tmp_path / "robot.urdf"
    text = urdf_text(rolling)
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(UrdfError, match=message):
        read_urdf(path)


def test_a_robot_is_named_or_given(rolling):
    assert checked_robot("rolling") == checked_robot(rolling) == checked_robot("paper", rolling) == rolling
    with pytest.raises(ValueError, match="unknown robot 'rollin'; known: 'paper', 'rolling', 'kugle'"):
        BallbotEnv(robot="rollin", physics="rk4")
    with pytest.raises(ValueError, match="not both"):
        BallbotEnv(robot="rolling", params=rolling, physics="rk4")
    with pytest.raises(TypeError, match="ball_inertia"):
        dataclasses.replace(default_params(), ball_inertia=0.1)
    with pytest.raises(ValueError, match="friction must be positive"):
        dataclasses.replace(default_params(), friction=0.0)


def balancing(robot, steps=25):
    """Forces of LQR from `START`, and the exact states under them."""
    gain = discrete_lqr(Stabilize(), robot, np.zeros(8), np.zeros(2), np.zeros(0))[0]
    exact = Rk4Simulator(robot, 0.02, 0.0005)
    exact.reset(START)
    x, forces, states = np.array(START), [], []
    for _ in range(steps):
        forces.append(tuple((-gain @ x).tolist()))
        x = np.array(exact.step(forces[-1]))
        states.append(x)
    return forces, states


def test_bullets_contact_converges_to_the_closed_form_with_first_order(rolling):
    grippy = dataclasses.replace(rolling, friction=3.0)
    forces, states = balancing(grippy)
    errors = []
    for physics_dt in (2e-3, 1e-3, 5e-4):
        simulator = make_simulator("bullet", grippy, 0.02, physics_dt)
        simulator.reset(START)
        found = [np.array(simulator.step(u)) for u in forces]
        errors.append(np.abs(np.array(found) - states).max())
        np.testing.assert_allclose(simulator.floor_force(), grippy.contact(states[-1], forces[-1]), rtol=0.01)
        assert np.hypot(*simulator.slip()) < 1e-5
        assert abs(simulator.height()) < 1e-4
        simulator.close()
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2, rel=0.1)


def test_bullets_ball_slips_where_the_closed_form_leaves_the_cone(rolling):
    """From standing still, the force at which the ball slips within a control step is that of the cone within 2 %."""

    def slip(force):
        simulator = make_simulator("bullet", rolling, 0.02)
        simulator.reset((0.0,) * 8)
        simulator.step((force, 0.0))
        found = np.hypot(*simulator.slip())
        simulator.close()
        return found

    low, high = 0.0, 350.0
    while high - low > 0.5:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if slip(middle) > 1e-3 else (middle, high)

    def limit(force):
        """The least over the control step."""
        x, u = np.zeros(8), np.array([force, 0.0])
        return min(rolling.limits(rolling.step(x, u, t), u)[1] for t in (1e-6, 0.01, 0.02))

    edge = next(f for f in np.arange(50, 350, 0.25) if limit(f) < 0)
    assert low == pytest.approx(edge, rel=0.02)


def test_losing_grip_is_a_failure_in_the_closed_form(rolling):
    env = BallbotEnv(robot="rolling", physics="rk4")
    _, info = env.reset(options={"state": np.zeros(8)})
    assert info["grip"].tolist() == [0, 0, 0, 0]
    _, _, terminated, _, info = env.step([0.1, 0.0])
    assert not terminated
    np.testing.assert_allclose(info["grip"][:3], rolling.contact(np.zeros(8), np.array([35.0, 0.0])))
    assert info["grip"][3] >= info["grip"][0] / info["grip"][2]
    _, _, terminated, _, info = env.step([1.0, 0.0])
    assert terminated
    assert info["failure"]
    assert env.limit_names[info["violated"]] == "grip"
    assert info["grip"][3] > 0.8


def test_slipping_is_no_failure_in_bullet():
    env = BallbotEnv(robot="rolling", physics="bullet")
    env.reset(options={"state": np.zeros(8)})
    _, _, terminated, _, info = env.step([1.0, 0.0])
    assert not terminated
    assert info["grip"][3] == pytest.approx(0.8, rel=0.01)
    env.close()


@pytest.mark.parametrize("engine", ["torch", "native"])
def test_batches_lose_grip_as_single_envs_do(engine):
    torch = pytest.importorskip("torch")
    from ballbot_gym.vector import BallbotVectorEnv

    count, rng = 8, np.random.default_rng(0)
    vector = BallbotVectorEnv(count, robot="rolling", engine=engine, dtype=torch.float64, autoreset_mode="NextStep")
    env = BallbotEnv(robot="rolling", physics="rk4")
    x = rng.uniform(-0.2, 0.2, (count, 8))
    _, infos = vector.reset(seed=0, options={"state": x})
    assert infos["grip"].shape == (count, 4)
    actions = rng.uniform(-1, 1, (count, 2))
    _, reward, terminated, _, infos = vector.step(actions)
    assert 0 < terminated.sum() < count
    for i in range(count):
        env.reset(options={"state": x[i]})
        _, alone, ended, _, info = env.step(actions[i])
        assert reward[i] == pytest.approx(alone)
        assert (ended, info["violated"]) == (terminated[i], infos["violated"][i])
        np.testing.assert_allclose(infos["grip"][i], info["grip"], rtol=1e-6)
    assert vector.limit_names == env.limit_names


def test_a_robot_draws_its_own_episodes():
    assert Orbit().max_steady_tilt > BallbotEnv("orbit", robot="rolling", physics="rk4").task.max_steady_tilt
    given = BallbotEnv("orbit", robot="rolling", physics="rk4", max_steady_tilt=0.2)
    assert given.task.max_steady_tilt == 0.2


SHORT = Stabilize(duration=3.0)
FAST = np.array([-1.0, 0, 0, 0, 3.0, 2.0, 0, 0])


def test_an_optimum_keeps_the_friction_cone_and_pays_for_it(rolling):
    free = dataclasses.replace(rolling, friction=math.inf)
    best, gripping = (find_optimum(SHORT, robot, FAST, np.zeros(0)) for robot in (free, rolling))
    needed = [rolling.limits(o.trajectory.x[:-1], o.trajectory.u, hold=0.02) for o in (best, gripping)]
    assert np.min(needed[0]) < 0
    assert np.min(needed[1]) >= 0
    assert best.cost < gripping.cost < 1.1 * best.cost
    reserved = find_optimum(SHORT, rolling, FAST, np.zeros(0), Backoff(grip=0.1))
    kept = rolling.limits(reserved.trajectory.x[:-1], reserved.trajectory.u, backoff=0.1, hold=0.02)
    assert np.min(kept) > -1e-6
    assert reserved.cost > gripping.cost


def test_nmpc_keeps_the_friction_cone(rolling):
    env = BallbotEnv(SHORT, robot=rolling, physics="rk4")
    controller = NmpcController(SHORT, rolling)
    episode = rollout(env, controller, options={"state": FAST})
    assert not episode.failure
    assert controller.counts.failed == 0
    limits = rolling.limits(episode.trajectory.x[:-1], episode.trajectory.u, hold=0.02)
    assert np.min(limits) >= 0
    assert episode.cost == pytest.approx(controller.plan.cost, rel=0.02)


def test_simulated_recoveries_grip(rolling):
    x0 = np.array([0, 0, 0.25, 0, 0, 0, 0.3, 0])
    members = righting.righted(Stabilize(), rolling, x0, np.zeros(0), rolling.force_limit)
    assert members
    for member in members:
        assert np.min(rolling.limits(member.x[:-1], member.u, hold=0.02)) >= 0


def test_an_episode_without_an_optimum_is_drawn_again(rolling, monkeypatch):
    """Only where friction is limited: the first two draws of episode 1 are refused here."""
    task = make_task("stabilize", "rolling")
    refused = [certified.cache.episode(task, rolling, 1, draw)[0] for draw in (0, 1)]

    def found(task, params, x, c, twice):
        if any((x == start).all() for start in refused):
            raise PlanError("it cannot but slip")
        t = np.array([0.0, 0.02])
        return SimpleNamespace(
            cost=1.0, violation=0.0, solver="fatrop", solver_status="fine", is_optimal=True,
            trajectory=Trajectory(t, np.array([x, x]), np.zeros((1, 2))),
        )  # fmt: skip

    monkeypatch.setattr(certification, "find_optimum", found)
    entries = dict(certification.entries("stabilize", range(2), "rolling"))
    states = certification.arrays(entries, task, rolling)["states"]
    for i, draw in ((0, 0), (1, 2)):
        np.testing.assert_array_equal(states[i], certified.cache.episode(task, rolling, i, draw)[0])
    refused.append(certified.cache.episode(Stabilize(), default_params(), 0)[0])
    assert next(certification.entries("stabilize", [0], "paper")) == (0, "it cannot but slip")


def test_a_certified_set_is_of_one_robot(tmp_path):
    task = make_task("turn", "rolling")  # the very fields of the paper's
    path = certified.load("turn", "rolling").save(task, tmp_path / "set.npz", "rolling")
    assert len(certified.load("turn", "rolling", path)) == 200
    with pytest.raises(certified.CertificateError, match=r"was computed for BallbotParams\(.*ballbot certify"):
        certified.load("turn", "paper", path)
    with pytest.raises(certified.CertificateError, match="ballbot certify --tasks turn --robot rolling"):
        certified.load("turn", "rolling", certified.path_of(task))
    renamed = certified.load("turn", "paper").save(task, tmp_path / "renamed.npz", "rolling")
    with pytest.raises(certified.CertificateError, match="its optimal trajectories have other states or costs"):
        certified.load("turn", "rolling", renamed)


def test_transfer_tells_who_was_made_for_what(tmp_path):
    arguments = {"tasks": ("stabilize",), "controllers": ("lqr",), "robot": "paper", "physics": ("rk4",), "workers": 1}
    transfer(episodes=2, made_for=("paper", "kugle"), out=tmp_path, **arguments)
    rows = list(csv.DictReader((tmp_path / "transfer.csv").open()))
    assert [(row["made_for"], row["robot"], row["episodes"]) for row in rows] == [
        ("paper", "paper", "2"),
        ("kugle", "paper", "2"),
    ]
    assert rows[0]["cost_mean"] != rows[1]["cost_mean"]
    assert {"regret_mean_on_own_floor", "regret_median_on_own_floor"} <= set(rows[0])
    assert not {"regret_mean", "optimum"} & set(rows[0])
    assert "| regret over the optimum on the robot's own floor |" in (tmp_path / "transfer.md").read_text()
    with pytest.raises(ValueError, match="the friction of the floor has no effect on a PointBall"):
        transfer(frictions=(0.8,), out=tmp_path, **arguments)
    with pytest.raises(ValueError, match="a physics is given more than once: rk4 rk4"):
        transfer(out=tmp_path, **arguments | {"physics": ("rk4", "rk4")})


@pytest.mark.parametrize(("physics", "library"), [("bullet", "pybullet"), ("mujoco", "mujoco")])
def test_an_engine_that_is_not_installed_is_noticed_before_any_episode(tmp_path, monkeypatch, physics, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match="pip install"):
        transfer(physics=("rk4", physics), out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_transfer_runs_a_name_for_the_robots_that_have_it():
    chosen = controllers_of(["turn"], ["dagger", "lqr"], ["paper", "rolling"])
    assert chosen["paper"] == {"turn": ["dagger", "lqr"]}
    assert "lqr" in chosen["rolling"]["turn"]
    with pytest.raises(ValueError, match="unknown controller nobody"):
        controllers_of(["turn"], ["lqr", "nobody"], ["paper", "rolling"])
    with pytest.raises(ValueError, match="given more than once"):
        controllers_of(["turn"], ["lqr", "lqr"], ["paper"])


def test_a_policy_is_of_one_robot(rolling):
    spec = PolicySpec.of(make_task("turn"), robot="rolling")
    assert PolicySpec.read(dataclasses.asdict(spec)) == spec
    assert PolicySpec.of(make_task("turn")).robot == "paper"
    assert not set(shipped_policies(make_task("turn"))) & set(ROBOTS)
    with pytest.raises(PolicyError, match="was trained on the robot 'paper', not on 'rolling'"):
        load_policy(shipped_policies(make_task("turn"))["dagger"], make_task("turn", "rolling"), rolling)


def test_weights_to_start_from_may_be_of_another_robot_and_its_episodes():
    path = shipped_policies(make_task("orbit"))["dagger"]
    there = make_task("orbit", "rolling")
    with pytest.raises(PolicyError, match="was trained on Orbit"):
        PolicyNetwork.load(path, there, "rolling")
    assert PolicyNetwork.load(path, there, robot=None).spec.robot == "paper"
    with pytest.raises(PolicyError, match="was trained on Orbit, not on Turn"):
        PolicyNetwork.load(path, make_task("turn"), robot=None)


def test_a_policy_that_was_trained_on_from_that_of_another_robot_is_one_of_its_own_robot(rolling, tmp_path):
    orbit = make_task("orbit", "rolling")
    start = PolicyNetwork.load(shipped_policies(make_task("orbit"))["dagger"], orbit, robot=None)
    settings = dataclasses.replace(LEARNERS["apg"].settings("orbit", warm=True), num_envs=2, iterations=1)
    learner = LEARNERS["apg"].make(orbit, rolling, settings, 0, start=start)
    path = learner.network.save(tmp_path / "mine", {})
    assert PolicyNetwork.load(path, orbit, "rolling").spec.robot == "rolling"
