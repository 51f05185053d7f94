"""Reads logs: a table with named columns, and a TOML file that says what the columns are.

```toml
separator = ","          # " " for any white space
names = ["t", "roll"]    # of a file without a line of names
rate = 100.0             # Hz, of a log without a column of time

[columns.t]
quantity = "time"
unit = "ms"

[columns.roll]
quantity = "lean_y"      # see `Readings.readable`
unit = "deg"
sign = -1                # 1 by default
scale = 1.0              # of raw values, 1 by default
delay = 0.005            # s, by which the reading is older than its time
window = 0.01            # s, over which it is a mean about that earlier time

[columns.pwm]
quantity = "command_1"   # see `Readings.commanded`
unit = "pwm"             # or "N m", "N", or "A" with torque_constant, N·m/A
full = 255               # the value at the full force of the drive, which every "pwm" needs
```

A ROS bag has `stamps = "received"` where its headers are of another clock, and every column has `topic` and `field`. The
columns of a log with `format = "kugle"` have the names of `formats`.

Whatever is wrong with a log is named in `Log.findings`, and readings that are wrong are left out.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_baselines.identification.formats import LogError, _bag, _kugle, _parquet, _Source, _text
from ballbot_baselines.identification.likelihood import Readings
from ballbot_gym import files
from ballbot_gym.robot import Ballbot

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

_UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": np.pi / 180, "turn": 2 * np.pi},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180, "rpm": 2 * np.pi / 60},
    "m/s²": {"m/s²": 1.0, "m/s^2": 1.0, "g": 9.80665},
}
_COMMAND_UNITS = ("N", "N m", "A", "pwm")
_FIELDS = {"quantity", "unit", "sign", "scale", "delay", "window", "full", "torque_constant", "topic", "field"}
_ENTRIES = ("columns", "separator", "names", "rate", "format", "stamps")
_OF_TABLES = ("separator", "names", "rate", "format")
_FORMATS, _STAMPS = ("table", "kugle"), ("header", "received")
_LEAST_SECONDS = 5.0
_LEAST_SHARE = 0.5  # of a column that must be readings
_GAP = 3.0  # times between readings, in median ones
_JITTER = 0.005  # of the time between readings, above which it is a finding
_FAR, _FAR_HERE = 10.0, 8.0  # typical errors of the whole log, and of those nearby: readings further off are glitches
_NEARBY = 101  # readings
_GLITCH_ROUNDS = 20
_EXAMPLES = 3


@dataclass(frozen=True)
class _Column:
    """What a column of a log holds, as its TOML says."""

    name: str
    quantity: str
    factor: float
    """From the values in the file to SI units, or to a robot's action."""
    delay: float = 0.0
    window: float = 0.0
    topic: str = ""
    field: str = ""


@dataclass(frozen=True)
class _Description:
    """What the TOML of a log says."""

    columns: tuple[_Column, ...]
    separator: str = ","
    names: tuple[str, ...] = ()
    rate: float | None = None
    format: str = "table"
    received: bool = False

    @property
    def is_bag(self) -> bool:
        """Whether the columns are of a ROS bag."""
        return bool(self.columns[0].topic)

    @property
    def by_quantity(self) -> dict[str, _Column]:
        """The columns by what they hold."""
        return {column.quantity: column for column in self.columns}

    @classmethod
    def read(cls, path: Path, robot: Ballbot) -> "_Description":
        """What the TOML of a log says.

        Raises:
            LogError: it is no TOML, or names a quantity or unit that there is not; the message says which there are.
        """
        try:
            content = tomllib.loads(files.read(path).decode())
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise LogError(f"{path} is not valid TOML: {error}") from None
        if unknown := set(content) - set(_ENTRIES):
            raise LogError(f"{path}: unknown entry {min(unknown)!r}; known: {', '.join(map(repr, _ENTRIES))}")
        given = content.get("columns")
        if not (isinstance(given, dict) and given and all(isinstance(each, dict) for each in given.values())):
            raise LogError(f"{path} has no table [columns.NAME] for each column")
        columns = tuple(_column(f"{path}: column {name!r}", name, each, robot) for name, each in given.items())
        names = [column.quantity for column in columns]
        if twice := [name for name in names if names.count(name) > 1]:
            raise LogError(f"{path}: two columns are {twice[0]!r}; leave one of them out")
        for name in Readings.commanded(robot):
            if name not in names:
                raise LogError(
                    f"{path}: no column has quantity = {name!r}; the commands of this robot must be in the log"
                )
        if not set(names) & set(Readings.readable(robot)):
            raise LogError(
                f"{path}: no column is a reading; give at least one of {', '.join(Readings.readable(robot))}"
            )
        if len({bool(column.topic) for column in columns}) > 1:
            raise LogError(f"{path}: give topic and field in every column, as for a ROS bag, or in none")
        return cls(columns, *(_bag_entries if columns[0].topic else _table_entries)(path, content, names))


