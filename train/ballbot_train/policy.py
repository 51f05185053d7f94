"""Learned policies: the network, its files, and the policy as a Controller.

A policy is two files: weights in `NAME.safetensors` and their description in `NAME.json`. Nothing in them is executed.
"""

import itertools
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import safetensors
import safetensors.torch
import torch

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.rollout import ActionController
from ballbot_gym.tasks import TASKS, Task

OBSERVATION_VERSION = 1
"""Raised whenever what any task observes changes, so that older policies are refused instead of misled."""

SHIPPED = Path(__file__).parent / "policies"
"""Policies that come with the package, as TASK-LEARNER.json and .safetensors."""

_ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "silu": torch.nn.SiLU}


class PolicyError(ValueError):
    """A policy file that is missing, damaged, or belongs to another task or observation."""


@dataclass(frozen=True)
class PolicySpec:
    """What a policy was made for and how its network is built; the JSON file holds it."""

    task: str
    """`repr` of the Task."""
    observations: int
    """Size of an observation."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers."""
    activation: Literal["tanh", "relu", "silu"] = "tanh"
    """After each hidden layer."""
    linear: bool = True
    """Whether a linear part is added to the network's output."""
    odd: bool = False
    """Whether opposite observations get opposite actions, exactly: no biases. Needs an odd activation."""
    squash: Literal["tanh", "clip"] = "tanh"
    """How the sum is brought into [−1, 1]."""
    observation_version: int = OBSERVATION_VERSION

    @classmethod
    def of(cls, task: Task, **fields: Any) -> "PolicySpec":
        """The spec for a task; fields are the others."""
        return cls(task=repr(task), observations=len(task.observation_scale), **fields)


class PolicyNetwork(torch.nn.Module):
    """action = squash(W o + MLP(o)): a linear part, which LQR can start, and a network that bends it.

    Observations o (..., no) to actions (..., 2) in [−1, 1], forces in units of the robot's limit.
    """

    def __init__(self, spec: PolicySpec):
        super().__init__()
        self.spec = spec
        self.linear = torch.nn.Linear(spec.observations, 2, bias=not spec.odd) if spec.linear else None
        widths = (spec.observations, *spec.hidden)
        layers: list[torch.nn.Module] = []
        for inputs, outputs in itertools.pairwise(widths):
            layers += [torch.nn.Linear(inputs, outputs, bias=not spec.odd), _ACTIVATIONS[spec.activation]()]
        last = torch.nn.Linear(widths[-1], 2, bias=not spec.odd)
        if spec.linear:  # so that the policy starts as its linear part
            for part in last.parameters():
                torch.nn.init.zeros_(part)
        self.mlp = torch.nn.Sequential(*layers, last)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        raw = self.raw(observation)
        return torch.tanh(raw) if self.spec.squash == "tanh" else raw.clamp(-1.0, 1.0)

    def raw(self, observation: torch.Tensor) -> torch.Tensor:
        """(..., 2) before it is squashed."""
        bent = self.mlp(observation)
        return bent if self.linear is None else bent + self.linear(observation)


class PolicyController(ActionController):
    """A policy as a Controller of forces, and with Stable-Baselines3's `predict` of actions."""

    def __init__(self, task: Task, params: BallbotParams, network: PolicyNetwork):
        super().__init__(task, params, lambda observation, begins: self.predict(observation)[0])
        self._network = network.eval()

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Actions (..., 2) for observations (..., no); the other arguments are SB3's and have no effect."""
        with torch.inference_mode():
            return self._network(torch.as_tensor(observation, dtype=torch.float32)).numpy(), state


def save_policy(path: str | Path, network: PolicyNetwork, about: Mapping[str, Any]) -> Path:
    """Writes `path`.safetensors and `path`.json.

    Args:
        path: with or without the ending .json.
        network: the policy.
        about: what else the JSON says: the training's configuration, its command, the measured regret.

    Returns:
        The path of the JSON file.
    """
    weights_path, spec_path = _paths(path)
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    files.write(weights_path, safetensors.torch.save(weights))
    return files.write(spec_path, json.dumps({"spec": asdict(network.spec), **about}, indent=1) + "\n")


def read_about(path: str | Path) -> dict[str, Any]:
    """What a policy's JSON file says.

    Raises:
        PolicyError: it is missing or damaged.
    """
    _, spec_path = _paths(path)
    try:
        about = json.loads(spec_path.read_text())
        if not isinstance(about["spec"], dict):
            raise TypeError("its spec is no object")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PolicyError(f"{spec_path} is not a policy: {error}") from error
    return about


def load_network(path: str | Path, task: Task) -> PolicyNetwork:
    """The network of a policy file made for this very task.

    Raises:
        PolicyError: a file is missing or damaged, or made for another task, observation or shape.
    """
    weights_path, spec_path = _paths(path)
    described = read_about(path)["spec"]
    try:
        spec = PolicySpec(**(described | {"hidden": tuple(described["hidden"])}))
        weights = safetensors.torch.load(weights_path.read_bytes())
    except (OSError, ValueError, KeyError, TypeError, safetensors.SafetensorError) as error:
        raise PolicyError(f"{spec_path} is not a policy: {error}") from error
    if spec.task != repr(task):
        raise PolicyError(f"{spec_path} was trained on {spec.task}, not on {task!r}")
    if spec.observation_version != OBSERVATION_VERSION:
        raise PolicyError(
            f"{spec_path} reads observation version {spec.observation_version}, this is {OBSERVATION_VERSION}; train it anew"
        )
    if spec.observations != len(task.observation_scale):
        raise PolicyError(
            f"{spec_path} takes {spec.observations} observations, {task.id} has {len(task.observation_scale)}"
        )
    try:
        network = PolicyNetwork(spec)
        network.load_state_dict(weights)
    except (RuntimeError, KeyError, TypeError) as error:
        raise PolicyError(f"{weights_path}: the weights do not fit their description: {error}") from error
    return network


def load_policy(
    path: str | Path, task: str | Task | None = None, params: BallbotParams | None = None
) -> PolicyController:
    """The policy of a file as a Controller with SB3's `predict`.

    Args:
        path: of either of its files.
        task: what it must have been trained on; default, the registered task, with default fields, that its file names.
        params: the robot; default, the paper's.

    Raises:
        PolicyError: as `load_network`; or no task is given, and its file names none that is registered.
    """
    if task is None:
        trained_on = read_about(path)["spec"].get("task")
        task = next((kind() for kind in TASKS.values() if repr(kind()) == trained_on), None)
        if task is None:
            raise PolicyError(f"{path} was trained on {trained_on}: give that Task as load_policy(path, task)")
    task = make_task(task)
    return PolicyController(task, default_params() if params is None else params, load_network(path, task))


def shipped_policies(task: Task) -> dict[str, Path]:
    """The policies of a task that come with the package, by the learner's name."""
    name = next((name for name, kind in TASKS.items() if type(task) is kind), None)
    if name is None:
        return {}
    return {path.stem.removeprefix(f"{name}-"): path for path in sorted(SHIPPED.glob(f"{name}-*.json"))}


def _paths(path: str | Path) -> tuple[Path, Path]:
    """Of the weights and of the description."""
    path = Path(path)
    stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
    return stem.with_name(stem.name + ".safetensors"), stem.with_name(stem.name + ".json")
