"""Saved models of Stable-Baselines3 as policies: their weights alone are read, and nothing in them is executed.

Of MODEL.zip, as `model.save` writes it, `policy.pth` is read as tensors, and of `data` plain JSON values. These are PPO, A2C,
SAC, TD3 and DDPG with MlpPolicy, with or without exploration by the state (use_sde), and of sb3_contrib TQC and TRPO.
Pickles, such as `VecNormalize.save` writes, can execute code, and are not read.
"""

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from ballbot_gym import files
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import Robot
from ballbot_gym.step import observation_space
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import observation_digest
from ballbot_train.policy.files import PolicyError
from ballbot_train.policy.weights import checked, linear_layers, saved_by_torch

with imports_of(__name__):
    import torch

_ACTIVATIONS = ("ELU", "GELU", "LeakyReLU", "ReLU", "SELU", "SiLU", "Tanh")
_MODULES = ("stable_baselines3.", "sb3_contrib.tqc.", "sb3_contrib.trpo.")  # whose policies act as it is written here
_ON_POLICY, _OFF_POLICY = ("mlp_extractor.policy_net.", "action_net."), ("actor.latent_pi.", "actor.mu.")
"""How the names of actors' layers begin."""
_MARK = "ballbot_observation_digest"
_DATA_LIMIT = 2**24  # bytes of JSON


class SavedModel(NamedTuple):
    """What is read of a model."""

    path: Path
    """Of its file."""
    layers: list[Any]
    """Weight and bias of each."""
    activation: str
    """Between them, a name in `torch.nn`."""
    squashed: bool
    """Whether the output is, by tanh."""
    most: float
    """What the output is clipped to, in size, before it is squashed."""
    observation_space: spaces.Box | str
    action_space: spaces.Box | str
    """What it was trained on: a Box, or the name of a space of another kind."""

    @property
    def observations(self) -> int:
        """Numbers of an observation."""
        return self.layers[0][0].shape[1]

    @classmethod
    def read(cls, path: str | Path) -> "SavedModel":
        """What a file holds.

        Raises:
            PolicyError: the file is missing, damaged or of a kind that is not read.
        """
        try:
            return _read_zip(Path(path))
        except PolicyError:
            raise
        except Exception as error:  # torch has dozens of ways to refuse a damaged file
            reason = str(error) if isinstance(error, files.FileError) else f"{error!r:.300}"
            raise PolicyError(f"{path} cannot be read as a saved model: {reason}") from error

    def _size(self, task: Task, params: Robot) -> int:
        """Numbers that an env shows to the model, with the history that it was trained with."""
        (size,) = observation_space(task, params, _history_of(self, task, params)).shape
        return size

    def fits(self, task: Task, params: Robot) -> bool:
        """Whether it takes observations of a task's size, with or without earlier ones.

        Raises:
            PolicyError: the size is the task's and the spaces are not.
        """
        if self.observations != self._size(task, params):
            return False
        check_spaces(str(self.path), self, task, params)
        return True

    def actor(
        self, task: Task, params: Robot, counterpart: tuple[spaces.Box, spaces.Box] | None = None
    ) -> "_SavedActor":
        """The deterministic policy: from observations (..., no), float32, to actions (..., 2) in [−1, 1].

        Args:
            task: what it is to do.
            params: the robot.
            counterpart: spaces of observations and actions of the environment in which it was trained, if that is a
                counterpart of the task.

        Raises:
            PolicyError: its observations or actions are not the env's.
        """
        size = counterpart[0].shape[0] if counterpart else self._size(task, params)
        actions = len(self.layers[-1][1])
        if (self.observations, actions) != (size, params.action_size):
            raise PolicyError(
                f"{self.path} takes {self.observations} observations and gives {actions} actions; {task.id} has {size} and "
                f"{params.action_size}"
            )
        history = check_spaces(str(self.path), self, task, params, counterpart)
        widths = (size, *(len(bias) for _, bias in self.layers))
        network = linear_layers(widths, getattr(torch.nn, self.activation), device="cpu", dtype=torch.float32)
        for linear, (weight, bias) in zip(list(network)[::2], self.layers, strict=True):
            linear.load_state_dict({"weight": weight, "bias": bias})
        unit = counterpart[1].high if counterpart else 1.0
        return _SavedActor(network, self.squashed, history, unit, self.most).eval()


