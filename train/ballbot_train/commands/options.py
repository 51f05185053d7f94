"""Options that several commands share."""

from typing import Annotated

from ballbot_gym.lazy import missing
from ballbot_train.executors import Workers

try:
    import tyro
except ModuleNotFoundError as error:
    raise missing(__name__, error.name) from error

WorkersOption = Annotated[Workers, tyro.conf.arg(name="")]
"""The options --workers and --ray of every command that does much work."""

NONE = tyro.conf.arg(help_behavior_hint="")
"""Of an option whose help needs no word about its default."""
