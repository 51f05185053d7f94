"""`ballbot verify`: the leaderboard row of a submission, computed from its motion alone."""

from collections.abc import Sequence
from pathlib import Path

from ballbot_train.evaluation import submissions
from ballbot_train.work.console import console, print_table


def verify(files: tuple[Path, ...], /, *, write: Path | None = None) -> None:
    """Verifies submissions to the leaderboard from their motions, without the policy, and prints the row of each.

    Args:
        files: submissions, as `ballbot submit` writes them.
        write: folder into which each row is written as JSON, such as leaderboard.
    """
    if not files:
        raise ValueError("give at least one submission")
    entries, refused = [], []
    for path in files:
        try:
            entries.append(submissions.verify(path))
        except ValueError as error:
            refused.append(f"refused: {error}")
    print_entries(entries)
    for entry in entries if write is not None else ():
        console.print(f"row: {entry.write(write)}")
    if refused:
        raise submissions.SubmissionError("\n".join(refused))


def print_entries(entries: Sequence[submissions.Entry]) -> None:
    """Prints rows of the leaderboard as a table."""
    if entries:
        rows = [
            {
                "task": entry.task,
                "name": entry.name,
                "robot": entry.robot,
                "physics": entry.physics,
                "success": f"{entry.success:.1%}",
                "falls": f"{entry.falls}/{len(entry.costs)}",
                "regret mean": entry.shown_regret,
            }
            for entry in entries
        ]
        print_table("verified", [*rows[0]], [[*row.values()] for row in rows])
    known = submissions.read_entries() if entries else []
    for entry in entries:
        if of := entry.copies(known):
            console.print(
                f"{entry.name}: its costs agree with those of {', '.join(of)} to 1e-6; is it the same motion?"
            )
        if entry.optima:
            console.print(f"{entry.name}: {entry.optima} motions agree with the certified optimal motions to 1e-6")
