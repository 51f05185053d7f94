"""The playground's simulation, which knows nothing of pages."""

import math

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO

from ballbot_baselines import CONTROLLERS
from ballbot_gym import certified, dynamics
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robots import named_robot
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import TASKS
from ballbot_gym.trajectory import Trajectory
from ballbot_train.play import background, views
from ballbot_train.play.clock import Clock
from ballbot_train.play.simulation import LARGEST_PUSH, Playground
from ballbot_train.policy_files import BEST

STANDING, FALLING = 3, 5  # certified episodes of Stabilize in which LQR comes to rest, and falls at 0.40 s


@pytest.fixture
def no_optimum(monkeypatch):
    """The optimum of the episode is not searched, which would compile a problem that no other test solves."""
    monkeypatch.setattr(background, "optimum_costs", lambda task, *problem: np.zeros(task.steps + 1))


@pytest.fixture
def play():
    opened = []

    def open_playground(*arguments, **keywords):
        playground = Playground(*arguments, **{"controller": "lqr", "physics": "rk4", "episode": STANDING} | keywords)
        opened.append(playground)
        playground.settle()
        playground.step()
        return playground

    yield open_playground
    for playground in opened:
        playground.close()


def go(playground, seconds):
    for _ in range(round(seconds / playground.world.task.control_dt)):
        assert playground.step()


@pytest.mark.parametrize("episode", [STANDING, FALLING])
def test_an_episode_without_pushes_costs_what_the_env_says(play, episode):
    playground = play(episode=episode)
    env = BallbotEnv("stabilize", physics="rk4")
    controller = CONTROLLERS["lqr"](env.task, env.params)
    expected = rollout(env, controller, options=certified.load("stabilize", "paper").options(episode))
    best = playground.optimum_cost
    while not playground.scores:
        playground.step()
    (score,) = playground.scores
    assert score.cost == pytest.approx(expected.cost, rel=1e-9)
    assert score.regret == pytest.approx(score.cost / best - 1)
    assert (score.failure != "") == expected.failure
    assert score.seconds == pytest.approx(expected.trajectory.duration)


def test_the_optimum_costs_what_is_certified(play):
    playground = play()
    assert playground.optimum_cost == pytest.approx(certified.load("stabilize", "paper").costs[STANDING], rel=1e-4)
    early = playground.optimum_cost_so_far
    go(playground, 1.0)
    assert 0 < early < playground.optimum_cost_so_far < playground.optimum_cost


def test_an_episode_at_rest_begins_with_a_push_that_fells_lqr_and_not_the_shipped_policy(play, no_optimum):
    playground = play(controller=None, ghosts=["lqr"], episode="rest")
    assert playground.main.name == BEST["stabilize"]
    for _ in range(2):  # once more after a restart
        go(playground, 0.9)
        assert not any(playground.main.x)
        go(playground, 2.5)
        policy, lqr = playground.runners
        assert (policy.violated, lqr.violated) == ("", "tilt")
        assert views.drawing(playground).robots[0].label == "LQR fell"
        playground.restart()
        playground.settle()


@pytest.mark.parametrize("physics", ["rk4", "bullet"])
def test_a_push_is_an_impulse_on_the_centre_of_mass(play, no_optimum, params, physics):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    playground = play(episode="rest", controller="lqr", physics=physics)
    playground.push(60.0, 30.0)
    go(playground, 0.02)
    expected = dynamics.step(params, dynamics.pushed(params, (0.0,) * 8, (60.0, 30.0)), (0.0, 0.0), 0.02)
    assert playground.main.x == pytest.approx(expected, abs=2e-3)


def test_ghosts_get_the_same_start_and_the_same_pushes(play):
    playground = play(controller="shac", ghosts=["lqr"])
    alone = play(controller="lqr")
    for each in (playground, alone):
        each.push(3.0, -2.0)
        go(each, 0.5)
    ghost, main = playground.runners[1], alone.main
    np.testing.assert_array_equal(ghost.x, main.x)
    assert playground.main.x != ghost.x


