"""Options that several commands share."""

from typing import Annotated

import tyro

from ballbot_train.executors import Workers

WorkersOption = Annotated[Workers, tyro.conf.arg(name="")]
"""The options --workers and --ray of every command that does much work."""
