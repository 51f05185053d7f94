"""Guesses for optimizers: simulated episodes in which feedback brings the robot upright.

Where a guessed path asks for leans and forces that the robot cannot have, optimizers do not converge. These guesses obey the
dynamics and the force limit, because they are simulated. The feedback is a cascade: the lean steers the ball to a point, and
the clipped force steers the lean. A family of gains is simulated at once.

The force limit is a square: along its diagonal there is √2 times the force of an axis. So a robot that falls along an axis
recovers more cheaply, and from farther, if it also leans to the side. The episode that stays in the vertical plane of such a
start is a saddle point: optimizers find it only slowly, and it is no optimum. Therefore most of the family first lean to
one side of the fall.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_baselines.solvers import guess
from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.tasks import Task

_LEAN_BANDWIDTHS = (7.0, 10.0, 14.0)  # rad/s, of the lean's loop
_TIME_CONSTANTS = (1.0, 1.3, 1.8)  # s, of the ball's loop
_SIDEWAYS = (0.1, 0.3, 0.6)  # rad: lean to the side at first
_FADES = (0.3, 0.8)  # s, in which that lean fades
_LARGEST_LEAN = 0.95  # rad, that the ball's loop asks for
_GRIPPING = 0.6  # of the friction at rest, that a simulated force uses per axis: the normal force may be less
_UPRIGHT, _STEADY = 0.15, 1.0  # rad and rad/s: leans and lean rates of a robot that has righted itself


@dataclass(frozen=True)
class _Recovery:
    """One of the family's simulated episodes: states (n+1, 8), forces (n, 2), N, and what it costs.

    `side` is the side of the fall to which it leans first, −1, 0 or 1. `righted` is the step after which it is upright.
    """

    side: int
    x: np.ndarray
    u: np.ndarray
    cost: float
    righted: int

    def guesses(self, task: Task, params: Any, c: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """At most one pair of states (n+1, 8) and forces (n, 2) to start from.

        It is this motion itself where that is a whole episode to the task's point of rest. Otherwise it is this motion until
        the robot is upright, followed by the first of the task's guessed paths from there.
        """
        if len(self.u) == task.steps and _has_point(task, self.x[0], c, params):
            return [(self.x, self.u)]
        k = self.righted
        path = task.guess_paths(self.x[k], c, params)[0][: task.steps + 1 - k]
        if len(path) < 2:
            return []
        x, u = guess.along_path(params, path, task.control_dt, start=self.x[k])
        return [(np.concatenate([self.x[:k], x]), np.concatenate([self.u[:k], u]))]


def righted(
    task: Task, params: Any, x0: np.ndarray, c: np.ndarray, force: float, start: float = 0.0
) -> list[_Recovery]:
    """The cheapest member for each side of the fall that rights the robot without violating a margin, if there is one.

    From state x0 (8,) at the episode's time `start`, s, with constants c (nc,) and at most this force per axis, N.
    """
    aside = [(0.0, 0.3), *((sign * lean, fade) for lean in _SIDEWAYS for fade in _FADES for sign in (-1, 1))]
    gains = np.array([(*loops, *a) for *loops, a in itertools.product(_LEAN_BANDWIDTHS, _TIME_CONSTANTS, aside)]).T
    target = task.reference(x0, c, params).x[-1, :2] if _has_point(task, x0, c, params) else np.array(x0[:2])
    with np.errstate(all="ignore"):  # members that fall may overflow, and are left out
        force = params.FORCE_SHARE * force
        if params.grips:
            force = min(force, _GRIPPING * params.friction * params.weight)
        x, u = _simulated(task, params, x0, gains, target, force)
        t = start + task.control_dt * np.arange(len(x))[:, None]
        margins = np.min([np.broadcast_to(m, x.shape[:2]) for m in task.margins(x, task.at(c, t))], axis=0)
        safe = np.logical_and.accumulate(margins >= 0, axis=0)
        if params.grips:
            limits = params.limits(x[:-1], u, hold=task.control_dt)
            gripping = np.logical_and.reduce([limit >= 0 for limit in limits])
            safe[1:] &= np.logical_and.accumulate(gripping, axis=0)
        costs = np.asarray(task.cost(x[:-1], u, task.at(c, t[:-1])))
        upright = (np.abs(x[..., 2:4]).max(-1) < _UPRIGHT) & (np.abs(x[..., 6:8]).max(-1) < _STEADY) & safe
    found = []
    for side in (1, -1, 0):
        mine = np.flatnonzero((np.sign(gains[2]) == side) & upright.any(0))
        # Members that stay safe to the end come first: they are whole episodes.
        totals = [(not safe[-1, i], costs[:, i].sum() * task.control_dt, i) for i in mine]
        if totals:
            _, cost, i = min(totals)
            first_upright = int(np.argmax(upright[:, i]))
            last = len(u) if safe[-1, i] else first_upright
            found.append(_Recovery(side, x[: last + 1, i], u[:last, i], float(cost), first_upright))
    return found


def _simulated(
    task: Task, params: Any, x0: np.ndarray, gains: np.ndarray, target: np.ndarray, force: float
) -> tuple[np.ndarray, np.ndarray]:
    """States (steps+1, n, 8) and forces (steps, n, 2), N, of n members that steer the ball to `target` (2,), m.

    The gains (4, n) are the bandwidth of the lean's loop, rad/s; the time constant of the ball's loop, s; how far it leans to
    the left of the fall at first, rad; and the time in which that fades, s.
    """
    bandwidth, seconds, lean, fade = gains
    aside = leaning_aside(x0, lean)
    x = np.array(np.broadcast_to(np.asarray(x0, np.float64), (gains.shape[1], params.state_size)))
    states, forces, dt = [x], [], task.control_dt
    for k in range(task.steps):
        leaning = aside * np.exp(-k * dt / fade)
        u = np.stack(steering(params, tuple(x.T), leaning, bandwidth, seconds, target, force), -1)
        u = params.turning_ball(x, u).clip(-params.force_limit, params.force_limit)
        forces.append(u)
        x = params.step(x, u, dt, params.substeps(dt))
        states.append(x)
    return np.array(states), np.array(forces)


def leaning_aside(x0: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """(2, n) leans to the left of the fall, of the size `lean` (n,), rad, for initial states (8,) or (n, 8)."""
    x0 = np.atleast_2d(x0)
    falling = x0[:, 2:4] + 0.2 * x0[:, 6:8]  # rad: where the body leans, or is about to
    size = np.hypot(falling[:, :1], falling[:, 1:])
    along = np.where(size > 1e-9, falling / np.maximum(size, 1e-9), [1.0, 0.0])
    return lean * np.stack([-along[:, 1], along[:, 0]])


def steering(
    params: Any,
    x: Vector,
    aside: Vector,
    bandwidth: Any,
    seconds: Any,
    target: Vector,
    force: float,
) -> tuple[Any, ...]:
    """The cascade's force (Fx, Fy), N, for floats, arrays, tensors and symbols: components of one shape.

    Args:
        x: 8 components of the state.
        aside: 2 components of what is added to the leans that the ball's loop asks for, rad.
        bandwidth: of the lean's loop, rad/s.
        seconds: time constant of the ball's loop, s.
        target: 2 components of where to steer the ball, m.
        force: largest force per axis, N.
    """
    h, mass = params.first_moment, params.moving_mass
    inertia = params.pivot_inertia - h * h / mass  # of the lean, with a ball that is free to move
    turning = mass * params.drive_radius  # the torque that drives the ball turns the body too
    forces = []
    for axis in range(2):
        position, lean, speed, rate = x[axis] - target[axis], x[2 + axis], x[4 + axis], x[6 + axis]
        wanted = ops.arctan((-2 / seconds * speed - position / seconds**2) / params.gravity)
        wanted = ops.clip(wanted, -_LARGEST_LEAN, _LARGEST_LEAN) + aside[axis]
        turn = -(bandwidth**2) * (lean - wanted) - 2 * bandwidth * rate
        # of a body in a vertical plane: inertia · lean acceleration = h g sin(lean) − (h/M) F cos(lean)
        moment = h * params.gravity * ops.sin(lean) - inertia * turn
        forces.append(ops.clip(moment * mass / (h * ops.cos(lean) + turning), -force, force))
    return tuple(forces)


def _has_point(task: Task, x0: np.ndarray, c: np.ndarray, params: Any) -> bool:
    """Whether the task ends at a point of rest."""
    return not task.first_exit and task.reference(x0, c, params).is_point