@dataclass(frozen=True)
class Log:
    """A log that was read, cleaned of what is wrong with it."""

    path: Path
    description: _Description
    readings: Readings
    findings: tuple[str, ...] = field(default=())
    """What is wrong with it, in sentences."""

    @classmethod
    def read(cls, path: Path, robot: Ballbot, columns: Path | None = None) -> "Log":
        """A log of a robot, cleaned.

        Args:
            path: of the CSV, text or Parquet file.
            robot: of the same kind.
            columns: path of the TOML that says what the columns are; default, that of the same name.

        Raises:
            LogError: it cannot be used; the message says why.
        """
        description = _Description.read(columns or path.with_suffix(".toml"), robot)
        (table, stamps), findings = _table(path, description), list[str]()
        for column in description.columns:
            if column.name not in table:
                raise LogError(f"{path} has no column {column.name!r}; it has {', '.join(map(repr, table))}")
        values = {c.quantity: _numbers(path, c.name, table[c.name], findings) * c.factor for c in description.columns}
        count = len(next(iter(values.values())))
        if stamps is not None:
            t = stamps
        else:
            t = values.pop("time") if description.rate is None else np.arange(count) / description.rate
        kept = _rows_in_time(path, t, findings)
        t, growing, restarts = _clock(t[kept], findings)
        t, values = t[growing], {name: column[kept][growing] for name, column in values.items()}
        if len(t) < 2 or t[-1] - t[0] < _LEAST_SECONDS:
            raise LogError(
                f"{path} holds {0.0 if len(t) < 2 else t[-1] - t[0]:.3g} s; give a log of at least {_LEAST_SECONDS:g} s"
            )
        names = tuple(name for name in Readings.readable(robot) if name in values)
        of = description.by_quantity
        for name, column in values.items():
            _check_column(path, of[name].name, column)
            _remove_glitches(of[name].name, t, column, findings)
        y = np.column_stack([values[name] for name in names])
        commands = np.column_stack([values[name] for name in Readings.commanded(robot)])
        delays, windows = (tuple(getattr(of[name], each) for name in names) for each in ("delay", "window"))
        guessed = np.where(np.isfinite(commands), 0.0, np.nanstd(commands, axis=0))
        commands = np.column_stack([_filled(column) for column in commands.T])
        readings = Readings(names, t, y, commands, delays, restarts, guessed if guessed.any() else None, windows)
        return cls(path, description, readings, tuple(findings))

    @staticmethod
    def write(readings: Readings, path: Path, full: float | None = None) -> Path:
        """Writes readings as CSV in SI units, with a line of names, and the TOML of its columns; returns the path.

        Args:
            readings: what is written.
            path: of the CSV file.
            full: the command of the full force of the drive, N, where it is known.
        """
        units = readings.units
        ages = {
            key: dict(zip(readings.names, getattr(readings, f"{key}s"), strict=False)) for key in ("delay", "window")
        }
        table = np.column_stack([readings.t, readings.y, readings.commands])
        rows = [",".join(f"{value:.9g}" for value in row) for row in table.tolist()]
        lines = []
        for name, unit in ({"time": "s"} | units).items():
            lines += [f"[columns.{name}]", f'quantity = "{name}"', f'unit = "{unit}"']
            lines += [f"{key} = {age[name]!r}" for key, age in ages.items() if age.get(name)]
            lines += [f"full = {full!r}"] if full and name.startswith("command") else []
            lines += [""]
        files.write(path.with_suffix(".toml"), "\n".join(lines))
        return files.write(path, "\n".join([",".join(["time", *units]), *rows]) + "\n")


