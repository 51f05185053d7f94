"""The second guess of the optimizer, and plans that are feasible and not optimal."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("casadi")

from ballbot_baselines import LqrController, NmpcController, TrajoptController, find_optimum
from ballbot_baselines.optimum import certification
from ballbot_baselines.solvers import righting
from ballbot_baselines.solvers.ocp import FEASIBLE, OcpSolver
from ballbot_gym import dynamics
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks.stabilize import Stabilize

NO_CONSTANTS = np.zeros(0)


def leaning(degrees, **others):
    x = np.zeros(8)
    x[2] = math.radians(degrees)
    for name, value in others.items():
        x[{"speed": 4, "lean_rate": 6}[name]] = value
    return x


@pytest.fixture(scope="module")
def steep(params):
    """The optimum from 60° of lean, to which the guessed path does not lead."""
    return find_optimum(Stabilize(), params, [0, 0, math.radians(60), 0, 0, 0, 0, 0], [])


def test_leaning_by_60_degrees_is_recovered_at_less_than_the_cost_of_staying_in_the_plane(steep):
    assert steep.is_optimal
    assert steep.cost == pytest.approx(78.088156, rel=1e-6)
    # 99.31 is the stationary episode in the plane of the fall: a saddle point
    assert steep.cost < 99.31
    assert np.abs(steep.trajectory.x[:, 1]).max() > 1.0


def test_trajopt_and_nmpc_recover_from_60_degrees_where_lqr_falls(make_env, params):
    env = make_env(physics="rk4")
    start = {"state": leaning(60)}
    assert rollout(env, LqrController(env.task, params), options=start).failure
    for controller in (TrajoptController(env.task, params), NmpcController(env.task, params)):
        assert rollout(env, controller, options=start).success


def test_members_obey_the_dynamics_the_force_limit_and_the_margins(params):
    task, x0 = Stabilize(duration=2.0), leaning(45, speed=6.0)
    members = righting.righted(task, params, x0, NO_CONSTANTS, params.force_limit)
    assert {member.side for member in members} == {-1, 0, 1}
    for member in members:
        np.testing.assert_array_equal(member.x[0], x0)
        after = dynamics.step(params, member.x[:-1], member.u, task.control_dt)
        np.testing.assert_allclose(after, member.x[1:], atol=1e-12)
        assert np.abs(member.u).max() <= params.force_limit
        assert dynamics.tilt(member.x).max() <= task.max_tilt
        assert np.abs(member.x[member.righted, 2:4]).max() < math.radians(10)


def test_no_member_rights_what_the_whole_force_cannot(params):
    task = Stabilize(duration=1.0)
    assert righting.righted(task, params, leaning(75, lean_rate=3.0), NO_CONSTANTS, params.force_limit) == []


@pytest.fixture
def altered(monkeypatch):
    """Has every solver fail, with given fields of its solutions."""
    solve = OcpSolver.solve

    def alter(**change):
        monkeypatch.setattr(OcpSolver, "solve", lambda *args: replace(solve(*args), success=False, **change))

    return alter


@pytest.fixture
def unconverged(altered):
    """No solver meets its tolerance, although all find the optimum."""
    altered(status="stopped")


def test_feasible_episode_without_an_optimum_is_returned_and_says_so(unconverged, params):
    found = find_optimum(Stabilize(), params, leaning(10), NO_CONSTANTS)
    assert found.status == "feasible"
    assert not found.is_optimal
    assert found.solver_status == "stopped"
    assert found.violation < FEASIBLE


def test_feasible_episode_gets_no_certificate(unconverged):
    ((_, error),) = certification.entries("stabilize", [0])
    assert "only a feasible episode" in error


def test_simulated_recovery_is_a_plan_where_no_solver_finds_one(altered, make_env, params):
    altered(status="lost", violation=1.0)
    env = make_env(physics="rk4")
    controller = TrajoptController(env.task, params)
    run = rollout(env, controller, options={"state": leaning(30)})
    assert controller.plan.solver == "simulation"
    assert run.cost == pytest.approx(controller.plan.cost, rel=1e-6)
    with pytest.raises(PlanError):
        TrajoptController(Stabilize(duration=1.0), params).reset(0.0, leaning(75, lean_rate=5.0), NO_CONSTANTS)
