import gc
import locale
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pybullet
import pytest

from ballbot_gym.engines import bullet, make_simulator
from ballbot_gym.robot import ROBOTS, named_robot, urdf_text

START = (0.1, -0.2, 0.6, -0.5, 1.0, -2.0, 1.5, 2.0)
FORCE = (60.0, -40.0)
GENTLE = (0.0, 0.0, 0.2, -0.1, 1.0, -2.0, 0.5, 0.3)


def held(params, physics, x, u, seconds, physics_dt):
    """The state after holding u for some seconds."""
    simulator = make_simulator(physics, params, seconds, physics_dt)
    simulator.reset(x)
    try:
        return np.array(simulator.step(u))
    finally:
        simulator.close()


def open_clients():
    return sum(pybullet.getConnectionInfo(i)["isConnected"] for i in range(1024))


def test_bullet_converges_to_the_closed_form_at_first_order(params):
    exact = held(params, "rk4", START, FORCE, 0.3, 0.0005)  # exact to 1e-11: its error is fourth order
    errors = [np.abs(held(params, "bullet", START, FORCE, 0.3, dt) - exact).max() for dt in (1e-3, 5e-4, 2.5e-4)]
    # first order means 2; measured 2.0e-2, 9.8e-3, 4.9e-3
    assert errors[0] == pytest.approx(2.0e-2, rel=0.05)
    assert 1.7 < errors[0] / errors[1] < 2.3
    assert 1.7 < errors[1] / errors[2] < 2.3


COMMAS = """\
LC_CTYPE
copy "POSIX"
END LC_CTYPE
LC_NUMERIC
decimal_point ","
thousands_sep "."
grouping 3;3
END LC_NUMERIC
"""
"""The source of a locale, because few containers have one with decimal commas."""


@pytest.fixture
def decimal_commas(tmp_path, monkeypatch):
    """A call after which C's decimals have commas."""
    if shutil.which("localedef") is None:
        pytest.skip("no localedef makes a locale here")
    (tmp_path / "source").write_text(COMMAS)
    # it leaves out, with a warning and exit status 1, what the source does not have
    subprocess.run(["localedef", "-c", "-i", tmp_path / "source", tmp_path / "commas"], capture_output=True)
    monkeypatch.setenv("LOCPATH", str(tmp_path))
    found = locale.setlocale(locale.LC_NUMERIC)
    yield lambda: locale.setlocale(locale.LC_NUMERIC, "commas")
    locale.setlocale(locale.LC_NUMERIC, found)


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_move_the_same_bit_for_bit_where_decimals_have_commas(name, physics, decimal_commas):
    robot, varied = named_robot(name), replace(named_robot(name), com_height=0.55)
    start, force = (*GENTLE, 0.0, 0.0, 0.0)[: robot.state_size], (5.0, -3.0, 1.0)[: robot.action_size]
    ends = []
    for changes in (lambda: None, decimal_commas):
        changes()
        simulator = make_simulator(physics, robot, 0.02)
        for params in (robot, varied):  # the second one loads a URDF again
            simulator.set_params(params)
            simulator.reset(start)
            ends.append([simulator.step(force) for _ in range(5)])
        simulator.close()
    assert ends[:2] == ends[2:]
    assert locale.localeconv()["decimal_point"] == ","  # as it was


def test_inertias_that_no_body_can_have_are_refused(params):
    with pytest.raises(ValueError, match="axial_inertia must be at most twice inertia"):
        replace(params, axial_inertia=3.0)  # of which Bullet would make 0


def test_bullet_refuses_a_robot_whose_numbers_it_does_not_hold(params, monkeypatch):
    monkeypatch.setattr(bullet, "urdf_text", lambda robot: urdf_text(robot).replace('"15.0"', '"fifteen"'))
    with pytest.raises(RuntimeError, match=r"PyBullet has \(0.0"):
        make_simulator("bullet", params, 0.02)


@pytest.mark.parametrize("change", [{"gravity": 3.7}, {"body_mass": 9.0}, {"com_height": 0.4, "gravity": 3.7}], ids=str)
@pytest.mark.parametrize("name", ["paper", "rolling"])
def test_a_robot_that_is_replaced_moves_as_one_made_anew(name, change, physics):
    other = replace(named_robot(name), **change)
    simulators = [make_simulator(physics, robot, 0.02) for robot in (named_robot(name), other)]
    simulators[0].set_params(other)
    ends = []
    for simulator in simulators:
        simulator.reset(GENTLE)
        ends.append([simulator.step((5.0, -3.0)) for _ in range(5)])
    assert ends[0] == ends[1]
    with pytest.raises(ValueError, match="this simulator was made for a"):
        simulators[0].set_params(named_robot("rolling" if name == "paper" else "paper"))
    for simulator in simulators:
        simulator.close()


def test_bullet_conserves_energy_to_first_order(params):
    energy = params.energy(GENTLE)
    steps = (2e-3, 1e-3, 5e-4)
    drift = [abs(params.energy(held(params, "bullet", GENTLE, (0.0, 0.0), 0.5, dt)) - energy) for dt in steps]
    assert drift[1] < 0.01 * energy  # measured 0.53 J of 117 J at 1 ms
    assert 1.7 < drift[0] / drift[1] < 2.3
    assert 1.7 < drift[1] / drift[2] < 2.3


def test_two_simulators_do_not_disturb_each_other(params, physics):
    alone, beside, other = (make_simulator(physics, params, 0.02) for _ in range(3))
    for simulator in (alone, beside):
        simulator.reset(START)
    expected = [alone.step(FORCE) for _ in range(10)]
    got = []
    for _ in range(10):
        other.reset(GENTLE)
        got.append(beside.step(FORCE))
        other.step((-350.0, 350.0))
    assert got == expected
    for simulator in (alone, beside, other):
        simulator.close()


def test_forgotten_simulators_release_their_clients(params):
    gc.collect()  # what other tests forgot
    before = open_clients()
    simulator = make_simulator("bullet", params, 0.02)
    assert open_clients() == before + 1
    del simulator
    assert open_clients() == before


def test_running_out_of_clients_says_what_to_do(params, monkeypatch):
    monkeypatch.setattr(pybullet, "connect", lambda mode: -1)
    with pytest.raises(RuntimeError, match=r"no free physics client; close\(\)"):
        make_simulator("bullet", params, 0.02)
