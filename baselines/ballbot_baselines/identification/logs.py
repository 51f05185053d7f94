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

[columns.pwm]
quantity = "command_1"   # see `Readings.commanded`
unit = "pwm"             # with full: the value at full torque; "A" with torque_constant, N·m/A; "N m"; "N"
full = 255
```

Whatever is wrong with a log is named in `Log.findings`, and readings that are wrong are left out.
"""

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

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
_FIELDS = {"quantity", "unit", "sign", "scale", "delay", "full", "torque_constant"}
_LEAST_SECONDS = 5.0
_LEAST_SHARE = 0.5  # of a column that must be readings
_GAP = 3.0  # times between readings, in median ones
_JITTER = 0.005  # of the time between readings, above which it is a finding
_FAR, _FAR_HERE = 10.0, 8.0  # typical errors of the whole log, and of those nearby: readings further off are glitches
_NEARBY = 101  # readings
_GLITCH_ROUNDS = 20
_EXAMPLES = 3


class LogError(files.FileError):
    """A log that cannot be used; the message names the file, and the column where there is one."""


@dataclass(frozen=True)
class _Column:
    """What a column of a log holds, as its TOML says."""

    name: str
    quantity: str
    factor: float
    """From the values in the file to SI units, or to a robot's action."""
    delay: float = 0.0


@dataclass(frozen=True)
class _Description:
    """What the TOML of a log says."""

    columns: tuple[_Column, ...]
    separator: str = ","
    names: tuple[str, ...] = ()
    rate: float | None = None

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
        if unknown := set(content) - {"columns", "separator", "names", "rate"}:
            raise LogError(f"{path}: unknown entry {min(unknown)!r}; known: 'columns', 'separator', 'names', 'rate'")
        given = content.get("columns")
        if not isinstance(given, dict) or not all(isinstance(each, dict) for each in given.values()):
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
        rate = content.get("rate")
        if ("time" in names) == (rate is not None):
            raise LogError(f"{path}: give either a column with quantity = 'time', or rate, in Hz")
        if rate is not None and not (isinstance(rate, int | float) and 1 <= rate <= 1e5):
            raise LogError(f"{path}: rate must be a number of Hz, not {rate!r}")
        separator, header = content.get("separator", ","), content.get("names", ())
        if not (isinstance(separator, str) and len(separator) == 1):
            raise LogError(f"{path}: separator must be one character, not {separator!r}")
        if not all(isinstance(name, str) for name in header):
            raise LogError(f"{path}: names must be a list of names, not {header!r}")
        return cls(columns, separator, tuple(header), None if rate is None else float(rate))


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
        table, findings = _table(path, description), list[str]()
        for column in description.columns:
            if column.name not in table:
                raise LogError(f"{path} has no column {column.name!r}; it has {', '.join(map(repr, table))}")
        values = {c.quantity: _numbers(path, c.name, table[c.name], findings) * c.factor for c in description.columns}
        count = len(next(iter(values.values())))
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
        delays = tuple(of[name].delay for name in names)
        guessed = np.where(np.isfinite(commands), 0.0, np.nanstd(commands, axis=0))
        commands = np.column_stack([_filled(column) for column in commands.T])
        readings = Readings(names, t, y, commands, delays, restarts, guessed if guessed.any() else None)
        return cls(path, description, readings, tuple(findings))

    @staticmethod
    def write(readings: Readings, path: Path) -> Path:
        """Writes readings as CSV in SI units, with a line of names, and the TOML of its columns; returns the path."""
        units, delays = readings.units, dict(zip(readings.names, readings.delays, strict=False))
        table = np.column_stack([readings.t, readings.y, readings.commands])
        rows = [",".join(f"{value:.9g}" for value in row) for row in table.tolist()]
        lines = []
        for name, unit in ({"time": "s"} | units).items():
            lines += [f"[columns.{name}]", f'quantity = "{name}"', f'unit = "{unit}"']
            lines += [f"delay = {delays[name]!r}", ""] if delays.get(name) else [""]
        files.write(path.with_suffix(".toml"), "\n".join(lines))
        return files.write(path, "\n".join([",".join(["time", *units]), *rows]) + "\n")


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
        "delay": given.get("delay", 0.0)
    }
    for key, value in numbers.items():
        if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9:
            raise LogError(f"{place}: {key} must be a number, not {value!r}")
    if (
        numbers["sign"] not in (-1, 1)
        or numbers["scale"] <= 0
        or numbers["full"] <= 0
        or numbers["torque_constant"] <= 0
    ):
        raise LogError(f"{place}: sign must be 1 or -1, and scale, full and torque_constant must be positive")
    if quantity in Readings.commanded(robot):
        factor = _command_factor(place, unit, given, robot)
    else:
        known = _UNITS[own[quantity]]
        if unit not in known:
            raise LogError(f"{place}: unit of {quantity} must be one of {', '.join(map(repr, known))}, not {unit!r}")
        factor = known[unit]
    return _Column(name, quantity, factor * numbers["sign"] * numbers["scale"], float(numbers["delay"]))


def _command_factor(place: str, unit: Any, given: dict[str, Any], robot: Ballbot) -> float:
    """N of the robot's action for a unit of a command."""
    if unit not in _COMMAND_UNITS:
        raise LogError(
            f"{place}: unit of a command must be one of {', '.join(map(repr, _COMMAND_UNITS))}, not {unit!r}"
        )
    for needs, name in (("A", "torque_constant"), ("pwm", "full")):
        if unit == needs and name not in given:
            raise LogError(f"{place}: commands in {unit!r} need {name}")
    lever = robot.wheel_radius or robot.ball_radius
    by_unit = {
        "N": 1.0,
        "N m": 1 / lever,
        "A": given.get("torque_constant", 1.0) / lever,
        "pwm": robot.force_limit / given.get("full", 1.0),
    }
    return by_unit[unit]


def _table(path: Path, description: _Description) -> dict[str, Any]:
    """The columns of a file by name, as text or numbers."""
    if path.suffix == ".parquet":
        return _parquet(path)
    try:
        text = files.read(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise LogError(f"{path} is not text; give a CSV or Parquet file") from None
    if description.separator == " ":
        rows = [line.split() for line in text.splitlines()]
    else:
        rows = list(csv.reader(io.StringIO(text), delimiter=description.separator, skipinitialspace=True))
    rows = [row for row in rows if row and not row[0].startswith("#")]
    names = list(description.names) or [name.strip() for name in (rows.pop(0) if rows else [])]
    if not rows:
        raise LogError(f"{path} holds no readings")
    if wrong := [i for i, row in enumerate(rows) if len(row) != len(names)]:
        if len(wrong) > len(rows) / 2:
            raise LogError(
                f"{path}: rows have {len(rows[wrong[0]])} values for {len(names)} names; is the separator "
                f"{description.separator!r}?"
            )
        rows = [row if len(row) == len(names) else [*row, *[""] * len(names)][: len(names)] for row in rows]
    return dict(zip(names, zip(*rows, strict=True), strict=False))


def _parquet(path: Path) -> dict[str, Any]:
    try:
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise LogError(f"{path}: reading Parquet needs pyarrow: pip install pyarrow; or give a CSV file") from None
    content = io.BytesIO(files.read(path))
    try:
        table = parquet.read_table(content)
    except (OSError, ValueError) as error:
        raise LogError(f"{path} is not a valid Parquet file: {error}") from None
    return {name: table.column(name).to_numpy() for name in table.column_names}


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
