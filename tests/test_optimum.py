import contextlib
import signal

import numpy as np
import pytest

pytest.importorskip("casadi")

import casadi

from ballbot_baselines import Backoff, LqrController, find_optimum, plan_to_track
from ballbot_baselines.optimum import find as optimum_module
from ballbot_baselines.solvers.ocp import FEASIBLE, Ocp, OcpSolver
from ballbot_baselines.solvers.shooting import Shooting
from ballbot_gym.robot import default_params
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks.orbit import Orbit
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.weave import Weave


def episode(task, seed=3):
    return task.sample(np.random.default_rng(seed), default_params())


@pytest.fixture(scope="module")
def optimum_of():
    """The optimum of each episode is found once."""
    optima = {}

    def find(task):
        if task not in optima:
            optima[task] = find_optimum(task, default_params(), *episode(task))
        return optima[task]

    return find


def test_a_plan_is_an_episode_of_its_cost_that_obeys_the_limits_and_ends_at_the_goal(task, optimum_of, params):
    optimum, (x0, c) = optimum_of(task), episode(task)
    trajectory = optimum.trajectory
    after = params.step(trajectory.x[:-1], trajectory.u, task.control_dt)
    np.testing.assert_allclose(after, trajectory.x[1:], atol=1e-6)
    np.testing.assert_array_equal(trajectory.x[0], x0)
    np.testing.assert_allclose(np.diff(trajectory.t), task.control_dt, rtol=1e-9)
    cost = task.cost(trajectory.x[:-1], trajectory.u, c).sum() * task.control_dt
    assert optimum.cost == pytest.approx(cost, rel=1e-9)
    assert np.abs(trajectory.u).max() <= params.force_limit
    assert min(np.min(margin) for margin in task.margins(trajectory.x, c)) >= 0
    reached = [task.is_goal(tuple(x), tuple(c)) for x in trajectory.x]
    assert reached[-1]
    if task.first_exit:
        assert not any(reached[:-1])  # else it would have ended, and cost less, before
        assert len(trajectory.u) <= task.steps
    else:
        assert len(trajectory.u) == task.steps


def test_optimum_says_how_it_was_found(task, optimum_of):
    optimum = optimum_of(task)
    assert optimum.status == "optimal"
    assert optimum.solver_status == "Solve_Succeeded"
    assert optimum.violation < FEASIBLE
    assert optimum.solver in ("fatrop", "ipopt")
    assert optimum.iterations > 0


def test_optimum_costs_no_more_than_lqr_and_less_than_a_fall(task, optimum_of, make_env, params):
    x0, c = episode(task)
    lqr = rollout(make_env(task, physics="rk4"), LqrController(task, params), options={"state": x0, "constants": c})
    assert optimum_of(task).cost <= lqr.cost * (1 + 1e-6)
    assert optimum_of(task).cost < task.survival_pay


def test_small_changes_of_the_forces_gain_nothing(optimum_of, params, rng):
    # first-order optimality, checked by simulation: 0.5 s only, because the plant is unstable
    task = Stabilize(duration=0.5)
    x0 = episode(task, 3)[0]
    optimum = optimum_of(task)
    assert simulated_cost(task, params, x0, optimum.trajectory.u) == pytest.approx(optimum.cost, rel=1e-9)
    for _ in range(20):
        u = optimum.trajectory.u + rng.normal(size=optimum.trajectory.u.shape)
        assert simulated_cost(task, params, x0, u) > optimum.cost


def simulated_cost(task, params, x, forces):
    cost = 0.0
    for u in forces:
        cost += task.cost(x, u, ()) * task.control_dt
        x = params.step(x, u, task.control_dt)
    return cost


def test_backoff_keeps_its_distances_and_costs_more(params):
    task = Weave()
    x0, c = episode(task, 3)
    kept = find_optimum(task, params, x0, c, Backoff(margin=0.03, goal=0.5, force=0.05), guesses=1)
    tight = find_optimum(task, params, x0, c, guesses=1)
    assert np.abs(kept.trajectory.u).max() <= 0.95 * params.force_limit + 1e-6
    assert min(np.min(margin) for margin in task.margins(kept.trajectory.x, c)) >= 0.03 - 1e-6
    assert kept.cost > tight.cost


