"""Schedules: how a setting changes while a learner trains.

`progress` is the share of the iterations that are done, from 0 to 1.
"""

import math


def cosine(start: float, final_fraction: float, progress: float) -> float:
    """Falls from `start` to `final_fraction * start` along half a cosine."""
    return start * (final_fraction + (1 - final_fraction) * (1 + math.cos(math.pi * progress)) / 2)
