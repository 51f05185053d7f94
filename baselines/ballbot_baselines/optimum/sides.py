"""What every choice of sides in a slalom will cost, predicted without solving it.

Across the way, the robot is nearly linear, and the sides hardly change how it moves along the way. So the times at which it
passes the obstacles are taken from one solution, such as that of the slalom without its obstacles. A small quadratic program
then finds the cheapest linear motion across the way that is on the right side of every obstacle at these times.

Without obstacles the optimal force is LQR's, u = −K y. Forces v added to it cost Σ s·v², with s = R + BᵀPB, and move the
position by the impulse response g of the closed loop. So the cheapest way to move by d at the times t costs dᵀ k(t, t)⁻¹ d,
with the kernel k(t, t') = Σ_r g(t − r) g(t' − r) / s. The program over d is solved for all choices at once, active set by
active set.

The prediction is no bound. It was measured on 350 random slaloms, with every choice solved. Each time the best choice, or one
that costs at most 0.1 % more, had a predicted cost at most 0.7 % above the lowest.
"""

import itertools
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.linalg

from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_gym.tasks import Task

GRIPPING_DOUBT = 0.02
"""`_Prediction.doubt` of robots that have to grip, because predictions ignore friction."""
_DOUBT = 0.01
_ACROSS = [1, 3, 5, 7]  # y, θ, ẏ, θ̇ in a state
_REGULARIZATION = 1e-9  # of the kernel, m²: obstacles passed in the same control step


@dataclass(frozen=True)
class _Prediction:
    """What follows from every choice of sides, in B slaloms of n obstacles.

    | field | shape | meaning |
    |---|---|---|
    | sides | (2^n, n) | −1 or 1, as in `Weave.routed_path` |
    | costs | (B, 2^n) | what the choice costs more than the motion without obstacles |
    | passed | (B, n) | control steps at which obstacles are passed |
    | free | (B, steps+1) | the ground position across the way without obstacles, m |
    | pushes | (B, 2^n, n) | multipliers of the obstacles, positive to the left |
    | responses | (steps+1, steps) | the position's response to forces, divided by √s |
    | doubt | | a choice whose predicted cost exceeds the lowest by more than this share need not be solved |
    """

    sides: np.ndarray
    costs: np.ndarray
    passed: np.ndarray
    free: np.ndarray
    pushes: np.ndarray
    responses: np.ndarray
    doubt: float

    def y(self, slalom: int) -> np.ndarray:
        """(2^n, steps+1) the ground position across the way in one slalom, m."""
        return self.free[slalom] + self.pushes[slalom] @ self.responses[self.passed[slalom]] @ self.responses.T


def predict(
    task: Task, params: Any, x0: np.ndarray, goal_y: np.ndarray, along: np.ndarray, obstacles: np.ndarray
) -> _Prediction:
    """Predicts every choice of sides, in B slaloms at once.

    Args:
        task, params: the slalom and the robot.
        x0: (B, 8) initial states.
        goal_y: (B,) m.
        along: (B, steps+1) x of one solution of each, m.
        obstacles: (B, n, 3) as `Task.passed_obstacles` gives.
    """
    motions, responses = _model(task, params)
    n, passed = obstacles.shape[1], np.abs(along[:, :, None] - obstacles[:, None, :, 0]).argmin(1)
    across = x0[:, _ACROSS] - np.pad(goal_y[:, None], ((0, 0), (0, 3)))
    free = goal_y[:, None] + np.einsum("nk,bk->bn", motions, across)
    sides, at = np.array(list(itertools.product((-1, 1), repeat=n))), responses[passed]
    kernels = at @ at.transpose(0, 2, 1) + _REGULARIZATION * np.eye(n)
    beyond = obstacles[..., 1] - np.take_along_axis(free, passed, 1)
    least = sides * (beyond[:, None] + sides * obstacles[:, None, :, 2])
    matrices = kernels[:, None] * sides[:, :, None] * sides[:, None, :]
    prices = _prices(matrices.reshape(-1, n, n), least.reshape(-1, n)).reshape(least.shape)
    costs = np.einsum("bsi,bsij,bsj->bs", prices, matrices, prices)
    doubt = GRIPPING_DOUBT if params.grips else _DOUBT
    return _Prediction(sides, costs, passed, free, sides * prices, responses, doubt)


@lru_cache(maxsize=8)
def _model(task: Task, params: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of the motion across the way: (steps+1, 4) positions without obstacles by initial state, and (steps+1, steps) impulse
    responses divided by √s.
    """
    params = params.ideal()  # with wheels it moves nearly as without
    no_constants = np.zeros(len(task.constant_names))
    at_rest = LinearQuadratic(task, params, np.zeros((1, 8)), np.zeros((1, 2)), no_constants)
    ((a,), (b,)), ((q,), (r,)) = at_rest.dynamics, at_rest.step_costs
    a, b = a[np.ix_(_ACROSS, _ACROSS)], b[_ACROSS, 1:]
    q, r = q[np.ix_(_ACROSS, _ACROSS)], r[1:, 1:]
    p = scipy.linalg.solve_discrete_are(a, b, q, r)
    price = r + b.T @ p @ b
    closed = a - b @ np.linalg.solve(price, b.T @ p @ a)
    powers = [np.eye(4)]
    for _ in range(task.steps):
        powers.append(closed @ powers[-1])
    impulse = np.array([0.0, *((power @ b)[0, 0] for power in powers[:-1])])
    responses = scipy.linalg.toeplitz(impulse, np.zeros(task.steps))
    return np.array([power[0] for power in powers]), responses / np.sqrt(price[0, 0])


def _prices(matrices: np.ndarray, least: np.ndarray) -> np.ndarray:
    """(n, m) multipliers λ ≥ 0 of n programs: minimize λᵀMλ/2 − hᵀλ with M = `matrices`, kernels with the sides' signs, and
    h = `least`.
    """
    prices, open_ = np.zeros(least.shape), np.ones(len(least), bool)
    scale = 1e-9 * np.abs(least).max(initial=1.0)
    for active in itertools.product((False, True), repeat=least.shape[1]):
        at = np.flatnonzero(active)
        tried = np.zeros(least.shape)
        if len(at):
            tried[:, at] = np.linalg.solve(matrices[:, at[:, None], at], least[:, at, None])[..., 0]
        reached = np.einsum("nij,nj->ni", matrices, tried)
        solved = open_ & (tried >= -scale).all(1) & (reached >= least - 10 * scale).all(1)
        prices[solved], open_ = tried[solved], open_ & ~solved
    return prices
