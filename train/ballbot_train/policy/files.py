"""The files of policies, read without torch: the task of a policy, how it was trained, and which policies are shipped.

A policy is two files: weights in `NAME.safetensors` and their description in `NAME.json`.
"""

import hashlib
import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args, get_type_hints

import ballbot_gym
from ballbot_gym import files
from ballbot_gym.checks import check_history
from ballbot_gym.robot import PAPER, ROBOT_FACTORS, ROBOTS, TRACKS, file_name, named_robot
from ballbot_gym.tasks import TASKS, Task
from ballbot_gym.tasks.identity import digest, observation_digest
from ballbot_gym.tasks.symmetry import FRAMES, Frame

OBSERVATION_VERSION = 1
"""Raised whenever what any task observes changes, so that older policies are refused instead of misled."""

SHIPPED = Path(__file__).parent.parent / "policies"
"""Policies that come with the package, as TASK-LEARNER.json and .safetensors, or TASK-ROBOT-LEARNER for other robots."""

BEST = {"stabilize": "apg", "turn": "apg", "orbit": "dagger", "weave": "apg"}
"""The learner of each task's shipped policy with the least mean regret, for the paper's robot."""

_MOST_LAYERS = 64
_MOST_MIRRORS = 16
_MOST_UNITS = 1_000_000  # of a layer
_DESCRIPTION_LIMIT = 2**24  # bytes

_FORCES = "force Fx, Fy on the ball in the world's frame, in units of force_limit_newton, in [-1, 1]"
_TORQUES = "torque of each motor at standstill, as its pull on the ball, in units of force_limit_newton, in [-1, 1]"
_HEADING = "\n\nThen cos psi, sin psi, and the rates of psi and of the ball's spin divided by 5 rad/s."
"""What the metadata of exported files says of actions, and behind an observation of its last part."""


Activation = Literal["tanh", "relu", "silu"]
"""What follows each hidden layer of a policy."""

Squash = Literal["tanh", "clip", "tanh_in_frame"]
"""How the sum of a policy's parts is brought into [−1, 1]. "tanh_in_frame" is that of `sac`: tanh, times `REACH`, in the
frame, then clip."""

Mirrors = tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
"""Signs of the observation and of the action in each mirror image."""


class PolicyError(ValueError):
    """A policy file that is missing, damaged, or belongs to another task or observation."""


def _check_count(name: str, number: Any) -> None:
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= _MOST_UNITS:
        raise ValueError(f"{name} must be whole numbers from 0 to {_MOST_UNITS}, not {number!r:.200}")


