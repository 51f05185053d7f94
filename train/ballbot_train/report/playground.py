"""The playground without Python: one HTML page in which a learned policy and LQR balance next to the optimum, and the reader
pushes them, or drives an episode.

Everything is in the page: the closed-form model, the tasks' costs, limits and observations, LQR's gains and the policies'
weights. The model and the tasks are printed as JavaScript from the lines that Python runs; see `printed`.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from ballbot_baselines import LqrController
from ballbot_gym import certified, drawing
from ballbot_gym.drawing import page
from ballbot_gym.env import make_task
from ballbot_gym.robot import TRACKS, Randomization, Robot, default_params
from ballbot_gym.step import outcome
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.policy.files import BEST, PolicyError, PolicyFile, shipped_policies
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.policy.printed import JAVASCRIPT, policy_function
from ballbot_train.report import labels
from ballbot_train.report.page import asset

_UNKNOWN = {"body_mass": "mass", "com_height": "centre of mass", "force": "force"}
"""Factors that the reader may change, within those of the track "unknown", and what the page calls them."""
LARGEST = 2_000_000
"""Bytes that the page may have."""


@dataclass(frozen=True)
class _Scenario:
    """What the robots of the page are up to."""

    title: str
    text: str
    """What to look at, in a sentence or two."""
    task: str
    episodes: tuple[int | None, ...] = (None,)
    """The certified episodes that can be chosen; None is standing at rest at the origin. The text describes the first one."""
    push: tuple[float, float, float] | None = None
    """A push that comes by itself: time, s, impulse, N·s, and bearing, rad."""


SCENARIOS = (
    _Scenario(
        "Push",
        "Both robots stand still and get the same push of 90 N·s. LQR is right for small leans only, and falls. "
        "The learned policy leans 45°, brakes and comes back.",
        "stabilize",
        push=(0.6, 90.0, 0.5),  # as `ballbot play` begins
    ),
    _Scenario(
        "Throw",
        "All start fast and leaning, and are to come to rest on the green spot. Braking takes a lean of 40°.",
        "stabilize",
        (7, 0, 3, 5),
    ),
    _Scenario(
        "Orbit",
        "From rest onto a circle at 5.5 m/s, which takes a steady lean of 43°.",
        "orbit",
        (17, 1, 2, 3),
    ),
    _Scenario(
        "Turn",
        "A right-angled turn through the gate at 6.8 m/s, with as little force as possible.",
        "turn",
        (1, 2, 3, 5),
    ),
    _Scenario(
        "Weave",
        "Round five obstacles, and to rest behind them. LQR does not know of obstacles.",
        "weave",
        (12, 0, 1, 3),
    ),
)
"""Every scenario of the page."""


def playground_page(policies: Sequence[str] = (), live: bool = False) -> str:
    """The page as HTML.

    Args:
        policies: files of policies, each shown instead of the shipped one of its task.
        live: see `page_html`.

    Raises:
        PolicyError: a file is no policy, or that of one that sees more than the present observation.
        ValueError: a policy is of no registered task, two are of one task, or the page would be larger than `LARGEST`.
    """
    text = page.page_html(engine_script(policies), asset("playground.js"), live)
    size = len(text.encode())
    if size > LARGEST:
        raise ValueError(f"the page would have {size / 1e6:.2f} MB, and at most {LARGEST / 1e6:g} MB load at once")
    return text


def engine_script(policies: Sequence[str] = ()) -> str:
    """All of the page that computes, as JavaScript without a page: what the tests run in node."""
    params, paths = default_params(), _policies(policies)
    networks = {task: PolicyNetwork.load(path, make_task(task)) for task, path in paths.items()}
    data = {
        "dt": make_task("stabilize").control_dt,
        "force_limit": params.force_limit,
        **page.look(params),
        "ghost_opacity": drawing.GHOST_OPACITY,
        "lqr": {"label": labels.label("lqr"), "color": labels.color("lqr")},
        "policies": {task: _policy_data(paths[task], network) for task, network in networks.items()},
        "unknown": {label: getattr(TRACKS["unknown"], name) for name, label in _UNKNOWN.items()},
        "you": {"label": "you", "color": labels.YOU},
        "best": {"label": "optimum", "color": labels.OPTIMUM},
        "scenarios": [_scenario_data(each, episode, params) for each in SCENARIOS for episode in each.episodes],
    }
    # Within a script, "<" could end it.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False, default=_packed).replace("<", "\\u003c")
    return "\n".join([_model_script(params, networks), f"const DATA = {text};", asset("engine.js")])


def _policies(given: Sequence[str]) -> dict[str, Path]:
    """The file of each task's policy."""
    paths: dict[str, Path] = {}
    for policy in given:
        name = ControllerName(str(policy))
        task = name.task(None)
        if task in paths:
            raise ValueError(f"{paths[task]} and {policy} are both policies for {task}; give one")
        paths[task] = name.path(make_task(task))
    return {task: paths.get(task, shipped_policies(make_task(task))[learner]) for task, learner in BEST.items()}


