"""Planar episodes of Stabilize by dynamic programming, which has no local optima, compared with `find_optimum`.

In a vertical plane the robot has four states and one force. The cost-to-go is computed on a grid of states by policy
iteration: each node holds the best force known, and the ratio of the cost-to-go to LQR's, which is 1 at rest. A sweep tries
other forces in each node for one control step of the env. Then the robot is simulated for `_LOOKAHEAD` steps under the forces
of the grid, and from there the cost-to-go counts, linear between nodes. So its interpolation counts once in that time. The
grid's axes are the principal axes of the motion of other optimal episodes, and it is larger than these.

Ratios beyond `_HIGHEST` are cut, and outside of the grid its edge counts. Both only lower the cost-to-go, so they cannot hide
a cheaper episode. The values of three grids are extrapolated to spacing 0. Besides, every episode is simulated under the
forces that the finest grid finds best.

It writes global_optimum.csv and global_optimum.png.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import tyro
from scipy.ndimage import map_coordinates

from ballbot_baselines import find_optimum
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import files
from ballbot_gym.robot import default_params
from ballbot_gym.tasks import TASKS

_PLANE = [0, 2, 4, 6]  # x, γ, ẋ, γ̇
_MARGIN = 1.2  # how much larger the grid is than the motions that span it
_HIGHEST = 3.0  # ratio to LQR's cost-to-go; 0.83 to 1.56 along optimal episodes
_SPANNING_EPISODES = 60
_SCANNED = 15  # forces from limit to limit
_SCAN_EVERY = 10  # sweeps
_LOOKAHEAD = 10  # control steps
_THREADS = 2

TASK, PARAMS = TASKS["stabilize"](), default_params()
LIMIT = PARAMS.force_limit
_GAIN, _LQR = discrete_lqr(TASK, PARAMS, np.zeros(8), np.zeros(2), np.zeros(0))
_GAIN, _LQR = _GAIN[0, _PLANE], _LQR[np.ix_(_PLANE, _PLANE)]


def starts(count: int, seed: int) -> np.ndarray:
    """(count, 8) states as Stabilize draws them, without what leads out of the plane of x."""
    rng = np.random.default_rng(seed)
    drawn = np.array([TASK.sample(rng, PARAMS)[0] for _ in range(count)])
    drawn[:, 1::2] = 0
    return drawn


def after(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(4, n) states one control step after x (4, n) under forces (n,)."""
    none = np.zeros_like(u)
    state = (x[0], none, x[1], none, x[2], none, x[3], none)
    dt = TASK.control_dt
    return np.stack(PARAMS.step(state, (u, none), dt, PARAMS.substeps(dt))[::2])


