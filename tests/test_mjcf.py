"""Robots that somebody described for MuJoCo: their numbers, and their motion behind our state, sensors and commands."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from ballbot_gym import BallbotEnv, GeneralOmni, MujocoModel
from ballbot_gym.env import make_task
from ballbot_gym.robot import Sensors, UrdfError
from ballbot_train.cli import _run as run

pytest.importorskip("mujoco")

RADIUS, WHEEL, ZENITH, AZIMUTHS = 0.11, 0.05, math.radians(42), (math.radians(10), math.radians(130), math.radians(250))
_HEAD = """<mujoco><option timestep="0.002" integrator="implicitfast" cone="elliptic"/>
<worldbody><geom name="floor" type="plane" size="5 5 0.1" friction="0.7 0.004 0.0001" condim="4"/>
"""


def mjcf(folder: Path, *changes: tuple[str, str]) -> Path:
    """Writes a ballbot with wheels of any kind; a change replaces a text by another."""
    text = f"""{_HEAD}
<body name="trunk" pos="0 0 {RADIUS}"><freejoint/>
  <inertial mass="8" pos="0.02 0 0.4" diaginertia="0.5 0.4 0.1"/>
  <body name="arm" pos="0 0 0.6"><joint name="shoulder" type="hinge" axis="0 1 0"/>
    <inertial mass="2" pos="0 -0.01 0.1" diaginertia="0.01 0.01 0.001"/></body>
  {"".join(_wheel(i, a) for i, a in enumerate(AZIMUTHS, 1))}
</body>
<body name="ball" pos="0 0 {RADIUS}"><freejoint/>
  <geom name="sphere" type="sphere" size="{RADIUS}" mass="3" friction="0.7 0.004 0.0001" condim="4"/></body>
