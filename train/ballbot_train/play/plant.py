"""What the controllers do not know of the robot: sliders for the stresses of `robustness`."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import NamedTuple

from ballbot_gym.randomization import Randomization
from ballbot_train.console import check_names
from ballbot_train.evaluation.robustness import STRESSES


class Span(NamedTuple):
    """What a slider allows."""

    label: str
    low: float
    high: float
    step: float


PLANT: dict[str, Span] = {
    "mass": Span("Masses, %", -50.0, 100.0, 5.0),
    "com": Span("Centre of mass, %", -30.0, 50.0, 5.0),
    "delay": Span("Delay, ms", 0.0, 120.0, 20.0),
    "lag": Span("Lag, ms", 0.0, 100.0, 5.0),
    "noise": Span("Sensor noise, ×", 0.0, 5.0, 0.25),
    "push": Span("Random pushes, N·s", 0.0, 12.0, 0.5),
}
"""By the name of the stress in `robustness.STRESSES`. 0 is nothing."""


def severity(stress: str, value: float) -> float:
    """The severity that a slider gives a stress.

    Raises:
        ValueError: no stress of this name, or a value outside of its `Span`.
    """
    check_names("change", [stress], PLANT)
    span = PLANT[stress]
    if not span.low <= value <= span.high:
        raise ValueError(f"{stress} must be {span.low:g} to {span.high:g}, not {value:g}")
    return span.step * round(value / span.step)


def randomization(severities: Mapping[str, float]) -> Randomization:
    """All hidden changes together: of each stress the fields that it changes."""
    changes = [STRESSES[stress].at(value) for stress, value in severities.items() if value]
    changed = {f.name: value for each in changes for f in fields(each) if (value := getattr(each, f.name)) != f.default}
    return replace(Randomization(), **changed)
