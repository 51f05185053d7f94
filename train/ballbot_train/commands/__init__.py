"""The commands of `ballbot`, one file each. A command is imported when it is called.

To add a command, write `NAME.py` with a function of the same name, and its name to `COMMANDS`.
"""

import ast
from importlib.util import find_spec
from pathlib import Path

COMMANDS = {
    name: f"{__name__}.{name}:{name}"
    for name in (
        *("benchmark", "evaluate", "compare", "submit", "verify", "robustness", "transfer", "basins", "paper"),
        *("optimize", "replay", "play", "page", "certify", "demos", "export", "train", "new"),
    )
}
"""Every command's function, as `ballbot_gym.lazy.load` takes it."""

MOVED = {"tune": "`ballbot tune` is an example now: python examples/tune.py --task TASK (in the source repository)"}
"""What to do in place of commands of earlier versions."""

RESUMABLE = ("benchmark", "evaluate", "robustness", "transfer", "basins", "certify", "demos", "train")
"""Those that continue where they were interrupted; `train` does it with --resume."""


def help_of(name: str) -> str:
    """The first line of a command's docstring, read from its file without importing it."""
    module, _, function = COMMANDS[name].partition(":")
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == function:
            return (ast.get_docstring(node) or "").partition("\n")[0]
    return ""
