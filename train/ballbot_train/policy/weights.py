"""Weights, whatever is around them: from files that others made, and where torch's defaults are others than ours.

Nothing in a file is executed, nothing grows beyond it, and all weights are finite numbers.
"""

import io
import itertools
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from ballbot_gym import files
from ballbot_gym.lazy import imports_of
from ballbot_train.policy.files import PolicyError

with imports_of(__name__):
    import torch

_LARGEST = 1e6  # far above any trained weight, and low enough for sums of their products in float32


@contextmanager
def own_defaults() -> Iterator[None]:
    """Within it torch is as learners take it, whatever the caller has set: float32 on the CPU, with gradients."""
    kind = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        # a default device slows every call of torch, so it is set only where there is another
        device = nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu")
        without_casts = torch.autocast("cpu", enabled=False)
        with device, without_casts, torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(kind)


def linear_layers(
    widths: Sequence[int], activation: Callable[[], torch.nn.Module], **options: Any
) -> torch.nn.Sequential:
    """Linear layers from width to width, with an activation between them; options are torch's of a linear layer."""
    made: list[torch.nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(widths):
        made += [torch.nn.Linear(fan_in, fan_out, **options), activation()]
    return torch.nn.Sequential(*made[:-1])


def saved_by_torch(content: bytes, path: str | Path, limit: int = files.READ_LIMIT) -> dict[str, Any]:
    """What torch.save wrote, as tensors on the CPU and plain values.

    Args:
        content: of the file.
        path: what errors call it.
        limit: bytes, unpacked.

    Raises:
        Exception: of torch, which has dozens of kinds of them for files that are damaged or hold other objects.
        ValueError: it is no archive of torch.save, holds no dict, or a tensor that declares more numbers than are stored.
    """
    # torch reads archives with other code, and unpacks what they declare: it gets another, of what was checked
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, part in files.unzipped(content, path, limit).items():
            if name.endswith("data.pkl") and b"bytearray" in part:  # torch would make one of any size
                raise ValueError(f"{path} holds other objects than tensors")
            archive.writestr(name, part)
    packed.seek(0)
    saved = torch.load(packed, weights_only=True, map_location="cpu")
    if not isinstance(saved, dict):
        raise ValueError(f"{path} holds {type(saved).__name__} and no weights")
    waiting, seen = [saved], set[int]()
    while waiting:
        part: Any = waiting.pop()
        if id(part) in seen:  # a file can name one object twice in each of forty lists
            continue
        seen.add(id(part))
        if isinstance(part, torch.Tensor):
            if part.layout != torch.strided or part.nbytes > part.untyped_storage().nbytes():
                raise ValueError(f"{path} holds a tensor of {part.numel()} numbers, and stores fewer")
        elif isinstance(part, Mapping | list | tuple | set):
            waiting += part.values() if isinstance(part, Mapping) else part
    return saved


def checked(weights: Mapping[str, Any], path: str | Path) -> dict[str, torch.Tensor]:
    """Weights by name as float32 on the CPU, together no more numbers than are stored: they may share none.

    Raises:
        PolicyError: one is something else, or holds numbers that are not finite or too large; the message names it.
    """
    declared, stored = 0, {}
    for name, tensor in weights.items():
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point() or tensor.layout != torch.strided:
            kind = tensor.dtype if isinstance(tensor, torch.Tensor) else type(tensor).__name__
            raise PolicyError(f"{path}: {name:.100} holds {kind}, and not floating-point numbers")
        declared += tensor.nbytes
        stored[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
    if declared > sum(stored.values()):
        raise PolicyError(f"{path} declares weights of {declared} bytes, and stores {sum(stored.values())}")
    found = {name: tensor.detach().float() for name, tensor in weights.items()}
    for name, tensor in found.items():
        if not tensor.isfinite().all():
            raise PolicyError(
                f"{path}: {name:.100} holds NaN or infinity; take an earlier policy of the training, or train again"
            )
        if (tensor.abs() > _LARGEST).any():
            raise PolicyError(
                f"{path}: {name:.100} holds numbers beyond ±{_LARGEST:g}; take an earlier policy of the training, or train "
                "again"
            )
    return found
