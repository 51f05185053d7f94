"""The playground without Python: one HTML page in which a learned policy and LQR balance beside the optimum, and the reader
pushes them, or drives an episode.

Everything is in the page: the closed-form model, the tasks' costs, limits and observations, LQR's gains and the policies'
weights. The model and the tasks are printed as JavaScript from the lines that Python runs; see `printed`.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import safetensors.numpy
from markupsafe import Markup

from ballbot_baselines.lqr import LqrController
from ballbot_gym import certified, drawing, dynamics, files
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.randomization import TRACKS, Randomization
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.symmetry import FRAMES, REACH
from ballbot_train.evaluation.controllers import policy_path, task_name
from ballbot_train.policy_files import BEST, PolicySpec, paths_of, read_description, shipped_policies
from ballbot_train.report import labels
from ballbot_train.report.page import asset, render, scene_data
from ballbot_train.report.printed import Functions, frame_functions, javascript_function

_UNKNOWN = (
    "body_mass",
    "com_height",
    "force",
)  # factors that the reader may change, within those of the track "unknown"
LARGEST = 2_000_000
"""Bytes that the page may have."""


@dataclass(frozen=True)
class Scenario:
    """What the robots of the page are up to."""

    title: str
    text: str
    """What to look at, in a sentence or two."""
    task: str
    episode: int | None = None
    """The certified episode that it is; None is standing at rest at the origin."""
    push: tuple[float, float, float] | None = None
    """A push that comes by itself: time, s, impulse, N·s, and bearing, rad."""
    others: tuple[int, ...] = ()
    """More certified episodes that can be chosen."""


SCENARIOS = (
    Scenario(
        "Push",
        "Both robots stand still and get the same push of 90 N·s. LQR is right for small leans only, and falls. "
        "The learned policy leans 45°, brakes and comes back.",
        "stabilize",
        push=(0.6, 90.0, 0.5),  # as `ballbot play` begins
    ),
    Scenario(
        "Throw",
        "All start fast and leaning, and are to come to rest on the green spot. Braking takes a lean of 40°.",
        "stabilize",
        7,
        others=(0, 3, 5),
    ),
    Scenario(
        "Orbit",
        "From rest onto a circle at 5.5 m/s, which takes a steady lean of 43°.",
        "orbit",
        17,
        others=(1, 2, 3),
    ),
    Scenario(
        "Turn",
        "A right-angled turn through the gate at 6.8 m/s, with as little force as possible.",
        "turn",
        1,
        others=(2, 3, 5),
    ),
    Scenario(
        "Weave",
        "Round five obstacles, and to rest behind them. LQR does not know of obstacles.",
        "weave",
        12,
        others=(0, 1, 3),
    ),
)
"""Every scenario of the page."""


def write_playground(path: Path, policies: Sequence[str] = ()) -> Path:
    """Writes the page; arguments and errors as `playground_page`."""
    return files.write(path, playground_page(policies))


def playground_page(policies: Sequence[str] = ()) -> str:
    """The page as HTML.

    Args:
        policies: files of policies, each shown in place of the shipped one of its task.

    Raises:
        PolicyError: a file is no policy.
        ValueError: a policy is of no registered task, two are of one task, or the page would be larger than `LARGEST`.
    """
    page = render(
        "playground.html.j2",
        style=asset("playground.css"),
        scripts=[Markup(engine_script(policies)), asset("scene.js"), asset("playground.js")],
    )
    size = len(page.encode())
    if size > LARGEST:
        raise ValueError(f"the page would have {size / 1e6:.2f} MB, and at most {LARGEST / 1e6:g} MB load at once")
    return str(page)


def engine_script(policies: Sequence[str] = ()) -> str:
    """All of the page that computes, as JavaScript without a page: what the tests run in node."""
    params = default_params()
    data = {
        "dt": make_task("stabilize").control_dt,
        "force_limit": params.force_limit,
        "unknown": {name: getattr(TRACKS["unknown"], name) for name in _UNKNOWN},
        "reach": REACH,
        **scene_data(params),
        "push_scale": drawing.PUSH_SCALE,
        "ghost_opacity": drawing.GHOST_OPACITY,
        "lqr": {"label": labels.label("lqr"), "color": labels.color("lqr", 0)},
        "policies": _policies(policies),
        "you": {"label": "you", "color": labels.YOU},
        "best": {"label": "optimum", "color": labels.OPTIMUM},
        "scenarios": [_scenario_data(episode, params) for scenario in SCENARIOS for episode in _episodes(scenario)],
    }
    # Within a script, "<" could end it.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    specs = {name: policy["frame"] for name, policy in data["policies"].items()}
    return "\n".join([_model_script(params, specs), f"const DATA = {text};", asset("engine.js")])


def _episodes(scenario: Scenario) -> list[Scenario]:
    """A scenario in each of its episodes."""
    text = "Another start of the same task."
    return [scenario, *(replace(scenario, text=text, episode=episode, others=()) for episode in scenario.others)]


def _policies(given: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The policy of each task."""
    paths: dict[str, Path] = {}
    for policy in given:
        task = task_name(str(policy), None)
        if task in paths:
            raise ValueError(f"{paths[task]} and {policy} are both policies for {task}; give one")
        paths[task] = policy_path(str(policy), make_task(task))
        _check_policy(paths[task], make_task(task))
    shipped = {task: shipped_policies(make_task(task))[learner] for task, learner in BEST.items()}
    return {task: _policy_data(paths.get(task, path), make_task(task)) for task, path in shipped.items()}


