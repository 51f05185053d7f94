"""C code compiled to shared libraries, once per content and processor, kept in the user's cache folder.

Sometimes that is impossible: there is no C compiler, the compiler fails or hangs, there is no home directory, or the folder
cannot be written or is not the user's own. Wheels of some systems contain libraries that were compiled before, in `SHIPPED`.
"""

import contextlib
import dataclasses
import hashlib
import logging
import os
import platform
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from ballbot_gym import files

_log = logging.getLogger(__name__)
_WINDOWS = sys.platform == "win32"
SUFFIX = ".dll" if _WINDOWS else ".so"
_FLAGS = ("-shared",) if _WINDOWS else ("-fPIC", "-shared")
_NATIVE = "-march=native"  # some compilers do not support it for some processors, such as clang for ARM
_LIBRARIES = () if _WINDOWS else ("-lm",)
_DIGITS = 24  # of SHA-256, in the names of libraries
_COMPILE_SECONDS = 300.0  # after which a compiler counts as hanging; on a busy machine some codes need a hundred
_VERSION_SECONDS = 10.0
_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH

_PACKAGE = Path(__file__).parents[1]

SHIPPED = Path(__file__).with_name("compiled")
"""The libraries that a wheel contains, in a folder for each of `LEVELS`."""

LEVELS = {
    "x86-64-v3": ("avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"),
    "x86-64": (),
    "arm64": (),
}
"""Kinds of processors, the fastest first, and the features by which Linux says that a processor is of that kind."""

_hanging: set[str] = set()  # compilers that were given up, so that the next libraries do not wait for them again


class NoMachineCodeError(RuntimeError):
    """C code cannot be compiled here; the message says why. It is empty where the log has said so already."""


@dataclass(frozen=True)
class Code:
    """C code of a shared library."""

    name: str
    """What the library is called, for humans who look into a folder of them."""
    source: str
    flags: tuple[str, ...]
    """Of the compiler, besides those that every library needs."""

    def stem(self, *machine: str) -> str:
        """The name of its library for a machine, without the digest of the library's content."""
        content = "\0".join([self.source, *machine, *self.flags])
        return f"{self.name}-{hashlib.sha256(content.encode()).hexdigest()[:_DIGITS]}"

    @property
    def portable_flags(self) -> tuple[str, ...]:
        """The flags without GCC's `--param NAME=VALUE` and `-fira-…`, which other compilers refuse."""
        pairs = zip(("", *self.flags), self.flags, strict=False)
        return tuple(flag for before, flag in pairs if "--param" not in (before, flag) and "-fira-" not in flag)

    def build(
        self, compiler: str, folder: Path, stem: str, extra: tuple[str, ...] = (), seconds: float | None = None
    ) -> Path:
        """Compiles it to a library in a folder.

        That is done in a folder of its own, and then renamed: two processes at once, or a kill, never leave half a library.

        Args:
            compiler: the program.
            folder: where the library is kept.
            stem: the library's name, to which the digest of its content is added.
            extra: further flags.
            seconds: after which the compiler counts as hanging; default, it is waited for.

        Raises:
            subprocess.CalledProcessError: the compiler refuses the code or a flag.
            subprocess.TimeoutExpired: it hangs.
        """
        flags = self.flags if _is_gcc(compiler) else self.portable_flags
        # inside the folder, because a rename is atomic within one file system only
        with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as scratch:
            code, built = Path(scratch) / "code.c", Path(scratch) / f"code{SUFFIX}"
            code.write_text(self.source, encoding="utf-8")
            _run([compiler, *flags, *extra, *_FLAGS, str(code), "-o", str(built), *_LIBRARIES], seconds, check=True)
            return _kept(built, folder, stem)


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
    code = Code(name, source, flags)
    if (shipped := _shipped(code)) is not None:
        return shipped
    program = compiler()
    if program is None or program in _hanging:
        raise NoMachineCodeError
    try:
        folder = cache_folder()
        _make_private(folder)
        stem = code.stem(_machine(program), _NATIVE, *_FLAGS)
        return _whole(folder, stem, own=True) or _compiled(code, program, folder, stem)
    except subprocess.CalledProcessError as error:
        raise NoMachineCodeError(f"{program} failed: {error.stderr.strip()[-300:]}") from error
    except subprocess.TimeoutExpired as error:
        _hanging.add(program)
        raise NoMachineCodeError(
            f"{program} did not finish within {error.timeout:g} s, so it is not run again"
        ) from error
    except (OSError, RuntimeError) as error:
        # a program that cannot be run, no home, or a folder that cannot be written
        raise NoMachineCodeError(str(error)[-300:]) from error


