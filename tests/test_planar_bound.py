"""The proven lower bound of planar Stabilize: its arithmetic is right, and bounds that claim too much are refused."""

import ctypes
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ballbot_gym.env import make_task
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_gym.robot import named_robot

pytest.importorskip("casadi")

from ballbot_baselines import PlanarBound, find_optima, find_optimum, regret
from ballbot_baselines.proofs.planar_bound import _Box, _check_numbers, _code, _problem, check_parts

TERMS, VARIABLES, DIGITS = 126, 5, 50


@pytest.fixture(scope="module")
def certificate() -> PlanarBound:
    try:
        _code()
    except NoMachineCodeError:
        pytest.skip("no C compiler")
    return PlanarBound.stored()


@dataclass
class Look:
    """A box and its three models: (mid, half) of each variable, the coefficients with what is dropped last, and exponents."""

    mid: np.ndarray
    half: np.ndarray
    models: np.ndarray
    powers: np.ndarray

    FACE = 2

    @classmethod
    def at(cls, certificate: PlanarBound, half: float) -> "Look":
        code = _code()
        code.prepare(ctypes.addressof(problem := _problem(certificate)))
        assert problem.rho == certificate.rho
        mid = np.append(0.5, np.random.default_rng(1).uniform(-0.7, 0.7, 4)) * (1, 1, 1, 1, 200)
        halves = half * np.array([0.5, 1, 1, 1, 300])
        out = np.zeros(3 * (TERMS + 1) + VARIABLES * TERMS)
        box = _Box((ctypes.c_double * 5)(*mid), (ctypes.c_double * 5)(*halves), cls.FACE, 0)
        code.look(ctypes.addressof(box), out.ctypes.data)
        models, powers = out[: 3 * (TERMS + 1)].reshape(3, -1), out[3 * (TERMS + 1) :].reshape(TERMS, VARIABLES)
        return cls(mid, halves, models, powers.astype(int))


@pytest.mark.parametrize("half", [0.2, 0.05, 0.01, 0.0])
def test_models_of_a_box_hold_the_environments_step_in_50_digits(certificate: PlanarBound, half: float) -> None:
    """The equations are the robot's own, in mpmath, so nothing is shared with the C code but V's coefficients."""
    mpmath, rng = pytest.importorskip("mpmath"), np.random.default_rng(2)
    task, robot, look = make_task("stabilize"), named_robot("paper"), Look.at(certificate, half)
    t = np.array(certificate.t)
    with mpmath.workdps(DIGITS):

        def v(x: list):
            z = mpmath.lu_solve(mpmath.matrix(t.tolist()), mpmath.matrix(x))
            pairs = zip(certificate.coefficients, certificate.exponents, strict=True)
            return mpmath.fsum(mpmath.mpf(c) * mpmath.fprod(z[i] ** e[i] for i in range(4)) for c, e in pairs)

        for _ in range(10):
            xi = [mpmath.mpf(float(each)) for each in rng.uniform(-1, 1, 5)]
            sigma, *y, w = (
                mpmath.mpf(float(m)) + mpmath.mpf(float(h)) * each
                for m, h, each in zip(look.mid, look.half, xi, strict=True)
            )
            y.insert(look.FACE, mpmath.mpf(1))
            s = mpmath.sqrt(sigma)
            x = [s * mpmath.fsum(mpmath.mpf(float(t[i, j])) * y[j] for j in range(4)) for i in range(4)]
            u = s * (mpmath.fsum(mpmath.mpf(g) * each for g, each in zip(certificate.gain, y, strict=True)) + w)
            zero = mpmath.mpf(0)
            state = tuple(itertools.chain(*((each, zero) for each in x)))
            after = robot.step(state, (u, zero), task.control_dt)
            assert after[1::2] == (0, 0, 0, 0)  # the motion stays in its plane
            cost = task.cost(state, (u, zero), ())
            exact = ((v(list(after[::2])) - v(x)) / task.control_dt / sigma, cost / sigma, v(x) / sigma)
            for number, model in zip(exact, look.models, strict=True):
                terms = (
                    mpmath.mpf(float(c)) * mpmath.fprod(a ** int(p) for a, p in zip(xi, row, strict=True))
                    for c, row in zip(model, look.powers, strict=False)
                )
                assert abs(number - mpmath.fsum(terms)) <= model[-1]


def test_what_a_model_drops_is_of_the_fifth_order(certificate: PlanarBound) -> None:
    dropped = np.array([Look.at(certificate, half).models[0, -1] for half in (0.02, 0.01, 0.005, 0.0)])
    assert np.all(np.abs(dropped[:2] / dropped[1:3] / 2**5 - 1) < 0.2)
    assert dropped[3] < 1e-4 * dropped[2]  # rounding alone


def test_some_boxes_of_the_stored_bound_are_proven(certificate: PlanarBound) -> None:
    steps = list(check_parts(certificate, roots=slice(-8, None), workers=1))
    assert all(proven for _, _, proven in steps)
    assert steps[-1][0] == 1


