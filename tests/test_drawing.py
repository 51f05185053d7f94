"""Where the parts of a drawn robot are."""

import math

import numpy as np
import pytest

from ballbot_gym.drawing import FORCE_SCALE, PUSH_SCALE, Robot, arrows, pose

LEANING = np.array([0.5, -0.2, 0.3, -0.4, 0, 0, 0, 0])


def test_the_body_leans_by_gamma_about_y_and_then_by_theta_about_minus_x(params):
    ball, body, top = pose(params, LEANING)
    axis = (body - ball) / params.com_height
    expected = (math.sin(0.3) * math.cos(0.4), -math.sin(0.4), math.cos(0.3) * math.cos(0.4))
    assert axis == pytest.approx(expected)
    assert top - body == pytest.approx(params.body_length / 2 * axis)


def test_the_forces_of_wheels_have_no_arrow(params):
    assert arrows(pose(params, LEANING), Robot(LEANING, u=np.array([100.0, 50.0, 20.0]))) == []


def test_the_arrows_start_in_the_ball_and_in_the_body_and_small_forces_have_none(params):
    pushed = Robot(LEANING, u=np.array([100.0, 0.0]), push=np.array([0.0, 50.0]))
    (_, (start, end)), (_, (struck, thrown)) = arrows(pose(params, LEANING), pushed)
    assert start == pytest.approx([0.5, -0.2, params.ball_radius])
    assert end - start == pytest.approx([100 * FORCE_SCALE, 0, 0])
    assert struck == pytest.approx(pose(params, LEANING).body)
    assert thrown - struck == pytest.approx([0, 50 * PUSH_SCALE, 0])
    for none in (Robot(LEANING, u=np.array([1.0, 0.0]), push=np.zeros(2)), Robot(LEANING)):
        assert arrows(pose(params, LEANING), none) == []
