"""The commands of `ballbot`, one file each."""

from collections.abc import Callable

from ballbot_train.commands.benchmark import benchmark
from ballbot_train.commands.certify import certify
from ballbot_train.commands.optimize import optimize
from ballbot_train.commands.paper import paper
from ballbot_train.commands.replay import replay

COMMANDS: dict[str, Callable[..., None]] = {
    "benchmark": benchmark,
    "paper": paper,
    "optimize": optimize,
    "replay": replay,
    "certify": certify,
}
