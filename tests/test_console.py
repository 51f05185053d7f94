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
from ballbot_train.escaping import PlainConsole
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


HOSTILE = "<img src=x onerror=alert(1)>|[a](javascript:b)`{1+1}`*b*\n=cmd \x1b[31m\u202egnp\udc80"


def test_names_are_text_in_markdown():
    written = console.markdown(["a", "b"], [[HOSTILE, "30.1 % (2 to 3)"]])
    header, _, row = written.splitlines()
    assert header == "| a | b |"
    assert row.endswith("| 30.1 % (2 to 3) |")
    assert row.count("|") == 3
    assert not set("<>{}`*\x1b\u202e\udc80") & set(row)
    assert "](" not in row
    assert "&#60;img src=x onerror=alert(1)&#62;" in row


def test_names_neither_rewrite_the_screen_nor_turn_it_around(monkeypatch):
    printed = PlainConsole(file=io.StringIO(), width=200)
    monkeypatch.setattr(console, "console", printed)
    printed.print(f"policy {HOSTILE}")
    console.print_table(HOSTILE, [HOSTILE], [[f"[red]{HOSTILE}:smile:"]])
    with console.progress_bars({HOSTILE: 1}):
        pass
    text = printed.file.getvalue()
    assert not set("\x1b\u202e\udc80") & set(text)
    assert text.count("\\x1b[31m\\u202egnp\\udc80") >= 3
    assert "[red]" in text
    assert ":smile:" in text


@pytest.mark.parametrize(
    ("start", "workers", "end", "busy"),
    [(0.1, 4, 4.5, False), (3.0, 4, 4.0, True), (0.0, 1, 6.0, True), (math.nan, 4, math.nan, False)],
)
def test_a_machine_with_more_to_do_than_cores_is_busy(start, workers, end, busy, monkeypatch):
    monkeypatch.setattr(provenance.os, "cpu_count", lambda: 4)
    monkeypatch.setattr(provenance, "load", lambda: end)
    facts = provenance.load_facts(start, workers)
    assert facts["busy"] is busy
    assert facts["load_end"] == (None if math.isnan(end) else end)


def test_times_of_a_busy_machine_are_marked():
    row = summarize([result(episode=i) for i in range(3)])
    quiet, busy = cells(row), cells(row, busy=True)
    changed = [name for name, a, b in zip(HEADER, quiet, busy, strict=True) if a != b]
    assert changed == ["plan", "per step"]
    assert busy[-1] == f"~{quiet[-1]}"


IMPORTED = "from ballbot_gym.engines.bullet_client import import_pybullet; import_pybullet(); print('imported')"


@pytest.mark.parametrize("closed", ["", "1>&- 2>&-"])
def test_pybullet_prints_nothing_when_it_is_imported(closed):
    run = subprocess.run(
        ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, IMPORTED], capture_output=True, text=True, check=True
    )
    assert run.stderr == ""
    assert run.stdout == ("" if "1>" in closed else "imported\n")
