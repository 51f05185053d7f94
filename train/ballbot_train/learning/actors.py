"""The shapes of actors that respect the symmetry of their task, and running averages of actors."""

from dataclasses import replace
from typing import Any, Literal

import torch
from torch.optim.swa_utils import AveragedModel

from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_gym.robot import PAPER, Robot, named_robot, registered_name
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.symmetry import FRAMES
from ballbot_train.policy.files import Activation, PolicySpec, Squash
from ballbot_train.policy.network import PolicyNetwork

Symmetry = Literal["none", "odd", "mirrors", "frame", "fine_frame", "centred"]
"""How an actor respects the task's symmetry: opposite observations get opposite actions (odd), its output is averaged over
the task's mirror images, or it sees and acts in the task's frame, or in its fine frame, which resolves small errors. A
centred actor acts in the finer of these frames, and keeps the robot exactly in the steady motion of the end of an episode."""

RoutedSymmetry = Literal[Symmetry, "routes"]
"""The same for learners that teach routes: the policy decides first on which sides it passes obstacles, and acts in the frame
of these."""

_ROUTES = (128, 128)  # units of the layers that decide on sides


def spec_for(
    task: Task,
    symmetry: RoutedSymmetry,
    hidden: tuple[int, ...],
    linear: bool = False,
    history: int = 0,
    robot: str = PAPER,
    informed: bool = False,
    activation: Activation = "tanh",
    squash: Squash | None = None,
) -> PolicySpec:
    """The shape of a policy. With a linear part, which can start as LQR, its output is by default squashed smoothly, and
    otherwise clipped.

    Layers of tanh are odd without biases. Others are averaged over opposite observations instead.
    Three wheels do not have the task's symmetry, so a robot with wheels does without.

    Raises:
        ValueError: the task does not have the symmetry that the settings ask for.
    """
    symmetry = "none" if not named_robot(robot).SYMMETRIES else symmetry
    steady = task.fine_frame or task.frame
    frames = {
        "routes": task.routed_frame,
        "frame": task.frame,
        "fine_frame": task.fine_frame,
        "centred": steady if steady is not None and FRAMES[steady].steady is not None else None,
    }
    lacks = {
        "odd": not any(set(mirror.state) == {-1} for mirror in task.mirrors) and "odd symmetry",
        "mirrors": not task.mirrors and "mirror images",
        "centred": not frames["centred"] and "frame with a steady motion",
    }
    missing = lacks.get(symmetry, frames.get(symmetry, "") is None and symmetry.replace("_", " "))
    if missing:
        others = 'give "none", "mirrors", "frame" or another as its symmetry'
        raise ValueError(f"{task.id} has no {missing}; {others}")
    odd = symmetry == "odd" and activation == "tanh"
    mirrors = task.mirrors if symmetry == "mirrors" else ()
    if symmetry == "odd" and not odd:
        mirrors = tuple(mirror for mirror in task.mirrors if set(mirror.state) == {-1})
    return PolicySpec.of(
        task,
        robot,
        hidden=hidden,
        activation=activation,
        linear=linear,
        odd=odd,
        frame=frames.get(symmetry),
        routes=_ROUTES if symmetry == "routes" else (),
        centred=symmetry == "centred",
        mirrors=tuple((task.observation_signs(mirror), mirror.action) for mirror in mirrors),
        squash=squash or ("tanh" if linear else "clip"),
        history=history,
        informed=informed,
    )


def actor_for(
    task: Task,
    params: Robot,
    config: Any,
    history: int,
    informed: bool,
    start: PolicyNetwork | None,
    activation: Activation = "tanh",
    squash: Squash = "tanh",
) -> PolicyNetwork:
    """A policy to train, of the config's symmetry and hidden layers, that starts as LQR; or `start` as `started` makes it."""
    robot = registered_name(params)
    spec = spec_for(task, config.symmetry, config.hidden, True, history, robot, informed, activation, squash)
    if start is not None:
        return started(start, spec)
    made = PolicyNetwork(spec)
    _start_as_lqr(made, task, params)
    return made


def _start_as_lqr(network: PolicyNetwork, task: Task, params: Robot) -> None:
    """Sets the network's linear part to LQR's gain, or to zero if the task does not end at rest in an equilibrium.

    Raises:
        ValueError: the network has no linear part.
    """
    if network.linear is None:
        raise ValueError("a network without a linear part cannot start as LQR")
    with torch.no_grad():
        for part in network.linear.parameters():
            part.zero_()
        if (gain := equilibrium_gain(task, params)) is not None:
            network.linear.weight[:, : gain[0].shape[1]] = torch.tensor(gain[0])


def started(network: PolicyNetwork, mine: PolicySpec) -> PolicyNetwork:
    """A policy to start from, perhaps of another robot and its episodes, for the task, robot and history of `mine`.

    Weights of inputs that it did not have before are zero at first.

    Raises:
        ValueError: it sees a longer past than `mine`, or is informed and `mine` is not, or commands another number of motors.
    """
    start, informed = network.spec, network.spec.informed or mine.informed
    own = {name: getattr(mine, name) for name in ("task", "robot", "history", "robot_numbers", "observation_digest")}
    spec = replace(start, **own, informed=informed)
    if start.history > mine.history:
        raise ValueError(
            f"the policy to start from observes {start.history} earlier steps; give --history {start.history}"
        )
    if spec.informed != mine.informed:
        raise ValueError("the policy to start from receives the parameters of its robot; give --informed")
    if (spec.actions, spec.observations) != (start.actions, start.observations):
        raise ValueError(f"a policy of {start.robot} cannot start a training for {mine.robot}, which has other motors")
    made = PolicyNetwork(spec)
    weights, shapes = network.state_dict(), made.state_dict()
    for name, weight in weights.items():
        more = shapes[name].shape[-1] - weight.shape[-1] if weight.ndim == 2 else 0
        weights[name] = torch.nn.functional.pad(weight, (0, more))  # what is seen more comes last
    made.load_state_dict(weights)
    return made


def average_of(actor: torch.nn.Module, updates: int) -> AveragedModel:
    """A running average of an actor over about its last `updates` updates, in `module`; at first, the mean of all updates."""

    def towards(kept: torch.Tensor, new: torch.Tensor, done: torch.Tensor | int) -> torch.Tensor:
        return kept.lerp(new, max(1 / updates, 1 / (1 + int(done))))

    return AveragedModel(actor, avg_fn=towards)
