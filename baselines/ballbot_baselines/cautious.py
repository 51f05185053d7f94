"""Plans for the worst robot of the track "unknown", so that feedback has force and room left on all of them."""

from dataclasses import replace

from ballbot_baselines.shooting import Backoff
from ballbot_baselines.trajopt import TrajoptController
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import TRACKS
from ballbot_gym.tasks import Task

_LEAST_FORCE, _LEAST_FRICTION = TRACKS["unknown"].force[0], TRACKS["unknown"].friction[0]
# A robot that differs from the model misses its plan: half of the goal's tolerance and 3 cm are left for that.
_BACKOFF = Backoff(margin=0.03, goal=0.5, force=1 - _LEAST_FORCE, grip=0.1)


def cautious_trajopt(task: Task, params: BallbotParams) -> TrajoptController:
    """`TrajoptController` for the nominal robot with the least force and friction of the track "unknown"."""
    return TrajoptController(task, replace(params, friction=params.friction * _LEAST_FRICTION), _BACKOFF)
