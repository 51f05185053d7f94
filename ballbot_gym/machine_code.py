"""C code compiled to shared libraries, once per content and processor, kept in the user's cache folder.

Sometimes that is impossible: there is no C compiler, the compiler fails or hangs, there is no home directory, or the folder
cannot be written or is not the user's own.
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

_log = logging.getLogger(__name__)
_FLAGS = ("-march=native", "-fPIC", "-shared")
_DIGEST = 32  # bytes of SHA-256 at a library's end
_COMPILE_SECONDS = 120.0  # after which a compiler counts as hanging
_VERSION_SECONDS = 10.0
_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_hanging: set[str] = set()  # compilers that were given up, so that the next libraries do not wait for them again


class NoMachineCodeError(RuntimeError):
    """C code cannot be compiled here; the message says why. It is empty where the log has said so already."""


def library(name: str, source: str, flags: tuple[str, ...] = ("-O2",)) -> Path:
    """The shared library of C code.

    Args:
        name: what it is called, for humans who look into the cache.
        source: C code.
        flags: of the compiler, besides those that every library needs.

    Raises:
        NoMachineCodeError: it cannot be compiled.
        ValueError: $BALLBOT_CACHE is no absolute path.
    """
    program = compiler()
    if program is None or program in _hanging:
        raise NoMachineCodeError
    try:
        folder = cache_folder()
        _make_private(folder)
        key = hashlib.sha256("\0".join([source, _machine(program), *flags, *_FLAGS]).encode()).hexdigest()[:24]
        path = folder / f"{name}-{key}.so"
        if not _is_whole(path):
            _build(program, source, path, flags)
        return path
    except subprocess.CalledProcessError as error:
        raise NoMachineCodeError(f"{program} failed: {error.stderr.strip()[-300:]}") from error
    except subprocess.TimeoutExpired as error:
        _hanging.add(program)
        raise NoMachineCodeError(
            f"{program} did not answer within {error.timeout:g} s, and is not asked again"
        ) from error
    except (OSError, RuntimeError) as error:
        # a program that cannot be run, no home, or a folder that cannot be written
        raise NoMachineCodeError(str(error)[-300:]) from error


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
    check_private(folder, "BALLBOT_CACHE")


def check_private(path: Path, variable: str) -> None:
    """Checks that nobody else can write into a folder or a file, whose folder the environment variable names.

    Raises:
        PermissionError: it belongs to another user, or others may write into it.
    """
    if os.name != "posix":
        return
    status = path.stat()
    if status.st_uid != os.geteuid():
        raise PermissionError(f"{path} belongs to another user; set {variable} to a folder of your own")
    if status.st_mode & _WRITABLE_BY_OTHERS:
        raise PermissionError(f'others may write into {path}; run "chmod go-w" on it')


def _build(compiler: str, source: str, path: Path, flags: tuple[str, ...]) -> None:
    """Compiles into a folder of its own, then renames: two processes at once, or a kill, never leave half a library."""
    # inside the cache, because a rename is atomic within one file system only
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".build-") as folder:
        code, built = Path(folder) / "code.c", Path(folder) / "code.so"
        code.write_text(source, encoding="utf-8")
        _run([compiler, *flags, *_FLAGS, str(code), "-o", str(built), "-lm"], _COMPILE_SECONDS, check=True)
        content = built.read_bytes()
        # Loaders ignore what follows a library, so its digest can travel with it.
        built.write_bytes(content + hashlib.sha256(content).digest())
        built.replace(path)


def _run(command: list[str], seconds: float, check: bool) -> str:
    """Standard output of a program; bytes that are no UTF-8 are replaced."""
    return subprocess.run(
        command, capture_output=True, encoding="utf-8", errors="replace", check=check, timeout=seconds
    ).stdout


def _is_whole(path: Path) -> bool:
    """Whether the library is there, this user's own, and as it was built: loading a damaged one would kill the process.

    A folder that others could once write into may still hold their files. These are built again.
    """
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return False
        check_private(path, "BALLBOT_CACHE")
    except (FileNotFoundError, PermissionError):
        return False
    content = path.read_bytes()
    return hashlib.sha256(content[:-_DIGEST]).digest() == content[-_DIGEST:]


@cache
def compiler() -> str | None:
    """The path of a C compiler; None, and a word in the log, where there is none."""
    path = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if path is None:
        _log.warning("no C compiler found: environments and optimization are several times slower")
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