def _table_entries(path: Path, content: dict[str, Any], names: list[str]) -> tuple[Any, ...]:
    """separator, names, rate and format of a table whose columns hold quantities of these names."""
    if "stamps" in content:
        raise LogError(f"{path}: stamps is for ROS bags, whose columns have topic and field")
    rate = content.get("rate")
    if ("time" in names) == (rate is not None):
        raise LogError(f"{path}: give either a column with quantity = 'time', or rate, in Hz")
    if rate is not None and not (isinstance(rate, int | float) and 1 <= rate <= 1e5):
        raise LogError(f"{path}: rate must be a number of Hz, not {rate!r}")
    separator, header, kind = content.get("separator", ","), content.get("names", ()), content.get("format", "table")
    if not (isinstance(separator, str) and len(separator) == 1):
        raise LogError(f"{path}: separator must be one character, not {separator!r}")
    if not all(isinstance(name, str) for name in header):
        raise LogError(f"{path}: names must be a list of names, not {header!r}")
    if kind not in _FORMATS:
        raise LogError(f"{path}: format must be one of {', '.join(map(repr, _FORMATS))}, not {kind!r}")
    return separator, tuple(header), None if rate is None else float(rate), kind


def _bag_entries(path: Path, content: dict[str, Any], names: list[str]) -> tuple[Any, ...]:
    """The same of a ROS bag, and whether its messages are of the time at which they were recorded."""
    if wrong := [key for key in _OF_TABLES if key in content]:
        raise LogError(f"{path}: {wrong[0]} is for tables; the columns here have topic and field, as for a ROS bag")
    if "time" in names:
        raise LogError(f"{path}: leave out the column of time; the messages of a ROS bag have their own")
    stamps = content.get("stamps", "header")
    if stamps not in _STAMPS:
        raise LogError(f"{path}: stamps must be one of {', '.join(map(repr, _STAMPS))}, not {stamps!r}")
    return ",", (), None, "table", stamps == "received"


def _column(place: str, name: str, given: dict[str, Any], robot: Ballbot) -> _Column:
    """A column as the TOML describes it."""
    if unknown := set(given) - _FIELDS:
        raise LogError(f"{place}: unknown entry {min(unknown)!r}; known: {', '.join(sorted(_FIELDS))}")
    quantity, unit = given.get("quantity"), given.get("unit")
    own = Readings.readable(robot) | {"time": "s"}
    if quantity not in (*own, *Readings.commanded(robot)):
        raise LogError(
            f"{place}: unknown quantity {quantity!r}; known: {', '.join((*own, *Readings.commanded(robot)))}"
        )
    numbers = {key: given.get(key, 1.0) for key in ("sign", "scale", "full", "torque_constant")} | {
        key: given.get(key, 0.0) for key in ("delay", "window")
    }
    for key, value in numbers.items():
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9:
            raise LogError(f"{place}: {key} must be a number, not {value!r}")
    if (
        numbers["sign"] not in (-1, 1)
        or numbers["scale"] <= 0
        or numbers["full"] <= 0
        or numbers["torque_constant"] <= 0
        or numbers["window"] < 0
    ):
        raise LogError(
            f"{place}: sign must be 1 or -1, scale, full and torque_constant must be positive, and window at least 0"
        )
    if quantity in Readings.commanded(robot):
        factor = _command_factor(place, unit, given, robot)
    else:
        known = _UNITS[own[quantity]]
        if unit not in known:
            raise LogError(f"{place}: unit of {quantity} must be one of {', '.join(map(repr, known))}, not {unit!r}")
        factor = known[unit]
    topic, part = (given.get(key, "") for key in ("topic", "field"))
    if not (isinstance(topic, str) and isinstance(part, str) and bool(topic) == bool(part)):
        raise LogError(f"{place}: topic and field must be names, and both are needed for a ROS bag")
    factor *= numbers["sign"] * numbers["scale"]
    return _Column(name, quantity, factor, float(numbers["delay"]), float(numbers["window"]), topic, part)


