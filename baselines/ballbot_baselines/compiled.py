"""CasADi functions as machine code, kept in the user's cache folder; see `ballbot_gym.machine_code`.

Where they cannot be compiled the interpreted functions are used, and one line of log says why. They are slower, with the same
results to rounding.
"""

import logging

import casadi

from ballbot_gym import machine_code

_log = logging.getLogger(__name__)


def compiled(name: str, functions: tuple[casadi.Function, ...]) -> tuple[casadi.Function, ...]:
    """The same functions, compiled into one shared library, or unchanged where they cannot be compiled.

    Args:
        name: what the library is called, for humans who look into the cache.
        functions: expression graphs with distinct names.

    Raises:
        ValueError: $BALLBOT_CACHE is no absolute path.
    """
    try:
        library = machine_code.library(name, _source(functions))
        return tuple(casadi.external(function.name(), str(library)) for function in functions)
    except RuntimeError as error:  # it cannot be compiled, or not be loaded
        reason = str(error)[-300:]
    if reason:
        _log.warning("derivatives of %s stay interpreted: %s", name, reason)
    return functions


def _source(functions: tuple[casadi.Function, ...]) -> str:
    generator = casadi.CodeGenerator("stage.c")
    for function in functions:
        generator.add(function)
    return generator.dump()
