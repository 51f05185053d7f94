"""CasADi functions compiled to machine code, once per content and processor, kept in the user's cache folder.

Sometimes that is impossible: there is no C compiler, the compiler fails or hangs, there is no home directory, or the folder
cannot be written or is not the user's own. Then the interpreted functions are used, and one line of log says why. They are
slower, with the same results to rounding.
"""

import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import casadi

_log = logging.getLogger(__name__)
_FLAGS = ("-O2", "-march=native", "-fPIC", "-shared")
_DIGEST = 32  # bytes of SHA-256 at a library's end
_COMPILE_SECONDS = 120.0  # after which a compiler counts as hanging
_VERSION_SECONDS = 10.0
_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_hanging: set[str] = set()  # compilers that were given up, so that the next functions do not wait for them again


def compiled(name: str, functions: tuple[casadi.Function, ...]) -> tuple[casadi.Function, ...]:
    """The same functions, compiled into one shared library, or unchanged where they cannot be compiled.

    Args:
        name: what the library is called, for humans who look into the cache.
        functions: expression graphs with distinct names.

    Raises:
        ValueError: $BALLBOT_CACHE is no absolute path.
    """
    compiler = _compiler()
    if compiler is None or compiler in _hanging:
        return functions
    try:
        folder = cache_folder()
        _make_private(folder)
        source = _source(functions)
        key = hashlib.sha256("\0".join([source, _machine(compiler), *_FLAGS]).encode()).hexdigest()[:24]
        library = folder / f"{name}-{key}.so"
        if not _is_whole(library):
            _build(compiler, source, library)
        return tuple(casadi.external(function.name(), str(library)) for function in functions)
    except subprocess.CalledProcessError as error:
        reason = f"{compiler} failed: {error.stderr.strip()[-300:]}"
    except subprocess.TimeoutExpired as error:
        _hanging.add(compiler)
        reason = f"{compiler} did not answer within {error.timeout:g} s, and is not asked again"
    except (OSError, RuntimeError) as error:
        # a program that cannot be run, no home, a folder that cannot be written, or a library that cannot be loaded
        reason = str(error)[-300:]
    _log.warning("derivatives of %s stay interpreted: %s", name, reason)
    return functions


def cache_folder() -> Path:
    """Where compiled functions are kept: $BALLBOT_CACHE, or ballbot-gym in the user's cache folder.

    Raises:
        ValueError: $BALLBOT_CACHE is no absolute path.
        RuntimeError: there is no home directory.
    """
    if (given := os.environ.get("BALLBOT_CACHE")) is not None:
        if not Path(given).is_absolute():
            raise ValueError(
                f"BALLBOT_CACHE must be an absolute path, not {given!r}; unset it for the user's cache folder"
            )
        return Path(given)
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # unset, or invalid by the XDG specification, which says to ignore it
        base = Path.home() / ".cache"
    if not base.is_absolute():
        raise RuntimeError("there is no home directory for the cache; set BALLBOT_CACHE to an absolute path")
    return base / "ballbot-gym"


def _make_private(folder: Path) -> None:
    """Makes the folder where it is missing, and checks that nobody else can put a library into it.

    Raises:
        PermissionError: the folder belongs to another user, or others may write into it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if os.name != "posix":
        return
    status = folder.stat()
    if status.st_uid != os.geteuid():
        raise PermissionError(f"{folder} belongs to another user; set BALLBOT_CACHE to a folder of your own")
    if status.st_mode & _WRITABLE_BY_OTHERS:
        raise PermissionError(f'others may write into {folder}; run "chmod go-w" on it')


def _source(functions: tuple[casadi.Function, ...]) -> str:
    generator = casadi.CodeGenerator("stage.c")
    for function in functions:
        generator.add(function)
    return generator.dump()


def _build(compiler: str, source: str, library: Path) -> None:
    """Compiles into a folder of its own, then renames: two processes at once, or a kill, never leave half a library."""
    # inside the cache, because a rename is atomic within one file system only
    with tempfile.TemporaryDirectory(dir=library.parent, prefix=".build-") as folder:
        code, built = Path(folder) / "stage.c", Path(folder) / "stage.so"
        code.write_text(source, encoding="utf-8")
        _run([compiler, *_FLAGS, str(code), "-o", str(built), "-lm"], _COMPILE_SECONDS, check=True)
        content = built.read_bytes()
        # Loaders ignore what follows a library, so its digest can travel with it.
        built.write_bytes(content + hashlib.sha256(content).digest())
        built.replace(library)


def _run(command: list[str], seconds: float, check: bool) -> str:
    """Standard output of a program; bytes that are no UTF-8 are replaced."""
    return subprocess.run(
        command, capture_output=True, encoding="utf-8", errors="replace", check=check, timeout=seconds
    ).stdout


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
    version = _run([compiler, "--version"], _VERSION_SECONDS, check=False)
    try:
        cpu = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags"))
    except (OSError, StopIteration):
        cpu = platform.processor()
    return f"{platform.machine()} {cpu} {version}"