@dataclass(frozen=True)
class PolicySpec:
    """What a policy was made for and how its network is built; the JSON file holds it."""

    task: str
    """`Task.problem()` of what it was trained on."""
    observations: int
    """Size of an observation."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers."""
    activation: Activation = "tanh"
    """After each hidden layer."""
    linear: bool = True
    """Whether a linear part is added to the network's output."""
    odd: bool = False
    """Whether opposite observations get opposite actions, exactly: no biases. Needs an odd activation."""
    frame: str | None = None
    """Name in `ballbot_gym.tasks.symmetry.FRAMES` of the frame in which the network sees and acts, or None."""
    routes: tuple[int, ...] = ()
    """Units of the hidden layers of the network that decides on which sides obstacles are passed; for frames with a route."""
    centred: bool = False
    """Whether the action in the frame's steady motion is exactly the one that keeps it."""
    mirrors: Mirrors = ()
    """Mirror images over which the network's output is averaged."""
    squash: Squash = "tanh"
    """See `Squash`."""
    observation_version: int = OBSERVATION_VERSION
    robot: str = PAPER
    """Name in `ROBOTS` of the robot it was trained on."""
    robot_numbers: str = ""
    """All numbers of that robot, because two files may have one name; "" in files of earlier versions."""
    observation_digest: str = ""
    """`identity.observation_digest` of its task; "" in files of earlier versions."""
    history: int = 0
    """Number of earlier observations and actions that it observes; `history` of its env."""
    informed: bool = False
    """Whether the robot's parameters (`ROBOT_FACTORS`) are appended to the observation. The policy runs behind a filter that
    estimates them, as in Yu et al., "Preparing for the unknown" (2017)."""

    def __post_init__(self) -> None:
        if not isinstance(self.task, str):
            raise ValueError(f"task must be text, not {self.task!r}")
        if self.robot not in ROBOTS:
            raise ValueError(f"robot must be one of {', '.join(ROBOTS)}, not {self.robot!r:.200}")
        if not named_robot(self.robot).SYMMETRIES and (self.frame is not None or self.mirrors):
            raise ValueError(f"{self.robot} has no symmetry, so its policies have neither a frame nor mirror images")
        for name in ("observations", "observation_version"):
            _check_count(name, getattr(self, name))
        check_history(self.history)
        if self.history and (self.routes or self.informed):
            raise ValueError("policies with routes and informed policies do not support a history; set history to 0")
        for name in ("hidden", "routes"):
            layers = getattr(self, name)
            if not isinstance(layers, tuple) or len(layers) > _MOST_LAYERS:
                raise ValueError(f"{name} must be the units of at most {_MOST_LAYERS} layers, not {layers!r:.200}")
            for units in layers:
                _check_count(name, units)
        for name in ("activation", "squash"):
            known = get_args(get_type_hints(PolicySpec)[name])
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, not {getattr(self, name)!r}")
        for name in ("robot_numbers", "observation_digest"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"{name} must be text, not {getattr(self, name)!r:.200}")
        for name in ("linear", "odd", "centred", "informed"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be true or false, not {getattr(self, name)!r}")
        if len(self.mirrors) > _MOST_MIRRORS:
            raise ValueError(f"mirrors must be at most {_MOST_MIRRORS}, not {len(self.mirrors)}")
        for signs, action in self.mirrors:
            if len(signs) != self.observations or len(action) != self.actions or not {*signs, *action} <= {-1, 1}:
                raise ValueError(
                    f"mirrors must hold signs of {self.observations} observations and {self.actions} actions"
                )
        if self.odd and self.activation != "tanh":
            raise ValueError(f"odd needs the activation tanh, not {self.activation}")
        if self.frame not in (None, *FRAMES):
            raise ValueError(f"no frame {self.frame!r}; known: {', '.join(FRAMES)}")
        if bool(self.routes) != (self.seen_in is not None and self.seen_in.route is not None):
            raise ValueError(
                f"routes must be given for a frame with a route, and for no other, not for {self.frame!r:.200}"
            )
        if self.centred and (self.seen_in is None or self.seen_in.steady is None):
            raise ValueError(f"centred needs a frame with a steady motion, not {self.frame!r:.200}")

    @property
    def seen_in(self) -> Frame | None:
        """The frame in which the network sees and acts."""
        return None if self.frame is None else FRAMES[self.frame]

    @property
    def actions(self) -> int:
        """Numbers that the policy commands."""
        return named_robot(self.robot).action_size

    @property
    def seen(self) -> int:
        """Numbers that the policy takes: an observation, followed by the past or by the robot's parameters."""
        parameters = len(ROBOT_FACTORS) if self.informed else 0
        return self.observations + self.history * (self.observations + self.actions) + parameters

    @classmethod
    def read(cls, described: Mapping[str, Any]) -> "PolicySpec":
        """The spec that a policy's JSON file describes. JSON has lists instead of tuples.

        Raises:
            KeyError, TypeError, ValueError: it describes none.
        """
        fields: dict[str, Any] = {"routes": (), "mirrors": (), **described}
        for name in ("hidden", "routes"):
            if not isinstance(fields[name], list | tuple):
                raise ValueError(f"{name} must be a list of whole numbers, not {fields[name]!r:.200}")
            fields[name] = tuple(fields[name])
        fields["mirrors"] = tuple((tuple(signs), tuple(action)) for signs, action in fields["mirrors"])
        return cls(**fields)

    @classmethod
    def of(cls, task: Task, robot: str = PAPER, **fields: Any) -> "PolicySpec":
        """The spec for a task and a robot by name; fields are the others."""
        observations = task.observation_size(named_robot(robot))
        spec = cls(task=task.problem(), observations=observations, robot=robot, **fields)
        return spec.on(task, robot)

    def on(self, task: Task, robot: str) -> "PolicySpec":
        """The same network for a robot by name."""
        params = named_robot(robot)
        content = {"robot_numbers": params.record(), "observation_digest": observation_digest(task, params)}
        return replace(self, robot=robot, **content)


@dataclass(frozen=True)
class PolicyFile:
    """A policy on disk: weights in `NAME.safetensors` and their description in `NAME.json`; or a saved model, `NAME.zip`."""

    path: str | Path
    """Of either file, the name without an ending, or the folder of a training run."""

    @property
    def is_run(self) -> bool:
        """Whether it is the folder of a training run that has a policy."""
        return (Path(self.path) / "policy.json").is_file()

    @property
    def weights(self) -> Path:
        """The path of the weights."""
        return Path(self.path) if Path(self.path).suffix == ".zip" else self._with(".safetensors")

    @property
    def description(self) -> Path:
        """The path of what describes them."""
        return self._with(".json")

    def _with(self, ending: str) -> Path:
        path = Path(self.path) / "policy" if self.is_run else Path(self.path)
        stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
        return stem.with_name(stem.name + ending)

    def read(self) -> dict[str, Any]:
        """What the description says; its `spec` holds the fields of a PolicySpec.

        Raises:
            PolicyError: it is missing or damaged.
        """
        if Path(self.path).suffix in (".pt", ".pth", ".ckpt"):
            raise PolicyError(
                f"{self.path} is neither a policy's .json nor a model of Stable-Baselines3 in a .zip: load it where it was "
                "made, and give ballbot_train.evaluate a function from observation to action"
            )
        try:
            read = files.read_json(self.description, _DESCRIPTION_LIMIT)
            if not isinstance(read["spec"], dict):
                raise TypeError("its spec is not an object")
            if not isinstance(read["spec"]["task"], str):
                raise TypeError("its spec names no task")
            if not isinstance(read.get("training", {}), dict):
                raise TypeError("its training is not an object")
        except KeyError as error:
            raise PolicyError(f"{self.description} is not a policy: it has no {error}") from error
        except (ValueError, TypeError) as error:
            raise PolicyError(f"{self.description} is not a policy: {error}") from error
        return read

    def way(self) -> str:
        """All learners and demonstrators of its training in turn, by its own record, for example "dagger → apg".

        "" where the record holds no command of `ballbot train`.
        """
        training = self.read().get("training", {})
        # by today's names; "made_by" is the original command, if that differs
        command = str(training.get("command"))
        names = re.findall(r"(?:ballbot train|--expert) (\w+)", command)
        return " → ".join(name for i, name in enumerate(names) if names[i - 1 : i] != [name])

    def metadata(self, task: Task, robot: str = PAPER) -> dict[str, str]:
        """What exported files say: task, layouts and units of input and output, control rate, and origin of the policy.

        Raises:
            PolicyError: the policy is missing or damaged, or it needs a filter.
        """
        described, params = self.read(), named_robot(robot)
        if described["spec"].get("informed"):
            raise PolicyError(
                f"{self.path} needs a filter that estimates its robot, and filters cannot be exported; export another policy"
            )
        learner = described.get("training", {}).get("learner", "unknown")
        return {
            "task": task.id,
            "problem": task.problem(),
            "robot": robot,
            "observation": _observation_table(task) + _HEADING * bool(params.OUTPUTS),
            "observation_scale": json.dumps(task.observation_scale),
            "history": str(described.get("spec", {}).get("history", 0)),
            "observation_version": str(OBSERVATION_VERSION),
            "constants": json.dumps(task.constant_names),
            "action": _TORQUES if params.OUTPUTS else _FORCES,
            "force_limit_newton": repr(float(params.force_limit)),
            "control_dt_seconds": repr(task.control_dt),
            "learner": str(learner),
            "weights_sha256": self.weights_digest(),
            "ballbot_gym_version": ballbot_gym.__version__,
        }

    def weights_digest(self) -> str:
        """SHA-256 of the weights, or of a saved model, as hexadecimal digits; raises a PolicyError if they are missing."""
        try:
            return hashlib.sha256(files.read(self.weights)).hexdigest()
        except files.FileError as error:
            raise PolicyError(f"{self.weights} is not a policy: {error}") from error

    def network_digest(self) -> str:
        """Digest of the network that the description says; "" of a saved model, whose only file has the weights too."""
        return "" if Path(self.path).suffix == ".zip" else digest(self.read()["spec"])

    def digest(self) -> str:
        """Digest of what the policy does: its weights, and the network that its description says."""
        return digest(self.weights_digest(), self.network_digest())


def _observation_table(task: Task) -> str:
    """The part of a task's docstring that lists its observation: number, quantity, divisor and unit, as a table."""
    _, _, after = (inspect.getdoc(type(task)) or "").partition("Observation, ")
    return "".join(after.partition("\n\nAction")[0])


@lru_cache(maxsize=1)
def shipped_ways() -> Mapping[str, str]:
    """The whole way of each shipped policy, by the SHA-256 of its weights."""
    return {file.weights_digest(): file.way() for file in map(PolicyFile, SHIPPED.glob("*.json"))}


def shipped_policies(task: Task, robot: str = PAPER, track: str | None = "") -> dict[str, Path]:
    """The policies of a task and robot that come with the package: the paths of their .json by the learner's name.

    Those that were trained on a track, as "apg-late", are among them where that track is given, and all where it is None.
    """
    name = next((name for name, kind in TASKS.items() if type(task) is kind), None)
    if name is None:
        return {}
    start = f"{file_name(name, robot)}-"
    found = {path.stem.removeprefix(start): path for path in sorted(SHIPPED.glob(f"{start}*.json"))}
    return {
        learner: path
        for learner, path in found.items()
        if learner.partition("-")[0] not in ROBOTS and (track is None or track_in(learner) in ("", track))
    }


def track_in(name: str) -> str:
    """The track that a policy's name says it was trained on, or ""."""
    last = name.rpartition("-")[2]
    return last if last in TRACKS else ""
