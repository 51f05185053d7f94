"""A proven lower bound of the cost of Stabilize in a vertical plane: `ballbot prove --planar`. The check is `planar_bound.c`.

The bound is a polynomial V of four variables, stored in `optimum/lower_bound.json` with all other numbers of the theorem.
Nothing of it is trusted: this module computes in exact fractions what the theorem in `planar_bound.c` asks of the goal, of
the schedule a_k and of the range of states. Then it checks the inequality of the step in boxes that cover this range.
"""

import ctypes
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np

from ballbot_baselines.optimum.find import find_optima
from ballbot_baselines.optimum.lower_bound import PlanarBound
from ballbot_gym import machine_code
from ballbot_gym.robot import default_params
from ballbot_gym.tasks.stabilize import Stabilize

_PAIRS, _FOURS = (list(itertools.combinations_with_replacement(range(4), n)) for n in (2, 4))
_KNOTS = 16
_WIDEST = 4096.0
_FLAGS = ("-O3",)
_PLANE = [0, 2, 4, 6]  # position, lean, speed and lean rate of a state


class _Problem(ctypes.Structure):
    """`problem` of planar_bound.c."""

    _fields_ = (
        *((name, ctypes.c_double) for name in ("mass", "moment", "inertia", "gravity", "dt", "limit")),
        *((name, ctypes.c_double * 4) for name in ("reach", "state_cost")),
        ("force_cost", ctypes.c_double),
        ("t", ctypes.c_double * 16),
        ("gain", ctypes.c_double * 4),
        *((name, ctypes.c_double) for name in ("widest", "rho")),
        *((name, ctypes.c_double * _KNOTS) for name in ("a", "r", "until")),
        ("c2", ctypes.c_double * 10),
        ("c4", ctypes.c_double * 35),
        ("c6", ctypes.c_double * 350),
        ("c8", ctypes.c_double * 1225),
        ("knots", ctypes.c_int64),
    )


class _Box(ctypes.Structure):
    """`box` of planar_bound.c."""

    _fields_ = (
        ("mid", ctypes.c_double * 5),
        ("half", ctypes.c_double * 5),
        ("face", ctypes.c_int64),
        ("depth", ctypes.c_int64),
    )


def _problem(certificate: PlanarBound) -> _Problem:
    """What planar_bound.c checks."""
    task, robot = Stabilize(), default_params()
    out = _Problem(robot.moving_mass, robot.first_moment, robot.pivot_inertia, robot.gravity, task.control_dt)
    out.limit, out.force_cost, out.knots, out.widest = (
        robot.force_limit,
        task.effort_weight,
        len(certificate.knots),
        _WIDEST,
    )
    out.reach[0], out.reach[1] = task.arena_radius, task.max_tilt
    out.state_cost[:] = [task.position_weight, *[task.rest_weight] * 3]
    out.t[:], out.gain[:] = np.ravel(certificate.t).tolist(), certificate.gain
    out.rho = certificate.rho
    for i, ((a, r), until) in enumerate(zip(certificate.knots, certificate.until(), strict=True)):
        out.a[i], out.r[i], out.until[i] = a, r, until
    for e, c in zip(certificate.exponents, certificate.coefficients, strict=True):
        factors = tuple(i for i in range(4) for _ in range(e[i]))
        degree, head, tail = len(factors), factors[:4], factors[4:]
        place = _PAIRS.index(head) if degree == 2 else _FOURS.index(head)
        if tail:
            rest = _PAIRS if degree == 6 else _FOURS
            place = place * len(rest) + rest.index(tail)
        getattr(out, f"c{degree}")[place] = c
    return out


