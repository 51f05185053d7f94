import numpy as np
import pytest

pytest.importorskip("casadi")

from ballbot_baselines import LqrController, find_optimum
from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_baselines.solvers.riccati import Gains, discrete_lqr
from ballbot_gym import Reference
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks.stabilize import Stabilize

ORIGIN, NO_FORCE, NO_CONSTANTS = np.zeros(8), np.zeros(2), np.zeros(0)
HIGH_LEAN = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0])  # the paper's two stabilizations
LOW_LEAN = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


def peak_lean(trajectory):
    """Degrees, of |γ| and |θ|."""
    return np.degrees(np.abs(trajectory.x[:, 2:4]).max())


def at_origin(task, params, points=1):
    return LinearQuadratic(task, params, np.zeros((points, 8)), np.zeros((points, 2)), NO_CONSTANTS)


def step(params, x, u):
    return params.step(x, u, 0.02)


def test_weights_are_read_off_the_tasks_cost(params):
    q, r = LinearQuadratic(Stabilize(), params, HIGH_LEAN[None], NO_FORCE[None], NO_CONSTANTS).costs
    np.testing.assert_allclose(q[0], np.diag([1, 1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5]), atol=1e-12)
    np.testing.assert_allclose(r[0], 5e-4 * np.eye(2), atol=1e-15)


def test_discrete_model_is_the_continuous_ones_exponential(params):
    from scipy.linalg import expm

    z = 1e-5 * np.eye(10)
    ahead, back = (params.derivative(sign * z[:, :8], sign * z[:, 8:]) for sign in (1, -1))
    ad, bd = at_origin(Stabilize(control_dt=0.02), params).dynamics
    exact = expm(0.02 * np.block([[(ahead - back).T / 2e-5], [np.zeros((2, 10))]]))
    # RK4 over 10 ms: (7.77·0.01)⁵/120 twice is 5e-8, times rates of up to 60
    np.testing.assert_allclose(ad[0], exact[:8, :8], atol=2e-6)
    np.testing.assert_allclose(bd[0], exact[:8, 8:], atol=2e-8)


def test_step_model_along_a_trajectory_is_the_steps_derivative(params, rng):
    x, u = rng.uniform(-1, 1, (5, 8)), rng.uniform(-200, 200, (5, 2))
    a, b = LinearQuadratic(Stabilize(control_dt=0.02), params, x, u, NO_CONSTANTS).dynamics
    h = 1e-6
    for k in range(5):
        columns = [(step(params, x[k] + h * e, u[k]) - step(params, x[k] - h * e, u[k])) / (2 * h) for e in np.eye(8)]
        np.testing.assert_allclose(a[k].T, columns, atol=1e-7)
        columns = [(step(params, x[k], u[k] + e) - step(params, x[k], u[k] - e)) / 2 for e in np.eye(2)]
        np.testing.assert_allclose(b[k].T, columns, atol=1e-5)


def small_starts(rng, p, scale, count):
    """States from which LQR stays linear, with the cost that P predicts."""
    starts = rng.normal(size=(count, 8)) * scale
    return [(x, x @ p @ x) for x in starts]


def test_measured_cost_from_small_states_is_the_riccati_cost(make_env, physics, params, rng):
    """The env's convention: forces held, cost summed over control steps."""
    task = Stabilize()
    _, p = discrete_lqr(task, params, ORIGIN, NO_FORCE, NO_CONSTANTS)
    env = make_env(task, physics=physics)
    for x, predicted in small_starts(rng, p, 0.003, 8):
        episode = rollout(env, LqrController(task, params), options={"state": x})
        # measured: below 1e-4 with rk4, 1.7e-3 with Bullet's 1 ms steps
        assert episode.cost == pytest.approx(predicted, rel=5e-3)
        assert episode.success


def test_discrete_lqr_solves_its_riccati_equation_and_is_stable(params):
    task = Stabilize()
    k, p = discrete_lqr(task, params, ORIGIN, NO_FORCE, NO_CONSTANTS)
    model = at_origin(task, params)
    a, b = (m[0] for m in model.dynamics)
    q, r = (m[0] * task.control_dt for m in model.costs)
    closed = a - b @ k
    np.testing.assert_allclose(q + k.T @ r @ k + closed.T @ p @ closed, p, rtol=1e-8, atol=1e-8)
    assert np.abs(np.linalg.eigvals(closed)).max() < 1


