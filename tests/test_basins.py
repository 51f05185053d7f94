import json
import math

import numpy as np
import pytest
from builders import FunctionController
from builders import result as certified_result

from ballbot_baselines import find_optimum
from ballbot_baselines.optimum.recovery import largest_leans
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, named_robot
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_train.evaluation import basins
from ballbot_train.report import figures

LEAN_RATE = 6  # its index in a state


@pytest.fixture(scope="module")
def limits(params):
    """Largest recoverable leans, degrees: standing, and at 0, 1 and 2 rad/s."""
    return np.degrees(largest_leans(Stabilize(), params, LEAN_RATE, np.array([0.0, 1.0, 2.0])))


def test_more_lean_is_recoverable_than_the_force_along_an_axis_holds_and_less_than_its_diagonal(limits, params):
    along, diagonal = (
        math.degrees(math.atan(factor * params.force_limit / (params.total_mass * params.gravity)))
        for factor in (1, math.sqrt(2))
    )
    assert along < limits[0] < diagonal


def test_the_faster_it_falls_the_less_lean_is_recoverable(limits):
    assert limits[0] > limits[1] + 5 > limits[2] + 10


def test_the_full_force_rights_what_is_within_the_boundary_and_not_what_is_beyond(limits, params, make_env):
    env = make_env(physics="rk4")
    full = FunctionController(lambda t, x: np.array([params.force_limit, 0.0]))
    for lean, righted in ((limits[0] - 3, True), (limits[0] + 3, False)):
        x = np.zeros(8)
        x[2] = math.radians(lean)
        leans = rollout(env, full, options={"state": x}).trajectory.x[:, 2]
        assert (leans.min() < 0) == righted


@pytest.mark.slow  # it compiles twice
def test_a_floor_that_lets_the_ball_slip_allows_less_lean_and_that_much_can_be_planned(limits):
    task, robot = make_task("stabilize", "rolling", duration=4.0), named_robot("rolling")
    (lean,) = np.degrees(largest_leans(task, robot, LEAN_RATE, np.array([0.0])))
    assert math.degrees(math.atan(robot.friction)) < lean < limits[0] - 10
    x = np.zeros(8)
    x[2] = math.radians(lean - 1)
    assert find_optimum(task, robot, x, np.zeros(0)).cost > 0


@pytest.fixture
def bounds():
    """37° either way at every value: the states at 37.5° are in doubt."""
    values = np.array([-15.0, 0.0, 15.0])
    right = np.column_stack([np.full(3, 37.0), values])
    return {name: np.concatenate([right, -right]) for name in basins.AXES}


POINTS = 5


@pytest.fixture
def maps_of_lqr(bounds, monkeypatch, tmp_path):
    """The maps of LQR, which recovers from some states (axis, value, lean in degrees), and the groups that were run."""
    monkeypatch.setattr(basins.jobs, "run", lambda *_: [[{"boundary": each.tolist()}] for each in bounds.values()])

    def maps(recovered):
        ran = []

        def measure(run, groups, *_):
            ran.extend(groups)
            for group in groups:
                axis = group.labels["axis"]
                for k, x in enumerate(group.starts):
                    state = (axis, x[basins.AXES[axis].component], round(math.degrees(x[2]), 9))
                    yield certified_result(controller="lqr", episode=k, success=state in recovered, labels=group.labels)

        monkeypatch.setattr(basins.MeasuredRun, "measure", measure)
        return basins.Basins.run(["lqr"], POINTS, "rk4", tmp_path, 1), ran

    return maps


def test_only_states_that_may_be_recoverable_are_run_and_only_half_of_them(maps_of_lqr):
    _, (group, _) = maps_of_lqr(set())
    states = {(speed, round(math.degrees(lean), 9)) for lean, speed in group.starts[:, [2, 4]].tolist()}
    assert states == {(speed, lean) for speed in (0.0, 7.5, 15.0) for lean in (-37.5, 0.0, 37.5)}


def test_a_state_from_which_a_controller_recovers_is_recoverable(maps_of_lqr):
    found, _ = maps_of_lqr({("speed", 0.0, 0.0), ("speed", 7.5, 37.5)})
    basin, _ = found.maps
    assert basin.recovered["lqr"].sum() == 3
    assert basin.recovered["lqr"][3, 3]
    assert basin.recovered["lqr"][1, 1]  # the same, turned by 180°
    assert basin.recoverable.sum() == 5 + 2
    assert basin.fraction("lqr") == pytest.approx(3 / 7)


@pytest.mark.parametrize("robot", ROBOTS)
def test_lqr_recovers_upright_and_slow_but_not_fast(robot, bounds, tmp_path, monkeypatch):
    monkeypatch.setattr(basins, "AXES", {"speed": basins.AXES["speed"]})
    run, boundaries = basins.jobs.run, [[[{"boundary": bounds["speed"].tolist()}]]]
    monkeypatch.setattr(basins.jobs, "run", lambda *made: boundaries.pop() if boundaries else run(*made))
    (basin,) = basins.Basins.run(["lqr"], 3, "rk4", tmp_path, 1, robot).maps
    assert basin.recovered["lqr"][:, 1].tolist() == [False, True, False]  # −15, 0 and 15 m/s


def test_maps_are_written_and_drawn(maps_of_lqr, tmp_path):
    found, _ = maps_of_lqr({("speed", 0.0, 0.0), ("lean rate", 0.0, -37.5)})
    found.write({"commit": "none", "robot": "rolling"}, tmp_path)
    written = json.loads((tmp_path / "basins.json").read_text())
    assert written["rows"][0]["recovered"] == pytest.approx(3 / (5 + 7))
    assert [entry["recovered"] for entry in written["maps"]] == [
        {"lqr": basin.recovered["lqr"].astype(int).tolist()} for basin in found.maps
    ]
    assert len((tmp_path / "basins.csv").read_text().splitlines()) == 1 + 2 * 25
    assert figures.save(figures.basin_figure(found), tmp_path / "basins.png").exists()


def test_the_command_maps_what_is_recoverable(tmp_path, typed, monkeypatch):
    monkeypatch.setattr(
        "ballbot_baselines.optimum.recovery.largest_leans", lambda *problem: np.full(31, math.radians(40))
    )
    ended, printed = typed("basins", "--controllers", "lqr", "--points", 3, "--physics", "rk4", "--workers", 1)
    assert (ended, "Share of the recoverable states, 3 × 3 a map" in printed) == (0, True), printed
    assert {path.name for path in (tmp_path / "runs" / "basins").iterdir()} == {
        "basins.csv",
        "basins.json",
        "basins.png",
    }
