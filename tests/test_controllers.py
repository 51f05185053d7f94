import numpy as np
import pytest

pytest.importorskip("casadi")

from builders import FunctionController

from ballbot_baselines import LqrController, TrajoptController, TvlqrController, find_optimum
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.controllers import ControllerName

IDLE = FunctionController(lambda t, x: np.zeros(2))
UPRIGHT = np.zeros(8)


def test_rollout_is_one_episode_of_the_env(make_env, task, physics):
    env = make_env(task, physics=physics)
    episode = rollout(env, IDLE, seed=5)
    _, info = env.reset(seed=5)
    total, states, done = 0.0, [info["state"]], False
    while not done:
        _, _, terminated, truncated, info = env.step([0.0, 0.0])
        total, done = total + info["cost"], terminated or truncated
        states.append(info["state"])
    assert episode.cost == total
    np.testing.assert_array_equal(episode.trajectory.x, states)
    np.testing.assert_array_equal(episode.constants, info["constants"])
    assert (episode.success, episode.failure) == (info["success"], info["failure"])
    assert episode.peak_tilt == episode.trajectory.tilt.max()


def test_rollout_reports_the_force_that_was_applied_not_asked_for(make_env):
    env = make_env(physics="rk4", duration=0.1)
    episode = rollout(env, FunctionController(lambda t, x: np.array([1e4, -70.0])), options={"state": UPRIGHT})
    np.testing.assert_allclose(episode.trajectory.u, np.tile([350.0, -70.0], (5, 1)))


def test_rollout_gives_the_controller_time_and_true_state(make_env):
    seen = []

    def record(t, x):
        seen.append((t, x.copy()))
        return np.array([1.0, 2.0])

    episode = rollout(make_env(physics="rk4", duration=0.2), FunctionController(record), options={"state": UPRIGHT})
    np.testing.assert_allclose([t for t, _ in seen], 0.02 * np.arange(10))
    np.testing.assert_array_equal([x for _, x in seen], episode.trajectory.x[:-1])


def test_settle_time_is_when_the_goal_begins_to_hold_for_good(make_env):
    env = make_env(physics="rk4")
    task = env.task
    episode = rollout(env, LqrController(task, env.params), options={"state": [0.5, 0, 0, 0, 0, 0, 0, 0]})
    inside = [task.is_goal(tuple(x), ()) for x in episode.trajectory.x]
    k = round(episode.settle_time / task.control_dt)
    assert 0 < k < len(inside)
    assert all(inside[k:])
    assert not inside[k - 1]


def test_settle_time_is_zero_at_rest_and_nan_where_the_goal_is_missed(make_env):
    env = make_env(physics="rk4", duration=0.2)
    assert rollout(env, IDLE, options={"state": UPRIGHT}).settle_time == 0
    assert np.isnan(rollout(env, IDLE, options={"state": [1.0, *[0.0] * 7]}).settle_time)


class TrackedOptimum:
    """Tracks the true optimum, without the margin that TrajoptController keeps."""

    def __init__(self, task, params):
        self.task, self.params = task, params

    def reset(self, t, x, c):
        self.plan = find_optimum(self.task, self.params, x, c)
        self.tracker = TvlqrController.for_task(self.task, self.params, self.plan.trajectory, c)
        self.tracker.reset(t, x, c)

    def act(self, t, x):
        return self.tracker.act(t, x)


def test_optimum_tracked_in_the_model_it_was_planned_in_costs_what_was_planned(task, make_env, params):
    """So −return of the optimal forces is the optimum; TVLQR only keeps rounding from growing by e^7.8 a second."""
    env, controller = make_env(task, physics="rk4"), TrackedOptimum(task, params)
    episode = rollout(env, controller, seed=3)
    assert episode.cost == pytest.approx(controller.plan.cost, rel=1e-9)  # measured: 5e-11
    assert episode.success


def test_plan_tracked_in_bullet_succeeds_at_nearly_the_planned_cost(task, make_env, params):
    env, controller = make_env(task, physics="bullet"), TrajoptController(task, params)
    for seed in (4, 5):
        episode = rollout(env, controller, seed=seed)
        assert episode.success
        assert episode.cost == pytest.approx(controller.plan.cost, rel=0.03)  # measured: 1.3e-3 with Bullet's 1 ms


def test_the_optimum_of_a_certified_episode_is_the_certified_one(task, params, monkeypatch):
    known, controller = certified.load(task, params), ControllerName("optimum").make(make_task(task), params)
    controller.reset(0.0, known.states[2], known.constants[2])
    assert controller.plan.cost == known.costs[2]
    np.testing.assert_array_equal(controller.plan.trajectory.u, known.trajectories[2].u)
    beside = known.states[2] + 0.01
    monkeypatch.setattr("ballbot_baselines.feedback.trajopt.plan_to_track", lambda *_, **__: 1 / 0)
    for start in ((0.0, beside), (0.02, known.states[2])):
        with pytest.raises(ZeroDivisionError):  # it is searched for
            controller.reset(*start, known.constants[2])


def test_plan_that_cannot_be_found_is_an_error_at_reset(make_env, params):
    env = make_env(physics="rk4", duration=1.0)
    with pytest.raises(PlanError):
        rollout(env, TrajoptController(env.task, params), options={"state": [0, 0, 1.3, 0, 0, 0, 5.0, 0]})


def test_tracker_applies_the_plan_on_the_plan_from_its_reset_on(params, rng):
    t = 0.02 * np.arange(6)
    plan = Trajectory(t, rng.normal(size=(6, 8)), rng.normal(size=(5, 2)))
    tracker = TvlqrController.for_task(Stabilize(), params, plan)
    tracker.reset(7.0, plan.x[0], np.zeros(0))
    for k in range(5):
        np.testing.assert_allclose(tracker.act(7.0 + t[k], plan.x[k]), plan.u[k], atol=1e-9)


def test_past_a_plan_that_ends_at_rest_the_tracker_is_lqr(params):
    task = Stabilize()
    plan = Trajectory(0.02 * np.arange(4), np.zeros((4, 8)), np.zeros((3, 2)))
    tracker = TvlqrController.for_task(task, params, plan)
    tracker.reset(0.0, UPRIGHT, np.zeros(0))
    k, _ = discrete_lqr(task, params, UPRIGHT, np.zeros(2), np.zeros(0))
    x = np.arange(8.0)
    for t in (0.0, 1.0):
        np.testing.assert_allclose(tracker.act(t, x), -k @ x, rtol=1e-6)
