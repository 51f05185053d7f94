"""Options that several commands share."""

from typing import Annotated

from ballbot_gym.lazy import missing
from ballbot_train.executors import Workers

try:
    import tyro
except ModuleNotFoundError as error:
    raise missing(__name__, error.name) from error

UNNAMED = tyro.conf.arg(name="")
"""Of a dataclass whose fields are options of their own names."""

WorkersOption = Annotated[Workers, UNNAMED, tyro.conf.DisallowNone]
"""The options --workers and --ray of every command that does much work."""
