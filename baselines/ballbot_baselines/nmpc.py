"""Nonlinear model predictive control: the task's own problem over a receding horizon, solved at every control step.

    minimize    Σ_j cost(x_j, u_j, c)·h_j + ρ Σ_j s_j + V(x_N)        over u_j, |u_j| ≤ limit, and slacks s_j ≥ 0
    subject to  x_{j+1} = step(x_j, u_j, h_j),   margins(x_j, c) + s_j ≥ back-off,   x_0 the (predicted) state
                limits(x_j, u_j) + s_j ≥ 0 where the robot's friction is limited, with a reserve of friction

`reset` plans the whole episode. The plan gives the cost beyond the horizon: V(x) ≈ λᵀ(x − x̄) + (x − x̄)ᵀP(x − x̄) about the
plan's state x̄ at the horizon's end. λ is the plan's costate (the multiplier of its dynamics), and P is TVLQR's cost-to-go
along the plan. So a robot on the plan stays on it, and a robot off the plan takes a Newton step.

Every iteration linearizes dynamics and margins about the last solution, shifted by one control step, and solves one
quadratic program by HPIPM: the sequential quadratic programming of Diehl et al., "A real-time iteration scheme for nonlinear
optimization in optimal feedback control" (2005). One iteration per step is that scheme; more iterate to convergence. The
Hessian is the cost's along the plan, so a converged solution is a stationary point of the nonlinear problem. Where friction
is limited, the friction cone curves more than the cost does: its curvature across the force is added, weighted with the
multipliers of the last program. Without it the iteration diverges along the cone.

`offset_free` makes up for a robot that differs from the model: what the model mispredicts of the accelerations from step to
step is fitted by recursive least squares, and added to the model over the horizon. As in Pannocchia and Rawlings,
"Disturbance models for offset-free model-predictive control" (2003), there is a constant disturbance. Errors of masses and
lengths are proportional to lean and force, so those are fitted as well.

The horizon's intervals are whole numbers of control steps: the first is one, as the env holds its force, and where there
are more control steps than nodes the later intervals hold theirs longer. Near the plan's end intervals shrink to nothing.
"""

import multiprocessing
import time
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal

import casadi
import numpy as np

from ballbot_baselines.compiled import LANES, in_lanes
from ballbot_baselines.linearize import quadratic_cost
from ballbot_baselines.lqr import final_weight
from ballbot_baselines.optimum import Backoff, Optimum, plan_to_track
from ballbot_baselines.tvlqr import TvlqrController
from ballbot_gym import dynamics
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task

# of the plan; for the goal it is half of TrajoptController's
_BACKOFF = Backoff(margin=0.01, goal=0.05, force=0.02, grip=0.1)
_OFFSET_FREE_BACKOFF = Backoff(margin=0.02, goal=0.4, force=0.05, grip=0.1)  # what is left of a wrong model
_SLACK_PRICE = 100.0  # per unit of violation of a margin at a node: more than any violation saves
_NODES = 40
_MARGINS = 2  # considered per node: the least ones. The others are far from violated, and each costs time
_SLACK_CURVATURE = 100.0  # keeps the program strictly convex, and HPIPM at few iterations
_GRIP_UNIT = 0.1  # of `dynamics.limits`, that costs as much as a unit of a margin
_LEAST_CURVATURE = 1e-6  # of the cost in every input, because an interval of length 0 has no cost
_RESIDUAL = 1e-4  # of the quadratic program, in states' SI units and fractions of the force
_QP_ITERATIONS = 30
_FORGETTING = 0.98  # of the disturbance's estimator per control step: it remembers about a second
_TRUST = np.array([1e-1, 1e1, 1e-3])  # variances of its constant, lean and force parts before the first step; SI units
_FAR = 10.0  # units of cost that a deviation from the plan will take: more is planned anew, if that is done in the background
_PLANNING_SECONDS = 0.2  # after which a new plan begins, on which the horizon predicts the robot then
_STALE_SECONDS = 1.0  # by which a plan may come too late


@dataclass
class Counts:
    """What happened since the controller was made.

    `steps` are calls of `act` that wanted a solution, `iterations` quadratic programs solved, `failed` the steps without
    a usable solution (`injected` of them on purpose), `late` solutions that came after the deadline, `cut` searches that
    the deadline ended before they converged, and `fallbacks` the steps taken under TVLQR: failed + late. `replans` are
    whole plans made anew because a first-exit goal was missed at the plan's end, or because the robot was far from its plan:
    they take longer than a step. `unplanned` of them found no plan, or came too late.
    """

    steps: int = 0
    iterations: int = 0
    failed: int = 0
    injected: int = 0
    late: int = 0
    cut: int = 0
    fallbacks: int = 0
    replans: int = 0
    unplanned: int = 0


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


_INPUTS = 2
"""Inputs of a stage."""


