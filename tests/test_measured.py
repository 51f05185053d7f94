"""The regret of trajectories from anywhere."""

import numpy as np
import pytest
from builders import FunctionController

from ballbot_baselines import find_optimum, regret
from ballbot_gym import BallbotEnv, certified, named_robot
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.controllers import ControllerName

ROBOT = named_robot("paper")


def test_a_certified_optimum_has_no_regret(task):
    known = certified.load(task, "paper")
    found = regret(known.trajectories[0], task, "paper", known.constants[0])
    assert found.regret == pytest.approx(0, abs=2e-4)  # find_optimum tries fewer guesses
    assert found.cost == pytest.approx(known.costs[0], rel=1e-6)
    assert (found.success, found.violated, found.force_excess) == (True, "", 0)
    assert np.abs(found.defects).max() < 1e-6


@pytest.mark.parametrize("name", ["lqr", "nothing"])
def test_an_episode_costs_what_the_env_said_of_it(name, make_env):
    """A failure's price included."""
    env = make_env("stabilize", physics="rk4")
    controller = (
        FunctionController(lambda t, x: np.zeros(2))
        if name == "nothing"
        else ControllerName(name).make(env.task, ROBOT)
    )
    run = rollout(env, controller, options=certified.load(env.task, ROBOT).options(0))
    found = regret(run.trajectory, env.task)
    assert found.cost == pytest.approx(run.cost, rel=1e-12)
    assert (found.success, bool(found.violated)) == (run.success, run.failure)
    assert found.regret > 0


def test_another_sampling_of_the_same_motion_has_the_same_regret():
    """Recorded every 5 ms from 3 s on, as arrays, and for longer than the episode."""
    env = BallbotEnv(Stabilize(duration=8.5), physics="rk4", physics_dt=0.005)
    run = rollout(
        env, ControllerName("lqr").make(env.task, ROBOT), options=certified.load("stabilize", ROBOT).options(2)
    )
    motion = run.trajectory
    fine, force = [motion.x[0]], np.repeat(motion.u, 4, axis=0)
    for u in force:
        fine.append(np.array(ROBOT.step(tuple(fine[-1]), tuple(u), 0.005, 1)))
    t = 3 + 0.005 * np.arange(len(fine))
    coarse, found = regret(motion, "stabilize"), regret((t, np.array(fine), force), "stabilize")
    assert found.regret == pytest.approx(coarse.regret, abs=1e-6)
    assert found.defects.shape == (len(force), 8)
    assert np.abs(found.defects).max() < 1e-9
    assert found.duration == 8


def test_a_clock_that_ends_just_before_the_episode_does_is_no_obstacle():
    """7.99964 s of 8 s, as the times of a log say."""
    motion = certified.load("stabilize", ROBOT).trajectories[2]
    found = regret((motion.t * (7.99964 / 8), motion.x, motion.u), "stabilize")
    assert found.regret == pytest.approx(0, abs=1e-3)
    assert (found.success, found.duration) == (True, 8)


def test_a_motion_that_the_robot_cannot_do_is_told_from_its_defects():
    known = certified.load("stabilize", ROBOT)
    motion = known.trajectories[0]
    x = motion.x.copy()
    x[100, 4] += 0.3
    found = regret(Trajectory(motion.t, x, 1.5 * motion.u), "stabilize")
    assert abs(found.defects[99, 4]) > 0.29
    assert found.force_excess == max(0.0, 1.5 * np.abs(motion.u).max() - ROBOT.force_limit)
    linear = Trajectory(motion.t, motion.x, np.vstack([motion.u, motion.u[-1:]]))
    assert np.abs(regret(linear, "stabilize").defects).max() > 1e-4  # held forces, read as linear ones


def test_arguments_that_do_not_fit_say_what_is_missing():
    known = certified.load("orbit", ROBOT)
    motion, c = known.trajectories[0], known.constants[0]
    short = Trajectory(motion.t[:50], motion.x[:50], motion.u[:49])
    with pytest.raises(ValueError, match=r"constants .'radius', 'speed'.*give constants, . numbers, not 0"):
        regret(motion, "orbit")
    with pytest.raises(
        ValueError, match=r"lasts 0.98 s, and an episode of BallbotOrbit-v0 lasts 8 s, so the cost of the rest"
    ):
        regret(short, "orbit", "paper", c)
    with pytest.raises(ValueError, match=r"lasts 7\.992 s, and an episode of BallbotOrbit-v0 lasts 8 s"):
        regret((0.999 * motion.t, motion.x, motion.u), "orbit", "paper", c)
    with pytest.raises(ValueError, match="at least two times"):
        regret(Trajectory(np.zeros(1), np.zeros((1, 8)), np.zeros((0, 2))), "stabilize")
    fallen = np.zeros((401, 8))
    fallen[:, 2] = 1.5
    with pytest.raises(ValueError, match="starts beyond the limit of tilt"):
        regret((0.02 * np.arange(401), fallen, np.zeros((400, 2))), "stabilize")
    with pytest.raises(ValueError, match="x0 must"):
        find_optimum("stabilize", "paper", np.zeros(7), np.zeros(0))
