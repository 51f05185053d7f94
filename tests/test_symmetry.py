"""Symmetries that tasks declare hold for the robot, for the costs, and for the policies that are built on them."""

import numpy as np
import pytest
import torch

from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.symmetry import FRAMES
from ballbot_train.learning.actors import spec_for
from ballbot_train.policy.files import PolicySpec
from ballbot_train.policy.network import PolicyNetwork

MIRRORED = [(name, i) for name, kind in TASKS.items() for i in range(len(kind().mirrors))]


def moments(task, params, rng, count=20):
    """States, constants and forces of episodes under way."""
    for _ in range(count):
        _, c = task.sample(rng, params)
        x = rng.uniform(-1, 1, 8) * [3, 3, 0.8, 0.8, 4, 4, 2, 2]
        yield x, c, rng.uniform(-300, 300, 2)


@pytest.mark.parametrize(("name", "index"), MIRRORED)
def test_a_mirror_image_moves_as_the_mirror_image_and_costs_the_same(name, index, params, rng):
    task = TASKS[name]()
    mirror = task.mirrors[index]
    signs = np.array(mirror.state), np.array(mirror.constants or 1), np.array(mirror.action)
    for x, c, u in moments(task, params, rng):
        mx, mc, mu = x * signs[0], c * signs[1], u * signs[2]
        after, mirrored = (params.step(tuple(a), tuple(b), 0.02, 2) for a, b in ((x, u), (mx, mu)))
        np.testing.assert_allclose(np.array(after) * signs[0], mirrored, rtol=1e-12, atol=1e-12)
        assert task.cost(mx, mu, mc) == pytest.approx(task.cost(x, u, c), rel=1e-12)
        for function in (task.limits, task.goal):
            np.testing.assert_allclose(function(mx, mc), function(x, c), rtol=1e-9, atol=1e-9)
        observed = np.array(task.observe(tuple(x), tuple(c))) * task.observation_signs(mirror)
        np.testing.assert_allclose(observed, task.observe(tuple(mx), tuple(mc)), rtol=1e-12, atol=1e-12)


def test_mirror_images_of_a_task_form_a_group(task):
    found = {(mirror.state, mirror.action, mirror.constants) for mirror in task.mirrors}
    for first in task.mirrors:
        for second in task.mirrors:
            product = tuple(
                tuple(a * b for a, b in zip(getattr(first, part), getattr(second, part), strict=True))
                for part in ("state", "action", "constants")
            )
            assert product in found or set(product[0]) == {1}


def turned(x, angle):
    """A state seen from a world that is turned about the vertical: the body's axis is rotated, then read as angles."""
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

    def axis(gamma, theta):
        return np.array([np.sin(gamma) * np.cos(theta), np.sin(theta)])

    gamma, theta = x[2:4]
    rate = np.array([np.cos(gamma) * np.cos(theta) * x[6] - np.sin(gamma) * np.sin(theta) * x[7], np.cos(theta) * x[7]])
    nx, ny = rotation @ axis(gamma, theta)
    rx, ry = rotation @ rate
    height = np.cos(gamma) * np.cos(theta)
    vertical_rate = -np.sin(gamma) * np.cos(theta) * x[6] - np.cos(gamma) * np.sin(theta) * x[7]
    theta_dot = ry / np.sqrt(1 - ny**2)
    gamma_dot = (rx * height - nx * vertical_rate) / (nx**2 + height**2)
    angles = [np.arctan2(nx, height), np.arcsin(ny)]
    return np.concatenate([rotation @ x[:2], angles, rotation @ x[4:6], [gamma_dot, theta_dot]])


