import os
import signal
import subprocess
import sys
import time

import pytest

from ballbot_train import jobs


def squares(log, items):
    """A job that notes every item it is asked for."""
    for item in items:
        with open(log, "a") as file:
            file.write(f"{item}\n")
        yield {"square": item**2}


def broken(log, items):
    for entry in squares(log, items):
        yield entry
        raise RuntimeError("power cut")


def ignore(group, count):
    pass


def job(function, log, items, name="job"):
    return jobs.Job(name, function, (str(log),), tuple(items))


def test_entries_come_in_the_order_of_jobs_and_items(tmp_path):
    work = [job(squares, tmp_path / "log", range(3 * i, 3 * i + 3), f"job{i}") for i in range(3)]
    counted = []
    done = jobs.run(work, tmp_path, 2, lambda group, count: counted.append(count))
    assert [[entry["square"] for entry in entries] for entries in done] == [[0, 1, 4], [9, 16, 25], [36, 49, 64]]
    assert sum(counted) == 9


def test_what_was_finished_before_an_error_is_not_done_again(tmp_path):
    log = tmp_path / "log"
    with pytest.raises(RuntimeError, match="power cut"):
        jobs.run([job(broken, log, range(4))], tmp_path, 1, ignore)
    assert log.read_text().split() == ["0"]
    (entries,) = jobs.run([job(squares, log, range(4))], tmp_path, 1, ignore)
    assert [entry["square"] for entry in entries] == [0, 1, 4, 9]
    assert log.read_text().split() == ["0", "1", "2", "3"]


def test_half_a_line_that_a_kill_left_is_done_again(tmp_path):
    log = tmp_path / "log"
    jobs.run([job(squares, log, range(3))], tmp_path, 1, ignore)
    path = next(tmp_path.rglob("job.jsonl"))
    path.write_text(path.read_text()[:-10])
    (entries,) = jobs.run([job(squares, log, range(3))], tmp_path, 1, ignore)
    assert [entry["square"] for entry in entries] == [0, 1, 4]
    assert log.read_text().split() == ["0", "1", "2", "2"]


SLOWLY = """
import sys, time
from pathlib import Path
sys.path.insert(0, {folder!r})
from ballbot_train import jobs

def slow(items):
    for item in items:
        time.sleep(0.02)
        yield {{"item": item}}

jobs.run([jobs.Job("job", slow, (), tuple(range(1000)))], Path({out!r}), 1, lambda group, count: None)
"""


def test_a_killed_process_loses_no_finished_item(tmp_path):
    code = SLOWLY.format(folder=os.getcwd(), out=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", code])
    path = tmp_path / "unfinished" / "job.jsonl"
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (path.exists() and path.read_text().count("\n") >= 5):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = path.read_text().count("\n")
    assert kept >= 5
    started = []

    def rest(items):
        started.extend(items)
        for item in items:
            yield {"item": item}

    (entries,) = jobs.run([jobs.Job("job", rest, (), tuple(range(1000)))], tmp_path, 1, ignore)
    assert [entry["item"] for entry in entries] == list(range(1000))
    assert started[0] == kept


def test_a_folder_belongs_to_one_run_until_it_is_released(tmp_path):
    jobs.claim(tmp_path, {"episodes": 3, "policies": {}})
    jobs.claim(tmp_path, {"episodes": 3, "policies": {}})
    with pytest.raises(ValueError, match="unfinished run of episodes 3, not 4"):
        jobs.claim(tmp_path, {"episodes": 4, "policies": {}})
    jobs.release(tmp_path)
    jobs.claim(tmp_path, {"episodes": 4, "policies": {}})
