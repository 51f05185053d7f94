"""Work that outlives an interruption: jobs in parallel processes, whose finished items are kept as they come.

Each job is one file of JSON lines, to which its process adds a line for every finished item. So a run that is killed at
any moment and started again does only what no line holds. A folder belongs to one configuration until it is released.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any

from ballbot_gym import files

Entry = dict[str, Any]
"""What is kept of one finished item: anything that JSON holds, NaN included."""

_CLAIM = "unfinished.json"
_FOLDER = "unfinished"


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


def claim(out: Path, config: Entry) -> None:
    """Marks a folder as this run's, so that only the same run continues in it.

    Raises:
        ValueError: it holds an unfinished run of another configuration.
    """
    marker = out / _CLAIM
    if marker.exists() and (held := json.loads(marker.read_text())) != json.loads(json.dumps(config)):
        changed = [key for key in {**held, **config} if held.get(key) != json.loads(json.dumps(config.get(key)))]
        what = "; ".join(f"{key} {held.get(key)!r}, not {config.get(key)!r}" for key in changed)
        raise ValueError(f"{out} holds an unfinished run of {what}; give another --out or delete the folder")
    files.write(marker, json.dumps(config))


def release(out: Path) -> None:
    """Ends a run whose results are written: what only served to continue it is deleted."""
    shutil.rmtree(out / _FOLDER, ignore_errors=True)
    (out / _CLAIM).unlink(missing_ok=True)


def run(jobs: Sequence[Job], out: Path, workers: int, on_progress: Callable[[str, int], None]) -> list[list[Entry]]:
    """Does what is not done yet.

    Args:
        jobs: what there is to do.
        out: folder of the results; unfinished ones are in a folder within.
        workers: processes; with 1, the calling one.
        on_progress: called with a job's group and a number of its items that are there.

    Returns:
        The entries of each job, in the order of its items.
    """
    paths = [out / _FOLDER / f"{job.name}.jsonl" for job in jobs]
    done = [_read(path) for path in paths]
    for job, entries in zip(jobs, done, strict=True):
        on_progress(job.group, len(entries))
    missing = [i for i, job in enumerate(jobs) if len(done[i]) < len(job.items)]
    if workers == 1 or len(missing) == 1:
        for i in missing:
            on_progress(jobs[i].group, _work(jobs[i], paths[i]))
    elif missing:
        os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, not the threads of each
        # spawn: a forked child would share PyBullet's clients and CasADi's state with this process
        with ProcessPoolExecutor(max_workers=min(workers, len(missing)), mp_context=get_context("spawn")) as pool:
            running = {pool.submit(_work, jobs[i], paths[i]): i for i in missing}
            try:
                for future in as_completed(running):
                    on_progress(jobs[running[future]].group, future.result())
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for child in active_children():  # else an interrupt would wait for their jobs; what is finished is kept
                    child.terminate()
                raise
    return [list(_read(path).values()) for path in paths]


def _work(job: Job, path: Path) -> int:
    """Does the items of a job that its file does not hold, and says how many they were."""
    done = _read(path)
    missing = tuple(item for i, item in enumerate(job.items) if i not in done)
    positions = (i for i in range(len(job.items)) if i not in done)
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


def _read(path: Path) -> dict[int, Entry]:
    """The finished items by their position, in order; half a line at the end is none."""
    if not path.exists():
        return {}
    lines = path.read_text().split("\n")[:-1]
    return dict(sorted((line["item"], line["entry"]) for line in map(json.loads, lines)))
