"""How far is a lower bound for motions out of the plane? A trial on samples, in which nothing is proven.

V is an even polynomial of degree 4 in the eight numbers of a state of Stabilize, with 366 coefficients. It is fitted to
optimal costs of random states. Then a linear program makes it as large as possible on condition that in samples with V < rho
no force lowers V in a control step by more than the step costs, up to a margin: as in `planar_bound.py`, but without
conditions on what a step reaches from outside. For each rho it prints what share of the optimal cost V is, in what share of
fresh samples the condition fails, by how much, and in which states.
"""

import itertools

import numpy as np
import tyro
from planar_bound import DT, EFFORT, LIMIT, LOSS, ROBOT, TASK, solve

from ballbot_baselines.proofs.planar_bound import _optimal_costs
from ballbot_baselines.solvers.riccati import discrete_lqr

COST = np.repeat([TASK.position_weight, *[TASK.rest_weight] * 3], 2)
FACTORS = [of for degree in (2, 4) for of in itertools.combinations_with_replacement(range(8), degree)]
PAIRS = list(itertools.combinations_with_replacement(range(8), 2))


class Fit:
    """V in coordinates z in which the cost rate of LQR in the linear robot is z'z."""

    def __init__(self, rho: float, margin: float, last: float):
        gain, cost = discrete_lqr(TASK, ROBOT, np.zeros(8), np.zeros(2), np.zeros(0))
        self.t = np.linalg.inv(np.linalg.cholesky(np.diag(COST) + EFFORT * gain.T @ gain).T)
        self.inverse, self.gain, self.rho, self.margin, self.last = np.linalg.inv(self.t), gain, rho, margin, last
        self.spread = np.linalg.inv(np.linalg.cholesky(self.t.T @ cost @ self.t).T)
        self.c: np.ndarray = np.zeros(len(FACTORS))

    def monomials(self, z: np.ndarray) -> np.ndarray:
        """(n, 366) of z (n, 8)."""
        two = np.stack([z[:, i] * z[:, j] for i, j in PAIRS], 1)
        place = {pair: i for i, pair in enumerate(PAIRS)}
        first, second = np.array([(place[of[:2]], place[of[2:]]) for of in FACTORS if len(of) == 4]).T
        return np.hstack([two, two[:, first] * two[:, second]])

    def value(self, z: np.ndarray) -> np.ndarray:
        """(n,) V of z."""
        return np.concatenate([self.monomials(some) @ self.c for some in np.array_split(z, len(z) // 20_000 + 1)])

    def after(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n, 8) one control step after z under forces u (n, 2)."""
        return ROBOT.step(z @ self.t.T, u, DT, ROBOT.substeps(DT)) @ self.inverse.T

    def rate(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n,) cost rates."""
        return np.square(z @ self.t.T) @ COST + EFFORT * np.square(u).sum(1)

    def worst(self, z: np.ndarray) -> np.ndarray:
        """(n, 2) forces of least V(F) + l dt, by Newton's method from LQR's, one force after the other."""

        def total(u: np.ndarray) -> np.ndarray:
            return self.value(self.after(z, u)) + DT * EFFORT * np.square(u).sum(1)

        u, h = np.clip(-z @ self.t.T @ self.gain.T, -LIMIT, LIMIT), 2.0
        for _, axis in itertools.product(range(3), np.eye(2)):
            low, middle, high = total(u - h * axis), total(u), total(u + h * axis)
            bend = np.maximum((low + high - 2 * middle) / h**2, 5e-6)
            u = np.clip(u - np.clip((high - low) / (2 * h) / bend, -100, 100)[:, None] * axis, -LIMIT, LIMIT)
        return u

    def left(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n,) what the condition leaves, as a share of the cost rate."""
        v, rate = self.value(z), self.rate(z, u)
        return ((self.value(self.after(z, u)) - v) / DT - self.last * v) / rate + 1

    def samples(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """States in all directions with V < rho."""
        d = rng.normal(size=(count, 8))
        d *= (1.15 * rng.random((count, 1)) ** 0.25) / np.linalg.norm(d, axis=1)[:, None]
        z = np.sqrt(self.rho) * d @ self.spread.T
        v = self.value(z)
        return z[(v > 0) & (v < 1.02 * self.rho) & (np.abs((z @ self.t.T)[:, 2:4]).max(1) < 1.2)]

    def conditions(self, z: np.ndarray) -> np.ndarray:
        """Rows a of conditions a c <= 1 - margin."""
        u, m = self.worst(z), self.monomials(z)
        return ((m - self.monomials(self.after(z, u))) / DT + self.last * m) / self.rate(z, u)[:, None]


def trial(rho: float, margin: float, last: float, states: int, samples: int, rounds: int) -> None:
    """Fits V for one rho and prints how far it is."""
    fit, rng = Fit(rho, margin, last), np.random.default_rng(3)
    d = rng.normal(size=(states, 8))
    z = np.sqrt(1.8 * rho) * (d * rng.random((states, 1)) ** 0.2 / np.linalg.norm(d, axis=1)[:, None]) @ fit.spread.T
    cost = _optimal_costs(z @ fit.t.T, range(8))
    near = cost < 1.3 * rho
    z, cost = z[near], cost[near]
    m = fit.monomials(z) / cost[:, None]
    first = fit.c = np.linalg.lstsq(m, np.full(len(m), 1 - LOSS), rcond=1e-12)[0]
    print(f"rho {rho:g}: fitted to {len(z)} optima within {np.abs(m @ first / (1 - LOSS) - 1).max():.3f}", flush=True)
    gain, kept = m[cost < rho].mean(0), np.zeros((0, 8))
    for _ in range(rounds):
        new = fit.samples(samples, rng)
        left = fit.left(new, fit.worst(new))
        print(f"  least {left.min():.3f}, below the margin in {(left < margin).mean():.3%} of {len(new)}", flush=True)
        kept = np.concatenate([kept, new[left < 0.3]])
        a = fit.conditions(kept)
        a = a[a @ fit.c > 0.5]
        fit.c = solve(a, np.full(len(a), 1 - margin), gain, first, 3.0)
    new = fit.samples(4 * samples, rng)
    left = fit.left(new, fit.worst(new))
    share = fit.value(z[cost < rho]) / cost[cost < rho]
    x = new[left.argmin()] @ fit.t.T
    print(f"  V / optimal cost {share.min():.3f} to {share.max():.3f}, mean {share.mean():.3f}")
    below = f"below 0 in {(left < 0).mean():.4%}, below the margin in {(left < margin).mean():.3%}"
    print(f"  {len(new)} fresh samples: least {left.min():.3f}, {below}")
    print(f"  the worst state {x.round(2)}, V {fit.value(new[[left.argmin()]])[0]:.2f}", flush=True)


def main(
    rhos: tuple[float, ...] = (1.0, 2.0),
    margin: float = 0.05,
    last: float = 0.012,
    states: int = 20_000,
    samples: int = 40_000,
    rounds: int = 4,
) -> None:
    """Fits a bound for each rho.

    Args:
        rhos: V is fitted where it is below these.
        margin: by how much the inequality should hold, as a share of the cost rate.
        last: the last slope of the schedule, as in the planar bound.
        states: random states for whose optimal cost V is fitted first.
        samples: of each round of the linear program.
        rounds: of the linear program.
    """
    for rho in rhos:
        trial(rho, margin, last, states, samples, rounds)


if __name__ == "__main__":
    tyro.cli(main)
