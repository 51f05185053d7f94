"""LQR as a controller, and its gain in the units of observations and actions."""

from dataclasses import replace

import numpy as np

from ballbot_baselines.solvers.riccati import discrete_lqr, is_equilibrium, reference_gains
from ballbot_gym import omni
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task


def equilibrium_gain(task: Task, params: BallbotParams) -> tuple[np.ndarray, np.ndarray] | None:
    """LQR in units of observations and actions, for tasks that end at rest in an equilibrium.

    Returns:
        The action per observation (2, 8), and the cost-to-go per squared observation (8, 8). The first eight observations
        of such a task are the scaled errors of the state. With wheels all no observations count: (3, no) and (no, no). None
        for every other task, and where LQR has no gain.
    """
    if task.clock:
        return None
    x, c = task.sample(np.random.default_rng(0), params)
    reference = task.reference(x, c, params)
    if task.first_exit or len(reference.x) > 1 or np.abs(np.asarray(task.observe(reference.x[0], c))[:8]).max() > 0:
        return None
    (x,), (u,) = omni.with_wheels(params, reference.x, reference.u)
    try:
        k, p = discrete_lqr(task, params, x, u, c)
    except PlanError:
        return None
    of_observation = np.zeros((len(x), 8 if params.wheels is None else task.observation_size(params)))
    of_observation[range(8), range(8)] = task.observation_scale[:8]
    if params.wheels is not None:  # sin ψ, and the others as `Task.seen` scales them
        of_observation[range(8, 11), range(-3, 0)] = 1.0, 5.0, 5.0
    return -k @ of_observation / params.force_limit, of_observation.T @ p @ of_observation


class LqrController:
    """LQR about the task's reference motion, with weights from the task's own cost.

    About an equilibrium the gain is constant. Along an open reference the gain is time-varying. Around a closed reference the
    gain is periodic, and the nearest point of the reference says which gain to use. A task with a clock gives an open one,
    with forces that look ahead, because it may be no motion of the robot.

    After `reset`, `reference` is that motion, and `gains` has a gain for each of its points.

    `reset` raises a PlanError where the reference is a single point that is no equilibrium.
    """

    def __init__(self, task: Task, params: BallbotParams):
        self._task, self._params = task, params

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        task, params = self._task, self._params
        self._start = t
        found = task.reference(x[:8], c, params)
        states, forces = omni.with_wheels(params, found.x, found.u)
        if len(states) == 1 and not is_equilibrium(params, states[0], forces[0]):
            raise PlanError(
                f"LQR of {task.id} would hold the robot at one point that it leaves by itself: a reference of one point must "
                f"rest. Let {type(task).__name__}.reference return a motion, with one point per control step"
            )
        reference = replace(found, x=states, u=forces)
        self.reference, self.gains = reference_gains(task, params, reference, c, t)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        reference = self.reference
        if reference.closed:
            i = int(np.argmin(np.sum((reference.x[:, :2] - x[:2]) ** 2, axis=1)))
        else:
            i = min(round((t - self._start) / self._task.control_dt), len(reference.x) - 1)
        return reference.u[i] - self.gains.k[i] @ (x - reference.x[i])
