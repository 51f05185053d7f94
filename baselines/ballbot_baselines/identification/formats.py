"""Reads files of logs as tables with named columns: text, Parquet, Kugle's dumps, and ROS bags.

Kugle writes a dump as text with tabs and without a line of names: 50 columns in NAME.txt, and 33 columns about its sensors in
sensor/NAME.txt. The rows of both belong together where their times are equal.

A ROS bag has messages on topics at times of their own. The rows of its table are the messages of one topic. Readings of
other topics belong to the row that is nearest in time, and are interpolated between two messages to the time of this row. A
command is its mean over the time from its row to the next, where each message holds until the next one.
"""

import csv
import io
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ballbot_gym import files
from ballbot_gym.lazy import imports_of

_KUGLE = {
    "time": 1, "accelerometer": 3, "gyroscope": 3, "magnetometer": 3, "position": 2, "q": 4, "velocity": 2, "dq": 4,
    "gyro_bias": 3, "com": 3, "wheel_slip": 1, "q_ref": 4, "omega_ref": 3, "velocity_ref": 2, "tilt_integral": 4,
    "slip_gain": 1, "s": 3, "compute_time": 1, "torque": 3,
}  # fmt: skip
"""Names of what a dump of Kugle holds, in order, with the number of columns of each."""
_KUGLE_SENSORS = {
    "time": 1, "raw_accelerometer": 3, "raw_gyroscope": 3, "raw_magnetometer": 3, "encoder_angle": 3,
    "torque_delivered": 3, "mti_q": 4, "mti_dq": 4, "mti_accelerometer": 3, "mti_gyroscope": 3, "mti_magnetometer": 3,
}  # fmt: skip
"""The same of its file in the folder sensor."""
_SPATIAL = ("accelerometer", "gyroscope", "magnetometer", "position", "velocity", "bias", "com", "omega_ref", "_ref")
"""Ends of names whose columns are along x, y and z; others are numbered from 1."""
_ATTITUDES = ("lean_x", "lean_y", "heading")
_FIELD = re.compile(r"(\w+)(?:\[([^\]]+)\])?")
_APART = 0.1  # s between clocks of topics, above which they are not the same clock
_NANOSECONDS = 1e9


class LogError(files.FileError):
    """A log that cannot be used; the message names the file, and the column where there is one."""


class _Source(NamedTuple):
    """Where a column of a ROS bag is found."""

    topic: str
    field: str
    """Such as angular_velocity.x, position[0], or velocity[wheel_1] of a joint by its name."""
    quantity: str
    held: bool
    """Whether a message holds until the next one, as commands do."""


class _Series(NamedTuple):
    """What one column has in a bag."""

    t: np.ndarray
    """(n,) ns, not decreasing."""
    values: np.ndarray
    """(n,) in the unit of the file."""


def _text(path: Path, separator: str, names: tuple[str, ...]) -> dict[str, Any]:
    """The columns of a text file by name, as text."""
    try:
        text = files.read(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise LogError(f"{path} is not text; give a CSV or Parquet file, or a ROS bag") from None
    if separator == " ":
        rows = [line.split() for line in text.splitlines()]
    else:
        rows = list(csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=True))
    rows = [row for row in rows if row and not row[0].startswith("#")]
    names = tuple(names) or tuple(name.strip() for name in (rows.pop(0) if rows else []))
    if not rows:
        raise LogError(f"{path} holds no readings")
    if wrong := [i for i, row in enumerate(rows) if len(row) != len(names)]:
        if len(wrong) > len(rows) / 2:
            raise LogError(
                f"{path}: rows have {len(rows[wrong[0]])} values for {len(names)} names; is the separator {separator!r}?"
            )
        rows = [row if len(row) == len(names) else [*row, *[""] * len(names)][: len(names)] for row in rows]
    return dict(zip(names, zip(*rows, strict=True), strict=False))


def _parquet(path: Path) -> dict[str, Any]:
    """The columns of a Parquet file by name."""
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


