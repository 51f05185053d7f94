"""Data sets of any size as shards: .npz files of some hundred episodes, in a folder or on object storage.

A set is a folder of this machine, or of storage that fsspec supports: runs/set, s3://BUCKET/set or gs://BUCKET/set, say.

| file | holds |
|---|---|
| shard-000000.npz, … | the arrays of some hundred episodes, one after another |
| manifest.json | what the set was made from, and of every finished shard its file, episodes, bytes and SHA-256 |

The manifest names a shard after its file is there. So the manifest lists complete shards only, and a resumed
run makes the others. A reader holds one shard in memory, and checks its digest.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import files
from ballbot_gym.lazy import imports_of
from ballbot_train.work import jobs
from ballbot_train.work.console import progress_bars
from ballbot_train.work.executors import Workers, completed

with imports_of(__name__):
    import fsspec
    from fsspec.implementations.local import LocalFileSystem

EPISODES = 500
"""Episodes of a shard."""

MANIFEST = "manifest.json"
_CHUNK = 5  # episodes that a worker makes at a time
_LIMIT = 2**32  # bytes of a shard, unpacked
_DENSEST = 8  # bytes that a byte of a shard may unpack to: those written here are not compressed
_MOST = 1_000_000  # shards, and episodes of each
_STORAGE = ("file", "local", "memory", "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl", "oss", "oci", "hf")
_STORAGE += ("http", "https", "sftp", "ssh", "hdfs", "webhdfs")
"""Of fsspec's schemes those of storage. Others unpack, cache or combine what yet other addresses hold."""
_VERSION = 1

Arrays = Mapping[str, np.ndarray]


