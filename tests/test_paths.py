"""Ground paths: they start and end as asked, and they are the same numbers as their formulas written out."""

import itertools

import numpy as np

from ballbot_gym.tasks.paths import catmull_rom, cubic, then_stay


def test_cubic_has_the_positions_and_velocities_asked_for_at_its_ends(rng):
    p0, v0, p1, v1 = rng.normal(size=(4, 2))
    dt = 1e-5
    path = cubic(p0, v0, p1, v1, 100_000, dt)
    np.testing.assert_array_equal(path[[0, -1]], [p0, p1])
    np.testing.assert_allclose((path[[1, -1]] - path[[0, -2]]) / dt, [v0, v1], atol=1e-3)


def test_curve_through_knots_meets_them_is_flat_at_its_ends_and_has_no_kinks():
    knots_x, knots_y, h = np.array([0.0, 1.0, 2.5, 4.0]), np.array([0.0, 1.0, -1.0, 0.5]), 1e-6
    np.testing.assert_allclose(catmull_rom(knots_x, knots_y, knots_x), knots_y, atol=1e-15)
    before = (knots_y[1:] - catmull_rom(knots_x, knots_y, knots_x[1:] - h)) / h
    after = (catmull_rom(knots_x, knots_y, knots_x[:-1] + h) - knots_y[:-1]) / h
    np.testing.assert_allclose([after[0], before[-1]], 0, atol=1e-5)
    np.testing.assert_allclose(before[:-1], after[1:], atol=1e-5)
    np.testing.assert_allclose(after[1], (knots_y[2] - knots_y[0]) / (knots_x[2] - knots_x[0]), atol=1e-5)


def test_path_that_ends_early_stays_at_its_last_point_and_a_long_one_is_cut():
    for length, steps in itertools.product(range(1, 5), range(6)):
        path = np.arange(2.0 * length).reshape(length, 2)
        expected = [path[min(k, length - 1)] for k in range(steps + 1)]
        np.testing.assert_array_equal(then_stay(path, steps), expected)
