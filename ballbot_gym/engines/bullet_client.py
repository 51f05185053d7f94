"""PyBullet if it is installed, imported without its output."""

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from types import ModuleType

HOW_TO_GET_IT = (
    'Get it with "pip install pybullet" on Linux x86-64 under Python 3.10 or 3.11: elsewhere it has no wheel.'
)


def import_pybullet() -> ModuleType:
    """PyBullet, or an ImportError that says how to get it, and what to do otherwise."""
    try:
        with _silenced() if "pybullet" not in sys.modules else nullcontext():  # it prints when it was built
            import pybullet
    except ImportError as error:
        raise ImportError(
            f'PyBullet is not installed. {HOW_TO_GET_IT} Or use physics="mujoco", or "rk4", which needs only NumPy.'
        ) from error
    if not pybullet.isNumpyEnabled():
        raise ImportError(
            "This PyBullet was built without NumPy. Reinstall its wheel with "
            '"pip install --force-reinstall --only-binary=:all: pybullet", or install NumPy first and build again.'
        )
    return pybullet


@contextmanager
def _silenced() -> Iterator[None]:
    """Drops what C code prints within the block."""
    # C buffers what it prints into a pipe, so its buffer must be emptied before and after
    flush = getattr(ctypes.CDLL(None), "fflush", lambda _: None) if os.name == "posix" else lambda _: None
    kept: dict[int, int] = {}
    flush(None)
    with open(os.devnull, "wb") as nothing:
        for stream in (1, 2):
            with suppress(OSError):  # it is closed, so nothing can be printed to it
                kept[stream] = os.dup(stream)
                os.dup2(nothing.fileno(), stream)
    try:
        yield
    finally:
        flush(None)
        for stream, original in kept.items():
            os.dup2(original, stream)
            os.close(original)
