"""Learned policies: the network, loading and saving it, and the policy as a Controller.

A policy is two files: weights in `NAME.safetensors` and their description in `NAME.json`. Nothing in them is executed.
This module imports torch; `files` reads descriptions without it.
"""

import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import PAPER, ROBOT_FACTORS, ROBOTS, Randomization, Robot, named_robot, robot_name
from ballbot_gym.rollout import ActionController
from ballbot_gym.tasks import TASKS, Task
from ballbot_gym.tasks.identity import observation_digest
from ballbot_gym.tasks.symmetry import REACH, Route
from ballbot_train.policy.files import (
    OBSERVATION_VERSION,
    PolicyError,
    PolicyFile,
    PolicySpec,
)
from ballbot_train.policy.weights import checked, linear_layers

with imports_of(__name__):
    import safetensors
    import safetensors.torch
    import torch

if TYPE_CHECKING:
    from ballbot_gym.vector.batch import BatchState

_FACTORS = len(ROBOT_FACTORS)
_FACTOR_SCALE = 0.3  # of the robot's parameters minus 1, as inputs of informed policies
_ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "silu": torch.nn.SiLU}


class PolicyNetwork(torch.nn.Module):
    """action = squash(W o + MLP(o)): the sum of a linear part, which LQR's gain can initialize, and a network.

    Observations o (..., no) to actions (..., 2) in [−1, 1], forces in units of the robot's limit; with wheels (..., 3).
    With a frame, o and the action are those of the frame. With mirrors, the sum is averaged over the mirror images, and so
    it mirrors exactly. A centred policy subtracts from the sum its value in the steady motion at the end of the episode,
    and adds the action that keeps this motion. So it rests exactly at its goal, or orbits exactly on the circle. With routes,
    a network of its own decides on which sides obstacles are passed.

    With a history, an observation also contains earlier observations and actions; each is transformed to its own frame. The
    observations of an informed policy end with the robot's parameters, and its forces are those of the nominal motors.
    """

    def __init__(self, spec: PolicySpec, device: str = "cpu"):
        super().__init__()
        self.spec = spec
        own: dict[str, Any] = {"device": device, "dtype": torch.float32}  # whatever torch's defaults are
        unchanged, none = [1] * _FACTORS * spec.informed, ((-1,) * spec.observations, (-1,) * spec.actions)
        self._mirrors = [
            (
                torch.tensor([*signs, *(spec.history * (*signs, *action)), *unchanged], **own),
                torch.tensor(action, **own),
            )
            for signs, action in (*spec.mirrors, *[none] * (spec.odd and spec.informed))
        ]
        self._frame = spec.seen_in
        self.present = spec.observations if self._frame is None else self._frame.size
        """Numbers of the present observation as the frame shows it."""
        self.routes = None
        if self._frame is not None and self._frame.route is not None:
            self.routes = Routes(self._frame.route, spec.routes, device)
        inputs = self.present + spec.history * (self.present + spec.actions) + _FACTORS * spec.informed
        self.linear = torch.nn.Linear(inputs, spec.actions, bias=not spec.odd, **own) if spec.linear else None
        widths = (inputs, *spec.hidden, spec.actions)
        self.mlp = linear_layers(widths, _ACTIVATIONS[spec.activation], bias=not spec.odd, **own)
        if spec.linear:  # so that the policy starts as its linear part
            for part in self.mlp[-1].parameters():
                torch.nn.init.zeros_(part)

    @property
    def history(self) -> int:
        """The number of earlier observations and actions that follow the present observation."""
        return self.spec.history

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self._squashed(self.raw(observation))

    def _squashed(self, raw: torch.Tensor) -> torch.Tensor:
        return torch.tanh(raw) if self.spec.squash == "tanh" else raw.clamp(-1.0, 1.0)

    @torch.no_grad()
    def prepared(self, observation: torch.Tensor) -> torch.Tensor:
        """(B, k) all of a policy that depends on observations (B, no) alone, and not on its layers; see `acting`.

        A frame's many small steps take about as long for thousands of observations as for one, so it pays to compute many
        batches of a fit at once. Informed policies are not supported.
        """
        if self._frame is None:
            return observation
        features, back = self.features(self._seen(observation))
        one = torch.ones_like(features[0])
        axes = *back((one, 0.0 * one)), *back((0.0 * one, one))
        steady = ()
        if self.spec.centred:
            kept, action = self.kept(features)
            steady = *kept, *self._needed(_stacked(action, observation)).unbind(-1)
        return _stacked((*features, *axes, *steady), observation)

    def acting(self, prepared: torch.Tensor) -> torch.Tensor:
        """Actions (B, 2) for what `prepared` gives of observations: those of `forward`, to rounding.

        Gradients pass a clip as if it were not there, so that a policy can be fitted where it acts at the wrong limit. Where
        the limit is right, the error is zero, and nothing has to be learned beyond it.
        """
        raw = self._unsquashed(prepared)
        acted = self._squashed(raw)
        return acted if self.spec.squash == "tanh" else raw + (acted - raw).detach()

    def _unsquashed(self, prepared: torch.Tensor) -> torch.Tensor:
        """`raw` for what `prepared` gives of observations."""
        if self._frame is None:
            return self.raw(prepared)
        if self.spec.centred:
            size = (prepared.shape[-1] - 6) // 2
            inputs, axes, kept, needed = prepared.split_with_sizes([size, 4, size, 2], -1)
            output, steady = self._sum(torch.cat([inputs, kept])).chunk(2)
            action = output - steady + needed
        else:
            inputs, axes = prepared.split_with_sizes([prepared.shape[-1] - 4, 4], -1)
            action = self._sum(inputs)
        action = self._reached(action)
        return action[:, :1] * axes[:, :2] + action[:, 1:] * axes[:, 2:]

    def knowing(self, observation: torch.Tensor, state: "BatchState", track: Randomization) -> torch.Tensor:
        """Actions (B, 2) for observations (B, no) without the robots' parameters, which an informed policy needs.

        As behind a filter it gets their mean over the track in the first control step, and afterwards those that were drawn.
        """
        if not self.spec.informed:
            return self(observation)
        drawn = state.drawn[[Randomization.DRAWN.index(name) for name in ROBOT_FACTORS]].T.to(observation.dtype)
        expected = drawn.new_tensor([sum(getattr(track, name)) / 2 for name in ROBOT_FACTORS])
        estimates = torch.where(state.steps[:, None] == 0, expected, drawn)
        return self(torch.cat([observation, estimates], -1)) / estimates[:, -1:]

    def raw(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 2) before it is squashed; with "tanh_in_frame" before it is clipped, which alone is left to do then."""
        estimates = observation[..., :0]
        if self.spec.informed:
            observation, estimates = observation[..., :-_FACTORS], (observation[..., -_FACTORS:] - 1.0) / _FACTOR_SCALE
        if self._frame is not None:
            # one observation at a time: a frame's many small steps take plain numbers a tenth of what they take tensors
            plain = observation.ndim == 1 and torch.is_inference_mode_enabled()
            features, back = self.features(self._seen(observation, plain))
            features = (*features, *(estimates.tolist() if plain else estimates.unbind(-1)))
            action = self.in_frame(_stacked(features, observation), features)
            return _stacked(back(tuple(action.tolist()) if plain else action.unbind(-1)), observation)
        if self.spec.informed:
            observation = torch.cat([observation, estimates], -1)
        total = self._sum(observation)
        for signs, action_signs in self._mirrors:
            total = total + action_signs * self._sum(signs * observation)
        return total / (1 + len(self._mirrors)) if self._mirrors else total

    def in_frame(self, inputs: torch.Tensor, features: tuple[Any, ...] | None = None) -> torch.Tensor:
        """(..., 2) in the frame, as `raw` in the world, for features (..., n) of the frame, also one by one."""
        return self._reached(self.centred(self._sum(inputs), inputs.unbind(-1) if features is None else features))

    def _reached(self, action: torch.Tensor) -> torch.Tensor:
        return REACH * torch.tanh(action) if self.spec.squash == "tanh_in_frame" else action

    def _seen(self, observation: torch.Tensor, plain: bool = False) -> tuple[Any, ...]:
        """The numbers of an observation, and behind them the sides of routes, if any."""
        numbers = tuple(observation.tolist()) if plain else observation.unbind(-1)
        return numbers if self.routes is None else (*numbers, *self.routes.sides(numbers))

    def features(self, observation: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
        """Features of the present observation, and behind them those of the past ones with their actions; the way back."""
        assert self._frame is not None
        count, own = self.spec.history, self.spec.observations
        if not count:
            return self._frame.features(observation)
        features, back = self._frame.features(observation[:own])
        for k in range(count):
            first = own + k * (own + 2)
            then, back_then = self._frame.features(observation[first : first + own])
            x, y = observation[first + own : first + own + 2]
            one = 0.0 * x + 1.0
            axes = (back_then((one, 0.0 * x)), back_then((0.0 * x, one)))  # orthonormal
            features = (*features, *then, *(a * x + b * y for a, b in axes))
        return features, back

    def shown(self, observation: torch.Tensor) -> torch.Tensor:
        """(B, no + past) to (B, `present` + past): the present observation as the frame shows it, the past as it is."""
        if self._frame is None:
            return observation
        own, past = observation[..., : self.spec.observations], observation[..., self.spec.observations :]
        features, _ = self._frame.features(self._seen(own))
        return torch.cat([_stacked(features, observation), past], -1)

    def centred(self, output: torch.Tensor, features: tuple[Any, ...]) -> torch.Tensor:
        """The network's output (..., 2) for features of its frame, before it is squashed. A centred policy's is less what the
        network gives in the steady motion, and has what keeps that motion instead.
        """
        if not self.spec.centred:
            return output
        kept, action = self.kept(features)
        output = output - self._sum(_stacked(kept, output))
        return output + self._needed(_stacked(action, output))

    def _needed(self, action: torch.Tensor) -> torch.Tensor:
        """What the network must give for an action (..., 2) in the frame, before it is squashed."""
        if self.spec.squash == "clip":
            return action
        reach = REACH if self.spec.squash == "tanh_in_frame" else 1
        return (action / reach).clamp(-0.999, 0.999).atanh()

    def kept(self, features: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, Any]]:
        """Features of the steady motion, as if it had lasted for the whole history, and the action that keeps it."""
        assert self._frame is not None
        assert self._frame.steady is not None
        kept, action = self._frame.steady(features[: self.present])
        estimates = features[self.present :] if self.spec.informed else ()
        return (*kept, *(self.spec.history * (*kept, *action)), *estimates), action

    def layers(self) -> dict[str, list[tuple[np.ndarray, np.ndarray | None]]]:
        """Weights and biases, or None, of the linear layers of its parts."""
        parts = {"mlp": self.mlp, "linear": self.linear, "routes": self.routes}
        return {
            name: [
                (layer.weight.detach().numpy(), None if layer.bias is None else layer.bias.detach().numpy())
                for layer in (() if part is None else part.modules())
                if isinstance(layer, torch.nn.Linear)
            ]
            for name, part in parts.items()
        }

    def save(self, path: str | Path, description: Mapping[str, Any]) -> Path:
        """Writes `path`.safetensors and `path`.json.

        Args:
            path: with or without the ending .json.
            description: what else the JSON says: the training's configuration, its command, the measured regret.

        Returns:
            The path of the JSON file.
        """
        file = PolicyFile(path)
        weights = {name: tensor.detach().cpu().contiguous() for name, tensor in self.state_dict().items()}
        files.write(file.weights, safetensors.torch.save(weights))
        return files.write(file.description, json.dumps({"spec": asdict(self.spec), **description}, indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path, task: Task, robot: str | None = PAPER) -> "PolicyNetwork":
        """The network of a policy file made for this very task and robot.

        Args:
            path: of either of its files.
            task: what it must have been trained on.
            robot: by name; None admits every robot, and with it other fields of the task.

        Raises:
            PolicyError: a file is missing or damaged, or made for another task, robot, observation or shape.
        """
        file = PolicyFile(path)
        weights_path, description_path = file.weights, file.description
        described = file.read()["spec"]
        try:
            spec = PolicySpec.read(described)
        except (KeyError, ValueError, TypeError) as error:
            lacks = "its spec has no " if isinstance(error, KeyError) else ""
            raise PolicyError(f"{description_path} is not a policy: {lacks}{error}") from error
        trained_on, wanted = (text.split("(")[0] if robot is None else text for text in (spec.task, task.problem()))
        if trained_on != wanted:
            raise PolicyError(f"{description_path} was trained on {trained_on}, not on {wanted}")
        if robot is not None and spec.robot != robot:
            raise PolicyError(f"{description_path} was trained on the robot {spec.robot!r}, not on {robot!r}")
        if spec.observation_version != OBSERVATION_VERSION:
            raise PolicyError(
                f"{description_path} reads observation version {spec.observation_version}, this is {OBSERVATION_VERSION}; "
                "train it again"
            )
        _check_content(description_path, spec, task)
        observations = task.observation_size(named_robot(spec.robot))
        if spec.observations != observations:
            raise PolicyError(
                f"{description_path} takes {spec.observations} observations, {task.id} has {observations}"
            )
        weights = _read_weights(weights_path)
        # shapes without memory, which a wrong description would ask for
        shapes = {name: tuple(part.shape) for name, part in cls(spec, "meta").state_dict().items()}
        found = {name: tuple(part.shape) for name, part in weights.items()}
        differing = [name for name in {**shapes, **found} if shapes.get(name) != found.get(name)]
        if differing:
            name = differing[0]
            raise PolicyError(
                f"{weights_path}: the weights do not fit their description: {name} has the shape {found.get(name)}, "
                f"and should have {shapes.get(name)}"
            )
        network = cls(spec)
        network.load_state_dict(weights)
        return network

    def _sum(self, inputs: torch.Tensor) -> torch.Tensor:
        output = self.mlp(inputs)
        return output if self.linear is None else output + self.linear(inputs)


class Routes(torch.nn.Module):
    """From observations to the sides on which obstacles are passed, by a small network. Its input is the layout of obstacles.

    Each choice of sides has an optimum of its own. A network that averages their actions drives into the obstacle between
    two paths, so the choice is a separate classification. The layout stays the same throughout an episode, so the choice
    does not change. The network has an output for each of the 2^n choices of obstacles that are passed on the farther side,
    and the greatest output is chosen.
    """

    def __init__(self, route: Route, hidden: tuple[int, ...], device: str = "cpu"):
        """Args: route: of a frame; hidden: units of the hidden layers; device: of the weights."""
        super().__init__()
        own: dict[str, Any] = {"device": device, "dtype": torch.float32}
        self.route = route
        self.mlp = linear_layers((3 * route.obstacles, *hidden, 2**route.obstacles), torch.nn.Tanh, **own)
        self._choices: torch.Tensor
        self.register_buffer("_choices", torch.tensor(self.choices(route.obstacles), **own), persistent=False)

    @staticmethod
    @functools.cache
    def choices(obstacles: int) -> tuple[tuple[float, ...], ...]:
        """Every choice of obstacles that are passed on their farther side, −1, in the order of the outputs."""
        return tuple(itertools.product((1.0, -1.0), repeat=obstacles))

    def layout(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 3 n) x, y and radius of every obstacle as seen from the goal, of observations (..., no)."""
        return torch.stack(self.route.layout(observation.unbind(-1)), -1)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., n) 1 for every obstacle that is passed on its left, −1 on its right, of observations (..., no)."""
        return torch.stack(self.sides(observation.unbind(-1)), -1)

    def sides(self, seen: tuple[Any, ...]) -> tuple[Any, ...]:
        """The same (n) for the numbers of an observation (no), which are tensors or plain ones. No gradient reaches them."""
        with torch.no_grad():
            best = self.mlp(_stacked(self.route.layout(seen), self._choices)).argmax(-1)
            if isinstance(seen[0], torch.Tensor):
                return self.route.sides(seen, self._choices[best].unbind(-1))
            return self.route.sides(seen, self.choices(self.route.obstacles)[int(best)])


def _stacked(values: Sequence[Any], like: torch.Tensor) -> torch.Tensor:
    """(..., n) of n tensors (...), or of n plain numbers a tensor as another one is."""
    return torch.stack(tuple(values), -1) if isinstance(values[0], torch.Tensor) else like.new_tensor(values)


class PolicyController(ActionController):
    """A policy as a Controller of forces, and with Stable-Baselines3's `predict` of actions."""

    def __init__(self, task: Task, params: Robot, network: torch.nn.Module):
        """Args: network: a `PolicyNetwork`, or another from observations (..., no) to actions (..., 2)."""
        history = getattr(network, "history", 0)
        super().__init__(task, params, self._action_for, history)
        self.network = network.eval()
        if isinstance(network, PolicyNetwork) and network.spec.informed:
            self.estimates = np.ones(_FACTORS)

    def _action_for(self, observation: np.ndarray, begins: bool) -> np.ndarray:
        return self.predict(observation)[0]

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions (..., 2) for observations (..., no); the other arguments are SB3's and have no effect."""
        # in its own precision, also where the caller has switched on automatic casts
        with torch.autocast("cpu", enabled=False), torch.inference_mode():
            given = torch.as_tensor(np.array(observation), dtype=torch.float32, device="cpu")
            return self.network(given).numpy(), state


