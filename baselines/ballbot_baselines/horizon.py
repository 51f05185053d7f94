"""The horizon of model predictive control: its grid in time, and the quadratic program of one iteration.

The horizon's intervals are whole numbers of control steps. The first is one step, because the env holds its force that long.
Where there are more control steps than nodes, the later intervals hold theirs longer.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import casadi
import numpy as np

from ballbot_baselines.compiled import LANES, LONG, SIMD, InPlace, in_lanes
from ballbot_baselines.disturbance import DisturbanceEstimator
from ballbot_baselines.shooting import RobotKind, robot_numbers
from ballbot_gym import dynamics
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task

_SLACK_PRICE = 100.0  # per unit of violation of a margin at a node: more than any violation saves
_SLACK_CURVATURE = 100.0  # keeps the program strictly convex, and HPIPM at few iterations
_MARGINS = 2  # considered per node: the least ones. The others are far from violated, and each costs time
_GRIP_UNIT = 0.1  # of `dynamics.limits`; this much costs as much as a unit of a margin
_LEAST_CURVATURE = 1e-6  # of the cost in every input, because an interval of length 0 has no cost
_RESIDUAL = 1e-4  # of the quadratic program, in states' SI units and fractions of the force
_QP_ITERATIONS = 30


class _Places(NamedTuple):
    """Where things stand in the arrays of an inner stage, for states of n components and inputs of m."""

    # Variables: changes of the state and of the input, and the slack of margins and grip.
    x: slice
    a: slice
    slack: int
    # Its Hessian, one dense block after the other: of the state (n, n), of the input (m, m), of the slack.
    q: slice
    r: slice
    of_slack: int
    # Its constraints: the gap to the next state, then the margins, then the limits of the robot's grip.
    gap: slice
    limits: slice
    # Column of a state in the constraints' matrix: −1 in the gap of the stage before, the slopes of the next state, and the
    # slopes of the margins and of the grip.
    next: slice
    slopes: slice

    @classmethod
    def of(cls, n: int, m: int) -> "_Places":
        squares, rest = (slice(0, n * n), slice(n * n, n * n + m * m), n * n + m * m), slice(n, None)
        return cls(
            slice(0, n), slice(n, n + m), n + m, *squares, slice(0, n), rest, slice(1, n + 1), slice(n + 1, None)
        )


@dataclass(frozen=True)
class Grid:
    """The horizon in control steps: node j lies `offsets[j]` after now, (N+1,); interval j is `lengths[j]` long, (N,)."""

    lengths: np.ndarray
    offsets: np.ndarray

    @classmethod
    def make(cls, steps: int, nodes: int) -> "Grid":
        """`nodes` intervals over a number of control steps: the first one step, the rest as equal as can be.

        Raises:
            ValueError: fewer than 2 nodes, or fewer control steps than nodes.
        """
        if not 2 <= nodes <= steps:
            raise ValueError(f"a horizon of {steps} control steps takes 2 to {steps} nodes, not {nodes}")
        base, longer = divmod(steps - 1, nodes - 1)
        lengths = np.array([1] + [base] * (nodes - 1 - longer) + [base + 1] * longer)
        return cls(lengths, np.concatenate([[0], np.cumsum(lengths)]))

    def shift_states(self) -> np.ndarray:
        """(N+1, N+1) takes values at the nodes to the values one control step later, linear between, constant beyond."""
        return np.array([np.interp(self.offsets + 1, self.offsets, unit) for unit in np.eye(len(self.offsets))]).T

    def shift_inputs(self) -> np.ndarray:
        """(N, N) takes values held over the intervals to their means one control step later; beyond the end they are 0."""
        held = np.repeat(np.eye(len(self.lengths)), self.lengths, axis=0)  # (steps, N)
        later = np.vstack([held[1:], np.zeros((1, len(self.lengths)))])
        return np.add.reduceat(later, self.offsets[:-1], axis=0) / self.lengths[:, None]


class _Stages:
    """An array of the solver; parts of it belong to the first stage, to the inner stages (count, width), and to the last."""

    def __init__(self, first: int, count: int, width: int, last: int, value: float = 0.0):
        end = first + count * width
        self.all = np.full(end + last, value)
        self.first, self.last = self.all[:first], self.all[end:]
        self.inner = self.all[first:end].reshape(count, width)


class HorizonQp:
    """The quadratic program of one iteration, for N intervals; arrays are allocated once and filled in place.

    Variables are changes δa_0, δx_1, δa_1, s_1, … δx_N: x_0 is known and no variable, inputs a are fractions of the force
    limit. (Changes, because HPIPM starts from 0.) Constraints of stage j are its dynamics, then its margins, then the limits
    of the robot's grip, if it has any; then there is an s_0 too. The last stage has no margins, because CasADi's interface
    allows no slack there.

    | attribute | shape | meaning |
    |---|---|---|
    | `x`, `a` | (N+1, 8), (N+1, 2) | where to linearize, and after `iterate` the solution; the last input is unused |
    | `h`, `c` | (N+1,), (N+1, nc) | length of each interval, s, and the constants `at` its time |
    | `reserve` | (N+1,) | of normal force, as a fraction of the weight, where the robot's grip is limited |
    | `distinct` | (m,) | indices of the task's margins that are considered |
    | `disturbance` | | what is added to the model; None for nothing |
    | `curvature` | (N,) | of the friction cone in the inputs, by the multipliers of the last program; 0 before the first |
    """

    def __init__(self, task: Task, kind: RobotKind, nodes: int):
        """Differentiates the stage and builds the solver; compiles on first use on a machine. `set_robot` must follow."""
        self._states, self._inputs = kind.states, kind.inputs
        self._at = _Places.of(self._states, self._inputs)
        count = len(task.margins((0.0,) * self._states, (1.0,) * (len(task.constant_names) + task.clock)))
        self.distinct = np.arange(count)
        self.disturbance: DisturbanceEstimator | None = None
        self.curvature = np.zeros(nodes)
        self._margins = min(count, _MARGINS)
        self._make_stage(task, kind, nodes, count)
        self._make_program(nodes, self._margins, 2 * kind.grips)

    def _make_stage(self, task: Task, kind: RobotKind, n: int, m: int) -> None:
        states, forces, grips = self._states, self._inputs, 2 * kind.grips
        variables = states + forces
        blocks = -(-n // LANES)  # of intervals; the last one is filled up with zeros
        computed = slice(0, blocks * LANES)

        def rows(*shape: int) -> np.ndarray:
            return np.zeros((max(n + 1, computed.stop), *shape))

        numbers = rows(1 + len(kind.names))  # an interval's length, and the robot
        c = rows(len(task.constant_names) + task.clock)
        inputs = [rows(states), rows(forces), numbers, c, *([rows()] if grips else [])]
        outputs = [rows(states), rows(variables, states), rows(variables), rows(m), rows(states, m)]
        outputs += [rows(grips), rows(variables, grips)] if grips else []
        self._stage = InPlace(
            _stage_function(task, kind).map(blocks),
            [array[computed] for array in inputs],
            [array[computed] for array in outputs],
        )
        self.x, self.a, _, self.c, *reserve = (array[: n + 1] for array in inputs)
        self.h, self._robot = numbers[: n + 1, 0], numbers[:, 1:]
        self.reserve = reserve[0] if grips else np.zeros(n + 1)
        self._next, self._jacobian, self._gradient, self._margin, self._margin_jacobian, *grip = (
            array[: n + 1] for array in outputs
        )
        none = np.zeros((n + 1, 0)), np.zeros((n + 1, variables, 0))
        self._grip, self._grip_jacobian = grip if grips else none

    def _make_program(self, n: int, m: int, grips: int) -> None:
        rows, slack = m + grips, int(grips > 0)  # of the first stage, if there is a grip
        at, states, inputs = self._at, self._states, self._inputs
        variables = partial(_Stages, inputs + slack, n - 1, at.slack + 1, states)
        constraints = partial(_Stages, states + grips, n - 1, states + rows, 0)
        # entries of the constraints' matrix
        of_states, of_inputs = states * (states + 1 + rows), inputs * (states + grips)
        a = _Stages(of_inputs + grips, n - 1, of_states + of_inputs + rows, states)
        self._h = _Stages(inputs**2 + slack, n - 1, at.of_slack + 1, states**2)
        self._g, self._z = variables(), variables()
        self._low, self._high = constraints(), constraints()
        self._lower, self._upper = variables(-np.inf), variables(np.inf)
        self._cost, multipliers = np.zeros(1), constraints()
        self._grip_multipliers = (
            multipliers.first[states:],
            multipliers.inner[:, states + m :],
        )  # of the last program, ≤ 0
        self._program = InPlace(
            _solver(n, m, grips, states, inputs),
            # HPIPM's interface reads every input and writes every output, so all have an array.
            [
                *(array.all for array in (self._h, self._g, a, self._low, self._high, self._lower, self._upper)),
                *(array.all for array in (variables(), variables(), constraints())),
            ],
            [self._z.all, self._cost, multipliers.all, variables().all],
        )
        self._a0 = a.first[:of_inputs].reshape(inputs, states + grips)
        self._a_x = a.inner[:, :of_states].reshape(n - 1, states, states + 1 + rows)
        self._a_u = a.inner[:, of_states : of_states + of_inputs].reshape(n - 1, inputs, states + grips)
        # what never changes: slacks are ≥ 0 and have a price, margins have no upper limit
        self._a_x[:, :, 0], a.last[:] = -1.0, -1.0
        a.first[of_inputs:], a.inner[:, of_states + of_inputs :] = 1.0, 1.0
        self._lower.first[inputs:], self._lower.inner[:, at.slack] = 0.0, 0.0
        self._h.first[inputs**2 :], self._h.inner[:, at.of_slack] = _SLACK_CURVATURE, _SLACK_CURVATURE
        self._g.first[inputs:], self._g.inner[:, at.slack] = _SLACK_PRICE, _SLACK_PRICE
        self._high.first[at.limits], self._high.inner[:, at.limits] = np.inf, np.inf

    def set_robot(self, params: BallbotParams) -> None:
        """Sets the robot of the model: one of the kind that the program was made for, which rolls and grips or does not."""
        self._robot[:] = robot_numbers(params)
        # of the cone in an input, per multiplier
        self._cone_curvature = 2 * (params.force_limit / (params.friction * params.weight)) ** 2 / _GRIP_UNIT

    def set_weights(self, q: np.ndarray, r: np.ndarray, p: np.ndarray, slope: np.ndarray, target: np.ndarray) -> None:
        """Sets the Hessian and the cost beyond the horizon.

        Args:
            q: (N, 8, 8) Hessians of the intervals' costs with respect to states.
            r: (N, 2, 2) the same with respect to inputs.
            p: (8, 8) of V(x) = slopeᵀ(x − target) + (x − target)ᵀ p (x − target).
            slope: (8,) of V at the target.
            target: (8,) state.
        """
        self._r = r + _LEAST_CURVATURE * np.eye(self._inputs)
        self._h.inner[:, self._at.q] = q[1:].reshape(len(q) - 1, -1)
        self._h.last[:] = 2 * p.ravel()
        self._beyond = p, slope, target

    def iterate(self, margin: float) -> bool:
        """Linearizes about (x, a), solves, and puts the solution into x[1:] and a; whether there is one.

        Args:
            margin: least value of the task's margins, in their own units.
        """
        x, a, at, inputs = self.x, self.a, self._at, self._inputs
        self._stage()
        if self.disturbance is not None:
            rates, slopes = self.disturbance.rates(self.x, self.a)
            self._next += self.h[:, None] * rates
            self._jacobian += self.h[:, None, None] * slopes
        if not np.isfinite(self._next).all():
            return False
        self._set_constraints(margin)
        r = self._r if not self.curvature.any() else self._r + self.curvature[:, None, None] * np.eye(inputs)
        self._h.first[: inputs**2], self._h.inner[:, at.r] = r[0].ravel(), r[1:].reshape(len(r) - 1, -1)
        p, slope, target = self._beyond
        self._g.first[:inputs], self._g.inner[:, : at.slack] = self._gradient[0, at.a], self._gradient[1:-1]
        self._g.last[:] = slope + 2 * p @ (x[-1] - target)
        self._lower.first[:inputs], self._upper.first[:inputs] = -1 - a[0], 1 - a[0]
        self._lower.inner[:, at.a], self._upper.inner[:, at.a] = -1 - a[1:-1], 1 - a[1:-1]
        if not (self._program() and self._program.solved and np.isfinite(self._cost[0])):
            return False
        a[0] += self._z.first[:inputs]
        a[1:-1] += self._z.inner[:, at.a]
        x[1:-1] += self._z.inner[:, at.x]
        x[-1] += self._z.last
        if self._grip.shape[1]:
            first, inner = self._grip_multipliers
            cones = np.concatenate([first[None], inner])[:, 1::2]
            self.curvature = self._cone_curvature * np.maximum(-cones, 0.0).sum(1)
        return True

    def _set_constraints(self, margin: float) -> None:
        jacobian, low, high, at = self._jacobian, self._low, self._high, self._at
        gaps = self.x[1:] - self._next[:-1]
        self._a0[:, at.gap] = jacobian[0, at.a]
        self._a_x[:, :, at.next], self._a_u[:, :, at.gap] = jacobian[1:-1, at.x], jacobian[1:-1, at.a]
        low.first[at.gap] = high.first[at.gap] = gaps[0]
        low.inner[:, at.gap] = high.inner[:, at.gap] = gaps[1:]
        margins, slopes = self._nearest_margins()
        limits, of_states = low.inner[:, at.limits], self._a_x[:, :, at.slopes]
        limits[:, : self._margins], of_states[:, :, : self._margins] = margin - margins, slopes
        if self._grip.shape[1]:
            grip = self._grip_jacobian
            self._a0[:, at.limits], self._a_u[:, :, at.limits] = grip[0, at.a], grip[1:-1, at.a]
            low.first[at.limits] = -self._grip[0]
            limits[:, self._margins :], of_states[:, :, self._margins :] = -self._grip[1:-1], grip[1:-1, at.x]

    def _nearest_margins(self) -> tuple[np.ndarray, np.ndarray]:
        """(N−1, m) the least of the inner nodes' distinct margins, and their slopes (N−1, 8, m)."""
        margins, slopes = self._margin[1:-1, self.distinct], self._margin_jacobian[1:-1][:, :, self.distinct]
        if margins.shape[1] == self._margins:
            return margins, slopes
        least = np.argpartition(margins, self._margins - 1, axis=1)[:, : self._margins]
        return np.take_along_axis(margins, least, 1), np.take_along_axis(slopes, least[:, None, :], 2)


