"""A robot and a task from outside of the packages have what ballbots have, without a change inside the packages."""

import math
import runpy
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import ballbot_gym
from ballbot_baselines import CONTROLLERS, find_optima, find_optimum
from ballbot_gym import TASKS, BallbotBatch, BallbotEnv, BallbotVectorEnv, rollout
from ballbot_gym.robot import PAPER, ROBOTS
from ballbot_train import evaluate
from ballbot_train.cli import _run as main

FILE = Path(__file__).parent.parent / "examples" / "classic" / "src" / "ballbot_classic" / "cart_pole.py"


@pytest.fixture(scope="module", autouse=True)
def registered():
    """What the example registers is gone after these tests."""
    yield
    TASKS.pop("cart_pole", None)
    ROBOTS.pop("cart_pole", None)
    gymnasium.registry.pop("CartPoleSwingUp-v0", None)
    sys.modules.pop("cart_pole", None)


@pytest.fixture(scope="module")
def cart_pole():
    """The names of the example."""
    sys.path.insert(0, str(FILE.parent))
    try:
        import cart_pole

        yield cart_pole
    finally:
        sys.path.remove(str(FILE.parent))


@pytest.fixture
def env(cart_pole):
    with BallbotEnv("cart_pole", render_mode="rgb_array") as env:
        yield env


def energy(robot, x):
    """J, of cart and pole, from the speeds of both."""
    _, theta, speed, rate = x
    across, up = speed + robot.length * math.cos(theta) * rate, -robot.length * math.sin(theta) * rate
    kinetic = robot.cart_mass * speed**2 / 2 + robot.pole_mass * (across**2 + up**2) / 2
    return kinetic + robot.pole_mass * robot.gravity * robot.length * math.cos(theta)


def test_the_file_is_short_and_imports_only_what_is_public():
    assert len(FILE.read_text().splitlines()) < 150
    assert set(runpy.run_path(str(FILE), run_name="cart_pole")) >= {"CartPole", "SwingUp"}


def test_without_a_force_its_energy_stays(cart_pole):
    robot, x = cart_pole.CartPole(), (0.1, 2.0, 0.5, -1.0)
    before = energy(robot, x)
    for _ in range(100):
        x = robot.step(x, (0.0,), 0.01, 1)
    assert energy(robot, x) == pytest.approx(before, rel=1e-6)


def test_its_environment_passes_gymnasiums_checks_and_has_a_picture(env):
    check_env(env, skip_render_check=True)
    assert env.physics == "rk4"
    _, info = env.reset(seed=0)
    assert info["height"] == pytest.approx(-0.5, abs=0.03)
    pictures = [env.render()]
    for _ in range(20):
        env.step(np.ones(1, np.float32))
    pictures.append(env.render())
    assert pictures[0].shape == (480, 640, 3)
    assert (pictures[0] != pictures[1]).any()
    assert gymnasium.make("CartPoleSwingUp-v0").unwrapped.task == env.task


def test_one_env_many_and_a_batch_move_alike(env):
    many = BallbotVectorEnv(3, task="cart_pole", dtype="float64")
    batch = BallbotBatch("cart_pole", 3, dtype="float64", compile=False)
    observations, info = many.reset(seed=0)
    batch.reset(seed=0)
    assert observations.shape == (3, 4)
    env.reset(seed=0, options={"state": info["state"][1]})
    torch = pytest.importorskip("torch")
    for action in (0.5, -0.2, 1.5):
        actions = np.full((3, 1), action, np.float32)
        seen, rewards, *_ = many.step(actions)
        step = batch.step(torch.from_numpy(actions))
        alone, reward, *_ = env.step(actions[0])
        np.testing.assert_allclose(seen, step.observation.numpy(), atol=1e-6)
        np.testing.assert_allclose(seen[1], alone, atol=1e-6)
        assert reward == pytest.approx(rewards[1], abs=1e-6)


def test_its_optimum_swings_up_and_nmpc_nearly_reaches_it(cart_pole, env):
    rng, robot = np.random.default_rng(0), cart_pole.CartPole()
    x, c = env.task.sample(rng, robot)
    optimum = find_optimum("cart_pole", "cart_pole", x, c)
    assert optimum.is_optimal
    assert env.task.is_goal(optimum.trajectory.x[-1], c)
    assert np.abs(optimum.trajectory.u).max() <= robot.force_limit
    (together,) = find_optima("cart_pole", PAPER, x[None], c[None])
    assert together is not None
    assert together.cost == pytest.approx(optimum.cost, rel=1e-6)
    for name, least, most in (("lqr", 1.0, np.inf), ("trajopt", 0, 0.05), ("nmpc", 0, 0.01)):
        run = rollout(env, CONTROLLERS[name](env.task, robot), seed=0, options={"state": x})
        assert least <= run.cost / optimum.cost - 1 <= most, name


def test_its_lqr_holds_the_pole_up(cart_pole, env):
    start = np.array([0.3, 0.2, 0.0, 0.0])
    run = rollout(env, CONTROLLERS["lqr"](env.task, cart_pole.CartPole()), seed=0, options={"state": start})
    optimum = find_optimum(env.task, cart_pole.CartPole(), start, np.zeros(0))
    assert run.success
    assert run.cost / optimum.cost - 1 == pytest.approx(0, abs=0.05)


def test_a_ballbots_robot_is_refused_by_a_message_that_names_the_right_one(cart_pole):
    with pytest.raises(ValueError, match="robot='cart_pole'"):
        BallbotEnv("cart_pole", robot="omni")
    with pytest.raises(ValueError, match="give physics='rk4'"):
        BallbotEnv("cart_pole", physics="mujoco")


@pytest.mark.slow
def test_commands_measure_and_train_it(cart_pole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart_pole.py").write_text(FILE.read_text())
    of = ["--task", "cart_pole", "--robot", "cart_pole"]
    assert main(["benchmark", "--tasks", *of[1:], "--controllers", "nmpc", "--episodes", "2", "--out", "b"]) == 0
    assert "nmpc" in (tmp_path / "b" / "leaderboard.md").read_text()
    few = ["--iterations", "2", "--evaluations", "1", "--test-episodes", "2", "--validation-episodes", "2"]
    assert main(["train", "ppo", *of, *few, "--num-envs", "64", "--out", "p"]) == 0
    row = evaluate(str(tmp_path / "p" / "policy.json"), "cart_pole", episodes=2, robot="cart_pole")
    assert row.episodes == 2


def test_the_package_does_not_name_it():
    folder = Path(ballbot_gym.__file__).parent
    assert not [path for path in folder.rglob("*.py") if "cart_pole" in path.read_text().lower()]
