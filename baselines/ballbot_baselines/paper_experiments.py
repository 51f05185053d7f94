"""The paper's experiments in simulation: its plans under feedback, and LQR beside trajectory optimization."""

from dataclasses import dataclass

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


@dataclass(frozen=True)
class TrackedPlan:
    """A plan and its execution under TVLQR, in PyBullet where it is installed.

    `error` is the largest distance between the two paths, m.
    """

    plan: Plan
    executed: Trajectory
    error: float


@dataclass(frozen=True)
class Stabilization:
    """One episode of Stabilize from the initial state of a paper's problem; `rate` is the rate of feedback, Hz."""

    controller: str
    rate: float
    episode: Episode


def track_plan(plan: Plan, params: BallbotParams) -> TrackedPlan:
    """Executes a plan under TVLQR in PyBullet, with the weights of the paper's cost."""
    trajectory, dt = plan.trajectory, TRACKING_DT
    controller = TvlqrController.for_weights(params, trajectory, dt, _STATE_WEIGHTS, _FORCE_WEIGHTS)
    executed = simulate(controller, params, trajectory.x[0], round(trajectory.duration / dt) * dt, dt)
    planned = np.array([trajectory.state(t) for t in executed.t])
    return TrackedPlan(plan, executed, error=float(np.hypot(*(executed.x - planned)[:, :2].T).max()))


def compare_stabilization(entry: PaperProblem) -> list[Stabilization]:
    """LQR and trajectory optimization in PyBullet, both with Stabilize's weights, as in the paper's Figs 2 and 3."""
    envs = {
        "lqr": BallbotEnv("stabilize", control_dt=LQR_DT, physics_dt=LQR_DT / 4),
        "trajopt": BallbotEnv("stabilize"),
    }
    options = {"state": entry.problem.initial[0]}
    runs = []
    for name, env in envs.items():
        episode = rollout(env, CONTROLLERS[name](env.task, env.params), options=options)
        runs.append(Stabilization(name, 1 / env.task.control_dt, episode))
        env.close()
    return runs
