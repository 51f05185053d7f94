"""Policies as ONNX files, which run wherever an ONNX runtime does: on robots, in C++, in browsers.

The graph is traced from `PolicyNetwork.forward`, so a policy's frame, mirror images, oddness and squashing are inside it.
"""

import contextlib
import copy
import io
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import ballbot_gym
from ballbot_gym import files
from ballbot_gym.lazy import imports_of, need
from ballbot_gym.robot import PAPER
from ballbot_gym.tasks import Task
from ballbot_train.policy.files import PolicyError, PolicyFile
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.policy.weights import own_defaults

with imports_of(__name__):
    import torch

_OPSET, _IR = 14, 7  # the lowest that onnx converts to; onnxruntime reads them since 1.8
_LARGEST_ERROR = 1e-5  # of an action: float32 sums in another order differ by less than 1e-6


@own_defaults()
def export_onnx(policy: str | Path, path: str | Path, task: Task, robot: str = PAPER) -> Path:
    """Writes a policy as an ONNX file, after checking that it acts as the policy does.

    The model has one input, `observation` (batch, no) float32 as the task observes, with the past behind it if the policy
    has a history, and one output, `action` (batch, 2) float32 in [−1, 1], in units of the force limit. Its metadata says what
    these are; see `PolicyFile.metadata`.

    Args:
        policy: the policy's file.
        path: of the ONNX file.
        task: what the policy was made for.
        robot: by name.

    Raises:
        PolicyError: as `PolicyNetwork.load`; or the policy's actions are not finite.
        ModuleNotFoundError: onnx or onnxscript is missing.
        RuntimeError: the ONNX graph acts differently from the policy.
    """
    network = PolicyNetwork.load(policy, task, robot).eval()
    about = PolicyFile(policy).metadata(task, robot)  # first, because it refuses policies that cannot be exported
    model = _traced(network)
    for name, value in about.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = name, value
    _check(model, network)
    return files.write(path, model.SerializeToString())


class _SiLU(torch.nn.Module):
    """SiLU by the exponential: the sigmoid of onnxruntime has errors that make those of actions a hundred times as large."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x / (1 + torch.exp(-x))


def _traced(network: PolicyNetwork) -> Any:
    """The network as an `onnx.ModelProto`, for batches of any size."""
    need("an ONNX file", "onnx", "onnxscript", extra="onnx")
    network = copy.deepcopy(network)
    for layers in [each for each in network.modules() if isinstance(each, torch.nn.Sequential)]:
        for i, layer in enumerate(layers):
            if isinstance(layer, torch.nn.SiLU):
                layers[i] = _SiLU()
    example = torch.zeros(2, network.spec.seen)
    silence = logging.getLogger("torch.onnx")
    level, silence.level = silence.level, logging.ERROR  # it lists libraries that are not installed
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")  # the exporter's own use of what torch has deprecated
            program = torch.onnx.export(
                network,
                (example,),
                input_names=["observation"],
                output_names=["action"],
                dynamic_shapes=({0: torch.export.Dim("batch")},),
                dynamo=True,
                verbose=False,
            )
    finally:
        silence.level = level
    assert program is not None
    from onnx.version_converter import convert_version

    model = convert_version(program.model_proto, _OPSET)
    model.ir_version = _IR
    model.producer_name, model.producer_version = "ballbot-gym", ballbot_gym.__version__
    for node in model.graph.node:  # the exporter notes there the files and lines of this machine
        del node.metadata_props[:]
    return model


def _check(model: Any, network: PolicyNetwork) -> None:
    """Raises a RuntimeError where the graph, run by ONNX's own reference, acts differently from the network."""
    from onnx.checker import check_model
    from onnx.reference import ReferenceEvaluator

    check_model(model, full_check=True)
    observations = np.random.default_rng(0).normal(size=(64, network.spec.seen)).astype(np.float32)
    # the reference's sigmoid computes both of two formulas, and takes the finite one
    with np.errstate(over="ignore", invalid="ignore"):
        (found,) = ReferenceEvaluator(model).run(None, {"observation": observations})  # pyright: ignore
    with torch.inference_mode():
        expected = network(torch.as_tensor(observations)).numpy()
    if not np.isfinite(expected).all():
        raise PolicyError("the policy's actions are not finite, so it cannot be exported; train it again")
    error = float(np.abs(found - expected).max())
    if not error < _LARGEST_ERROR:
        raise RuntimeError(f"the ONNX graph's actions differ from the policy's by {error:g}: not written")
