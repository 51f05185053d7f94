"""CasADi functions compiled to machine code, once per content and processor, kept in the user's cache folder.

Where that is impossible (no C compiler, one that fails, a folder that cannot be written) the interpreted functions are used
instead, with one line of log: slower, with the same results to rounding.
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
_DIGEST = 32  # bytes of SHA-256 at a library's end


def compiled(name: str, functions: tuple[casadi.Function, ...]) -> tuple[casadi.Function, ...]:
    """The same functions, compiled into one shared library, or unchanged where they cannot be compiled.

    Args:
        name: what the library is called, for humans who look into the cache.
        functions: expression graphs with distinct names.
    """
    compiler = _compiler()
    if compiler is None:
        return functions
    source = _source(functions)
    key = hashlib.sha256("\0".join([source, _machine(compiler), *_FLAGS]).encode()).hexdigest()[:24]
    library = cache_folder() / f"{name}-{key}.so"
    try:
        if not _is_whole(library):
            _build(compiler, source, library)
        return tuple(casadi.external(function.name(), str(library)) for function in functions)
    except subprocess.CalledProcessError as error:
        reason = f"{compiler} failed: {error.stderr.strip()[-300:]}"
    except (OSError, RuntimeError) as error:  # a folder that cannot be written, or a library that cannot be loaded
        reason = str(error)[-300:]
    _log.warning("derivatives of %s stay interpreted: %s", name, reason)
    return functions


def cache_folder() -> Path:
    """Where compiled functions are kept: $BALLBOT_CACHE, or ballbot-gym in the user's cache folder."""
    if "BALLBOT_CACHE" in os.environ:
        return Path(os.environ["BALLBOT_CACHE"])
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ballbot-gym"


def _source(functions: tuple[casadi.Function, ...]) -> str:
    generator = casadi.CodeGenerator("stage.c")
    for function in functions:
        generator.add(function)
    return generator.dump()


def _build(compiler: str, source: str, library: Path) -> None:
    """Compiles into a folder of its own, then renames: two processes at once, or a kill, never leave half a library."""
    library.parent.mkdir(parents=True, exist_ok=True)
    # inside the cache, because a rename is atomic within one file system only
    with tempfile.TemporaryDirectory(dir=library.parent, prefix=".build-") as folder:
        code, built = Path(folder) / "stage.c", Path(folder) / "stage.so"
        code.write_text(source)
        command = [compiler, *_FLAGS, str(code), "-o", str(built), "-lm"]
        subprocess.run(command, capture_output=True, text=True, check=True)
        content = built.read_bytes()
        # Loaders ignore what follows a library, so its digest can travel with it.
        built.write_bytes(content + hashlib.sha256(content).digest())
        built.replace(library)


def _is_whole(library: Path) -> bool:
    """Whether the library is there and as it was built: loading a damaged one would kill the process."""
    try:
        content = library.read_bytes()
    except FileNotFoundError:
        return False
    return hashlib.sha256(content[:-_DIGEST]).digest() == content[-_DIGEST:]


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
