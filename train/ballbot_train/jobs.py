"""Work that outlives an interruption: jobs in parallel processes, whose finished items are kept as they come.

Each job is one file of JSON lines. Its process adds a line for every finished item. A run that is killed at any moment and
started again therefore does only the items that no line holds. A folder belongs to one configuration until it is released,
and to one process at a time.
"""

import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any

from ballbot_gym import files
from ballbot_gym.lazy import missing

try:
    import filelock
except ModuleNotFoundError as error:
    raise missing(__name__, error.name) from error

Entry = dict[str, Any]
"""What is kept of one finished item: anything that JSON holds, NaN included."""

MARKER = "unfinished.json"
"""The file that says which configuration a folder belongs to."""

_FOLDER = "unfinished"
_LOCK = ".lock"
_held: dict[Path, filelock.BaseFileLock] = {}


class WorkerError(RuntimeError):
    """Worker processes died, and died again when their items were tried once more."""


@dataclass(frozen=True)
class Job:
    """Items that one process does one after another."""

    name: str
    """Of its file; different for every job of a run."""
    function: Callable[..., Iterator[Entry]]
    """Called as function(*arguments, items), in another process: a function of a module. Yields one entry per item."""
    arguments: tuple[Any, ...]
    items: tuple[Any, ...]
    """Done in this order; each is what JSON holds."""
    group: str = ""
    """What its progress counts for."""


def make_folder(out: Path) -> None:
    """Makes the folder of a run, unless it is there. Call it before the work, which would else be lost.

    Raises:
        ValueError: there is a file of that name, or of the name of a folder above.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ValueError(f"{out} cannot be a folder, because a file is in its place; give another --out") from error


def unfinished(out: Path) -> Path:
    """The folder within a run's folder that only serves to continue the run; `release` deletes it."""
    return out / _FOLDER


def claim(out: Path, config: Mapping[str, Any], marker: str = MARKER, facts: Mapping[str, Any] | None = None) -> None:
    """Marks a folder as belonging to one configuration, and locks it for this process until `release` or `unlock`.

    The same configuration may claim the folder again, and so continues in it.

    Args:
        out: the folder; made if missing.
        config: what decides the results; anything that JSON holds.
        marker: name of the file in the folder that keeps the configuration.
        facts: written beside the configuration, and not compared.

    Raises:
        ValueError: the folder belongs to another configuration, another process is using it, or its marker is damaged.
    """
    facts = {} if facts is None else facts
    path, wanted = out / marker, json.loads(json.dumps(dict(config)))
    locked_before = _holds(out)
    _lock(out)
    try:
        if path.exists():
            held = {key: value for key, value in _read_marker(path).items() if key not in facts}
            check_same(held, wanted, out, "an unfinished run" if marker == MARKER else "a run")
        files.write(path, json.dumps({**wanted, **facts}, indent=1) + "\n")
    except BaseException:
        if not locked_before:
            unlock(out)
        raise


def check_same(held: Mapping[str, Any], wanted: Mapping[str, Any], out: Path, what: str) -> None:
    """Raises a ValueError that names the settings of what a folder holds where they are not those wanted.

    Args:
        held: settings of what the folder holds, as JSON gives them.
        wanted: settings of what is to be in it; anything that JSON holds.
        out: the folder.
        what: it holds, in words.
    """
    wanted = json.loads(json.dumps(dict(wanted)))
    changed = [key for key in {**held, **wanted} if held.get(key) != wanted.get(key)]
    if changed:
        said = "; ".join(f"{key} {held.get(key)!r}, not {wanted.get(key)!r}" for key in changed)
        raise ValueError(f"{out} holds {what} of {said}; give another --out or delete the folder")


def _read_marker(path: Path) -> dict[str, Any]:
    try:
        held = files.read_json(path)
        if not isinstance(held, dict):
            raise ValueError(f"{path} holds no object")
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); delete it or give another --out") from error
    return held


def release(out: Path, marker: str = MARKER) -> None:
    """Ends a run whose results are written: deletes what only served to continue it, and unlocks the folder."""
    shutil.rmtree(unfinished(out), ignore_errors=True)
    (out / marker).unlink(missing_ok=True)
    unlock(out)


def unlock(out: Path) -> None:
    """Lets other processes use a folder; its configuration stays. Without effect where this process holds no lock."""
    lock = _held.pop(out.resolve(), None)
    if lock is not None:
        Path(lock.lock_file).unlink(missing_ok=True)  # while it is held, so that nobody else's is deleted
        lock.release()


def _holds(out: Path) -> bool:
    return out.resolve() in _held and (out / _LOCK).exists()


