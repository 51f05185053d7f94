"""What every search of an optimum returns."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ballbot_baselines.solvers.ocp import Solution
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Moving, Trajectory


def _no_feedback() -> np.ndarray:
    raise ValueError("the gains of this optimum are not known; TvlqrController.for_task makes a feedback about it")


@dataclass(frozen=True, repr=False)
class Optimum(Moving):
    """The best motion that a search found: its cost, its trajectory, and how the solver ended.

    | field | meaning |
    |---|---|
    | `cost` | of the whole episode, or of the paper's problem |
    | `trajectory` | of n control steps with forces held; the paper's problems have linear forces |
    | `status` | "optimal" if the solver converged, else "feasible": within all limits, but its cost may not be minimal |
    | `solver_status` | how the solver ended, in its own words |
    | `violation` | largest amount by which a constraint is missed, SI units |
    | `iterations` | of the solver; 0 where it does not count them |
    | `solver` | "fatrop", "ipopt", "ilqr", or "simulation" |
    | `seconds` | wall time of the whole search; of many episodes, the share of one |
    | `slopes` | (n+1, 8) derivatives of the cost to go with respect to x_0 … x_n |
    | `markers` | what the task draws |
    | `gains` | (n, 2, 8) K of the feedback u − K (x' − x) about the optimum, N per unit of the state |

    Slopes are 0 for a simulated episode. They are NaN where they are not known: in the goal of an optimum that iLQR found,
    and for the paper's problems. Gains are the derivative of the optimal force where iLQR found the optimum, and TVLQR's
    otherwise.
    With wheels there are 11 states and 3 forces.
    """

    cost: float
    trajectory: Trajectory
    status: Literal["optimal", "feasible"]
    solver_status: str
    violation: float
    iterations: int
    solver: str
    seconds: float
    slopes: np.ndarray
    markers: tuple[Marker, ...] = ()
    feedback: Callable[[], np.ndarray] = _no_feedback
    """Computes `gains`. It takes as long as a part of the search, so it is called at the first use of `gains`."""

    @classmethod
    def of(cls, solution: Solution, trajectory: Trajectory, seconds: float, **more: Any) -> "Optimum":
        """A solution of fatrop, ipopt or a simulation that is within its limits; `more` are further fields."""
        return cls(
            cost=solution.cost,
            trajectory=trajectory,
            status="optimal" if solution.is_optimal else "feasible",
            solver_status=solution.status,
            violation=solution.violation,
            iterations=solution.iterations,
            solver=solution.solver,
            seconds=seconds,
            **more,
        )

    def facts(self) -> dict[str, str]:
        return {"cost": f"{self.cost:.4g}", "status": self.status, "found in": f"{self.seconds:.2f} s"}

    @property
    def is_optimal(self) -> bool:
        """Whether the solver converged."""
        return self.status == "optimal"

    @cached_property
    def gains(self) -> np.ndarray:
        return self.feedback()
