"""Fits the lower bound of the cost of planar Stabilize that `ballbot prove --planar` checks, and measures it.

Nobody has to trust the fit: it makes `lower_bound.json`, and the check proves what that file says. V is an even
polynomial in z. First it is fitted to the optimal costs of random states. Then a linear program, with a penalty on the
distance from that fit, makes V as large as possible at the task's planar starts, on condition that in samples (z, u) with
the worst force u

    (V(F(z, u)) − V(z))/dt + l(z, u) ≥ margin · l(z, u)   where V < rho, and   V(F(z, u)) + dt l(z, u) > rho   elsewhere.

Fresh samples that violate a condition are added, with the worst states near them, and the program is solved again.

It writes lower_bound.json. It prints how much the conditions leave in fresh samples, what share of the task's planar
starts the bound covers, and what share of the optimal cost it is in random states.
"""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from scipy.linalg import cho_factor, cho_solve, eigh, solve_triangular

from ballbot_baselines import PlanarBound
from ballbot_baselines.proofs.planar_bound import _PLANE, _in_goal, _optimal_costs, _tightness
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import files
from ballbot_gym.robot import default_params
from ballbot_gym.tasks import Stabilize

TASK, ROBOT = Stabilize(), default_params()
DT, EFFORT = TASK.control_dt, TASK.effort_weight
COST = np.array([TASK.position_weight, *[TASK.rest_weight] * 3])
STARTS = np.array([TASK.start_position, TASK.start_lean, TASK.start_speed, TASK.start_lean_rate])
KNOTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 0.9, 1.0)
LOSS = 0.05  # V is first fitted to this share less than the optimal cost
FORCES = np.linspace(-355, 355, 9)  # N, from which the worst one is searched
LIMIT = 350.0
FARTHEST_LEAN = 1.42  # rad, slightly beyond the limit of tilt, because the check's boxes reach beyond it