@pytest.mark.slow
def test_the_stored_bound_is_proven(certificate: PlanarBound) -> None:
    assert all(proven for _, _, proven in check_parts(certificate))


@pytest.mark.parametrize("factor", [1.04, 1.2])
def test_a_bound_that_claims_too_much_is_refused(certificate: PlanarBound, factor: float) -> None:
    wrong = replace(
        certificate, coefficients=[factor * c for c in certificate.coefficients], delta=factor * certificate.delta
    )
    assert not all(proven for _, _, proven in check_parts(wrong, roots=slice(-32, None), workers=1))


def test_the_command_and_its_users_refuse_a_coefficient_that_was_changed_in_its_fifth_digit(
    certificate: PlanarBound, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    prove = pytest.importorskip("ballbot_train.commands.prove").prove
    changed, path = json.loads(certificate.text()), tmp_path / "lower_bound.json"
    monkeypatch.setattr("ballbot_baselines.optimum.lower_bound._STORED", path)
    path.write_text(json.dumps(changed))
    PlanarBound.stored.cache_clear()
    assert PlanarBound.stored() == certificate
    changed["coefficients"][7] *= 1 + 1e-5
    path.write_text(json.dumps(changed))
    PlanarBound.stored.cache_clear()
    try:
        with pytest.raises(ValueError, match="was changed: the SHA-256 of its numbers"):
            prove(planar=True)
        with pytest.raises(ValueError, match="was changed"):
            PlanarBound.stored()
    finally:
        PlanarBound.stored.cache_clear()


def test_numbers_that_the_theorem_does_not_allow_are_refused(certificate: PlanarBound) -> None:
    _check_numbers(certificate)
    lower = replace(certificate, delta=certificate.delta * (1 - 1e-3))
    with pytest.raises(ArithmeticError, match="at most delta in the goal"):
        _check_numbers(lower)
    with pytest.raises(ArithmeticError, match="positive definite"):
        _check_numbers(replace(certificate, coefficients=[-c for c in certificate.coefficients]))
    with pytest.raises(ArithmeticError, match="knots"):
        _check_numbers(replace(certificate, knots=certificate.knots[:-1]))


def test_no_optimum_costs_less_than_the_bound(certificate: PlanarBound) -> None:
    task, robot, x0 = make_task("stabilize"), named_robot("paper"), np.zeros((12, 8))
    x0[:, ::2] = np.random.default_rng(2).uniform(-1, 1, (12, 4)) * (0.15, 0.05, 0.2, 0.3)
    bound = certificate.bound(x0[:, ::2], task.steps)
    x0, bound = x0[np.isfinite(bound)], bound[np.isfinite(bound)]
    assert len(bound) >= 6
    for optimum, least in zip(find_optima(task, robot, x0, np.zeros((len(x0), 0))), bound, strict=True):
        assert optimum is not None
        assert 0.9 * optimum.cost < least <= optimum.cost


START = np.array([0.2, 0.0, 0.05, 0.0, 0.1, 0.0, 0.0, 0.0])


def test_only_planar_starts_of_the_same_problem_have_a_bound() -> None:
    bound, task, robot = PlanarBound.stored(), make_task("stabilize"), named_robot("paper")
    least = bound.of_episode(task, robot, START)
    assert least > 0
    assert bound.of_episode(task, robot, np.roll(START, 1)) == least  # in the other plane
    assert bound.of_episode(make_task("stabilize", start_lean=0.1), robot, START) == least
    assert bound.of_episode(make_task("stabilize", duration=1.0), robot, START) < least
    others = [
        (make_task("stabilize", effort_weight=1e-3), robot, START),
        (make_task("weave"), robot, START),
        (task, named_robot("rolling"), START),
        (task, robot, START + 0.01),
        (task, robot, 10 * START),
        (task, robot, 0 * START),
    ]
    assert np.isnan([bound.of_episode(*other) for other in others]).all()


def test_both_planes_have_the_same_motions() -> None:
    robot, rng = named_robot("paper"), np.random.default_rng(0)
    x, u = np.zeros((100, 8)), np.zeros((100, 2))
    x[:, ::2], u[:, 0] = rng.uniform(-1, 1, (100, 4)), rng.uniform(-350, 350, 100)
    one, other = (robot.step(np.roll(x, n, axis=1), np.roll(u, n, axis=1), 0.02) for n in (0, 1))
    assert np.abs(np.roll(one, 1, axis=1) - other).max() < 1e-14
    assert not one[:, 1::2].any()


def test_a_planar_motion_has_a_regret_that_is_proven() -> None:
    task, robot = make_task("stabilize"), named_robot("paper")
    optimum = find_optimum(task, robot, START, np.zeros(0))
    found = regret(optimum.trajectory, task, robot)
    assert found.proven == pytest.approx(optimum.cost / PlanarBound.stored().of_episode(task, robot, START) - 1)
    assert found.regret <= found.proven < 0.1
