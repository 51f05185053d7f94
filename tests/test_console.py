"""What the commands print: progress into a pipe, and marks of times that a busy machine spoils."""

import io
import re
import subprocess
import sys
import time

import pytest
from rich.console import Console

from ballbot_train.work import console
from ballbot_train.work.console import PlainConsole


def test_progress_into_a_pipe_is_a_line_for_every_bar_that_is_not_full(monkeypatch):
    printed = Console(file=io.StringIO(), width=100, markup=False)
    monkeypatch.setattr(console, "console", printed)
    monkeypatch.setattr(console, "LINE_SECONDS", 0.05)
    with console.progress_bars({"turn": 4, "[red]orbit": 2}) as advance:
        advance("turn", 3)
        advance("[red]orbit", 2)
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


IMPORTED = "from ballbot_gym.engines.bullet_client import import_pybullet; import_pybullet(); print('imported')"


@pytest.mark.parametrize("closed", ["", "1>&- 2>&-"])
def test_pybullet_prints_nothing_when_it_is_imported(closed):
    run = subprocess.run(
        ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, IMPORTED], capture_output=True, text=True, check=True
    )
    assert run.stderr == ""
    assert run.stdout == ("" if "1>" in closed else "imported\n")
