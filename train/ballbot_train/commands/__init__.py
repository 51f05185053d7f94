"""The commands of `ballbot`, one file each. A command is imported when it is called.

To add a command, write `NAME.py` with a function of the same name, and add one line to `COMMANDS`.
"""

import ast
from importlib.util import find_spec
from pathlib import Path

COMMANDS: dict[str, str] = {
    "benchmark": "ballbot_train.commands.benchmark:benchmark",
    "evaluate": "ballbot_train.commands.evaluate:evaluate",
    "compare": "ballbot_train.commands.compare:compare",
    "submit": "ballbot_train.commands.submit:submit",
    "verify": "ballbot_train.commands.verify:verify",
    "robustness": "ballbot_train.commands.robustness:robustness",
    "transfer": "ballbot_train.commands.transfer:transfer",
    "basins": "ballbot_train.commands.basins:basins",
    "paper": "ballbot_train.commands.paper:paper",
    "optimize": "ballbot_train.commands.optimize:optimize",
    "replay": "ballbot_train.commands.replay:replay",
    "play": "ballbot_train.commands.play:play",
    "page": "ballbot_train.commands.page:page",
    "certify": "ballbot_train.commands.certify:certify",
    "demos": "ballbot_train.commands.demos:demos",
    "export": "ballbot_train.commands.export:export",
    "train": "ballbot_train.commands.train:train",
    "curves": "ballbot_train.commands.curves:curves",
    "tune": "ballbot_train.commands.tune:tune",
    "new": "ballbot_train.commands.new:new",
}
"""Every command's function, as `ballbot_gym.lazy.load` takes it."""

RESUMABLE = ("benchmark", "evaluate", "robustness", "transfer", "basins", "certify", "demos", "train", "tune")
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