def _check_numbers(certificate: PlanarBound) -> int:
    """Checks in exact fractions what the theorem asks of its numbers.

    Returns:
        n: the theorem's range of states lies in σ ≤ 2ⁿ.

    Raises:
        ArithmeticError: something does not hold.
    """
    problem, (a, r) = _problem(certificate), zip(*certificate.knots, strict=True)
    t = [[Fraction(each) for each in row] for row in certificate.t]
    inverse, quadratic = _inverse(t), _quadratic(certificate)
    most, higher = _in_goal(certificate)
    rho, dt = Fraction(certificate.rho), Fraction(problem.dt)
    reach = [_root(rho / (dt * Fraction(cost))) for cost in problem.state_cost]
    reach = [min(each, Fraction(limit)) if limit else each for each, limit in zip(reach, problem.reach, strict=True)]
    farthest = max(sum(abs(row[j]) * reach[j] for j in range(4)) for row in inverse) ** 2
    holds = {
        "T is upper triangular": all(t[i][j] == 0 for i in range(4) for j in range(i)),
        "the quadratic part of V is positive definite": _is_positive(quadratic),
        "V is at most delta in the goal": most + higher <= Fraction(certificate.delta),
        "the goal lies where V is used": max(sum(z * z for z in corner) for corner in _corners(certificate)) <= 1,
        "delta is less than rho": certificate.delta < certificate.rho,
        "the boxes of forces reach beyond the gain": sum(map(abs, certificate.gain)) < _WIDEST / 2,
        "the knots rise from 0 to 1, with slopes >= 0": a[0] == 0
        and a[-1] == 1
        and sorted(a) == list(a)
        and min(r) >= 0,
    }
    if wrong := [name for name, right in holds.items() if not right]:
        raise ArithmeticError(f"it is not true that {' and that '.join(wrong)}")
    return int(np.ceil(np.log2(float(max(farthest, 1)) * 1.001)))


def _quadratic(certificate: PlanarBound) -> list[list[Fraction]]:
    """The matrix of the quadratic part of V."""
    out = [[Fraction(0)] * 4 for _ in range(4)]
    for e, c in zip(certificate.exponents, certificate.coefficients, strict=True):
        if sum(e) == 2:
            i, j = (i for i in range(4) for _ in range(e[i]))
            out[i][j] += Fraction(c) / 2
            out[j][i] += Fraction(c) / 2
    return out


def _corners(certificate: PlanarBound) -> list[list[Fraction]]:
    """z in the corners of the goal, which is slightly enlarged."""
    inverse = _inverse([[Fraction(each) for each in row] for row in certificate.t])
    goal = [Fraction(each) * Fraction(1 + 1e-9) for each in Stabilize.AT_REST]
    signs = itertools.product((1, -1), repeat=4)
    return [[sum((row[j] * s[j] * goal[j] for j in range(4)), Fraction(0)) for row in inverse] for s in signs]


def _in_goal(certificate: PlanarBound) -> tuple[Fraction, Fraction]:
    """Upper bounds of the quadratic part of V in the goal, if it is convex, and of the rest of V there."""
    quadratic, corners = _quadratic(certificate), _corners(certificate)
    # a convex function is largest in a corner
    most = max(sum(z[i] * quadratic[i][j] * z[j] for i in range(4) for j in range(4)) for z in corners)
    largest, rest = [max(corner[i] for corner in corners) for i in range(4)], Fraction(0)
    for e, c in zip(certificate.exponents, certificate.coefficients, strict=True):
        if sum(e) > 2:
            rest += abs(Fraction(c)) * math.prod(largest[i] ** e[i] for i in range(4))
    return Fraction(most), rest


def _inverse(matrix: list[list[Fraction]]) -> list[list[Fraction]]:
    """Of a matrix whose pivots are not 0, as of an upper triangular one or a positive definite one."""
    m = [[*row, *(Fraction(i == j) for j in range(4))] for i, row in enumerate(matrix)]
    for p in range(4):
        m[p] = [x / m[p][p] for x in m[p]]
        for i in range(4):
            if i != p:
                m[i] = [x - m[i][p] * y for x, y in zip(m[i], m[p], strict=True)]
    return [row[4:] for row in m]


def _is_positive(matrix: list[list[Fraction]]) -> bool:
    """Whether a symmetric matrix is positive definite: all of its pivots are positive."""
    m = [list(row) for row in matrix]
    for p in range(4):
        if m[p][p] <= 0:
            return False
        for i in range(p + 1, 4):
            m[i] = [x - m[i][p] / m[p][p] * y for x, y in zip(m[i], m[p], strict=True)]
    return True


