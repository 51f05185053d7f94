"""`ballbot basins`: from where each controller recovers, and from where anything could."""

import os
from pathlib import Path
from typing import Literal

from ballbot_train import jobs
from ballbot_train.console import console, print_table, progress_bar
from ballbot_train.evaluation import basins as maps
from ballbot_train.evaluation import evaluate
from ballbot_train.report import figures


def basins(
    controllers: tuple[str, ...] = (),
    points: int = 21,
    quick: bool = False,
    physics: Literal["bullet", "rk4"] = "bullet",
    out: Path = Path("runs/basins"),
    workers: int = os.cpu_count() or 1,
) -> None:
    """Maps for Stabilize from which leans, speeds and lean rates each controller recovers, within what 350 N allow.

    Args:
        controllers: as of `ballbot benchmark`.
        points: along each axis of a map; odd.
        quick: only 9 points.
        physics: "bullet" or "rk4".
        out: folder of basins.json, basins.csv and basins.png; an interrupted run continues here.
        workers: processes.
    """
    points = min(points, 9) if quick else points
    if points < 3 or points % 2 == 0:
        raise ValueError(f"points must be odd and at least 3, not {points}")
    chosen = evaluate.controllers_of([maps.TASK], controllers)
    names = chosen[maps.TASK]
    facts = evaluate.begin(out, chosen, workers, physics=physics, points=points)
    with progress_bar() as progress:
        bars = {"boundary": progress.add_task("boundary", total=len(maps.AXES))}

        def advance(name: str, count: int) -> None:
            progress.advance(bars[name], count)

        bounds = maps.boundaries(out, workers, advance)
        work = maps.cell_jobs(bounds, names, points, physics)
        totals = {name: sum(len(job.items) for job in work if job.group == name) for name in names}
        bars |= {name: progress.add_task(name, total=total) for name, total in totals.items()}
        done = jobs.run(work, out, workers, advance)
    made = maps.maps_of(bounds, (entry for entries in done for entry in entries), names, points)
    maps.write(made, facts, out)
    picture = figures.save(figures.basin_figure(made), out / "basins.png")
    jobs.release(out)
    header = ["controller", "recovered", *(f"by lean and {basin.axis}" for basin in made)]
    shares = [[maps.fraction(made, name), *(basin.fraction(name) for basin in made)] for name in names]
    rows = [[name, *(f"{share:.1%}" for share in group)] for name, group in zip(names, shares, strict=True)]
    print_table(f"Share of the recoverable states, {points} × {points} a map, physics={physics}", header, rows)
    console.print(f"map: {picture}")
