"""How much the errors of a recording could have lowered its costs.

Each control step of a recording may miss the engine's by a small tolerance. One error does nothing, but a whole episode of
errors that all lower the cost would do the work of a force. So for each recorded motion we compute the costate: by how much
the episode's cost rises per unit of the state. Costate times error is what an error changed in the cost. The multipliers of
limits that bind, such as the clearance of an obstacle, are not part of it: a motion alone does not tell them.
"""

import numpy as np

from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_baselines.solvers.riccati import Gains, lqr_at_end
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task

_H = 1e-5  # m, rad and per second, of finite differences


def costates(task: Task, robot: Robot, x: np.ndarray, action: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The slopes (n, 8) of an episode's cost with respect to the state after each step.

    Args:
        task: the task.
        robot: the robot.
        x: (n+1, 8) recorded states.
        action: (n, 2) recorded actions.
        c: (nc,) constants of the episode.

    After a deviation time-varying LQR steers back to the motion. Along an optimum the slopes do not depend on the
    feedback. Without feedback they would grow as fast as the robot falls.
    """
    n = len(action)
    force, before = robot.force_limit * action, x[:-1]
    model = LinearQuadratic(task, robot, before, force, c)
    (a, b), (along_x, along_u) = model.dynamics, model.step_cost_slopes
    _, final = lqr_at_end(task, robot, x[-1], c, n * task.control_dt)
    k = Gains.before(final, model).k
    costate = np.zeros_like(before)
    costate[-1] = _at_end(task, x, force[-1], c)
    for i in reversed(range(1, n)):
        costate[i - 1] = along_x[i] - k[i].T @ along_u[i] + (a[i] - b[i] @ k[i]).T @ costate[i]
    return costate


def _at_end(task: Task, x: np.ndarray, force: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The last costate (8,). A task that ends in its goal ends later if the last state is farther from the goal."""
    n = len(x) - 1
    c, earlier = (np.asarray(task.at(c, i * task.control_dt)) for i in (n, n - 1))
    distances = np.array(task.goal(x[-1], c), np.float64)
    nearest = int(np.argmax(distances))
    approach = (np.array(task.goal(x[-2], earlier), np.float64) - distances)[nearest] / task.control_dt
    if not task.first_exit or distances[nearest] > 0 or approach <= 0:
        return np.zeros(x.shape[1])
    moved = [np.subtract(task.goal(x[-1] + d, c), task.goal(x[-1] - d, c))[nearest] for d in _H * np.eye(x.shape[1])]
    return np.array(moved) / (2 * _H) * float(task.cost(x[-2], force, earlier)) / approach