def test_controllers_change_without_a_jump(play):
    playground = play()
    go(playground, 0.5)
    states = [playground.main.x]
    for name in ("shac", "lqr"):
        playground.set_controller(name)
        assert playground.step()  # under the old one
        states.append(playground.main.x)
        playground.settle()
        go(playground, 0.02)
        states.append(playground.main.x)
        assert playground.main.name == playground.main.wanted == name
    steps = np.abs(np.diff([state[:2] for state in states], axis=0)).max()
    assert steps < 0.02 * 8  # m: a control step at less than 8 m/s
    assert len(playground.trajectory().u) > 25  # one episode all along


def test_after_a_fall_the_same_episode_begins_again(play):
    playground = play(episode=FALLING)
    go(playground, 0.5)
    assert playground.ended
    assert "fell after 0.4 s" in views.status(playground)
    fallen = playground.main.x
    go(playground, 1.0)
    assert playground.main.x == fallen
    for _ in range(40):
        playground.step()
    playground.settle()
    assert playground.step()
    assert not playground.ended
    assert playground.episode == FALLING


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_nmpc_goes_on_through_the_ends_of_episodes_in_every_task(play, task):
    playground = play(task, controller="nmpc", ghosts=["trajopt"], episode=0)
    for _ in range(1000):
        playground.settle()
        playground.step()
    assert playground.notice == ""
    assert all(score.failure == "" for score in playground.scores)
    assert views.drawing(playground).paths[-1].name in ("plan", "robot")


# --- what the user changes ---


def test_what_the_controllers_do_not_know_changes_the_robot_alone(play):
    playground = play()
    gain = playground.main.controller.act(0.0, np.ones(8))
    playground.set_plant("mass", 50.0)
    playground.set_plant("delay", 40.0)
    assert playground.main.env.episode_params.body_mass == pytest.approx(1.5 * playground.world.params.body_mass)
    np.testing.assert_array_equal(playground.main.controller.act(0.0, np.ones(8)), gain)
    go(playground, 0.02)
    assert playground.main.force == (0.0, 0.0)  # the delayed actuator has not seen a command yet


@pytest.mark.parametrize(("physics", "seed"), [("rk4", 0), ("bullet", 1)])
def test_an_episode_of_another_robot_is_that_of_the_env(play, no_optimum, seed, physics):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    playground = play(robot="rolling", episode=None, seed=seed, physics=physics)
    (state, constants), env = playground.start, BallbotEnv("stabilize", robot="rolling", physics=physics)
    controller = CONTROLLERS["lqr"](env.task, env.params)
    expected = rollout(env, controller, options={"state": state, "constants": constants})
    while not playground.scores:
        playground.step()
    (score,) = playground.scores
    assert score.cost == pytest.approx(expected.cost, rel=1e-6)
    assert (score.failure != "") == expected.failure


def test_another_task_or_robot_keeps_the_controllers_that_it_has(play, no_optimum):
    playground = play(controller="lqr", ghosts=["shac"])
    playground.set_robot("rolling")  # which has no such policy
    playground.settle()
    assert playground.step()
    assert (playground.world.robot, playground.main.wanted, playground.ghosts) == ("rolling", "lqr", ())
    assert playground.world.params == named_robot("rolling")
    playground.set_task("orbit")
    playground.settle()
    assert playground.step()
    assert (playground.world.task_name, playground.main.wanted, playground.ghosts) == (
        "orbit",
        "lqr",
        (),
    )


def test_no_push_harms(play, no_optimum):
    playground = play()
    for push in ((math.nan, 0.0), (math.inf, 1.0), (1e300, 1e300), (-1e9, 0.0), (0.0, 0.0)):
        playground.restart()
        playground.settle()
        playground.push(*push)
        go(playground, 0.1)
        assert np.isfinite(playground.main.x).all()
        # every kilogram that is pushed weighs more than 1 kg
        assert np.hypot(*playground.main.x[4:6]) < 8 + LARGEST_PUSH  # m/s


