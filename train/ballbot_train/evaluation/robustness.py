"""The leaderboard under disturbances: how success and regret change with their severity, and with tracks.

No controller knows of the disturbance: experts plan for the nominal robot with ideal actuators and sensors. Under a stress,
regret is measured against the undisturbed optimum, so no controller could avoid all of it. On a track (`tracks.py`) it is
measured against the optimum of each episode's own robot. Every controller meets the same draws.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import PAPER
from ballbot_train import jobs
from ballbot_train.evaluation.benchmark import CHUNK, episode_job
from ballbot_train.evaluation.results import Result, Row
from ballbot_train.executors import Workers
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
class StressResult(Result):
    """An episode under a disturbance."""

    stress: str = NONE
    level: float = 0.0


@dataclass(frozen=True)
class StressRow(Row):
    """A leaderboard row under a disturbance."""

    stress: str = NONE
    level: float = 0.0


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


def episodes_to_run(
    controllers: Mapping[str, Sequence[str]], wanted: Sequence[Condition], episodes: int
) -> dict[str, int]:
    """How many episodes `run` runs under every stress or track."""
    counts: dict[str, int] = {}
    for condition in wanted:
        each = sum(map(len, condition.chosen(controllers).values())) * episodes
        counts[condition.name] = counts.get(condition.name, 0) + each
    return counts


def run(
    controllers: Mapping[str, Sequence[str]],
    wanted: Sequence[Condition],
    episodes: int,
    physics: str,
    out: Path,
    workers: int | Workers,
    on_progress: Callable[[str, int], None],
    seed: int = 0,
    robot: str = PAPER,
) -> list[StressResult]:
    """Runs everything, resumably.

    Args:
        controllers: names by task.
        wanted: the conditions.
        episodes: certified episodes of each task, from the first.
        physics: "bullet", "mujoco" or "rk4".
        out: folder of the results.
        workers: a number of processes, or `Workers`.
        on_progress: called with the name of a condition and a number of finished episodes.
        seed: of the draws: episode i draws the same with every controller.
        robot: by name.
    """
    work = [
        (
            condition,
            episode_job(
                task,
                name,
                physics,
                range(start, min(start + chunk, episodes)),
                seed,
                condition.randomization,
                f"{condition.name}-{condition.level:g}",
                condition.name,
                robot,
                own_optima=condition.own_optima,
            ),
        )
        for condition in wanted
        for chunk in (CHUNK if condition.own_optima else episodes,)
        for task, group in condition.chosen(controllers).items()
        for name in group
        for start in range(0, episodes, chunk)
    ]
    done = jobs.run([job for _, job in work], out, workers, on_progress)
    return [
        StressResult(**entry, stress=condition.name, level=condition.level)
        for (condition, _), entries in zip(work, done, strict=True)
        for entry in entries
    ]


def curve_of(rows: Sequence[StressRow], task: str, controller: str, stress: str) -> list[StressRow]:
    """The rows of one curve, by severity, the undisturbed among them."""
    chosen = [row for row in rows if (row.task, row.controller) == (task, controller) and row.stress in (stress, NONE)]
    return sorted(chosen, key=lambda row: row.level)