@lru_cache(maxsize=16)
def horizon_qp(task: Task, kind: RobotKind, nodes: int) -> HorizonQp:
    """The program of a task, kind of robot and number of intervals, made once and shared by all controllers."""
    return HorizonQp(task, kind, nodes)


@lru_cache(maxsize=16)
def _stage_function(task: Task, kind: RobotKind) -> casadi.Function:
    """(x, a, p, c) -> next state, its Jacobian (8, 10), gradient of the interval's cost (10), margins, their Jacobian.

    It computes `LANES` intervals at once, and matrices are columns. p is the interval's length and the robot's numbers.

    Where friction is limited, it also takes the reserve of grip, and gives the limits of grip and their Jacobian.
    """
    x, a = casadi.SX.sym("x", kind.states), casadi.SX.sym("a", kind.inputs)
    p = casadi.SX.sym("p", 1 + len(kind.names))
    c = casadi.SX.sym("c", len(task.constant_names) + task.clock)
    robot, limit = kind.symbolic(p)
    z, u, h = casadi.vertcat(x, a), limit * a, p[0]
    after = dynamics.step(robot, x, u, h, 2)  # two RK4 steps, as the env takes per control step
    margins = casadi.vertcat(*task.margins(x, c))
    outputs = [
        after,
        casadi.vec(casadi.densify(casadi.jacobian(after, z))),
        casadi.densify(casadi.gradient(task.cost(x, u, c) * h, z)),
        margins,
        casadi.vec(casadi.densify(casadi.jacobian(margins, x))),
    ]
    inputs = [x, a, p, c]
    if kind.grips:
        reserve = casadi.SX.sym("reserve")
        inputs.append(reserve)
        begins, ends = (
            casadi.vertcat(*dynamics.grip_limits(robot, force, reserve))
            for force in dynamics.held_contact(robot, x, u, task.control_dt)
        )
        # only the end of a control step that is nearer to slipping: each row costs time
        grip = casadi.if_else(ends[1] < begins[1], ends, begins) / _GRIP_UNIT
        outputs += [grip, casadi.vec(casadi.densify(casadi.jacobian(grip, z)))]
    function = casadi.Function("stage", inputs, outputs, {"cse": True})
    return in_lanes(f"{task.id}-nmpc", (function,), flags=LONG if kind.wheels else SIMD)[0]


