"""The paper's experiments in simulation: its plans under feedback, and LQR beside trajectory optimization."""

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_baselines.collocation import Plan
from ballbot_baselines.paper_problems import EFFORT_WEIGHT, REST_WEIGHT, PaperProblem
from ballbot_baselines.tvlqr import TvlqrController
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Episode, rollout, simulate
from ballbot_gym.trajectory import Trajectory

TRACKING_DT = 0.01
"""Control step at which the paper's plans are tracked, s."""
LQR_DT = 0.001
"""Control step of the paper's LQR, s. The paper's LQR is continuous."""

_STATE_WEIGHTS = np.diag([1.0, 1.0, *[REST_WEIGHT] * 6])
_FORCE_WEIGHTS = EFFORT_WEIGHT * np.eye(2)


def track_plan(plan: Plan, params: BallbotParams) -> tuple[Trajectory, float]:
    """A plan's execution under TVLQR, in PyBullet where it is installed, with the weights of the paper's cost.

    Returns:
        What was executed, and the largest distance between its path and the plan's, m.
    """
    trajectory, dt = plan.trajectory, TRACKING_DT
    controller = TvlqrController.for_weights(params, trajectory, dt, _STATE_WEIGHTS, _FORCE_WEIGHTS)
    executed = simulate(controller, params, trajectory.x[0], round(trajectory.duration / dt) * dt, dt)
    planned = np.array([trajectory.state(t) for t in executed.t])
    return executed, float(np.hypot(*(executed.x - planned)[:, :2].T).max())


def compare_stabilization(entry: PaperProblem) -> dict[str, Episode]:
    """Episodes of LQR and of trajectory optimization in PyBullet, both with Stabilize's weights, as in the paper's Figs 2, 3.

    They start from the initial state of the paper's problem.
    """
    envs = {
        "lqr": BallbotEnv("stabilize", control_dt=LQR_DT, physics_dt=LQR_DT / 4),
        "trajopt": BallbotEnv("stabilize"),
    }
    episodes = {}
    for name, env in envs.items():
        controller = CONTROLLERS[name](env.task, env.params)
        episodes[name] = rollout(env, controller, options={"state": entry.problem.initial[0]})
        env.close()
    return episodes
