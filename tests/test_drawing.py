"""Where the parts of a drawn robot are."""

import math

import numpy as np
import pytest

from ballbot_gym.drawing import FORCE_SCALE, PUSH_SCALE, Robot, arrows, pose

LEANING = np.array([0.5, -0.2, 0.3, -0.4, 0, 0, 0, 0])


def rotated(turn, vector):
    """A vector under the rotation of a unit quaternion."""
    w, axis = turn[0], turn[1:]
    return vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)


def test_the_quaternion_turns_about_y_by_gamma_then_about_minus_x_by_theta(params):
    ball, body, top, turn = pose(params, LEANING)
    axis = rotated(turn, np.array([0, 0, 1.0]))
    assert math.acos(axis[2]) == pytest.approx(math.acos(math.cos(0.3) * math.cos(0.4)))
    assert axis[0] > 0 > axis[1]
    assert rotated(turn, np.array([1.0, 0, 0])) == pytest.approx([math.cos(0.3), 0, -math.sin(0.3)])  # θ leaves x alone
    assert body - ball == pytest.approx(params.com_height * axis)
    assert top - body == pytest.approx(params.body_length / 2 * axis)


def test_the_arrows_start_in_the_ball_and_in_the_body_and_small_forces_have_none(params):
    pushed = Robot(LEANING, u=np.array([100.0, 0.0]), push=np.array([0.0, 50.0]))
    (_, (start, end)), (_, (struck, thrown)) = arrows(pose(params, LEANING), pushed)
    assert start == pytest.approx([0.5, -0.2, params.ball_radius])
    assert end - start == pytest.approx([100 * FORCE_SCALE, 0, 0])
    assert struck == pytest.approx(pose(params, LEANING).body)
    assert thrown - struck == pytest.approx([0, 50 * PUSH_SCALE, 0])
    for none in (Robot(LEANING, u=np.array([1.0, 0.0]), push=np.zeros(2)), Robot(LEANING)):
        assert arrows(pose(params, LEANING), none) == []