class _Inner:
    """Where the parts of an inner stage (0 < j < N) stand among its entries.

    The first stage has no state, and a slack only where the robot's grip is limited; the last stage has a state only.
    """

    # Variables: changes of the state and of the input, and the slack of the margins.
    X, A, SLACK, VARIABLES = slice(0, 8), slice(8, 10), 10, 11
    # Hessian, one dense block after the other: of the state (8, 8), of the input (2, 2), of the slack.
    Q, R, SLACK_CURVATURE, HESSIAN = slice(0, 64), slice(64, 68), 68, 69
    # Constraints: the gap to the next state, then the margins, then the limits of the robot's grip.
    GAP, MARGINS = slice(0, 8), slice(8, None)
    # Column of a state in the constraints' matrix: −1 in the gap of the stage before, the slopes of the next state, and
    # the slopes of the margins and of the grip.
    BEFORE, NEXT, SLOPES = 0, slice(1, 9), slice(9, None)


@dataclass(frozen=True)
class _Matrix:
    """Nonzeros of the constraints' matrix that belong to an inner stage, column after column.

    Each of the 8 state columns has 1 + 8 + m + g entries (see `_Inner`), each of the 2 input columns has the 8 slopes of the
    next state and those of the grip's g limits, and the slack's column has a 1 for each of the m margins and g limits.
    """

    margins: int
    grips: int

    @property
    def rows(self) -> int:
        """Constraints besides the gap."""
        return self.margins + self.grips

    @property
    def state_column(self) -> int:
        return 1 + 8 + self.rows

    @property
    def input_column(self) -> int:
        return 8 + self.grips

    @property
    def states(self) -> slice:
        return slice(0, 8 * self.state_column)

    @property
    def inputs(self) -> slice:
        return slice(self.states.stop, self.states.stop + 2 * self.input_column)

    @property
    def slack(self) -> slice:
        return slice(self.inputs.stop, self.inputs.stop + self.rows)


