"""The paper's three optimizations and the problems of its figures, with the weights for which reference optima are known.

"High lean angle trajectory optimization for ball balancing robots", equations (2) to (4): direct collocation with a free
time step, costs summed over knots and not multiplied by the step, and a final-time cost S·h·N in every summand. The paper's
experiments follow in simulation: its plans under feedback, and LQR compared with trajectory optimization.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ballbot_baselines.feedback.lqr import LqrController
from ballbot_baselines.feedback.trajopt import TrajoptController
from ballbot_baselines.feedback.tvlqr import TvlqrController
from ballbot_baselines.optimum.optimum import Optimum
from ballbot_baselines.paper.collocation import Problem
from ballbot_baselines.solvers.guess import along_path
from ballbot_baselines.solvers.riccati import discrete_lqr
from ballbot_gym import ops
from ballbot_gym.env import BallbotEnv
from ballbot_gym.ops import squared
from ballbot_gym.robot import Ballbot
from ballbot_gym.rollout import Episode, rollout
from ballbot_gym.tasks.paths import cubic
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.trajectory import Trajectory

DISTANCE_WEIGHT = 1.0  # Q0, of the squared ground distance from the destination
REST_WEIGHT = 0.1  # Q1, of the other squared states
EFFORT_WEIGHT = 1e-4  # R
TIME_WEIGHT = 1.0  # S
ORBIT_WEIGHT = 0.1  # Q of the orbit's x² + y²
LEAN_LIMIT = 1.0  # rad

INTERVALS = 40
WEAVE_INTERVALS = 80  # obstacles bind at knots only: with 40 the path cuts 3 cm into them between knots

TRACKING_DT = 0.01
"""Control step at which the paper's plans are tracked, s."""
LQR_DT = 0.001
"""Control step of the paper's LQR, s. The paper's LQR is continuous."""
_WIDE_ARENA = 100.0  # m: no plan of the paper leaves it


@dataclass(frozen=True)
class PaperProblem:
    """One of the paper's experiments: the problem, the guess it is solved from, and the figure it is in."""

    title: str
    figure: str
    problem: Problem
    guess: Callable[[Ballbot], Trajectory]
    obstacles: tuple[tuple[float, float, float], ...] = ()
    """x, y and the distance that the ball's centre keeps, m."""

    def solve(self, params: Ballbot, solver: str = "ipopt") -> Optimum:
        """The optimum.

        Raises:
            PlanError: the solver stopped without it.
        """
        return self.problem.solve(params, self.guess(params), solver)

    def compare(self) -> dict[str, Episode]:
        """Episodes of LQR and of trajectory optimization in PyBullet, both with Stabilize's weights, as in the paper's
        Figs 2, 3, from the initial state of the problem.
        """
        runs = {
            "lqr": (LqrController, BallbotEnv("stabilize", control_dt=LQR_DT, physics_dt=LQR_DT / 4)),
            "trajopt": (TrajoptController, BallbotEnv("stabilize")),
        }
        episodes = {}
        for name, (kind, env) in runs.items():
            episodes[name] = rollout(env, kind(env.task, env.params), options={"state": self.problem.initial[0]})
            env.close()
        return episodes

    @staticmethod
    def track(plan: Optimum, params: Ballbot) -> tuple[Trajectory, float]:
        """A plan's execution under TVLQR, in PyBullet where it is installed, with the weights of the paper's cost.

        Returns:
            What was executed, and the largest distance between its path and the plan's, m.
        """
        trajectory, dt = plan.trajectory, TRACKING_DT
        task = Stabilize(
            control_dt=dt, position_weight=DISTANCE_WEIGHT, rest_weight=REST_WEIGHT, effort_weight=EFFORT_WEIGHT
        )
        upright = np.zeros(8), np.zeros(2), np.zeros(0)  # uniform motion upright linearizes like standing
        controller = TvlqrController.for_task(task, params, trajectory, end=discrete_lqr(task, params, *upright))
        tracked = replace(task, duration=round(trajectory.duration / dt) * dt, arena_radius=_WIDE_ARENA)
        env = BallbotEnv(tracked, params=params)
        executed = rollout(env, controller, options={"state": trajectory.x[0]}).trajectory
        env.close()
        planned = np.array([trajectory.state(t) for t in executed.t])
        return executed, float(np.hypot(*(executed.x - planned)[:, :2].T).max())


def between_states(
    name: str,
    x0: np.ndarray,
    x1: np.ndarray,
    obstacles: tuple[tuple[float, float, float], ...] = (),
    intervals: int = INTERVALS,
) -> Problem:
    """The paper's optimizations 1 and, with obstacles, 3: from state x0 to state x1, (8,) each."""

    def cost(x: ops.Vector, u: ops.Vector, h: float, q: ops.Vector) -> float:
        px, py, *rest = ops.components(x)
        return (
            DISTANCE_WEIGHT * squared(px - x1[0], py - x1[1])
            + REST_WEIGHT * squared(*rest)
            + EFFORT_WEIGHT * squared(*ops.components(u))
            + TIME_WEIGHT * h * intervals
        )

    def clearances(x: ops.Vector, u: ops.Vector, q: ops.Vector) -> tuple:
        px, py, *_ = ops.components(x)
        return tuple(squared(px - ox, py - oy) - distance**2 for ox, oy, distance in obstacles)

    return Problem(
        name=name,
        cost=cost,
        initial=(x0, x0),
        final=(x1, x1),
        intervals=intervals,
        lean_limit=LEAN_LIMIT,
        inequalities=clearances if obstacles else None,
    )