def _check_policy(path: Path, task: Task) -> None:
    """Raises a PolicyError where a file is no policy of the task."""
    from ballbot_train.policy import load_network  # it imports torch

    load_network(path, task)


def _policy_data(path: Path, task: Task) -> dict[str, Any]:
    """What a policy computes with, the numbers packed. torch is not imported: the files hold all."""
    described = read_description(path)
    spec = PolicySpec.read(described["spec"])
    name = str(described.get("training", {}).get("learner", path.stem))
    weights = safetensors.numpy.load(files.read(paths_of(path)[0]))
    # activations lie between the layers, which are numbered with them
    layers = [f"mlp.{2 * i}" for i in range(len(spec.hidden) + 1)]
    return {
        "label": labels.label(name),
        "color": labels.color(name, 0),
        "layers": [_layer(weights, layer) for layer in layers],
        "linear": _layer(weights, "linear") if spec.linear else None,
        "activation": spec.activation,
        "squash": spec.squash,
        "mirrors": spec.mirrors,
        "frame": spec.frame,
        "centred": spec.centred,
        "routes": [_layer(weights, f"routes.mlp.{2 * i}") for i in range(len(spec.routes) + 1)] if spec.routes else [],
    }


def _layer(weights: Mapping[str, np.ndarray], name: str) -> dict[str, str | None]:
    bias = weights.get(f"{name}.bias")
    return {
        "weight": _packed(weights[f"{name}.weight"], np.float32),
        "bias": None if bias is None else _packed(bias, np.float32),
    }


def _scenario_data(scenario: Scenario, params: BallbotParams) -> dict[str, Any]:
    task = make_task(scenario.task)
    state, constants, optimum, best = np.zeros(8), np.zeros(0), None, None
    if scenario.episode is not None:
        episodes = certified.load(task, params)
        state, constants = episodes.states[scenario.episode], episodes.constants[scenario.episode]
        optimum = float(episodes.costs[scenario.episode])
        trajectory = episodes.trajectories[scenario.episode]
        best = {"x": _packed(trajectory.x, np.float32), "u": _packed(trajectory.u, np.float32)}
    lqr = LqrController(task, params)
    lqr.reset(0.0, state, constants)
    return {
        "title": scenario.title,
        "text": scenario.text,
        "task": scenario.task,
        "episode": scenario.episode,
        "state": state.tolist(),
        "constants": constants.tolist(),
        "duration": task.duration,
        "optimum": optimum,
        "best": best,
        "push": scenario.push,
        "markers": [asdict(marker) for marker in task.markers(constants)],
        "lqr": {
            "closed": lqr.reference.closed,
            "x": _packed(lqr.reference.x, np.float64),
            "u": _packed(lqr.reference.u, np.float64),
            "k": _packed(lqr.gains.k, np.float64),
        },
    }


def _model_script(params: BallbotParams, frames: Mapping[str, str | None]) -> str:
    """The functions `step` and `push`, of a robot with the factors `_UNKNOWN`, and `MODELS`: those of every shipped task."""
    dt = make_task("stabilize").control_dt
    substeps = dynamics.substeps_for(dt)

    def robot(factors: casadi.SX) -> BallbotParams:
        given: dict[str, Any] = dict(zip(_UNKNOWN, casadi.vertsplit(factors), strict=True))
        return TRACKS["unknown"].robot(params, tuple(given.get(name, 1.0) for name in Randomization.DRAWN))

    parts = [
        javascript_function(
            "step", lambda x, u, r: dynamics.step(robot(r), x, u, dt, substeps), {"x": 8, "u": 2, "robot": 3}
        ),
        javascript_function(
            "push", lambda x, impulse, r: dynamics.pushed(robot(r), x, impulse), {"x": 8, "impulse": 2, "robot": 3}
        ),
    ]
    models = []
    for name in BEST:
        source, entry = _task_script(name, make_task(name), frames.get(name))
        parts.append(source)
        models.append(entry)
    return "\n".join([*parts, "const MODELS = {\n" + "\n".join(models) + "\n};"])


def _task_script(name: str, task: Task, frame: str | None) -> tuple[str, str]:
    """The source of a task's functions, and its line of `MODELS`."""
    constants = len(task.constant_names)
    of_state = {"x": 8, "c": constants}
    functions: Functions = {
        "observe": (task.observe, of_state),
        "cost": (task.cost, {"x": 8, "u": 2, "c": constants}),
        "limits": (task.limits, of_state),
        "goal": (task.goal, of_state),
    }
    if frame is not None:
        own, observations = FRAMES[frame], len(task.observation_scale)
        seen = observations + (0 if own.route is None else own.route.obstacles)
        functions |= frame_functions(own, own.features, observations, seen)
        if (steady := own.steady) is not None:  # the features of the steady motion, and then the action
            functions["steady"] = (lambda f: sum(steady(tuple(casadi.vertsplit(f))), ()), {"f": own.size})
    sources = [javascript_function(f"{name}_{key}", *function) for key, function in functions.items()]
    entries = ", ".join(f"{key}: {name}_{key}" for key in functions)
    facts = f"limit_names: {json.dumps(task.limit_names)}, first_exit: {json.dumps(task.first_exit)}"
    return "\n".join(sources), f"  {name}: {{ {entries}, {facts} }},"


def _packed(numbers: np.ndarray, kind: type) -> str:
    """Numbers in base64, little-endian, as every browser's machine reads them."""
    return base64.b64encode(np.ascontiguousarray(numbers, np.dtype(kind).newbyteorder("<")).tobytes()).decode()
