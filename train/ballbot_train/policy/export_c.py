"""Policies and LQR as one C99 file, for microcontrollers: no malloc, no library but math.h, single precision.

`PolicyNetwork` says what is computed. Its frame, routes and steady motion, and the task's observation, are traced and printed
from the lines that Python runs; see `printed`.
"""

import re
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_baselines.feedback.adaptive import FilteredController
from ballbot_baselines.feedback.kalman import SensorFilter
from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_gym import files
from ballbot_gym.env import BallbotEnv
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import PAPER, Robot, Sensors, named_robot
from ballbot_gym.rollout import Controller, rollout
from ballbot_gym.tasks import Task
from ballbot_train.policy.files import PolicyError, PolicyFile, PolicySpec
from ballbot_train.policy.network import PolicyController, PolicyNetwork
from ballbot_train.policy.printed import C_IN_DOUBLE, C, policy_function
from ballbot_train.policy.weights import own_defaults
from ballbot_train.work.console import printable
from ballbot_train.work.templates import render

with imports_of(__name__):
    import casadi
    import torch

LQR = "lqr"
"""What is exported by this name is LQR, and no policy's file."""

PREFIX = "ballbot"
"""How the names of functions begin, and in capitals those of macros."""

LARGEST_ERROR = 1e-5
"""Of an action in the file's own test; float32 differs from Python by less."""

_TEST_STEPS = 16
_TEMPLATE = Path(__file__).parent / "assets" / "controller.c.j2"


@own_defaults()
def export_c(
    policy: str | Path,
    path: str | Path,
    task: Task,
    robot: str = PAPER,
    filtered: bool = False,
    prefix: str = PREFIX,
) -> Path:
    """Writes a policy, or LQR, as a C file that observes and acts; its first lines say how to use it.

    Args:
        policy: the policy's file, or "lqr" for a task whose LQR has one gain for all episodes.
        path: of the C file.
        task: what the policy was made for.
        robot: by name.
        filtered: with `SensorFilter` in front of it, which makes the state from sensors.
        prefix: of all names that the file shows to others, so that one program can hold several controllers.

    Raises:
        PolicyError: as `PolicyNetwork.load`; or the policy's actions are not finite.
        ValueError: the task's LQR, or where its filter expects to start, depends on the episode; or a frame or an observation
            cannot be printed; or the prefix is no name in C.
    """
    if not re.fullmatch("[a-z][a-z0-9_]{0,30}", prefix):
        raise ValueError(
            f"prefix must be small letters, digits and underscores, for example left_leg, not {prefix!r:.100}"
        )
    if policy == LQR:
        network, about = _lqr_network(task, robot), {"task": task.id, "problem": task.problem(), "robot": robot}
    else:
        network, about = PolicyNetwork.load(policy, task, robot).eval(), PolicyFile(policy).metadata(task, robot)
    return files.write(path, _source(network, about, task, robot, filtered, prefix))


def _lqr_network(task: Task, robot: str = PAPER) -> PolicyNetwork:
    """LQR about the equilibrium in which a task ends, as a policy of one layer.

    Raises:
        ValueError: the task ends in none.
    """
    found = equilibrium_gain(task, named_robot(robot))
    if found is None:
        raise ValueError(
            f"LQR of {task.id} has different gains in each episode, so it cannot be a C file; export a policy"
        )
    network = PolicyNetwork(PolicySpec.of(task, robot=robot, hidden=(), linear=False, odd=True, squash="clip"))
    gain = np.zeros((network.spec.actions, network.spec.observations))
    gain[:, : found[0].shape[1]] = found[0]
    network.load_state_dict({"mlp.0.weight": torch.as_tensor(gain)})
    return network.eval()


def _source(network: PolicyNetwork, about: dict[str, str], task: Task, robot: str, filtered: bool, prefix: str) -> str:
    spec, params, networks = network.spec, named_robot(robot), network.layers()
    source = render(
        _TEMPLATE,
        prefix=prefix,
        # lines of a C comment, which no text from a file can end
        about=printable("\n".join(f"{name}: {value}" for name, value in about.items())).replace("*", "×"),
        spec=spec,
        params=params,
        task=task,
        widest=max(weight.shape[0] for layers in networks.values() for weight, _ in layers),
        networks=networks,
        observed=C.function(
            "observed",
            lambda x, c, t: task.seen(tuple(casadi.vertsplit(x)), task.at(tuple(casadi.vertsplit(c)), t), params),
            {"x": params.state_size, "c": len(task.constant_names), "t": 1},
        ),
        acted=C.function("acted", policy_function(network), {"o": spec.seen}),
        filter=_filter(task, params) if filtered else None,
        test=_test(network, task, robot, filtered),
        largest_error=C.number(LARGEST_ERROR),
        number=C.number,
        numbers=lambda values: textwrap.fill(", ".join(map(C.number, values.ravel())), 120),
        exact=lambda values: textwrap.fill(", ".join(map(repr, values.tolist())), 120),
    )
    return str(source)


def _filter(task: Task, params: Robot) -> dict[str, Any]:
    """What the template needs of `SensorFilter`."""
    if task.constant_names:
        raise ValueError(
            f"the start of {task.id} depends on the episode, so the filter cannot be in a C file; leave out -ekf"
        )
    sensor_filter = SensorFilter(task, params)

    def robot(x: casadi.SX, u: casadi.SX) -> casadi.SX:
        found, slopes = sensor_filter.model(x, u)
        return casadi.vertcat(found, casadi.vec(slopes.T))

    start, deviations = sensor_filter.expected_start(np.zeros(0))
    return {
        "substeps": params.substeps(task.control_dt),
        "start": start,
        "start_variance": deviations**2,
        "model_variance": sensor_filter.model_variance,
        "reading_variance": sensor_filter.reading_variance,
        "model": C_IN_DOUBLE.function("robot", robot, {"x": params.state_size, "u": params.action_size}),
    }


def _test(network: PolicyNetwork, task: Task, robot: str, filtered: bool) -> dict[str, np.ndarray]:
    """Of an episode under the policy: states in some steps, or what sensors show in the first ones, as float32, and the
    actions that it takes on them one after the other.
    """
    params, seen = named_robot(robot), list[np.ndarray]()
    controller: Controller = PolicyController(task, params, network)
    if filtered:
        controller = FilteredController(task, params, "-ekf", controller)
    env = BallbotEnv(task, physics="rk4", robot=robot, observation="sensors" if filtered else "state")
    c = rollout(env, controller, seed=0, watch=seen.append).constants.astype(np.float32)
    k = np.arange(_TEST_STEPS) if filtered else np.linspace(0, len(seen) - 1, _TEST_STEPS).astype(int)
    shown, times = np.array(seen)[k], (k * task.control_dt).astype(np.float32)
    if filtered:
        readings = (shown[:, :9] * Sensors.SCALE).astype(np.float32)
        arrays = {"sensors": readings, "place": shown[0, 9:11]}
        shown = np.hstack([readings / np.array(Sensors.SCALE), shown[:, 9:]])
    else:
        shown = shown.astype(np.float32)
        arrays = {"states": shown}
    controller.reset(0.0, shown[0], c)
    actions = np.array([controller.act(float(t), x) for t, x in zip(times, shown, strict=True)]) / params.force_limit
    if not np.isfinite(actions).all():
        raise PolicyError("the policy's actions are not finite, so it cannot be exported; train it again")
    return arrays | {"constants": c if c.size else np.zeros(1), "times": times, "actions": actions.clip(-1, 1)}
