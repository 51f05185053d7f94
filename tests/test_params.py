import dataclasses
from fractions import Fraction

import numpy as np
import pytest

from ballbot_gym.robot import (
    ROBOTS,
    URDF_PATH,
    PointBall,
    UrdfError,
    default_params,
    named_robot,
    read_urdf,
    urdf_text,
)


def test_packaged_robot_has_the_numbers_that_give_the_papers_linearization():
    assert default_params() == PointBall(
        ball_mass=0.5,
        ball_radius=0.1,
        body_mass=15.0,
        body_radius=0.1,
        body_length=1.0,
        com_height=0.6,
        inertia=1.2875,
        axial_inertia=0.075,
        force_limit=350.0,
        gravity=9.81,
    )


def test_body_is_a_solid_cylinder(params):
    m, r, length = params.body_mass, params.body_radius, params.body_length
    assert params.inertia == pytest.approx(m * (3 * r**2 + length**2) / 12, rel=1e-12)
    assert params.axial_inertia == pytest.approx(m * r**2 / 2, rel=1e-12)


def test_derived_quantities_are_those_of_the_two_masses(params):
    assert params.total_mass == 15.5
    assert params.first_moment == pytest.approx(9.0)
    assert params.pivot_inertia == pytest.approx(1.2875 + 15 * 0.6**2)


@pytest.mark.parametrize("robot", ROBOTS)
def test_written_urdf_reads_back_bit_by_bit(robot, tmp_path):
    params = named_robot(robot)
    numbers = {name: value for name, value in dataclasses.asdict(params).items() if value and isinstance(value, float)}
    # thirds and sevenths: numbers that a short decimal would lose
    changed = dataclasses.replace(params, **{name: value * 8 / 7 + 1 / 3 for name, value in numbers.items()})
    if hasattr(changed, "wheels"):
        changed = dataclasses.replace(changed, wheels=dataclasses.replace(changed.wheels, radius=1 / 3))
    path = tmp_path / "changed.urdf"
    path.write_text(urdf_text(changed))
    assert read_urdf(path, gravity=changed.gravity) == changed


def test_a_ball_whose_inertia_is_beyond_all_numbers_has_a_urdf_too(params, tmp_path):
    huge = dataclasses.replace(params, ball_radius=1e200)
    (tmp_path / "huge.urdf").write_text(urdf_text(huge))
    assert read_urdf(tmp_path / "huge.urdf", gravity=huge.gravity) == huge


def test_gravity_is_the_callers_and_defaults_to_the_earths():
    assert read_urdf().gravity == 9.81
    assert read_urdf(gravity=1.62).gravity == 1.62


def test_revolute_leans_are_as_good_as_continuous_ones(tmp_path, params):
    assert read_changed(tmp_path, 'type="continuous"', 'type="revolute"') == params


def read_changed(folder, old, new):
    text = URDF_PATH.read_text()
    assert old in text
    path = folder / "changed.urdf"
    path.write_text(text.replace(old, new))
    return read_urdf(path)


def block(start, end):
    """The packaged URDF's text from `start` through the next `end`."""
    text = URDF_PATH.read_text()
    first = text.index(start)
    return text[first : text.index(end, first) + len(end)]


BAD_URDFS = {
    "missing joint": (block('<joint name="theta"', "</joint>"), "", "joint 'theta' is missing"),
    "missing inertial": (
        block('<inertial>\n      <mass value="0.5"/>', "</inertial>"),
        "",
        "link 'ball' has no <inert",
    ),
    "missing attribute": (
        '<mass value="15"/>',
        "<mass/>",
        "link[@name='body']/inertial/mass: value = '' is not a number",
    ),
    "negative mass": ('<mass value="15"/>', '<mass value="-15"/>', "body_mass must be positive and finite, not -15.0"),
    "body not round": (
        'iyy="1.2875"',
        'iyy="1.3"',
        "link 'body': inertial/inertia iyy is (1.3,), and must be (1.2875,)",
    ),
    "wrong axis": ('<axis xyz="-1 0 0"/>', '<axis xyz="1 0 0"/>', "joint 'theta': axis xyz is (1.0, 0.0, 0.0)"),
    "wrong parent": (
        '<parent link="ball"/>',
        '<parent link="slide"/>',
        "joint 'gamma': parent link is slide, and must be ball",
    ),
    "displaced joint": ('<child link="body"/>', '<child link="body"/><origin xyz="0 0 0.2"/>', "joint 'theta'"),
}


@pytest.mark.parametrize(("old", "new", "culprit"), BAD_URDFS.values(), ids=BAD_URDFS.keys())
def test_bad_urdf_gets_an_error_that_names_file_and_culprit(tmp_path, old, new, culprit):
    with pytest.raises(UrdfError) as error:
        read_changed(tmp_path, old, new)
    assert culprit in str(error.value)
    assert "changed.urdf" in str(error.value)


def test_unequal_force_limits_are_refused(tmp_path):
    text = URDF_PATH.read_text().replace('effort="350"', 'effort="300"', 1)
    path = tmp_path / "uneven.urdf"
    path.write_text(text)
    with pytest.raises(UrdfError, match=r"one effort limit, not 300\.0 and 350\.0 N"):
        read_urdf(path)


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.array, int, Fraction])
def test_every_kind_of_number_is_a_float_in_the_robot_and_in_its_urdf(kind, params, tmp_path):
    robot = dataclasses.replace(params, body_mass=kind(12), gravity=kind(9))
    assert repr(robot) == repr(dataclasses.replace(params, body_mass=12.0, gravity=9.0))
    (tmp_path / "robot.urdf").write_text(urdf_text(robot))
    assert read_urdf(tmp_path / "robot.urdf", gravity=9.0) == robot
    wheels = dataclasses.replace(named_robot("omni").wheels, radius=kind(1))
    assert repr(wheels.radius) == "1.0"
