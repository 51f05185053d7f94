"""Sim-to-sim transfer: controllers that were made for one robot, run on another, in one physics engine or in several.

The controller plans and observes as for its own robot. It meets the certified episodes of the robot that it runs on, and its
cost is compared with that robot's optimum on its own floor, on other floors too. PyBullet and MuJoCo simulate a rolling
robot's contact, and its friction may differ from what the controller was made for.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import named_robot
from ballbot_train.evaluation import benchmark
from ballbot_train.evaluation.results import Row, shown


def floor(robot: str, friction: float | None) -> BallbotParams:
    """A robot by name on a floor with this friction; None is the robot's own.

    Raises:
        ValueError: a friction for a robot whose ball does not roll.
    """
    params = named_robot(robot)
    if friction is None:
        return params
    if not params.rolls:
        raise ValueError(f"the ball of {robot!r} does not roll, so its floor has no friction; give a rolling robot")
    return replace(params, friction=friction)


def groups_of(
    controllers: Mapping[str, Mapping[str, Sequence[str]]],
    robot: str,
    frictions: Sequence[float | None],
    physics: Sequence[str],
) -> list[benchmark.Group]:
    """What to run, for `run_groups`, whose results are told by "made_for", "robot" and "friction".

    Args:
        controllers: names by task, by the robot that they were made for.
        robot: what they run on, by name.
        frictions: of the floors; None is the robot's own.
        physics: some of "bullet", "mujoco" and "rk4".
    """
    return [
        benchmark.Group(
            task,
            name,
            engine,
            robot,
            made_for,
            params,
            told={"made_for": made_for, "robot": robot, "friction": params.friction},
        )
        for made_for, by_task in controllers.items()
        for task, names in by_task.items()
        for name in names
        for params in [floor(robot, friction) for friction in frictions]
        for engine in physics
    ]


REGRET = "regret over the optimum on the robot's own floor"
"""What tables and figures call it."""
COLUMNS = {
    name: f"{name}_on_own_floor" for name in ("regret_mean", "regret_low", "regret_high", "regret_median", "optimum")
}
"""The same in CSV files."""
TABLE: dict[str, Callable[[Row], str]] = {
    "task": lambda row: row.task,
    "made for": lambda row: row.told["made_for"],
    "controller": lambda row: row.controller,
    "runs on": lambda row: row.told["robot"],
    "friction": lambda row: shown(row.told["friction"], "g"),
    "physics": lambda row: row.told["physics"],
    "success": lambda row: f"{100 * row.success:.1f} %",
    "falls": lambda row: f"{row.falls}/{row.episodes}",
    REGRET: lambda row: shown(row.regret_mean, ".2%"),
    "peak tilt": lambda row: shown(row.peak_tilt_median, ".1f", "°"),
}
"""What the table shows of a row that is told by the same and "physics"."""
