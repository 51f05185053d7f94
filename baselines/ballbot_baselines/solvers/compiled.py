"""CasADi functions as machine code, kept in the user's cache folder; see `ballbot_gym.machine_code`.

Where they cannot be compiled the interpreted functions are used, and one line of log says why. They are slower, with the same
results to rounding.
"""

import logging
from collections.abc import Callable, Iterable

import casadi
import numpy as np

from ballbot_gym import machine_code
from ballbot_gym.machine_code import codegen

LANES = 8
"""Stages that `in_lanes` computes at once: as many float64 as an AVX-512 register holds."""

# Without -O2, GCC leaves the upper halves of vector registers dirty, which slows all SSE code that runs afterwards. It spends
# most of its time on which registers to free. With these last settings it weighs nothing against each other, takes half of
# the time, and the code is as fast.
SIMD = (
    *("-O2", "-ftree-vectorize", "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fopenmp-simd"),
    *("-fira-region=one", "--param", "lra-max-considered-reload-pseudos=0"),
)
"""Flags of the compiler for functions of `LANES` stages."""

LONG = (*SIMD, "-O1", "-fno-ivopts")
"""The same for a function of more than `_MANY` operations, on which the compiler would spend twice the time."""

_MANY = 10_000

_log = logging.getLogger(__name__)


def compiled(name: str, functions: tuple[casadi.Function, ...]) -> tuple[casadi.Function, ...]:
    """The same functions, compiled into one shared library, or unchanged where they cannot be compiled.

    Args:
        name: what the library is called, for humans who look into the cache.
        functions: expression graphs with distinct names.

    Raises:
        ValueError: $BALLBOT_CACHE is no absolute path.
    """
    generator = casadi.CodeGenerator("stage.c")
    for function in functions:
        generator.add(function)
    return _loaded(name, generator.dump, _names(functions), ("-O2",)) or functions


def in_lanes(name: str, functions: tuple[casadi.Function, ...]) -> tuple[casadi.Function, ...]:
    """The same functions of `LANES` stages at once, which SIMD instructions compute: a column for each stage.

    Args: those of `compiled`. Arguments and results are dense columns.

    Raises:
        ValueError: $BALLBOT_CACHE is no absolute path.
    """
    lanes = f"{name}-lanes"

    def source() -> str:
        # printing takes a third of the time in which a first optimum is found, and serializing a tenth of that
        problem = LANES, *(function.serialize() for function in functions)
        return machine_code.printed(lanes, problem, (), lambda: codegen.in_lanes(functions, LANES))

    flags = LONG if max(function.n_instructions() for function in functions) > _MANY else SIMD
    try:
        found = _loaded(lanes, source, _names(functions), flags)
    except NotImplementedError:  # an operation that only CasADi can write as C
        found = compiled(name, functions)
        return tuple(function.map(LANES) for function in found)
    return found or tuple(function.map(LANES) for function in functions)


class InPlace:
    """A function that reads and writes given arrays. A call through `casadi.DM` would take twice as long."""

    def __init__(self, function: casadi.Function, inputs: list[np.ndarray], outputs: list[np.ndarray]):
        self._buffer = function.buffer()[0]
        self._inputs, self._outputs = ([array.data for array in arrays] for arrays in (inputs, outputs))

    def __call__(self) -> bool:
        """Whether it ran without an error."""
        buffer = self._buffer
        # HPIPM's interface changes the pointers that it is given (seen in CasADi 3.8.2), so they are set before each call.
        # The type stubs ask for a size, but memory views bring their own.
        for i, view in enumerate(self._inputs):
            buffer.set_arg(i, view)  # pyright: ignore[reportCallIssue]
        for i, view in enumerate(self._outputs):
            buffer.set_res(i, view)  # pyright: ignore[reportCallIssue]
        buffer._eval()
        return buffer.ret() == 0

    @property
    def solved(self) -> bool:
        """Whether a solver reports success."""
        return bool(self._buffer.stats()["success"])


def _loaded(
    name: str, source: Callable[[], str], functions: Iterable[str], flags: tuple[str, ...]
) -> tuple[casadi.Function, ...] | None:
    """The functions, by their names, of a library of the C code that `source` prints; None where there is none."""
    code = source()
    try:
        library = machine_code.library(name, code, flags)
        return tuple(casadi.external(function, str(library)) for function in functions)
    except RuntimeError as error:  # it cannot be compiled, or not be loaded
        if str(error):
            _log.warning("derivatives of %s stay interpreted: %s", name, str(error)[-300:])
    return None


def _names(functions: Iterable[casadi.Function]) -> list[str]:
    return [function.name() for function in functions]
