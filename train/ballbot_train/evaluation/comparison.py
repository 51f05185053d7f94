"""Two benchmarks of the same episodes, compared pair by pair: better, worse, or cannot tell.

Both runs have the same episodes, so the results of each episode are compared with each other, and the difficulty of the
episode cancels. The mean difference per episode and its 95 % bootstrap interval are reported. A difference counts only if it
exceeds a margin:

- Success decides first, if a sign test over the episodes in which only one of the two succeeded agrees, because the bootstrap
  interval of a handful of falls is too narrow. Otherwise regret decides, over the episodes in which neither failed.
- Training with another seed gives another policy. Each method is represented by one seed, so no number of episodes separates
  the methods. Policies with different weights must therefore differ by more than `TRAINING_MARGIN`, which is about what a
  seed changes. To compare methods more finely, train several seeds of each.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ballbot_baselines import CONTROLLERS, VARIANTS
from ballbot_train.evaluation.results import Result
from ballbot_train.evaluation.statistics import CONFIDENCE, Interval

MARGIN = 0.001
"""Of regret and of success: PyBullet and the model of the optimum differ by as much."""
TRAINING_MARGIN = 0.02
"""The same between policies that were trained separately."""

_FEWEST = 8  # episodes; the bootstrap interval of fewer is too narrow
_SAME_OPTIMUM = 1e-6  # relative; beyond this, two episodes of the same number are different ones


@dataclass(frozen=True)
class Comparison:
    """One controller on one task: the result of B minus that of A. Success and regret are fractions."""

    task: str
    controller: str
    episodes: int
    """How many both ran."""
    success: float
    success_low: float
    success_high: float
    regret: float
    """Over the episodes in which neither failed; less is better."""
    regret_low: float
    regret_high: float
    verdict: str
    """B is "better" or "worse", "cannot tell", or "not comparable"."""
    why: str


Run = tuple[Mapping[str, Any], Sequence[Result]]
"""Facts and episodes, as `read_results` gives."""


def compare(
    a: Run,
    b: Run,
    match: tuple[str, str] | None = None,
    training_margin: float = TRAINING_MARGIN,
) -> list[Comparison]:
    """Compares controllers of the same name on every task that both runs have.

    Args:
        a: a run.
        b: another.
        match: a controller of A and one of B to compare instead; where each has but one, they are compared anyway.
        training_margin: of success and regret, between policies with different weights; else it is `MARGIN`.

    Raises:
        ValueError: there is nothing to compare, the margin is no number from 0, or a run holds an episode twice.
    """
    if not 0 <= training_margin < math.inf:
        raise ValueError(f"training_margin must be a number from 0, not {training_margin}")
    groups_a, groups_b = _groups(a[1]), _groups(b[1])
    pairs = _pairs(groups_a, groups_b, match)
    if not pairs:
        raise ValueError(
            f"A and B have no task and controller in common: A has {_named(groups_a)}, B has {_named(groups_b)}"
        )
    return [
        _compare_one(
            task,
            name_a if name_a == name_b else f"{name_a} → {name_b}",
            groups_a[task, name_a],
            groups_b[task, name_b],
            training_margin if _trained_apart(f"{task}/{name_a}", f"{task}/{name_b}", a[0], b[0]) else MARGIN,
        )
        for task, name_a, name_b in pairs
    ]


Groups = dict[tuple[str, str], dict[int, Result]]


def _groups(results: Sequence[Result]) -> Groups:
    groups: Groups = {}
    for result in results:
        group = groups.setdefault((result.task, result.controller), {})
        if result.episode in group:
            raise ValueError(f"episode {result.episode} of {result.controller} on {result.task} occurs twice")
        group[result.episode] = result
    return groups


def _named(groups: Groups) -> str:
    return ", ".join(f"{controller} on {task}" for task, controller in groups) or "nothing"


def _pairs(a: Groups, b: Groups, match: tuple[str, str] | None) -> list[tuple[str, str, str]]:
    """(task, controller of A, controller of B)."""
    tasks = [task for task in dict.fromkeys(task for task, _ in a) if any(task == other for other, _ in b)]
    if match is None:
        common = [(task, name, name) for task, name in a if (task, name) in b]
        only_a, only_b = ({name for _, name in groups} for groups in (a, b))
        if common or len(only_a) != 1 or len(only_b) != 1:
            return common
        match = only_a.pop(), only_b.pop()
    return [(task, *match) for task in tasks if (task, match[0]) in a and (task, match[1]) in b]


def _trained_apart(a: str, b: str, about_a: Mapping[str, Any], about_b: Mapping[str, Any]) -> bool:
    """Whether either is a learned policy and they have not the same weights."""
    if all(name.partition("/")[2] in CONTROLLERS | VARIANTS for name in (a, b)):
        return False
    weights = about_a.get("policies", {}).get(a)
    return weights is None or weights != about_b.get("policies", {}).get(b)


def _compare_one(task: str, name: str, a: Mapping[int, Result], b: Mapping[int, Result], margin: float) -> Comparison:
    shared = sorted(a.keys() & b.keys())
    pairs = [(a[i], b[i]) for i in shared]
    hindrance = _hindrance(pairs)
    nothing = math.nan, (math.nan, math.nan)
    success = regret = nothing
    if hindrance:
        outcome, why = "not comparable", hindrance
    else:
        wins = np.array([float(second.success) - float(first.success) for first, second in pairs])
        regrets = np.array([s.regret - f.regret for f, s in pairs if not (f.failure or s.failure)])
        success = float(wins.mean()), Interval.of_mean(wins)
        regret = (float(regrets.mean()), Interval.of_mean(regrets)) if len(regrets) else nothing
        outcome, why = _judge(wins, success[1], regret[1], len(regrets), margin)
    return Comparison(task, name, len(shared), success[0], *success[1], regret[0], *regret[1], outcome, why)


def _hindrance(pairs: Sequence[tuple[Result, Result]]) -> str:
    """Why the episodes cannot be compared; empty if they can."""
    if not pairs:
        return "no episode was run by both"
    if any(first.physics != second.physics for first, second in pairs):
        return f"different physics: {pairs[0][0].physics} and {pairs[0][1].physics}"
    changed = [f.episode for f, s in pairs if not math.isclose(f.optimum, s.optimum, rel_tol=_SAME_OPTIMUM)]
    if changed:
        return (
            f"other episodes: the optimum of episode {changed[0]} differs, and of {len(changed)} of {len(pairs)} in all"
        )
    return ""


def _judge(
    wins: np.ndarray, success: tuple[float, float], regret: tuple[float, float], standing: int, margin: float
) -> tuple[str, str]:
    from scipy import stats  # slow to import

    if len(wins) < _FEWEST:
        return "cannot tell", f"{len(wins)} episodes are too few"
    won, lost = int(np.sum(wins > 0)), int(np.sum(wins < 0))
    by_success = _verdict(*success, margin)
    if by_success != "cannot tell" and stats.binomtest(won, won + lost).pvalue < 1 - CONFIDENCE:
        return by_success, f"succeeds in {won} episodes where A does not, A in {lost} where it does not"
    by_regret = _verdict(-regret[1], -regret[0], margin) if standing >= _FEWEST else "cannot tell"
    if by_regret != "cannot tell":
        return by_regret, f"regret, over {standing} episodes"
    return "cannot tell", f"no difference beyond {margin:.1%} is sure"


def _verdict(low: float, high: float, margin: float) -> str:
    """What the interval of a difference says where more is better; differences up to the margin decide nothing."""
    if low > margin:
        return "better"
    return "worse" if high < -margin else "cannot tell"
