"""The horizon of model predictive control: its grid in time, and the quadratic program of one iteration.

The horizon's intervals are whole numbers of control steps. The first is one step, because the env holds its force that long.
Where there are more control steps than nodes, the later intervals hold theirs longer.
"""

from functools import lru_cache
from typing import Any

import casadi
import numpy as np

from ballbot_baselines.feedback.disturbance import DisturbanceEstimator
from ballbot_baselines.solvers.compiled import LANES, InPlace, in_lanes
from ballbot_baselines.solvers.nlp import Stages
from ballbot_gym.robot import Kind, Robot
from ballbot_gym.tasks import Task

_SLACK_PRICE = 100.0  # per unit of violation of a margin at a node: more than any violation saves
_SLACK_CURVATURE = 100.0  # keeps the program strictly convex, and HPIPM at few iterations
_MARGINS = 2  # considered per node: the least ones. The others are far from violated, and each costs time
_GRIP_UNIT = 0.1  # of `Ballbot.limits`; this much costs as much as a unit of a margin
_LEAST_CURVATURE = 1e-6  # of the cost in every input, because an interval of length 0 has no cost
_RESIDUAL = 1e-4  # of the quadratic program, in states' SI units and fractions of the force
_QP_ITERATIONS = 30


class _Pattern:
    """Where a matrix (height, width) has entries: in blocks, of rows (K, r) and columns (K, c) of K dense parts each."""

    def __init__(self, height: int, width: int, *blocks: tuple[np.ndarray, np.ndarray]):
        present = np.zeros((width, height), bool)
        for rows, columns in blocks:
            present[columns[:, :, None], rows[:, None]] = True
        columns, rows = np.nonzero(present)
        self.sparsity = casadi.Sparsity.triplet(height, width, rows.tolist(), columns.tolist())
        self._places = np.full(present.shape, -1)
        self._places[columns, rows] = np.arange(len(rows))

    def places(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """(K, c, r) where a block's entries stand among all, which are sorted by columns."""
        return self._places[columns[:, :, None], rows[:, None]]


class _HorizonQp:
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

    def __init__(self, task: Task, kind: Kind, nodes: int):
        """Differentiates the stage and builds the solver; compiles on first use on a machine. `set_robot` must follow."""
        self._states, self._inputs = len(kind.robot.STATE), len(kind.robot.ACTION)
        count = len(task.margins((0.0,) * self._states, (1.0,) * (len(task.constant_names) + task.clock)))
        self.distinct = np.arange(count)
        self.disturbance: DisturbanceEstimator | None = None
        self.curvature = np.zeros(nodes)
        self._margins = min(count, _MARGINS)
        self._make_stage(task, kind, nodes, count)
        self._make_program(nodes, self._margins, 2 * kind.grips)

    def _make_stage(self, task: Task, kind: Kind, n: int, m: int) -> None:
        states, forces, grips = self._states, self._inputs, 2 * kind.grips
        variables = states + forces
        blocks = -(-n // LANES)  # of intervals; the last one is filled up with zeros
        computed = slice(0, blocks * LANES)

        def rows(*shape: int) -> np.ndarray:
            return np.zeros((max(n + 1, computed.stop), *shape))

        numbers = rows(1 + len(kind.numbers))  # an interval's length, and the robot
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
        states, inputs, stage = self._states, self._inputs, np.arange(n + 1)[:, None]
        # Variables of a stage: x, a, and the slack of margins and grip. There is no x_0, and without grip no s_0.
        first = stage * (states + inputs + 1) - states - (not grips) * (stage > 0)
        self._x_at, self._a_at = first[1:] + np.arange(states), first[:-1] + states + np.arange(inputs)
        slack = first[0 if grips else 1 : -1] + states + inputs
        # Constraints of a stage: the gap to the next state, margins but in the first stage, and the limits of the grip.
        last = stage[:-1] * (states + m + grips) + states
        self._gap_at, self._grip_at = last - states - m * (stage[:-1] > 0) + np.arange(states), last + np.arange(grips)
        self._margin_at = last[1:] - m + np.arange(m)
        inner, width, height = self._x_at[:-1], self._x_at[-1, -1] + 1, last[-1, 0] + grips
        next_states = self._gap_at.reshape(-1, 1), self._x_at.reshape(-1, 1)
        slacks = (self._margin_at, slack[1 - n :]), (self._grip_at[-len(slack) :], slack)
        slopes = (
            (self._gap_at, self._a_at),
            (self._gap_at[1:], inner),
            (self._margin_at, inner),
            (self._grip_at, self._a_at),
            (self._grip_at[1:], inner),
        )
        a = _Pattern(height, width, next_states, *slacks, *slopes)
        h = _Pattern(width, width, (self._x_at, self._x_at), (self._a_at, self._a_at), (slack, slack))
        self._slopes_at = [a.places(*block) for block in slopes]
        self._q_at, self._r_at = h.places(self._x_at, self._x_at), h.places(self._a_at, self._a_at)

        self._h, self._a = np.zeros(h.sparsity.nnz()), np.zeros(a.sparsity.nnz())
        self._g, self._z, self._lower, self._upper, *unused = np.zeros((7, width))
        self._low, self._high, self._multipliers, none = np.zeros((4, height))
        self._cost = np.zeros(1)
        self._program = InPlace(
            _solver(n, m, grips, h.sparsity, a.sparsity, states, inputs),
            # HPIPM's interface reads every input and writes every output, so all have an array.
            [self._h, self._g, self._a, self._low, self._high, self._lower, self._upper, *unused[:2], none],
            [self._z, self._cost, self._multipliers, unused[2]],
        )
        # what never changes: slacks are ≥ 0 and have a price, margins have no upper limit
        self._a[a.places(*next_states)] = -1.0
        for block in slacks:
            self._a[a.places(*block)] = 1.0
        self._lower[self._x_at], self._upper[:] = -np.inf, np.inf
        self._h[h.places(slack, slack)], self._g[slack] = _SLACK_CURVATURE, _SLACK_PRICE
        self._high[self._margin_at] = self._high[self._grip_at] = np.inf

    def set_robot(self, params: Robot) -> None:
        """Sets the robot of the model: one of the kind that the program was made for, which rolls and grips or does not."""
        self._robot[:] = params.numbers()
        # of the cone in an input, per multiplier
        self._cone_curvature = 2 * params.cone_curvature() / _GRIP_UNIT

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
        self._h[self._q_at[:-1]], self._h[self._q_at[-1]] = q[1:], 2 * p
        self._beyond = p, slope, target

    def iterate(self, margin: float) -> bool:
        """Linearizes about (x, a), solves, and puts the solution into x[1:] and a; whether there is one.

        Args:
            margin: least value of the task's margins, in their own units.
        """
        x, a, states = self.x, self.a, self._states
        self._stage()
        if self.disturbance is not None:
            with np.errstate(all="ignore"):  # where the iteration diverges, this may overflow, and there is no solution
                rates, slopes = self.disturbance.rates(self.x, self.a)
                self._next += self.h[:, None] * rates
                self._jacobian += self.h[:, None, None] * slopes
        if not np.isfinite(self._next).all():
            return False
        self._set_constraints(margin)
        r = self._r if not self.curvature.any() else self._r + self.curvature[:, None, None] * np.eye(self._inputs)
        p, slope, target = self._beyond
        self._h[self._r_at], self._g[self._a_at] = r, self._gradient[:-1, states:]
        self._g[self._x_at[:-1]] = self._gradient[1:-1, :states]
        self._g[self._x_at[-1]] = slope + 2 * p @ (x[-1] - target)
        self._lower[self._a_at], self._upper[self._a_at] = -1 - a[:-1], 1 - a[:-1]
        if not (self._program() and self._program.solved and np.isfinite(self._cost[0])):
            return False
        a[:-1] += self._z[self._a_at]
        x[1:] += self._z[self._x_at]
        if self._grip.shape[1]:
            cones = self._multipliers[self._grip_at][:, 1::2]  # ≤ 0
            self.curvature = self._cone_curvature * np.maximum(-cones, 0.0).sum(1)
        return True

    def _set_constraints(self, margin: float) -> None:
        jacobian, grip, states = self._jacobian[:-1], self._grip_jacobian[:-1], self._states
        margins, slopes = self._nearest_margins()
        found = jacobian[:, states:], jacobian[1:, :states], slopes, grip[:, states:], grip[1:, :states]
        for at, values in zip(self._slopes_at, found, strict=True):
            self._a[at] = values
        self._low[self._gap_at] = self._high[self._gap_at] = self.x[1:] - self._next[:-1]
        self._low[self._margin_at], self._low[self._grip_at] = margin - margins, -self._grip[:-1]

    def _nearest_margins(self) -> tuple[np.ndarray, np.ndarray]:
        """(N−1, m) the least of the inner nodes' distinct margins, and their slopes (N−1, 8, m)."""
        margins, slopes = self._margin[1:-1, self.distinct], self._margin_jacobian[1:-1][:, :, self.distinct]
        if margins.shape[1] == self._margins:
            return margins, slopes
        least = np.argpartition(margins, self._margins - 1, axis=1)[:, : self._margins]
        return np.take_along_axis(margins, least, 1), np.take_along_axis(slopes, least[:, None, :], 2)


horizon_qp = lru_cache(maxsize=16)(_HorizonQp)
"""The program of a task, kind of robot and number of intervals, made once and shared by all controllers."""


@lru_cache(maxsize=16)
def _stage_function(task: Task, kind: Kind) -> casadi.Function:
    """(x, a, p, c) -> next state, its Jacobian (8, 10), gradient of the interval's cost (10), margins, their Jacobian.

    It computes `LANES` intervals at once, and matrices are columns. p is the interval's length and the robot's numbers.

    Where friction is limited, it also takes the reserve of grip, and gives the limits of grip and their Jacobian.
    """
    x, a = casadi.SX.sym("x", len(kind.robot.STATE)), casadi.SX.sym("a", len(kind.robot.ACTION))
    p = casadi.SX.sym("p", 1 + len(kind.numbers))
    c = casadi.SX.sym("c", len(task.constant_names) + task.clock)
    robot: Any = kind.model(p[1:])
    z, u, h = casadi.vertcat(x, a), robot.force_limit * a, p[0]
    margins = casadi.vertcat(*task.margins(x, c))
    outputs = [
        casadi.densify(casadi.gradient(task.cost(x, u, c) * h, z)),
        margins,
        casadi.vec(casadi.densify(casadi.jacobian(margins, x))),
    ]
    inputs = [x, a, p, c]
    if kind.grips:
        reserve = casadi.SX.sym("reserve")
        inputs.append(reserve)
        begins, ends = (
            casadi.vertcat(*robot.grip_limits(force, reserve)) for force in robot.held_contact(x, u, task.control_dt)
        )
        # only the end of a control step that is nearer to slipping: each row costs time
        grip = casadi.if_else(ends[1] < begins[1], ends, begins) / _GRIP_UNIT
        outputs += [grip, casadi.vec(casadi.densify(casadi.jacobian(grip, z)))]
    (others,) = in_lanes(f"{task.id}-nmpc", (casadi.Function("stage", inputs, outputs, {"cse": True}),))
    # two steps of RK4, as the env takes per control step
    discrete = kind.robot.DISCRETE
    motion = Stages.motion(
        z, p, casadi.SX(robot.step(x, u, h) if discrete else h * robot.derivative(x, u)), 0 if discrete else 2
    )
    given = [casadi.MX.sym(name, others.size_in(i)) for i, name in enumerate(others.name_in())]
    after, entries = motion.jacobian(casadi.vertcat(*given[:2]), given[2][: motion.params, :])
    # each entry of the Jacobian is one of the nonzeros, or the 0 before them
    count = motion.jacobian_at.nnz()
    numbers = casadi.vec(casadi.densify(casadi.DM(motion.jacobian_at, list(range(1, count + 1)))))
    jacobian = casadi.vertcat(casadi.MX.zeros(1, LANES), entries)[[int(i) for i in numbers.nonzeros()], :]
    return casadi.Function("stage", given, [after, jacobian, *others.call(given)])


def _solver(
    n: int, m: int, grips: int, h: casadi.Sparsity, a: casadi.Sparsity, states: int, inputs: int
) -> casadi.Function:
    """HPIPM for n intervals with m margins and limits of grip at each node."""
    options = {
        "print_time": False,
        "error_on_fail": False,
        "N": n,
        "nx": [0] + [states] * n,
        "nu": [inputs + (grips > 0)] + [inputs + 1] * (n - 1) + [0],
        "ng": [grips] + [m + grips] * (n - 1) + [0],
        "hpipm": {
            "mode": "speed_abs",  # a fourth faster, as it computes no residuals; costs agree to 0.03 %
            "mu0": 1.0,
            "iter_max": _QP_ITERATIONS,
            **dict.fromkeys(("res_g_max", "res_b_max", "res_d_max", "res_m_max"), _RESIDUAL),
        },
    }
    return casadi.conic("qp", "hpipm", {"h": h, "a": a}, options)
