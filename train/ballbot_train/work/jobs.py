"""Work that can be interrupted and continued: jobs on parallel workers, whose results are written as soon as they arrive.

Each finished job is one file of JSON, with an entry for every item. Workers compute and this process writes, so workers may
be on other machines; `executors` says where. A run that is killed at any moment and started again therefore does only the
jobs that have no file. A folder belongs to one configuration until it is released, and to one process at a time.
"""

import json
import re
import shutil
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ballbot_gym import files
from ballbot_gym.lazy import imports_of
from ballbot_gym.tasks.identity import changed_parts
from ballbot_train.work.console import progress_bars
from ballbot_train.work.executors import Workers, completed

with imports_of(__name__):
    import filelock

Entry = dict[str, Any]
"""What is kept of one finished item: anything that JSON holds, NaN included."""

MARKER = "unfinished.json"
"""The file that says which configuration a folder belongs to, while its run is unfinished."""

_FOLDER = "unfinished"
_LOCK = ".lock"
_LIMIT = 2**32  # bytes of a job's file
_DIGESTS = {
    "problem": "an unknown problem",
    "problems": "unknown problems",
    "networks": "unknown policies",
    "start_policy": "an unknown policy to start from",
    "demonstrations": "unknown demonstrations",
    "expert_policy": "an unknown policy as expert",
}
"""Settings that hold digests, and what a folder is of whose settings lack them, because an earlier version made it."""
_FILES = {"start_policy": "--start", "demonstrations": "--demos", "expert_policy": "--expert"}
_held: dict[Path, filelock.BaseFileLock] = {}


@dataclass(frozen=True)
class Job:
    """Items that one worker does one after another, and which are kept together when the last is done.

    Small items belong into one job, because starting a job takes time.
    """

    name: str
    """Unique among the jobs of a run; its file is named after it."""
    function: Callable[..., Iterator[Entry]]
    """Called as function(*arguments, items), perhaps elsewhere: a function of a module. Yields one entry per item."""
    arguments: tuple[Any, ...]
    items: tuple[Any, ...]
    """Done in this order; each is what JSON holds."""
    group: str = ""
    """What its progress counts for."""


class RunFolder:
    """The folder of a run, which belongs to one configuration and to one process at a time."""

    def __init__(self, out: Path, marker: str = MARKER):
        """Args: out: the folder; made when it is claimed. marker: name of the file in it that keeps the configuration."""
        self.out, self._marker = out, marker

    @property
    def unfinished(self) -> Path:
        """The folder within that only serves to continue the run; `release` deletes it."""
        return self.out / _FOLDER

    def make(self) -> None:
        """Makes the folder, unless it is there. Call it before the work, which would else be lost.

        Raises:
            ValueError: there is a file of that name, or of the name of a folder above.
        """
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise ValueError(
                f"{self.out} cannot be a folder, because a file is in its place; give another --out"
            ) from error

    def claim(self, config: Mapping[str, Any], facts: Mapping[str, Any] | None = None) -> None:
        """Marks the folder as belonging to one configuration, and locks it for this process until `release` or `unlock`.

        The same configuration may claim the folder again, and so continues in it. Another one may where no job of an
        unfinished run has come to its end.

        Args:
            config: what decides the results; anything that JSON holds.
            facts: written along with the configuration, and not compared.

        Raises:
            ValueError: the folder belongs to another configuration, another process is using it, or its marker is damaged.
        """
        facts = {} if facts is None else facts
        path, wanted, is_usual = self.out / self._marker, json.loads(json.dumps(dict(config))), self._marker == MARKER
        locked_before = self._is_held
        self._lock()
        try:
            if path.exists() and (not is_usual or any(self.unfinished.glob("*.json"))):
                try:
                    held = files.read_json(path)
                except files.FileError as error:
                    raise ValueError(f"{path} is damaged ({error}); delete it or give another --out") from error
                held = {key: value for key, value in held.items() if key not in facts}
                check_same(held, wanted, self.out, "an unfinished run" if is_usual else "a run")
            files.write(path, json.dumps({**wanted, **facts}, indent=1) + "\n")
        except BaseException:
            if not locked_before:
                self.unlock()
            raise

    def release(self) -> None:
        """Ends a run whose results are written: deletes what only served to continue it, and unlocks the folder."""
        shutil.rmtree(self.unfinished, ignore_errors=True)
        (self.out / self._marker).unlink(missing_ok=True)
        self.unlock()

    def unlock(self) -> None:
        """Lets other processes use the folder; its configuration stays. Without effect where this process holds no lock."""
        lock = _held.pop(self.out.resolve(), None)
        if lock is not None:
            Path(lock.lock_file).unlink(missing_ok=True)  # while it is held, so that no other run's lock is deleted
            lock.release()

    @property
    def _is_held(self) -> bool:
        return self.out.resolve() in _held and (self.out / _LOCK).exists()

    def _lock(self) -> None:
        if self._is_held:
            return
        self.unlock()  # the folder was deleted meanwhile, and the lock with it
        self.make()
        while not self._is_held:  # a lock that another process deleted between our opening and locking it is no lock
            lock = filelock.FileLock(self.out.resolve() / _LOCK, timeout=0, thread_local=False)
            try:
                lock.acquire()
            except filelock.Timeout:
                raise ValueError(
                    f"another run is using {self.out} right now; wait until it has ended, or give another --out"
                ) from None
            _held[self.out.resolve()] = lock


