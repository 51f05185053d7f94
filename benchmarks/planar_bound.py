"""Fits the lower bound of the cost of planar Stabilize that `ballbot prove --planar` checks, and measures it.

Nobody has to trust the fit: it makes `lower_bound.json`, and the check proves what that file says. V is an even
polynomial in z. In samples (z, u) it should obey (V(F(z, u)) − V(z))/dt + l(z, u) = margin · l(z, u) for the worst force u.
A fit by least squares for given forces, and the worst forces of that fit, are computed in turn.

It writes lower_bound.json. It prints how much the inequality leaves in fresh samples, what share of the task's planar
starts the bound covers, and what share of the optimal cost it is in random states.
"""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from scipy.linalg import eigh

from ballbot_baselines import PlanarBound, find_optima
from ballbot_baselines.proofs.planar_bound import _in_goal
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import files
from ballbot_gym.robot import PAPER, named_robot
from ballbot_gym.tasks import Stabilize

_PLANE = [0, 2, 4, 6]  # position, lean, speed and lean rate of a state
TASK, ROBOT = Stabilize(), named_robot(PAPER)
COST = np.array([TASK.position_weight, *[TASK.rest_weight] * 3])
KNOTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
LARGEST_FORCE = 400.0  # N, of the worst ones that a fit tries


class Fit:
    """V = Σ cᵢ mᵢ(z), with x = T z and LQR's cost rate near zᵀz."""

    def __init__(self, degree: int, margin: float):
        gain, cost = discrete_lqr(TASK, ROBOT, np.zeros(8), np.zeros(2), np.zeros(0))
        self.gain, self.cost = gain[0, _PLANE], cost[np.ix_(_PLANE, _PLANE)]
        rate = np.diag(COST) + TASK.effort_weight * np.outer(self.gain, self.gain)
        self.t = np.round(np.linalg.inv(np.linalg.cholesky(rate).T), 4)
        self.inverse, self.margin = np.linalg.inv(self.t), margin
        grid = itertools.product(range(degree + 1), repeat=4)
        self.exponents = np.array(
            sorted((e for e in grid if sum(e) in range(2, degree + 1, 2)), key=lambda e: (sum(e), e))
        )
        self.c = np.zeros(len(self.exponents))
        lqr = self.t.T @ self.cost @ self.t
        for i, e in enumerate(self.exponents):
            if e.sum() == 2:
                a, b = np.repeat(np.arange(4), e)
                self.c[i] = (1 - margin) * lqr[a, b] * (1 if a == b else 2)

    def monomials(self, z: np.ndarray) -> np.ndarray:
        """(n, m) of z (n, 4)."""
        powers = z[:, :, None] ** np.arange(self.exponents.max() + 1)
        return np.prod([powers[:, i, self.exponents[:, i]] for i in range(4)], 0)

    def after(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n, 4) one control step after z under forces u (n,)."""
        x, none = (z @ self.t.T).T, np.zeros_like(u)
        state = (x[0], none, x[1], none, x[2], none, x[3], none)
        return np.stack(ROBOT.step(state, (u, none), TASK.control_dt)[::2], 1) @ self.inverse.T

    def step_cost(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n,) cost of a control step."""
        return TASK.control_dt * (np.square(z @ self.t.T) @ COST + TASK.effort_weight * u**2)

    def worst(self, z: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n,) forces of least V(F) + l dt, by Newton's method from u with differences of 2 N."""

        def total(u: np.ndarray) -> np.ndarray:
            return self.monomials(self.after(z, u)) @ self.c + self.step_cost(z, u)

        h = 2.0
        for _ in range(6):
            low, middle, high = total(u - h), total(u), total(u + h)
            bend = np.maximum((low + high - 2 * middle) / h**2, 1e-5)
            u = np.clip(u - np.clip((high - low) / (2 * h) / bend, -100, 100), -LARGEST_FORCE, LARGEST_FORCE)
        return u

    def samples(self, count: int, rho: float, seed: int) -> np.ndarray:
        """(count, 4) states about rest where LQR's cost is at most rho, in all directions."""
        rng = np.random.default_rng(seed)
        d = rng.normal(size=(count, 4))
        d *= (np.sqrt(rho) * rng.random(count) ** 0.5 / np.linalg.norm(d, axis=1))[:, None]
        return np.linalg.solve(np.linalg.cholesky(self.cost).T, d.T).T @ self.inverse.T

    def improve(self, rho: float, count: int, rounds: int, spread: float, from_lqr: bool) -> None:
        """Fits V in {V < 1.15 rho}, and loosely in a larger set, in rounds.

        Samples in which the last round missed the margin by far count more in the next one.

        Args:
            rho: as in `main`.
            count: of the samples.
            rounds: of the fit.
            spread: LQR's cost in the samples is up to this times rho.
            from_lqr: whether V is still LQR's, which says little of where V is small.
        """
        near = self.samples(600, 1.6e-4, 3), self.samples(600, 0.1 * rho, 4)
        z = np.concatenate([self.samples(count, spread * rho, 1), *near])
        u, boost = -(z @ self.t.T @ self.gain), np.ones(len(z))
        for n in range(rounds):
            u = self.worst(z, u)
            m = self.monomials(z)
            rows = (m - self.monomials(self.after(z, u))) / self.step_cost(z, u)[:, None]
            inside = m @ self.c < 1.15 * rho
            if n:
                missed = np.abs(1 - rows @ self.c - self.margin) / 0.02 - 1
                boost = np.clip(boost * np.where(inside, 1 + 2 * np.clip(missed, -0.15, 2), 1), 0.3, 30)
            weight = np.where(inside | (from_lqr and n < 2), 1.0, 0.1) * np.sqrt(boost)
            size, wanted = np.abs(rows).max(0), (1 - self.margin) * weight
            self.c = np.linalg.lstsq(weight[:, None] * rows / size, wanted, rcond=1e-13)[0] / size

    def left(self, rho: float) -> np.ndarray:
        """((V(F) − V)/dt + l)/l at the worst force, in fresh samples of {V < rho}."""
        z = self.samples(4000, 2.2 * rho, 9)
        z = z[self.monomials(z) @ self.c < rho]
        u = self.worst(z, -(z @ self.t.T @ self.gain))
        return (self.monomials(self.after(z, u)) - self.monomials(z)) @ self.c / self.step_cost(z, u) + 1

    def slopes(self, share: float) -> list[tuple[float, float]]:
        """The knots of the schedule: a share of what LQR's cost allows in the linear robot."""
        bend, out = TASK.effort_weight * np.outer(self.gain, self.gain), []
        for a in KNOTS:
            of_lqr = a * (1 - self.margin)
            rate = float(eigh(of_lqr * bend + np.diag(COST), self.cost, eigvals_only=True)[0])
            out.append((a, round(share * (1 - of_lqr) * rate / (1 - self.margin), 4)))
        return out