def _solver(n: int, m: int, grips: int, states: int, inputs: int) -> casadi.Function:
    """HPIPM for n intervals with m margins and limits of grip at each node."""
    state, action, slack = (casadi.Sparsity.dense(size, size) for size in (states, inputs, 1))
    first_slack = [slack] if grips else []
    options = {
        "print_time": False,
        "error_on_fail": False,
        "N": n,
        "nx": [0] + [states] * n,
        "nu": [inputs + len(first_slack)] + [inputs + 1] * (n - 1) + [0],
        "ng": [grips] + [m + grips] * (n - 1) + [0],
        "hpipm": {
            "mode": "speed_abs",  # a fourth faster, as it computes no residuals; costs agree to 0.03 %
            "mu0": 1.0,
            "iter_max": _QP_ITERATIONS,
            **dict.fromkeys(("res_g_max", "res_b_max", "res_d_max", "res_m_max"), _RESIDUAL),
        },
    }
    hessian = casadi.diagcat(action, *first_slack, *[state, action, slack] * (n - 1), state)
    return casadi.conic("qp", "hpipm", {"h": hessian, "a": _constraint_pattern(n, m, grips, states, inputs)}, options)


def _constraint_pattern(n: int, m: int, grips: int, states: int, inputs: int) -> casadi.Sparsity:
    """Where the constraints' matrix has entries; the constants at the top of this file say their order."""
    at = _Places.of(states, inputs)
    first_rows, first_columns, height, width = states + grips, inputs + (grips > 0), states + m + grips, at.slack + 1
    present = np.zeros((first_rows + (n - 1) * height, first_columns + (n - 1) * width + states), bool)
    present[:first_rows, :inputs] = present[states:first_rows, inputs:first_columns] = True
    for k in range(n):
        row, column = first_rows + k * height, first_columns + k * width
        before = row - height if k else 0
        present[range(before, before + states), range(column, column + states)] = True
        own = present[row : row + height, column : column + width]  # without rows in the last stage
        own[:, at.x] = own[at.gap, at.a] = own[states + m :, at.a] = own[states:, at.slack :] = True
    rows, columns = np.nonzero(present)
    return casadi.Sparsity.triplet(*present.shape, rows.tolist(), columns.tolist())
