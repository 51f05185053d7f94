"""An episode of any task as a problem for solvers: multiple shooting on the env's own discretization.

minimize   Σ_k cost(x_k, u_k, c)·control_dt        over forces u_k, |u_k| ≤ limit, held for control_dt
subject to x_{k+1} = step(x_k, u_k)  (RK4),   margins(x_k, c) ≥ 0,   first-exit tasks: goal(x_n, c) ≤ 0 at a free n,
           limits(x_k, u_k) ≥ 0 at both ends of each step, where the robot's friction is limited (`Ballbot.limits`)

Solvers see actions, which are forces divided by their limit.
"""

import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import casadi
import numpy as np

from ballbot_baselines.solvers import guess
from ballbot_baselines.solvers.formulas import check_formulas
from ballbot_baselines.solvers.ocp import Ocp, OcpSolver, Solution
from ballbot_gym.ops import is_number
from ballbot_gym.robot import Kind, Robot
from ballbot_gym.tasks import Task

BARRIER = 0.1
"""Of the first iterate of the solvers."""
NEAR_BARRIER = 1e-3
"""The same near a solution of nearly the same problem: it takes about half the iterations."""
SAME_BARRIER = 1e-5
"""The same near a solution of the same problem. A larger one leads from an optimum of a slalom to one nearby that touches an
obstacle in other steps and may cost more."""

FREE_TIME_INTERVALS = 60
"""Of a first-exit task whose time is free."""

_MOST_ITERATIONS = 200


@dataclass(frozen=True)
class Backoff:
    """How far a plan stays from its limits, so that a controller that tracks it stays within them.

    The defaults are as large as the solvers' tolerance, so that optimal forces and states are exactly within the limits.

    Raises:
        ValueError: a field is negative or not finite, or a fraction is not below 1.
    """

    margin: float = 1e-7
    """Distance from margins, in their unit."""
    goal: float = 1e-6
    """Share of the goal's tolerance."""
    force: float = 1e-7
    """Share of the force limit."""
    grip: float = 1e-5
    """Reserve of normal force, as a share of the weight."""

    def __post_init__(self) -> None:
        for name, below in (("margin", math.inf), ("goal", 1.0), ("force", 1.0), ("grip", 1.0)):
            value = getattr(self, name)
            if not is_number(value):
                raise ValueError(f"Backoff: {name} must be a number, not {value!r}")
            if not 0 <= value < below:
                raise ValueError(f"Backoff: {name} must be at least 0 and below {below:g}, not {value}")

    def times(self, share: float) -> "Backoff":
        """A share of every field, but not less than the field's default or, if that is less, than the field itself."""
        least = asdict(Backoff())
        return Backoff(**{name: min(value, max(share * value, least[name])) for name, value in asdict(self).items()})


