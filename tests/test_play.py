"""The playground's simulation, which knows nothing of pages."""

import math
import shutil

import numpy as np
import pytest

from ballbot_baselines import CONTROLLERS
from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import named_robot
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks import TASKS
from ballbot_train.policy.files import BEST, SHIPPED
from ballbot_train.report.simulation import LARGEST_PUSH, Playground

STANDING, FALLING = 3, 5  # certified episodes of Stabilize in which LQR comes to rest, and falls at 0.40 s


@pytest.fixture
def play():
    opened = []

    def open_playground(*arguments, **keywords):
        keywords = {"controller": "lqr", "physics": "rk4", "episode": STANDING} | keywords
        opened.append(Playground(*arguments, **keywords))
        return opened[-1]

    yield open_playground
    for playground in opened:
        playground.close()


def go(playground, seconds):
    for _ in range(round(seconds / playground.world.task.control_dt)):
        playground.step()


def scored(playground):
    """The score of the episode, at its end."""
    while not playground.scores:
        playground.step()
    return playground.scores[0]


@pytest.mark.parametrize(
    ("robot", "physics", "episode"),
    [*(("paper", "rk4", i) for i in (STANDING, FALLING)), *(("rolling", each, "random") for each in ("rk4", "bullet"))],
)
def test_an_episode_without_pushes_costs_what_the_env_says(play, robot, physics, episode):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    playground = play(robot=robot, physics=physics, episode=episode)
    env = BallbotEnv("stabilize", robot=robot, physics=physics)
    options = dict(zip(("state", "constants"), playground.start, strict=True))
    expected = rollout(env, CONTROLLERS["lqr"](env.task, env.params), options=options)
    score = scored(playground)
    assert score.cost == pytest.approx(expected.cost, rel=1e-6)
    assert (score.failure != "") == expected.failure
    assert score.seconds == pytest.approx(expected.trajectory.duration)
    best = math.nan if episode == "random" else certified.load("stabilize", robot).costs[episode]
    assert score.regret == pytest.approx(score.cost / best - 1, nan_ok=True)


def test_an_episode_at_rest_begins_with_a_push_that_fells_lqr_and_not_the_shipped_policy(play):
    playground = play(controller=None, ghosts=["lqr"], episode="rest")
    assert playground.main.name == BEST["stabilize"]
    for _ in range(2):  # once more after a restart
        go(playground, 1.0)
        assert not any(playground.main.x)
        go(playground, 2.5)
        policy, lqr = playground.runners
        assert (policy.violated, lqr.violated) == ("", "tilt")
        assert playground.drawing().robots[0].label == "LQR fell"
        playground.restart()


@pytest.mark.parametrize("physics", ["rk4", "bullet"])
def test_a_push_is_an_impulse_on_the_centre_of_mass(play, params, physics):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    playground = play(episode="rest", physics=physics)
    playground.push(60.0, 30.0)
    pushed = params.pushed((0.0,) * 8, (60.0, 30.0))
    assert playground.main.x == pytest.approx(pushed)
    playground.step()
    expected = params.step(pushed, playground.main.force, 0.02)
    assert playground.main.x == pytest.approx(expected, abs=2e-3)
    playground.push(1e300, 1e300)  # which is cut
    playground.step()
    assert np.hypot(*playground.shown_push) == pytest.approx(LARGEST_PUSH)


def test_ghosts_get_the_same_start_and_the_same_pushes(play):
    playground, alone = play(controller="apg", ghosts=["lqr"]), play()
    for each in (playground, alone):
        each.push(3.0, -2.0)
        go(each, 0.5)
    assert playground.runners[1].x == alone.main.x != playground.main.x
    playground.set_ghosts(["trajopt"])  # all begin again
    assert playground.runners[1].x == playground.main.x == tuple(playground.start[0])


def test_controllers_change_without_a_jump(play):
    playground = play()
    go(playground, 0.5)
    for name in ("apg", "nmpc", "lqr"):
        before = playground.main.x
        playground.set_controller(name)
        playground.step()
        assert playground.main.name == name
        assert np.abs(np.subtract(playground.main.x, before)[:2]).max() < 0.02 * 8  # m: at less than 8 m/s
    assert len(playground.main.forces) == 28  # one episode all along


def test_after_a_fall_the_same_episode_begins_again(play):
    playground = play(episode=FALLING)
    assert "fell after 0.4 s" in scored(playground).text
    fallen = playground.main.x
    go(playground, 1.0)
    assert playground.ended
    assert playground.main.x == fallen
    go(playground, 0.6)
    assert not playground.ended
    assert playground.episode == FALLING


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_nmpc_goes_on_through_the_ends_of_episodes_in_every_task(play, task):
    playground = play(task, controller="nmpc", ghosts=["trajopt"], episode=0)
    go(playground, 20.0)
    assert playground.notice == ""
    assert all(score.failure == "" for score in playground.scores)


