"""Certified optima as strict local minima: the forces of the certified set, or of a search where the set has none.

A set has the forces of its first episodes alone; those of the others are searched again, and their costs are compared.
Distances between forces are shares of the force limit, so of actions in [−1, 1].
"""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ballbot_baselines.optimum.certification import _motion_again
from ballbot_baselines.optimum.find import find_optima
from ballbot_baselines.proofs.local_minimum import _NotProvenError, _Problem, _prove
from ballbot_baselines.proofs.stationary import _stationary
from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, named_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.trajectory import Trajectory

NEAR = 5e-6
"""Largest distance of a minimum from the stored forces: five times the reserve that the solvers keep from a goal."""
SAME_COST = 1e-5
"""Largest difference between a stored cost and that of the minimum: what these reserves cost is less."""
_BELOW = 1e-9  # by which a stored cost may be too low, from rounding and the tolerance of solvers


def _enclosed(problem: _Problem, motion: Trajectory, cost: float, stored: bool = True) -> dict[str, Any]:
    """Proves that there is a strict local minimum near a motion, of nearly this cost.

    Args:
        problem: the episode.
        motion: states and forces.
        cost: the certified cost.
        stored: whether the forces are those of the certificate, so that the minimum must be near them.

    Raises:
        ArithmeticError: it could not be proven; the message names the hypothesis that fails.
    """
    point, linear = _stationary(problem, motion.x, motion.u)
    found = _prove(problem, point, linear)
    limit = problem.robot.force_limit
    distance = float((np.abs(point.u - motion.u) + found.radius).max()) / limit
    if stored and not distance < NEAR:
        raise _NotProvenError(f"the minimum is {distance:.2g} of the force limit away from the stored forces")
    above = cost - found.low
    if not -_BELOW < above < SAME_COST:
        raise _NotProvenError(f"the minimum costs {found.low:.9g}, and not the certified {cost:.9g}")
    return {
        "radius": float(found.radius.max()) / limit,
        "distance": distance if stored else None,
        "cost": found.low,
        "cost_width": found.high - found.low,
        "stored_above": above,
        "rounding": found.rounding,
        "forces_at_bound": int(point.fixed.sum()),
        "active_constraints": len(point.rows),
        "least_multiplier": float(point.mu.min()) if point.rows else None,
    }


def _lines(name: str, indices: Sequence[int]) -> Iterator[dict[str, Any]]:
    """A line for each of some episodes of a task."""
    task, robot = make_task(name, PAPER), named_robot(PAPER)
    known = certified.load(task, robot)
    others = [i for i in indices if i >= len(known.trajectories)]
    searched = find_optima(task, robot, known.states[others], known.constants[others]) if others else []
    found = dict(zip(others, searched, strict=True))
    for i in indices:
        began, cost, stored = time.perf_counter(), float(known.costs[i]), i < len(known.trajectories)
        line: dict[str, Any] = {"task": name, "episode": i, "proven": 0, "why_not": ""}
        try:
            motion = known.trajectories[i] if stored else _motion_again(task, robot, known, i, found[i], SAME_COST)
            line |= _enclosed(_Problem(task, robot, tuple(known.constants[i].tolist())), motion, cost, stored)
            line["proven"] = 1
        except (ArithmeticError, PlanError) as error:
            line["why_not"] = str(error)
        yield line | {"seconds": time.perf_counter() - began}


def _summary(name: str, rows: Sequence[dict[str, Any]]) -> str:
    """What was proven of a task, and which episodes were not."""
    proven = [row for row in rows if row["proven"]]
    parts = [f"{name}: {len(proven)} of {len(rows)} minima enclosed, {sum(row['seconds'] for row in rows):.0f} s"]
    if proven:
        near = [row["distance"] for row in proven if row["distance"] is not None]
        above = [abs(row["stored_above"]) for row in proven]
        parts += [
            f"radius at most {max(row['radius'] for row in proven):.1e} of the force limit; {sum(d < 1e-6 for d in near)} of "
            f"{len(near)} within 1e-6 of stored forces, the farthest {max(near, default=0.0):.1e}",
            f"cost enclosed to {max(row['cost_width'] for row in proven):.1e}; {sum(a < 1e-9 for a in above)} stored costs "
            f"within 1e-9 of it, the farthest {max(above):.1e} away",
            f"a step of the environment is rounded by at most {max(row['rounding'] for row in proven):.1e}",
        ]
    parts += [f"episode {row['episode']}: {row['why_not']}" for row in rows if not row["proven"]]
    return "\n  ".join(parts)
