"""What the commands print: progress into a pipe, and marks of times that a busy machine spoils."""

import io
import math
import re
import subprocess
import sys
import time

import pytest
from builders import result
from rich.console import Console

from ballbot_train import console, provenance
from ballbot_train.evaluation.results import HEADER, cells, summarize


def test_progress_into_a_pipe_is_a_line_for_every_bar_that_is_not_full(monkeypatch):
    printed = Console(file=io.StringIO(), width=100, markup=False)
    monkeypatch.setattr(console, "console", printed)
    monkeypatch.setattr(console, "LINE_SECONDS", 0.05)
    with console.progress_bars({"turn": 4, "[red]orbit": 2}) as bars:
        bars.advance("turn", 3)
        bars.advance("[red]orbit", 2)
        time.sleep(0.3)
    lines = printed.file.getvalue().splitlines()
    assert any(re.fullmatch(r"0:00:0\d turn: 3 of 4", line) for line in lines)
    assert not any(line.endswith("[red]orbit: 2 of 2") for line in lines)


def test_nothing_is_printed_after_the_end(monkeypatch):
    printed = Console(file=io.StringIO(), width=100)
    monkeypatch.setattr(console, "console", printed)
    monkeypatch.setattr(console, "LINE_SECONDS", 0.05)
    with console.progress_bars({"turn": 4}):
        pass
    before = printed.file.getvalue()
    time.sleep(0.2)
    assert printed.file.getvalue() == before


@pytest.mark.parametrize(
    ("start", "workers", "end", "busy"),
    [(0.1, 4, 4.5, False), (3.0, 4, 4.0, True), (0.0, 1, 6.0, True), (math.nan, 4, math.nan, False)],
)
def test_a_machine_with_more_to_do_than_cores_is_busy(start, workers, end, busy, monkeypatch):
    monkeypatch.setattr(provenance.os, "cpu_count", lambda: 4)
    facts = provenance.load_facts([(start, workers)], [end])
    assert facts["busy"] is busy
    assert facts["load_end"] == (None if math.isnan(end) else end)


def test_a_run_that_was_interrupted_on_a_busy_machine_stays_one_of_a_busy_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(provenance.os, "cpu_count", lambda: 4)
    monkeypatch.setattr(provenance, "load", lambda: 9.0)
    provenance.LoadRecord(tmp_path, 1)
    with (tmp_path / "unfinished" / "loads.jsonl").open("a") as file:
        file.write("\n[9.")  # the kill
    monkeypatch.setattr(provenance, "load", lambda: 0.5)
    assert provenance.LoadRecord(tmp_path, 1).facts() == {"busy": True, "load_start": 9.0, "load_end": 0.5}
    assert not provenance.LoadRecord(tmp_path / "other", 1).facts()["busy"]


def test_times_of_a_busy_machine_are_marked():
    row = summarize([result(episode=i) for i in range(3)])
    quiet, busy = cells(row), cells(row, busy=True)
    changed = [name for name, a, b in zip(HEADER, quiet, busy, strict=True) if a != b]
    assert changed == ["plan", "per step"]
    assert busy[-1] == f"~{quiet[-1]}"


IMPORTED = "from ballbot_gym.simulator import import_pybullet; import_pybullet(); print('imported')"


@pytest.mark.parametrize("closed", ["", "1>&-", "2>&-", "1>&- 2>&-"])
def test_pybullet_prints_nothing_when_it_is_imported(closed):
    run = subprocess.run(
        ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, IMPORTED], capture_output=True, text=True, check=True
    )
    assert run.stderr == ""
    assert run.stdout == ("" if "1>" in closed else "imported\n")
