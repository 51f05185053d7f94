"""The leaderboard under disturbances: how success and regret change with their severity, and with tracks.

The disturbance is hidden from all controllers: experts plan for the nominal robot with ideal actuators and sensors. Every
controller gets the same draws. Under a stress, regret is measured against the undisturbed optimum, so no controller could
avoid all of it.

The tracks of `ballbot_gym.robot.randomization` are unknown robots. Every episode has an optimum of its own there: that of its
robot, whose first forces are zero while its delay lasts. Only a controller with access to the drawn parameters could reach
it. In units of that optimum J, regret is the sum of two parts:

- what the hidden parameters cost: how far the best controller of the table is from J in the same episode,
- what the controller adds: how much more it costs than that best controller.

A separate column shows the cost of delay, which is J minus the optimum without delay, because no controller can avoid it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, TRACKS, Randomization
from ballbot_train.evaluation import optima
from ballbot_train.evaluation.results import Result, Row, leaderboard
from ballbot_train.evaluation.runner import Group
from ballbot_train.evaluation.statistics import shown
from ballbot_train.policy.files import track_in


@dataclass(frozen=True)
class _Stress:
    """One kind of disturbance, by severity; severity 0 is none."""

    label: str
    """What the severity is, with its unit."""
    levels: tuple[float, ...]
    at: Callable[[float], Randomization]

    @property
    def choices(self) -> tuple[float, float, float]:
        """The least and the greatest severity to choose from by hand, twice the table's, and a step; 0 is none."""
        return 2 * min(0.0, *self.levels), 2 * max(self.levels), min(map(abs, self.levels))


def _both(value: float) -> tuple[float, float]:
    """A range of one value."""
    return value, value


STRESSES: dict[str, _Stress] = {
    "push": _Stress(
        "impulse of pushes on the ball, one in 2 s, N·s",
        (1.0, 2.0, 4.0, 8.0),
        lambda impulse: Randomization(push_impulse=_both(impulse), push_interval=2.0),
    ),
    "noise": _Stress(
        "sensor noise × (1 cm, 0.01 rad, 5 cm/s, 0.05 rad/s)",
        (0.5, 1.0, 2.0, 4.0),
        lambda factor: Randomization(
            **dict.fromkeys(("position_noise", "lean_noise"), 0.01 * factor),
            **dict.fromkeys(("velocity_noise", "lean_rate_noise"), 0.05 * factor),
        ),
    ),
    "delay": _Stress(
        "delay of the force, ms", (20.0, 40.0, 60.0), lambda ms: Randomization(actuator_delay=_both(1e-3 * ms))
    ),
    "lag": _Stress(
        "time constant of the actuator, ms",
        (10.0, 20.0, 40.0, 60.0),
        lambda ms: Randomization(actuator_lag=_both(1e-3 * ms)),
    ),
    "mass": _Stress(
        "error of both masses, %",
        (-20.0, -10.0, 10.0, 20.0),
        lambda percent: Randomization(**dict.fromkeys(("body_mass", "ball_mass"), _both(1 + 0.01 * percent))),
    ),
    "com": _Stress(
        "error of the centre of mass's height, %",
        (-20.0, -10.0, 10.0, 20.0),
        lambda percent: Randomization(com_height=_both(1 + 0.01 * percent)),
    ),
}
"""Every disturbance by its name on the command line."""

REGRET = "regret over the undisturbed optimum, %"
"""What tables and figures call it."""

NONE = "none"
"""The name of no disturbance, severity 0 of every stress."""

EXPERTS = {
    "unknown": ("cautious", "nmpc-adaptive"),
    "late": ("nmpc-adaptive",),
    "noisy": ("nmpc-ekf",),
    "real": ("nmpc-adaptive-ekf",),
}
"""The experts that are made for each track, which run there where no controllers are named."""


