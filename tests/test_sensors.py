"""What robots with wheels measure, and the filter that makes a state of it."""

import copy

import numpy as np
import pytest

from ballbot_baselines import StateFromSensors
from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import TRACKS, Sensors, named_robot
from ballbot_gym.rollout import rollout
from ballbot_train.evaluation.controllers import ControllerName, controllers_of
from ballbot_train.evaluation.evaluate import evaluate
from ballbot_train.report.replay import certified_replay
from ballbot_train.report.simulation import Playground

DT = 0.02


@pytest.fixture
def robot():
    return named_robot("omni")


def random_motion(robot, rng):
    """A state, the wheels' forces, and the state a control step later."""
    x = tuple((np.array([1, 1, 0.4, 0.4, 1, 1, 1, 1, 3, 1, 3]) * rng.uniform(-1, 1, 11)).tolist())
    u = tuple(rng.uniform(-20, 20, 3).tolist())
    return x, u, robot.step(x, u, DT)


def body(x):
    """The body's axes as columns."""
    (sin_g, sin_t, sin_p), (cos_g, cos_t, cos_p) = np.sin([x[2], x[3], x[8]]), np.cos([x[2], x[3], x[8]])
    about_y = np.array([[cos_g, 0, sin_g], [0, 1, 0], [-sin_g, 0, cos_g]])
    about_x = np.array([[1, 0, 0], [0, cos_t, sin_t], [0, -sin_t, cos_t]])
    about_z = np.array([[cos_p, -sin_p, 0], [sin_p, cos_p, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def test_standing_still_only_gravity_is_measured(robot):
    read = robot.readings((0.0,) * 11, (0.0,) * 3)
    np.testing.assert_allclose(read, [0, 0, 0, 0, 0, robot.gravity, 0, 0, 0], atol=1e-12)


def test_the_gyroscope_measures_how_the_body_turns_and_the_accelerometer_how_its_centre_speeds_up(robot, rng):
    def rate(of, x, u, h=1e-4):
        """Of a function of the state, by differences along the motion."""
        slope = h * np.array(robot.derivative(x, u))
        return (of(x + slope) - of(x - slope)) / (2 * h)

    def speed(x):
        return np.array([*x[4:6], 0.0]) + robot.com_height * rate(body, x, u)[:, 2]

    for x, u, _ in (random_motion(robot, rng) for _ in range(3)):
        x = np.array(x)
        turning = body(x).T @ rate(body, x, u)
        force = body(x).T @ (rate(speed, x, u) + [0, 0, robot.gravity])
        found = robot.readings(tuple(x), u)
        np.testing.assert_allclose(found[:3], [turning[2, 1], turning[0, 2], turning[1, 0]], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found[3:6], force, rtol=1e-4, atol=1e-3)


def test_wheels_turn_as_their_power_says(robot, rng):
    x, u, _ = random_motion(robot, rng)
    w, _ = robot.relative_turning(x)
    speeds = np.array(robot.readings(x, u)[6:])
    assert robot.wheels.radius * speeds @ u == pytest.approx(np.dot(robot.torque(u, x[8]), w))


def test_readings_are_means_over_the_control_step(robot, rng):
    x, u, after = random_motion(robot, rng)
    read, fine, parts = Sensors(robot, DT).mean(x, u, after), x, []
    for _ in range(20):
        later = robot.step(fine, u, DT / 20)
        parts.append(Sensors(robot, DT / 20).mean(fine, u, later))
        fine = later
    expected = np.array(parts)
    expected = [*expected[:, :6].mean(0), *expected[:, 6:].sum(0)]
    np.testing.assert_allclose(read, expected, rtol=1e-3, atol=1e-3)


def test_encoders_forget_nothing_of_a_turn(robot):
    env = BallbotEnv(robot=robot, physics="rk4", observation="sensors", history=1)
    seen, info = env.reset(seed=3)
    assert env.observation_space.contains(seen)
    assert seen.shape == (2 * 11 + 3,)
    counted, turned, x = np.zeros(3), np.zeros(3), tuple(info["state"])
    for _ in range(10):
        seen, *_, info = env.step([0.1, -0.05, -0.05])
        after = tuple(info["state"])
        turned += Sensors(robot, DT).mean(x, tuple(info["force"]), after)[6:]
        counted, x = counted + seen[6:9], after
    assert np.abs(counted - turned).max() < 2 * Sensors.TICK


def test_a_copy_goes_on_with_the_same_readings():
    env = BallbotEnv(robot="omni", physics="rk4", observation="sensors")
    env.reset(seed=0)
    other, held = copy.deepcopy(env), env.get_state()
    first = env.step([0.1, 0.0, 0.0])[0]
    np.testing.assert_array_equal(other.step([0.1, 0.0, 0.0])[0], first)
    env.set_state(held)
    np.testing.assert_array_equal(env.step([0.1, 0.0, 0.0])[0], first)
    with pytest.raises(ValueError, match="another randomization, history or observation"):
        BallbotEnv(robot="omni", physics="rk4").set_state(held)


def test_batches_measure_what_single_envs_do(monkeypatch):
    torch = pytest.importorskip("torch")
    from ballbot_gym.vector import BallbotVectorEnv

    for name in ("GYROSCOPE_NOISE", "GYROSCOPE_BIAS", "ACCELEROMETER_NOISE"):
        monkeypatch.setattr(Sensors, name, 0.0)
    given = {"task": "turn", "robot": "omni", "observation": "sensors", "history": 1}
    vector = BallbotVectorEnv(2, dtype=torch.float64, **given)
    many, infos = vector.reset(seed=0)
    env = BallbotEnv(physics="rk4", **given)
    alone, _ = env.reset(options={"state": infos["state"][0], "constants": infos["constants"][0]})
    for _ in range(3):
        np.testing.assert_allclose(many[0], alone, rtol=1e-5, atol=1e-6)
        many, *_ = vector.step(np.tile([0.1, -0.1, 0.05], (2, 1)))
        alone, *_ = env.step([0.1, -0.1, 0.05])


def test_lqr_behind_the_filter_comes_to_rest_from_sensors_alone():
    env = BallbotEnv(robot="omni", physics="rk4", observation="sensors")
    controller, known = ControllerName("lqr-ekf").make(env.task, env.params), certified.load(env.task, "omni")
    for i in range(3):
        episode = rollout(env, controller, seed=i, options=known.options(i))
        assert episode.success
        assert episode.cost < 1.1 * known.costs[i]
        off = np.abs(controller.filter.x - episode.trajectory.x[-2])
        assert off[2:4].max() < 3e-3  # rad; 1e-3 is usual
        assert off[:2].max() < 0.02  # m
    with pytest.raises(ValueError, match="needs states"):
        rollout(env, ControllerName("lqr").make(env.task, env.params))


def test_evaluation_shows_sensors_to_a_filtered_controller():
    rows = [evaluate(name, "stabilize", episodes=2, physics="rk4", robot="omni_strong") for name in ("lqr", "lqr-ekf")]
    assert [row.success for row in rows] == [1, 1]
    assert 0 < rows[1].regret_mean - rows[0].regret_mean < 0.1
    assert controllers_of(["stabilize"], ["lqr-ekf"], ["omni"]) == {"omni": {"stabilize": ["lqr-ekf"]}}


def test_replays_and_the_playground_show_sensors_to_a_filtered_controller():
    first, again = (certified_replay("stabilize", ["lqr-ekf"], 0, "rk4", robot="omni").takes[0] for _ in range(2))
    playground = Playground("stabilize", "lqr-ekf", physics="rk4", robot="omni")
    for _ in range(100):
        playground.step()
    playground.close()
    assert not first.failed
    np.testing.assert_array_equal(first.trajectory.x, again.trajectory.x)
    assert (playground.main.violated, playground.notice) == ("", "")


def test_the_playground_changes_to_a_controller_that_takes_sensors_and_back():
    playground = Playground("stabilize", "lqr", physics="rk4", robot="omni")
    for name in ("lqr-ekf", "lqr", "lqr-ekf"):
        for _ in range(25):
            playground.step()
        playground.set_controller(name)
    playground.set_plant("mass", playground.plant["mass"])
    for _ in range(50):
        playground.step()
    assert (playground.main.violated, playground.notice) == ("", "")
    playground.close()


def test_the_wrapper_shows_a_policy_the_state():
    env = StateFromSensors(BallbotEnv("orbit", robot="omni", physics="rk4", observation="sensors"))
    seen, info = env.reset(seed=0)
    for _ in range(3):
        assert env.observation_space.contains(seen)
        np.testing.assert_allclose(env.filter.x, info["state"], atol=0.1)
        seen, _, _, _, info = env.step(np.zeros(3))
    with pytest.raises(ValueError, match='observation="sensors"'):
        StateFromSensors(BallbotEnv(robot="omni", physics="rk4"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observation": "pixels"}, "'state' or 'sensors', not 'pixels'"),
        ({"observation": "sensors"}, "only robots with wheels have sensors"),
        ({"observation": "sensors", "robot": "omni", "randomization": TRACKS["noisy"]}, "noise of their own"),
    ],
)
def test_sensors_that_none_has_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        BallbotEnv(physics="rk4", **given)
