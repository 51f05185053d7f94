import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ballbot_train.work import jobs
from ballbot_train.work.executors import WorkerError
from ballbot_train.work.provenance import _commit_of


def squares(log, items):
    """A job that notes every item it is asked for."""
    for item in items:
        with open(log, "a") as file:
            file.write(f"{item}\n")
        yield {"square": item**2}


def broken(log, items):
    list(squares(log, items))
    raise RuntimeError("power cut")


def ignore(group, count):
    pass


def job(function, log, items, name="job"):
    return jobs.Job(name, function, (str(log),), tuple(items))


def test_what_was_finished_before_an_error_is_not_done_again(tmp_path):
    log = tmp_path / "log"
    first, second = job(squares, log, range(4), "first"), range(4, 6)
    with pytest.raises(RuntimeError, match="power cut"):
        jobs.run([first, job(broken, log, second, "second")], tmp_path, 1, ignore)
    done = jobs.run([first, job(squares, log, second, "second")], tmp_path, 1, ignore)
    assert [entry["square"] for entries in done for entry in entries] == [0, 1, 4, 9, 16, 25]
    assert log.read_text().split() == ["0", "1", "2", "3", *"4545"]


ENDLESS = """
import os, time
from pathlib import Path

def work(folder, items):
    for item in items:
        (Path(folder) / f"{os.getpid()}.pid").touch()
        time.sleep(600)
        yield {}
"""


def lives(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_workers_end_with_a_run_that_is_killed(tmp_path):
    (tmp_path / "endless.py").write_text(ENDLESS)
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, '.'); import endless; from ballbot_train.work import jobs\n"
        "work = [jobs.Job(str(i), endless.work, ('.',), (0,)) for i in range(2)]\n"
        "if __name__ == '__main__': jobs.run(work, Path('out'), 2, lambda group, count: None)"
    )
    run = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and len(list(tmp_path.glob("*.pid"))) < 2:
        time.sleep(0.05)
    run.kill()
    run.wait()
    workers = [int(path.stem) for path in tmp_path.glob("*.pid")]
    assert len(workers) == 2
    while time.monotonic() < deadline and any(map(lives, workers)):
        time.sleep(0.05)
    assert not any(map(lives, workers))


def failing(items):
    for item in items:
        if item == 1:
            raise ValueError("no episode 1")
        yield {"value": item}


def test_a_folder_belongs_to_a_run_from_its_first_result_until_it_is_released(tmp_path):
    work = [jobs.Job(f"{i}", failing, (), (i,)) for i in (1, 0)]
    for episodes in (3, 4):
        jobs.RunFolder(tmp_path).claim({"episodes": episodes})
        with pytest.raises(ValueError, match="no episode 1"):
            jobs.run(work, tmp_path, 1, ignore)
    with pytest.raises(ValueError, match="no episode 1"):
        jobs.run(work[::-1], tmp_path, 1, ignore)
    jobs.RunFolder(tmp_path).claim({"episodes": 4})
    with pytest.raises(ValueError, match="unfinished run of episodes 4, not 3"):
        jobs.RunFolder(tmp_path).claim({"episodes": 3})
    jobs.RunFolder(tmp_path).release()
    assert not any(tmp_path.iterdir())
    jobs.RunFolder(tmp_path).claim({"episodes": 3})
    jobs.RunFolder(tmp_path).release()


def test_the_files_of_a_claim_keep_facts_that_are_not_compared(tmp_path):
    jobs.RunFolder(tmp_path, "config.json").claim({"seed": 1}, {"about": {"commit": "a"}})
    jobs.RunFolder(tmp_path, "config.json").claim({"seed": 1}, {"about": {"commit": "b"}})
    assert json.loads((tmp_path / "config.json").read_text()) == {"seed": 1, "about": {"commit": "b"}}
    with pytest.raises(ValueError, match="seed 1, not 2"):
        jobs.RunFolder(tmp_path, "config.json").claim({"seed": 2}, {"about": {}})


HOLDING = """
import sys
from pathlib import Path
from ballbot_train.work import jobs

jobs.RunFolder(Path(sys.argv[1])).claim({"seed": 1})
print("claimed", flush=True)
sys.stdin.readline()
"""


