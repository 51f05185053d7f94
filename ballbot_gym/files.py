"""Reads and writes files: a reader never sees half of one, and no file makes a reader allocate more than it should."""

import csv
import io
import json
import math
import os
import re
import secrets
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from ballbot_gym.checks import real_array

READ_LIMIT = 256 * 2**20
"""Bytes that a file may hold, unpacked, unless a reader says otherwise."""

JSON_LIMIT = 2**26
"""Bytes of JSON that are read, unless a reader says otherwise: as Python's objects they take up to 24 times as much."""

_PIECE = 2**20  # bytes
_FORMULA = re.compile(r"'*[=+\-@\t\r]")
_MOST_MEMBERS = 10_000  # of an archive; zipfile makes an object of each before it says how many there are


class FileError(ValueError):
    """A file that is missing, too large, or not what it should be; the message names it."""


def read(path: str | Path, limit: int = READ_LIMIT) -> bytes:
    """The content of a regular file.

    Raises:
        FileError: it is missing, no regular file, not readable, or larger than `limit` bytes.
    """
    try:
        if not os.path.exists(path):
            raise FileError(f"{path}: no such file")
        if not os.path.isfile(path):  # reading a pipe or a device may never end
            raise FileError(f"{path} is not a regular file")
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            content = b"" if size > limit else _read_at_most(file, limit + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{path} cannot be read: {error}") from error
    if max(size, len(content)) > limit:
        raise FileError(f"{path} is larger than {limit / 2**20:.0f} MiB, the most that is read")
    return content


def _read_at_most(file: IO[bytes], size: int) -> bytes:
    """The first bytes of a file, in pieces: read(size) takes memory for `size` bytes, however few there are."""
    pieces = []
    while size > 0 and (piece := file.read(min(size, _PIECE))):
        pieces.append(piece)
        size -= len(piece)
    return b"".join(pieces)


def read_json(path: str | Path, limit: int = JSON_LIMIT, content: bytes | None = None, kind: type = dict) -> Any:
    """The object, or what else of JSON, that a file holds, whose content may have been read already; errors name the path.

    Raises:
        FileError: as `read`, or it holds no JSON of that kind.
    """
    content = read(path, limit) if content is None else content
    if len(content) > limit:
        raise FileError(f"{path} holds more than {limit / 2**20:.0f} MiB of JSON, the most that is read")
    try:
        held = json.loads(content)
    except RecursionError:
        raise FileError(f"{path} holds no JSON that can be read: it is nested too deeply") from None
    except ValueError as error:
        raise FileError(f"{path} is not valid JSON: {error}") from error
    if not isinstance(held, kind):
        raise FileError(f"{path} holds no {'object' if kind is dict else kind.__name__} of JSON")
    return held


def read_npz(path: str | Path, limit: int = READ_LIMIT, content: bytes | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name. Sizes are checked before anything is unpacked, and no object is loaded.

    Args:
        path: the file.
        limit: bytes of all arrays together.
        content: of the file, if it was read already; errors name the path.

    Raises:
        FileError: as `read`; or it is no .npz file, is damaged or encrypted, or its arrays are larger than `limit`.
    """
    content = read(path, limit) if content is None else content
    members = unzipped(content, path, limit, ".npz file")
    read_array = np.lib.format.read_array  # it loads no objects, and fails where an array is shorter than it says
    try:
        return {name.removesuffix(".npy"): read_array(io.BytesIO(array)) for name, array in members.items()}
    except Exception as error:  # NumPy's headers have dozens of ways to fail, and all mean the same
        raise FileError(f"{path} is not a valid .npz file: {error}") from error


def unzipped(content: bytes, path: str | Path, limit: int = READ_LIMIT, kind: str = "zip archive") -> dict[str, bytes]:
    """The members of a zip archive by name. What they declare is checked before any is unpacked, and holds.

    Args:
        content: of the archive.
        path: and kind: what errors call it.
        limit: bytes of all members together.

    Raises:
        FileError: it is none, is damaged or encrypted, or has too many members or too large ones.
    """
    if content.count(b"PK\1\2") > _MOST_MEMBERS:
        raise FileError(f"{path} holds more than {_MOST_MEMBERS} files, the most that are read")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            if total > limit:
                raise FileError(f"{path} unpacks to {total / 2**20:.0f} MiB; at most {limit / 2**20:.0f} MiB are read")
            for member in members:
                if member.flag_bits & 1:
                    raise FileError(f"{path}: {member.filename} is encrypted; write it without a password")
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise FileError(
                        f"{path}: {member.filename} is compressed by method {member.compress_type}; use numpy.savez"
                    )
            if len({member.filename for member in members}) < len(members):
                raise FileError(f"{path} holds two files of one name")
            unpacked = {}
            for member in members:
                with archive.open(member) as file:  # archive.read() would unpack all that follows, whatever is declared
                    unpacked[member.filename] = _read_at_most(file, member.file_size)
            return unpacked
    except FileError:
        raise
    except Exception as error:  # zipfile has dozens of ways to fail, and all mean the same
        raise FileError(f"{path} is not a valid {kind}: {error}") from error


def numbers(value: Any, what: str, shape: tuple[int, ...] | None = None, most: float = math.inf) -> np.ndarray:
    """value as a float64 array, if it holds real numbers, all finite and within ±most. `what` is its name in messages.

    Whole numbers are real. Complex numbers, truth values, text and whole numbers of more than 64 bits are not.

    Raises:
        ValueError: it holds something else, or is of another shape than `shape`.
    """
    array = real_array(value, what).astype(np.float64, copy=False)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{what} has the shape {array.shape}, and not {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite numbers, and it holds NaN or infinity")
    if (np.abs(array) > most).any():
        raise ValueError(f"{what} must be numbers within ±{most:g}")
    return array


def write(path: str | Path, content: bytes | str) -> Path:
    """Writes content under a temporary name in the same folder, made if missing, and renames it.

    Raises:
        FileError: a device, a pipe or a folder has this name, which a file would replace.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise FileError(f"{path} is not a regular file, so it is not replaced; give another path")
    path.parent.mkdir(parents=True, exist_ok=True)
    # The name cannot be guessed, and the file must be new. Otherwise another user's link could lead to another file.
    unfinished = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.tmp")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    try:
        with open(os.open(unfinished, flags, 0o666), "wb") as file:
            file.write(content.encode(errors="backslashreplace") if isinstance(content, str) else content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def npz(arrays: Mapping[str, np.ndarray], compressed: bool = True) -> bytes:
    """Arrays as an .npz, the same bytes for the same arrays."""
    buffer, save = io.BytesIO(), np.savez_compressed if compressed else np.savez
    save(buffer, **arrays)  # pyright: ignore[reportArgumentType]  # no array is called allow_pickle
    return buffer.getvalue()


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Writes one line for each row under a line of column names, the keys of the first row.

    Text that a spreadsheet would compute as a formula gets an apostrophe in front.
    """
    text = io.StringIO()
    names = list(rows[0] if rows else ())
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writerow({name: _csv_cell(name) for name in names})
    writer.writerows({name: _csv_cell(value) for name, value in row.items()} for row in rows)
    return write(path, text.getvalue())


def _csv_cell(value: Any) -> Any:
    if not isinstance(value, str) or not _FORMULA.match(value):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