def printed(name: str, problem: tuple[Any, ...], kinds: tuple[type, ...], source: Callable[[], str]) -> str:
    """The C code that `source` prints.

    For tasks and robots of this package it is kept in the cache, because CasADi prints it, whose import takes longer than a
    hundred control steps, and printing takes longer still. Those of users may change in ways that cannot be seen without
    printing.

    Args:
        name: what the code is called, for humans who look into the cache.
        problem: everything that determines the code, besides the files of this package. Of dataclasses, all fields count.
        kinds: the classes of task and robot; () where `problem` holds all that is printed.
        source: prints the code; it may raise any error.
    """
    if not all(kind.__module__.startswith(f"{_PACKAGE.name}.") for kind in kinds):
        return source()
    content = [_fields(part) if dataclasses.is_dataclass(part) else repr(part) for part in problem]
    key = hashlib.sha256("\0".join([_digests_of_package(), *content]).encode()).hexdigest()[:_DIGITS]
    try:
        path = cache_folder() / f"{name}-{key}.c"
        if path.is_file():
            check_private(path.parent, "BALLBOT_CACHE")
            check_private(path, "BALLBOT_CACHE")
            return path.read_text(encoding="utf-8")
    except (OSError, RuntimeError, ValueError):  # `library` says what is wrong with the folder
        return source()
    code = source()
    with contextlib.suppress(OSError):
        _make_private(path.parent)
        files.write(path, code)
    return code


def _fields(part: Any) -> str:
    """A dataclass and all its fields, those too that its repr leaves out."""
    return repr((type(part), [(field.name, getattr(part, field.name)) for field in dataclasses.fields(part)]))


@cache
def _digests_of_package() -> str:
    """The files of this package and their digests, so that every copy of it prints the same code once."""
    found = sorted(path for path in _PACKAGE.rglob("*") if path.suffix in (".py", ".c", ".h"))
    return "\0".join(f"{path.relative_to(_PACKAGE).as_posix()} {_digest(path)}" for path in found)


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
    """Makes the folder if it is missing, and checks that no other user can put a library into it.

    Raises:
        PermissionError: the folder belongs to another user, or others may write into it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_private(folder, "BALLBOT_CACHE")


def check_private(path: Path, variable: str) -> None:
    """Checks that no other user can write into a folder or a file. The environment variable names its folder.

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