class Polynomial:
    """V = Σ cᵢ mᵢ(z), the even monomials of four variables."""

    def __init__(self, degree: int):
        grid = itertools.product(range(degree + 1), repeat=4)
        even = (e for e in grid if sum(e) in range(2, degree + 1, 2))
        self.degree, self.exponents = degree, np.array(sorted(even, key=lambda e: (sum(e), e)))
        pairs = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        place = {pair: i for i, pair in enumerate(pairs)}
        self.pairs = np.array(pairs)
        self.first = np.array([place[e[0], e[1]] for e in self.exponents])
        self.second = np.array([place[e[2], e[3]] for e in self.exponents])

    def monomials(self, z: np.ndarray) -> np.ndarray:
        """(n, m) of z (n, 4)."""
        return self._of_two(z[:, 0], z[:, 1])[:, self.first] * self._of_two(z[:, 2], z[:, 3])[:, self.second]

    def value(self, z: np.ndarray, c: np.ndarray) -> np.ndarray:
        """(n,) V of z (n, 4)."""
        table = np.zeros((len(self.pairs),) * 2)
        table[self.first, self.second] = c
        return np.einsum("na,na->n", self._of_two(z[:, 0], z[:, 1]) @ table, self._of_two(z[:, 2], z[:, 3]))

    def _of_two(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(n, k) monomials of two variables."""
        powers = np.ones((2, self.degree + 1, len(a)))
        for i in range(self.degree):
            powers[:, i + 1] = powers[:, i] * (a, b)
        return (powers[0][self.pairs[:, 0]] * powers[1][self.pairs[:, 1]]).T


def solve(a: np.ndarray, b: np.ndarray, gain: np.ndarray, start: np.ndarray, penalty: float) -> np.ndarray:
    """Maximizes gainᵀc − Σ max(ac − b, 0) − penalty/2 · mean of (a(c − start))², by Mehrotra's method."""
    count, size = len(a), np.abs(a).max(0)
    a = a / size
    r = np.linalg.qr(a / np.sqrt(count), mode="r")  # not by a.T @ a, because columns are nearly dependent
    a = np.ascontiguousarray(solve_triangular(r.T, a.T, lower=True).T)
    gain = solve_triangular(r.T, gain / size, lower=True)
    first = c = r @ (start * size)
    left = b - a @ c
    s, by = np.maximum(left, 0.05), np.full(count, 1.0 / count)
    other = 1.0 - by
    e = s * by / other + np.maximum(-left, 0)  # how much a condition is missed; `by` and `other` are multipliers
    for _ in range(250):
        of_a, of_c = b - a @ c + e - s, gain - penalty * (c - first) - a.T @ by
        mu = (s @ by + e @ other) / (2 * count)
        gap = 2 * count * mu / (1 + abs(gain @ c - e.sum()))
        if gap < 1e-5 and np.abs(of_a).max() < 1e-7 and np.abs(of_c).max() < 1e-6 * (1 + np.abs(gain).max()):
            break
        d = 1 / (s / by + e / other)
        rows = a * np.sqrt(d)[:, None]
        bend = rows.T @ rows
        bend[np.diag_indices(len(bend))] += penalty + 1e-13 * np.trace(bend) / len(bend)
        factor = cho_factor(bend)

        def step(of_s: np.ndarray, of_e: np.ndarray) -> tuple[np.ndarray, ...]:
            w = d * (of_s / by - of_a - of_e / other)  # noqa: B023
            dc = cho_solve(factor, of_c - a.T @ w)  # noqa: B023
            d_by = w + d * (a @ dc)  # noqa: B023
            return dc, (of_s - s * d_by) / by, d_by, (of_e + e * d_by) / other  # noqa: B023

        _, ds, d_by, de = step(-s * by, -e * other)
        primal, dual = _length((s, ds), (e, de)), _length((by, d_by), (other, -d_by))
        after = ((s + primal * ds) @ (by + dual * d_by) + (e + primal * de) @ (other - dual * d_by)) / (2 * count)
        wanted = (after / mu) ** 3 * mu
        dc, ds, d_by, de = step(wanted - s * by - ds * d_by, wanted - e * other + de * d_by)
        length = min(0.99 * _length((s, ds), (e, de)), 0.99 * _length((by, d_by), (other, -d_by)))
        c, s, e = c + length * dc, s + length * ds, e + length * de
        by, other = by + length * d_by, other - length * d_by
    return solve_triangular(r, c) / size


def _length(*pairs: tuple[np.ndarray, np.ndarray]) -> float:
    """The longest step up to 1 after which all numbers are still positive."""
    return min(1.0, *(float((x[d < 0] / -d[d < 0]).min(initial=1.0)) for x, d in pairs))


def ellipsoid(z: np.ndarray) -> np.ndarray:
    """(4, 4) Q of the smallest ellipsoid zᵀQz ≤ 1 that contains some points."""
    weight = np.full(len(z), 1 / len(z))
    for _ in range(3000):
        spread = (z * weight[:, None]).T @ z
        far = np.einsum("ni,ij,nj->n", z, np.linalg.inv(spread), z)
        weight *= far / 4
        if far.max() < 4 * (1 + 1e-3):
            break
    return np.linalg.inv(spread) / far.max()


def _accelerations(lean: np.ndarray, rate: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the ball's position and of the lean, in a vertical plane."""
    sine, cosine, moment = np.sin(lean), np.cos(lean), ROBOT.first_moment
    pull = force + moment * sine * rate * rate
    leaning = moment * (ROBOT.gravity * sine - cosine * pull / ROBOT.moving_mass)
    leaning = leaning / (ROBOT.pivot_inertia - moment * moment * cosine * cosine / ROBOT.moving_mass)
    return (pull - moment * cosine * leaning) / ROBOT.moving_mass, leaning


class Fit:
    """V, its samples and its conditions."""

    def __init__(self, degree: int, rho: float, margin: float, last: float, speed: float):
        gain, cost = discrete_lqr(TASK, ROBOT, np.zeros(8), np.zeros(2), np.zeros(0))
        self.gain, self.cost = gain[0, _PLANE], cost[np.ix_(_PLANE, _PLANE)]
        rate = np.diag(COST) + EFFORT * np.outer(self.gain, self.gain)
        self.t = np.round(np.linalg.inv(np.linalg.cholesky(rate).T), 4)
        self.inverse = np.linalg.inv(self.t)
        self.lqr = self.t.T @ self.cost @ self.t
        self.p, self.rho, self.margin = Polynomial(degree), rho, margin
        self.slopes = self.schedule(speed, last)
        self.c, self.q = np.zeros(len(self.p.exponents)), np.eye(4)

    def schedule(self, speed: float, last: float) -> list[float]:
        """The slopes at the knots: a share of what LQR's cost allows in the linear robot, and the last one."""
        out = []
        for a in KNOTS[:-1]:
            of_lqr, bend = a * (1 - LOSS), EFFORT * np.outer(self.gain, self.gain)
            rate = float(eigh(of_lqr * bend + np.diag(COST), self.cost, eigvals_only=True)[0])
            out.append(round(speed * (1 - of_lqr) * rate / (1 - LOSS), 4))
        return [*out, last]

    def begin(self, z: np.ndarray, cost: np.ndarray, reach: float) -> None:
        """Fits V to optimal costs, and takes the ellipsoid that holds the states whose cost is below reach · rho."""
        self.q = ellipsoid(z[cost < reach * self.rho])
        near = (cost < 1.8 * self.rho) & (self.within(z) < 1.3)
        weight = np.where(cost[near] < 1.1 * self.rho, 1, 0.3) / cost[near]
        rows = self.p.monomials(z[near]) * weight[:, None]
        size = np.abs(rows).max(0)
        self.c = np.linalg.lstsq(rows / size, (1 - LOSS) * cost[near] * weight, rcond=1e-13)[0] / size

    def within(self, z: np.ndarray) -> np.ndarray:
        """(n,) Q of z: V is used where it is at most 1."""
        return np.einsum("ni,ij,nj->n", z, self.q, z)

    def value(self, z: np.ndarray) -> np.ndarray:
        """(n,) V of z."""
        return self.p.value(z, self.c)

    def after(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n, 4) one control step after z under forces u (n,)."""
        h, (position, lean, speed, rate) = DT / 2, (z @ self.t.T).T
        for _ in range(2):
            a1, b1 = _accelerations(lean, rate, u)
            a2, b2 = _accelerations(lean + h / 2 * rate, rate + h / 2 * b1, u)
            rate2 = rate + h / 2 * b1
            a3, b3 = _accelerations(lean + h / 2 * rate2, rate + h / 2 * b2, u)
            rate3 = rate + h / 2 * b2
            a4, b4 = _accelerations(lean + h * rate3, rate + h * b3, u)
            rate4, speeds = (
                rate + h * b3,
                speed + 2 * (speed + h / 2 * a1) + 2 * (speed + h / 2 * a2) + (speed + h * a3),
            )
            position, lean = position + h / 6 * speeds, lean + h / 6 * (rate + 2 * rate2 + 2 * rate3 + rate4)
            speed, rate = speed + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4), rate + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        return np.stack([position, lean, speed, rate], 1) @ self.inverse.T

    def rate(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n,) cost rates."""
        return np.square(z @ self.t.T) @ COST + EFFORT * u**2

    def worst(self, z: np.ndarray, u: np.ndarray, a: float, rounds: int) -> np.ndarray:
        """(n,) forces of least a V(F) + l dt, by Newton's method from u with differences of 2 N."""

        def total(u: np.ndarray) -> np.ndarray:
            return a * self.value(self.after(z, u)) + DT * EFFORT * u**2

        h = 2.0
        for _ in range(rounds):
            low, middle, high = total(u - h), total(u), total(u + h)
            bend = np.maximum((low + high - 2 * middle) / h**2, 5e-6)
            u = np.clip(u - np.clip((high - low) / (2 * h) / bend, -100, 100), -LIMIT, LIMIT)
        return u

    def worst_inside(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) forces of least V(F) + l dt among those with F in the ellipsoid, and where there is one."""

        def total(u: np.ndarray) -> np.ndarray:
            end = self.after(z, u)
            return np.where(self.within(end) < 1, self.value(end) + DT * EFFORT * u**2, np.inf)

        best, u = np.full(len(z), np.inf), np.zeros(len(z))
        for each in FORCES:
            tried = np.full(len(z), each)
            cost = total(tried)
            better = cost < best
            best, u = np.where(better, cost, best), np.where(better, tried, u)
        tried = self.worst(z, u, 1.0, 5)
        return np.where(total(tried) < best, tried, u), np.isfinite(best)

    def left(self, z: np.ndarray) -> np.ndarray:
        """(n,) the least that a condition leaves beyond the margin, of the cost rate; infinite where none is needed."""
        v, (u, needed) = self.value(z), self.worst_inside(z)
        after, rate = self.value(self.after(z, u)), self.rate(z, u)
        decrease = ((after - v) / DT - self.slopes[-1] * v) / rate + 1 - self.margin
        jump = (after + DT * rate - self.rho) / (DT * rate) - 0.5 * self.margin
        inside = self.within(z) < 1
        out = np.where(inside, np.where(v < self.rho, decrease, np.maximum(decrease, jump)), jump)
        return np.where(needed & (np.abs((z @ self.t.T)[:, 1]) < FARTHEST_LEAN), out, np.inf)

    def climb(self, z: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """States near z where less is left, by random search, and how much."""
        left, step, axes = self.left(z), 0.05, np.linalg.cholesky(self.q).T
        for _ in range(12):
            tried = z + np.linalg.solve(axes, rng.normal(size=z.shape).T).T * step
            found = self.left(tried)
            better, step = found < left, 0.8 * step
            z, left = np.where(better[:, None], tried, z), np.where(better, found, left)
        return z, left

    def samples(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, 4) states in and around the ellipsoid, in all directions."""
        d = rng.normal(size=(count, 4))
        d /= np.linalg.norm(d, axis=1)[:, None]
        r = np.where(rng.random(count) < 0.15, rng.random(count) * 0.7, (1.25 * rng.random(count)) ** 0.35)
        return np.linalg.solve(np.linalg.cholesky(self.q).T, (d * r[:, None]).T).T

    def conditions(self, z: np.ndarray, until: list[float]) -> tuple[np.ndarray, np.ndarray]:
        """Rows a and numbers b of conditions a c ≤ b, those that the last V obeys by far left out."""
        z = z[np.abs((z @ self.t.T)[:, 1]) < FARTHEST_LEAN]
        v, q = self.value(z), self.within(z)
        inside, out = (v < 1.02 * self.rho) & (q < 1), []
        near, v_near = z[inside], v[inside]
        m, (u, needed) = self.p.monomials(near), self.worst_inside(near)
        for a, r, most in list(zip(KNOTS, self.slopes, until, strict=True))[5:]:
            k = (v_near < 1.05 * most) & needed
            force = u[k] if a == 1 else self.worst(near[k], u[k], a, 3)
            decrease = a * (m[k] - self.p.monomials(self.after(near[k], force))) / DT
            rows = (decrease + r * m[k]) / self.rate(near[k], force)[:, None]
            out.append((rows, np.full(len(rows), 1 - self.margin), 0.5 if a == 1 else 0.15))
        lqr = np.einsum("ni,ij,nj->n", z, self.lqr, z)
        k = (q < 1.1) & (v < 1.05 * self.rho) & (v < 0.8 * lqr)  # V is not far below LQR's cost
        out.append((-self.p.monomials(z[k]) / lqr[k][:, None], np.full(k.sum(), -0.35), 0.5))
        far = z[~inside]
        u, needed = self.worst_inside(far)
        after, step = self.after(far[needed], u[needed]), DT * self.rate(far[needed], u[needed])
        k = step < self.rho
        rows = -self.p.monomials(after[k]) / step[k][:, None]
        out.append((rows, 1 - self.rho / step[k] - 0.6 * self.margin, 0.5))
        kept = [b - a @ self.c < most for a, b, most in out]
        rows = np.concatenate([a[k] for (a, _, _), k in zip(out, kept, strict=True)])
        return rows, np.concatenate([b[k] for (_, b, _), k in zip(out, kept, strict=True)])

    def improve(self, z0: np.ndarray, cost: np.ndarray, guides: np.ndarray, count: int, rounds: int) -> None:
        """Makes V large at starts z0 of some optimal costs, and keeps it above rho at guides."""
        rng, z, first, delta = np.random.default_rng(1), np.zeros((0, 4)), self.c, 0.154
        ahead = [min(a + DT * max(self.slopes), 0.999999) for a in KNOTS[1:]]
        until = [delta / (1 - a) if a < 0.999999 else 1e9 for a in [*ahead, 1.0]]
        gain = (self.p.monomials(z0) / cost[:, None]).mean(0)
        high = -self.p.monomials(guides) / self.rho
        for n in range(rounds):
            many = self.samples(60 * count, rng)  # V itself is quickly computed, and thin sets of low values are rare
            many = many[(np.abs((many @ self.t.T)[:, 1]) < FARTHEST_LEAN) & (self.within(many) < 1.1)]
            v = self.value(many)
            low = many[v < 0.36 * np.einsum("ni,ij,nj->n", many, self.lqr, many)][:3000]
            edge = many[(v < 1.05 * self.rho) & (np.abs((many @ self.t.T)[:, 1]) > 1.2)][: count if n else 0]
            new = np.concatenate([edge, self.samples(12 * count if n else count, rng)])
            left = self.left(new)
            print(f"round {n}: at least {left.min():.4f} beyond the margin, negative in {(left < 0).mean():.3%}")
            if n:
                order = np.argsort(left)[:5000]
                worst, found = self.climb(new[order], rng)
                new = np.concatenate([new[order][left[order] < 0.03], worst[found < 0.03], new[-500:]])
            z = np.concatenate([z, new, low])
            a, b = self.conditions(z, until)
            k = -1.03 - high @ self.c < 0.5
            a, b = np.concatenate([a, high[k]]), np.concatenate([b, np.full(k.sum(), -1.03)])
            self.c = solve(a, b, gain, first, penalty=3.0)

    def certificate(self, speed: float) -> PlanarBound:
        """V in coordinates in which the ellipsoid is a ball, with rounded coefficients, and a schedule of some speed."""
        inside, rng = self.inverse.T @ self.q @ self.inverse, np.random.default_rng(0)
        t = np.round(np.linalg.inv(np.linalg.cholesky(inside).T), 5)
        z = rng.normal(size=(4000, 4))
        z /= np.linalg.norm(z, axis=1)[:, None]
        z *= 1.2 * rng.random((4000, 1)) ** 0.3
        v, m = self.value(z @ t.T @ self.inverse.T), self.p.monomials(z)
        weight = 1 / np.maximum(np.abs(v), 1e-4)
        c = np.linalg.lstsq(m * weight[:, None], v * weight, rcond=1e-15)[0]
        out = PlanarBound(
            t=t.tolist(),
            gain=np.round(-self.gain @ t, 3).tolist(),
            exponents=self.p.exponents.tolist(),
            coefficients=[float(f"{each:.7g}") for each in c],
            rho=self.rho,
            delta=1.0,
            knots=list(zip(KNOTS, self.schedule(speed, self.slopes[-1]), strict=True)),
        )
        return replace(out, delta=float(np.ceil(1e4 * float(sum(_in_goal(out)))) / 1e4))


def measure(certificate: PlanarBound, count: int) -> None:
    """Prints how many planar starts the bound covers, and which share of the optimal cost it is in some of them."""
    covered, ratio = _tightness(certificate, count)
    most, a = certificate.rho - certificate.delta, certificate.schedule(TASK.steps)
    bound = f"max({a:.4f} V, V - {certificate.delta})"
    print(f"covers {covered:.3%} of the task's planar starts: those whose bound {bound} is at most {most:.4f}")
    parts = f"{ratio.min():.4f} to {ratio.max():.4f}, mean {ratio.mean():.4f}"
    print(
        f"bound / optimal cost in {len(ratio)} random planar starts: {parts}, above 0.97 in {(ratio > 0.97).mean():.1%}"
    )


def main(
    degree: int = 8,
    rho: float = 6.4,
    margin: float = 0.02,
    reach: float = 1.5,
    last: float = 0.012,
    speed: float = 0.7,
    faster: float = 0.88,
    samples: int = 20_000,
    rounds: int = 9,
    states: int = 1000,
    out: Path = Path("runs/lower_bound.json"),
) -> None:
    """Fits the bound.

    Args:
        degree: of V.
        rho: V is fitted where it is below this.
        margin: by how much the inequality should hold, as a share of the cost rate.
        reach: V is used in the smallest ellipsoid of states whose optimal cost is below this times rho.
        last: the last slope of the schedule.
        speed: of the rest of the schedule in the fit, as a share of what the linear robot allows.
        faster: the same in the certificate, because the fit leaves room for a faster one.
        samples: of the first round of the fit.
        rounds: of the fit.
        states: random starts for which the optimum is computed; 0 for none.
        out: the certificate.
    """
    fit = Fit(degree, rho, margin, last, speed)
    rng = np.random.default_rng(12)
    d = rng.normal(size=(14_000, 4))
    d /= np.linalg.norm(d, axis=1)[:, None]
    z = np.linalg.solve(np.linalg.cholesky(fit.cost).T, d.T).T @ fit.inverse.T
    z = z * (np.sqrt(4 * rho) * rng.random(len(d)) ** 0.5)[:, None]
    z = z[np.abs((z @ fit.t.T)[:, 1]) < 1.39]
    cost = _optimal_costs(z @ fit.t.T)
    z, cost = z[np.isfinite(cost)], cost[np.isfinite(cost)]
    fit.begin(z, cost, reach)
    guides = z[(cost > 1.2 * rho) & (fit.within(z) < 1.1)]
    x0 = np.random.default_rng(11).uniform(-1, 1, (400_000, 4)) * STARTS
    x0 = x0[np.einsum("ni,ij,nj->n", x0, fit.cost, x0) < 3 * rho][:6000]
    cost = _optimal_costs(x0)
    low = cost < rho
    fit.improve((x0 @ fit.inverse.T)[low], cost[low], guides, samples, rounds)
    certificate = fit.certificate(faster)
    files.write(out, certificate.text())
    left = fit.left(fit.samples(40_000, np.random.default_rng(9)))
    print(f"the conditions leave at least {left.min() + margin:.4f} of the cost rate in 40,000 fresh samples")
    if states:
        measure(certificate, states)


if __name__ == "__main__":
    tyro.cli(main)
