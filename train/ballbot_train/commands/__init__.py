"""The commands of `ballbot`, one file each."""

from collections.abc import Callable

from ballbot_train.commands.basins import basins
from ballbot_train.commands.benchmark import benchmark
from ballbot_train.commands.certify import certify
from ballbot_train.commands.compare import compare
from ballbot_train.commands.demos import demos
from ballbot_train.commands.optimize import optimize
from ballbot_train.commands.paper import paper
from ballbot_train.commands.replay import replay
from ballbot_train.commands.robustness import robustness
from ballbot_train.commands.train import train

COMMANDS: dict[str, Callable[..., None]] = {
    "benchmark": benchmark,
    "compare": compare,
    "robustness": robustness,
    "basins": basins,
    "paper": paper,
    "optimize": optimize,
    "replay": replay,
    "certify": certify,
    "demos": demos,
    "train": train,
}
