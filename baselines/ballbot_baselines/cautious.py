"""Plans for the worst robot of the track "unknown", so that feedback has force and friction left on every robot of it."""

from dataclasses import replace

from ballbot_baselines.trajopt import TrajoptController
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import TRACKS
from ballbot_gym.tasks import Task


def cautious_trajopt(task: Task, params: BallbotParams) -> TrajoptController:
    """`TrajoptController` for the nominal robot with the least force and friction of the track "unknown"."""
    track = TRACKS["unknown"]
    friction = params.friction * track.friction[0]
    return TrajoptController(task, replace(params, force_limit=params.force_limit * track.force[0], friction=friction))