def groups_of(
    controllers: Mapping[str, Sequence[str]],
    names: Sequence[str],
    physics: str,
    robot: str = PAPER,
    experts: Mapping[str, Sequence[str]] = {},
) -> list[Group]:
    """What to run, for `MeasuredRun.measure`. Results are labelled with "stress" and "level". Tracks have level 0.

    Args:
        controllers: names by task. Policies that were trained on a track meet that track alone.
        names: in `TRACKS` or `STRESSES`. Every level of a stress is run, and the undisturbed episodes once.
        physics: "bullet", "mujoco" or "rk4".
        robot: by name.
        experts: more controllers, by the track that they meet.
    """
    stresses = [name for name in names if name not in TRACKS]
    conditions = [(NONE, 0.0, Randomization())] if stresses else []
    conditions += [(name, level, STRESSES[name].at(level)) for name in stresses for level in STRESSES[name].levels]
    conditions += [(name, 0.0, TRACKS[name]) for name in names if name in TRACKS]
    return [
        Group(
            task,
            controller,
            physics,
            robot,
            randomization=randomization,
            own_optima=name in TRACKS,
            labels={"stress": name, "level": level},
            counts_for=name,
        )
        for name, level, randomization in conditions
        for task, group in controllers.items()
        for controller in [*group, *experts.get(name, ())]
        if track_in(controller) in ("", name)
    ]


def curve_of(rows: Sequence[Row], task: str, controller: str, stress: str) -> list[Row]:
    """The rows of one curve, by severity, the undisturbed among them."""
    chosen = [row for row in rows if (row.task, row.controller) == (task, controller)]
    chosen = [row for row in chosen if row.labels["stress"] in (stress, NONE)]
    return sorted(chosen, key=lambda row: row.labels["level"])


def track_rows(results: Sequence[Result], robot: str = PAPER, seed: int = 0) -> list[Row]:
    """One row per track, task and controller; seed is of the bootstrap.

    The labels of a row are its "track", the "best" controller of the track and task, and three means over episodes, in units
    of the episode's optimum, NaN without an episode: "delay_costs", what delay adds to the optimum;
    "hidden_parameters_cost", the regret of the best controller in the episodes in which neither of the two fails; and
    "controller_adds", the row's further regret in the same episodes. The best controller has the least mean regret among
    those that succeed most often.
    """
    regrets: dict[tuple[str, str, str], dict[int, float]] = {}
    for result in results:
        regrets.setdefault((result.labels["stress"], result.task, result.controller), {})[result.episode] = (
            result.regret
        )
    plain, rows = leaderboard(results, seed), []
    for row in plain:
        track, task = row.labels["stress"], row.task
        rivals = [other for other in plain if (other.labels["stress"], other.task) == (track, task)]
        best = min(rivals, key=lambda other: (-other.success, np.nan_to_num(other.regret_mean, nan=np.inf))).controller
        own, of_best = (regrets[track, task, name] for name in (row.controller, best))
        known = optima.known(make_task(task, robot), robot, own, randomization=TRACKS[track])
        delay = float(np.mean(1 - known.ideal[[*own]] / known.costs[[*own]]))
        pairs = np.array([(of_best[episode], regret) for episode, regret in own.items()])
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        unknown, lost = pairs.mean(axis=0).tolist() if len(pairs) else (math.nan, math.nan)
        costs = {"delay_costs": delay, "hidden_parameters_cost": unknown, "controller_adds": lost - unknown}
        rows.append(replace(row, labels={"track": track, **costs, "best": best}))
    return rows


def _percent(*values: float) -> str:
    return " to ".join(shown(100 * value, ".2f") for value in values)


TRACK_TABLE: dict[str, Callable[[Row], str]] = {
    "track": lambda row: row.labels["track"],
    "task": lambda row: row.task,
    "controller": lambda row: row.controller,
    "physics": lambda row: row.physics,
    "success, %": lambda row: f"{100 * row.success:.4g}",
    "failures": lambda row: f"{row.falls} of {row.episodes}",
    "mean regret, %": lambda row: _percent(row.regret_mean),
    "95 % interval": lambda row: _percent(row.regret_low, row.regret_high),
    "delay costs, %": lambda row: _percent(row.labels["delay_costs"]),
    "hidden parameters cost, %": lambda row: _percent(row.labels["hidden_parameters_cost"]),
    "controller adds, %": lambda row: _percent(row.labels["controller_adds"]),
}
"""What the table of tracks shows of a row of `track_rows`."""
