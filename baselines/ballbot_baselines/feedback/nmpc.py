"""Nonlinear model predictive control: the task's own problem over a receding horizon, solved at every control step.

    minimize    Σ_j cost(x_j, u_j, c)·h_j + ρ Σ_j s_j + V(x_N)        over u_j, |u_j| ≤ limit, and slacks s_j ≥ 0
    subject to  x_{j+1} = step(x_j, u_j, h_j),   margins(x_j, c) + s_j ≥ back-off,   x_0 the state
                limits(x_j, u_j) + s_j ≥ 0 where the robot's friction is limited, with a reserve of friction

`reset` plans the whole episode. The plan gives the cost beyond the horizon: V(x) ≈ λᵀ(x − x̄) + (x − x̄)ᵀP(x − x̄) about the
plan's state x̄ at the horizon's end. λ is the plan's costate (the multiplier of its dynamics), and P is TVLQR's cost-to-go
along the plan. So a robot on the plan stays on it, and a robot off the plan takes a Newton step.

Every iteration linearizes dynamics and margins about the last solution, shifted by one control step, and solves one
quadratic program by HPIPM (`horizon.py`): the sequential quadratic programming of Diehl et al., "A real-time iteration scheme
for nonlinear optimization in optimal feedback control" (2005). One iteration per step is that scheme; more iterate to
convergence. The Hessian is the cost's along the plan, so a converged solution is a stationary point of the nonlinear problem.
Where friction is limited, the friction cone curves more than the cost does: its curvature across the force is added, weighted
with the multipliers of the last program. Without it the iteration diverges along the cone.

`offset_free` corrects the model for a robot that differs from it (`disturbance.py`). At every step the difference between the
measured and the predicted accelerations is fitted by recursive least squares, and added to the model over the horizon. As in
Pannocchia and Rawlings, "Disturbance models for offset-free model-predictive control" (2003), there is a constant
disturbance. Errors of masses and lengths are proportional to lean and force, so those are fitted as well.

The model has no dry friction, and the force that overcomes it is added, as LQR does. Friction that changes its sign with a
speed is far from linear there: with it in the model, the iteration diverges if a state is estimated and the torque is short.
"""

from dataclasses import dataclass

import numpy as np

from ballbot_baselines.feedback.disturbance import DisturbanceEstimator
from ballbot_baselines.feedback.horizon import horizon_qp
from ballbot_baselines.feedback.tvlqr import TvlqrController
from ballbot_baselines.optimum.find import plan_to_track
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_baselines.solvers.shooting import Backoff
from ballbot_gym.robot import Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task

BACKOFF = Backoff(margin=0.01, goal=0.05, force=0.02, grip=0.1)
"""Of the plan; for the goal it is half of `TrajoptController`'s."""
_OFFSET_FREE_BACKOFF = Backoff(margin=0.02, goal=0.4, force=0.05, grip=0.1)  # what is left of a wrong model
_NODES = 40
_FEWEST = 20  # control steps of the default horizon, for systems whose control steps are long
_TOLERANCE = 1e-4  # a search has converged when no input changes by more than this fraction of the force limit


@dataclass
class _Counts:
    """What happened since the controller was made.

    | count | of |
    |---|---|
    | `steps` | calls of `act` before the plan's end |
    | `iterations` | quadratic programs that were solved |
    | `failed` | steps whose program had no solution, which followed the last plan under TVLQR |
    | `replans` | whole plans that were made again because a first-exit goal was missed at the plan's end |
    """

    steps: int = 0
    iterations: int = 0
    failed: int = 0
    replans: int = 0


