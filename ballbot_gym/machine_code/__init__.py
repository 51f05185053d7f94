"""Machine code: C code of what tasks and robots compute, and how it becomes shared libraries.

`codegen` prints C, for many robots at once and for one, `single` runs that of one, and `libraries` compiles it.
"""

from ballbot_gym.machine_code.libraries import (
    LEVELS,
    SUFFIX,
    NoMachineCodeError,
    cache_folder,
    check_private,
    compile_library,
    compiler,
    content_key,
    kept,
    library,
    shipped_source,
    without_parameters,
)

__all__ = [
    "LEVELS",
    "SUFFIX",
    "NoMachineCodeError",
    "cache_folder",
    "check_private",
    "compile_library",
    "compiler",
    "content_key",
    "kept",
    "library",
    "shipped_source",
    "without_parameters",
]