# --- what the user changes ---


def test_what_the_controllers_do_not_know_changes_the_robot_alone(play):
    playground = play()
    gain = playground.main.controller.act(0.0, np.ones(8))
    playground.set_plant("mass", 40.0)
    playground.set_plant("delay", 40.0)
    assert playground.main.env.episode_params.body_mass == pytest.approx(1.4 * playground.world.params.body_mass)
    np.testing.assert_array_equal(playground.main.controller.act(0.0, np.ones(8)), gain)
    playground.step()
    assert playground.main.force == (0.0, 0.0)  # the delayed actuator has not seen a command yet
    assert math.isnan(playground.optimum_cost)  # which is of the robot that everybody knows


def test_every_episode_of_a_track_has_a_robot_of_its_own(play):
    playground = play("turn", episode=0, randomization="unknown")
    masses = []
    for episode in range(3):
        playground.begin(episode)
        masses.append(playground.main.env.episode_params.body_mass / playground.world.params.body_mass)
    assert len(set(masses)) == 3
    assert 0.7 <= min(masses) < max(masses) <= 1.4
    playground.set_plant("mass", 10.0)  # a slider takes its place
    playground.begin(3)
    assert playground.main.env.episode_params.body_mass == pytest.approx(1.1 * playground.world.params.body_mass)


def test_another_task_or_robot_keeps_the_controllers_that_it_has(play):
    playground = play(ghosts=["sac"])
    for change in (lambda: playground.set_world(robot="rolling"), lambda: playground.set_world("orbit")):
        change()
        playground.step()
        assert (playground.main.name, playground.ghosts) == ("lqr", ())  # which have no such policy
        assert playground.main.env.params == named_robot("rolling")
    assert playground.world.task_name == "orbit"


def test_a_policy_file_becomes_a_controller_that_can_be_chosen(play, tmp_path):
    for file in SHIPPED.glob("stabilize-ppo.*"):
        shutil.copy(file, tmp_path / f"mine{file.suffix}")
    mine = str(tmp_path / "mine.json")
    playground = play(controller=mine)
    playground.step()
    assert playground.main.name == mine
    assert playground.notice == ""
    assert mine in playground.world.controllers


WRONG = [
    (lambda p: p.set_world("dance"), "unknown task dance"),
    (lambda p: p.set_world(robot="teapot"), "unknown robot teapot"),
    (lambda p: p.set_controller("nobody"), "unknown controller 'nobody'"),
    (lambda p: p.set_controller("nowhere/policy.json"), "no such file"),
    (lambda p: p.set_controller(str(SHIPPED / "orbit-ppo.json")), "orbit"),
    (lambda p: p.set_ghosts(["nobody"]), "unknown controller 'nobody'"),
    (lambda p: p.set_plant("mass", math.nan), "mass must be -40 to 40"),
    (lambda p: p.set_plant("mass", 1e9), "mass must be -40 to 40"),
    (lambda p: p.set_plant("weather", 1.0), "unknown change weather"),
    (lambda p: p.begin(200), "episode must be 0 to 199, not 200"),
    (lambda p: p.push(math.nan, 0.0), "a push must be finite"),
    (lambda p: p.push(math.inf, 1.0), "a push must be finite"),
]


def test_wrong_input_is_refused_and_the_robot_goes_on(play):
    playground = play()
    for change, message in WRONG:
        with pytest.raises(ValueError, match=f"(?i){message}"):
            change(playground)
        go(playground, 0.04)
    assert (playground.main.name, playground.ghosts, playground.notice) == ("lqr", (), "")
    assert len(playground.main.forces) == 2 * len(WRONG)


def test_a_controller_that_fails_gives_no_force_and_is_named(play):
    class Broken:
        def act(self, t, x):
            return np.array([math.nan, 0.0])

    playground = play()
    playground.main.controller = Broken()
    playground.step()
    assert playground.main.force == (0.0, 0.0)
    assert "LQR" in playground.notice


class Lost:
    def __init__(self, task, params):
        pass

    def reset(self, t, x, c):
        raise PlanError("no way")


def test_where_a_planner_finds_no_way_lqr_starts_instead(play, monkeypatch):
    monkeypatch.setitem(CONTROLLERS, "trajopt", Lost)
    playground = play(controller="apg")
    with pytest.raises(PlanError, match="no way"):
        playground.set_controller("trajopt")
    assert playground.main.name == "apg"  # the old one stays
    playground = play(controller="trajopt")
    assert playground.main.name == "lqr"
    assert "LQR does instead: no way" in playground.notice
