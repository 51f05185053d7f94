"""Experts that know the model: linear control, trajectory optimization, and the optima that regret is measured against.

`from ballbot_baselines import find_optimum` is the short path to `optimum.find_optimum`. Importing this package is light:
CasADi and SciPy are imported when a controller is made or `find_optimum` is first asked for.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ballbot_gym.lazy import called, load, need
from ballbot_gym.params import BallbotParams
from ballbot_gym.rollout import Controller
from ballbot_gym.tasks import Task

if TYPE_CHECKING:
    from ballbot_baselines.optimum import find_optimum

need(__name__, "casadi", "scipy")

CONTROLLERS: dict[str, Callable[[Task, BallbotParams], Controller]] = {
    "lqr": called("ballbot_baselines.lqr:LqrController"),
    "trajopt": called("ballbot_baselines.trajopt:TrajoptController"),
    "nmpc": called("ballbot_baselines.nmpc:NmpcController"),
}
"""Every controller by its name on the command line. To add a controller, write one file and add one line here."""

VARIANTS: dict[str, Callable[[Task, BallbotParams], Controller]] = {
    "nmpc-offset-free": called("ballbot_baselines.nmpc:offset_free_nmpc"),
}
"""Controllers that run where they are named, and in the robustness track. They have no row on the leaderboard."""

_LAZY = {"find_optimum": "ballbot_baselines.optimum:find_optimum"}

__all__ = ["CONTROLLERS", "VARIANTS", "Controller", "find_optimum"]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return load(_LAZY[name])
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
