"""`ballbot compare`: is one benchmark's result better than another's?"""

from pathlib import Path
from typing import Any

from ballbot_gym.engines import PHYSICS
from ballbot_gym.robot import PAPER
from ballbot_train.evaluation import comparison, submissions
from ballbot_train.evaluation.results import Result, read_results
from ballbot_train.evaluation.statistics import Interval
from ballbot_train.work.console import console, print_table


def compare(
    a: Path,
    b: Path,
    /,
    match: tuple[str, str] | None = None,
    training_margin: float = comparison.TRAINING_MARGIN,
) -> None:
    """Prints for every task and controller whether B is better than A, worse, or whether the episodes cannot tell.

    Args:
        a: folder of a benchmark, or its leaderboard.json; or the name of a row of the leaderboard, such as lqr.
        b: the same for the other result.
        match: a controller of A and one of B, to compare controllers that have different names.
        training_margin: smallest difference of success or regret that counts between policies with different weights, because
            another training seed can change them by as much; 0.02 is 2 %. Between other controllers 0.1 % counts.
    """
    runs = _read(a), _read(b)
    compared = comparison.compare(runs[0], runs[1], match, training_margin)
    for key in sorted(runs[0][0].keys() & runs[1][0].keys()):
        first, second = (run[0].get(key) for run in runs)
        if first != second and key not in ("policies", "load"):
            console.print(f"{key}: {first} in A, {second} in B")
    header = ["task", "controller", "B is", "episodes", "success B − A", "regret B − A", "because"]
    print_table(f"A: {a}\nB: {b}", header, [_cells(entry) for entry in compared])


def _read(source: Path) -> tuple[dict[str, Any], list[Result]]:
    """`read_results` of a path, or the same of the leaderboard's rows of that name, with the paper's robot.

    Raises:
        ValueError: there is neither.
    """
    if source.exists():
        return read_results(source)
    entries = [entry for entry in submissions.read_entries() if entry.robot == PAPER]
    first = sorted(entries, key=lambda entry: list(PHYSICS).index(entry.physics), reverse=True)
    chosen = {entry.task: entry for entry in first if entry.name == str(source)}.values()
    if not chosen:
        names = ", ".join(dict.fromkeys(entry.name for entry in entries))
        raise ValueError(f"{source}: no such file or folder, and no row of the leaderboard, which has {names}")
    policies = {f"{entry.task}/{entry.name}": entry.policy for entry in chosen if entry.policy}
    return {"policies": policies}, [result for entry in chosen for result in entry.results()]


def _cells(entry: comparison.Comparison) -> list[str]:
    success = Interval(entry.success_low, entry.success_high).text(entry.success, "+")
    regret = Interval(entry.regret_low, entry.regret_high).text(entry.regret, "+")
    return [entry.task, entry.controller, entry.verdict, str(entry.episodes), success, regret, entry.why]
