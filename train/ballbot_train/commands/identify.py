"""`ballbot identify`: from a log of a robot to the robot's file, with intervals, and what the log does not determine."""

import json
import math
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from ballbot_baselines.identification.design import design as designed
from ballbot_baselines.identification.identify import Identified
from ballbot_baselines.identification.identify import identify as identified
from ballbot_baselines.identification.likelihood import Innovations, Readings
from ballbot_baselines.identification.logs import Log, LogError
from ballbot_baselines.identification.record import Motion, Waves
from ballbot_baselines.identification.record import record as recorded
from ballbot_gym import files
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import Ballbot, named_robot, urdf_text
from ballbot_train.report import figures
from ballbot_train.work.console import (
    Physics,
    RobotName,
    check_least,
    console,
    physics_or_default,
    print_table,
    progress_bar,
)

with imports_of(__name__):
    import tyro
    from matplotlib.figure import Figure

_LONGEST = 600.0  # s of a recorded log
_DOTS = 2000  # of a residual figure's axis


def identify(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    robot: RobotName = "omni",
    columns: Path | None = None,
    known: tuple[str, ...] = (),
    record: bool = False,
    design: bool = False,
    motion: Path | None = None,
    seconds: float | None = None,
    max_lean: float = 8.0,
    physics: Physics | None = None,
    randomization: str | None = None,
    seed: int = 0,
    out: Path = Path("runs/identify"),
) -> None:
    """Finds the numbers of a robot from logs of its motion, with 95 % intervals, and writes its URDF.

    Args:
        logs: CSV or Parquet files, dumps of Kugle or ROS bags, with the same columns.
        robot: name of the nominal robot, or its URDF: what is known before, from drawings and data sheets.
        columns: the TOML file that says what the columns are; default, next to the first log, with its name.
        known: names of numbers that were measured otherwise and are held at those of the robot, such as body_mass.
        record: record a log of a simulated robot instead.
        design: find the most informative motion instead.
        motion: of --record: the motion.json that --design wrote, or a file of "times" (k), s, and "places" (k, 3), x and
            y in m and the heading in rad, to which the robot moves at these; default, the robot drives in waves.
        seconds: of --record and --design: length of the log, s; default, 60 and 20.
        max_lean: of --design: the greatest lean, degrees.
        physics: of --record: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        randomization: of --record: name of the track that draws the robot, its drive and its sensors; default, "unknown" for
            robots with wheels, and "real" for others.
        seed: of --record: seed of what is drawn.
        out: folder of the results.
    """
    nominal = named_robot(robot)
    if not isinstance(nominal, Ballbot):
        raise ValueError(f"identify is for ballbots, and {robot!r} is a {type(nominal).__name__}")
    if record or design:
        _refuse(bool(logs) or (record and design), "give one of: paths of logs, --record, --design")
        length = (60.0 if record else 20.0) if seconds is None else seconds
        _refuse(not 5 <= length <= _LONGEST, f"seconds must be from 5 to {_LONGEST:g}, not {length:g}")
        _refuse(not 1 <= max_lean <= 30, f"max_lean must be from 1 to 30 degrees, not {max_lean:g}")
        if record:
            _record(nominal, robot, motion, length, physics, randomization, seed, out)
        else:
            _design(nominal, length, math.radians(max_lean), known, out)
        return
    _refuse(not logs, "give the path of a log; `ballbot identify --record` makes one of a simulated robot")
    read = [Log.read(path, nominal, columns or logs[0].with_suffix(".toml")) for path in logs]
    with progress_bar() as progress:
        bar = progress.add_task("likelihood", total=None)
        result = identified(nominal, read, known, lambda done: progress.update(bar, completed=done))
    _show(result)
    _write(result, read, robot, _show_scores(result, read), out)


def _refuse(wrong: bool, message: str) -> None:
    if wrong:
        raise ValueError(message)


