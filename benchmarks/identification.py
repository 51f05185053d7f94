"""How exactly logs determine robots: errors, coverage of intervals, predictions and time, on robots drawn by seed.

    python benchmarks/identification.py --robot rolling --physics rk4 mujoco --robots 5

For every robot that is drawn, a log of 60 s is recorded and identified, once as it is and once with glitches in 1 % of all
readings and commands and stamps that jitter by 3 ms. A third copy has a wrong sign too. The robots were weighed: the masses
of body and ball are given. Robots without wheels are of the track `real`, those with wheels of the track `unknown`, with a
delay of up to 20 ms besides. Robots that are in the file of results are not repeated.
"""

import argparse
import csv
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ballbot_baselines.identification.checks import Predictions
from ballbot_baselines.identification.identify import Identified, identify
from ballbot_baselines.identification.likelihood import Readings
from ballbot_baselines.identification.logs import Log, LogError
from ballbot_baselines.identification.record import Recorded, record
from ballbot_gym import files, named_robot
from ballbot_gym.robot import TRACKS, Ballbot

_KNOWN = ("body_mass", "ball_mass")
_GLITCHES, _SIZE, _JITTER = 0.01, 6.0, 0.003  # share, in standard deviations of a column, and s
_TRUE = (
    "com_height", "inertia", "axial_inertia", "force_limit", "wheels.no_load_speed", "wheels.inertia", "wheels.damping",
    "wheels.spin_friction",
)  # fmt: skip
_WHEELED = replace(TRACKS["unknown"], actuator_delay=(0.0, 0.02))
_TRIES = 100  # seeds are skipped whose robot falls under the controller of the nominal one


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="rolling")
    parser.add_argument("--physics", nargs="+", default=["rk4", "mujoco"])
    parser.add_argument("--robots", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--clean", action="store_true", help="logs without errors alone")
    parser.add_argument("--out", type=Path, default=Path("runs/identification.csv"))
    options = parser.parse_args()
    nominal: Any = named_robot(options.robot)
    track = _WHEELED if nominal.SENSORS else "real"
    rows: list[dict[str, Any]] = []
    if options.out.exists():
        rows = list(csv.DictReader(options.out.read_text().splitlines()))
    for physics in options.physics:
        done = 0
        for seed in range(options.first, options.first + _TRIES):
            if done == options.robots:
                break
            key = {"robot": options.robot, "physics": physics, "seed": str(seed)}
            if any(all(row[name] == value for name, value in key.items()) for row in rows):
                done += 1
                continue
            try:
                made = record(nominal, options.seconds, randomization=track, physics=physics, seed=seed)
            except ValueError as error:
                print(f"{physics} {seed}: {error}", flush=True)
                continue
            found = [{**key, **row} for row in of_robot(nominal, made, seed, options.clean)]
            rows += [{name: str(value) for name, value in row.items()} for row in found]
            done += 1
            files.write_csv(options.out, rows)
            print(f"{options.robot} {physics} {seed}: done", flush=True)
    summarize([row for row in rows if row["robot"] == options.robot and row["physics"] in options.physics])


def of_robot(nominal: Any, made: Recorded, seed: int, clean: bool) -> list[dict[str, Any]]:
    """Rows of a robot: of its log as it is, with errors, and with a wrong sign."""
    weighed = replace(nominal, **{name: getattr(made.robot, name) for name in _KNOWN})
    rng, rows = np.random.default_rng(seed), []
    logs = {"clean": made.readings} if clean else {"clean": made.readings, "dirty": dirty(made.readings, rng)}
    for kind, readings in logs.items():
        rows += [{"log": kind, **row} for row in measure(weighed, made, readings)]
    if not clean:
        named = sign_is_named(weighed, dirty(made.readings, rng), rng)
        rows.append({"log": "wrong sign", **row_of("named", named, 1.0)})
    return rows


def dirty(readings: Readings, rng: np.random.Generator) -> Readings:
    """A log with glitches in 1 % of readings and commands, and stamps that jitter."""

    def hit(values: np.ndarray) -> np.ndarray:
        wrong = values + rng.uniform(-_SIZE, _SIZE, values.shape) * values.std(axis=0)
        return np.where(rng.random(values.shape) < _GLITCHES, wrong, values)

    t = readings.t + rng.normal(0, _JITTER, len(readings.t))
    return replace(readings, t=t, y=hit(readings.y), commands=hit(readings.commands))


def through_files(readings: Readings, robot: Ballbot) -> Log:
    """A log that was written and read again."""
    with TemporaryDirectory() as folder:
        return Log.read(Log.write(readings, Path(folder) / "log.csv"), robot)


def measure(robot: Ballbot, made: Recorded, readings: Readings) -> list[dict[str, Any]]:
    """Rows of what was found from one log."""
    log = through_files(readings, robot)
    begin = time.process_time()
    result = identify(robot, [log], _KNOWN)
    rows = [row_of("seconds of one core", time.process_time() - begin, np.nan)]
    named = sum("glitch" in each for each in result.findings), any("jitters" in each for each in result.findings)
    rows.append(row_of("rounds of the search", result.found.rounds, np.nan))
    rows += [row_of("columns with glitches named", named[0], np.nan), row_of("jitter named", float(named[1]), np.nan)]
    truths = {"delay": made.delay} | {name: value_of(made.robot, name) for name in _TRUE if has(made.robot, name)}
    for each in result.found.estimates:
        if (true := truths.get(each.parameter.name)) is not None:
            held = each.low <= true <= each.high
            found = {"low": each.low, "high": each.high, "inside": held, "determined": each.determined}
            rows.append(row_of(each.parameter.name, each.value, true) | found)
    return [*rows, *predictions(result, made, log)]


def predictions(result: Identified, made: Recorded, log: Log) -> list[dict[str, Any]]:
    """Errors of predictions over 0.5 s of the identified robot, over those of the true one."""
    problem, n = result.found.problem, len(log.readings.t)
    z = problem.z_of(made.robot, made.delay, result.found.z)
    true = Predictions.of(problem, z[None], log.readings.between(round(0.75 * n), n))
    ratios = result.predictions.errors[:, :, 1] / true.errors[0, :, 1]
    nominal, identified = np.exp(np.log(ratios).mean(axis=1))
    return [row_of("prediction error of the nominal robot", nominal, 1.0), row_of("prediction error", identified, 1.0)]


def sign_is_named(robot: Ballbot, readings: Readings, rng: np.random.Generator) -> float:
    """1 if a column whose sign is wrong is named, else 0."""
    columns = [*readings.names, *Readings.commanded(robot)]
    i = int(rng.integers(len(columns)))
    y, commands = readings.y.copy(), readings.commands.copy()
    (y if i < y.shape[1] else commands)[:, i % y.shape[1] if i >= y.shape[1] else i] *= -1
    try:
        identify(robot, [through_files(replace(readings, y=y, commands=commands), robot)], _KNOWN)
    except LogError as error:
        named = f"'{columns[i]}'" in str(error) and "sign" in str(error)
        if not named:
            print(f"{columns[i]}: {error}")
        return float(named)
    print(f"{columns[i]}: its sign is not named")
    return 0.0


def has(robot: Ballbot, name: str) -> bool:
    return not name.startswith("wheels.") or bool(robot.wheel_radius)


def value_of(robot: Any, name: str) -> float:
    for part in name.split("."):
        robot = getattr(robot, part)
    return robot


def row_of(name: str, value: float, true: float) -> dict[str, Any]:
    return {"name": name, "value": value, "true": true, "low": "", "high": "", "inside": "", "determined": ""}


def summarize(rows: list[dict[str, Any]]) -> None:
    """Prints medians and largest values by kind of log and quantity, and the coverage of the intervals."""
    for kind in dict.fromkeys(row["log"] for row in rows):
        for name in dict.fromkeys(row["name"] for row in rows if row["log"] == kind):
            own = [row for row in rows if (row["log"], row["name"]) == (kind, name)]
            values, true = (np.array([float(row[each]) for row in own]) for each in ("value", "true"))
            if not own[0]["inside"]:
                print(f"{kind}: {name}: median {np.median(values):.3g}, {values.min():.3g} to {values.max():.3g}")
                continue
            unit, factor = ("ms", 1e3) if name == "delay" else ("%", 100.0)
            sizes = factor * np.abs(values - true) / (1.0 if name == "delay" else true)
            determined, inside = (sum(row[each] == "True" for row in own) for each in ("determined", "inside"))
            print(
                f"{kind}: {name}: error median {np.median(sizes):.2g} {unit}, largest {sizes.max():.2g} {unit}; determined "
                f"in {determined}, inside the interval in {inside} of {len(own)}"
            )
        sure = [row["inside"] == "True" for row in rows if row["log"] == kind and row["determined"] == "True"]
        if sure:
            print(f"{kind}: {sum(sure)} of {len(sure)} intervals of numbers that the log determines hold the truth")


if __name__ == "__main__":
    main()