def step_cost(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """(n,) cost of a control step."""
    none = np.zeros_like(u)
    return TASK.control_dt * TASK.cost((x[0], none, x[1], none, x[2], none, x[3], none), (u, none), ())


def lqr_cost(x: np.ndarray) -> np.ndarray:
    """(n,) LQR's cost-to-go."""
    return np.einsum("in,ij,jn->n", x, _LQR, x)


def principal_axes(seed: int) -> np.ndarray:
    """(4, 4) the map from states to coordinates in which optimal planar episodes fill a box, and the grid [−1, 1]⁴."""
    motions = []
    for x0 in starts(_SPANNING_EPISODES, seed):
        x = find_optimum(TASK, PARAMS, x0, np.zeros(0)).trajectory.x
        if np.abs(x[:, 1]).max() < 1e-6:
            motions.append(x[:, _PLANE])
    moved = np.concatenate(motions)
    largest = np.abs(moved).max(0)
    axes = np.linalg.svd(moved / largest, full_matrices=False)[2] / largest
    return axes / (_MARGIN * np.abs(moved @ axes.T).max(0))[:, None]


class Grid:
    """The cost-to-go on n⁴ states, and the best force of each."""

    def __init__(self, axes: np.ndarray, n: int, coarser: "Grid | None" = None):
        """Args: n is odd; a coarser grid gives the values to start from."""
        self._axes, self._n = axes, n
        unit = np.linspace(-1, 1, n)
        # Turning the world takes a state to its negative, so half of the nodes tell all.
        nodes = np.stack(np.meshgrid(*[unit] * 4, indexing="ij")).reshape(4, -1)[:, : n**4 // 2 + 1]
        self._x = np.linalg.solve(axes, nodes)
        if coarser is None:
            self._u, ratio = np.clip(-_GAIN @ self._x, -LIMIT, LIMIT), np.ones(nodes.shape[1])
        else:
            self._u, ratio = coarser.force(self._x), coarser.ratio(self._x)
        self._set(ratio)

    def _set(self, ratio: np.ndarray) -> None:
        self._ratios, self._forces = (
            np.concatenate([half, sign * half[-2::-1]]).reshape([self._n] * 4)
            for half, sign in ((ratio, 1), (self._u, -1))
        )

    def _at(self, values: np.ndarray, x: np.ndarray) -> np.ndarray:
        places = (np.clip(self._axes @ x, -1, 1) + 1) * (0.5 * (self._n - 1))
        return map_coordinates(values, places, order=1, prefilter=False, mode="nearest")

    def ratio(self, x: np.ndarray) -> np.ndarray:
        """(n,) the cost-to-go of states (4, n), divided by LQR's."""
        return self._at(self._ratios, x)

    def force(self, x: np.ndarray) -> np.ndarray:
        """(n,) forces of the policy in states (4, n), N."""
        return self._at(self._forces, x)

    def cost_with(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """(n,) the cost-to-go of states (4, n) if u is held in the next step."""
        cost = step_cost(x, u)
        x = after(x, u)
        for _ in range(_LOOKAHEAD - 1):
            u = self.force(x)
            cost += step_cost(x, u)
            x = after(x, u)
        return cost + lqr_cost(x) * self.ratio(x)

    def best(self, x: np.ndarray) -> tuple[float, float]:
        """The best force of all in one state (4, 1), from limit to limit, then nearer and nearer; and the cost-to-go."""
        low, high, cost = -LIMIT, LIMIT, np.inf
        while high - low > 0.5:
            tried = np.linspace(low, high, 2 * _SCANNED)
            costs = self.cost_with(np.repeat(x, len(tried), 1), tried)
            best, cost = int(np.argmin(costs)), float(costs.min())
            low, high = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
        return 0.5 * (low + high), cost

    def iterate(self, sweeps: int, report: Callable[[int, float], None]) -> None:
        """Sweeps over all nodes; `report` gets the number of sweeps and the mean change of the last."""
        spread = 60.0  # N, between the best force so far and the others that are tried
        with ThreadPoolExecutor(_THREADS) as threads:
            parts = np.array_split(np.arange(len(self._u)), max(8 * _THREADS, len(self._u) // 10_000))
            for k in range(sweeps):
                scan = k % _SCAN_EVERY == 2
                swept = list(threads.map(lambda part: self._swept(part, spread, scan), parts))  # noqa: B023
                ratio, self._u = (np.concatenate(column) for column in zip(*swept, strict=True))
                ratio[-1] = 1.0  # at rest
                change = float(np.abs(ratio - self._ratios.ravel()[: len(ratio)]).mean())
                self._set(ratio)
                spread = max(8.0, 50.0 if scan else 0.7 * spread)
                report(k + 1, change)

    def _swept(self, part: np.ndarray, spread: float, scan: bool) -> tuple[np.ndarray, np.ndarray]:
        """New ratios of some nodes, with the best of three forces, and the parabola's force for the next sweep."""
        x, u = self._x[:, part], self._u[part]
        if scan:
            tried = [u, *np.broadcast_to(np.linspace(-LIMIT, LIMIT, _SCANNED)[:, None], (_SCANNED, len(u)))]
            costs = np.array([self.cost_with(x, force) for force in tried])
            u = np.array(tried)[costs.argmin(0), np.arange(len(u))]
        low, high = np.maximum(u - spread, -LIMIT), np.minimum(u + spread, LIMIT)
        here, lower, upper = (self.cost_with(x, force) for force in (u, low, high))
        best = np.minimum(np.minimum(here, lower), upper)
        with np.errstate(divide="ignore", invalid="ignore"):  # at a limit two of the forces are the same
            left, right = (lower - here) / (low - u), (upper - here) / (high - u)
            bend = (left - right) / (low - high)
            move = np.where(bend > 0, -(left - bend * (low - u)) / (2 * bend), np.nan)
        downhill = np.where(lower < here, low - u, np.where(upper < here, high - u, 0.0))
        move = np.where(np.isfinite(move), move, downhill)
        ratio = np.clip(best / np.maximum(lqr_cost(x), 1e-12), 0.5, _HIGHEST)
        return ratio, np.clip(u + np.clip(move, -2 * spread, 2 * spread), -LIMIT, LIMIT)


def simulated_cost(grid: Grid, x0: np.ndarray) -> float:
    """Of the episode under the grid's best forces; LQR's near rest."""
    x, cost = x0[_PLANE][:, None], 0.0
    for _ in range(TASK.steps):
        u = np.array([grid.best(x)[0]]) if lqr_cost(x)[0] > 1e-3 else -_GAIN @ x
        cost += float(step_cost(x, u)[0])
        x = after(x, u)
    return cost


def extrapolated(values: np.ndarray, sizes: tuple[int, ...]) -> tuple[np.ndarray, float]:
    """Values (starts,) at spacing 0 from values (grids, starts), and the power of the spacing with which the errors fall."""
    spacing = 1 / (np.array(sizes[-3:], float) - 1)
    changes = np.abs(np.diff(values[-3:] / values[-1], axis=0)).mean(1)
    powers = np.linspace(1, 6, 501)
    ratios = (spacing[0] ** powers - spacing[1] ** powers) / (spacing[1] ** powers - spacing[2] ** powers)
    power = float(powers[np.argmin(np.abs(ratios - changes[0] / changes[1]))])
    share = spacing[2] ** power / (spacing[1] ** power - spacing[2] ** power)
    return values[-1] + share * (values[-1] - values[-2]), power


def main(
    episodes: int = 50,
    sizes: tuple[int, ...] = (11, 17, 25, 33),
    sweeps: int = 25,
    seed: int = 7,
    out: Path = Path("runs/global_optimum"),
) -> None:
    """Compares both on planar starts.

    Args:
        episodes: starts.
        sizes: nodes along each axis of the grids; each starts from the one before.
        sweeps: over each grid.
        seed: of the starts.
        out: folder of the results.
    """
    axes = principal_axes(seed + 1)
    tested = starts(episodes, seed)
    optima = [find_optimum(TASK, PARAMS, x0, np.zeros(0)) for x0 in tested]
    aside = np.array([np.abs(optimum.trajectory.x[:, 1]).max() for optimum in optima])
    cost = np.array([optimum.cost for optimum in optima])
    flat = aside < 1e-6  # where leaving the plane pays, the plane's optimum costs more
    values, grid = [], Grid(axes, sizes[0])
    for n in sizes:
        began = time.perf_counter()
        if values:
            grid = Grid(axes, n, grid)
        grid.iterate(sweeps, _progress(n))
        values.append(np.array([grid.best(x0[_PLANE][:, None])[1] for x0 in tested]))
        print(f"{n}^4 nodes, {time.perf_counter() - began:.0f} s: {_difference((values[-1] / cost - 1)[flat])}")
    limit, power = extrapolated(np.array(values), sizes)
    off = (limit / cost - 1)[flat]
    print(
        f"extrapolated with the power {power:.1f}: {np.abs(off).mean():.2%} on average, {np.abs(off).max():.2%} at most"
    )
    simulated = np.array([simulated_cost(grid, x0) for x0 in tested])
    print(f"the grid's forces, simulated: {_difference((simulated / cost - 1)[flat])}")
    for ratio in (simulated / cost)[~flat]:
        print(f"an optimum leaves the plane; the grid's episode in it costs {ratio:.3f} times as much")
    rows = [
        {
            "x": x0[0],
            "gamma": x0[2],
            "speed": x0[4],
            "lean_rate": x0[6],
            "optimum": cost[i],
            "leaves_plane": int(not flat[i]),
            **{f"grid_{n}": values[k][i] for k, n in enumerate(sizes)},
            "extrapolated": limit[i],
            "simulated": simulated[i],
        }
        for i, x0 in enumerate(tested)
    ]
    files.write_csv(out / "global_optimum.csv", rows)
    _draw(cost, np.array(values), limit, simulated, sizes, flat, out / "global_optimum.png")


def _difference(off: np.ndarray) -> str:
    return f"{np.abs(off).mean():.3%} off on average, from {off.min():.3%} to {off.max():.3%}"


def _progress(n: int) -> Callable[[int, float], None]:
    def report(sweep: int, change: float) -> None:
        if sweep % 5 == 0:
            print(f"{n}^4 nodes, sweep {sweep}: ratios change by {change:.1e} on average", flush=True)

    return report


def _draw(
    cost: np.ndarray,
    values: np.ndarray,
    limit: np.ndarray,
    simulated: np.ndarray,
    sizes: tuple[int, ...],
    flat: np.ndarray,
    path: Path,
) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    order = np.flatnonzero(flat)[np.argsort(cost[flat])]
    for n, value in zip(sizes, values, strict=True):
        axis.plot(cost[order], 100 * (value / cost - 1)[order], ".", ms=4, label=f"{n}⁴ nodes")
    axis.plot(cost[order], 100 * (limit / cost - 1)[order], "kx", ms=5, label="extrapolated")
    axis.plot(cost[order], 100 * (simulated / cost - 1)[order], "k+", ms=5, label="its forces, simulated")
    axis.axhline(0, color="k", lw=0.6)
    axis.set(xscale="log", xlabel="certified optimum", ylabel="dynamic programming, % more", ylim=(-1, 6))
    axis.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
