"""Machine code: C code of what tasks and robots compute, and how it becomes shared libraries.

`codegen` prints C, for many robots at once and for one, `single` runs that of one, and `libraries` compiles it.
"""

from ballbot_gym.machine_code.libraries import (
    LEVELS,
    SUFFIX,
    Code,
    NoMachineCodeError,
    cache_folder,
    check_private,
    compiler,
    library,
    printed,
    shipped_source,
)

__all__ = [
    "LEVELS",
    "SUFFIX",
    "Code",
    "NoMachineCodeError",
    "cache_folder",
    "check_private",
    "compiler",
    "library",
    "printed",
    "shipped_source",
]