</worldbody>
<actuator>{"".join(f'<motor name="motor_{i}" joint="wheel_{i}" gear="3" ctrlrange="-0.5 0.5"/>' for i in (1, 2, 3))}
<position joint="shoulder" kp="200"/></actuator></mujoco>"""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "robot.xml"
    path.write_text(text)
    return path


def _wheel(i: int, azimuth: float) -> str:
    s, c = math.sin(ZENITH), math.cos(ZENITH)
    out, axis = (s * math.cos(azimuth), s * math.sin(azimuth), c), (-c * math.cos(azimuth), -c * math.sin(azimuth), s)
    place = [(RADIUS + WHEEL) * each for each in out]
    ends = " ".join(f"{side * each:.9f}" for side in (-0.01, 0.01) for each in axis)
    where, along = (" ".join(f"{each:.12f}" for each in vector) for vector in (place, axis))
    sign = "-" if i == 2 else ""  # a wheel may turn either way
    along = " ".join(f"{sign}{each}".replace("--", "") for each in along.split())
    return f"""<body name="wheel_body_{i}" pos="{where}">
    <joint name="wheel_{i}" type="hinge" axis="{along}" damping="0.01" frictionloss="0.2" armature="0.002"/>
    <geom type="cylinder" fromto="{ends}" size="{WHEEL}" mass="0.1"/></body>"""


def test_the_numbers_are_those_of_the_file(tmp_path):
    robot = MujocoModel(mjcf(tmp_path)).robot
    assert type(robot) is GeneralOmni
    assert (robot.ball_mass, robot.ball_radius, robot.friction) == (pytest.approx(3), RADIUS, pytest.approx(0.7))
    assert robot.body_mass == pytest.approx(10.3)
    wheels = 0.3 * (RADIUS + WHEEL) * math.cos(ZENITH)
    assert robot.com_height == pytest.approx((8 * 0.4 + 2 * 0.7 + wheels) / 10.3)
    assert (robot.com_x, robot.com_y) == (pytest.approx(8 * 0.02 / 10.3), pytest.approx(-2 * 0.01 / 10.3))
    assert robot.wheels.radius == pytest.approx(WHEEL)
    assert robot.force_limit == pytest.approx(1.5 / WHEEL)
    assert robot.zenith == pytest.approx(ZENITH)
    azimuths = np.array([robot.azimuth_1, robot.azimuth_2, robot.azimuth_3])
    np.testing.assert_allclose(np.cos(azimuths - AZIMUTHS), 1.0)
    assert robot.axle_friction == pytest.approx(0.2)
    assert robot.wheels.damping == pytest.approx(0.01)
    assert robot.wheels.inertia == pytest.approx(0.002 + 0.5 * 0.1 * WHEEL**2, rel=1e-3)
    assert robot.wheels.spin_friction == pytest.approx(0.004 * robot.weight)


def test_bodies_are_lumped_where_they_are_held(tmp_path):
    held = MujocoModel(mjcf(tmp_path), {"shoulder": math.radians(90)}).robot
    assert held.com_x == pytest.approx((8 * 0.02 + 2 * 0.1) / 10.3)
    upright = MujocoModel(mjcf(tmp_path)).robot
    assert held.inertia < upright.inertia  # the arm's mass is nearer to the centre of mass along the axis


def test_the_motion_is_that_of_our_state(tmp_path):
    model = MujocoModel(mjcf(tmp_path))
    x = np.array([0.1, -0.2, 0.05, -0.04, 0.1, 0.2, 0.1, 0.05, 0.5, 0.3, 0.4])
    np.testing.assert_allclose(model.reset(x), x, atol=1e-9)
    np.testing.assert_allclose(model.readings[:3], model.robot.readings(x, np.zeros(3))[:3], atol=1e-9)
    assert model.observed(np.zeros(0)).shape == (11,)


def test_at_first_the_accelerometer_reads_what_a_robot_without_force_feels(tmp_path):
    model = MujocoModel(mjcf(tmp_path))
    model.reset(model.robot.rest())
    np.testing.assert_allclose(model.readings[3:6], [0, 0, model.robot.gravity], atol=0.3 * model.robot.gravity)


def test_all_wheels_together_turn_body_and_ball_against_each_other_as_in_the_equations(tmp_path):
    """Wheels without rollers roll in this motion alone."""
    model = MujocoModel(mjcf(tmp_path))
    x, robot = model.reset(model.robot.rest()), model.robot
    turned = np.zeros(3)
    for _ in range(10):
        found = model.step(np.full(3, 12.0))
        x = robot.step(x, np.full(3, 12.0), 0.02, 4)
        turned += model.readings[6:]
    assert (turned > 0).all()
    assert found[9] < -0.1
    assert found[9] == pytest.approx(x[9], rel=0.5)
    assert model.readings[2] == pytest.approx(found[9], rel=0.2)
    np.testing.assert_allclose(model.readings[3:6], [0, 0, robot.gravity], atol=1.0)


def test_an_environment_of_the_robot_simulates_its_sensors(tmp_path):
    robot = MujocoModel(mjcf(tmp_path)).robot
    env = BallbotEnv(make_task("stabilize", "omni"), "rk4", robot=robot, observation="sensors")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (11,)
    assert Sensors(robot, 0.02).samples == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('type="plane" size="5 5 0.1"', 'type="box" size="5 5 0.1" pos="0 0 -0.1"'), "there is no floor"),
        (('name="ball" pos="0 0 0.11"', 'name="ball" pos="0 0 0.3"'), "no ball on the floor"),
        (('type="sphere" size="0.11"', 'type="box" size="0.11 0.11 0.11"'), "no ball on the floor"),
        ((f'size="{WHEEL}"', 'size="0.02"'), "no wheels touch the ball"),
        (('<motor name="motor_2" joint="wheel_2" gear="3" ctrlrange="-0.5 0.5"/>', ""), "three wheels, and here are 2"),
        ((' ctrlrange="-0.5 0.5"', ""), "has no limit; give its actuator a ctrlrange or a forcerange"),
        (('<motor name="motor_1" joint="wheel_1" gear="3"', '<position kp="9" joint="wheel_1"'), "is a servo"),
        (
            ('<body name="trunk" pos="0 0 0.11"><freejoint/>', '<body name="trunk" pos="0 0 0.11">'),
            "give it a freejoint",
        ),
        (('mass="8" pos="0.02 0 0.4"', 'mass="80" pos="0.02 0 -0.1"'), "below the ball's centre"),
        (("<mujoco>", "<mujoco><"), "MuJoCo cannot read it"),
    ],
)
def test_what_is_no_ballbot_is_named(tmp_path, change, message):
    with pytest.raises(UrdfError, match=re.escape(message)):
        MujocoModel(mjcf(tmp_path, change))


def test_joints_that_are_not_there_are_named(tmp_path):
    with pytest.raises(UrdfError, match="no joint 'elbow' to hold; known: 'shoulder'"):
        MujocoModel(mjcf(tmp_path), {"elbow": 1.0})


@pytest.mark.slow
def test_commands_take_an_mjcf_where_they_take_a_robot(tmp_path, capsys):
    path = mjcf(tmp_path)
    state = ["--state", "0.2", "0", "0", "0", "0", "0", "0", "0"]
    assert run(["optimize", "stabilize", "--robot", str(path), "--out", str(tmp_path / "out"), *state]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"axle_friction\W+0\.2\b", shown)
    assert "trajectory:" in shown
