"""Reads and writes files: a reader never sees half of one, and no file makes a reader allocate more than it should."""

import csv
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

READ_LIMIT = 256 * 2**20
"""Bytes that a file may hold, unpacked, unless a reader says otherwise."""

_PIECE = 2**20  # bytes
_FORMULA = re.compile(r"'*[=+\-@\t\r]")


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
        if not os.path.isfile(path):  # a pipe or a device could be read for ever
            raise FileError(f"{path} is no regular file")
        with open(path, "rb") as file:
            content = _read_at_most(file, limit + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{path} cannot be read: {error}") from error
    if len(content) > limit:
        raise FileError(f"{path} is larger than {limit / 2**20:.0f} MiB, the most that is read")
    return content


def _read_at_most(file: BinaryIO, size: int) -> bytes:
    """The first bytes of a file, in pieces: read(size) takes memory for `size` bytes, however few there are."""
    pieces = []
    while size > 0 and (piece := file.read(min(size, _PIECE))):
        pieces.append(piece)
        size -= len(piece)
    return b"".join(pieces)


def read_json(path: str | Path, limit: int = READ_LIMIT) -> Any:
    """What a file of JSON holds.

    Raises:
        FileError: as `read`, or it holds no JSON.
    """
    content = read(path, limit)
    try:
        return json.loads(content)
    except RecursionError:
        raise FileError(f"{path} holds no JSON that can be read: it is nested too deeply") from None
    except ValueError as error:
        raise FileError(f"{path} holds no JSON: {error}") from error


def read_npz(path: str | Path, limit: int = READ_LIMIT) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name. Sizes are checked before anything is unpacked, and no object is loaded.

    Args:
        path: the file.
        limit: bytes of all arrays together.

    Raises:
        FileError: as `read`; or it is no .npz file, is damaged or encrypted, or its arrays are larger than `limit`.
    """
    return arrays_of(read(path, limit), path, limit)


def arrays_of(content: bytes, path: str | Path, limit: int = READ_LIMIT) -> dict[str, np.ndarray]:
    """As `read_npz`, of content that was read already; errors name the path."""
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
            names = [member.filename.removesuffix(".npy") for member in members]
            if len(set(names)) < len(names):
                raise FileError(f"{path} holds two arrays of one name")
            return {name: _array(archive.read(member)) for name, member in zip(names, members, strict=True)}
    except FileError:
        raise
    except Exception as error:  # zipfile and NumPy's headers have dozens of ways to fail, and all mean the same
        raise FileError(f"{path} is no .npz file, or a damaged one: {error}") from error


def _array(content: bytes) -> np.ndarray:
    """The array of an .npy file, whose declared size must be that of what follows."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"arrays of version {version} are not read")
    shape, fortran, dtype = readers[version](file)
    if dtype.hasobject or dtype.fields is not None:
        raise ValueError(f"an array of {dtype} is no array of numbers or text")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError(f"the declared shape {shape} of {dtype} does not fit {len(content) - file.tell()} bytes")
    array = np.frombuffer(content, dtype, offset=file.tell())
    return array.reshape(shape, order="F" if fortran else "C").copy()


def write(path: str | Path, content: bytes | str) -> Path:
    """Writes content under a temporary name in the same folder, made if missing, and renames it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        unfinished.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str) else content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def npz(arrays: Mapping[str, np.ndarray], compressed: bool = True) -> bytes:
    """Arrays as an .npz, the same bytes for the same arrays."""
    buffer, save = io.BytesIO(), np.savez_compressed if compressed else np.savez
    save(buffer, **arrays)  # pyright: ignore[reportArgumentType]  # no array is called allow_pickle
    return buffer.getvalue()


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Path:
    """Writes arrays as a compressed .npz, the same bytes for the same arrays."""
    return write(path, npz(arrays))


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> Path:
    """Writes one line for each row under a line of column names; columns default to the keys of the first row.

    Text that a spreadsheet would compute as a formula gets an apostrophe in front; `csv_text` takes it off.
    """
    text = io.StringIO()
    names = list(columns or (rows[0] if rows else ()))
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writerow({name: _csv_cell(name) for name in names})
    writer.writerows({name: _csv_cell(value) for name, value in row.items()} for row in rows)
    return write(path, text.getvalue())


def csv_text(cell: str) -> str:
    """The text that `write_csv` wrote as this cell."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def _csv_cell(value: Any) -> Any:
    if not isinstance(value, str) or not _FORMULA.match(value):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