def test_hopeless_start_raises_with_every_solvers_status_and_violation(params):
    # 74° of tilt, and falling at 5 rad/s: no 350 N catch that
    task = Stabilize(duration=1.0)
    x0 = np.array([0.0, 0.0, 1.3, 0.0, 0.0, 0.0, 5.0, 0.0])
    assert not task.violated(tuple(x0), ())
    with pytest.raises(PlanError) as error:
        find_optimum(task, params, x0, np.zeros(0))
    message = str(error.value)
    assert "BallbotStabilize-v0: no feasible episode from x = [0.0, 0.0, 1.3" in message
    for solver in ("fatrop", "ipopt"):
        part = message[message.index(f"{solver}: ") :]
        assert float(part[part.index("violation ") + 10 :].split(";")[0].rstrip(")")) > FEASIBLE


@pytest.mark.slow
def test_an_episode_where_fatrop_goes_in_circles_has_an_optimum_nevertheless(params):
    x0 = np.array([0.25444759690884416, 1.0531376213391865, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = find_optimum(Orbit(), params, x0, np.array([1.0834400902000283, 3.9722615268345076]))
    assert found.is_optimal
    assert found.cost == pytest.approx(19.5707702, rel=1e-6)  # that of other guessed paths too


N = 8


def toy():
    """Nonlinear, with path and final constraints of both kinds, a parameter, and an initial state with linked parts."""
    return Ocp(
        name="toy",
        states=3,
        inputs=2,
        params=1,
        next=lambda s, w, p: (
            s + 0.2 * casadi.vertcat(s[1], casadi.sin(s[2]) + w[0], w[1] * casadi.cos(s[0]) - p * s[1])
        ),
        cost=lambda s, w, p: s[0] ** 2 + 0.1 * s[1] ** 4 + casadi.exp(0.3 * s[2]) + 0.05 * (w[0] ** 2 + w[1] ** 2),
        equalities=lambda s, w, p: w[0] + 0.3 * w[1] - 0.1 * s[1] * w[1],
        inequalities=lambda s, w, p: casadi.vertcat(0.3 - s[0] ** 2 - 0.1 * w[1] ** 2, 0.3 + w[0] * s[2]),
        final_cost=lambda s, p: 3 * s[0] ** 2 + p * casadi.cos(s[1]),
        final_equalities=lambda s, p: s[2] ** 2 + s[2] - 0.2,
        final_inequalities=lambda s, p: s[1] + 0.6,
        initial_matrix=np.array([[1.0, 0.0, -2.0]]),
    )


def toy_bounds(ocp):
    lower, upper = ocp.no_bounds(N)
    lower[0, 1] = upper[0, 1] = -0.3
    lower[0, 0] = 0.4
    lower[:, 3:], upper[:, 3:] = -2, 1.5
    return lower, upper


def solve_toy(solver, p=0.4):
    ocp = toy()
    return OcpSolver(ocp, N, solver).solve(np.full((N + 1, 3), 0.1), np.full((N, 2), 0.1), *toy_bounds(ocp), [p])


def solve_toy_by_casadi(p=0.4):
    """The same problem written out in one piece and differentiated by CasADi: cost, states, inputs, iterations."""
    ocp, (lower, upper) = toy(), toy_bounds(toy())
    s, w = casadi.SX.sym("s", 3, N + 1), casadi.SX.sym("w", 2, N)
    columns = [(s[:, k], w[:, k], p) for k in range(N)]
    equal = [casadi.mtimes(casadi.DM(ocp.initial_matrix), s[:, 0]), ocp.final_equalities(s[:, N], p)]
    equal += [s[:, k + 1] - ocp.next(*columns[k]) for k in range(N)] + [ocp.equalities(*column) for column in columns]
    unequal = [ocp.inequalities(*column) for column in columns] + [ocp.final_inequalities(s[:, N], p)]
    equal, unequal = casadi.vertcat(*equal), casadi.vertcat(*unequal)
    cost = sum(ocp.cost(*column) for column in columns) + ocp.final_cost(s[:, N], p)
    z = casadi.vertcat(casadi.vec(s), casadi.vec(w))
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8}}
    solver = casadi.nlpsol("plain", "ipopt", {"x": z, "f": cost, "g": casadi.vertcat(equal, unequal)}, options)
    result = solver(
        x0=0.1,
        lbx=np.concatenate([lower[:, :3].ravel(), lower[:-1, 3:].ravel()]),
        ubx=np.concatenate([upper[:, :3].ravel(), upper[:-1, 3:].ravel()]),
        lbg=0,
        ubg=np.concatenate([np.zeros(equal.shape[0]), np.full(unequal.shape[0], np.inf)]),
    )
    values = np.array(result["x"]).ravel()
    states, inputs = values[: 3 * (N + 1)].reshape(N + 1, 3), values[3 * (N + 1) :].reshape(N, 2)
    assert solver.stats()["success"]
    return float(result["f"]), states, inputs, solver.stats()["iter_count"]


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
@pytest.mark.parametrize("p", [0.4, -1.0])
def test_staged_problem_has_the_solution_of_the_problem_written_out(solver, p):
    cost, states, inputs, _ = solve_toy_by_casadi(p)
    staged = solve_toy(solver, p)
    assert staged.is_optimal
    assert staged.cost == pytest.approx(cost, rel=1e-7)
    np.testing.assert_allclose(staged.states, states, atol=1e-4)
    np.testing.assert_allclose(staged.inputs, inputs, atol=1e-4)