def test_tracking_gains_along_an_equilibrium_converge_to_lqr(params):
    task = Stabilize()
    k, p = discrete_lqr(task, params, ORIGIN, NO_FORCE, NO_CONSTANTS)
    n = 1000  # 20 s; the slowest closed-loop mode decays below 1e-8 of itself
    gains = Gains.before(np.eye(8), at_origin(task, params, n))
    np.testing.assert_allclose(gains.k[0], k, rtol=1e-6)
    np.testing.assert_allclose(gains.p[0], p, rtol=1e-6, atol=1e-9)
    from_lqr = Gains.before(p, at_origin(task, params, 5))
    np.testing.assert_allclose(from_lqr.k, np.tile(k, (5, 1, 1)), rtol=1e-8)


def test_goal_weight_is_one_per_squared_tolerance(params):
    (weight,) = at_origin(Stabilize(), params).goal_weights
    tolerance = np.array([0.1, 0.1, np.radians(2), np.radians(2), 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(np.diag(weight), 1 / tolerance**2, rtol=1e-3)  # 1 − cos is quadratic to 1e-4


def test_lqr_controller_at_its_reference_applies_the_reference_force(task, params, rng):
    x, c = task.sample(rng, params)
    controller = LqrController(task, params)
    controller.reset(0.0, x, c)
    reference = task.reference(x, c, params)
    for i in (0, len(reference.x) // 2):
        force = controller.act(i * task.control_dt, reference.x[i])
        np.testing.assert_allclose(force, reference.u[i], atol=1e-6)


def test_lqr_holds_a_slow_orbit(make_env, params):
    env = make_env("orbit", physics="rk4")
    task = env.task
    episode = rollout(env, LqrController(task, params), options={"constants": {"radius": 2.5, "speed": 2.0}}, seed=0)
    assert episode.success


def test_lqr_oscillates_to_high_lean_where_the_optimum_does_not(make_env, params):
    """The paper's Fig. 3, LQR in near-continuous time as in the paper."""
    task = Stabilize(control_dt=0.001)
    lqr = rollout(make_env(task, physics="rk4"), LqrController(task, params), options={"state": HIGH_LEAN})
    optimum = find_optimum(Stabilize(), params, HIGH_LEAN, NO_CONSTANTS)
    assert 50 < peak_lean(lqr.trajectory) < 60  # measured: 55.9°
    assert 36 < peak_lean(optimum.trajectory) < 42  # measured: 39.2°
    assert lqr.cost > 3 * optimum.cost  # measured: 4.2


def test_lqr_at_low_lean_is_nearly_the_optimum(make_env, params):
    """The paper's Fig. 2."""
    task = Stabilize(control_dt=0.001)
    lqr = rollout(make_env(task, physics="rk4"), LqrController(task, params), options={"state": LOW_LEAN})
    optimum = find_optimum(Stabilize(), params, LOW_LEAN, NO_CONSTANTS)
    assert peak_lean(lqr.trajectory) == pytest.approx(peak_lean(optimum.trajectory), abs=0.5)  # 9.75° and 9.57°
    assert lqr.cost == pytest.approx(optimum.cost, rel=0.02)


def test_equilibrium_gain_gives_lqrs_force_and_cost_from_the_observation(params):
    task = Stabilize()
    k, p = discrete_lqr(task, params, ORIGIN, NO_FORCE, NO_CONSTANTS)
    action_gain, weight = equilibrium_gain(task, params)
    x = 0.01 * np.arange(1.0, 9.0)
    observation = np.asarray(task.observe(x, NO_CONSTANTS))[:8]
    np.testing.assert_allclose(params.force_limit * action_gain @ observation, -k @ x, rtol=1e-12)
    assert observation @ weight @ observation == pytest.approx(x @ p @ x, rel=1e-12)


class LaneChange(Stabilize):
    """Ends in another lane, at speed: a reference that moves is a motion, and no point."""

    def reference(self, x, c, params):
        lane = np.zeros((1, 8))
        lane[0, 1], lane[0, 4] = 1.0, 3.0
        return Reference(lane, np.zeros((1, 2)))


def test_lqr_about_a_single_point_that_moves_is_refused_with_what_a_reference_is(params):
    with pytest.raises(
        PlanError,
        match=r"LQR can only hold a robot at rest\. Let LaneChange\.reference return a motion, with one point per",
    ):
        LqrController(LaneChange(), params).reset(0.0, np.zeros(8), np.zeros(0))
