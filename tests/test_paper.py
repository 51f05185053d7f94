from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("casadi")

from ballbot_baselines.paper import problems
from ballbot_baselines.paper.collocation import collocation_error
from ballbot_baselines.paper.problems import PAPER_PROBLEMS, between_states
from ballbot_baselines.solvers import guess as guesses
from ballbot_gym.rollout import PlanError
from ballbot_gym.trajectory import Trajectory

pytestmark = pytest.mark.usefixtures("interpreted")  # each problem is solved a few times, in a tenth of a second

SOLVERS = ("ipopt", "fatrop")

# J*, final time in s and peak |lean| in degrees, from two independent programs that agree to every digit
REFERENCE = {
    "stabilize-1": (106.3652, 1.684, 14.37),
    "stabilize-5": (239.2439, 2.870, 44.80),
    "turn-3": (177.6493, 1.843, 29.84),
    "turn-10": (612.924, 7.406, 57.30),
    "orbit-4": (161.306, 1.669, 40.06),
}


@pytest.fixture(scope="module")
def plan_of(params):
    """Each problem is solved once by each solver."""
    plans = {}

    def plan(name, solver="ipopt"):
        if (name, solver) not in plans:
            plans[name, solver] = PAPER_PROBLEMS[name].solve(params, solver)
        return plans[name, solver]

    return plan


def peak_lean(trajectory):
    return np.degrees(np.abs(trajectory.x[:, 2:4]).max())


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", REFERENCE)
def test_reference_optimum_is_reproduced(plan_of, name, solver):
    cost, seconds, lean = REFERENCE[name]
    plan = plan_of(name, solver)
    assert plan.cost == pytest.approx(cost, rel=1e-4)
    assert plan.trajectory.duration == pytest.approx(seconds, abs=6e-4)  # as many digits as are known
    assert peak_lean(plan.trajectory) == pytest.approx(lean, abs=6e-3)
    assert plan.solver == solver
    assert plan.solver_status == "Solve_Succeeded"


def test_fast_turn_runs_at_the_force_and_lean_limits(plan_of, params):
    trajectory = plan_of("turn-10").trajectory
    assert np.abs(trajectory.u).max() == pytest.approx(params.force_limit, rel=1e-6)
    assert np.abs(trajectory.x[:, 2:4]).max() == pytest.approx(1.0, rel=1e-6)


def test_orbit_at_4_metres_per_second_is_a_circle_of_1063_mm_at_40_degrees(plan_of):
    plan = plan_of("orbit-4")
    x = plan.trajectory.x
    assert np.hypot(*x[0, :2]) == pytest.approx(1.063, abs=5e-4)
    np.testing.assert_allclose(np.hypot(x[:, 0], x[:, 1]), 1.0627, atol=1e-4)
    np.testing.assert_allclose(np.hypot(x[:, 4], x[:, 5]), 4.0, atol=1e-6)
    tilt = np.degrees(plan.trajectory.tilt)
    assert tilt.mean() == pytest.approx(40, abs=0.5)
    assert np.ptp(tilt) < 0.1  # measured: 0.04°, from the axial inertia
    np.testing.assert_allclose(x[-1], x[0], atol=1e-6)


def test_some_orbit_leans_almost_45_degrees(plan_of):
    orbits = [name for name in PAPER_PROBLEMS if name.startswith("orbit-")]
    assert any(44 < np.degrees(plan_of(name).trajectory.tilt).max() < 46 for name in orbits)


def test_weave_keeps_its_distances_and_passes_both_sides(plan_of):
    problem, x = PAPER_PROBLEMS["weave"], plan_of("weave").trajectory.x
    assert len(problem.obstacles) >= 3
    sides = set()
    for ox, oy, distance in problem.obstacles:
        gap = np.hypot(x[:, 0] - ox, x[:, 1] - oy)
        assert gap.min() >= distance - 1e-6
        sides.add(np.sign(x[gap.argmin(), 1] - oy))
    assert sides == {-1, 1}


def test_plans_obey_their_boundary_values_and_limits(plan_of, params):
    for name, entry in PAPER_PROBLEMS.items():
        plan, problem = plan_of(name), entry.problem
        x, u = plan.trajectory.x, plan.trajectory.u
        for end, (lower, upper) in ((x[0], problem.initial), (x[-1], problem.final)):
            assert (end >= lower - 1e-7).all()
            assert (end <= upper + 1e-7).all()
        assert np.abs(u).max() <= params.force_limit * (1 + 1e-7)
        assert np.abs(x[:, 2:4]).max() <= problem.lean_limit + 1e-7
        step = plan.trajectory.t[1]
        assert problem.step[0] <= step <= problem.step[1]
        assert plan.violation < 1e-6


def test_plans_satisfy_hermite_simpson_between_knots(plan_of, params):
    for name in PAPER_PROBLEMS:
        trajectory = plan_of(name).trajectory
        x, u, h = trajectory.x, trajectory.u, np.diff(trajectory.t)[:, None]
        f = params.derivative(x, u)
        middle = 0.5 * (x[:-1] + x[1:]) + h / 8 * (f[:-1] - f[1:])
        f_middle = params.derivative(middle, 0.5 * (u[:-1] + u[1:]))
        defect = x[1:] - x[:-1] - h / 6 * (f[:-1] + 4 * f_middle + f[1:])
        assert np.abs(defect).max() < 1e-6
        times = 0.5 * (trajectory.t[1:] + trajectory.t[:-1])
        np.testing.assert_allclose([trajectory.state(t) for t in times], middle, atol=1e-12)