def _record(
    nominal: Ballbot,
    name: str,
    motion: Path | None,
    seconds: float,
    physics: Physics | None,
    track: str | None,
    seed: int,
    out: Path,
) -> None:
    """Records a log, and writes it next to the robot that made it."""
    check_least(0, seed=seed)
    track = track or ("unknown" if nominal.SENSORS else "real")
    waves = None if motion is None else _motion(motion)
    log = recorded(nominal, seconds, waves, track, physics_or_default(physics, name), seed)
    path = Log.write(log.readings, out / "log.csv", nominal.force_limit)
    true = files.write(out / "true.urdf", urdf_text(log.robot))
    console.print(f"log: {path}, {seconds:g} s\ncolumns: {out / 'log.toml'}")
    console.print(f"the robot that made it, with a delay of {1e3 * log.delay:g} ms: {true}")


def _design(nominal: Ballbot, seconds: float, max_lean: float, known: tuple[str, ...], out: Path) -> None:
    """Finds the most informative motion, writes it, and prints how exactly a log of it would determine the robot."""
    with progress_bar() as progress:
        bar = progress.add_task("frequencies", total=None)
        found = designed(
            nominal, seconds, max_lean, known, lambda done, total: progress.update(bar, completed=done, total=total)
        )
    header = ["", "after balancing", "after this motion"]
    each = zip(found.names, found.balancing, found.deviations, strict=True)
    print_table(
        f"standard deviations after {seconds:g} s, in those of the prior",
        header,
        [[n, f"{a:.3g}", f"{b:.3g}"] for n, a, b in each],
    )
    held = {name: np.asarray(value).tolist() for name, value in found.motion._asdict().items()}
    path = files.write(out / "motion.json", json.dumps(held, indent=1))
    console.print(f"intervals: {found.ratio:.2f} of those after balancing, as their geometric mean")
    console.print(f"motion: {path}, with leans of up to {math.degrees(found.lean):.1f}°")


class _Places(NamedTuple):
    """A motion from place to place."""

    times: np.ndarray
    """(k,) s, growing, at which the robot is asked to be elsewhere."""
    places: np.ndarray
    """(k, 3) m, m and rad; before the first time it is the origin."""

    def __call__(self, t: float) -> np.ndarray:
        i = int(np.searchsorted(self.times, t, side="right")) - 1
        return self.places[i] if i >= 0 else np.zeros(3)


def _motion(path: Path) -> Motion:
    """The motion of a file that --design wrote, or one from place to place."""
    held = files.read_json(path)
    kind = _Places if "places" in held else Waves
    try:
        parts = [files.numbers(held[name], f"{path}: {name}") for name in kind._fields]
    except KeyError as error:
        raise LogError(f"{path} has no {error.args[0]!r}; give a motion that --design wrote") from None
    k = parts[0].size if kind is _Places else len(parts[1])
    shapes = [(k,), (k, 3)] if kind is _Places else [(3, k), (k,), (3, k)]
    _refuse([part.shape for part in parts] != shapes, f"{path} is no motion that --design wrote")
    return kind(*parts)


def _show(result: Identified) -> None:
    """Prints findings, numbers and predictions."""
    for finding in result.findings:
        console.print(f"• {finding}", soft_wrap=True)
    print_table("numbers", ["", "nominal", "identified", "95 % interval", "unit", "from"], _rows(result))
    console.print("rows from 'prior' are not in the log: they stay near the nominal robot")
    for each in result.found.directions:
        mixed = ", ".join(f"{share:+.2f} {name}" for name, share in each.shares.items())
        console.print(
            f"the log does not determine {mixed} (eigenvalue {each.eigenvalue:.1e} of the prior's)", soft_wrap=True
        )
    shown = result.predictions
    header = [
        "median error",
        *(f"{who}, {h:g} s" for h in shown.horizons for who in ("nominal", "identified", "no change")),
    ]
    rows = [
        [
            group,
            *(
                "–" if math.isnan(error) else f"{error:.3g}"
                for j in range(len(shown.horizons))
                for error in (*shown.errors[:, i, j], shown.constant[i, j])
            ),
        ]
        for i, group in enumerate(shown.groups)
    ]
    print_table("predictions of the last quarter, which was held back", header, rows)