def _root(a: Fraction) -> Fraction:
    """An upper bound of a square root."""
    return Fraction(float(a) ** 0.5 * (1 + 1e-9))


@cache
def _code() -> ctypes.CDLL:
    """planar_bound.c."""
    source = Path(__file__).with_name("planar_bound.c").read_text(encoding="utf-8")
    code = ctypes.CDLL(str(machine_code.library("planar-bound", source, _FLAGS)))
    code.check.restype = ctypes.c_int64
    code.check.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p]
    code.look.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    code.prepare.argtypes = [ctypes.c_void_p]
    return code


def _roots(most: int, moves: bool) -> list[_Box]:
    """Boxes that cover σ ≤ 2ᵐᵒˢᵗ: σ by octaves, each component of y in halves."""
    out = []
    for octave in range(most, -6, -1):
        low = 0.0 if octave == -5 else 2.0 ** (octave - 1)
        high = 2.0**octave
        for face, corner in itertools.product(range(4), itertools.product((-0.5, 0.5), repeat=3)):
            mid, half = ((low + high) / 2, *corner, 0.0), ((high - low) / 2, 0.5, 0.5, 0.5, _WIDEST * moves)
            out.append(_Box((ctypes.c_double * 5)(*mid), (ctypes.c_double * 5)(*half), face, 0))
    return out


def check_parts(
    certificate: PlanarBound, most_boxes: int = 10**8, roots: slice = slice(None), workers: int | None = None
) -> Iterator[tuple[float, int, bool]]:
    """Checks a certificate. Yields after each root box: the share that is done, its boxes, and whether it is proven.

    Args:
        certificate: the numbers of the theorem.
        most_boxes: after which a root box is given up.
        roots: some of the root boxes of (A) and of (B), for a quick trial. The theorem needs all.
        workers: threads; default, one for each processor.

    Raises:
        ArithmeticError: a number of the theorem is wrong.
        machine_code.NoMachineCodeError: there is no C compiler.
    """
    most, code, problem = _check_numbers(certificate), _code(), _problem(certificate)
    code.prepare(ctypes.addressof(problem))

    def check(job: tuple[_Box, bool]) -> tuple[int, bool]:
        boxes = ctypes.c_int64()
        left = code.check(ctypes.addressof(job[0]), int(job[1]), most_boxes, ctypes.addressof(boxes))
        return boxes.value, left == 0

    jobs = [(root, moves) for moves in (False, True) for root in _roots(most, moves)[roots]]
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        running = [pool.submit(check, job) for job in jobs]
        for n, each in enumerate(as_completed(running)):
            boxes, proven = each.result()
            if not proven:
                pool.shutdown(cancel_futures=True)
            yield (n + 1) / len(jobs), boxes, proven
            if not proven:
                return


def _optimal_costs(x: np.ndarray, components: Sequence[int] = _PLANE) -> np.ndarray:
    """(n,) of states with some components x, of a plane by default, and else zeros; NaN where no optimum is found."""
    x0 = np.zeros((len(x), 8))
    x0[:, components] = x
    optima = find_optima(Stabilize(), default_params(), x0, np.zeros((len(x0), 0)))
    return np.array([np.nan if each is None else each.cost for each in optima])


def _tightness(certificate: PlanarBound, count: int) -> tuple[float, np.ndarray]:
    """How much of the optimal cost a bound is; nothing of it is proven.

    Returns:
        The share of the task's planar starts that the bound covers. (count,) the bound of random ones that it covers, divided
        by the optimal cost.
    """
    task = Stabilize()
    most = [task.start_position, task.start_lean, task.start_speed, task.start_lean_rate]
    x0 = np.random.default_rng(5).uniform(-1, 1, (max(4 * count, 100_000), 4)) * most
    bound = certificate.bound(x0, task.steps)
    covered = np.isfinite(bound)
    ratio = bound[covered][:count] / _optimal_costs(x0[covered][:count])
    return float(covered.mean()), ratio[np.isfinite(ratio)]
