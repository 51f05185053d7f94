"""Saved models of Stable-Baselines3 as policies: their weights alone are read, and nothing in them is executed.

| file | from | read are |
|---|---|---|
| MODEL.zip | `model.save` of Stable-Baselines3 | `policy.pth`, as tensors; from `data`, plain JSON values |
| MODEL.vecnormalize.npz | `save_vecnormalize`, where observations were normalized | arrays of numbers |

These are PPO, A2C, SAC, TD3 and DDPG with MlpPolicy, and of sb3_contrib TQC and TRPO.

Pickles, such as `VecNormalize.save` writes, can execute code, and are not read.
"""

import hashlib
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from ballbot_gym import files
from ballbot_gym.lazy import imports_of
from ballbot_gym.params import BallbotParams
from ballbot_gym.sensors import observation_space
from ballbot_gym.tasks import Task
from ballbot_train.policy_files import PolicyError
from ballbot_train.weights import checked, linear_layers, saved_by_torch

with imports_of(__name__):
    import torch

_ACTIVATIONS = {name.lower(): name for name in ("ELU", "GELU", "LeakyReLU", "ReLU", "SELU", "SiLU", "Tanh")}
_MODULES = ("stable_baselines3.", "sb3_contrib.tqc.", "sb3_contrib.trpo.")  # whose policies act as it is written here
_DATA_LIMIT = 2**24  # bytes of JSON
_SUPPORTED = "give a model with MlpPolicy, or load the model yourself and give it to ballbot_train.evaluate"


class Spaces(NamedTuple):
    """What a model was trained on: a Box, or the name of a space of another kind."""

    observation_space: spaces.Box | str
    action_space: spaces.Box | str


class SavedActor(torch.nn.Module):
    """Normalizes observations, runs the network, and brings its output into [−1, 1]."""

    def __init__(self, network: torch.nn.Module, squashed: bool, statistics: Mapping[str, Any] | None):
        """Args: squashed: whether the output is, by tanh; statistics: as of `_read`."""
        super().__init__()
        self.network, self._squashed, self._statistics = network, squashed, statistics

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        if self._statistics is not None:
            mean, scale, limit = (self._statistics[name] for name in ("mean", "scale", "limit"))
            observation = ((observation.double() - mean) / scale).clamp(-limit, limit).float()
        action = self.network(observation)
        return torch.tanh(action) if self._squashed else action.clamp(-1.0, 1.0)


def check_spaces(name: str, model: Any, task: Task, params: BallbotParams) -> None:
    """Refuses a model that was trained in other spaces, as behind a wrapper that rescales, stacks or converts.

    Its `observation_space` and `action_space` are compared with the env's, if it has them.

    Raises:
        PolicyError: they differ; the message says what to evaluate instead.
    """
    seen = observation_space(task, params, history_of(model, task))
    own = {"observation": seen, "action": spaces.Box(-1.0, 1.0, (2,), np.float32)}
    for kind, wanted in own.items():
        found = getattr(model, f"{kind}_space", None)
        if found is not None and not _alike(found, wanted):
            raise PolicyError(
                f"{name} was trained on {kind}s {_in_words(found)}, and those of {task.id} are {_in_words(wanted)}. Where a "
                "wrapper changed them, give ballbot_train.evaluate a function that does what the wrapper did, for "
                "RescaleAction to ±350: lambda observation: model.predict(observation, deterministic=True)[0] / 350"
            )


def history_of(model: Any, task: Task) -> int:
    """How many earlier observations and actions a model saw in training, by the size of its observations; else 0."""
    shape, own = getattr(getattr(model, "observation_space", None), "shape", None), len(task.observation_scale)
    more = shape[0] - own if shape and len(shape) == 1 else 0
    return more // (own + 2) if more > 0 and more % (own + 2) == 0 else 0


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


def observations_of(path: str | Path) -> int:
    """The size of the observations that a saved model takes.

    Raises:
        PolicyError: as `load_actor`.
    """
    layers, *_ = _read(path)
    return layers[0][0].shape[1]


def fits(path: str | Path, task: Task, params: BallbotParams) -> bool:
    """Whether a saved model takes observations of a task's size.

    Raises:
        PolicyError: as `load_actor`; also where the size is the task's and the spaces are not.
    """
    layers, *_, trained = _read(path)
    if layers[0][0].shape[1] != len(task.observation_scale):
        return False
    check_spaces(str(path), trained, task, params)
    return True


