"""The leaderboard under disturbances: how success and regret change with their severity, and with tracks.

No controller knows of the disturbance: experts plan for the nominal robot with ideal actuators and sensors. Under a stress,
regret is measured against the undisturbed optimum, so no controller could avoid all of it. On a track (`tracks.py`) it is
measured against the optimum of each episode's own robot. Every controller meets the same draws.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import PAPER
from ballbot_train.evaluation.benchmark import Group
from ballbot_train.evaluation.results import Row
from ballbot_train.policy_files import track_in


@dataclass(frozen=True)
class Stress:
    """One kind of disturbance, by severity; severity 0 is none."""

    label: str
    """What the severity is, with its unit."""
    levels: tuple[float, ...]
    at: Callable[[float], Randomization]


def _push(impulse: float) -> Randomization:
    return Randomization(push_impulse=(impulse, impulse), push_interval=2.0)


def _noise(factor: float) -> Randomization:
    return Randomization(
        position_noise=0.01 * factor,
        lean_noise=0.01 * factor,
        velocity_noise=0.05 * factor,
        lean_rate_noise=0.05 * factor,
    )


def _delay(milliseconds: float) -> Randomization:
    return Randomization(actuator_delay=(1e-3 * milliseconds, 1e-3 * milliseconds))


def _lag(milliseconds: float) -> Randomization:
    return Randomization(actuator_lag=(1e-3 * milliseconds, 1e-3 * milliseconds))


def _mass(percent: float) -> Randomization:
    factor = 1 + 0.01 * percent
    return Randomization(body_mass=(factor, factor), ball_mass=(factor, factor))


def _com(percent: float) -> Randomization:
    factor = 1 + 0.01 * percent
    return Randomization(com_height=(factor, factor))


STRESSES: dict[str, Stress] = {
    "push": Stress("impulse of pushes on the ball, one in 2 s, N·s", (1.0, 2.0, 4.0, 8.0), _push),
    "noise": Stress("sensor noise × (1 cm, 0.01 rad, 5 cm/s, 0.05 rad/s)", (0.5, 1.0, 2.0, 4.0), _noise),
    "delay": Stress("delay of the force, ms", (20.0, 40.0, 60.0), _delay),
    "lag": Stress("time constant of the actuator, ms", (10.0, 20.0, 40.0, 60.0), _lag),
    "mass": Stress("error of both masses, %", (-20.0, -10.0, 10.0, 20.0), _mass),
    "com": Stress("error of the centre of mass's height, %", (-20.0, -10.0, 10.0, 20.0), _com),
}
"""Every disturbance by its name on the command line."""

REGRET = "regret over the undisturbed optimum, %"
"""What tables and figures call it."""

NONE = "none"
"""The name of no disturbance, severity 0 of every stress."""


@dataclass(frozen=True)
class Condition:
    """What controllers meet: a stress of some severity, or a track, whose level is 0."""

    name: str
    level: float
    randomization: Randomization
    own_optima: bool = False
    """Whether regret is over the optimum of each episode's own robot, and not over the undisturbed one."""
    left_out: tuple[str, ...] = ()
    """Controllers that do not meet it."""

    def chosen(self, controllers: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
        """Those controllers by task that meet it: not the policies that were trained on other tracks."""

        def meets(name: str) -> bool:
            return name not in self.left_out and track_in(name) in ("", self.name)

        return {task: [name for name in group if meets(name)] for task, group in controllers.items()}


def conditions(stresses: Sequence[str]) -> list[Condition]:
    """Every level of some stresses in `STRESSES`, and the undisturbed once."""
    levels = ((name, level) for name in stresses for level in STRESSES[name].levels)
    return [
        Condition(NONE, 0.0, Randomization()),
        *(Condition(name, level, STRESSES[name].at(level)) for name, level in levels),
    ]


def groups_of(
    controllers: Mapping[str, Sequence[str]], wanted: Sequence[Condition], physics: str, robot: str = PAPER
) -> list[Group]:
    """Controllers by task under conditions, for `run_groups`, whose results are told by "stress" and "level"."""
    return [
        Group(
            task,
            name,
            physics,
            robot,
            randomization=condition.randomization,
            own_optima=condition.own_optima,
            told={"stress": condition.name, "level": condition.level},
            counts_for=condition.name,
        )
        for condition in wanted
        for task, names in condition.chosen(controllers).items()
        for name in names
    ]


def curve_of(rows: Sequence[Row], task: str, controller: str, stress: str) -> list[Row]:
    """The rows of one curve, by severity, the undisturbed among them."""
    chosen = [row for row in rows if (row.task, row.controller) == (task, controller)]
    chosen = [row for row in chosen if row.told["stress"] in (stress, NONE)]
    return sorted(chosen, key=lambda row: row.told["level"])
