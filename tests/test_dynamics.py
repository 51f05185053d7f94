import math

import numpy as np
import pytest

from ballbot_gym.robot import RK4_STEP, URDF_PATH, cos_tilt, tilt

START = (0.1, -0.2, 0.6, -0.5, 1.0, -2.0, 1.5, 2.0)  # high lean, all rates at work
FORCE = (60.0, -40.0)
GENTLE = (0.0, 0.0, 0.2, -0.1, 1.0, -2.0, 0.5, 0.3)  # falls freely to γ = 1.7 rad in half a second


def random_points(count, max_tilt, seed=0):
    """States (count, 8) up to max_tilt, rad, and forces (count, 2) up to the limit."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (4 * count, 8)) * [2, 2, max_tilt, max_tilt, 5, 5, 5, 5]
    x = x[np.cos(x[:, 2]) * np.cos(x[:, 3]) > math.cos(max_tilt)][:count]
    assert len(x) == count
    return x, rng.uniform(-350, 350, (count, 2))


def integrate(params, x, u, seconds, h):
    return np.array(params.step(x, u, seconds, round(seconds / h)))


def test_linearization_at_origin_is_the_papers(params):
    z = 1e-5 * np.eye(10)
    ahead, back = (params.derivative(sign * z[:, :8], sign * z[:, 8:]) for sign in (1, -1))
    a, b = np.split((ahead - back).T / 2e-5, [8], axis=1)
    # the paper's (5) and (6), printed to three decimals; its c is the first digits of 0.29517
    expected_a, expected_b = np.zeros((8, 8)), np.zeros((8, 2))
    expected_a[:4, 4:] = np.eye(4)
    expected_a[4, 2] = expected_a[5, 3] = -35.072
    expected_a[6, 2] = expected_a[7, 3] = 60.403
    expected_b[4, 0] = expected_b[5, 1] = 0.295
    expected_b[6, 0] = expected_b[7, 1] = -0.397
    np.testing.assert_array_equal(np.round(a, 3), expected_a)
    np.testing.assert_array_equal(np.round(b, 3), expected_b)


def test_upright_at_rest_is_an_equilibrium(params):
    assert params.derivative((0.0,) * 8, (0.0, 0.0)) == (0.0,) * 8


def test_floats_numpy_casadi_and_torch_give_the_same_derivative(params):
    casadi, torch = pytest.importorskip("casadi"), pytest.importorskip("torch")
    x, u = random_points(200, math.radians(75))
    batch = params.derivative(x, u)
    floats = [params.derivative(tuple(a), tuple(b)) for a, b in zip(x.tolist(), u.tolist(), strict=True)]
    tensors = params.derivative(torch.from_numpy(x), torch.from_numpy(u))
    sx, su = casadi.SX.sym("x", 8), casadi.SX.sym("u", 2)
    symbolic = casadi.Function("f", [sx, su], [params.derivative(sx, su)])
    # the libraries' sines differ in the last bit, and the mass matrix's condition at 75° (below 1e3) magnifies it
    rounding = {"rtol": 1e-12, "atol": 1e-10}
    np.testing.assert_allclose(floats, batch, **rounding)
    np.testing.assert_allclose(tensors.numpy(), batch, **rounding)
    np.testing.assert_allclose(np.array(symbolic(x.T, u.T)).T, batch, **rounding)


def test_batches_of_any_shape_and_tuples_of_arrays_give_the_same_step(params):
    x, u = random_points(6, math.radians(60))
    flat = params.step(x, u, 0.02)
    shaped = params.step(x.reshape(2, 3, 8), u.reshape(2, 3, 2), 0.02)
    columns = params.step(tuple(x.T), tuple(u.T), 0.02)
    np.testing.assert_array_equal(shaped.reshape(6, 8), flat)
    np.testing.assert_array_equal(np.stack(columns, axis=1), flat)


def test_closed_form_is_drakes(params):
    """Runs where drake is installed; needs no other extra: `pytest tests/test_dynamics.py -k drake`."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(URDF_PATH))
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -params.gravity])
    plant.Finalize()
    context = plant.CreateDefaultContext()
    x, u = random_points(1000, math.radians(75))
    ours = np.stack(params.accelerations(x, u), axis=1)
    worst = 0.0
    for state, force, mine in zip(x, u, ours, strict=True):
        plant.SetPositionsAndVelocities(context, state)
        plant.get_actuation_input_port().FixValue(context, force)
        drakes = plant.get_generalized_acceleration_output_port().Eval(context)
        worst = max(worst, np.abs(mine - drakes).max() / np.abs(drakes).max())
    assert worst < 1e-12  # measured: 4e-15


def test_energy_rate_is_the_power_of_the_force(params):
    # dE/dt = F·v; central differences over h leave h²: measured 9e-4 W at 1e-4 s and 9e-6 W here, of up to 2,600 W
    x, u = random_points(100, math.radians(70))
    h = 1e-5
    before, after = params.step(x, u, -h, 1), params.step(x, u, h, 1)
    rate = (params.energy(after) - params.energy(before)) / (2 * h)
    np.testing.assert_allclose(rate, (u * x[:, 4:6]).sum(axis=1), atol=1e-4)


def test_rk4_conserves_energy_to_its_order(params):
    # fourth order: halving the step divides the drift by 16 in the limit; measured 15.0 and 15.5
    drift = [
        abs(params.energy(integrate(params, GENTLE, (0.0, 0.0), 0.5, h)) - params.energy(GENTLE))
        for h in (0.02, 0.01, 0.005)
    ]
    assert drift[0] / drift[1] > 14
    assert drift[1] / drift[2] > 14
    assert drift[1] < 1e-6 * params.energy(GENTLE)  # at RK4_STEP; measured 1e-7


def test_rk4_step_is_as_accurate_as_documented(params):
    exact = integrate(params, START, FORCE, 0.3, 1e-4)  # (10 ms/0.1 ms)⁴ = 1e8 times more accurate
    error = {h: np.abs(integrate(params, START, FORCE, 0.3, h) - exact).max() for h in (0.02, RK4_STEP)}
    assert error[RK4_STEP] < 1e-6  # measured: 8.1e-7
    assert error[0.02] / error[RK4_STEP] == pytest.approx(16, rel=0.2)


def test_tilt_of_floats_arrays_and_tensors_is_the_same_angle(rng):
    torch = pytest.importorskip("torch")
    x = rng.uniform(-3, 3, (20, 8))
    expected = [tilt(tuple(row)) for row in x.tolist()]
    np.testing.assert_allclose(tilt(x), expected, rtol=1e-14)
    np.testing.assert_allclose(tilt(torch.as_tensor(x)), expected, rtol=1e-14)
    np.testing.assert_allclose(np.cos(expected), cos_tilt(x), atol=1e-15)
