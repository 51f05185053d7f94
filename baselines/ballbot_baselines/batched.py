"""Optima of thousands of episodes at once, by iLQR with force limits on batches, for tasks that come to rest freely.

Every episode starts from its cheapest simulated recovery (`righting.simulate`). Each iteration linearizes the control steps
along all episodes, sweeps backwards with the box-constrained Riccati recursion of Tassa et al., "Control-limited differential
dynamic programming" (2014), and rolls the new feedback out, with shorter steps where the cost rises. Episodes that no
longer improve leave the batch. Matrices of all episodes are multiplied at once, on a CPU or a GPU.

An episode is optimized for its first seconds, and LQR's cost-to-go counts for what is left: there the robot is nearly at
rest. The cost that is returned is that of the whole episode in the closed form, under these forces and LQR's after them. So
it is the cost of an episode that exists, and never below the optimum.

It knows no margins: episodes that violate one, and those that no recovery survives, are not solved. Measured on Stabilize:
see `benchmarks/batched_optima.py`.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ballbot_baselines import righting
from ballbot_baselines.linearize import quadratic_cost
from ballbot_baselines.lqr import discrete_lqr, is_equilibrium
from ballbot_gym import dynamics
from ballbot_gym.lazy import missing
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task

try:
    import torch
except ModuleNotFoundError as error:
    raise missing(__name__, error.name) from error

_SECONDS = 3.0  # optimized; LQR's cost-to-go counts for the rest
_AT_ONCE = 4096  # episodes that are optimized together; of fewer, the time for calling torch counts
_CHUNK = 16_384  # episodes whose trajectories are in memory together, some 60 kB each
# of simulated recoveries: bandwidth, rad/s; time constant, s; lean to the side, rad, and how fast it fades, s
_FAMILY = tuple(itertools.product((7.0, 14.0), (1.0, 1.4), (0.0,), (1.0,)))
_SIDEWAYS_FAMILY = tuple(itertools.product((7.0, 10.0, 14.0), (1.0, 1.8), (-0.6, -0.3, 0.3, 0.6), (0.3,)))
_MOST_ITERATIONS = 15
_SHORTER_STEPS = (0.5, 0.2, 0.05, 0.01)  # shares of a step that are tried where the whole step raises the cost
_TOLERANCE = 1e-5  # relative: an iteration that lowers the cost by less is the last
_FORCE_UNIT = 100.0  # N: scales the forces, so that all derivatives are of about the same size
_SHIFT = 1e-6  # of the differences, in rad, rad/s and `_FORCE_UNIT`
_FORCE_BACKOFF = 1e-7  # of the force limit, as in `optimum.Backoff`


@dataclass(frozen=True)
class BatchOptima:
    """Optima of B episodes of n control steps.

    | field | shape | meaning |
    |---|---|---|
    | costs | (B,) | NaN where not solved |
    | solved | (B,) bool | it converged, and no margin is violated |
    | states | (B, n+1, 8) | |
    | forces | (B, n, 2) | N |
    | gains | (B, n, 2, 8) | K of the feedback u − K (x' − x) about the optimum, N per unit of the state |
    | slopes | (B, n, 8) | of the remaining cost with respect to each state but the last |
    | iterations | (B,) | until it converged |
    """

    costs: np.ndarray
    solved: np.ndarray
    states: np.ndarray
    forces: np.ndarray
    gains: np.ndarray
    slopes: np.ndarray
    iterations: np.ndarray


def solves(task: Task, params: BallbotParams) -> bool:
    """Whether `find_optima` solves this task: it comes to rest in an equilibrium, and only tilt and arena limit it."""
    if task.first_exit or params.grips:
        return False
    x, c = task.sample(np.random.default_rng(0), params)
    reference = task.reference(x, c, params)
    free = len(task.margins(tuple(x), tuple(c))) == len(Task.margins(task, tuple(x), tuple(c)))
    return free and not len(c) and len(reference.x) == 1 and is_equilibrium(params, reference.x[0], reference.u[0])


def find_optima(
    task: Task,
    params: BallbotParams,
    x0: np.ndarray,
    forces: np.ndarray | None = None,
    device: str = "cpu",
) -> BatchOptima:
    """Optimizes B episodes.

    Args:
        task: one that `solves` admits.
        params: the robot.
        x0: (B, 8) initial states.
        forces: (B, k, 2) N, of episodes to start from where they are cheaper than the simulated recoveries, as those of a
            policy; k at least `optimized_steps(task)`.
        device: of torch, where the episodes are optimized.

    Raises:
        ValueError: the task is none that it solves, or an array has the wrong shape.
    """
    if not solves(task, params):
        raise ValueError(f"{task.id} with this robot is not solved in batches; take find_optimum")
    x0 = np.asarray(x0, np.float64)
    if x0.ndim != 2 or x0.shape[1] != 8:
        raise ValueError(f"x0 must have the shape (B, 8), not {x0.shape}")
    steps = optimized_steps(task)
    if forces is not None and (forces.shape[::2] != (len(x0), 2) or forces.shape[1] < steps):
        raise ValueError(f"forces must have the shape ({len(x0)}, at least {steps}, 2), not {forces.shape}")
    solver = _Solver(task, params, device)
    parts = []
    for rows in _chunks(len(x0)):
        starts = [_recoveries(task, params, x0[rows])]
        if forces is not None:
            starts.append(forces[rows, :steps].transpose(1, 2, 0))
        parts.append(solver.solve(x0[rows], starts))
    return BatchOptima(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in BatchOptima.__annotations__)
    )


def optimized_steps(task: Task) -> int:
    """Control steps at the start of an episode that `find_optima` optimizes."""
    return min(task.steps, round(_SECONDS / task.control_dt))


def _chunks(count: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, max(count, 1), _CHUNK))


def _recoveries(task: Task, params: BallbotParams, x0: np.ndarray) -> np.ndarray:
    """(steps, 2, B) forces of the cheapest simulated recovery of each episode; none where none survives.

    Where none in the plane of the fall survives, recoveries to its sides are tried.
    """
    steps, dt = optimized_steps(task), task.control_dt
    target = task.reference(np.zeros(8), np.zeros(0), params).x[-1, :2]
    best, chosen = np.full(len(x0), np.inf), np.zeros((steps, 2, len(x0)))
    for member in (*_FAMILY, *_SIDEWAYS_FAMILY):
        rows = np.arange(len(x0)) if member in _FAMILY else np.flatnonzero(best == np.inf)
        gains = np.tile(np.array(member)[:, None], (1, len(rows)))
        with np.errstate(all="ignore"):  # members that fall may overflow
            x, u = righting.simulate(params, x0[rows], gains, target, steps, dt, params.force_limit)
            costs = np.asarray(task.cost(x[:-1], u, np.zeros(0))).sum(0)
            margins = [np.broadcast_to(margin, x.shape[:2]) for margin in task.margins(x, np.zeros(0))]
            costs = np.where((np.array(margins) >= 0).all((0, 1)), costs, np.inf)
        better = costs < best[rows]
        best[rows[better]] = costs[better]
        chosen[..., rows[better]] = u[:, better].transpose(0, 2, 1)
    return chosen


class _Solver:
    """The batched optimizer of one task. Within, the episodes are the last axis: x (8, B), u (2, B)."""

    def __init__(self, task: Task, params: BallbotParams, device: str):
        self._task, self._params = task, params
        rest = task.reference(np.zeros(8), np.zeros(0), params)
        self._rest = torch.tensor(rest.x[-1], dtype=torch.float64, device=device)[:, None]
        self._limit = params.force_limit * (1 - _FORCE_BACKOFF)
        k, p = discrete_lqr(task, params, rest.x[-1], rest.u[-1], np.zeros(0))
        q, r = quadratic_cost(task, rest.x[-1:], rest.u[-1:], np.zeros(0))
        self._lqr, self._p, self._q, self._r = (
            torch.tensor(each, device=device) for each in (k, p, q[0] * task.control_dt, r[0] * task.control_dt)
        )
        self._device = device

    @torch.no_grad()
    def solve(self, x0: np.ndarray, starts: list[np.ndarray]) -> BatchOptima:
        """Args: x0 (B, 8); forces (T, 2, B), of which the cheapest are the start."""
        count, steps = len(x0), len(starts[0])
        start = torch.tensor(x0.T, device=self._device)
        u, x = start.new_zeros(steps, 2, count), start.new_zeros(steps + 1, 8, count)
        gains, slopes = u.new_zeros(steps, 2, 8, count), u.new_zeros(steps, 8, count)
        cost = u.new_full((count,), torch.inf)
        for few in torch.arange(count, device=self._device).split(_AT_ONCE):
            for forces in starts:
                held = torch.tensor(forces, device=self._device)[..., few]
                new_x, new_u, new = self._roll(start[:, few], held, gains[..., few], x[..., few])
                lower = new < cost[few]
                at = few[lower]
                x[..., at], u[..., at], cost[at] = new_x[..., lower], new_u[..., lower], new[lower]
        iterations = torch.zeros(count, dtype=torch.int64, device=self._device)
        converged = torch.zeros(count, dtype=torch.bool, device=self._device)
        left = torch.nonzero(cost.isfinite())[:, 0]
        while len(left):
            few = left[:_AT_ONCE]  # where some are done, others take their places
            before = cost[few]
            change, feedback, slope, promised = self._backward(x[..., few], u[..., few])
            gains[..., few], slopes[..., few] = feedback, slope
            new_x, new_u, new = self._roll(start[:, few], u[..., few] + change, feedback, x[..., few])
            worse = torch.nonzero(new >= before)[:, 0]
            if len(worse):
                shorter = self._with_shorter_steps(few[worse], start, x, u, change[..., worse], feedback[..., worse])
                new_x[..., worse], new_u[..., worse], new[worse] = shorter
            lower = new < before
            at = few[lower]
            x[..., at], u[..., at], cost[at] = new_x[..., lower], new_u[..., lower], new[lower]
            iterations[few] += 1
            done = lower & (promised < _TOLERANCE * before)
            converged[few[done]] = True
            given_up = ~lower | (iterations[few] >= _MOST_ITERATIONS)
            left = torch.cat([few[~(done | given_up)], left[_AT_ONCE:]])
        return self._finish(x, u, gains, slopes, converged.cpu().numpy(), iterations.cpu().numpy())

    def _with_shorter_steps(
        self,
        rows: torch.Tensor,
        start: torch.Tensor,
        x: torch.Tensor,
        u: torch.Tensor,
        change: torch.Tensor,
        feedback: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """As `_roll`, for each of the rows with the best of `_SHORTER_STEPS`; all are tried at once."""
        tries, count = len(_SHORTER_STEPS), len(rows)
        shares = u.new_tensor(_SHORTER_STEPS).repeat_interleave(count)
        forces = u[..., rows].repeat(1, 1, tries) + shares * change.repeat(1, 1, tries)
        about, gains = x[..., rows].repeat(1, 1, tries), feedback.repeat(1, 1, 1, tries)
        states, forces, costs = self._roll(start[:, rows].repeat(1, tries), forces, gains, about)
        best = costs.view(tries, count).argmin(0) * count + torch.arange(count, device=rows.device)
        return states[..., best], forces[..., best], costs[best]

    def _step(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        dt = self._task.control_dt
        return torch.stack(dynamics.step(self._params, x.unbind(0), u.unbind(0), dt, dynamics.substeps_for(dt)))

    def _cost(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return self._task.control_dt * self._task.cost(x.unbind(0), u.unbind(0), ())

    def _roll(
        self, start: torch.Tensor, u: torch.Tensor, gains: torch.Tensor, about: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Simulates u − K (x − about): states (T+1, 8, B), forces (T, 2, B), and the cost with LQR's after them (B,)."""
        x, cost = [start], torch.zeros_like(start[0])
        forces = []
        for k in range(len(u)):
            force = u[k] - (gains[k] * (x[-1] - about[k])).sum(1)
            forces.append(force.clamp(-self._limit, self._limit))
            cost = cost + self._cost(x[-1], forces[-1])
            x.append(self._step(x[-1], forces[-1]))
        states, off = torch.stack(x), x[-1] - self._rest
        cost = cost + (off * (self._p @ off)).sum(0)
        upright = dynamics.cos_tilt(states.unbind(1)).amin(0) > np.cos(self._task.max_tilt)  # NaN is not
        return states, torch.stack(forces), torch.where(upright, cost, torch.inf)

    def _slopes_of_accelerations(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """(B, 4, 6) slopes of the accelerations in leans, lean rates and forces / `_FORCE_UNIT`; nothing else moves them.

        Differences are some ten times faster here than automatic differentiation, and exact to 1e-6.
        """
        at = torch.stack([x[2], x[3], x[6], x[7], u[0] / _FORCE_UNIT, u[1] / _FORCE_UNIT])
        shifts = _SHIFT * torch.eye(6, 7, dtype=x.dtype, device=x.device)  # the last of 7 points is not shifted
        gamma, theta, gamma_dot, theta_dot, fx, fy = (at[:, None] + shifts[:, :, None]).unbind(0)
        zero = torch.zeros_like(gamma)
        state = zero, zero, gamma, theta, zero, zero, gamma_dot, theta_dot
        found = torch.stack(dynamics.accelerations(self._params, state, (_FORCE_UNIT * fx, _FORCE_UNIT * fy)))
        return ((found[:, :6] - found[:, 6:]) / _SHIFT).permute(2, 0, 1)

    def _linearized(self, x: torch.Tensor, after: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """[A B] (B, 8, 10) of the control step, from its derivatives in its middle: their error is of third order."""
        dt, slopes = self._task.control_dt, self._slopes_of_accelerations(0.5 * (x + after), u)
        rates = x.new_zeros(x.shape[1], 8, 10)
        rates[:, range(4), range(4, 8)] = dt
        rates[:, 4:, 2:4], rates[:, 4:, 6:8] = dt * slopes[..., :2], dt * slopes[..., 2:4]
        rates[:, 4:, 8:] = dt / _FORCE_UNIT * slopes[..., 4:]
        total, power = rates.clone(), rates
        for k in (2, 3):
            power = torch.bmm(rates[..., :8], power) / k
            total += power
        total[:, range(8), range(8)] += 1.0
        return total

    def _backward(self, x: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Changes of the forces (T, 2, B), feedback K (T, 2, 8, B), slopes of the cost-to-go (T, 8, B), and by how much the
        linear model says that the changes lower the cost (B,).
        """
        count = x.shape[-1]
        slope = 2 * (self._p @ (x[-1] - self._rest)).T
        value, promised = 2 * self._p.expand(count, 8, 8), torch.zeros_like(slope[:, 0])
        changes, feedbacks, slopes = [], [], []
        for k in range(len(u) - 1, -1, -1):
            linear = self._linearized(x[k], x[k + 1], u[k])
            hessian = torch.bmm(linear.transpose(1, 2), torch.bmm(value, linear))
            gradient = torch.bmm(linear.transpose(1, 2), slope[:, :, None])[:, :, 0]
            hessian[:, :8, :8] += 2 * self._q
            hessian[:, 8:, 8:] += 2 * self._r
            gradient[:, :8] += 2 * (self._q @ (x[k] - self._rest)).T
            gradient[:, 8:] += 2 * (self._r @ u[k]).T
            of_force, mixed = hessian[:, 8:, 8:], hessian[:, 8:, :8]
            change, inverse = _box_step(of_force, gradient[:, 8:], -self._limit - u[k].T, self._limit - u[k].T)
            feedback = torch.bmm(inverse, mixed)
            moved = torch.bmm(of_force, change[:, :, None])[:, :, 0] + gradient[:, 8:]
            promised = promised - 0.5 * (change * (moved + gradient[:, 8:])).sum(1)
            slope = (
                gradient[:, :8]
                + torch.bmm(mixed.transpose(1, 2), change[:, :, None])[:, :, 0]
                - torch.bmm(feedback.transpose(1, 2), moved[:, :, None])[:, :, 0]
            )
            value = hessian[:, :8, :8] - torch.bmm(mixed.transpose(1, 2), feedback)
            value = 0.5 * (value + value.transpose(1, 2))
            changes.append(change.T)
            feedbacks.append(feedback.permute(1, 2, 0))
            slopes.append(slope.T)
        return torch.stack(changes[::-1]), torch.stack(feedbacks[::-1]), torch.stack(slopes[::-1]), promised

    def _finish(
        self,
        x: torch.Tensor,
        u: torch.Tensor,
        gains: torch.Tensor,
        slopes: torch.Tensor,
        converged: np.ndarray,
        iterations: np.ndarray,
    ) -> BatchOptima:
        """Goes on with LQR to the episodes' end, and counts the cost of all of it."""
        rest, states, forces = self._task.steps - len(u), [x[-1]], []
        for _ in range(rest):
            forces.append((self._lqr @ (self._rest - states[-1])).clamp(-self._limit, self._limit))
            states.append(self._step(states[-1], forces[-1]))
        ends = torch.stack(states)
        slopes = torch.cat([slopes, 2 * torch.einsum("ij,kjb->kib", self._p, ends[:-1] - self._rest)])
        gains = torch.cat([gains, self._lqr[None, :, :, None].expand(rest, 2, 8, x.shape[-1])])
        x, u = torch.cat([x[:-1], ends]), torch.cat([u, *(force[None] for force in forces)])
        cost = self._cost(x[:-1].transpose(0, 1), u.transpose(0, 1)).sum(0)
        within = torch.stack([m.expand(x.shape[::2]).amin(0) for m in self._task.margins(x.unbind(1), ())]).amin(0) >= 0
        solved = converged & within.cpu().numpy() & cost.isfinite().cpu().numpy()
        return BatchOptima(
            costs=np.where(solved, cost.cpu().numpy(), np.nan),
            solved=solved,
            states=x.permute(2, 0, 1).cpu().numpy(),
            forces=u.permute(2, 0, 1).cpu().numpy(),
            gains=gains.permute(3, 0, 1, 2).cpu().numpy(),
            slopes=slopes.permute(2, 0, 1).cpu().numpy(),
            iterations=iterations,
        )


def _box_step(
    hessian: torch.Tensor, gradient: torch.Tensor, low: torch.Tensor, high: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The d (B, 2) within [low, high] that minimizes ½ dᵀHd + gᵀd, and the inverse of H (B, 2, 2) in its free components.

    In two dimensions it is the free minimum, or else the least of the minima on the four edges.
    """
    a, b, c = hessian[:, 0, 0], hessian[:, 0, 1], hessian[:, 1, 1]
    g0, g1 = gradient.unbind(1)
    determinant = a * c - b * b
    free = torch.stack([b * g1 - c * g0, b * g0 - a * g1], 1) / determinant[:, None]
    inside = ((free >= low) & (free <= high)).all(1)
    edges = []
    for edge in (low, high):
        d0, d1 = edge.unbind(1)
        edges += [
            torch.stack([d0, (-(g1 + b * d0) / c).clamp(low[:, 1], high[:, 1])], 1),
            torch.stack([(-(g0 + b * d1) / a).clamp(low[:, 0], high[:, 0]), d1], 1),
        ]
    tried = torch.stack(edges)
    d0, d1 = tried.unbind(-1)
    costs = 0.5 * (a * d0 * d0 + c * d1 * d1) + b * d0 * d1 + g0 * d0 + g1 * d1
    best = tried[costs.argmin(0), torch.arange(len(a), device=a.device)]
    step = torch.where(inside[:, None], free, best)
    moves = (step > low) & (step < high)
    both = moves.all(1)
    bottom = torch.where(both, determinant, 1.0)
    zero = torch.zeros_like(a)
    first = torch.where(both, c / bottom, torch.where(moves[:, 0], 1 / a, zero))
    second = torch.where(both, a / bottom, torch.where(moves[:, 1], 1 / c, zero))
    mixed = torch.where(both, -b / bottom, zero)
    return step, torch.stack([first, mixed, mixed, second], 1).view(-1, 2, 2)