@lru_cache(maxsize=64)
def ocp_of(task: Task, kind: Kind, free_time: bool = False) -> Ocp:
    """A task on its env's discretization, or with forces held longer than its control steps.

    Inputs are actions, force / limit; `Shooting.parameters` gives p. How long forces are held comes first in it, then the
    numbers of the robot. So problems on fine and coarse grids and of all robots of a kind share all compiled functions, and
    all tasks share those of the dynamics. With `free_time` one length of all intervals, s, is the last state.
    """
    n, nc, first = len(kind.robot.STATE), len(task.constant_names), 1 + len(kind.numbers)
    margin, goal, reserve = range(first + nc, first + nc + 3)  # back-offs in p

    def robot_of(p: casadi.SX) -> tuple[Any, casadi.SX]:
        """The robot, and its force limit."""
        robot = kind.model(p[1:first])
        return robot, robot.force_limit

    def of_stage(s: casadi.SX, p: casadi.SX) -> tuple[casadi.SX, casadi.SX, casadi.SX]:
        """State, length of the interval, and constants, with the stage's time if the task has a clock."""
        c, length = p[first : first + nc], s[n] if free_time else p[0]
        return s[:n], length, task.at(c, p[-2] + p[-1] * length) if task.clock else c

    def margins(s: casadi.SX, p: casadi.SX) -> casadi.SX:
        x, _, c = of_stage(s, p)
        return casadi.vertcat(*task.margins(x, c)) - p[margin]

    def path(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        if not kind.grips:
            return margins(s, p)
        robot, limit = robot_of(p)
        return casadi.vertcat(margins(s, p), *robot.limits(s[:n], limit * a, p[reserve], p[0]))

    def final(s: casadi.SX, p: casadi.SX) -> casadi.SX:
        if not task.first_exit:
            return margins(s, p)
        x, _, c = of_stage(s, p)
        # Goal functions are normalized, q/tolerance² − 1: keeping a fraction b of the tolerance asks (1−b)² − 1 − g ≥ 0.
        return casadi.vertcat(margins(s, p), (1 - p[goal]) ** 2 - 1 - casadi.vertcat(*task.goal(x, c)))

    def move(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        (x, length, _), (robot, limit) = of_stage(s, p), robot_of(p)
        if kind.robot.DISCRETE:
            return casadi.vertcat(robot.step(x, limit * a, length, substeps), s[n:])
        return casadi.vertcat(length * robot.derivative(x, limit * a), casadi.SX.zeros(int(free_time)))

    def cost(s: casadi.SX, a: casadi.SX, p: casadi.SX) -> casadi.SX:
        (x, length, c), (_, limit) = of_stage(s, p), robot_of(p)
        return task.cost(x, limit * a, c) * length

    substeps = 2 if free_time else kind.robot.substeps(task.control_dt)
    return Ocp(
        name=f"{task.id}-free-time" if free_time else task.id,
        states=n + free_time,
        inputs=len(kind.robot.ACTION),
        params=first + nc + 2 + kind.grips + task.clock,
        counts_stages=task.clock,
        next=move,
        cost=cost,
        inequalities=path,
        final_inequalities=final,
        rk4_steps=0 if kind.robot.DISCRETE else substeps,
    )


@lru_cache(maxsize=256)
def _solver(task: Task, kind: Kind, free_time: bool, *options: Any) -> OcpSolver:
    return OcpSolver(ocp_of(task, kind, free_time), *options)


@dataclass(frozen=True, eq=False)
class Shooting:
    """One episode as a problem. Guesses are states x (n+1, 8) and actions a (n, 2), forces divided by their limit."""

    task: Task
    params: Robot
    x0: np.ndarray
    c: np.ndarray
    backoff: Backoff
    start: float = 0.0
    """The episode's time at x0, s."""

    def parameters(self, coarseness: int = 1) -> list[float]:
        """p of `ocp_of`: s that forces are held, `Robot.numbers`, c, back-offs from margins and goal, of grip if friction
        is limited, and the episode's time at the start, s, if the task has a clock.
        """
        params, backoff = self.params, self.backoff
        reserve, clock = [backoff.grip] if params.grips else [], [self.start] if self.task.clock else []
        held = self.task.control_dt * coarseness
        return [held, *params.numbers(), *self.c, backoff.margin, backoff.goal, *reserve, *clock]

    def along(self, path: np.ndarray, length: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """A guess that roughly follows a ground path (n+1, 2), m, one point every `length` s; default, the control step."""
        x, u = guess.along_path(self.params, path, length or self.task.control_dt, start=self.x0)
        return x, u / self.params.force_limit

    def solve(
        self,
        x: np.ndarray,
        a: np.ndarray,
        coarseness: int = 1,
        solver: str = "fatrop",
        barrier: float = BARRIER,
        iterations: int = _MOST_ITERATIONS,
        tolerance: float | None = None,
    ) -> Solution:
        """From a guess by one solver, which is made once for all robots of a kind.

        Args:
            x: states; (n+1, 9) with a free length of all intervals, s, which is a rough guess of the time of arrival.
            a: actions.
            coarseness: control steps for which forces are held.
            solver: "fatrop" or "ipopt".
            barrier: of the first iterate.
            iterations: after which it gives up.
            tolerance: of the solver; default, the finest that it reaches.

        Raises:
            ValueError: no optimizer can use the task's formulas; see `check_formulas`.
        """
        n, known, force, dt = len(a), self.params.state_size, self.backoff.force, self.task.control_dt
        free_time = x.shape[1] > known
        # On the friction cone fatrop stalls between 1e-7 and 1e-8, at the same cost to 7 digits.
        tolerance = tolerance or (1e-6 if self.params.grips else 1e-8)
        check_formulas(self.task, self.params)
        made = _solver(self.task, self.params.kind, free_time, n, solver, tolerance, iterations, barrier)
        lower, upper = made.ocp.no_bounds(n)
        lower[0, :known] = upper[0, :known] = self.x0
        lower[:, x.shape[1] :], upper[:, x.shape[1] :] = force - 1, 1 - force
        if free_time:
            longest = self.task.duration / n
            lower[:, known], upper[:, known] = min(dt / 4, longest), longest
        return made.solve(x, a, lower, upper, self.parameters(coarseness))

    def solve_to_the_end(self, x: np.ndarray, a: np.ndarray, barrier: float = BARRIER) -> list[Solution]:
        """From a guess by fatrop, and if that fails by ipopt: all solutions, the best last.

        Args:
            x: states.
            a: actions.
            barrier: of the first try; near a solution less than `BARRIER`, which is tried then.
        """
        solutions = []
        for name, first in dict.fromkeys((("fatrop", barrier), ("fatrop", BARRIER), ("ipopt", BARRIER))):
            solutions.append(self.solve(x, a, solver=name, barrier=first))
            if solutions[-1].is_optimal:
                break
        return solutions

    def relaxed(self, x: np.ndarray, a: np.ndarray, h: float) -> Solution:
        """The solution with a free interval length from a guess with intervals of h s."""
        n, length = FREE_TIME_INTERVALS, h * len(a) / FREE_TIME_INTERVALS
        x, a = guess.motion_resampled(x, a, n)
        for name in ("fatrop", "ipopt"):
            solution = self.solve(np.column_stack([x, np.full(n + 1, length)]), a, solver=name)
            if solution.is_optimal:
                break
        return solution

    def in_whole_steps(self, relaxed: Solution) -> list[Solution]:
        """Solutions that arrive after whole numbers of control steps.

        The search begins at the arrival of a solution with a free interval length, and goes both ways while the cost falls.
        """
        most = self.task.steps
        arrival = relaxed.states[0, -1] * FREE_TIME_INTERVALS / self.task.control_dt
        steps = min(max(1, math.ceil(arrival)), most)

        def arriving(steps: int) -> list[Solution]:
            return self.solve_to_the_end(
                *guess.motion_resampled(relaxed.states[:, :-1], relaxed.inputs, steps), NEAR_BARRIER
            )

        groups = {steps: arriving(steps)}
        for direction in (-1, 1):
            nearby = steps + direction
            while 1 <= nearby <= most:
                groups[nearby] = arriving(nearby)
                found, before = groups[nearby][-1], groups[nearby - direction][-1]
                if not (found.is_optimal and (not before.is_optimal or found.cost < before.cost)):
                    break
                nearby += direction
        return [solution for group in groups.values() for solution in group]