def test_cost_is_the_papers_sum_over_knots(plan_of):
    plan = plan_of("stabilize-5")
    x, u, seconds = plan.trajectory.x[:-1], plan.trajectory.u[:-1], plan.trajectory.duration
    knots = (x[:, :2] ** 2).sum(axis=1) + 0.1 * (x[:, 2:] ** 2).sum(axis=1) + 1e-4 * (u**2).sum(axis=1) + seconds
    assert plan.cost == pytest.approx(knots.sum(), rel=1e-9)


def test_collocation_error_shrinks_as_knots_are_added(plan_of, params):
    for name, factor in (("stabilize-1", 4), ("turn-3", 4), ("stabilize-5", 2)):
        coarse, entry = plan_of(name), PAPER_PROBLEMS[name]
        x0, x1 = entry.problem.initial[0], entry.problem.final[0]
        times = np.linspace(0, coarse.trajectory.duration, 81)
        x, u = (np.array([read(t) for t in times]) for read in (coarse.trajectory.state, coarse.trajectory.force))
        fine = between_states(name, x0, x1, intervals=80).solve(params, Trajectory(times, x, u))
        # measured: 4.8, 5 and 3.0 (where forces jump, less is gained)
        fine_error, coarse_error = (collocation_error(params, each.trajectory) for each in (fine, coarse))
        assert fine_error < coarse_error / factor


def test_collocation_error_is_zero_for_a_motion_that_is_a_cubic(params):
    t = np.linspace(0, 1, 6)
    x = np.zeros((6, 8))
    x[:, 0], x[:, 4] = 2 + 3 * t, 3.0  # upright at constant speed
    moving = Trajectory(t, x, np.zeros((6, 2)), xdot=params.derivative(x, np.zeros((6, 2))))
    assert collocation_error(params, moving) < 1e-12


def test_collocation_error_is_the_integral_of_the_residual(params):
    # at rest upright under 10 N that are not there: |0 − c·10 N| over 0.5 s
    x, u = np.zeros((3, 8)), np.tile([10.0, 0.0], (3, 1))
    pushed = Trajectory([0.0, 0.5, 1.0], x, u, xdot=np.zeros((3, 8)))
    assert collocation_error(params, pushed) == pytest.approx(0.397241 * 10 * 0.5, rel=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_problem_without_a_solution_raises_with_status_and_violation(params, solver):
    entry = PAPER_PROBLEMS["stabilize-5"]
    hurried = replace(entry.problem, name="hurried", step=(0.005, 0.01))  # 0.4 s to stop from 5 m/s
    with pytest.raises(PlanError, match=rf"hurried: {solver} found no plan: \w+.*violated by \d\.\de[+-]\d\d"):
        hurried.solve(params, entry.guess(params), solver, max_iterations=60)


@pytest.mark.parametrize("solver", SOLVERS)
def test_start_beyond_the_lean_limit_raises_a_plan_error(params, solver):
    entry = PAPER_PROBLEMS["stabilize-1"]
    x0 = entry.problem.initial[0] + [0, 0, 1.2, 0, 0, 0, 0, 0]  # the limit is 1
    leaning = replace(entry.problem, name="leaning", initial=(x0, x0))
    with pytest.raises(PlanError, match="leaning"):
        leaning.solve(params, entry.guess(params), solver)


def test_guess_along_an_accelerating_path_is_the_motion_itself(params):
    # exact for constant acceleration: a steady lean of arctan(a/g), and a force that moves both masses
    dt, a = 0.01, 3.0
    t = dt * np.arange(101)
    x, u = guesses.along_path(params, np.column_stack([0.5 * a * t**2, 0 * t]), dt)
    inside = slice(20, -20)  # differences and smoothing are one-sided at the ends
    np.testing.assert_allclose(x[inside, 2], np.arctan(a / params.gravity), rtol=1e-9)
    np.testing.assert_allclose(u[inside], np.tile([params.total_mass * a, 0], (len(u[inside]), 1)), atol=1e-8)
    residual = params.derivative(x[:-1], u)[inside] - np.gradient(x, dt, axis=0)[:-1][inside]
    assert np.abs(residual).max() < 1e-8


def test_plan_is_tracked_within_a_centimetre_in_bullet(plan_of, params):
    pytest.importorskip("pybullet")
    plan = plan_of("stabilize-1")
    executed, error = problems.PaperProblem.track(plan, params)
    assert error < 0.01  # measured: 1 mm
    assert executed.duration == pytest.approx(plan.trajectory.duration, abs=problems.TRACKING_DT)


def test_lqr_and_trajectory_optimization_start_where_the_papers_problem_starts():
    pytest.importorskip("pybullet")
    entry = PAPER_PROBLEMS["stabilize-1"]
    episodes = entry.compare()
    steps = {name: np.diff(episode.trajectory.t) for name, episode in episodes.items()}
    assert {name: round(1 / step.mean()) for name, step in steps.items()} == {"lqr": 1000, "trajopt": 50}
    for episode in episodes.values():
        np.testing.assert_array_equal(episode.trajectory.x[0], entry.problem.initial[0])
        assert not episode.failure
