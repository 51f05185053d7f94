"""Proofs that optima are local minima: interval arithmetic holds what it should, and a changed optimum is refused."""

from dataclasses import replace

import numpy as np
import pytest

from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.robot import named_robot

pytest.importorskip("casadi")

from ballbot_baselines.proofs.intervals import VARIABLES, _Ball, _derivatives, _variables
from ballbot_baselines.proofs.local_minimum import (
    _Curvature,
    _Linear,
    _NotProvenError,
    _parts_of,
    _Point,
    _Problem,
    _residual,
)
from ballbot_baselines.proofs.minima import _enclosed
from ballbot_baselines.proofs.stationary import _stationary

DIGITS = 80


@pytest.mark.parametrize(("radius", "digits"), [(0.0, np.float64), (1e-6, np.float64), (0.0, np.longdouble)])
def test_balls_hold_a_step_and_its_derivatives_in_80_digits(radius: float, digits: type) -> None:
    mpmath, rng = pytest.importorskip("mpmath"), np.random.default_rng(3)
    robot, h = named_robot("paper"), mpmath.mpf(10) ** -15
    scale = np.array([2, 2, 0.8, 0.8, 3, 3, 2, 2, 200, 200])
    middle = (rng.uniform(-1, 1, VARIABLES) * scale).astype(digits)
    point = middle + (radius * rng.uniform(-1, 1, VARIABLES)).astype(digits)
    jets = _variables(_Ball(middle[None], np.full((1, VARIABLES), radius)), 2)
    value, slope, bend = _derivatives(robot.step(jets[:8], jets[8:], 0.02))
    with mpmath.workdps(DIGITS):
        exact = [mpmath.mpf(float(a)) + mpmath.mpf(float(a - digits(float(a)))) for a in point]

        def step(*moves: tuple[int, int]) -> list:
            moved = list(exact)
            for i, sign in moves:
                moved[i] += sign * h
            return list(robot.step(tuple(moved[:8]), tuple(moved[8:]), 0.02))

        def inside(numbers: list, ball: _Ball) -> bool:
            pairs = zip(numbers, ball.m, ball.r, strict=True)
            middles = ((x, mpmath.mpf(float(m)) + mpmath.mpf(float(m - digits(float(m)))), r) for x, m, r in pairs)
            return all(abs(x - m) <= r + mpmath.mpf(10) ** -25 for x, m, r in middles)

        assert inside(step(), value[0])
        for i in range(VARIABLES):
            ahead, back = step((i, 1)), step((i, -1))
            assert inside([(a - b) / (2 * h) for a, b in zip(ahead, back, strict=True)], slope[0, :, i])
            j = (i + 3) % VARIABLES
            corners = zip(
                step((i, 1), (j, 1)), step((i, 1), (j, -1)), step((i, -1), (j, 1)), step((i, -1), (j, -1)), strict=True
            )
            assert inside([(a - b - c + d) / (4 * h * h) for a, b, c, d in corners], bend[0, :, i, j])
    assert (value.r < 1e-3).all()
    assert (bend.r < 1e-2).all()


@pytest.fixture
def short():
    """The problem, the motion and the cost of a certified turn of 40 steps, whose goal has four active constraints."""
    task, robot = make_task("turn"), named_robot("paper")
    known = certified.load(task, robot)
    return _Problem(task, robot, tuple(known.constants[4].tolist())), known.trajectories[4], float(known.costs[4])


def test_a_certified_turn_is_a_strict_local_minimum(short):
    found = _enclosed(*short)
    assert found["radius"] < 1e-9
    assert found["cost_width"] < 1e-9
    assert found["active_constraints"] == 4


def test_a_force_or_a_cost_that_differs_in_its_fifth_digit_is_refused(short):
    problem, motion, cost = short
    forces = motion.u.copy()
    forces[np.unravel_index(np.abs(forces).argmax(), forces.shape)] *= 1 + 1e-4
    with pytest.raises(_NotProvenError, match="stored forces"):
        _enclosed(problem, replace(motion, u=forces), cost)
    with pytest.raises(_NotProvenError, match="certified"):
        _enclosed(problem, motion, cost * (1 + 1e-4))


def test_the_command_proves_stored_minima_and_refuses_a_set_that_was_changed_in_its_fifth_digit(monkeypatch, capsys):
    prove = pytest.importorskip("ballbot_train.commands.prove").prove
    prove(check=True, tasks=("turn",), episodes=1)
    assert "1 of 1 minima enclosed" in capsys.readouterr().out
    known = certified.load(make_task("turn"), named_robot("paper"))
    motion = known.trajectories[0]
    forces = motion.u.copy()
    forces[3] *= 1 + 1e-4
    changed = (
        replace(known, costs=known.costs * (1 + 1e-4)),
        replace(known, trajectories=[replace(motion, u=forces), *known.trajectories[1:]]),
    )
    for wrong in changed:
        monkeypatch.setattr(certified, "load", lambda *_, wrong=wrong: wrong)
        with pytest.raises(ValueError, match="1 of 1 minima could not be proven"):
            prove(check=True, tasks=("turn",), episodes=1)
        assert "0 of 1 minima enclosed" in capsys.readouterr().out


def test_a_motion_that_is_no_optimum_is_refused(short):
    problem, motion, cost = short
    with pytest.raises(ArithmeticError):
        _enclosed(problem, replace(motion, u=0.5 * motion.u), cost)


def test_the_conditions_change_as_the_linear_model_says_up_to_the_bound_of_the_theorem(short) -> None:
    """F(z) − F(0) − Mz is the mean of (F' − M)z on the way to z, and F is nearly quadratic: half of the bound is reached."""
    problem, motion, _ = short
    point, m = _stationary(problem, motion.x, motion.u)
    rng, size = np.random.default_rng(0), 1e-6
    box = tuple(np.full(part.shape, size) for part in (point.x, point.u, point.x, point.mu))
    box[0][0] = 0.0
    inside = moved(point, m, *(_Ball(np.zeros(part.shape), part) for part in box))
    bounds = _Curvature(inside, _parts_of(problem, inside.x, inside.u, 2), m).variation(box)
    dx, v, w, nu = (part * rng.choice([-1, 1], part.shape) for part in box)
    near = moved(point, m, dx, v, w, nu)
    change = [
        after.m - before.m
        for after, before in zip(
            *(_residual(each, _parts_of(problem, _Ball(each.x), _Ball(each.u), 1), m) for each in (near, point)),
            strict=True,
        )
    ]
    states = w - np.vstack([times(np.swapaxes(m.a, 1, 2), w[1:]), np.zeros((1, 8))])
    linear = [dx[1:] - times(m.a, dx[:-1]) - times(m.b, v), v + times(m.gb, w[1:]), states, np.zeros(len(nu))]
    for j, (k, _) in enumerate(point.rows):
        linear[2][k] += m.slopes[j] * nu[j]
        linear[3][j] = m.slopes[j] @ dx[k]
    ratios = [np.max(np.abs(a - b)[1:] / c[1:]) for a, b, c in zip(change, linear, bounds, strict=True)]
    assert max(ratios) == pytest.approx(0.5, abs=0.01)


def times(matrices, vectors):
    return (matrices @ vectors[..., None])[..., 0]


def moved(point: _Point, m: _Linear, dx, v, w, nu) -> _Point:
    """The point at z = (dx, v, w, nu) of the theorem."""
    return replace(
        point,
        x=point.x + dx,
        u=point.u + (v - times(m.k, dx[:-1])),
        lam=point.lam + (times(m.p, dx) + w),
        mu=point.mu + nu,
    )