def _circular_orbit(name: str, speed: float, radius: float) -> Problem:
    """The paper's optimization 2: a closed circle at constant ground speed, m/s, from (0, y ≥ 0). Its radius q[0] is free;
    the guess of it is `radius`, m.
    """

    def cost(x: ops.Vector, u: ops.Vector, h: float, q: ops.Vector) -> float:
        px, py, *_ = ops.components(x)
        effort = EFFORT_WEIGHT * squared(*ops.components(u))
        return ORBIT_WEIGHT * squared(px, py) + effort + TIME_WEIGHT * h * INTERVALS

    def on_circle(x: ops.Vector, u: ops.Vector, q: ops.Vector) -> tuple:
        px, py, _, _, vx, vy, _, _ = ops.components(x)
        return squared(px, py) - squared(*ops.components(q)), squared(vx, vy) - speed**2

    everywhere = np.full(8, np.inf)
    lower, upper = -everywhere, everywhere.copy()
    lower[0] = upper[0] = lower[1] = 0.0
    return Problem(
        name=name,
        cost=cost,
        initial=(lower, upper),
        final=(-everywhere, everywhere),
        intervals=INTERVALS,
        lean_limit=LEAN_LIMIT,
        periodic=True,
        free=((0.1, 10.0, radius),),
        equalities=on_circle,
    )


def _hermite_guess(params: Ballbot, x0: np.ndarray, x1: np.ndarray, duration: float) -> Trajectory:
    """A smooth guess: a cubic ground path, the leans that balance its accelerations, and zero forces; duration in s."""
    path = cubic(x0[:2], x0[4:6], x1[:2], x1[4:6], INTERVALS, duration / INTERVALS)
    return _along(params, path, x0, x1, duration)


def _along(params: Ballbot, path: np.ndarray, x0: np.ndarray, x1: np.ndarray, duration: float) -> Trajectory:
    """Zero forces, and states along a ground path (intervals+1, 2), m, from x0 to x1."""
    h = duration / (len(path) - 1)
    x, _ = along_path(params, path, h)
    x[0], x[-1] = x0, x1
    return Trajectory(h * np.arange(len(path)), x, np.zeros((len(path), 2)))


def _orbit_guess(params: Ballbot, speed: float, radius: float) -> Trajectory:
    bearings = np.pi / 2 + np.linspace(0, 2 * np.pi, INTERVALS + 1)
    x, u = params.steady_orbit(radius, speed, bearings)
    return Trajectory(2 * np.pi * radius / speed / INTERVALS * np.arange(len(x)), x, u)


def _weave_guess(
    params: Ballbot, x0: np.ndarray, x1: np.ndarray, via: tuple[tuple[float, float], ...], duration: float
) -> Trajectory:
    """A spline that passes each obstacle on a chosen side, leans from its accelerations, zero forces."""
    from scipy.interpolate import CubicSpline

    points = np.array([x0[:2], *via, x1[:2]])
    s = np.linspace(0, 1, WEAVE_INTERVALS + 1)
    along = s**3 * (10 - 15 * s + 6 * s**2)
    spline = CubicSpline((points[:, 0] - points[0, 0]) / np.ptp(points[:, 0]), points)
    return _along(params, spline(along), x0, x1, duration)


def _state(x: float = 0.0, y: float = 0.0, vx: float = 0.0, vy: float = 0.0) -> np.ndarray:
    """(8,) an upright state with this ball position, m, and velocity, m/s."""
    return np.array([x, y, 0.0, 0.0, vx, vy, 0.0, 0.0])


def _point_to_point(
    name: str, title: str, figure: str, x0: np.ndarray, x1: np.ndarray, duration: float
) -> PaperProblem:
    guess = partial(_hermite_guess, x0=x0, x1=x1, duration=duration)
    return PaperProblem(title, figure, between_states(name, x0, x1), guess)


def _stabilization(speed: float, figure: str, duration: float) -> PaperProblem:
    title = f"Stabilization from x = −1 m, ẏ = {speed:g} m/s"
    return _point_to_point(f"stabilize-{speed:g}", title, figure, _state(x=-1.0, vy=speed), _state(), duration)


def _turn(speed: float, figure: str, duration: float) -> PaperProblem:
    x0, x1 = _state(y=-1.0, vy=speed), _state(x=1.0, vx=speed)
    return _point_to_point(f"turn-{speed:g}", f"90° turn at {speed:g} m/s", figure, x0, x1, duration)


def _orbit(speed: float, figure: str, radius: float) -> PaperProblem:
    problem = _circular_orbit(f"orbit-{speed:g}", speed, radius)
    guess = partial(_orbit_guess, speed=speed, radius=radius)
    return PaperProblem(f"Circular orbit at {speed:g} m/s", figure, problem, guess)


def _weave(figure: str) -> PaperProblem:
    x0, x1 = _state(), _state(x=6.0)
    obstacles = ((1.5, 0.25, 0.6), (3.0, -0.25, 0.6), (4.5, 0.25, 0.6))
    via = tuple((x, y - np.sign(y) * (distance + 0.1)) for x, y, distance in obstacles)
    return PaperProblem(
        title="Weave through three obstacles",
        figure=figure,
        problem=between_states("weave", x0, x1, obstacles, WEAVE_INTERVALS),
        guess=partial(_weave_guess, x0=x0, x1=x1, via=via, duration=3.0),
        obstacles=obstacles,
    )


PAPER_PROBLEMS: dict[str, PaperProblem] = {
    entry.problem.name: entry
    for entry in (
        _stabilization(1, "Fig. 2", 2.0),
        _stabilization(5, "Fig. 3", 3.0),
        _turn(3, "Fig. 4a", 2.0),
        _turn(10, "Fig. 4b", 6.0),
        _orbit(4, "Fig. 5a", 1.2),
        _orbit(5.5, "Fig. 5a", 1.2),
        _weave("Fig. 5b"),
    )
}
"""The paper's experiments by name."""
