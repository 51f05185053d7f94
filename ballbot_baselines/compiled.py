"""CasADi functions compiled to machine code, once per content and processor, kept in the user's cache folder.

Without a C compiler the interpreted functions are used instead: slower, with the same results to rounding.
"""

import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import casadi

_log = logging.getLogger(__name__)
_FLAGS = ("-O2", "-march=native", "-fPIC", "-shared")


def compiled(name: str, functions: tuple[casadi.Function, ...]) -> tuple[casadi.Function, ...]:
    """The same functions, compiled into one shared library, or unchanged where there is no C compiler.

    Args:
        name: what the library is called, for humans who look into the cache.
        functions: expression graphs with distinct names.
    """
    compiler = _compiler()
    if compiler is None:
        return functions
    with tempfile.TemporaryDirectory() as folder:
        generator = casadi.CodeGenerator("stage.c")
        for function in functions:
            generator.add(function)
        generator.generate(folder + os.sep)
        source = (Path(folder) / "stage.c").read_bytes()
        key = hashlib.sha256(source + _machine(compiler).encode() + " ".join(_FLAGS).encode()).hexdigest()[:24]
        library = cache_folder() / f"{name}-{key}.so"
        if not library.exists():
            library.parent.mkdir(parents=True, exist_ok=True)
            # A name of its own, then an atomic rename: a second process or a kill never leaves half a library.
            unfinished = library.with_name(f"{library.stem}.{os.getpid()}.tmp")
            result = subprocess.run(
                [compiler, *_FLAGS, str(Path(folder) / "stage.c"), "-o", str(unfinished), "-lm"],
                capture_output=True,
                text=True,
            )
            if result.returncode != 0:
                unfinished.unlink(missing_ok=True)
                _log.warning("%s failed, derivatives stay interpreted: %s", compiler, result.stderr.strip()[-300:])
                return functions
            unfinished.replace(library)
    return tuple(casadi.external(function.name(), str(library)) for function in functions)


def cache_folder() -> Path:
    """Where compiled functions are kept: $BALLBOT_CACHE, or ballbot-gym in the user's cache folder."""
    if "BALLBOT_CACHE" in os.environ:
        return Path(os.environ["BALLBOT_CACHE"])
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ballbot-gym"


@cache
def _compiler() -> str | None:
    path = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if path is None:
        _log.warning("no C compiler found: derivatives are interpreted, and optimization is several times slower")
    return path


@cache
def _machine(compiler: str) -> str:
    """What a library compiled with -march=native depends on besides its source."""
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True).stdout
    try:
        cpu = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags"))
    except (OSError, StopIteration):
        cpu = platform.processor()
    return f"{platform.machine()} {cpu} {version}"
