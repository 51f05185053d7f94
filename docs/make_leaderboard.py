"""Writes the tables of leaderboard.md from the rows in leaderboard/: python docs/make_leaderboard.py [--release].

With --release it first lists the rows in leaderboard/released.txt, so that the submissions beside them can move to a release.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import released

from ballbot_gym import files
from ballbot_gym.engines import PHYSICS_NAMES
from ballbot_gym.robot import PAPER
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation import comparison
from ballbot_train.evaluation.submissions import Entry, read_entries
from ballbot_train.policy.files import shipped_ways
from ballbot_train.work.console import markdown

PAGE = Path(__file__).parent / "leaderboard.md"
FILMS = Path(__file__).parent / "pictures" / "films"
_TABLES = re.compile(r"(<!-- tables -->\n).*(<!-- end of tables -->)", flags=re.DOTALL)
_HEADER = ["controller", "regret, 95 %", "failed", "group", "best", "worst"]


def page() -> str:
    """The page as the rows make it."""
    boards: dict[tuple[str, str, str], list[Entry]] = {}
    for entry in read_entries():
        boards.setdefault((entry.task, entry.robot, entry.physics), []).append(entry)
    tasks = list(TASKS)
    order = sorted(boards, key=lambda board: (board[1] != PAPER, *board[1:], tasks.index(board[0])))
    parts = (f"## {_title(*board)}\n\n{_table(boards[board])}" for board in order)
    text = "\n".join(parts)
    return _TABLES.sub(lambda match: f"{match[1]}\n{text}\n{match[2]}", PAGE.read_text(encoding="utf-8"))


def shown_name(entry: Entry) -> str:
    """The whole way of a shipped policy, and the name of any other row."""
    return shipped_ways().get(entry.policy, entry.name)


def _title(task: str, robot: str, physics: str) -> str:
    return task.capitalize() + (f", {robot}" if robot != PAPER else "") + f", in {PHYSICS_NAMES[physics]}"


def _table(entries: Sequence[Entry]) -> str:
    """Rows with fewer failures first, then those with less regret."""
    ranked = sorted(entries, key=lambda entry: (-entry.success, entry.regret_mean or 0.0))
    lines = [
        [shown_name(entry), entry.shown_regret, f"{round(len(entry.costs) * (1 - entry.success))}", str(group)]
        for entry, group in zip(ranked, _groups(ranked), strict=True)
    ]
    # links in what was handed in are escaped; ours come after that
    head, rule, *rows = markdown(_HEADER[:-2], lines).splitlines()
    table = [f"{head} {' | '.join(_HEADER[-2:])} |", f"{rule} --- | --- |"]
    for entry, row in zip(ranked, rows, strict=True):
        if entry.link:
            row = row.replace(f"| {shown_name(entry)} |", f"| [{shown_name(entry)}]({entry.link}) |", 1)
        table.append(f"{row} {' | '.join(_filmed(entry, episode) for episode in extremes(entry))} |")
    notes = [note for entry in ranked if (note := _whose_motion(entry, entries))]
    return "\n".join([*table, *(f"\n{note}" for note in notes)]) + "\n"


def _whose_motion(entry: Entry, others: Sequence[Entry]) -> str:
    """A sentence if the motion is another row's or that of optima, else ""."""
    of = [f"`{name}`" for name in entry.copies(others)]
    if entry.optima:
        of.append(f"the certified optimum in {entry.optima} of its episodes")
    return f"The motion of `{entry.name}` is that of {' and '.join(of)}, to 1e-6." if of else ""


def _filmed(entry: Entry, episode: int) -> str:
    """An episode's number, linked to its film if there is one."""
    name = film(entry, episode)
    return f"[{episode}](pictures/films/{name})" if (FILMS / name).exists() else str(episode)


def film(entry: Entry, episode: int) -> str:
    """Name of a film."""
    return f"{Path(entry.file).stem}-{episode}.webp"


def _groups(ranked: Sequence[Entry]) -> list[int]:
    """A new group begins with each row that is worse than the first of the group before, by the paired episodes."""
    groups, leader = [1], ranked[0]
    for entry in ranked[1:]:
        (compared,) = comparison.compare(
            ({}, leader.results()),
            ({}, entry.results()),
            match=(leader.name, entry.name),
            training_margin=comparison.MARGIN,  # a row is one policy, and not its method
        )
        worse = compared.verdict == "worse"
        groups.append(groups[-1] + worse)
        leader = entry if worse else leader
    return groups


def extremes(entry: Entry) -> tuple[int, int]:
    """The episodes that are nearest to and farthest from their optima, the price of failures included."""
    ratios = [result.cost / result.optimum for result in entry.results()]
    return ratios.index(min(ratios)), ratios.index(max(ratios))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--release", action="store_true")
    if parser.parse_args().release:
        released.release()
    files.write(PAGE, page())
