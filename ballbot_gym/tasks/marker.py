"""What a task wants drawn."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Marker:
    """Something a task wants drawn: an upright cylinder of `radius` and `height`, its foot on the floor, both in m.

    A `ring` is drawn as its circumference only.
    """

    position: tuple[float, float]
    radius: float
    height: float
    color: tuple[float, float, float, float]
    ring: bool = False