def _path_of(out: Path, name: str) -> Path:
    plain = re.sub(r"[^\w-]", "-", name, flags=re.ASCII)[-100:]
    return RunFolder(out).unfinished / f"{plain if plain == name else f'{plain}-{zlib.crc32(name.encode()):08x}'}.json"


def check_same(held: Mapping[str, Any], wanted: Mapping[str, Any], out: Path, what: str) -> None:
    """Raises a ValueError that names the settings of what a folder holds where they are not those wanted.

    Args:
        held: settings of what the folder holds, as JSON gives them.
        wanted: settings of what is to be in it; anything that JSON holds.
        out: the folder.
        what: it holds, in words.
    """
    wanted = json.loads(json.dumps(dict(wanted)))
    changed = list(_differences(held, wanted))
    if changed:
        raise ValueError(f"{out} holds {what} of {'; '.join(changed)}; give another --out or delete the folder")


def _differences(held: Mapping[str, Any], wanted: Mapping[str, Any], of: str = "") -> Iterator[str]:
    """What differs, in words; of settings that are themselves named values, only those that differ."""
    for key in {**held, **wanted}:
        old, new = held.get(key), wanted.get(key)
        if old == new:
            continue
        if key in _DIGESTS and new is not None and not isinstance(old, type(new)):
            yield f"{_DIGESTS[key]}, because an earlier version made it"
        elif key == "problem" or of == "problems ":
            yield _changed_problem(key, old, new)
        elif key in _FILES:
            if new is not None:  # else that option is another, which is said of it
                yield f"a file of {_FILES[key]} that has changed since"
        elif of in ("policies ", "networks "):
            if None not in (old, new):  # else the controllers are others, which is said of these
                yield f"the policy {key}, whose {'weights have' if of == 'policies ' else 'description has'} changed since"
        elif isinstance(old, dict) and isinstance(new, dict):
            yield from _differences(old, new, f"{of}{key} ")
        else:
            yield f"{of}{key} {old!r}, not {new!r}"


def _changed_problem(key: str, old: Any, new: Any) -> str:
    """Another problem in words; key is "problem", or "TASK" or "ROBOT/TASK"."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return f"problem {key} {old!r}, not {new!r}"
    parts = changed_parts(old, new)
    *most, last = parts
    listed = f"{', '.join(most)} and {last}" if most else last
    named = "" if key == "problem" else f" {key}"
    return f"another problem{named}: its {listed} {'have' if last.endswith('s') or most else 'has'} changed since"


def run(
    jobs: Sequence[Job], out: Path, workers: int | Workers, on_progress: Callable[[str, int], None] | None = None
) -> list[list[Entry]]:
    """Does the jobs that are not done yet. The calling process writes every result as it arrives.

    Args:
        jobs: what there is to do.
        out: folder of the results, which the caller has claimed; unfinished ones are in a folder within.
        workers: a number of processes, or `Workers`; see `completed`.
        on_progress: called with a job's group and a number of its items that are there; default, a bar for each group.

    Returns:
        The entries of each job, in the order of its items; every item has one.

    Raises:
        WorkerError: a worker died.
        ValueError: there are no workers.
    """
    results: dict[int, list[Entry]] = {}
    totals: Counter[str] = Counter()
    for job in jobs:
        totals[job.group] += len(job.items)

    def tasks() -> Iterator[Any]:
        for number, job in enumerate(jobs):
            if (done := _read(_path_of(out, job.name), len(job.items))) is None:
                yield (number, job), _result, (job,)
            else:
                advance(job.group, len(job.items))
                results[number] = done

    with progress_bars(totals) if on_progress is None else nullcontext(on_progress) as advance:
        for (number, job), text in completed(tasks(), workers):
            files.write(_path_of(out, job.name), text)
            advance(job.group, len(job.items))
            results[number] = json.loads(text)
    return [results[i] for i in range(len(jobs))]


def _result(job: Job) -> str:
    """The entries of a job as JSON, on a worker."""
    entries = list(job.function(*job.arguments, job.items))
    if len(entries) != len(job.items):
        raise ValueError(f"{job.name} gives {len(entries)} entries for {len(job.items)} items")
    return json.dumps(entries)


def _read(path: Path, items: int) -> list[Entry] | None:
    """The entries of a finished job; None where it has none, or a damaged file."""
    try:
        entries = files.read_json(path, _LIMIT, kind=list)
    except files.FileError:  # or there is none
        return None
    return entries if len(entries) == items else None