def _compiled(code: Code, compiler: str, folder: Path, stem: str) -> Path:
    """The library of that name, compiled for this very processor if the compiler can do that.

    Of processes that need the same library at once, one compiles it, and the others wait for it.
    """
    with _alone(folder / f".{stem}.lock"):
        if (path := _whole(folder, stem, own=True)) is not None:
            return path
        _log.info("compiling %s, once on this machine", code.name)
        try:
            return code.build(compiler, folder, stem, (_NATIVE,), _COMPILE_SECONDS)
        except subprocess.CalledProcessError:
            return code.build(compiler, folder, stem, (), _COMPILE_SECONDS)


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Holds a lock file, for as long as a compiler may take at most. Without the library of locks, it does not wait."""
    try:
        import filelock
    except ImportError:
        yield
        return
    lock = filelock.FileLock(path)
    try:
        lock.acquire(timeout=_COMPILE_SECONDS)
    except (filelock.Timeout, NotImplementedError):  # some file systems have no locks
        yield
        return
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows removes no open file
            path.unlink()
        lock.release()


def _kept(built: Path, folder: Path, stem: str) -> Path:
    """Renames a library into a folder. Its name ends with a digest of its content, so that damage is noticed.

    A digest inside of the file would break its signature, which macOS asks for.
    """
    path = folder / f"{stem}-{_digest(built)}{SUFFIX}"
    try:
        built.replace(path)
    except PermissionError:  # Windows replaces no library that is in use
        if not _has_its_digest(path):
            raise
    return path


def _run(command: list[str], seconds: float | None, check: bool) -> str:
    """Standard output of a program; bytes that are no UTF-8 are replaced.

    If it takes too long, it ends with all that it has started: a compiler that is killed alone leaves its passes running.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "encoding": "utf-8", "errors": "replace"}
    with subprocess.Popen(command, start_new_session=not _WINDOWS, **pipes) as process:
        try:
            output, errors = process.communicate(timeout=seconds)
        except BaseException:
            process.kill() if _WINDOWS else os.killpg(process.pid, signal.SIGKILL)
            raise
    if check and process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, output, errors)
    return output


def _shipped(code: Code) -> Path | None:
    """The library that the package contains of this code, of the best level of this processor; None where there is none."""
    if not SHIPPED.is_dir():
        return None
    found = (_whole(SHIPPED / level, code.stem(), own=False) for level in _levels())
    return next((path for path in found if path is not None), None)


def shipped_source(name: str) -> str | None:
    """C code that the package contains by name, for machines without CasADi; None where there is none."""
    path = SHIPPED / "source" / f"{name}.c"
    return path.read_text(encoding="utf-8") if path.is_file() else None


def _whole(folder: Path, stem: str, own: bool) -> Path | None:
    """The library of that name that is as it was built; None where there is none. A damaged one would kill the process.

    Args:
        folder: where it is looked for.
        stem: its name without the digest of its content.
        own: whether it must be this user's own. A folder that others could once write into may still hold their files.
    """
    return next((path for path in sorted(folder.glob(f"{stem}-*{SUFFIX}")) if _is_whole(path, own)), None)


def _is_whole(path: Path, own: bool) -> bool:
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return False
        if own:
            check_private(path, "BALLBOT_CACHE")
    except (FileNotFoundError, PermissionError):
        return False
    return _has_its_digest(path)


def _has_its_digest(path: Path) -> bool:
    return path.is_file() and path.stem.rpartition("-")[2] == _digest(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_DIGITS]


@cache
def compiler() -> str | None:
    """The path of a C compiler. If there is none, None and a line in the log."""
    path = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    if path is None:
        _log.warning("no C compiler found: environments and optimization are several times slower")
    return path


@cache
def _is_gcc(compiler: str) -> bool:
    """Whether a compiler is GCC. On macOS, clang is called gcc too."""
    return "Free Software Foundation" in _version(compiler)


@cache
def _version(compiler: str) -> str:
    return _run([compiler, "--version"], _VERSION_SECONDS, check=False)


@cache
def _machine(compiler: str) -> str:
    """What a library compiled with -march=native depends on besides its source."""
    return f"{platform.machine()} {' '.join(_features()) or platform.processor()} {_version(compiler)}"


@cache
def _features() -> tuple[str, ...]:
    """What Linux says that this processor can do; () elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ()
    # "flags" on x86, "Features" on ARM
    return tuple(next((line for line in lines if line.lower().startswith(("flags", "features"))), "").split()[2:])


@cache
def _levels() -> tuple[str, ...]:
    """Those of `LEVELS` that this processor is of, the fastest first."""
    family = {"x86_64": "x86-64", "amd64": "x86-64", "aarch64": "arm64", "arm64": "arm64"}.get(
        platform.machine().lower()
    )
    return tuple(
        level
        for level, needed in LEVELS.items()
        if family is not None and level.startswith(family) and set(needed) <= set(_features())
    )
