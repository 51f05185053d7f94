"""Markers: the objects of a task in pictures, such as obstacles and goals."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Marker:
    """An upright cylinder on the floor, with `radius` and `height` in m.

    If `ring` is true, only its circumference is drawn.
    """

    position: tuple[float, float]
    radius: float
    height: float
    color: tuple[float, float, float, float]
    ring: bool = False