class Shards:
    """A set of shards, to read or to add to."""

    def __init__(self, url: str | Path):
        """Reads the manifest, if there is one.

        Raises:
            FileError: the manifest is damaged, or nothing can be read there.
        """
        self.url = str(url).rstrip("/")
        self.about: dict[str, Any] | None = None
        """What the set was made from; None where there is none yet."""
        self._shards: dict[int, dict[str, Any]] = {}
        try:
            self._files, self._root = _place_of(self.url)
            text = self._content(MANIFEST, files.JSON_LIMIT)
        except FileNotFoundError:
            return
        except (ImportError, ValueError, OSError) as error:
            raise files.FileError(f"{self.url} cannot be read: {error}") from error
        try:
            manifest = files.read_json(MANIFEST, content=text)
            if manifest["version"] != _VERSION:
                raise ValueError(f"version {manifest['version']}")
            self.about = dict(manifest["about"])
            for i, shard in manifest["shards"].items():
                known = {"episodes": int(shard["episodes"]), "sha256": str(shard["sha256"])}
                if not (0 <= int(i) <= _MOST and 0 <= known["episodes"] <= _MOST):
                    raise ValueError(f"shard {i:.20} of {known['episodes']} episodes, and at most {_MOST} are possible")
                self._shards[int(i)] = shard | known
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise files.FileError(f"{self.url}/{MANIFEST} is damaged ({error!r}); make the set again") from error

    @staticmethod
    def is_at(path: str | Path) -> bool:
        """Whether a path is the URL or the folder of a set."""
        return "://" in str(path) or (Path(path) / MANIFEST).is_file()

    @property
    def numbers(self) -> list[int]:
        """Of the finished shards, in order."""
        return sorted(self._shards)

    @property
    def episodes(self) -> int:
        """Of all finished shards."""
        return sum(shard["episodes"] for shard in self._shards.values())

    def has(self, number: int, episodes: int) -> bool:
        """Whether a shard is finished, with this number of episodes."""
        return number in self._shards and self._shards[number]["episodes"] == episodes

    def read(self, number: int) -> dict[str, np.ndarray]:
        """The arrays of a shard.

        Raises:
            FileError: the shard is missing, or is not the one of the manifest.
        """
        path = f"{self.url}/{_name(number)}"
        try:
            content = self._content(_name(number), _LIMIT)
        except (OSError, files.FileError) as error:
            raise files.FileError(f"{path} cannot be read: {error}") from error
        if hashlib.sha256(content).hexdigest() != self._shards[number]["sha256"]:
            raise files.FileError(f"{path} is not the file that {MANIFEST} names; delete both, and make the set again")
        return files.read_npz(path, min(_LIMIT, _DENSEST * len(content)), content)

    def _content(self, name: str, limit: int) -> bytes:
        """Of a file of the set. Raises a FileError where it is larger than `limit` bytes."""
        path = f"{self._root}/{name}"
        if (self._files.size(path) or 0) > limit:  # some storage does not tell
            raise files.FileError(f"{name} is larger than {limit / 2**20:.0f} MiB, the most that is read")
        return self._files.cat_file(path)

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        """The shards one after another, in order."""
        return map(self.read, self.numbers)

    def write(self, number: int, arrays: Arrays, episodes: int) -> None:
        """Adds a shard."""
        content = files.npz(arrays, compressed=False)  # trajectories hardly shrink, and one process writes all shards
        self._write(_name(number), content)
        digest = hashlib.sha256(content).hexdigest()
        self._shards[number] = {"file": _name(number), "episodes": episodes, "bytes": len(content), "sha256": digest}
        self.write_manifest()

    def write_manifest(self) -> None:
        """Says what the set is made from and what is finished of it."""
        manifest = {"version": _VERSION, "about": self.about, "shards": {i: self._shards[i] for i in self.numbers}}
        self._write(MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())

    def _write(self, name: str, content: bytes) -> None:
        path = f"{self._root}/{name}"
        if isinstance(self._files, LocalFileSystem):
            files.write(path, content)
        else:  # objects appear whole
            self._files.pipe_file(path, content)

    @classmethod
    def make(
        cls,
        url: str,
        about: Mapping[str, Any],
        episodes: int,
        function: Callable[[range], Arrays],
        out: Path,
        workers: int | Workers,
        named: str,
        per_shard: int = EPISODES,
    ) -> "Shards":
        """Makes what is missing of a set, episode by episode on workers, and keeps nothing of a shard that is written.

        Args:
            url: of the set.
            about: what decides the episodes besides their numbers; anything that JSON holds.
            episodes: how many, from number 0.
            function: of a module, or a partial of one. On a worker it gives the arrays of episodes of these numbers by name,
                or none. They are joined along their first axis.
            out: folder of this machine for what is unfinished, by which a killed run continues.
            workers: a number of processes, or `Workers`.
            named: what the progress bar calls it.
            per_shard: episodes of a shard.

        Raises:
            ValueError: the set is made from something else, or another process is making it.
            WorkerError: processes died, so that episodes are missing.
        """
        shards = cls(url)
        about = {**about, "per_shard": per_shard}
        run = jobs.RunFolder(out, "set.json")
        run.claim({"shards": url, **about})
        if shards.about is None:
            shards.about = about
            shards.write_manifest()
        else:
            jobs.check_same(shards.about, about, Path(url), "a set")

        def parts_of(shard: int) -> dict[range, Path]:
            """The parts of a shard, and the files in which those are kept that are there."""
            last = min((shard + 1) * per_shard, episodes)
            parts = (range(start, min(start + _CHUNK, last)) for start in range(shard * per_shard, last, _CHUNK))
            return {part: run.unfinished / f"{part.start:09d}-{part.stop:09d}.npz" for part in parts}

        def missing() -> Iterator[Any]:
            for shard in range(-(-episodes // per_shard)):
                parts = parts_of(shard)
                finished = shards.has(shard, sum(map(len, parts)))
                for part, path in parts.items():
                    if finished or path.exists():
                        advance(named, len(part))
                    else:
                        yield part, function, (part,)
                join(shard)  # a killed run may have had all of it

        def join(shard: int) -> None:
            """Writes a shard if all of it is there."""
            parts = parts_of(shard)
            if not all(path.exists() for path in parts.values()):
                return
            read = [arrays for path in parts.values() if (arrays := files.read_npz(path))]
            joined = {name: np.concatenate([each[name] for each in read]) for name in (read[0] if read else ())}
            shards.write(shard, joined, sum(map(len, parts)))
            for path in parts.values():
                path.unlink()

        with progress_bars({named: episodes}) as advance:
            for part, arrays in completed(missing(), workers):
                files.write(parts_of(part.start // per_shard)[part], files.npz(arrays, compressed=False))
                advance(named, len(part))
                join(part.start // per_shard)
        run.release()
        return shards


def _place_of(url: str) -> tuple[Any, str]:
    """The storage of a URL or of a folder, and the path in it. A folder may have any name.

    Raises:
        ValueError: the URL is not one of storage.
        ImportError, OSError: raised by fsspec.
    """
    scheme, address, path = url.partition("://")
    if not address:
        return LocalFileSystem(), str(Path(url).absolute())
    if scheme not in _STORAGE or "::" in path:
        raise ValueError(
            f"{scheme}:// is not a supported storage; give a folder, or a URL that begins with one of {', '.join(_STORAGE)}"
        )
    return fsspec.core.url_to_fs(url)


def _name(number: int) -> str:
    return f"shard-{number:06d}.npz"
