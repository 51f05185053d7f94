"""Shapes of a robot in pictures, as plain data for every renderer."""

from dataclasses import dataclass

Point = tuple[float, float, float]
"""x, y and z, m; the floor is z = 0."""

DARK = "#292e3b"
"""Colour of parts, such as a ball, that do not have the colour of the controller."""


@dataclass(frozen=True)
class Sphere:
    """A sphere. Without a colour "#rrggbb" it has the colour of the controller that is shown."""

    centre: Point
    radius: float
    color: str | None = None


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the line from one point to another. Without a colour it has the controller's colour."""

    start: Point
    end: Point
    radius: float
    color: str | None = None


Shape = Sphere | Cylinder
