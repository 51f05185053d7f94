"""Results as an evaluation would have made them, for tests of what is done with results."""

from ballbot_train.evaluation.results import Result
from ballbot_train.evaluation.robustness import StressResult

_FIELDS = {
    "task": "stabilize",
    "controller": "lqr",
    "episode": 0,
    "physics": "rk4",
    "cost": 12.0,
    "optimum": 10.0,
    "success": True,
    "failure": False,
    "peak_tilt": 30.0,
    "settle_time": 2.0,
    "duration": 8.0,
    "plan_seconds": 0.1,
    "step_seconds": 1e-5,
}


def result(**changes):
    """An episode that LQR finished with a regret of 20 %, except for what is changed."""
    return Result(**(_FIELDS | changes))


def stress_result(stress, level, **changes):
    """The same under a disturbance."""
    return StressResult(**(_FIELDS | {"stress": stress, "level": level} | changes))
