"""Whether a task's formulas can be optimized: differentiable, smooth and finite, with costs that are not negative."""

from collections.abc import Callable
from typing import Any

import casadi
import numpy as np

from ballbot_gym.robot import Kind, Robot
from ballbot_gym.tasks import Task

_SEGMENTS, _POINTS = 32, 401  # straight lines through states near starts, and points of each
_REACH, _TURN = 2.0, 0.5  # how far lines lead from starts, SI units; and of angles, rad
_SMOOTH = 1e-3  # of its range: how much a quantity may differ from the integral of its slope, between two points
_ADVICE = (
    "Compute with + - * / ** and the functions of ballbot_gym.ops on ops.components of x, u and c; not with if, float() "
    "or math"
)

_checked: set[tuple[Task, Kind]] = set()


def check_formulas(task: Task, params: Robot) -> None:
    """Checks cost, margins and goal of a task near some of its starts, once for every kind of robot.

    Raises:
        ValueError: a method cannot be differentiated by CasADi, jumps, has a kink, or is not finite, or a cost is negative.
    """
    if (task, params.kind) not in _checked:
        _check(task, params)
        _checked.add((task, params.kind))


def _check(task: Task, params: Robot) -> None:
    rng = np.random.default_rng(0)
    starts = [task.sample(rng, params) for _ in range(_SEGMENTS)]
    x = np.stack([x for x, _ in starts])
    towards = rng.uniform(-1, 1, x.shape) * [_TURN if each.unit == "rad" else _REACH for each in params.STATE]
    u = rng.uniform(-1, 1, (_SEGMENTS, params.action_size)) * params.force_limit
    at_times = rng.uniform(0, task.duration, _SEGMENTS)
    c = np.stack([task.at(c, np.float64(t)) for (_, c), t in zip(starts, at_times, strict=True)])
    share = np.linspace(0, 1, _POINTS)
    methods: dict[str, Callable[[Any, Any, Any], tuple[Any, ...]]] = {
        "cost": lambda x, u, c: (task.cost(x, u, c),),
        "margins": lambda x, u, c: task.margins(x, c),
        "goal": lambda x, u, c: task.goal(x, c),
    }
    for name, method in methods.items():
        along = _along(task, name, method, x.shape[1], u.shape[1], c.shape[1])
        for k in range(_SEGMENTS):
            values, slopes, bends = np.array(along(x[k], towards[k], u[k], c[k], share[None])).reshape(3, -1, _POINTS)
            start = f"x = {np.round(x[k], 3).tolist()}, c = {np.round(c[k], 3).tolist()}"
            if not np.isfinite(values[:, 0]).all():
                raise ValueError(f"{task.id}: {name} is not finite at the start {start}. {_ADVICE}")
            if name == "cost" and values[0, 0] < 0:
                raise ValueError(
                    f"{task.id}: cost is {values[0, 0]:g} at the start {start}; it must not be negative, because regret "
                    "divides by the optimal cost. Add a constant to it"
                )
            kinds = [("jumps", values, slopes), ("has a kink", slopes, bends)]
            for what, one, slope in () if task.pieces else kinds:
                if _breaks(one, slope):
                    raise ValueError(
                        f"{task.id}: {name} {what} near {start}, and optimizers need slopes that change gradually. Blend "
                        "steps over some width, and write sqrt(d² + w²) instead of |d|"
                    )


def _along(
    task: Task, name: str, method: Callable[..., tuple[Any, ...]], states: int, forces: int, constants: int
) -> casadi.Function:
    """From a state, a direction, forces and constants to a method's values, slopes and bends at shares of the line."""
    x, towards, u = (casadi.SX.sym(name, count) for name, count in (("x", states), ("towards", states), ("u", forces)))
    c, s = casadi.SX.sym("c", constants), casadi.SX.sym("s")
    try:
        values = casadi.vertcat(*method(x + s * towards, s * u, c))
        slopes = casadi.jtimes(values, s, casadi.SX(1))
        return casadi.Function(
            name, [x, towards, u, c, s], [casadi.vertcat(values, slopes, casadi.jtimes(slopes, s, 1))]
        )
    except Exception as error:  # users' code may raise any error when it gets a symbol
        raise ValueError(f"{task.id}: {name} cannot be differentiated ({error}). {_ADVICE}") from error


def _breaks(values: np.ndarray, slopes: np.ndarray) -> bool:
    """Whether a quantity changes between two points by more than its slopes explain."""
    expected = 0.5 * (slopes[:, 1:] + slopes[:, :-1]) / (values.shape[1] - 1)
    off = np.abs(np.diff(values) - expected)
    allowed = _SMOOTH * np.ptp(values, axis=1, keepdims=True) + 1e-9 * (1 + np.abs(values[:, 1:]))
    return bool((np.isfinite(off) & (off > allowed)).any())
