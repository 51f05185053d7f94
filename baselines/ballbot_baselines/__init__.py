"""Model-based experts: linear control, trajectory optimization, and the optima that regret is measured against.

Everything that users need is imported from here: `from ballbot_baselines import find_optimum`. Importing this package is
fast: CasADi and SciPy are imported at the first use of one of these names, or when a controller is made.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from ballbot_gym.lazy import called, exports, need
from ballbot_gym.robot import TRACKS, Robot
from ballbot_gym.rollout import Controller, PlanError
from ballbot_gym.tasks import Task

if TYPE_CHECKING:
    from ballbot_baselines.feedback.kalman import StateFromSensors
    from ballbot_baselines.feedback.lqr import LqrController
    from ballbot_baselines.feedback.nmpc import NmpcController
    from ballbot_baselines.feedback.trajopt import TrajoptController
    from ballbot_baselines.feedback.tvlqr import TvlqrController
    from ballbot_baselines.identification.identify import identify
    from ballbot_baselines.identification.logs import Log
    from ballbot_baselines.identification.record import record
    from ballbot_baselines.optimum.find import certified_optimum, find_optima, find_optimum, plan_to_track
    from ballbot_baselines.optimum.lower_bound import PlanarBound
    from ballbot_baselines.optimum.measured import Regret, regret
    from ballbot_baselines.optimum.optimum import Optimum
    from ballbot_baselines.solvers.guess import along_path
    from ballbot_baselines.solvers.ocp import Ocp, OcpSolver, Solution
    from ballbot_baselines.solvers.shooting import Backoff

need(__name__, "casadi", "scipy")

_NMPC = called("ballbot_baselines.feedback.nmpc:NmpcController")
_ADAPTIVE = called("ballbot_baselines.feedback.adaptive:AdaptiveNmpcController")
_TRAJOPT = called("ballbot_baselines.feedback.trajopt:TrajoptController")

CONTROLLERS: dict[str, Callable[[Task, Robot], Controller]] = {
    "lqr": called("ballbot_baselines.feedback.lqr:LqrController"),
    "trajopt": _TRAJOPT,
    "nmpc": _NMPC,
}
"""Every controller by its name on the command line. To add a controller to the package, write its file and a line here."""

VARIANTS: dict[str, Callable[[Task, Robot], Controller]] = {
    "optimum": called("ballbot_baselines.feedback.trajopt:OptimumController"),
    "nmpc-offset-free": partial(_NMPC, offset_free=True),
    "cautious": partial(_TRAJOPT, for_robots=TRACKS["unknown"]),
    "nmpc-adaptive": partial(_ADAPTIVE, ending="-adaptive"),
    "nmpc-ekf": partial(_ADAPTIVE, ending="-ekf"),
    "nmpc-adaptive-ekf": partial(_ADAPTIVE, ending="-adaptive-ekf"),
}
"""Controllers that commands run only if they are named. They have no row on the leaderboard."""

FILTERS = ("-adaptive-ekf", "-ekf", "-adaptive")
"""Endings of a controller's name that put a filter in front of it, as in "lqr-ekf"; see `feedback.adaptive`."""

__all__ = [
    "CONTROLLERS",
    "FILTERS",
    "VARIANTS",
    "Backoff",
    "Controller",
    "Log",
    "LqrController",
    "NmpcController",
    "Ocp",
    "OcpSolver",
    "Optimum",
    "PlanError",
    "PlanarBound",
    "Regret",
    "Solution",
    "StateFromSensors",
    "TrajoptController",
    "TvlqrController",
    "along_path",
    "certified_optimum",
    "find_optima",
    "find_optimum",
    "identify",
    "plan_to_track",
    "record",
    "regret",
]

_MODULES = {
    "feedback.kalman": ("StateFromSensors",),
    "feedback.lqr": ("LqrController",),
    "feedback.nmpc": ("NmpcController",),
    "feedback.trajopt": ("TrajoptController",),
    "feedback.tvlqr": ("TvlqrController",),
    "identification.identify": ("identify",),
    "identification.logs": ("Log",),
    "identification.record": ("record",),
    "optimum.find": ("certified_optimum", "find_optima", "find_optimum", "plan_to_track"),
    "optimum.lower_bound": ("PlanarBound",),
    "optimum.measured": ("Regret", "regret"),
    "optimum.optimum": ("Optimum",),
    "solvers.guess": ("along_path",),
    "solvers.ocp": ("Ocp", "OcpSolver", "Solution"),
    "solvers.shooting": ("Backoff",),
}
__getattr__ = exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
