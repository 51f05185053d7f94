"""The layers of a policy in machine code, for thousands of observations at once.

Networks of policies are small, so that torch spends more time on their activations, and on memory between its operations,
than on their products. `layers.c` computes all layers of a few observations before it goes on to the next ones.
"""

import copy
import ctypes
from functools import cache
from pathlib import Path
from typing import Any

from ballbot_gym import machine_code
from ballbot_gym.lazy import imports_of
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_train.policy.network import PolicyNetwork

with imports_of(__name__):
    import torch

_SOURCE = Path(__file__).with_name("layers.c")
_ACTIVATIONS = ("tanh", "relu", "silu")  # in the order of layers.c
_WIDEST = 1024  # numbers between layers
_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", f"-DWIDEST={_WIDEST}")


def with_compiled_layers(network: PolicyNetwork) -> PolicyNetwork:
    """The same policy with its layers in machine code, without gradients; or the policy itself where that cannot be made.

    Its actions differ from torch's by the rounding of single precision.
    """
    try:
        layers = _Layers(network.mlp, network.spec.activation)
    except NoMachineCodeError:
        return network
    faster = copy.copy(network)
    faster._modules = {**network._modules, "mlp": layers}
    return faster


@cache
def _library() -> ctypes.CDLL:
    return ctypes.CDLL(str(machine_code.library("layers", _SOURCE.read_text(encoding="utf-8"), _FLAGS)))


class _Layers(torch.nn.Module):
    """Linear layers with an activation between them."""

    def __init__(self, layers: torch.nn.Sequential, activation: str):
        """Raises: NoMachineCodeError: they cannot be compiled, or are wider than is supported."""
        super().__init__()
        linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
        widths = [linear[0].in_features, *(layer.out_features for layer in linear)]
        if max(widths) > _WIDEST:
            raise NoMachineCodeError(f"layers of {max(widths)} units are wider than {_WIDEST}")
        self._outputs, self._function = widths[-1], _library().layers
        # kept, so that the pointers stay valid
        self._kept = [
            [None if part is None else part.detach().contiguous() for part in (layer.weight, layer.bias)]
            for layer in linear
        ]
        pointers: Any = ctypes.c_void_p * len(linear)
        weights, biases = (
            pointers(*(None if part is None else part.data_ptr() for part in parts))
            for parts in zip(*self._kept, strict=True)
        )
        sizes = (ctypes.c_int32 * len(widths))(*widths)
        self._shape = ctypes.c_int32(len(linear)), sizes, weights, biases
        self._activation = ctypes.c_int32(_ACTIVATIONS.index(activation))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """(..., inputs) float32 to (..., outputs)."""
        given = inputs.float().contiguous()
        outputs = torch.empty(*given.shape[:-1], self._outputs)
        pointers = (ctypes.c_void_p(part.data_ptr()) for part in (given, outputs))
        self._function(ctypes.c_int64(outputs.numel() // self._outputs), *self._shape, self._activation, *pointers)
        return outputs