def _command_factor(place: str, unit: Any, given: dict[str, Any], robot: Ballbot) -> float:
    """N of the robot's action for a unit of a command."""
    if unit not in _COMMAND_UNITS:
        raise LogError(
            f"{place}: unit of a command must be one of {', '.join(map(repr, _COMMAND_UNITS))}, not {unit!r}"
        )
    for needs, names in (("A", ("torque_constant", "full")), ("pwm", ("full",))):
        if unit == needs and not set(names) & set(given):
            raise LogError(f"{place}: commands in {unit!r} need {' or '.join(names)}")
    if (
        "full" in given
    ):  # so that the command is right for a robot whose drive is stronger than it was thought to be, too
        return robot.force_limit / given["full"]
    lever = robot.wheel_radius or robot.ball_radius
    return {"N": 1.0, "N m": 1 / lever, "A": given.get("torque_constant", 1.0) / lever}[unit]


def _table(path: Path, description: _Description) -> tuple[dict[str, Any], np.ndarray | None]:
    """The columns of a file by name, as text or numbers, and the times of their rows, s, where the file has them apart."""
    if description.is_bag:
        sources = {
            column.name: _Source(column.topic, column.field, column.quantity, column.quantity.startswith("command"))
            for column in description.columns
        }
        t, table = _bag(path, sources, description.received)
        return table, t
    if path.is_dir():
        raise LogError(f"{path} is a folder; the columns of a ROS bag need topic and field in their description")
    if description.format == "kugle":
        return _kugle(path), None
    if path.suffix == ".parquet":
        return _parquet(path), None
    return _text(path, description.separator, description.names), None


def _numbers(path: Path, name: str, cells: Any, findings: list[str]) -> np.ndarray:
    """(n,) the cells of a column; NaN where there is no number."""
    values, wrong = np.full(len(cells), np.nan), []
    for i, cell in enumerate(cells):
        try:
            values[i] = float(cell)
        except (TypeError, ValueError):
            wrong.append(i)
    values[~np.isfinite(values)] = np.nan
    if len(wrong) > _LEAST_SHARE * len(cells):
        raise LogError(f"{path}: column {name!r} holds no numbers, but {cells[wrong[0]]!r} for example")
    if wrong:
        first = f"{cells[wrong[0]]!r} in row {wrong[0] + 1}"
        findings.append(
            f"column {name!r}: {_counted(len(wrong), 'cell')} without a number, the first {first}; left out"
        )
    return values


def _rows_in_time(path: Path, t: np.ndarray, findings: list[str]) -> np.ndarray:
    """Indices of the rows that have a time, without those where the clock goes back."""
    known = np.flatnonzero(np.isfinite(t))
    if len(known) < 2 or (dt := float(np.median(np.diff(t[known])))) <= 0:
        raise LogError(f"{path}: the column of time does not grow; is it the time?")
    before = np.maximum.accumulate(np.concatenate([[-np.inf], t[known][:-1]]))
    back = t[known] < before - dt
    kept = known[~back]
    if len(kept) < _LEAST_SHARE * len(t):
        raise LogError(f"{path}: the time grows in {len(kept)} of {len(t)} rows only; is that column the time?")
    if len(known) < len(t):
        findings.append(f"time: {_counted(len(t) - len(known), 'row')} without a time; left out")
    if back.any():
        first, rows = known[back][0], _counted(int(back.sum()), "row")
        findings.append(f"time: the clock goes back in {rows}, the first row {first + 1} at {t[first]:.3f} s; left out")
    return kept


