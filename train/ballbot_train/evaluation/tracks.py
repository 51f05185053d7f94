"""Controllers on robots that nobody told them: their regret on the tracks of `ballbot_gym.randomization`, in three parts.

Every episode has an optimum of its own: that of its robot, whose first forces are none while its delay lasts. Who reaches it
would have to know what was drawn. In units of that optimum J, regret splits into what adds up:

- what not knowing costs: how far the best controller of the table is from J in the same episode,
- what the controller loses: how much dearer it is than that one.

What delay costs is told beside them, because no controller could avoid it: J less the optimum without delay.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ballbot_gym.env import make_task
from ballbot_gym.randomization import TRACKS, checked_randomization
from ballbot_gym.robots import PAPER
from ballbot_train.evaluation import optima
from ballbot_train.evaluation.results import Result, Row, shown, summarize
from ballbot_train.evaluation.robustness import Condition

EXPERTS = {
    "unknown": ("cautious", "nmpc-adaptive"),
    "late": ("nmpc-adaptive",),
    "noisy": ("nmpc-ekf",),
    "real": ("nmpc-adaptive-ekf",),
}
"""The experts that are made for each track, which run there where no controllers are named."""


def conditions(tracks: Sequence[str]) -> list[Condition]:
    """The tracks of these names.

    Raises:
        ValueError: no track of such a name.
    """
    return [Condition(name, 0.0, checked_randomization(name), own_optima=True) for name in tracks]


def with_experts(
    controllers: Mapping[str, Sequence[str]], wanted: Sequence[Condition]
) -> tuple[dict[str, list[str]], list[Condition]]:
    """The same controllers by task and the experts of these tracks, each of which is left out on the other tracks."""
    experts = list(dict.fromkeys(name for condition in wanted for name in EXPERTS[condition.name]))
    others = {c.name: tuple(name for name in experts if name not in EXPERTS[c.name]) for c in wanted}
    chosen = {task: [*group, *experts] for task, group in controllers.items()}
    return chosen, [replace(condition, left_out=others[condition.name]) for condition in wanted]


def rows_of(results: Sequence[Result], robot: str = PAPER, seed: int = 0) -> list[Row]:
    """One row per track, task and controller; seed is of the bootstrap.

    A row is told by its "track" and by shares of the mean, in units of the episode's optimum, NaN without an episode:
    "delay_costs", what delay adds to the optimum; "not_knowing_costs", the regret of the "best" controller in the episodes in
    which neither fails; "controller_loses", the regret beyond that in the same episodes. The best controller is, of those
    that succeed most often, the one of least mean regret.
    """
    groups: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for result in results:
        groups.setdefault((result.told["stress"], result.task), {}).setdefault(result.controller, []).append(result)
    rows = []
    for (track, task), group in groups.items():
        plain = {name: summarize(done, seed) for name, done in group.items()}
        best = min(plain, key=lambda name: (-plain[name].success, _last_if_nan(plain[name].regret_mean)))
        episodes = [result.episode for result in group[best]]
        known = optima.known(make_task(task, robot), robot, episodes, randomization=TRACKS[track])
        delay = float(np.mean(1 - known.ideal[episodes] / known.costs[episodes]))
        of_best = {result.episode: result.regret for result in group[best]}
        for name, done in group.items():
            pairs = np.array([(of_best[result.episode], result.regret) for result in done])
            pairs = pairs[np.isfinite(pairs).all(axis=1)]
            unknown, own = pairs.mean(axis=0).tolist() if len(pairs) else (math.nan, math.nan)
            costs = {"delay_costs": delay, "not_knowing_costs": unknown, "controller_loses": own - unknown}
            rows.append(replace(plain[name], told={"track": track, **costs, "best": best}))
    return rows


def _last_if_nan(value: float) -> float:
    return value if math.isfinite(value) else math.inf


def _percent(*values: float) -> str:
    return " to ".join(shown(100 * value, ".2f") for value in values)


_COLUMNS: dict[str, Callable[[Row], str]] = {
    "track": lambda row: row.told["track"],
    "task": lambda row: row.task,
    "controller": lambda row: row.controller,
    "success, %": lambda row: f"{100 * row.success:.4g}",
    "failures": lambda row: f"{row.falls} of {row.episodes}",
    "mean regret, %": lambda row: _percent(row.regret_mean),
    "95 % interval": lambda row: _percent(row.regret_low, row.regret_high),
    "delay costs, %": lambda row: _percent(row.told["delay_costs"]),
    "not knowing costs, %": lambda row: _percent(row.told["not_knowing_costs"]),
    "controller loses, %": lambda row: _percent(row.told["controller_loses"]),
}
HEADER = list(_COLUMNS)


def cells(row: Row) -> list[str]:
    """A line of the table."""
    return [text(row) for text in _COLUMNS.values()]