class NmpcController:
    """Model predictive control about the episode's plan. One iteration per control step by default (real-time iteration).

    If the quadratic program of a step fails, the step follows the last plan under TVLQR: the last solution, shifted, plus the
    gain of the episode's plan times the distance from this solution.

    | attribute | meaning |
    |---|---|
    | `plan` | the episode's plan; None before the first `reset`, which raises a PlanError where there is no plan |
    | `disturbance` | the estimate of how the robot differs from the model, if `offset_free`; else None |
    | `backoff` | the distance that its plans keep from their limits |
    | `counts` | numbers of steps, iterations and failures so far |
    """

    def __init__(
        self,
        task: Task,
        params: Robot,
        nodes: int | None = None,
        horizon: float | None = None,
        iterations: int = 1,
        backoff: Backoff | None = None,
        offset_free: bool = False,
    ):
        """Builds the program; `reset` does the planning.

        Args:
            nodes: intervals of the horizon, at most one per control step; default 40, or one per control step if friction is
                limited, because the optimal forces then change from step to step along the friction cone.
            horizon: s, a whole number of control steps; default 1 s, or 20 control steps if these are longer.
            iterations: largest number of iterations per control step: 1 is the real-time iteration; about 20 converge.
            backoff: distance of the plan from its limits; within the horizon, margins keep half of it. Default, `BACKOFF`,
                or more if `offset_free`.
            offset_free: whether to estimate how the robot's accelerations differ from the model's, and to correct the model.

        Raises:
            ValueError: the horizon is not a whole number of control steps, or has fewer than 2.
        """
        self._task = task
        self.adapt(params)
        self.backoff = backoff or (_OFFSET_FREE_BACKOFF if offset_free else BACKOFF)
        self._iterations, self._offset_free = iterations, offset_free
        if horizon is None:
            horizon = max(1.0, _FEWEST * task.control_dt)
        steps = round(horizon / task.control_dt)
        if steps < 0 or abs(steps * task.control_dt - horizon) > 1e-9:
            raise ValueError(f"horizon must be a whole number of control steps of {task.control_dt} s, not {horizon} s")
        nodes = min(nodes or (steps if params.grips else _NODES), steps)
        self._offsets, self._shift_states, self._shift_inputs = _grid(steps, nodes)
        self._qp = horizon_qp(task, params.kind, nodes)
        self.plan: Optimum | None = None
        self.disturbance: DisturbanceEstimator | None = None
        self.counts = _Counts()

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        c = np.asarray(c, np.float64)
        self._follow(t, x, c)
        self._c, self._lost = c, False
        self.disturbance = DisturbanceEstimator(self._params.force_limit) if self._offset_free else None
        self._before: tuple[np.ndarray, np.ndarray] | None = None

    def adapt(self, params: Robot) -> None:
        """Continues with the model of another robot of the same kind. The plan stays."""
        self._robot, self._params = params, params.without_dry_friction()

    def _follow(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        """Plans from state x at the episode's time t, and starts on the plan. It takes longer than a control step.

        Raises:
            PlanError: there is no plan.
        """
        task, robot = self._task, self._params
        plan = plan_to_track(task, robot, x, c, self.backoff, t)
        self._start, self.plan = t, plan
        self._trajectory = trajectory = plan.trajectory
        self._tracker = TvlqrController.for_task(task, robot, trajectory, c)
        self._tracker.reset(t, trajectory.x[0], c)
        self._length, self._step = len(trajectory.u), 0
        q, r = LinearQuadratic(task, robot, trajectory.x[:-1], trajectory.u, c, t).costs
        self._q, self._r = 2 * q, 2 * r * robot.force_limit**2  # Hessians of the cost rate in states and actions
        # of the cost-to-go from each state, whose second derivatives are the tracker's
        self._slopes = plan.slopes
        # sums of the actions before each step
        sums = np.cumsum(trajectory.u, axis=0) / robot.force_limit
        self._sums = np.concatenate([np.zeros((1, robot.action_size)), sums])
        margins = np.array([task.margins(x, task.at(c, t)) for t, x in zip(trajectory.t, trajectory.x, strict=True)])
        self._distinct = np.unique(margins, axis=1, return_index=True)[1]  # unused obstacles repeat others
        nodes = len(self._shift_inputs)
        self._dx, self._da = np.zeros((nodes + 1, robot.state_size)), np.zeros((nodes, robot.action_size))
        self._curvature = np.zeros(nodes)
        self._reserve = self._reserve_of_grip()

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        x, limit = np.asarray(x, np.float64), self._params.force_limit
        self._estimate(x)
        elapsed = round((t - self._start) / self._task.control_dt)
        if elapsed >= self._length and self._found_new_plan(t, x):
            elapsed = 0
        if elapsed >= self._length:
            u = self._tracker.act(t, x)  # the plan's end is held
        else:
            self._advance(elapsed)
            u = limit * self._qp.a[0] if self._solve(x) else self._fall_back(x)
        u = np.clip(u, -limit, limit)
        forces = self._robot.overcoming(x, u, self._task.control_dt)
        # what is left of u for the model without friction, where the limit cuts the forces
        self._before = x, u + np.clip(forces, -limit, limit) - forces
        return forces

    def _reserve_of_grip(self) -> float:
        """The reserve of grip that the horizon keeps: the back-off, or what the plan keeps if that is less."""
        if not self._params.grips:
            return 0.0
        x, u = self._trajectory.x, self._trajectory.u
        least = np.min(self._params.grip_reserve(x[:-1], u, self._task.control_dt))
        return float(np.clip(least, 0.0, self.backoff.grip))

    def _estimate(self, x: np.ndarray) -> None:
        """Fits the disturbance to what the model mispredicted over the last control step."""
        if self.disturbance is None or self._before is None or not np.isfinite(x).all():
            return
        dt = self._task.control_dt
        expected = self._params.step(*self._before, dt, self._params.substeps(dt))
        self.disturbance.fit(*self._before, (x - expected)[4:] / dt)

    def _found_new_plan(self, t: float, x: np.ndarray) -> bool:
        """At the plan's end: whether the first-exit goal was missed, and a new plan to it was found."""
        if not self._task.first_exit or self._lost:
            return False
        self.counts.replans += 1
        try:
            self._follow(t, x, self._c)
        except PlanError:
            self._lost = True
        return not self._lost

    def _advance(self, elapsed: int) -> None:
        """Shifts the last solution to now. It is stored as its deviation from the plan, which is small and smooth."""
        for _ in range(elapsed - self._step):
            self._dx, self._da = self._shift_states @ self._dx, self._shift_inputs @ self._da
        passed = self._curvature[elapsed - self._step :]
        self._curvature = np.concatenate([passed, np.zeros(len(self._curvature) - len(passed))])
        self._step = elapsed
        self._nodes = at = np.minimum(elapsed + self._offsets, self._length)
        self._lengths = np.diff(at)  # near the plan's end intervals shrink to nothing
        sums = self._sums
        self._x_plan = self._trajectory.x[at]
        self._a_plan = (sums[at[1:]] - sums[at[:-1]]) / np.maximum(self._lengths, 1)[:, None]

    def _solve(self, x: np.ndarray) -> bool:
        """Whether a solution for state x was found. It is then in the program's x and a."""
        qp, counts = self._qp, self.counts
        counts.steps += 1
        self._load(x)
        for _ in range(self._iterations):
            before = qp.a.copy()
            if not qp.iterate(0.5 * self.backoff.margin):
                counts.failed += 1
                return False
            counts.iterations += 1
            if np.abs(qp.a - before).max() < _TOLERANCE:
                break
        self._dx, self._da = qp.x - self._x_plan, qp.a[:-1] - self._a_plan
        self._curvature = qp.curvature
        return True

    def _load(self, x: np.ndarray) -> None:
        qp, dt, end = self._qp, self._task.control_dt, self._nodes[-1]
        self._guess_x, self._guess_a = self._x_plan + self._dx, self._a_plan + self._da
        qp.x[:], qp.a[:-1] = self._guess_x, self._guess_a
        qp.x[0] = x
        qp.set_robot(self._params)
        qp.distinct, qp.disturbance, qp.curvature = self._distinct, self.disturbance, self._curvature
        times = self._trajectory.t[0] + dt * self._nodes
        qp.h[:-1], qp.c[:], qp.reserve[:] = dt * self._lengths, self._task.at(self._c, times), self._reserve
        at, weight = np.minimum(self._nodes[:-1], self._length - 1), (dt * self._lengths)[:, None, None]
        qp.set_weights(
            self._q[at] * weight, self._r[at] * weight, self._tracker.gains.p[end], self._slopes[end], self._x_plan[-1]
        )

    def _fall_back(self, x: np.ndarray) -> np.ndarray:
        """The last plan under TVLQR: the last solution, shifted, with the episode plan's gains."""
        gain = self._tracker.gains.k[self._step]
        return self._params.force_limit * self._guess_a[0] - gain @ (x - self._guess_x[0])


def _grid(steps: int, nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`nodes` intervals N over a number of control steps: the first one step, the rest as equal as can be.

    Returns:
        How many control steps after now the nodes lie, (N+1,). What takes values at the nodes to the values one control step
        later, linear between and constant beyond, (N+1, N+1). What takes values held over the intervals to their means one
        control step later, 0 beyond the end, (N, N).

    Raises:
        ValueError: fewer than 2 nodes, or fewer control steps than nodes.
    """
    if not 2 <= nodes <= steps:
        raise ValueError(f"a horizon of {steps} control steps takes 2 to {steps} nodes, not {nodes}")
    base, longer = divmod(steps - 1, nodes - 1)
    lengths = np.array([1] + [base] * (nodes - 1 - longer) + [base + 1] * longer)
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    of_states = np.array([np.interp(offsets + 1, offsets, unit) for unit in np.eye(nodes + 1)]).T
    held = np.repeat(np.eye(nodes), lengths, axis=0)  # (steps, N)
    later = np.vstack([held[1:], np.zeros((1, nodes))])
    return offsets, of_states, np.add.reduceat(later, offsets[:-1], axis=0) / lengths[:, None]