def test_the_radial_frame_sees_the_same_wherever_on_the_circle_the_robot_is(params, rng):
    task = TASKS["orbit"]()
    frame = FRAMES[task.frame]
    for x, c, u in moments(task, params, rng):
        x[2:4] *= 0.7
        seen, back = frame.features(tuple(task.observe(tuple(x), tuple(c))))
        assert len(seen) == frame.size
        angle = rng.uniform(-np.pi, np.pi)
        elsewhere, back_elsewhere = frame.features(tuple(task.observe(tuple(turned(x, angle)), tuple(c))))
        np.testing.assert_allclose(elsewhere, seen, rtol=1e-9, atol=1e-9)
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(back_elsewhere(tuple(u)), rotation @ back(tuple(u)), rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("name", ["frame", "fine_frame"])
def test_the_slalom_frames_see_a_mirror_image_as_the_same(params, rng, name):
    task = TASKS["weave"]()
    frame, signs = FRAMES[getattr(task, name)], np.array(task.observation_signs(task.mirrors[0]))
    for _ in range(50):
        seen = task.observe(*task.sample(rng, params)) + rng.normal(size=len(signs))
        features, back = frame.features(tuple(seen))
        mirrored, mirrored_back = frame.features(tuple(signs * seen))
        assert len(features) == frame.size
        np.testing.assert_allclose(mirrored, features, atol=1e-12)
        assert mirrored_back((1.0, 2.0)) == (back((1.0, 2.0))[0], -back((1.0, 2.0))[1])


@pytest.mark.parametrize(("name", "index"), MIRRORED)
def test_a_policy_that_is_averaged_over_mirror_images_mirrors_exactly(name, index, rng):
    task = TASKS[name]()
    mirrors = tuple((task.observation_signs(mirror), mirror.action) for mirror in task.mirrors)
    network = PolicyNetwork(PolicySpec.of(task, hidden=(16,), linear=False, mirrors=mirrors))
    observation = torch.as_tensor(rng.normal(size=(50, len(task.observation_scale))), dtype=torch.float32)
    signs, action_signs = (torch.tensor(part) for part in mirrors[index])
    torch.testing.assert_close(network(signs * observation), action_signs * network(observation))


def steady_motion(task, c, params, rng):
    """A state and the force of the motion in which an episode shall end."""
    if task.id == "BallbotOrbit-v0":
        states, forces = params.steady_orbit(*c, rng.uniform(0, 6, 1))
        return states[0], forces[0]
    goal = c[:2] if len(c) else np.zeros(2)
    return np.array([*goal, *np.zeros(6)]), np.zeros(2)


@pytest.mark.parametrize(
    ("name", "frame"), [("orbit", "radial"), ("weave", "slalom"), ("weave", "fine_slalom"), ("stabilize", "fine_rest")]
)
def test_a_frame_knows_the_steady_motion_of_the_episode(params, rng, name, frame):
    task = TASKS[name]()
    frame = FRAMES[frame]
    for _ in range(50):
        x, c = task.sample(rng, params)
        ending, force = steady_motion(task, c, params, rng)
        seen, back = frame.features(tuple(task.observe(ending, c)))
        for features in (seen, frame.features(tuple(task.observe(x, c)))[0]):
            steady, action = frame.steady(features)
            np.testing.assert_allclose(steady, seen, atol=1e-3)
            np.testing.assert_allclose(back(action), force / params.force_limit, atol=1e-3)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("name", ["orbit", "weave", "stabilize"])
def test_centred_policies_keep_the_steady_motion_whatever_they_learnt(params, rng, name, linear):
    task = TASKS[name]()
    network = PolicyNetwork(spec_for(task, "centred", (8,), linear))
    torch.nn.init.normal_(network.mlp[-1].weight)
    _, c = task.sample(rng, params)
    x, force = steady_motion(task, c, params, rng)
    observations = torch.tensor(np.stack([task.observe(each, c) for each in (x, 1.1 * x + 0.1)]), dtype=torch.float32)
    with torch.inference_mode():
        kept, away = network(observations)
        np.testing.assert_allclose(network(observations[0]), kept, atol=1e-5)
    np.testing.assert_allclose(kept, force / params.force_limit, atol=5e-3)
    assert (away - kept).abs().max() > 0.01
