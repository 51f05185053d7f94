"""A lower bound of the cost of planar episodes of Stabilize, for two fifths of its planar starts.

`ballbot prove --planar` proves it. The theorem is at the top of `proofs/planar_bound.c`, and its numbers are in
`lower_bound.json`.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym.robot import PAPER, Robot, named_robot
from ballbot_gym.tasks import Stabilize, Task

_STORED = Path(__file__).with_name("lower_bound.json")
_FREE = ("duration", "survival_reward", "start_position", "start_lean", "start_speed", "start_lean_rate")
"""Fields of Stabilize that may have any value: of steps there may be any number, and no cost depends on the other ones."""


@dataclass(frozen=True)
class PlanarBound:
    """A polynomial V and a schedule a_k, which bound the cost of successful episodes from below.

    In a vertical plane states are x = (position, lean, speed, lean rate), in m, rad, m/s and rad/s.
    """

    t: list[list[float]]
    """(4, 4) upper triangular: states x are T z. V is only used where zᵀz is at most 1."""
    gain: list[float]
    """(4,) forces are near gain · z. Any numbers are right; good ones save boxes."""
    exponents: list[list[int]]
    """(m, 4) of the monomials of V in z, of degree 2, 4, 6 or 8."""
    coefficients: list[float]
    """(m,) of these monomials."""
    rho: float
    """The bound holds where V < rho."""
    delta: float
    """V is at most this in the goal."""
    knots: list[tuple[float, float]]
    """(a, r): the schedule a_k, by its slopes at some a. The last a is 1."""

    @classmethod
    @cache
    def stored(cls) -> "PlanarBound":
        """The proven bound that comes with the package.

        Raises:
            ValueError: the file is not as it was written.
        """
        numbers = json.loads(_STORED.read_text(encoding="utf-8"))
        said, found = numbers.pop("sha256", None), _digest(numbers)
        if said != found:
            raise ValueError(
                f"{_STORED} was changed: the SHA-256 of its numbers is {found}, and the file says {said}. Install the "
                "package again; or, to check other numbers, write the file with `benchmarks/planar_bound.py`"
            )
        return cls(**numbers)

    def text(self) -> str:
        """The content of `lower_bound.json`: all numbers, and their SHA-256."""
        numbers = asdict(self)
        return json.dumps(numbers | {"sha256": _digest(numbers)}) + "\n"

    def of_episode(self, task: Task, robot: Robot, x0: np.ndarray) -> float:
        """The least cost of a successful motion in the vertical plane of its start.

        Args:
            task: the problem.
            robot: the robot.
            x0: (8,) initial state.

        Returns:
            The bound. NaN where none is proven: for other problems than Stabilize of the paper's robot, for starts that are
            farther from rest, and for those outside of the vertical planes through the x and the y axis.
        """
        given = {name: getattr(task, name, None) for name in _FREE}
        if None in given.values() or replace(Stabilize(), **given) != task or robot != named_robot(PAPER):
            return float("nan")
        planes = x0[::2], x0[1::2]
        plane = next((p for p, other in zip(planes, planes[::-1], strict=True) if not np.any(other)), None)
        least = float("nan") if plane is None else float(self.bound(plane[None], task.steps)[0])
        return least if least > 0 else float("nan")

    def value(self, x: np.ndarray) -> np.ndarray:
        """(n,) V of planar states (n, 4), rounded."""
        return np.prod(self._z(x)[:, :, None] ** np.array(self.exponents).T[:, None], 0) @ np.array(self.coefficients)

    def bound(self, x: np.ndarray, steps: int) -> np.ndarray:
        """(n,) lower bounds of the cost of successful episodes of some steps from planar states (n, 4).

        NaN where none is proven.
        """
        v, a, z = self.value(x), self.schedule(steps), self._z(x)
        bound = np.maximum(a * v, v - self.delta)
        inside = (np.sum(z**2, 0) < 1) & (v < self.rho) & (bound <= self.rho - self.delta)
        return np.where(inside, bound, np.nan)

    def until(self) -> list[float]:
        """For each knot, below which V the inequality is needed with it: δ/(1 − a) for the largest a that can follow it."""
        ahead = [a for a, _ in self.knots[1:]] + [1.0]
        following = [a + self._dt() * max(r for _, r in self.knots) + 1e-9 for a in ahead]
        return [self.delta / (1 - a) * (1 + 1e-9) if a < 1 else float("inf") for a in following]

    def schedule(self, steps: int) -> float:
        """a_n for n steps, rounded down."""
        slopes, a = np.array(self.knots), 0.0
        for _ in range(steps):
            a = min(1.0, a + self._dt() * float(np.interp(a, slopes[:, 0], slopes[:, 1])) * (1 - 1e-12))
        return a - 1e-9 * (a < 1)

    def _z(self, x: np.ndarray) -> np.ndarray:
        """(4, n) of planar states (n, 4)."""
        return np.linalg.solve(np.array(self.t), x.T)

    def _dt(self) -> float:
        return Stabilize().control_dt


def _digest(numbers: dict[str, Any]) -> str:
    """SHA-256 of the numbers of a bound."""
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()
