"""Options that several commands share."""

from typing import Annotated, Literal

from ballbot_gym.lazy import imports_of
from ballbot_train.work.executors import Workers

with imports_of(__name__):
    import tyro

Filter = Literal["adaptive", "ekf", "adaptive-ekf"]
"""The filters that --filter can put in front of controllers."""

UNNAMED = tyro.conf.arg(name="")
"""Marks a dataclass whose fields become options without a prefix: `--task`, and not `--run.task`."""

WorkersOption = Annotated[Workers, UNNAMED, tyro.conf.DisallowNone]
"""The options --workers and --ray of every command that does much work."""