def test_staged_derivatives_are_exact_to_second_order():
    # a wrong gradient or Jacobian misses the solution; a wrong Hessian takes more iterations to it
    *_, iterations = solve_toy_by_casadi()
    assert solve_toy("ipopt").iterations == iterations


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_infeasible_bounds_are_reported_not_hidden(solver):
    ocp = toy()
    lower, upper = toy_bounds(ocp)
    lower[3:, 0] = 2.0  # where 0.3 − s₀² ≥ 0 cannot hold
    given = np.zeros((N + 1, 3)), np.zeros((N, 2)), lower, upper, [0.4]
    solution = OcpSolver(ocp, N, solver, max_iterations=50).solve(*given)
    assert not solution.success
    assert solution.violation > 1e-3
    assert solution.status


def test_a_plan_to_track_leaves_no_force_in_reserve_where_that_is_all_there_is(params, monkeypatch):
    x0 = np.zeros(8)
    x0[2], x0[4] = np.radians(-67.5), 12.0  # all but the whole force is too little
    reserve = Backoff(goal=0.1, force=0.02)
    failed = []

    def find(*arguments, **keywords):
        if arguments[-1] == reserve:  # to find that out takes the solvers seconds
            failed.append(reserve)
            raise PlanError("no feasible episode")
        return find_optimum(*arguments, **keywords)

    monkeypatch.setattr(optimum_module, "find_optimum", find)
    assert plan_to_track(Stabilize(), params, x0, [], reserve).is_optimal
    assert failed == [reserve]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_within_a_solver_is_not_lost(number, monkeypatch):
    """CasADi prints a KeyboardInterrupt and goes on."""
    from ballbot_baselines.solvers import ocp

    def interrupted(number, frame):
        raise KeyboardInterrupt

    def swallowing(*given, **named):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        return {}

    before = signal.signal(number, interrupted)
    try:
        with pytest.raises(KeyboardInterrupt), ocp._interrupts_kept():
            swallowing()
        assert signal.getsignal(number) is interrupted
    finally:
        signal.signal(number, before)


def test_a_motion_starts_where_the_episode_does_wherever_its_guess_starts(params):
    task = Stabilize(duration=2.0)
    x0 = np.array([0.5, 0, 0, 0, 0, 0, 0, 0])
    episode = Shooting(task, params, x0, np.zeros(0), Backoff())
    solution = episode.solve(np.zeros((task.steps + 1, 8)), np.zeros((task.steps, 2)))
    assert solution.is_optimal
    np.testing.assert_allclose(solution.states[0], x0, atol=1e-9)