def measure(certificate: PlanarBound, count: int) -> None:
    """Prints which share of the optimal cost the bound is, in random states, and how many planar starts it covers."""
    rng, a = np.random.default_rng(5), certificate.schedule(TASK.steps)
    most = (certificate.rho - certificate.delta) / a
    x0 = np.zeros((200_000, 8))
    limits = (TASK.start_position, TASK.start_lean, TASK.start_speed, TASK.start_lean_rate)
    x0[:, _PLANE] = rng.uniform(-1, 1, (len(x0), 4)) * limits
    covered = np.isfinite(certificate.bound(x0[:, _PLANE], TASK.steps))
    print(f"covers {covered.mean():.3%} of the task's planar starts: those where V is at most {most:.4f}")
    fit = Fit(2, 0.0)
    x0 = np.zeros((20 * count, 8))
    x0[:, _PLANE] = fit.samples(len(x0), 2 * most, 6) @ fit.t.T
    bound = certificate.bound(x0[:, _PLANE], TASK.steps)
    inside = np.flatnonzero(np.isfinite(bound))[:count]
    x0, bound = x0[inside], bound[inside]
    found = find_optima(TASK, ROBOT, x0, np.zeros((len(x0), 0)))
    ratio = np.array([b / o.cost for b, o in zip(bound, found, strict=True) if o is not None])
    print(
        f"bound / optimal cost in {len(ratio)} random states: {ratio.min():.4f} to {ratio.max():.4f}, mean {ratio.mean():.4f}"
    )


def main(
    degree: int = 8,
    rho: float = 1.0,
    margin: float = 0.05,
    outer: float = 2.5,
    share: float = 0.6,
    speed: float = 0.8,
    samples: int = 7000,
    rounds: int = 7,
    states: int = 200,
    out: Path = Path("runs/lower_bound.json"),
) -> None:
    """Fits the bound.

    Args:
        degree: of V.
        rho: V is fitted where it is below this.
        margin: by how much the inequality should hold, as a share of the cost rate.
        outer: V is used where its quadratic part is at most this times rho.
        share: V is at least this share of its quadratic part.
        speed: of the schedule of the last seconds, as a share of what the linear robot allows.
        samples: of the fit.
        rounds: of the fit, twice: from LQR's cost, and then from that fit in more samples.
        states: random ones for which the optimum is computed; 0 for none.
        out: the certificate.
    """
    fit = Fit(degree, margin)
    fit.improve(rho, samples, rounds, 2.0, from_lqr=True)
    fit.improve(rho, samples, rounds, 2.4, from_lqr=False)
    certificate = PlanarBound(
        t=fit.t.tolist(),
        gain=np.round(-fit.gain @ fit.t, 3).tolist(),
        exponents=fit.exponents.tolist(),
        coefficients=[float(f"{c:.7g}") for c in fit.c],
        rho=rho,
        outer=outer * rho,
        share=share,
        delta=1.0,
        knots=fit.slopes(speed),
    )
    certificate = replace(certificate, delta=float(np.ceil(1e4 * float(sum(_in_goal(certificate)))) / 1e4))
    fit.c = np.array(certificate.coefficients)
    left = fit.left(rho)
    print(f"the inequality leaves {left.min():.4f} to {left.max():.4f} of the cost rate in {len(left)} samples")
    print(f"delta {certificate.delta}, a {certificate.schedule(TASK.steps):.4f} of V")
    files.write(out, certificate.text())
    if states:
        measure(certificate, states)


if __name__ == "__main__":
    tyro.cli(main)
