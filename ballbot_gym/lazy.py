"""Entry points that are imported when they are first used, so that a registry costs no import.

Where a library is missing, the error names the extra that brings it.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

_EXTRAS = {"ballbot_gym": "train", "ballbot_baselines": "baselines", "ballbot_train": "train"}
"""The extra that brings what a package of ours imports."""


def load(entry: str) -> Any:
    """What "package.module:name" names.

    Raises:
        ModuleNotFoundError: a library is missing; the message names the extra to install.
    """
    module, _, name = entry.partition(":")
    try:
        return getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if (error.name or "").partition(".")[0] in _EXTRAS or package not in _EXTRAS:
            raise
        raise missing(entry.replace(":", "."), error.name) from error


def need(package: str, *libraries: str, extra: str | None = None) -> None:
    """Raises the error of `missing` if a library is not installed. Imports nothing."""
    for name in libraries:
        if find_spec(name) is None:
            raise missing(package, name, extra)


@contextmanager
def imports_of(package: str, extra: str | None = None) -> Iterator[None]:
    """Where a library that the block imports is not installed, the error is that of `missing`."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise missing(package, error.name, extra) from error


def missing(package: str, library: str | None, extra: str | None = None) -> ModuleNotFoundError:
    """The error that says which extra brings a library; by default the extra of the package of ours that needs it."""
    extra = extra or _EXTRAS[package.partition(".")[0]]
    return ModuleNotFoundError(f"{package} needs {library}, which is not installed: {install(extra)}", name=library)


def install(extra: str) -> str:
    """The commands that install an extra: the one for an installed package, and the one for a checkout."""
    return f'pip install "ballbot-gym[{extra}]", or in a checkout pip install -e ".[{extra}]"'


def called(entry: str) -> Callable[..., Any]:
    """A function that imports "package.module:name" when it is called, and passes the call on to it."""

    def call(*args: Any, **kwargs: Any) -> Any:
        return load(entry)(*args, **kwargs)

    call.__name__ = entry.rpartition(":")[2]
    return call


def exports(package: str, entries: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package whose public names are imported when they are first used.

    Args:
        package: its `__name__`.
        entries: from public name to the module in the package that has it, such as "optimum" or "learning.sb3".
    """

    def attribute(name: str) -> Any:
        if name not in entries:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return load(f"{package}.{entries[name]}:{name}")

    return attribute
