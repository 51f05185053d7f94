"""Pictures of drawings."""

import math
from dataclasses import replace

import numpy as np

from ballbot_gym.drawing import Drawing, GroundPath, Robot
from ballbot_gym.drawing.picture import YAW, picture
from ballbot_gym.tasks.marker import Marker

UPRIGHT = np.zeros(8)


def pixels(frame, color):
    """Where a picture has about this colour, as rows and columns."""
    return np.argwhere(np.abs(frame.astype(int) - color).sum(axis=2) < 90)


def test_camera_follows_the_ball(params):
    states = (np.array([x, -x, 0, 0, 0, 0, 0, 0]) for x in (0.0, 20.0))
    orange = [pixels(picture(Drawing(params, (Robot(x),))), (217, 119, 6)).mean(axis=0) for x in states]
    np.testing.assert_allclose(orange[0], orange[1], atol=1)  # pixels


def test_pictures_show_lean_force_path_and_ghost(params):
    def shown(*robots, paths=(), markers=()):
        return picture(Drawing(params, robots, paths, markers), 320, 240)

    upright = Robot(UPRIGHT)
    body = pixels(shown(upright), (217, 119, 6))
    leaning = pixels(shown(Robot(leaning_to_the_right())), (217, 119, 6))
    assert leaning[:, 1].mean() > body[:, 1].mean() + 10  # columns
    assert leaning[:, 0].min() > body[:, 0].min()  # its top is lower
    assert len(pixels(shown(replace(upright, u=np.array([60.0, -190.0]))), (217, 26, 140))) > 50
    path = GroundPath(np.array([[-1.0, 0.0], [1.0, 0.0]]), "#1f6fb2")
    solid, dashed = (len(pixels(shown(paths=(replace(path, dashed=d),)), (31, 111, 178))) for d in (False, True))
    assert solid > 1.5 * dashed > 30
    ghost = shown(replace(upright, alpha=0.4))
    assert len(pixels(ghost, (217, 119, 6))) == 0
    assert (ghost != shown()).any()
    assert len(pixels(shown(upright, markers=[Marker((0.5, 0.5), 0.2, 0.5, (0.9, 0.1, 0.1, 1.0))]), (200, 25, 25))) > 25
    behind = Robot(np.array([3.0, 2.0, 1.0, 0, 0, 0, 0, 0]))  # the camera
    assert shown(behind, upright).shape == (240, 320, 3)


def leaning_to_the_right():
    """A state whose body leans across the direction in which pictures look."""
    return np.array([0, 0, 0.5 * math.cos(YAW), 0.5 * math.sin(YAW), 0, 0, 0, 0])


def test_what_is_nearer_hides_what_is_farther(params):
    away = 0.6 * np.array([-math.sin(YAW), math.cos(YAW)])
    behind, before = (Marker(tuple(sign * away), 0.3, 1.5, (0.1, 0.2, 0.9, 1.0)) for sign in (1, -1))
    counts = [
        len(pixels(picture(Drawing(params, (Robot(UPRIGHT),), markers=(marker,))), (217, 119, 6)))
        for marker in (behind, before)
    ]
    assert counts[0] > 1000
    assert counts[1] == 0
