"""The commands of `ballbot`, one file each. A command is imported when it is called.

To add a command, write `NAME.py` with a function of the same name, and its name to `GROUPS`.
"""

GROUPS = {
    "measure": ("benchmark", "evaluate", "compare", "robustness", "transfer", "basins", "submit", "verify"),
    "look": ("play", "page", "replay", "optimize", "paper"),
    "train": ("train", "demos"),
    "make": ("new", "identify", "certify", "prove", "export"),
}
"""The commands by what they are for, in the order of `ballbot --help`."""

COMMANDS = {name: f"{__name__}.{name}:{name}" for names in GROUPS.values() for name in names}
"""Every command's function, as `ballbot_gym.lazy.load` takes it."""

MOVED = {"tune": "`ballbot tune` is an example now: python examples/tune.py --task TASK (in the source repository)"}
"""What to do instead of commands of earlier versions."""

RESUMABLE = ("benchmark", "evaluate", "robustness", "transfer", "basins", "certify", "demos", "train")
"""Commands that continue an interrupted run when they are started again; `train` does it with --resume."""