def _clock(t: np.ndarray, findings: list[str]) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """The times of readings on their clock, which of them grow, and the indices of the first readings after gaps.

    Stamps that jitter about a regular clock, without moving away from it, were written late and not measured late. Then the
    regular clock is taken.
    """
    steps = np.diff(t)
    dt = float(np.median(steps))
    after = np.flatnonzero(steps > _GAP * dt) + 1
    if len(after):
        shown = ", ".join(f"{steps[i - 1]:.3f} s at {t[i - 1]:.3f} s" for i in after[:_EXAMPLES])
        findings.append(f"time: {_counted(len(after), 'gap')}: {shown}; the filter starts again after each")
    regular, jitter, apart = t.copy(), [], []
    for first, last in zip([0, *after], [*after, len(t)], strict=True):
        if last - first > 2:
            line = np.polyfit(np.arange(last - first), t[first:last], 1)
            regular[first:last] = np.polyval(line, np.arange(last - first))
            jitter.append(np.diff(t[first:last]) - line[0])
            apart.append(t[first:last] - regular[first:last])
    jitter, apart = (float(np.std(np.concatenate(parts))) for parts in (jitter, apart))
    if jitter > _JITTER * dt:
        text = (
            f"time: the clock of {1 / dt:.4g} Hz jitters: the times between readings have a standard deviation of "
            f"{1e3 * jitter:.2g} ms"
        )
        if apart < jitter:  # of independent errors of stamps it is jitter / √2, and of steps that add up far more
            findings.append(f"{text}; the stamps stay about a regular clock, which is used instead")
            t = regular
        else:
            findings.append(f"{text}; readings are taken at their stamps")
    growing = t > np.maximum.accumulate(np.concatenate([[-np.inf], t[:-1]]))
    starts = np.cumsum(growing)[after] - 1
    return t, growing, tuple(starts.tolist())


def _check_column(path: Path, name: str, values: np.ndarray) -> None:
    """Raises a LogError for a column that says nothing."""
    read = values[np.isfinite(values)]
    if len(read) < _LEAST_SHARE * len(values):
        raise LogError(f"{path}: column {name!r} has readings in {len(read)} of {len(values)} rows only; leave it out")
    if np.ptp(read) == 0:
        raise LogError(f"{path}: column {name!r} is always {read[0]:g} in SI units; leave it out of the description")


def _remove_glitches(name: str, t: np.ndarray, values: np.ndarray, findings: list[str]) -> None:
    """Replaces readings that their neighbours contradict by NaN, the worst of each neighbourhood first."""
    read, glitches = values.copy(), list[int]()
    for _ in range(_GLITCH_ROUNDS):
        error = _contradictions(values)
        typical = 1.4826 * float(np.median(error[error > 0])) if (error > 0).any() else 0.0
        around = np.lib.stride_tricks.sliding_window_view(np.pad(error, 2), 5).max(axis=1)
        half = _NEARBY // 2
        worst = [
            int(i)
            for i in np.flatnonzero((error > _FAR * typical) & (error == around))
            if error[i] > _FAR_HERE * 1.4826 * np.median(error[max(i - half, 0) : i + half + 1])
        ]
        if not worst:
            break
        values[worst] = np.nan
        glitches += worst
    if glitches:
        glitches.sort()
        shown = ", ".join(f"{read[i]:.3g} at {t[i]:.3f} s" for i in glitches[:_EXAMPLES])
        share = f"{_counted(len(glitches), 'glitch', 'es')} ({len(glitches) / len(values):.2%})"
        findings.append(f"column {name!r}: {share}, in SI units {shown}; left out")


def _counted(count: int, what: str, ending: str = "s") -> str:
    return f"{count} {what}{ending if count != 1 else ''}"


def _contradictions(values: np.ndarray) -> np.ndarray:
    """(n,) how far each reading is from what its neighbours say; 0 where it or they are missing.

    They say it three times: as their mean, and along the line of the two before and of the two after. The median of these is
    right where one neighbour is a glitch itself.
    """
    padded = np.concatenate([[np.nan] * 2, values, [np.nan] * 2])
    far_before, before, after, far_after = padded[:-4], padded[1:-3], padded[3:-1], padded[4:]
    guesses = np.stack([(before + after) / 2, 2 * before - far_before, 2 * after - far_after])
    known, error = np.isfinite(values) & np.isfinite(guesses).any(axis=0), np.zeros(len(values))
    error[known] = np.abs(values[known] - np.nanmedian(guesses[:, known], axis=0))
    return error


def _filled(values: np.ndarray) -> np.ndarray:
    """Commands, with those that are missing between their neighbours."""
    known = np.flatnonzero(np.isfinite(values))
    return np.interp(np.arange(len(values)), known, values[known])
