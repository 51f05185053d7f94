"""`ballbot basins`: the states that each controller recovers from, and the states from which recovery is possible at all."""

from pathlib import Path

from ballbot_gym.robot import PAPER
from ballbot_train.commands.options import Filter, WorkersOption
from ballbot_train.evaluation.basins import TASK, Basins
from ballbot_train.evaluation.controllers import controllers_of
from ballbot_train.evaluation.names import with_way
from ballbot_train.evaluation.runner import MeasuredRun
from ballbot_train.report import figures
from ballbot_train.work import jobs
from ballbot_train.work.console import Physics, RobotName, console, physics_or_default, print_table
from ballbot_train.work.executors import Workers


def basins(
    controllers: tuple[str, ...] = (),
    points: int = 21,
    physics: Physics | None = None,
    out: Path = Path("runs/basins"),
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    filter: Filter | None = None,
) -> None:
    """Maps the leans, speeds and lean rates of Stabilize from which each controller recovers, where recovery is possible.

    Args:
        controllers: same as in `ballbot benchmark`.
        points: number of states along each axis of a map; odd.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        out: folder of basins.json, basins.csv and basins.png; an interrupted run continues here.
        workers: where the work is done.
        robot: name of the robot, with its limits and controllers.
        filter: filter in front of every controller: it estimates the robot, the delay, or the state from sensors.
    """
    if not 3 <= points <= 501 or points % 2 == 0:
        raise ValueError(f"points must be odd, and 3 to 501, not {points}")
    chosen = controllers_of([TASK], controllers, [robot], filter)
    physics = physics_or_default(physics, robot)
    names = chosen[robot][TASK]
    run = MeasuredRun.open(out, workers, chosen, robot, physics=physics, points=points)
    found = Basins.run(names, points, physics, out, workers, robot)
    found.write(run.facts, out)
    picture = figures.save(figures.basin_figure(found, run.ways), out / "basins.png")
    jobs.RunFolder(out).release()
    header = ["controller", "recovered", *(f"by lean and {basin.axis}" for basin in found.maps)]
    shares = [[found.fraction(name), *(basin.fraction(name) for basin in found.maps)] for name in names]
    rows = [
        [with_way(name, run.ways.get(f"{TASK}/{name}", "")), *(f"{share:.1%}" for share in group)]
        for name, group in zip(names, shares, strict=True)
    ]
    print_table(f"Share of the recoverable states, {points} × {points} a map, physics={physics}", header, rows)
    console.print(f"map: {picture}")