class Disturbance:
    """What is added to the model's accelerations: for each axis a constant, a part of its lean, and a part of its force.

    The coefficients (2 axes, 3, 2) say, by axis, what the constant, the lean (rad) and the force (fraction of its limit) add
    to the ball's acceleration, m/s², and to the lean's, rad/s². They are fitted by recursive least squares, and start at 0.
    """

    def __init__(self, force_limit: float):
        self.coefficients = np.zeros((2, 3, 2))
        self._limit = force_limit
        self._covariance = np.tile(np.diag(_TRUST * [1.0, 1.0, force_limit**2 / 100]), (2, 1, 1))

    def fit(self, x: np.ndarray, u: np.ndarray, errors: np.ndarray) -> None:
        """Takes the errors (4,) of the accelerations over a control step from state x (8,) under force u (2,), N."""
        for axis in range(2):
            features = np.array([1.0, x[2 + axis], u[axis] / self._limit])
            covariance = self._covariance[axis]
            gain = covariance @ features / (_FORGETTING + features @ covariance @ features)
            missed = errors[[axis, 2 + axis]] - features @ self.coefficients[axis]
            self.coefficients[axis] += np.outer(gain, missed)
            # Forgetting is limited: at rest nothing is learned, and the covariance must not grow.
            updated = covariance - np.outer(gain, features @ covariance)
            self._covariance[axis] = updated / _FORGETTING if np.trace(updated) < _TRUST.sum() else updated

    def rates(self, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is added to the rates of states x (n, 8) under actions a (n, 2): (n, 8), and its slopes (10, 8)."""
        added, slopes = np.zeros(x.shape), np.zeros((10, 8))
        for axis in range(2):
            constant, lean, force = self.coefficients[axis]
            places = [4 + axis, 6 + axis]
            added[:, places] = constant + x[:, 2 + axis, None] * lean + a[:, axis, None] * force
            slopes[2 + axis, places], slopes[8 + axis, places] = lean, force
        return added, slopes


class HorizonQp:
    """The quadratic program of one iteration, for N intervals; arrays are allocated once and filled in place.

    Variables are changes δa_0, δx_1, δa_1, s_1, … δx_N: x_0 is known and no variable, inputs a are fractions of the force
    limit. (Changes, because HPIPM starts from 0.) Constraints of stage j are its dynamics, then its margins, then the limits
    of the robot's grip, if it has any; then there is an s_0 too. The last stage has no margins, because CasADi's interface
    allows no slack there.
    """

    def __init__(self, task: Task, params: BallbotParams, nodes: int):
        """Differentiates the stage and builds the solver; compiles on first use on a machine."""
        count = len(task.margins((0.0,) * 8, (1.0,) * len(task.constant_names)))
        self.distinct = np.arange(count)
        """Indices of the task's margins that are considered."""
        self.disturbance: Disturbance | None = None
        grips = _grips(params)
        # of the cone in an input, per multiplier
        self._cone_curvature = 2 * (params.force_limit / (params.friction * params.weight)) ** 2 / _GRIP_UNIT
        self._make_stage(task, params, nodes, count, grips)
        self._make_program(nodes, min(count, _MARGINS), grips)

    def _make_stage(self, task: Task, params: BallbotParams, n: int, m: int, grips: int) -> None:
        blocks = -(-n // LANES)  # of intervals; the last one is filled up with zeros
        computed = slice(0, blocks * LANES)

        def rows(*shape: int) -> np.ndarray:
            return np.zeros((max(n + 1, computed.stop), *shape))

        inputs = [rows(8), rows(2), rows(), rows(len(task.constant_names)), *([rows()] if grips else [])]
        outputs = [rows(8), rows(10, 8), rows(10), rows(m), rows(8, m)]
        outputs += [rows(grips), rows(10, grips)] if grips else []
        self._stage = _InPlace(
            _stage_function(task, params).map(blocks),
            [array[computed] for array in inputs],
            [array[computed] for array in outputs],
        )
        self.x, self.a, self.h, self.c, *reserve = (array[: n + 1] for array in inputs)
        self.reserve = reserve[0] if grips else np.zeros(n + 1)
        """(nodes + 1,) of normal force, as a fraction of the weight, where the robot's grip is limited."""
        self._next, self._jacobian, self._gradient, self._margin, self._margin_jacobian, *grip = (
            array[: n + 1] for array in outputs
        )
        self._grip, self._grip_jacobian = grip if grips else (np.zeros((n + 1, 0)), np.zeros((n + 1, 10, 0)))

    def _make_program(self, n: int, m: int, grips: int) -> None:
        hessian, constraints = _patterns(n, m, grips)
        program = casadi.conic(
            "qp",
            "hpipm",
            {"h": hessian, "a": constraints},
            {
                "print_time": False,
                "error_on_fail": False,
                "N": n,
                "nx": [0] + [8] * n,
                "nu": [3 if grips else 2] + [3] * (n - 1) + [0],
                "ng": [grips] + [m + grips] * (n - 1) + [0],
                "hpipm": {
                    "mode": "speed_abs",  # a fourth faster, as it computes no residuals; costs agree to 0.03 %
                    "mu0": 1.0,
                    "iter_max": _QP_ITERATIONS,
                    **dict.fromkeys(("res_g_max", "res_b_max", "res_d_max", "res_m_max"), _RESIDUAL),
                },
            },
        )
        h, a = np.zeros(hessian.nnz()), np.zeros(constraints.nnz())
        g, z = np.zeros(hessian.shape[0]), np.zeros(hessian.shape[0])
        low, high = np.zeros(constraints.shape[0]), np.zeros(constraints.shape[0])
        self._lower, self._upper = np.full(len(z), -np.inf), np.full(len(z), np.inf)
        self._cost = np.zeros(1)
        # HPIPM's interface reads every input and writes every output, so all have an array.
        self._unused = [np.zeros(len(z)), np.zeros(len(z)), np.zeros(len(low)), np.zeros(len(low)), np.zeros(len(z))]
        start, multipliers, row_multipliers, *duals = self._unused
        self._program = _InPlace(
            program,
            [h, g, a, low, high, self._lower, self._upper, start, multipliers, row_multipliers],
            [z, self._cost, *duals],
        )
        self._divide(h, g, a, low, high, z, n, _Matrix(m, grips))
        first, inner, _ = _stages(self._unused[3], 8 + grips, n - 1, 8 + m + grips)
        self._grip_multipliers = first[8:], inner[:, 8 + m :]  # of the last program, ≤ 0
        self.curvature = np.zeros(n)
        """(nodes,) of the friction cone in the inputs, by the multipliers of the last program; before the first, 0."""
        # what never changes: slacks are ≥ 0 and have a price, margins have no upper limit
        self._lower_stages[:, _Inner.SLACK] = 0.0
        self._h[:, _Inner.SLACK_CURVATURE] = _SLACK_CURVATURE
        self._g[:, _Inner.SLACK] = _SLACK_PRICE
        self._high[:, _Inner.MARGINS] = np.inf
        self._lower0[_INPUTS:] = 0.0
        self._h0[2 * _INPUTS :] = _SLACK_CURVATURE
        self._g0[_INPUTS:] = _SLACK_PRICE
        self._high0[_Inner.MARGINS] = np.inf

    def _divide(
        self,
        h: np.ndarray,
        g: np.ndarray,
        a: np.ndarray,
        low: np.ndarray,
        high: np.ndarray,
        z: np.ndarray,
        n: int,
        matrix: _Matrix,
    ) -> None:
        """Views of the solver's arrays stage by stage. The constants of the constraints' matrix are put in here."""
        at, variables, rows, grips = _Inner, _Inner.VARIABLES, matrix.rows, matrix.grips
        slack = 1 if grips else 0  # of the first stage
        self._g0, self._g, self._g_end = _stages(g, _INPUTS + slack, n - 1, variables)
        self._z0, self._z, self._z_end = _stages(z, _INPUTS + slack, n - 1, variables)
        self._lower0, self._lower_stages, _ = _stages(self._lower, _INPUTS + slack, n - 1, variables)
        self._upper0, self._upper_stages, _ = _stages(self._upper, _INPUTS + slack, n - 1, variables)
        self._h0, self._h, self._h_end = _stages(h, 2 * 2 + slack, n - 1, at.HESSIAN)
        self._low0, self._low, _ = _stages(low, 8 + grips, n - 1, 8 + rows)
        self._high0, self._high, _ = _stages(high, 8 + grips, n - 1, 8 + rows)
        first = _INPUTS * matrix.input_column
        a0, a_stages, a_end = _stages(a, first + grips, n - 1, matrix.slack.stop)
        self._a0 = a0[:first].reshape(_INPUTS, matrix.input_column)
        a0[first:] = 1.0
        self._margins = slice(at.MARGINS.start, at.MARGINS.start + matrix.margins)
        self._a_x = a_stages[:, matrix.states].reshape(n - 1, 8, matrix.state_column)
        self._a_u = a_stages[:, matrix.inputs].reshape(n - 1, _INPUTS, matrix.input_column)
        self._a_x[:, :, at.BEFORE], a_end[:] = -1.0, -1.0
        a_stages[:, matrix.slack] = 1.0

    def set_weights(self, q: np.ndarray, r: np.ndarray, p: np.ndarray, slope: np.ndarray, target: np.ndarray) -> None:
        """Sets the Hessian and the cost beyond the horizon.

        Args:
            q: (N, 8, 8) Hessians of the intervals' costs with respect to states.
            r: (N, 2, 2) the same with respect to inputs.
            p: (8, 8) of V(x) = slopeᵀ(x − target) + (x − target)ᵀ p (x − target).
            slope: (8,) of V at the target.
            target: (8,) state.
        """
        self._r = r + _LEAST_CURVATURE * np.eye(2)
        self._h[:, _Inner.Q] = q[1:].reshape(-1, 64)
        self._h_end[:] = 2 * p.ravel()
        self._beyond = p, slope, target

    def iterate(self, margin: float) -> bool:
        """Linearizes about (x, a), solves, and puts the solution into x[1:] and a, if there is one.

        Args:
            margin: least value of the task's margins, in their own units.
        """
        x, a = self.x, self.a
        self._stage()
        if self.disturbance is not None:
            rates, slopes = self.disturbance.rates(self.x, self.a)
            self._next += self.h[:, None] * rates
            self._jacobian += self.h[:, None, None] * slopes
        if not np.isfinite(self._next).all():
            return False
        self._set_constraints(margin)
        r = self._r if not self.curvature.any() else self._r + self.curvature[:, None, None] * np.eye(_INPUTS)
        self._h0[: _INPUTS * _INPUTS] = r[0].ravel()
        self._h[:, _Inner.R] = r[1:].reshape(-1, 4)
        p, slope, target = self._beyond
        self._g0[:_INPUTS], self._g[:, : _Inner.SLACK] = self._gradient[0, _Inner.A], self._gradient[1:-1]
        self._g_end[:] = slope + 2 * p @ (x[-1] - target)
        self._lower0[:_INPUTS], self._upper0[:_INPUTS] = -1 - a[0], 1 - a[0]
        self._lower_stages[:, _Inner.A], self._upper_stages[:, _Inner.A] = -1 - a[1:-1], 1 - a[1:-1]
        if not (self._program() and self._program.solved and np.isfinite(self._cost[0])):
            return False
        a[0] += self._z0[:_INPUTS]
        a[1:-1] += self._z[:, _Inner.A]
        x[1:-1] += self._z[:, _Inner.X]
        x[-1] += self._z_end
        if self._grip.shape[1]:
            first, inner = self._grip_multipliers
            cones = np.concatenate([first[None], inner])[:, 1::2]
            self.curvature = self._cone_curvature * np.maximum(-cones, 0.0).sum(1)
        return True

    def _set_constraints(self, margin: float) -> None:
        jacobian = self._jacobian
        gaps = self.x[1:] - self._next[:-1]
        margins, slopes = self._nearest_margins()
        at = _Inner
        self._a0[:, at.GAP] = jacobian[0, at.A]
        self._a_x[:, :, at.NEXT], self._a_u[:, :, at.GAP] = jacobian[1:-1, at.X], jacobian[1:-1, at.A]
        self._a_x[:, :, at.SLOPES][:, :, : margins.shape[1]] = slopes
        self._low0[at.GAP] = self._high0[at.GAP] = gaps[0]
        self._low[:, at.GAP] = self._high[:, at.GAP] = gaps[1:]
        self._low[:, self._margins] = margin - margins
        if self._grip.shape[1]:
            grip, rows = self._grip_jacobian, slice(self._margins.stop, None)
            self._a0[:, at.GAP.stop :] = grip[0, at.A]
            self._a_u[:, :, at.GAP.stop :] = grip[1:-1, at.A]
            self._a_x[:, :, at.SLOPES][:, :, margins.shape[1] :] = grip[1:-1, at.X]
            self._low0[at.GAP.stop :], self._low[:, rows] = -self._grip[0], -self._grip[1:-1]

    def _nearest_margins(self) -> tuple[np.ndarray, np.ndarray]:
        """(N−1, m) the least of the inner nodes' distinct margins, and their slopes (N−1, 8, m)."""
        margins, slopes = self._margin[1:-1, self.distinct], self._margin_jacobian[1:-1][:, :, self.distinct]
        rows = self._margins.stop - self._margins.start
        if margins.shape[1] == rows:
            return margins, slopes
        least = np.argpartition(margins, rows - 1, axis=1)[:, :rows]
        return np.take_along_axis(margins, least, 1), np.take_along_axis(slopes, least[:, None, :], 2)


@dataclass(frozen=True)
class Prepared:
    """A plan with all that the controller needs to follow it: gains and weights along it. Making it takes several steps."""

    plan: Optimum
    tracker: TvlqrController
    q: np.ndarray
    r: np.ndarray
    p: np.ndarray
    slopes: np.ndarray
    sums: np.ndarray
    distinct: np.ndarray

    @classmethod
    def make(cls, task: Task, params: BallbotParams, plan: Optimum, c: np.ndarray) -> "Prepared":
        """Of a plan for constants c (nc,)."""
        trajectory = plan.trajectory
        tracker = TvlqrController.for_task(task, params, trajectory, c)
        q, r = quadratic_cost(task, trajectory.x[:-1], trajectory.u, c)
        margins = np.array([task.margins(x, c) for x in trajectory.x])
        return cls(
            plan=plan,
            tracker=tracker,
            q=2 * q,
            r=2 * r * params.force_limit**2,
            p=np.concatenate([tracker.gains.p, final_weight(task, params, trajectory.x[-1], c)[None]]),
            slopes=np.concatenate([np.zeros((1, 8)), plan.costates]),
            sums=np.concatenate([np.zeros((1, 2)), np.cumsum(trajectory.u, axis=0)]) / params.force_limit,
            distinct=np.unique(margins, axis=1, return_index=True)[1],  # unused obstacles repeat others
        )


def prepared_plan(task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray, backoff: Backoff) -> Prepared:
    """Plans from state x (8,), and prepares the plan.

    Raises:
        PlanError: there is no plan.
    """
    return Prepared.make(task, params, plan_to_track(task, params, x, c, backoff), c)


class NmpcController:
    """Model predictive control about the episode's plan. One iteration per control step by default (real-time iteration).

    `plan` is the episode's plan, `counts` what happened so far; `reset` raises a PlanError where there is no plan.
    `predicted` (nodes + 1, 8) are the states of the last solution; None before the first `act` and after the plan's end.

    A step whose program fails, or whose solution is late, applies the last plan under TVLQR: the last solution, shifted,
    plus the episode plan's gain times the distance from it.
    """

    def __init__(
        self,
        task: Task,
        params: BallbotParams,
        nodes: int | None = None,
        horizon: float = 1.0,
        iterations: int = 1,
        tolerance: float = 1e-4,
        backoff: Backoff = _BACKOFF,
        delay: float = 0.0,
        deadline: float | None = None,
        failure_rate: float = 0.0,
        seed: int = 0,
        offset_free: bool = False,
        replanning: Literal["wait", "background"] = "wait",
    ):
        """Builds the program; `reset` does the planning.

        Args:
            task: the problem.
            params: the robot.
            nodes: intervals of the horizon, at most one per control step; default 40, or one per control step where friction
                is limited, because forces follow the friction cone from step to step.
            horizon: s, whole control steps.
            iterations: most iterations per step: 1 is the real-time iteration, some 20 converge.
            tolerance: largest change of an input, as a fraction of the force limit, that counts as converged.
            backoff: how far the plan keeps from its limits; the horizon's margins keep half of it.
            delay: s, whole control steps, from `act` until its force acts. Forces already commanded are taken into account.
            deadline: s of wall time per step; a later solution is not used. None makes results repeatable.
            failure_rate: share of steps whose solution is thrown away, drawn with `seed`: fault injection.
            seed: of the injected failures.
            offset_free: whether to estimate how the robot's accelerations differ from the model's, and to correct the model.
            replanning: "wait" makes a new plan within the step that wants it, so that results are repeatable. "background"
                makes it in another process, also where the robot is far from its plan, and no step waits for it. When it
                arrives depends on the machine. A script that asks for it needs the guard `if __name__ == "__main__":`.

        Raises:
            ValueError: another `replanning`, a horizon or delay that is no whole number of control steps, or a horizon of
                fewer than 2.
        """
        if replanning not in ("wait", "background"):
            raise ValueError(f'replanning must be "wait" or "background", not {replanning!r}')
        self._task, self._params, self._backoff = task, params, backoff
        self._offset_free, self._background = offset_free, replanning == "background"
        self._iterations, self._tolerance = iterations, tolerance
        self._deadline, self._failure_rate = deadline, failure_rate
        self._rng = np.random.default_rng(seed)
        self._delay = _whole_steps(delay, task.control_dt, "delay")
        steps = _whole_steps(horizon, task.control_dt, "horizon")
        nodes = min(nodes or (steps if params.grips else _NODES), steps)
        self._grid = Grid.make(steps, nodes)
        self._shift_states, self._shift_inputs = self._grid.shift_states(), self._grid.shift_inputs()
        self._qp = _horizon_qp(task, params, nodes)
        self.plan: Optimum | None = None
        self.predicted: np.ndarray | None = None
        self.counts = Counts()
        if self._background:
            _worker().submit(_start_up)  # so that the first new plan need not wait for the process

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        """Plans from the state that the first force will meet."""
        self._begin(t, c)
        self.follow(plan_to_track(self._task, self._params, self._predicted(x), self._c, self._backoff))

    def start(self, t: float, c: np.ndarray, prepared: Prepared) -> None:
        """As `reset`, with a plan that `prepared_plan` has made before, for instance in another process."""
        self._begin(t, c)
        self._adopt(prepared)

    @property
    def backoff(self) -> Backoff:
        """How far its plans keep from their limits."""
        return self._backoff

    def _begin(self, t: float, c: np.ndarray) -> None:
        self._start, self._c, self._lost = t, np.asarray(c, np.float64), False
        self._disturbance = Disturbance(self._params.force_limit) if self._offset_free else None
        self._before: tuple[np.ndarray, np.ndarray] | None = None
        self._planning: Future[Prepared] | None = None
        self._commanded = [np.zeros(2)] * self._delay

    def follow(self, plan: Optimum) -> None:
        """Takes a plan of the episode, and starts the horizon on it."""
        self._adopt(Prepared.make(self._task, self._params, plan, self._c))

    def _adopt(self, prepared: Prepared) -> None:
        plan = prepared.plan
        self.plan, self._trajectory, self.predicted = plan, plan.trajectory, None
        self._tracker = prepared.tracker
        self._tracker.reset(self._start, plan.trajectory.x[0], self._c)
        self._length = len(plan.trajectory.u)
        self._q, self._r, self._p = prepared.q, prepared.r, prepared.p
        self._slopes, self._sums, self._distinct = prepared.slopes, prepared.sums, prepared.distinct
        self._step = 0
        nodes = len(self._grid.lengths)
        self._dx, self._da = np.zeros((nodes + 1, 8)), np.zeros((nodes, 2))
        self._curvature = np.zeros(nodes)
        self._reserve = self._reserve_of(plan)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        began = time.perf_counter()
        self._estimate(x)
        measured = x
        x = self._predicted(x)
        if self._background:
            self._take_new_plan(t)
        elapsed = self._elapsed(t)
        if elapsed >= self._length and not self._background and self._missed_goal(t, x):
            elapsed = 0
        if elapsed >= self._length:
            u = self._tracker.act(t, x)  # the plan's end is held
            self.predicted = None
        else:
            self._advance(elapsed)
            solved = self._solve(x, began)
            self.predicted = self._x_plan + self._dx
            u = self._params.force_limit * self._qp.a[0] if solved else self._fall_back(x)
        if self._background:
            self._ask_for_new_plan(t, x, elapsed)
        u = np.clip(u, -self._params.force_limit, self._params.force_limit)
        self._commanded = [*self._commanded, u]
        acting = self._commanded[0]
        self._commanded = self._commanded[1:] if self._delay else []
        self._before = measured, acting
        return u

    def _reserve_of(self, plan: Optimum) -> float:
        """The reserve of grip that the horizon keeps: the back-off, or what the plan keeps if that is less."""
        if not self._params.grips:
            return 0.0
        trajectory = plan.trajectory
        forces = dynamics.held_contact(self._params, trajectory.x[:-1], trajectory.u, self._task.control_dt)
        least = min(np.min(dynamics.grip_reserve(self._params, force)) for force in forces)
        return float(np.clip(least, 0.0, self._backoff.grip))

    def _elapsed(self, t: float) -> int:
        return round((t - self._start) / self._task.control_dt)

    def _estimate(self, x: np.ndarray) -> None:
        """Fits the disturbance to what the model mispredicted over the last control step."""
        if self._disturbance is None or self._before is None or not np.isfinite(x).all():
            return
        dt = self._task.control_dt
        expected = dynamics.step(self._params, *self._before, dt, dynamics.substeps_for(dt))
        self._disturbance.fit(*self._before, (x - expected)[4:] / dt)

    def _missed_goal(self, t: float, x: np.ndarray) -> bool:
        """Whether the plan is over, the first-exit goal is not reached, and a new plan to it was found."""
        if not self._task.first_exit or self._lost:
            return False
        self.counts.replans += 1
        try:
            plan = plan_to_track(self._task, self._params, x, self._c, self._backoff)
        except PlanError:
            self.counts.unplanned += 1
            self._lost = True
            return False
        self._start = t
        self.follow(plan)
        return True

    def _ask_for_new_plan(self, t: float, x: np.ndarray, elapsed: int) -> None:
        """Has the other process plan, if the plan is over or far, from where the robot will be in `_PLANNING_SECONDS`."""
        if self._planning is not None:
            return
        over = elapsed >= self._length
        if over and not self._task.first_exit:
            return
        if over:
            begin, ahead = self._coasted(x), round(_PLANNING_SECONDS / self._task.control_dt)
        else:
            off = x - self._trajectory.x[elapsed]
            if not off @ self._p[elapsed] @ off > _FAR:
                return
            node = int(np.searchsorted(self._grid.offsets, _PLANNING_SECONDS / self._task.control_dt))
            begin, ahead = self._qp.x[node].copy(), int(self._grid.offsets[node])
        if not np.isfinite(begin).all():
            return
        self.counts.replans += 1
        self._planned_start = t + ahead * self._task.control_dt
        self._planning = _worker().submit(prepared_plan, self._task, self._params, begin, self._c, self._backoff)

    def _coasted(self, x: np.ndarray) -> np.ndarray:
        """The state after `_PLANNING_SECONDS` under the tracker, which holds the plan's end."""
        dt, limit = self._task.control_dt, self._params.force_limit
        for k in range(round(_PLANNING_SECONDS / dt)):
            u = np.clip(self._tracker.act(self._start + (self._length + k) * dt, x), -limit, limit)
            x = dynamics.step(self._params, x, u, dt, dynamics.substeps_for(dt))
        return x

    def _take_new_plan(self, t: float) -> None:
        """Follows the plan that the other process has made, from its start on."""
        if self._planning is None or not self._planning.done() or t < self._planned_start - 1e-9:
            return
        planning, self._planning = self._planning, None
        if planning.exception() is not None or t > self._planned_start + _STALE_SECONDS:
            self.counts.unplanned += 1
            return
        self._start = self._planned_start
        self._adopt(planning.result())

    def _predicted(self, x: np.ndarray) -> np.ndarray:
        """The state that the force commanded now will meet."""
        dt = self._task.control_dt
        for u in self._commanded:
            x = dynamics.step(self._params, x, u, dt, dynamics.substeps_for(dt))
            if self._disturbance is not None:
                x = x + dt * self._disturbance.rates(x[None], u[None] / self._params.force_limit)[0][0]
        return np.asarray(x, np.float64)

    def _advance(self, elapsed: int) -> None:
        """Shifts the last solution to now. It is stored as its deviation from the plan, which is small and smooth."""
        for _ in range(elapsed - self._step):
            self._dx, self._da = self._shift_states @ self._dx, self._shift_inputs @ self._da
        passed = self._curvature[elapsed - self._step :]
        self._curvature = np.concatenate([passed, np.zeros(len(self._curvature) - len(passed))])
        self._step = elapsed
        n, grid = self._length, self._grid
        at = np.minimum(elapsed + grid.offsets, n)
        self._lengths = np.diff(at)
        self._nodes = at
        trajectory = self._trajectory
        self._x_plan = trajectory.x[at]
        self._a_plan = (self._sums[at[1:]] - self._sums[at[:-1]]) / np.maximum(self._lengths, 1)[:, None]

    def _solve(self, x: np.ndarray, began: float) -> bool:
        """Whether a solution for state x was found in time. It is then in the program's x and a."""
        qp, counts = self._qp, self.counts
        counts.steps += 1
        self._load(x)
        found = False
        for _ in range(self._iterations):
            before = qp.a.copy()
            if not qp.iterate(0.5 * self._backoff.margin):
                found = False
                break
            counts.iterations += 1
            found = True
            if self._iterations == 1 or np.abs(qp.a - before).max() < self._tolerance:
                break
            # One more iteration takes at most as long as all iterations so far.
            if self._deadline is not None and time.perf_counter() - began > 0.5 * self._deadline:
                counts.cut += 1
                break
        injected = self._failure_rate > 0 and self._rng.random() < self._failure_rate
        counts.injected += injected
        found = found and not injected
        if not found:
            counts.failed += 1
            return False
        # A late solution is not used in this step, but the next step starts from it.
        self._dx, self._da = qp.x - self._x_plan, qp.a[:-1] - self._a_plan
        self._curvature = qp.curvature
        if self._deadline is not None and time.perf_counter() - began > self._deadline:
            counts.late += 1
            return False
        return True

    def _load(self, x: np.ndarray) -> None:
        qp, dt, at = self._qp, self._task.control_dt, np.minimum(self._nodes[:-1], self._length - 1)
        self._guess_x, self._guess_a = self._x_plan + self._dx, self._a_plan + self._da
        qp.x[:], qp.a[:-1] = self._guess_x, self._guess_a
        qp.x[0] = x
        qp.distinct, qp.disturbance, qp.curvature = self._distinct, self._disturbance, self._curvature
        qp.h[:-1], qp.c[:], qp.reserve[:] = dt * self._lengths, self._c, self._reserve
        weight = (dt * self._lengths)[:, None, None]
        end = self._nodes[-1]
        qp.set_weights(
            self._q[at] * weight, self._r[at] * weight, self._p[end], self._slopes[end], self._trajectory.x[end]
        )

    def _fall_back(self, x: np.ndarray) -> np.ndarray:
        """The last plan under TVLQR: the last solution, shifted, with the episode plan's gains."""
        self.counts.fallbacks += 1
        gain = self._tracker.gains.k[self._step]
        return self._params.force_limit * self._guess_a[0] - gain @ (x - self._guess_x[0])


def offset_free_nmpc(task: Task, params: BallbotParams) -> NmpcController:
    """NMPC that estimates how the robot differs from the model, and keeps more distance from its limits."""
    return NmpcController(task, params, backoff=_OFFSET_FREE_BACKOFF, offset_free=True)


@cache
def _worker() -> ProcessPoolExecutor:
    """One process that plans for all controllers. It is spawned: forking a process with threads is not safe."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def _start_up() -> None:
    """What the process does first: it has imported this module by then."""


def _whole_steps(seconds: float, dt: float, what: str) -> int:
    steps = round(seconds / dt)
    if steps < 0 or abs(steps * dt - seconds) > 1e-9:
        raise ValueError(f"{what} must be a whole number of control steps of {dt} s, not {seconds} s")
    return steps


@lru_cache(maxsize=16)
def _horizon_qp(task: Task, params: BallbotParams, nodes: int) -> HorizonQp:
    return HorizonQp(task, params, nodes)


@lru_cache(maxsize=16)
def _stage_function(task: Task, params: BallbotParams) -> casadi.Function:
    """(x, a, h, c) -> next state, its Jacobian (8, 10), gradient of the interval's cost (10), margins, their Jacobian.

    It computes `LANES` intervals at once, and matrices are columns.

    Where friction is limited, it also takes the reserve of grip, and gives the limits of grip and their Jacobian.
    """
    x, a, h = casadi.SX.sym("x", 8), casadi.SX.sym("a", 2), casadi.SX.sym("h")
    c = casadi.SX.sym("c", len(task.constant_names))
    z, u = casadi.vertcat(x, a), params.force_limit * a
    after = dynamics.step(params, x, u, h, 2)  # two RK4 steps, as the env takes per control step
    margins = casadi.vertcat(*task.margins(x, c))
    outputs = [
        after,
        casadi.vec(casadi.densify(casadi.jacobian(after, z))),
        casadi.densify(casadi.gradient(task.cost(x, u, c) * h, z)),
        margins,
        casadi.vec(casadi.densify(casadi.jacobian(margins, x))),
    ]
    inputs = [x, a, h, c]
    if params.grips:
        reserve = casadi.SX.sym("reserve")
        inputs.append(reserve)
        begins, ends = (
            casadi.vertcat(*dynamics.grip_limits(params, force, reserve))
            for force in dynamics.held_contact(params, x, u, task.control_dt)
        )
        # only the end of a control step that is nearer to slipping: each row costs time
        grip = casadi.if_else(ends[1] < begins[1], ends, begins) / _GRIP_UNIT
        outputs += [grip, casadi.vec(casadi.densify(casadi.jacobian(grip, z)))]
    function = casadi.Function("stage", inputs, outputs, {"cse": True})
    return in_lanes(f"{task.id}-nmpc", (function,))[0]


def _grips(params: BallbotParams) -> int:
    """How many limits of its grip a robot has."""
    return len(dynamics.limits(params, (0.0,) * 8, (0.0, 0.0)))


def _patterns(n: int, m: int, grips: int) -> tuple[casadi.Sparsity, casadi.Sparsity]:
    """Sparsity of the program's Hessian and of its constraints' matrix; `_Inner` and `_Matrix` say the order of entries."""
    state, inputs, slack = casadi.Sparsity.dense(8, 8), casadi.Sparsity.dense(2, 2), casadi.Sparsity.dense(1, 1)
    first_slack = [slack] if grips else []
    hessian = casadi.diagcat(inputs, *first_slack, *[state, inputs, slack] * (n - 1), state)
    width, height = _Inner.VARIABLES, 8 + m + grips
    first_rows, first_columns = 8 + grips, _INPUTS + len(first_slack)
    entries = [(i, j) for j in range(_INPUTS) for i in range(first_rows)]
    entries += [(i, _INPUTS) for i in range(8, first_rows)]
    for k in range(1, n + 1):
        row, column = first_rows + (k - 1) * height, first_columns + (k - 1) * width
        before = row - height if k > 1 else 0
        own = range(row, row + height if k < n else row)  # the last stage has no constraints of its own
        for j in range(8):
            entries += [(before + j, column + j), *((i, column + j) for i in own)]
        of_inputs = [*own[_Inner.GAP], *own[8 + m :]]
        entries += [(i, column + j) for j in (8, 9) for i in of_inputs]
        entries += [(i, column + _Inner.SLACK) for i in own[_Inner.MARGINS]]
    rows, columns = zip(*entries, strict=True)
    shape = (first_rows + (n - 1) * height, first_columns + (n - 1) * width + 8)
    return hessian, casadi.Sparsity.triplet(*shape, list(rows), list(columns))


def _stages(array: np.ndarray, first: int, count: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Views of the first stage's entries, of the middle stages' (count, width), and of the last's."""
    middle = first + count * width
    return array[:first], array[first:middle].reshape(count, width), array[middle:]


class _InPlace:
    """A function that reads and writes given arrays. A call through `casadi.DM` would take twice as long."""

    def __init__(self, function: casadi.Function, inputs: list[np.ndarray], outputs: list[np.ndarray]):
        self._buffer = function.buffer()[0]
        self._inputs, self._outputs = ([array.data for array in arrays] for arrays in (inputs, outputs))

    def __call__(self) -> bool:
        """Whether it ran without an error."""
        buffer = self._buffer
        # HPIPM's interface uses up the pointers it is given (seen in CasADi 3.8.2), so they are given anew.
        # The type stubs ask for a size, but memory views bring their own.
        for i, view in enumerate(self._inputs):
            buffer.set_arg(i, view)  # pyright: ignore[reportCallIssue]
        for i, view in enumerate(self._outputs):
            buffer.set_res(i, view)  # pyright: ignore[reportCallIssue]
        buffer._eval()
        return buffer.ret() == 0

    @property
    def solved(self) -> bool:
        """Whether a solver reports success."""
        return bool(self._buffer.stats()["success"])