def _show_scores(result: Identified, logs: list[Log]) -> list[dict[str, Any]]:
    """Prints and returns the regret of the controller that made the logs, where they tell it."""
    rows: list[dict[str, Any]] = []
    for log in logs:
        for each in result.scores(log):
            rows.append({"log": str(log.path), **each._asdict(), "regret": each.regret})
            console.print(
                f"regret of the controller of {log.path}, in {each.duration:.3g} s from {each.begin:.3f} s on that end at "
                f"rest: {each.regret:.1%} (cost {each.cost:.4g}, optimum {each.optimum:.4g})",
                soft_wrap=True,
            )
    if not rows:
        console.print(
            "the regret of the controller is not known: no part of the log begins away from rest and ends at rest",
            soft_wrap=True,
        )
    return rows


def _rows(result: Identified) -> list[list[str]]:
    return [
        [
            each.parameter.name,
            f"{each.parameter.nominal:.5g}",
            f"{each.value:.5g}",
            f"{each.low:.5g} to {each.high:.5g}",
            each.parameter.unit,
            "log" if each.determined else "prior",
        ]
        for each in result.found.estimates
    ]


def _write(result: Identified, logs: list[Log], robot: str, scores: list[dict[str, Any]], out: Path) -> None:
    """Writes the robot, its numbers as CSV and JSON, and the figure of residuals."""
    found = result.found
    rows: list[dict[str, Any]] = [
        {
            "name": each.parameter.name,
            "unit": each.parameter.unit,
            "nominal": each.parameter.nominal,
            "value": each.value,
            "low": each.low,
            "high": each.high,
            "determined_by": "log" if each.determined else "prior",
        }
        for each in found.estimates
    ]
    shown = result.predictions
    record = {
        "robot": robot,
        "logs": [str(log.path) for log in logs],
        "known": found.problem.known,
        "numbers": rows,
        "findings": result.findings,
        "not_determined": [each._asdict() for each in found.directions],
        "predictions": {
            "groups": shown.groups,
            "horizons": shown.horizons,
            **dict(zip(("nominal", "identified"), map(_without_nan, shown.errors), strict=True)),
            "no_change": _without_nan(shown.constant),
        },
        "controller": scores,
    }
    files.write_csv(out / "numbers.csv", rows)
    files.write(out / "numbers.json", json.dumps(record, indent=1, ensure_ascii=False))
    figures.save(_residual_figure(result, logs[0].readings), out / "residuals.png")
    path = files.write(out / "robot.urdf", urdf_text(found.robot))
    console.print(f"numbers: {out / 'numbers.csv'}\nresiduals: {out / 'residuals.png'}\nrobot: {path}")


def _without_nan(values: np.ndarray) -> list[Any]:
    """What JSON can hold: None instead of NaN."""
    return np.where(np.isnan(values), None, values).tolist()  # pyright: ignore[reportCallIssue, reportArgumentType]


def _residual_figure(result: Identified, readings: Readings) -> Figure:
    """Innovations over their expected deviations: white noise of size 1 where the robot explains the log."""
    problem = result.found.problem
    inside = Innovations.of(problem.robot, readings, problem.lanes(result.found.z[None]))
    scaled = np.where(np.isfinite(readings.y), inside.missed[:, 0] / np.sqrt(inside.variance[:, 0]), np.nan)
    rows = math.ceil(len(readings.names) / 2)
    figure = Figure(figsize=(12, 1.5 * rows + 1), layout="constrained")
    every = max(1, len(scaled) // _DOTS)
    for axis, name, values in zip(figure.subplots(rows, 2, squeeze=False).flat, readings.names, scaled.T, strict=False):
        axis.plot(readings.t[::every], values[::every], ".", ms=2, alpha=0.5)
        read = values[np.isfinite(values)]
        beyond = (
            f"{np.mean(np.abs(read) > 1.96):.1%} beyond ±1.96, where 5 % are expected" if read.size else "no reading"
        )
        axis.set_title(f"{name}: {beyond}", fontsize=9)
        axis.set_ylim(-5, 5)
        axis.grid(alpha=0.3)
    figure.supxlabel("time, s")
    figure.supylabel("innovation over its expected deviation")
    return figure
