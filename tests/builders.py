"""Results as an evaluation would have made them, plain controllers, and the example's systems, for tests."""

import importlib.util
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np

from ballbot_gym.robot import ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.results import Result

CLASSIC = Path(__file__).parent.parent / "examples" / "classic"

_FIELDS = {
    "task": "stabilize",
    "controller": "lqr",
    "episode": 0,
    "physics": "rk4",
    "cost": 12.0,
    "optimum": 10.0,
    "success": True,
    "failure": False,
    "peak_tilt": 30.0,
    "settle_time": 2.0,
    "duration": 8.0,
    "plan_seconds": 0.1,
    "step_seconds": 1e-5,
}


def result(**changes):
    """An episode that LQR finished with a regret of 20 %, except for what is changed."""
    return Result(**(_FIELDS | changes))


def stress_result(stress, level, **changes):
    """The same under a disturbance."""
    return result(labels={"stress": stress, "level": level}, **changes)


def measured(cost_ratio, cost, mean_cost, success=1.0):
    """What `score_and_validate` could give."""
    certified = {"cost_ratio": cost_ratio, "regret_mean": 0.1, "regret_median": 0.1, "regret_worst": 0.1}
    validation = {"cost": cost, "success": success, "failures": 0, "mean_cost": mean_cost}
    figures = {f"certified/{name}": value for name, value in (certified | {"success": success, "failures": 0}).items()}
    return figures | {f"validation/{name}": value for name, value in validation.items()}


@dataclass(frozen=True)
class FunctionController:
    """A plain function u = f(t, x) as a Controller."""

    function: object

    def reset(self, t, x, c):
        pass

    def act(self, t, x):
        return np.asarray(self.function(t, x), np.float64)


def random_policy(task, hidden=(8,), mirrors=False, **fields):
    """A small network for a task whose outputs are not those of its start; `mirrors` are all that the task has."""
    import torch

    from ballbot_train.policy.network import PolicyNetwork, PolicySpec

    if mirrors:
        fields["mirrors"] = tuple((task.observation_signs(mirror), mirror.action) for mirror in task.mirrors)
    torch.manual_seed(0)
    network = PolicyNetwork(PolicySpec.of(task, hidden=hidden, **fields))
    torch.nn.init.normal_(network.mlp[-1].weight)
    return network


def task_and_robot(policy):
    """The names of both in the name of a shipped policy, as TASK-ROBOT-LEARNER."""
    task, *others = policy.split("-")
    return task, next((robot for robot in ROBOTS if robot in others), "paper")


@contextmanager
def classic_systems():
    """The package of `examples/classic`, whose tasks and robots are registered in this block alone."""
    folder, before = str(CLASSIC / "src"), [dict(each) for each in (TASKS, ROBOTS, gymnasium.registry)]
    sys.path.insert(0, folder)
    try:
        import ballbot_classic

        ballbot_classic.register()
        yield ballbot_classic
    finally:
        sys.path.remove(folder)
        for held, own in zip((TASKS, ROBOTS, gymnasium.registry), before, strict=True):
            held.clear()
            held.update(own)
        for name in [name for name in sys.modules if name.partition(".")[0] == "ballbot_classic"]:
            del sys.modules[name]


def script(path):
    """A file of `examples` as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
