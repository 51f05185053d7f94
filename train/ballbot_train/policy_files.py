"""What a policy's files say, readable without torch: which task it was made for, how it was trained, where it is.

A policy is two files: weights in `NAME.safetensors` and their description in `NAME.json`.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ballbot_gym.tasks import TASKS, Task
from ballbot_gym.tasks.symmetry import FRAMES

OBSERVATION_VERSION = 1
"""Raised whenever what any task observes changes, so that older policies are refused instead of misled."""

SHIPPED = Path(__file__).parent / "policies"
"""Policies that come with the package, as TASK-LEARNER.json and .safetensors."""


class PolicyError(ValueError):
    """A policy file that is missing, damaged, or belongs to another task or observation."""


@dataclass(frozen=True)
class PolicySpec:
    """What a policy was made for and how its network is built; the JSON file holds it."""

    task: str
    """`Task.problem()` of what it was trained on."""
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
    frame: str | None = None
    """Name in `ballbot_gym.tasks.symmetry.FRAMES` of the frame in which the network sees and acts, or None."""
    mirrors: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = ()
    """Signs of the observation and of the action in each mirror image over which the network's output is averaged."""
    squash: Literal["tanh", "clip"] = "tanh"
    """How the sum is brought into [−1, 1]."""
    observation_version: int = OBSERVATION_VERSION

    @classmethod
    def read(cls, described: Mapping[str, Any]) -> "PolicySpec":
        """The spec that a policy's JSON file describes, where JSON has lists in place of tuples.

        Raises:
            KeyError, TypeError, ValueError: it describes none.
        """
        mirrors = tuple((tuple(signs), tuple(action)) for signs, action in described.get("mirrors", ()))
        if described.get("frame") not in (None, *FRAMES):
            raise ValueError(f"no frame {described['frame']!r}; known: {', '.join(FRAMES)}")
        return cls(**(dict(described) | {"hidden": tuple(described["hidden"]), "mirrors": mirrors}))

    @classmethod
    def of(cls, task: Task, **fields: Any) -> "PolicySpec":
        """The spec for a task; fields are the others."""
        return cls(task=task.problem(), observations=len(task.observation_scale), **fields)


def read_description(path: str | Path) -> dict[str, Any]:
    """What a policy's JSON file says; its `spec` holds the fields of a PolicySpec.

    Args:
        path: of either of the policy's files.

    Raises:
        PolicyError: it is missing or damaged.
    """
    _, description = paths_of(path)
    try:
        read = json.loads(description.read_text())
        if not isinstance(read["spec"], dict):
            raise TypeError("its spec is no object")
        if not isinstance(read["spec"]["task"], str):
            raise TypeError("its spec names no task")
    except KeyError as error:
        raise PolicyError(f"{description} is not a policy: it has no {error}") from error
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise PolicyError(f"{description} is not a policy: {error}") from error
    return read


def shipped_policies(task: Task) -> dict[str, Path]:
    """The policies of a task that come with the package: the paths of their .json by the learner's name."""
    name = next((name for name, kind in TASKS.items() if type(task) is kind), None)
    if name is None:
        return {}
    return {path.stem.removeprefix(f"{name}-"): path for path in sorted(SHIPPED.glob(f"{name}-*.json"))}


def weights_digest(path: str | Path) -> str:
    """SHA-256 of a policy's weights, as hexadecimal digits.

    Raises:
        PolicyError: they are missing.
    """
    weights, _ = paths_of(path)
    try:
        return hashlib.sha256(weights.read_bytes()).hexdigest()
    except OSError as error:
        raise PolicyError(f"{weights} is not a policy: {error}") from error


def paths_of(path: str | Path) -> tuple[Path, Path]:
    """The paths of a policy's weights and of its description, given either of them or the name without an ending."""
    path = Path(path)
    stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
    return stem.with_name(stem.name + ".safetensors"), stem.with_name(stem.name + ".json")