def _policy_data(path: Path, network: PolicyNetwork) -> dict[str, Any]:
    """The data of a policy, besides the printed functions."""
    if network.spec.seen != network.spec.observations:
        raise PolicyError(
            f"{path} needs a history or its robot's parameters, which the page does not compute; give another policy"
        )
    name = str(PolicyFile(path).read().get("training", {}).get("learner", path.stem))
    return {
        "label": labels.label(name),
        "color": labels.color(name),
        "activation": network.spec.activation,
        **network.layers(),
    }


def _scenario_data(scenario: _Scenario, episode: int | None, params: Robot) -> dict[str, Any]:
    task = make_task(scenario.task)
    state, constants, optimum, best = np.zeros(8), np.zeros(0), None, None
    if episode is not None:
        episodes = certified.load(task, params)
        state, constants = episodes.states[episode], episodes.constants[episode]
        optimum = float(episodes.costs[episode])
        trajectory = episodes.trajectories[episode]
        best = {"x": np.float32(trajectory.x), "u": np.float32(trajectory.u)}
    lqr = LqrController(task, params)
    lqr.reset(0.0, state, constants)
    return {
        "title": scenario.title,
        "text": scenario.text if episode == scenario.episodes[0] else "Another start of the same task.",
        "task": scenario.task,
        "episode": episode,
        "state": state.tolist(),
        "constants": constants.tolist(),
        "duration": task.duration,
        "optimum": optimum,
        "best": best,
        "push": scenario.push,
        "markers": [asdict(marker) for marker in task.markers(constants)],
        "lqr": {
            "closed": lqr.reference.closed,
            "x": lqr.reference.x,
            "u": lqr.reference.u,
            "k": lqr.gains.k,
        },
    }


def _model_script(params: Robot, networks: Mapping[str, PolicyNetwork]) -> str:
    """The functions `step` and `push`, of a robot with the factors `_UNKNOWN`, and `MODELS`: those of every shipped task."""
    dt = make_task("stabilize").control_dt
    substeps = params.substeps(dt)

    def robot(factors: casadi.SX) -> Robot:
        given: dict[str, Any] = dict(zip(_UNKNOWN, casadi.vertsplit(factors), strict=True))
        return TRACKS["unknown"].robot(params, tuple(given.get(name, 1.0) for name in Randomization.DRAWN))

    parts = [
        JAVASCRIPT.function("step", lambda x, u, r: robot(r).step(x, u, dt, substeps), {"x": 8, "u": 2, "robot": 3}),
        JAVASCRIPT.function(
            "push", lambda x, impulse, r: robot(r).pushed(x, impulse), {"x": 8, "impulse": 2, "robot": 3}
        ),
    ]
    models = []
    for name, network in networks.items():
        task = make_task(name)
        functions = {
            "observe": (task.observe, {"x": 8, "c": len(task.constant_names)}),
            "outcome": (partial(_outcome, task), {"x": 8, "u": 2, "end": 8, "c": len(task.constant_names)}),
            "action": (policy_function(network), {"o": network.spec.seen}),
        }
        parts += [JAVASCRIPT.function(f"{name}_{key}", *function) for key, function in functions.items()]
        entries = ", ".join(f"{key}: {name}_{key}" for key in functions)
        models.append(f"  {name}: {{ {entries}, limit_names: {json.dumps(task.limit_names)} }},")
    return "\n".join([*parts, "const MODELS = {", *models, "};"])


def _outcome(task: Task, x: casadi.SX, u: casadi.SX, end: casadi.SX, c: casadi.SX) -> tuple[Any, ...]:
    """Cost of a control step, the index of the limit that it violates, or −1, and whether the episode ends at its goal."""
    did = outcome(task, x, u, end, c, 1)
    return -did.reward_cost, did.violated, did.success


def _packed(numbers: np.ndarray) -> dict[str, str]:
    """Numbers by their kind, in base64, little-endian, as every browser's machine reads them."""
    content = np.ascontiguousarray(numbers, numbers.dtype.newbyteorder("<")).tobytes()
    return {numbers.dtype.name: base64.b64encode(content).decode()}