def test_two_processes_never_use_a_folder_at_once(tmp_path):
    other = subprocess.Popen(
        [sys.executable, "-c", HOLDING, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "claimed\n"
    with pytest.raises(ValueError, match=r"another run is using .* right now"):
        jobs.RunFolder(tmp_path).claim({"seed": 1})
    other.kill()  # what a killed process held is free again
    other.communicate()
    jobs.RunFolder(tmp_path).claim({"seed": 1})
    jobs.RunFolder(tmp_path).release()


def deadly(log, items):
    """Squares, but the process dies the first time at item 9, when the first job is kept."""
    for entry in squares(log, items):
        if entry["square"] == 81 and Path(log).read_text().split().count("9") == 1:
            while not any(Path(log).parent.rglob("job0.json")):
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGKILL)
        yield entry


def test_a_worker_that_dies_ends_the_run_and_what_is_finished_is_kept(tmp_path):
    log, counted = tmp_path / "log", []
    work = [job(deadly, log, range(i, i + 4), f"job{i}") for i in (0, 4, 8)]
    with pytest.raises(WorkerError, match=r"died, most likely out of memory .* the same command does what is missing"):
        jobs.run(work, tmp_path, 2, ignore)
    done = jobs.run(work, tmp_path, 2, lambda group, count: counted.append(count))
    assert [entry["square"] for entries in done for entry in entries] == [i**2 for i in range(12)]
    assert sum(counted) == 12
    items = log.read_text().split()
    assert [items.count(item) for item in ("0", "3", "9")] == [1, 1, 2]


@pytest.mark.parametrize("damaged", ["", '[{"square": 0}', "[]", "\x00" * 20])
def test_a_result_that_is_damaged_is_made_again(damaged, tmp_path):
    log = tmp_path / "log"
    jobs.run([job(squares, log, range(4))], tmp_path, 1, ignore)
    next(tmp_path.rglob("job.json")).write_text(damaged)
    (entries,) = jobs.run([job(squares, log, range(4))], tmp_path, 1, ignore)
    assert [entry["square"] for entry in entries] == [0, 1, 4, 9]
    assert log.read_text().split() == [*"01230123"]


def forgetful(items):
    yield from ()


def test_a_run_never_ends_with_items_missing(tmp_path):
    with pytest.raises(ValueError, match="job gives 0 entries for 1 items"):
        jobs.run([jobs.Job("job", forgetful, (), (1,))], tmp_path, 1, ignore)


def test_a_result_names_the_commit_of_the_checkout_that_tracks_the_code(tmp_path):
    def git(*arguments):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        subprocess.run(["git", *identity, "-C", str(tmp_path), *arguments], check=True, capture_output=True)

    nested = tmp_path / "a" / "b"
    nested.mkdir(parents=True)
    tracked, untracked = nested / "tracked.py", nested / "untracked.py"
    for path in (tracked, untracked):
        path.write_text("")
    git("init")
    git("add", "a/b/tracked.py")
    git("commit", "-m", "first")
    assert re.fullmatch("[0-9a-f]{7,}", _commit_of(tracked))
    assert _commit_of(untracked) == "none"  # an installed package in somebody else's repository
    tracked.write_text("changed")
    assert _commit_of(tracked).endswith("-dirty")


def unpicklable(items):
    yield {"item": 0}
    raise Unpicklable(lambda: None)


class Unpicklable(ValueError):
    pass


def test_an_error_of_a_worker_is_the_error_of_the_run_whatever_it_holds(tmp_path):
    with pytest.raises(RuntimeError, match="Unpicklable"):
        jobs.run([jobs.Job("job", unpicklable, (), (0, 1))], tmp_path, 2, ignore)


def test_of_nested_settings_only_those_that_differ_are_named(tmp_path):
    held = {"seed": 1, "settings": {"gamma": 0.99, "hidden": [64, 64]}}
    with pytest.raises(ValueError, match=r"holds a run of settings gamma 0\.99, not 0\.98; give another --out"):
        jobs.check_same(held, {"seed": 1, "settings": {"gamma": 0.98, "hidden": (64, 64)}}, tmp_path, "a run")


WITHOUT_GUARD = """
from ballbot_train.work import jobs
from pathlib import Path
from test_jobs import ignore, job, squares

if GUARD:
    jobs.run([job(squares, Path("log"), range(i, i + 2), f"job{i}") for i in (0, 2)], Path("out"), 2, ignore)
"""


@pytest.mark.parametrize("guard", ["True", "__name__ == '__main__'"])
def test_a_script_without_a_guard_learns_that_it_needs_one(guard, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(WITHOUT_GUARD.replace("GUARD", guard))
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": paths}
    ended = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    if guard == "True":
        assert 'must do its work under if __name__ == "__main__":' in ended.stderr.splitlines()[-1]
        assert "out of memory" not in ended.stderr.splitlines()[-1]
    else:
        assert ended.returncode == 0, ended.stderr
