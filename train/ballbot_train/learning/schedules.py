"""Schedules: how a setting changes while a learner trains.

`progress` is the share of the iterations that are done, from 0 to 1.
"""

import math


def cosine(start: float, final_fraction: float, progress: float) -> float:
    """Falls from `start` to `final_fraction * start` along half a cosine."""
    return start * (final_fraction + (1 - final_fraction) * (1 + math.cos(math.pi * progress)) / 2)


def linear(start: float, final_fraction: float, progress: float) -> float:
    """Falls from `start` to `final_fraction * start` along a straight line."""
    return start * (1 - (1 - final_fraction) * progress)


def geometric(start: float, end: float, progress: float) -> float:
    """Goes from `start` to `end`, both positive, by the same factor in every iteration."""
    return start * (end / start) ** progress


def discount(start: float, end: float, progress: float) -> float:
    """A discount factor that goes from `start` to `end`, both below 1: 1 less it goes there geometrically."""
    return 1 - geometric(1 - start, 1 - end, progress)