def digest(path: str | Path) -> str:
    """SHA-256 of a saved model and of the statistics beside it, as hexadecimal digits."""
    beside = [other for other in (statistics_of(path),) if other.exists()]
    return hashlib.sha256(b"".join(files.read(part) for part in (path, *beside))).hexdigest()


def statistics_of(path: str | Path) -> Path:
    """The path of the statistics of a saved model's observations."""
    path = Path(path)
    return path.with_name(f"{path.stem}.vecnormalize.npz")


def save_vecnormalize(normalization: Any, model: str | Path) -> Path:
    """Writes the statistics of a Stable-Baselines3 `VecNormalize` beside a saved model, for `ballbot evaluate MODEL.zip`.

    Args:
        normalization: the VecNormalize, for instance of `model.get_vec_normalize_env()`, or of `VecNormalize.load`.
        model: path of the saved model, MODEL.zip or MODEL.

    Returns:
        The path of the file, MODEL.vecnormalize.npz.

    Raises:
        TypeError: it is no VecNormalize of plain observations.
    """
    model = Path(model)
    model = model if model.suffix == ".zip" else model.with_name(f"{model.name}.zip")
    moments = getattr(normalization, "obs_rms", None)
    if not hasattr(normalization, "norm_obs") or (normalization.norm_obs and not hasattr(moments, "mean")):
        raise TypeError(f"give a VecNormalize of plain observations, not {normalization!r}")
    arrays: dict[str, np.ndarray] = {"normalized": np.array(int(normalization.norm_obs))}
    if normalization.norm_obs and moments is not None:
        arrays |= {
            "mean": np.asarray(moments.mean, np.float64),
            "variance": np.asarray(moments.var, np.float64),
            "epsilon": np.array(float(normalization.epsilon)),
            "limit": np.array(float(normalization.clip_obs)),
        }
    return files.write_npz(statistics_of(model), arrays)


def load_actor(path: str | Path, task: Task, params: BallbotParams) -> SavedActor:
    """The deterministic policy of a saved model: from observations (..., no), float32, to actions (..., 2) in [−1, 1].

    Args:
        path: of the file.
        task: what it is to do.
        params: the robot.

    Raises:
        PolicyError: the file is missing, damaged or of a kind that is not read; or its observations or actions are not the
            env's.
    """
    found, activation, squashed, normalization, trained = _read(path)
    size = found[0][0].shape[1]
    if size != len(task.observation_scale):
        raise PolicyError(f"{path} takes {size} observations, {task.id} has {len(task.observation_scale)}")
    check_spaces(str(path), trained, task, params)
    if normalization is not None and len(normalization["mean"]) != size:
        raise PolicyError(f"{path} takes {size} observations, its statistics are of {len(normalization['mean'])}")
    widths = (size, *(len(bias) for _, bias in found))
    network = linear_layers(widths, getattr(torch.nn, _ACTIVATIONS[activation]), device="cpu", dtype=torch.float32)
    for linear, (weight, bias) in zip(list(network)[::2], found, strict=True):
        linear.load_state_dict({"weight": weight, "bias": bias})
    return SavedActor(network, squashed, normalization).eval()


def _read(path: str | Path) -> tuple[list[Any], str, bool, dict[str, Any] | None, Spaces]:
    """Layers (weight, bias), activation, whether tanh squashes, statistics of observations, or None, and the spaces."""
    try:
        return _read_zip(Path(path))
    except PolicyError:
        raise
    except Exception as error:  # torch has dozens of ways to refuse a damaged file
        reason = str(error) if isinstance(error, files.FileError) else f"{error!r:.300}"
        raise PolicyError(f"{path} is no saved model that can be read, or a damaged one: {reason}") from error