def _kugle(path: Path) -> dict[str, Any]:
    """The columns of a dump of Kugle, of the file about its sensors if there is one, and the leans of its quaternions."""
    table = _dump(path, _KUGLE)
    of_sensors = path.parent / "sensor" / path.name
    if of_sensors.exists():
        sensed = _dump(of_sensors, _KUGLE_SENSORS)
        _, own, other = np.intersect1d(table["time"], sensed["time"], return_indices=True)
        if len(own) < min(len(table["time"]), len(sensed["time"])) / 2:
            raise LogError(f"{path} and {of_sensors} have other times, so they are not of the same dump")
        table = {name: column[own] for name, column in table.items()}
        table |= {name: column[other] for name, column in sensed.items() if name != "time"}
    for prefix in ("", "mti_"):
        if f"{prefix}q_1" in table:
            turned = np.stack([table[f"{prefix}q_{i}"] for i in (1, 2, 3, 4)])
            found = zip(_ATTITUDES, _attitude(turned), strict=True)
            table |= {f"{prefix}{name}": values for name, values in found}
    return table


def _dump(path: Path, names: Mapping[str, int]) -> dict[str, np.ndarray]:
    """The columns of one of Kugle's files; rows that were not written to their end are left out."""
    count = sum(names.values())
    try:
        lines = [line.split() for line in files.read(path).decode().splitlines()]
        whole = [[float(cell) for cell in line] for line in lines if len(line) == count]
    except ValueError as error:
        raise LogError(f"{path} is no dump of Kugle: {error}") from None
    if len(whole) < len(lines) - 1 or not whole:  # of the last row a part may be missing
        other = next((len(line) for line in lines if len(line) != count), 0)
        raise LogError(f"{path} is no dump of Kugle: its rows have {other} columns and not {count}")
    columns, found, first = np.array(whole).T, dict[str, np.ndarray](), 0
    for name, width in names.items():
        marks = "xyz" if name.endswith(_SPATIAL) and width < 4 else "1234"
        for i in range(width):
            found[name if width == 1 else f"{name}_{marks[i]}"] = columns[first + i]
        first += width
    return found


def _attitude(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """γ, θ and ψ (n,), rad, of quaternions (4, n) with the real part first; ψ without jumps."""
    with np.errstate(all="ignore"):  # of quaternions that are 0, where there is no attitude
        w, x, y, z = q / np.linalg.norm(q, axis=0)
    upright = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)  # the body's axis
    gamma, theta = np.arctan2(upright[0], upright[2]), np.arcsin(np.clip(upright[1], -1.0, 1.0))
    ahead = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)  # the body's x axis
    along = np.cos(gamma) * ahead[0] - np.sin(gamma) * ahead[2]
    across = np.cos(theta) * ahead[1] - np.sin(theta) * (np.sin(gamma) * ahead[0] + np.cos(gamma) * ahead[2])
    psi, known = np.arctan2(across, along), np.isfinite(w)
    psi[known] = np.unwrap(psi[known])
    return gamma, theta, psi


