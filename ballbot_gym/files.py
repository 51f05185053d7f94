"""Writes files so that a reader never sees half of one."""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def write(path: str | Path, content: bytes | str) -> Path:
    """Writes content under a temporary name in the same folder, made if missing, and renames it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Path:
    """Writes arrays as a compressed .npz, the same bytes for the same arrays."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]  # no array is called allow_pickle
    return write(path, buffer.getvalue())


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> Path:
    """Writes one line for each row under a line of column names; columns default to the keys of the first row."""
    text = io.StringIO()
    names = list(columns or (rows[0] if rows else ()))
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return write(path, text.getvalue())
