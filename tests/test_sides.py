"""Predictions of what each choice of sides in a slalom costs."""

import numpy as np
import pytest

pytest.importorskip("casadi")

from ballbot_baselines import find_optimum
from ballbot_baselines.optimum import sides
from ballbot_baselines.optimum.guesses import ALL_GUESSES
from ballbot_gym import certified
from ballbot_gym.tasks.paths import sides_passed
from ballbot_gym.tasks.weave import Weave


@pytest.fixture
def slaloms():
    """Start, constants and optimal path of certified slaloms."""
    known = certified.load("weave", "paper")
    return [(known.states[i], known.constants[i], known.trajectories[i].x[:, :2]) for i in range(20)]


def predicted(task, params, x0, c, path):
    """What is predicted of one slalom."""
    return sides.predict(task, params, x0[None], c[1:2], path[None, :, 0], task.passed_obstacles(c)[None])


def test_predicted_motions_clear_every_obstacle_on_their_side(slaloms, params):
    task = Weave()
    for x0, c, path in slaloms[:5]:
        _, obstacles = Weave.split_constants(c)
        found = predicted(task, params, x0, c, path)
        assert len(found.sides) == 2 ** len(obstacles)
        passed = [int(np.argmin(np.abs(path[:, 0] - x))) for x in obstacles[:, 0]]
        y = found.y(0)
        clearance = found.sides * (y[:, passed] - obstacles[:, 1]) - obstacles[:, 2] - task.ball_radius
        assert clearance.min() > -1e-6
        assert found.passed[0].tolist() == passed
        assert (found.costs >= 0).all()
        np.testing.assert_allclose(y[:, 0], x0[1], atol=1e-9)
        np.testing.assert_allclose(y[:, -1], 0.0, atol=1e-2)


def test_obstacles_far_from_the_way_cost_nothing_on_one_side(slaloms, params):
    x0, c, path = slaloms[0]
    c = c.copy()
    c[3::3] = 8.0  # all on the left
    found = predicted(Weave(), params, x0, c, path)
    right = (found.sides == -1).all(1)
    assert found.costs[0, right] == 0.0
    assert found.costs[0, ~right].min() > 1.0


def test_the_optimal_choice_is_predicted_among_the_best(slaloms, params):
    task, excess = Weave(), []
    for x0, c, path in slaloms:
        found = predicted(task, params, x0, c, path)
        optimal = (found.sides == sides_passed(path, task.passed_obstacles(c))).all(1)
        excess.append(float(found.costs[0, optimal][0] - found.costs.min()))
    assert max(excess) < 1.0
    assert np.median(excess) < 0.1


def test_the_slalom_without_obstacles_predicts_the_optimal_choice(params):
    task, known = Weave(), certified.load("weave", "paper")
    doubt = []
    for i in range(2):
        x0, c = known.states[i], known.constants[i]
        free = find_optimum(task, params, x0, task.without_obstacles(c), guesses=1)
        assert free.cost < known.costs[i]
        found = predicted(task, params, x0, c, free.trajectory.x)
        optimal = (found.sides == sides_passed(known.trajectories[i].x, task.passed_obstacles(c))).all(1)
        doubt.append((found.costs[0, optimal][0] - found.costs.min()) / known.costs[i])
    assert max(doubt) < 0.01


@pytest.mark.slow
def test_the_search_from_every_choice_finds_what_the_likely_ones_lead_to(params):
    """From rest to rest the solver comes to a worse optimum on the best sides of this certified episode."""
    task, known = Weave(), certified.load("weave", "paper")
    x0, c = known.states[12], known.constants[12]
    likely, all_choices = (find_optimum(task, params, x0, c, guesses=guesses) for guesses in (5, ALL_GUESSES))
    assert likely.cost == pytest.approx(105.2216, abs=1e-3)
    assert all_choices.cost <= likely.cost * (1 + 1e-9)


def test_a_choice_on_which_the_solver_fails_is_tried_again(params):
    """From rest to rest on the best sides the solver stops; from the path that another choice's solution predicts it ends."""
    task = Weave()
    x0, c = task.sample(np.random.default_rng([2026, 1, 156]), params)
    found = find_optimum(task, params, x0, c)
    assert sides_passed(found.trajectory.x, task.passed_obstacles(c)) == (1, -1, 1, -1)
    assert found.cost == pytest.approx(75.8071, abs=1e-3)