def _bag(
    path: Path, sources: Mapping[str, _Source], received: bool = False
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The times (n,), s, and the columns by name of a ROS bag.

    Args:
        path: of a folder that ROS 2 wrote, of its MCAP or SQLite file, or of a bag of ROS 1.
        sources: what each column is.
        received: whether messages are of the time at which they were recorded; otherwise of that in their header, where
            they have one.
    """
    series = {name: _sorted(each) for name, each in _messages(path, sources, received).items()}
    sensed = [name for name, source in sources.items() if not source.held]
    clock = np.unique(series[max(sensed, key=lambda name: len(series[name].t))].t)
    first, last = (pick(each.t[i] for each in series.values()) for pick, i in ((max, 0), (min, -1)))
    clock = clock[(clock >= first) & (clock <= last)]  # where every topic has messages
    if len(clock) < 2:
        raise LogError(f"{path} has no time in which all of its topics have messages")
    begin = clock[0]
    t = (clock - begin) / _NANOSECONDS
    resample = {True: _held, False: _nearest}
    columns = {
        name: resample[sources[name].held](t, (each.t - begin) / _NANOSECONDS, each.values)
        for name, each in series.items()
    }
    return t, columns


def _sorted(series: _Series) -> _Series:
    order = np.argsort(series.t, kind="stable")
    return _Series(series.t[order], series.values[order])


def _nearest(t: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n,) readings at rows t (n,) of messages at times `known` (m,), s; NaN in rows that are nearest to no message."""
    out = np.full(len(t), np.nan)
    after = np.clip(np.searchsorted(t, known), 1, len(t) - 1)
    rows = np.where(known - t[after - 1] < t[after] - known, after - 1, after)
    rows = np.unique(rows[np.abs(known - t[rows]) < np.median(np.diff(t))])
    out[rows] = np.interp(t[rows], known, values)
    return out


def _held(t: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n,) means over the time from each row to the next of commands that hold; NaN before the first of them."""
    ends = np.append(t, 2 * t[-1] - t[-2])
    total = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(known))])
    last = np.clip(np.searchsorted(known, ends, side="right") - 1, 0, len(known) - 1)
    sums = total[last] + values[last] * (ends - known[last])
    return np.where(t < known[0], np.nan, np.diff(sums) / np.diff(ends))


def _messages(path: Path, sources: Mapping[str, _Source], received: bool) -> dict[str, _Series]:
    """What the messages of a bag say of each column."""
    with imports_of(f"reading the ROS bag {path}", "logs"):
        from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]
        from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]
    times, values = ({name: [] for name in sources} for _ in range(2))
    offsets: dict[str, list[int]] = {}
    whole = path.parent if path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").exists() else path
    try:
        with AnyReader([whole], default_typestore=get_typestore(Stores.LATEST)) as reader:
            topics = {source.topic for source in sources.values()}
            if lacking := topics - {each.topic for each in reader.connections}:
                found = ", ".join(sorted(f"{each.topic!r} ({each.msgtype})" for each in reader.connections))
                raise LogError(f"{path} has no topic {min(lacking)!r}; it has {found}")
            wanted = [each for each in reader.connections if each.topic in topics]
            for connection, stamp, raw in reader.messages(connections=wanted):
                message = reader.deserialize(raw, connection.msgtype)
                header = getattr(message, "header", None)
                at = stamp if received or header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
                offsets.setdefault(connection.topic, []).append(at - stamp)
                for name, source in sources.items():
                    if source.topic == connection.topic and (value := _value(path, name, source, message)) is not None:
                        times[name].append(at)
                        values[name].append(value)
    except LogError:
        raise
    except Exception as error:  # the library raises those of its storages and of its parsers
        raise LogError(f"{path} is not a ROS bag that can be read: {error}") from None
    _check_clocks(path, offsets)
    if empty := next((name for name in sources if not times[name]), None):
        source = sources[empty]
        raise LogError(f"{path}: column {empty!r}: no message of {source.topic!r} has a field {source.field!r}")
    read = {name: np.array(values[name], np.float64) for name in sources}
    for name, source in sources.items():
        if read[name].ndim == 2:
            read[name] = _attitude(read[name].T)[_ATTITUDES.index(source.quantity)]
    return {name: _Series(np.array(times[name], np.int64), read[name]) for name in sources}


def _check_clocks(path: Path, offsets: dict[str, list[int]]) -> None:
    """Raises a LogError if the stamps of the topics are of several clocks."""
    apart = {topic: float(np.median(each)) / _NANOSECONDS for topic, each in offsets.items()}
    first, last = min(apart, key=apart.__getitem__), max(apart, key=apart.__getitem__)
    if apart[last] - apart[first] > _APART:
        raise LogError(
            f"{path}: the clocks of {first!r} and {last!r} are {apart[last] - apart[first]:.3g} s apart, because the "
            'stamps in headers are not of the clock of the recording; give stamps = "received" to use that one'
        )


def _value(path: Path, name: str, source: _Source, message: Any) -> Any:
    """What a message says of a column: a number, or a quaternion; None where it does not have the joint."""
    here = message
    for part in source.field.split("."):
        found = _FIELD.fullmatch(part)
        if found is None or not hasattr(here, found[1]):
            known = ", ".join(each for each in getattr(here, "__dataclass_fields__", {}) if not each.startswith("__"))
            raise LogError(
                f"{path}: column {name!r}: {source.topic!r} has no field {source.field!r}; known: {known or 'none'}"
            )
        owner, here = here, getattr(here, found[1])
        if found[2] is not None:
            here = _entry(owner, here, found[2])
            if here is None:
                return None
    if source.quantity in _ATTITUDES and hasattr(here, "w"):
        return here.w, here.x, here.y, here.z
    if not np.isscalar(here) or isinstance(here, str):
        raise LogError(f"{path}: column {name!r}: {source.field!r} of {source.topic!r} is no number; name a part of it")
    return here


def _entry(owner: Any, values: Any, key: str) -> Any:
    """An entry of an array by its number, or by the name that the message gives it; None where it has none."""
    names: Callable[[str], int] = list(getattr(owner, "name", [])).index
    try:
        return values[int(key) if key.isdecimal() else names(key)]
    except (IndexError, ValueError):
        return None