WRONG = [
    (lambda p: p.set_task("dance"), "unknown task dance"),
    (lambda p: p.set_robot("teapot"), "unknown robot teapot"),
    (lambda p: p.set_controller("nobody"), "unknown controller 'nobody'"),
    (lambda p: p.set_controller("nowhere/policy.json"), "unknown controller"),
    (lambda p: p.set_ghosts(["nobody"]), "unknown controller 'nobody'"),
    (lambda p: p.set_plant("mass", math.nan), "mass must be -50 to 100"),
    (lambda p: p.set_plant("mass", 1e9), "mass must be -50 to 100"),
    (lambda p: p.set_plant("weather", 1.0), "unknown change weather"),
    (lambda p: p.start_certified(200), "episode must be 0 to 199, not 200"),
]


def test_wrong_input_is_refused_and_the_robot_goes_on(play):
    playground = play()
    for change, message in WRONG:
        with pytest.raises(ValueError, match=message):
            change(playground)
        go(playground, 0.04)
        assert playground.notice == ""


@pytest.fixture
def saved_model(tmp_path):
    """A model as Stable-Baselines3 writes it."""
    path = tmp_path / "mine.zip"
    env = gymnasium.make("BallbotStabilize-v0", physics="rk4")
    PPO("MlpPolicy", env, n_steps=2, batch_size=2, device="cpu").save(path)
    return str(path)


def test_a_saved_model_of_another_library_is_offered_where_it_fits(play, saved_model):
    playground = play()
    playground.set_controller(saved_model)
    playground.settle()
    go(playground, 0.04)
    assert playground.main.name == saved_model
    assert playground.notice == ""
    playground.set_task("orbit")  # its observations are others
    assert saved_model not in playground.controllers
    playground.set_task("stabilize")
    assert saved_model in playground.controllers


def test_a_controller_that_fails_gives_no_force_and_is_named(play):
    playground = play()

    class Broken:
        def act(self, t, x):
            return np.array([math.nan, 0.0])

    playground.main.take_controller(Broken(), 0)
    go(playground, 0.02)
    assert playground.main.force == (0.0, 0.0)
    assert "LQR" in playground.notice


def test_where_a_planner_finds_no_way_lqr_starts_instead(play, monkeypatch):
    playground = play()
    monkeypatch.setitem(CONTROLLERS, "trajopt", lambda task, params: (_ for _ in ()).throw(RuntimeError("no way")))
    playground.set_controller("trajopt")
    playground.settle()
    assert playground.main.wanted == playground.main.name == "lqr"  # the old one stays
    assert "no way" in playground.notice
    playground.main.wanted = "trajopt"
    playground.restart()
    playground.settle()
    assert playground.step()
    assert playground.main.name == "lqr"
    assert "LQR does instead" in playground.notice


# --- what is kept ---


def test_what_happened_can_be_saved(play, tmp_path):
    playground = play(ghosts=["shac"])
    go(playground, 0.5)
    path = playground.trajectory().save(tmp_path / "played.npz")
    np.testing.assert_array_equal(Trajectory.load(path).x[-1], playground.main.x)


class Watch:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def test_a_short_hold_up_is_caught_up_and_a_long_one_is_given_up():
    watch = Watch()
    clock = Clock(0.02, now=watch)

    def late():
        return [step for step in (clock.take() for _ in range(50)) if step is not None]

    assert late() == [0.0]
    watch.now += 0.1
    assert late() == pytest.approx([0.08, 0.06, 0.04, 0.02, 0.0])
    watch.now += 10.0
    assert late() == pytest.approx([9.98])


def test_every_episode_of_a_track_has_a_robot_of_its_own(play, no_optimum):
    playground = play("turn", episode=0, randomization="unknown")
    masses = []
    for episode in range(3):
        playground.start_certified(episode)
        masses.append(playground.main.env.episode_params.body_mass / playground.world.params.body_mass)
    assert len(set(masses)) == 3
    assert 0.7 <= min(masses) < max(masses) <= 1.4
    playground.set_plant("mass", 10.0)  # a slider takes its place
    playground.start_certified(3)
    assert playground.main.env.episode_params.body_mass == pytest.approx(1.1 * playground.world.params.body_mass)