class _SavedActor(torch.nn.Module):
    """Runs a network, and brings its output into [−1, 1]."""

    def __init__(
        self, network: torch.nn.Module, squashed: bool, history: int = 0, unit: Any = 1.0, most: float = math.inf
    ):
        """Args: squashed: whether the output is, by tanh; else it is clipped. history: as that of its env. unit: the largest
        action of its env. most: see `SavedModel`.
        """
        super().__init__()
        self._most = most
        self.history = history
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.float32))
        self.network, self._squashed = network, squashed

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        action = self.network(observation)
        if self._squashed:
            return torch.tanh(action.clamp(-self._most, self._most))
        return (action / self.unit).clamp(-1.0, 1.0)


def mark(space: spaces.Space, task: Task, params: Robot) -> None:
    """Adds the digest of a task's observations to the space that models are trained in: their files keep what is added.

    `BallbotVecEnv` and `RegretCallback` do so. Models that were trained without them are known by their spaces alone.
    """
    setattr(space, _MARK, observation_digest(task, params))


def check_spaces(
    name: str, model: Any, task: Task, params: Robot, counterpart: tuple[spaces.Box, spaces.Box] | None = None
) -> int:
    """Refuses a model that was trained in other spaces, as behind a wrapper that rescales, stacks or converts.

    Its `observation_space` and `action_space` are compared with the env's, if it has them, and so is its `mark`. The spaces
    of a `counterpart` of the task may be given instead of the env's.

    Returns:
        The number of earlier observations and actions that the model observes.

    Raises:
        PolicyError: they differ; the message says what to evaluate instead.
    """
    history = 0 if counterpart else _history_of(model, task, params)
    if (
        getattr(getattr(model, "observation_space", None), _MARK, observed := observation_digest(task, params))
        != observed
    ):
        raise PolicyError(
            f"{name} was trained on other observations: {task.id} observes other values in the same states; restore its "
            "`observe`, or train again"
        )
    seen = observation_space(task, params, history)
    acting = spaces.Box(-1.0, 1.0, (params.action_size,), np.float32)
    own = dict(zip(("observation", "action"), counterpart or (seen, acting), strict=True))
    for kind, wanted in own.items():
        found = getattr(model, f"{kind}_space", None)
        if found is not None and not _alike(found, wanted):
            if kind == "observation" and history and getattr(found, "shape", None) == wanted.shape:
                raise PolicyError(
                    f"{name} was trained on {wanted.shape[0]} numbers, which may be a stack of frames: past actions of an "
                    f"env with history={history} are bounded by 1, and these are not. Give ballbot_train.evaluate a "
                    "function that stacks the frames and calls the model, or train with history=N of this version"
                )
            raise PolicyError(
                f"{name} was trained on {kind}s {_in_words(found)}, and those of {task.id} are {_in_words(wanted)}. Where a "
                "wrapper changed them, give ballbot_train.evaluate a function that does what the wrapper did, for "
                "RescaleAction to ±350: lambda observation: model.predict(observation, deterministic=True)[0] / 350"
            )
    return history


def _history_of(model: Any, task: Task, params: Robot) -> int:
    """The number of earlier observations and actions that a model observed, by the size of its observations; else 0.

    `check_spaces` refuses other spaces of this size.
    """
    shape, own = getattr(getattr(model, "observation_space", None), "shape", None), task.observation_size(params)
    more = shape[0] - own if shape and len(shape) == 1 else 0
    past = own + params.action_size
    return more // past if more > 0 and more % past == 0 else 0


def _alike(found: Any, wanted: spaces.Box) -> bool:
    """Whether a space has the shape, the dtype and, to a thousandth, as saved models round them, the bounds of another."""
    return (
        isinstance(found, spaces.Box)
        and (found.shape, found.dtype) == (wanted.shape, wanted.dtype)
        and all(np.allclose(getattr(found, end), getattr(wanted, end), rtol=1e-3) for end in ("low", "high"))
    )


def _in_words(space: Any) -> str:
    if not isinstance(space, spaces.Box):
        return f"{space!s:.200}"
    return f"{space.shape} {space.dtype} from {space.low.min():g} to {space.high.max():g}"