def _check_content(path: Path, spec: PolicySpec, task: Task) -> None:
    """Raises a PolicyError where another robot, or another observation, has the name of that on which a policy was trained.

    Files of earlier versions hold neither, and are compared by name and size alone.
    """
    params = named_robot(spec.robot)
    if spec.robot_numbers not in ("", params.record()):
        own, here = (
            set(text.split("(", 1)[1].rstrip(")").split(", ")) for text in (spec.robot_numbers, params.record())
        )
        raise PolicyError(
            f"{path} was trained on a robot {spec.robot!r} with {', '.join(sorted(own - here))}, and the robot of this name "
            f"has {', '.join(sorted(here - own))} here; give the robot that it was trained on, or train again"
        )
    if spec.observation_digest not in ("", observation_digest(task, params)):
        raise PolicyError(
            f"{path} was trained on other observations: {task.id} now observes other values in the same states; restore its "
            "`observe`, or train again"
        )


def _read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights of a file; raises a PolicyError that names what is no number."""
    try:
        return checked(safetensors.torch.load(files.read(path)), path)
    except PolicyError:
        raise
    # safetensors answers some files with a KeyError, or with an error that torch raises
    except (ValueError, KeyError, TypeError, RuntimeError, safetensors.SafetensorError) as error:
        raise PolicyError(f"{path} is not a policy: {error}") from error


def load_policy(path: str | Path, task: str | Task | None = None, params: Robot | None = None) -> PolicyController:
    """The policy of a file as a Controller with SB3's `predict`.

    Args:
        path: of either of its files.
        task: what it must have been trained on; default, the registered task, with default fields, that its file names.
        params: the robot; default, the one that its file names.

    Raises:
        PolicyError: as `PolicyNetwork.load`; or no task is given, and its file names none that is registered.
    """
    spec = PolicyFile(path).read()["spec"]
    robot = spec.get("robot", PAPER) if params is None else robot_name(params)
    if not isinstance(robot, str) or robot not in ROBOTS:
        raise PolicyError(f"{path} was trained on the robot {robot!r}, which is none of {', '.join(ROBOTS)}")
    if task is None:
        task = next(
            (each for each in (make_task(name, robot) for name in TASKS) if each.problem() == spec["task"]), None
        )
        if task is None:
            raise PolicyError(f"{path} was trained on {spec['task']}: give that Task as load_policy(path, task)")
    task = make_task(task, robot)
    params = named_robot(robot) if params is None else params
    return PolicyController(task, params, PolicyNetwork.load(path, task, robot))
