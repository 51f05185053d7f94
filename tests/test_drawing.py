"""Where the parts of a drawn robot are."""

import math

import numpy as np
import pytest

from ballbot_gym.drawing import FORCE_SCALE, PUSH_SCALE, Drawing, Drawn

LEANING = np.array([0.5, -0.2, 0.3, -0.4, 0, 0, 0, 0])


def test_the_body_leans_by_gamma_about_y_and_then_by_theta_about_minus_x(params):
    ball, axis = params.placed(LEANING)
    assert ball == pytest.approx([0.5, -0.2, params.ball_radius])
    expected = (math.sin(0.3) * math.cos(0.4), -math.sin(0.4), math.cos(0.3) * math.cos(0.4))
    assert axis == pytest.approx(expected)
    _, body, cap = params.shapes(LEANING)
    assert np.subtract(cap.end, ball) == pytest.approx((params.com_height + params.body_length / 2) * axis)
    assert np.subtract(cap.end, body.start) == pytest.approx(params.body_length * axis)


def arrows(params, robot):
    return Drawing(params, (robot,)).arrows(robot)


def test_the_forces_of_wheels_have_no_arrow(params):
    assert arrows(params, Drawn(LEANING, u=np.array([100.0, 50.0, 20.0]))) == []


def test_the_arrows_start_in_the_ball_and_in_the_body_and_small_forces_have_none(params):
    pushed = Drawn(LEANING, u=np.array([100.0, 0.0]), push=np.array([0.0, 50.0]))
    (_, (start, end)), (_, (struck, thrown)) = arrows(params, pushed)
    ball, axis = params.placed(LEANING)
    assert start == pytest.approx(ball)
    assert end - start == pytest.approx([100 * FORCE_SCALE, 0, 0])
    assert struck == pytest.approx(ball + params.com_height * axis)
    assert thrown - struck == pytest.approx([0, 50 * PUSH_SCALE, 0])
    for none in (Drawn(LEANING, u=np.array([1.0, 0.0]), push=np.zeros(2)), Drawn(LEANING)):
        assert arrows(params, none) == []