def _read_zip(path: Path) -> SavedModel:
    members = files.unzipped(files.read(path), path)
    for name in ("data", "policy.pth"):
        if name not in members:
            raise PolicyError(f"{path} is not a saved Stable-Baselines3 model: it holds no {name}")
    data = files.read_json(f"data in {path}", _DATA_LIMIT, members["data"])
    weights = saved_by_torch(members["policy.pth"], f"policy.pth in {path}")
    options, made_by = data.get("policy_kwargs") or {}, str(data["policy_class"].get("__module__", ""))
    extracts = any("features_extractor" in name or "lstm" in name for name in [*weights, *options])
    begins = next((start for start in (_ON_POLICY, _OFF_POLICY) if any(n.startswith(start[-1]) for n in weights)), ())
    usual = "Tanh" if begins == _ON_POLICY else "ReLU"
    given = str(options.get("activation_fn", f"<class 'torch.nn.modules.activation.{usual}'>"))
    # a class of a user may have the name of one of torch's
    activation = given.removeprefix("<class 'torch.nn.modules.activation.").removesuffix("'>")
    unread = {
        f"a policy of {made_by or 'an unknown module':.100}": not made_by.startswith(_MODULES),
        "a network that extracts features": extracts,
        "an output that is squashed by tanh (squash_output)": begins == _ON_POLICY and options.get("squash_output"),
        # only on-policy algorithms leave this empty where there was no VecNormalize
        "statistics of VecNormalize": "gae_lambda" in data and data.get("_last_original_obs") is not None,
        f"the activation {activation:.100}": activation not in _ACTIVATIONS,
        f"no actor, but {', '.join(list(weights)[:4]):.200}": not begins,
    }
    if reasons := [what for what, holds in unread.items() if holds]:
        raise PolicyError(
            f"{path} has {reasons[0]}, which is not read; give a model with MlpPolicy, or load the model where you trust it, "
            "and give it to ballbot_train.evaluate"
        )
    found = (_space(data[name]) for name in ("observation_space", "action_space"))
    # where off-policy algorithms explore by the state, they bound the mean action, see SB3's `Actor`
    bound = float(options.get("clip_mean", 2.0)) if data.get("use_sde") and begins == _OFF_POLICY else 0.0
    return SavedModel(path, _layers(path, weights, *begins), activation, usual == "ReLU", bound or math.inf, *found)


def _space(described: Mapping[str, Any]) -> spaces.Box | str:
    """A space from its text form. The pickled form is not read."""
    kind = str(described[":type:"])
    if not kind.endswith(".box.Box'>"):
        return kind
    shape, dtype = described.get("_shape", described.get("shape")), np.dtype(described["dtype"])
    words = (str(described[end]).replace("[", " ").replace("]", " ").split() for end in ("low", "high"))
    low, high = (np.array(each, np.float64).astype(dtype).reshape(shape) for each in words)
    space = spaces.Box(low, high, dtype=dtype.type)
    if _MARK in described:
        setattr(space, _MARK, str(described[_MARK]))
    return space


def _layers(path: Path, weights: Mapping[str, Any], *prefixes: str) -> list[Any]:
    """Weight and bias of the linear layers under names that begin so, in order.

    Raises:
        PolicyError: they are not what `checked` takes, or do not follow one another.
    """
    names = []
    for prefix in prefixes:
        numbers = {name.removeprefix(prefix).rpartition(".")[0] for name in weights if name.startswith(prefix)}
        for number in sorted(numbers, key=lambda text: int(text or 0)):
            start = f"{prefix}{number}." if number else prefix
            names.append((f"{start}weight", f"{start}bias"))
    found = checked({name: weights[name] for pair in names for name in pair}, path)
    layers = [(found[weight], found[bias]) for weight, bias in names]
    shapes = [tuple(part.shape) for layer in layers for part in layer]
    fitting = all(weight.ndim == 2 and bias.shape == weight.shape[:1] for weight, bias in layers) and all(
        after.shape[1] == before.shape[0] for (before, _), (after, _) in itertools.pairwise(layers)
    )
    if not fitting or not shapes:
        raise PolicyError(
            f"{path} is not a network of linear layers that ends in actions: its weights and biases are {shapes!s:.200}"
        )
    return layers