def _read_zip(path: Path) -> tuple[list[Any], str, bool, dict[str, Any] | None, Spaces]:
    members = files.unzipped(files.read(path), path)
    for name in ("data", "policy.pth"):
        if name not in members:
            raise PolicyError(f"{path} is no saved Stable-Baselines3 model: it holds no {name}")
    data = files.read_json(f"data in {path}", _DATA_LIMIT, members["data"])
    weights = saved_by_torch(members["policy.pth"], f"policy.pth in {path}")
    made_by = str(data["policy_class"].get("__module__", ""))
    if not made_by.startswith(_MODULES):
        raise PolicyError(
            f"{path} has a policy of {made_by or 'an unknown module':.100}, which is not read; {_SUPPORTED}"
        )
    options = data.get("policy_kwargs") or {}
    unknown = [name for name in weights if "features_extractor" in name or "lstm" in name]
    if unknown or "features_extractor_class" in options:
        raise PolicyError(
            f"{path} extracts features ({(unknown or ['features_extractor_class'])[0]:.100}); {_SUPPORTED}"
        )
    if data.get("use_sde"):
        raise PolicyError(f"{path} explores by its state (use_sde), which is not read; {_SUPPORTED}")
    if "action_net.weight" in weights:
        layers, usual = _layers(path, weights, "mlp_extractor.policy_net.", "action_net."), "tanh"
    elif any(name.startswith("actor.latent_pi.") for name in weights):
        layers, usual = _layers(path, weights, "actor.latent_pi.", "actor.mu."), "relu"
    elif "actor.mu.0.weight" in weights:
        layers, usual = _layers(path, weights, "actor.mu."), "relu"
    else:
        raise PolicyError(f"{path} has no actor that is read, but {', '.join(list(weights)[:4]):.200}, …; {_SUPPORTED}")
    named = str(options.get("activation_fn", usual))
    activation = named.rstrip("'>").rpartition(".")[2].rpartition("'")[2].lower()
    if activation not in _ACTIVATIONS:
        raise PolicyError(f"{path} has the activation {named:.100}; known: {', '.join(_ACTIVATIONS)}")
    found = Spaces(_space(data["observation_space"]), _space(data["action_space"]))
    return layers, activation, usual == "relu", _statistics(path, data), found


def _space(described: Mapping[str, Any]) -> spaces.Box | str:
    """A space from the words that stand beside its pickled form, which is not read."""
    kind = str(described[":type:"])
    if not kind.endswith(".box.Box'>"):
        return kind
    shape, dtype = described.get("_shape", described.get("shape")), np.dtype(described["dtype"])
    words = (str(described[end]).replace("[", " ").replace("]", " ").split() for end in ("low", "high"))
    low, high = (np.array(each, np.float64).astype(dtype).reshape(shape) for each in words)
    return spaces.Box(low, high, dtype=dtype.type)


def _statistics(path: Path, data: Mapping[str, Any]) -> dict[str, Any] | None:
    """Mean, scale and limit of the normalization of observations, or None."""
    beside = statistics_of(path)
    if not beside.exists():
        # Only on-policy algorithms leave this empty where there was no VecNormalize.
        if "gae_lambda" in data and data.get("_last_original_obs") is not None:
            raise PolicyError(
                f"{path} was trained with VecNormalize, and {beside} is missing. Its own file is a pickle, which can execute "
                f"code and is not read. Write the statistics where you trust it: ballbot_train.save_vecnormalize("
                f'VecNormalize.load("vecnormalize.pkl", venv), "{path}")'
            )
        return None
    arrays = files.read_npz(beside)
    try:
        if not files.numbers(arrays["normalized"], "normalized", ()):
            return None
        mean = files.numbers(arrays["mean"], "mean")
        variance = files.numbers(arrays["variance"], "variance", (mean.size,))
        epsilon, limit = (float(files.numbers(arrays[name], name, ())) for name in ("epsilon", "limit"))
        if mean.ndim != 1 or limit <= 0 or (variance + epsilon <= 0).any():
            raise ValueError("mean must be a row of numbers, variance + epsilon and limit positive")
    except (KeyError, ValueError) as error:
        raise PolicyError(
            f"{beside} is damaged ({error}); write it again with ballbot_train.save_vecnormalize"
        ) from error
    scale = torch.sqrt(torch.from_numpy(variance + epsilon))
    return {"mean": torch.from_numpy(mean), "scale": scale, "limit": limit}


def _layers(path: Path, weights: Mapping[str, Any], *prefixes: str) -> list[Any]:
    """Weight and bias of the linear layers under names that begin so, in order.

    Raises:
        PolicyError: they are not what `checked` takes, do not follow one another, or do not end in two actions.
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
    if not fitting or shapes[-1:] != [(2,)]:
        raise PolicyError(
            f"{path} is no network of linear layers that ends in 2 actions: its weights and biases are {shapes!s:.200}"
        )
    return layers
