"""Shapes: what is drawn of a robot, as plain data that every renderer draws."""

from dataclasses import dataclass

Point = tuple[float, float, float]
"""x, y and z, m; the floor is z = 0."""

DARK = "#292e3b"
"""Colour of parts that have the same colour whatever drives the robot, such as a ball."""


@dataclass(frozen=True)
class Sphere:
    """A sphere. Without a colour "#rrggbb" it has that of the controller that is shown."""

    centre: Point
    radius: float
    color: str | None = None


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the line from one point to another. Without a colour it has that of the controller that is shown."""

    start: Point
    end: Point
    radius: float
    color: str | None = None


Shape = Sphere | Cylinder