def _lock(out: Path) -> None:
    if _holds(out):
        return
    unlock(out)  # the folder was deleted meanwhile, and the lock with it
    make_folder(out)
    while not _holds(out):  # a lock that another process deleted between our opening and locking it is no lock
        lock = filelock.FileLock(out.resolve() / _LOCK, timeout=0, thread_local=False)
        try:
            lock.acquire()
        except filelock.Timeout:
            raise ValueError(
                f"another run is using {out} right now; wait until it has ended, or give another --out"
            ) from None
        _held[out.resolve()] = lock


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Locks a folder within the block, unless this process has claimed it already."""
    if _holds(out):
        yield
        return
    _lock(out)
    try:
        yield
    finally:
        unlock(out)


def run(jobs: Sequence[Job], out: Path, workers: int, on_progress: Callable[[str, int], None]) -> list[list[Entry]]:
    """Does what is not done yet.

    An item whose process dies is tried once more. If that process dies too, the item is left out, all others are done,
    and a WorkerError says which are missing.

    Args:
        jobs: what there is to do.
        out: folder of the results; unfinished ones are in a folder within.
        workers: processes. The calling process does no item itself, so that it outlives any of them; but with 1 worker and
            $BALLBOT_IN_PROCESS set, it does them all, for debuggers and tests.
        on_progress: called with a job's group and a number of its items that are there.

    Returns:
        The entries of each job, in the order of its items; every item has one.

    Raises:
        WorkerError: processes died, so that items are missing.
        ValueError: another process is using the folder, or there are no workers.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, not {workers}")
    paths = [unfinished(out) / f"{job.name}.jsonl" for job in jobs]
    with _locked(out):
        done = [_read(path, len(job.items)) for path, job in zip(paths, jobs, strict=True)]
        for job, entries in zip(jobs, done, strict=True):
            on_progress(job.group, len(entries))
        missing = [i for i, job in enumerate(jobs) if len(done[i]) < len(job.items)]
        if workers == 1 and os.environ.get("BALLBOT_IN_PROCESS"):
            for i in missing:
                on_progress(jobs[i].group, _work(jobs[i], paths[i]))
        elif missing:
            work = [(jobs[i], paths[i]) for i in missing]
            lost = _in_processes(work, min(workers, len(missing)), on_progress)
            if lost:
                raise WorkerError(
                    f"worker processes died, most likely out of memory, at {'; '.join(lost)}. Everything else is kept: the "
                    "same command does only what is missing, with fewer --workers each has more memory"
                )
        return [_complete(job, path) for job, path in zip(jobs, paths, strict=True)]


def _complete(job: Job, path: Path) -> list[Entry]:
    entries = _read(path, len(job.items))
    if len(entries) < len(job.items):
        raise ValueError(
            f"{path} holds {len(entries)} of {len(job.items)} items though the run has ended; run the command again"
        )
    return list(entries.values())


def _in_processes(work: Sequence[tuple[Job, Path]], workers: int, on_progress: Callable[[str, int], None]) -> list[str]:
    """Does jobs in parallel processes, and names the items whose processes died twice."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, not the threads of each
    context = get_context("spawn")  # a forked child would share PyBullet's clients and CasADi's state with this process

    # one pool for each process, so that a process that dies takes only its own job with it
    def new_pool() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(max_workers=1, mp_context=context)

    queue = list(reversed(range(len(work))))
    deaths: dict[tuple[int, int], int] = {}
    counted = {i: len(_read(path, len(job.items))) for i, (job, path) in enumerate(work)}
    pools: list[ProcessPoolExecutor] = []
    running: dict[Future[int], tuple[int, ProcessPoolExecutor]] = {}

    def count(i: int) -> None:
        """Reports what the file of a job holds more than was reported."""
        job, path = work[i]
        present = len(_read(path, len(job.items)))
        on_progress(job.group, present - counted[i])
        counted[i] = present

    def start(pool: ProcessPoolExecutor) -> None:
        if not queue:
            pool.shutdown(wait=False)
            return
        i = queue.pop()
        skipped = {position for (job, position), times in deaths.items() if job == i and times > 1}
        running[pool.submit(_work, *work[i], skipped)] = i, pool

    try:
        for _ in range(workers):
            pools.append(new_pool())
            start(pools[-1])
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                i, pool = running.pop(future)
                try:
                    future.result()
                except BrokenProcessPool:
                    pool.shutdown(wait=False)
                    dead = _first_missing(*work[i], [p for (job, p), times in deaths.items() if job == i and times > 1])
                    if dead is not None:
                        deaths[i, dead] = deaths.get((i, dead), 0) + 1
                        queue.insert(0, i)  # last in turn, when other processes may have left memory
                    pools.append(pool := new_pool())
                count(i)
                start(pool)
    except BaseException:
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for child in active_children():  # else an interrupt would wait for their jobs; what is finished is kept
            child.terminate()
        raise
    return [f"{work[i][0].name}, item {work[i][0].items[p]}" for (i, p), times in sorted(deaths.items()) if times > 1]


def _first_missing(job: Job, path: Path, skipped: Collection[int]) -> int | None:
    """The position of the item at which a process that died was."""
    done = _read(path, len(job.items))
    return next((i for i in range(len(job.items)) if i not in done and i not in skipped), None)


def _work(job: Job, path: Path, skipped: Collection[int] = ()) -> int:
    """Does the items of a job that its file does not hold, less those skipped, and says how many they were."""
    done = _read(path, len(job.items))
    positions = [i for i in range(len(job.items)) if i not in done and i not in skipped]
    missing = tuple(job.items[i] for i in positions)
    # a kill may have left half a line, which would spoil the next
    files.write(path, "".join(_line(i, entry) for i, entry in done.items()))
    with path.open("a") as file:
        for i, entry in zip(positions, job.function(*job.arguments, missing), strict=True):
            file.write(_line(i, entry))
            file.flush()
            if (parent := parent_process()) is not None and not parent.is_alive():
                os._exit(1)  # the run was killed, and may already go on in another process
    return len(missing)


def _line(i: int, entry: Entry) -> str:
    return json.dumps({"item": i, "entry": entry}) + "\n"


def _read(path: Path, items: int) -> dict[int, Entry]:
    """The finished ones of a number of items by their position, in order; a damaged line is none."""
    if not path.exists():
        return {}
    found = {}
    for text in path.read_text(errors="replace").split("\n")[:-1]:
        try:
            line = json.loads(text)
            i, entry = line["item"], line["entry"]
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
        if isinstance(i, int) and 0 <= i < items:
            found[i] = entry
    return dict(sorted(found.items()))
