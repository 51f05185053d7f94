"""Entry points that are imported when they are first used, so that a registry costs no import."""

from collections.abc import Callable
from importlib import import_module
from typing import Any


def load(entry: str) -> Any:
    """What "package.module:name" names."""
    module, _, name = entry.partition(":")
    return getattr(import_module(module), name)


def called(entry: str) -> Callable[..., Any]:
    """A function that imports "package.module:name" when it is called, and passes the call on to it."""

    def call(*args: Any, **kwargs: Any) -> Any:
        return load(entry)(*args, **kwargs)

    call.__name__ = entry.rpartition(":")[2]
    return call
