"""LQR as a controller, and its gain in the units of observations and actions."""

from dataclasses import replace

import numpy as np

from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_baselines.solvers.riccati import Gains, discrete_lqr, lqr_at_end
from ballbot_gym.robot import Robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Reference, Task

_MAX_ROUNDS = 50  # around a closed motion until the Riccati equation is periodic


def equilibrium_gain(task: Task, params: Robot) -> tuple[np.ndarray, np.ndarray] | None:
    """LQR in units of observations and actions, for tasks that end at rest in an equilibrium.

    Returns:
        The action per observation (2, 8), and the cost-to-go per squared observation (8, 8). The first observations of such
        a task are the scaled errors of the state. Of a robot with outputs all observations count: (3, no) and (no, no).
        None for every other task, and where LQR has no gain.
    """
    if task.clock:
        return None
    x, c = task.sample(np.random.default_rng(0), params)
    reference = task.reference(x, c, params)
    errors = params.state_size - params.OUTPUT_STATES
    if (
        task.first_exit
        or len(reference.x) > 1
        or np.abs(np.asarray(task.observe(reference.x[0], c))[:errors]).max() > 0
    ):
        return None
    (x,), (u,) = params.extended(reference.x, reference.u)
    try:
        k, p = discrete_lqr(task, params, x, u, c)
    except PlanError:
        return None
    of_observation = np.zeros((len(x), task.observation_size(params) if params.OUTPUTS else errors))
    of_observation[range(errors), range(errors)] = task.observation_scale[:errors]
    last = range(-params.OUTPUT_STATES, 0)  # the last outputs are about the remaining components of the state
    of_observation[range(errors, len(x)), last] = [params.OUTPUT_SCALE[i] for i in last]
    return -k @ of_observation / params.force_limit, of_observation.T @ p @ of_observation


class LqrController:
    """LQR about the task's reference motion, with weights from the task's own cost.

    About an equilibrium the gain is constant. Along an open reference the gain is time-varying. Around a closed reference the
    gain is periodic, and the gain of the nearest point of the reference is used. The reference of a task with a clock is
    open. Because the robot may be unable to follow it exactly, the forces take the later part of it into account.

    After `reset`, `reference` is that motion, and `gains` has a gain for each of its points.

    `reset` raises a PlanError if the reference is a single point that is not an equilibrium.
    """

    def __init__(self, task: Task, params: Robot):
        self._task, self._robot = task, params
        self._params = params.without_dry_friction()

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        task, params = self._task, self._params
        self._start = t
        found = task.reference(x, c, params)
        states, forces = params.extended(found.x, found.u)
        # the gains around a closed motion are the same at all times
        model = LinearQuadratic(task, params, states, forces, c, 0.0 if found.closed else t)
        if len(states) == 1 and not model.starts_at_rest:
            raise PlanError(
                f"the reference of {task.id} is one point, at which the robot does not rest; LQR can only hold a robot at "
                f"rest. Let {type(task).__name__}.reference return a motion, with one point per control step"
            )
        if found.closed:
            self.gains = _closed_gains(model)
        else:
            _, p_final = lqr_at_end(task, params, states[-1], c, t + task.control_dt * len(states))
            self.gains = Gains.before(p_final, model)
            if task.clock:
                forces = forces + _feedforward(model, self.gains)
        self.reference: Reference = replace(found, x=states, u=forces)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        reference = self.reference
        if reference.closed:
            i = int(np.argmin(np.sum((reference.x[:, :2] - x[:2]) ** 2, axis=1)))
        else:
            i = min(round((t - self._start) / self._task.control_dt), len(reference.x) - 1)
        u = reference.u[i] - self.gains.k[i] @ (x - reference.x[i])
        return self._robot.overcoming(x, u, self._task.control_dt)


def _closed_gains(model: LinearQuadratic) -> Gains:
    """LQR around a closed motion: the Riccati recursion goes backwards, round after round, until it is periodic."""
    after = np.eye(model.x.shape[1])
    for _ in range(_MAX_ROUNDS):
        gains = Gains.before(after, model)
        if np.allclose(after, gains.p[0], rtol=1e-6):
            return gains
        after = gains.p[0]
    raise PlanError(f"LQR around the closed motion of {model.task.id} found no periodic gain in {_MAX_ROUNDS} rounds")


def _feedforward(model: LinearQuadratic, gains: Gains) -> np.ndarray:
    """(n, 2) forces, N, to add along an open reference that is no motion of the robot, or not the cheapest near it.

    They are the forces of the cheapest motion in the linear model about the reference. LQR's gains are the feedback of the
    same model. The model includes the errors of the reference in the equations of motion, and the gradients of the cost.
    """
    x, u, dt = model.x, model.u, model.task.control_dt
    (a, b), (_, r), (of_x, of_u) = model.dynamics, model.step_costs, model.step_cost_slopes
    missed = np.zeros_like(x)
    missed[:-1] = model.params.step(x, u, dt, model.params.substeps(dt))[:-1] - x[1:]
    forces = np.zeros_like(u)
    slope = np.zeros(x.shape[1])  # half the slope of the cost-to-go, which is xᵀPx + 2 slopeᵀx
    for i in reversed(range(len(x))):
        after = gains.p[i + 1]
        slope = slope + after @ missed[i]
        along = of_u[i] / 2 + b[i].T @ slope
        forces[i] = -np.linalg.solve(r[i] + b[i].T @ after @ b[i], along)
        slope = of_x[i] / 2 + a[i].T @ slope - gains.k[i].T @ along
    return forces
