"""What evaluation measures: episodes' results, rows of the leaderboard, and the files that hold them."""

import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from ballbot_gym import files
from ballbot_gym.certified import version
from ballbot_gym.trajectory import Displayed
from ballbot_train.evaluation.names import shortened, with_way
from ballbot_train.evaluation.statistics import Interval, shown

_LEADERBOARD = "leaderboard"
SMALL = 0.01
"""An optimum below this share of the mean optimum is nearly 0."""
NEAR = 3.0
"""An episode without failure ends near the goal if its last state is within this multiple of the goal's tolerances."""


@dataclass(frozen=True)
class Result:
    """One certified episode under one controller; SI units, angles in degrees. If there is no trajectory, numbers are NaN."""

    task: str
    controller: str
    episode: int
    physics: str
    cost: float
    optimum: float
    success: bool
    failure: bool
    peak_tilt: float = math.nan
    settle_time: float = math.nan
    duration: float = math.nan
    plan_seconds: float = math.nan
    step_seconds: float = math.nan
    effort: float = math.nan
    """Mean of |F| over the episode, N."""
    goal_error: float = math.nan
    """How far from the goal the episode ended, in units of the goal's tolerances: at most 1 in the goal."""
    violated: str = ""
    """Name of the limit at which the episode failed, such as "tilt"."""
    note: str = ""
    """The reason why there is no trajectory: the message of the controller that found no plan; else ""."""
    labels: Mapping[str, Any] = field(default_factory=dict)
    """Further labels of the episode, such as a disturbance. Each is a column of its own in files."""

    @property
    def regret(self) -> float:
        """cost / optimum − 1; NaN for a failed episode, because most of its cost is the price of the failure."""
        return math.nan if self.failure else self.cost / self.optimum - 1


@dataclass(frozen=True, repr=False)
class Row(Displayed):
    """A leaderboard row. Regret, excess, peak tilt, settle time and effort are of the episodes that did not fail."""

    task: str
    controller: str
    physics: str
    """"bullet", "mujoco" or "rk4": in which engine."""
    episodes: int
    success: float
    falls: int
    failed_by: str
    """How many episodes failed at which limit, such as "60 tilt, 4 arena"."""
    near: float
    """Share of the episodes that ended in the goal or near it, within `NEAR` times its tolerances; NaN if it is not known."""
    regret_mean: float
    regret_low: float
    """Of the mean's 95 % bootstrap interval."""
    regret_high: float
    regret_median: float
    excess_mean: float
    """Mean of cost − optimum, in the unit of the cost; use it instead of the regret if some optima are nearly 0."""
    cost_mean: float
    cost_median: float
    peak_tilt_median: float
    settle_time_median: float
    effort_mean: float
    """Mean of |F|, N."""
    plan_ms_median: float
    step_us_median: float
    labels: Mapping[str, Any] = field(default_factory=dict)
    """Further labels of the row. Each is a column of its own in files."""

    def facts(self) -> dict[str, str]:
        return {
            "controller": self.controller,
            "task": self.task,
            "physics": self.physics,
            "episodes": f"{self.episodes}",
            "success": f"{100 * self.success:.4g} %",
            **({"in or near the goal": f"{100 * self.near:.4g} %"} if self.near > self.success else {}),
            "failures": f"{self.falls}" + (f" ({self.failed_by})" if self.failed_by else ""),
            "mean regret": _percent(self.regret_mean),
        }


def warn_of_small(optima: Sequence[float] | np.ndarray) -> None:
    """Warns where optimal costs are nearly 0 next to the others, so that the mean regret is that of a few episodes."""
    known = np.asarray(optima)[np.isfinite(optima)]
    small = int((known < SMALL * known.mean()).sum()) if known.size else 0
    if small:
        warnings.warn(
            f"in {small} of {known.size} episodes the optimum costs less than {SMALL:.0%} of the mean optimum, so that their "
            "regrets decide the mean: compare regret_median, or excess_mean, the mean of cost − optimum",
            stacklevel=3,
        )


def _counted(violated: Iterable[str]) -> str:
    """How many episodes failed at which kind of limit, the most frequent first; their other entries are ""."""
    kinds = Counter(name.partition(" ")[0] for name in violated if name)  # "obstacle 3" is an obstacle
    return ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())


def near_share(goal_errors: Sequence[float] | np.ndarray, failure: Sequence[bool] | np.ndarray) -> float:
    """Share of episodes that ended without failure within `NEAR` times the goal's tolerances; NaN if an end is not known."""
    near = np.where(failure, 0.0, np.asarray(goal_errors) <= NEAR)
    unknown = np.isnan(goal_errors) & ~np.asarray(failure)
    return math.nan if unknown.any() else float(near.mean())


def success_text(success: float, near: float) -> str:
    """A success rate in per cent; where more episodes ended near the goal, followed by their share."""
    text = f"{100 * success:.1f} %"
    return f"{text} ({100 * near:.1f} % near)" if near > success else text


def _row(results: Sequence[Result], seed: int) -> Row:
    """The leaderboard row of one controller on one task; seed is of the bootstrap.

    Warns where the optimum of an episode is nearly 0 next to the others: the mean regret says little then.
    """
    standing = [result for result in results if not result.failure]

    def median(values: Iterable[float]) -> float:
        finite = [value for value in values if math.isfinite(value)]
        return float(np.median(finite)) if finite else math.nan

    regrets = [result.regret for result in standing]
    warn_of_small([result.optimum for result in results])
    low, high = Interval.of_mean(regrets, seed)
    return Row(
        task=results[0].task,
        controller=results[0].controller,
        physics=results[0].physics,
        episodes=len(results),
        success=float(np.mean([result.success for result in results])),
        falls=len(results) - len(standing),
        failed_by=_counted(result.violated for result in results),
        near=near_share([result.goal_error for result in results], [result.failure for result in results]),
        regret_mean=float(np.mean(regrets)) if regrets else math.nan,
        regret_low=low,
        regret_high=high,
        regret_median=median(regrets),
        excess_mean=float(np.mean([each.cost - each.optimum for each in standing])) if standing else math.nan,
        cost_mean=float(np.mean([result.cost for result in results])),
        cost_median=median(result.cost for result in results),
        peak_tilt_median=median(result.peak_tilt for result in standing),
        settle_time_median=median(result.settle_time for result in standing),
        effort_mean=float(np.mean([result.effort for result in standing])) if standing else math.nan,
        plan_ms_median=1e3 * median(result.plan_seconds for result in results),
        step_us_median=1e6 * median(result.step_seconds for result in results),
        labels=results[0].labels,
    )


def _columns(entry: Any) -> dict[str, Any]:
    """The fields of a dataclass instance by name, followed by the labels of a result or a row."""
    named = asdict(entry)
    labels = named.pop("labels", {})
    return named | labels


def leaderboard(results: Sequence[Result], seed: int = 0) -> list[Row]:
    """One row for each task, controller, engine and set of labels, in order. The seed is that of the bootstrap."""
    groups: dict[tuple[Any, ...], list[Result]] = {}
    for result in results:
        groups.setdefault((result.task, result.controller, result.physics, *result.labels.items()), []).append(result)
    return [_row(group, seed) for group in groups.values()]


def write_results(
    rows: Sequence[Row],
    results: Sequence[Result],
    facts: Mapping[str, Any],
    out: Path,
    name: str = _LEADERBOARD,
    renamed: Mapping[str, str] = {},
    **more: Any,
) -> None:
    """Writes NAME.csv with the rows, episodes.csv, and NAME.json, which holds the facts as "about", with the version of the
    benchmark, the rows, and more. leaderboard.json holds the episodes too, which `read_results` reads.

    Some columns of the CSV files may have other names than the fields.
    """
    for table, entries in ((name, rows), ("episodes", results)):
        named = [{renamed.get(key, key): value for key, value in _columns(entry).items()} for entry in entries]
        files.write_csv(out / f"{table}.csv", named)
    if name == _LEADERBOARD:
        more["episodes"] = results
    about = {"benchmark": version.BENCHMARK, **facts}
    files.write(out / f"{name}.json", to_json({"about": about, **more, "rows": rows}))


def read_results(path: Path) -> tuple[dict[str, Any], list[Result]]:
    """What a benchmark's facts and episodes were.

    Args:
        path: its folder or its leaderboard.json.

    Raises:
        ValueError: it is none of these, damaged, or of another version of the benchmark.
    """
    path = Path(path)
    path = path / f"{_LEADERBOARD}.json" if path.is_dir() else path
    try:
        document = files.read_json(path)
        about, results = dict(document["about"]), [_from_json(entry) for entry in document["episodes"]]
    except files.FileError as error:
        raise ValueError(f"{path} holds no episodes of a benchmark: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{path} holds no episodes of a benchmark: {error!r}") from error
    version.check(about.get("benchmark"), path, "measure again")
    return about, results


def _from_json(entry: Mapping[str, Any]) -> Result:
    values: dict[str, Any] = {key: math.nan if value is None else value for key, value in entry.items()}
    for each in fields(Result)[:-1]:  # without the labels, which results of a leaderboard do not have
        value, kind = values.get(each.name, each.default), cast(Any, each.type)
        fits = isinstance(value, (int, float) if kind is float else kind)
        if not fits or (isinstance(value, bool) and kind is not bool):
            raise TypeError(f"{each.name} of an episode is {value!r:.200}")
        values[each.name] = kind(value)  # a whole number that no float holds is an OverflowError
    result = Result(**values)
    if not (math.isfinite(result.cost) and 0 < result.optimum < math.inf):
        raise ValueError(
            f"episode {result.episode} of {result.controller} on {result.task} has the cost {result.cost} and the optimum "
            f"{result.optimum}"
        )
    return result


def to_json(document: Mapping[str, Any]) -> str:
    """A document as JSON; its lists of dataclass instances become lists of objects, one a line, with null for NaN."""

    def line(entry: Any) -> str:
        return json.dumps({key: _or_null(value) for key, value in _columns(entry).items()}, ensure_ascii=False)

    def text(value: Any) -> str:
        if isinstance(value, list | tuple) and value and hasattr(value[0], "__dataclass_fields__"):
            return "[\n  " + ",\n  ".join(map(line, value)) + "\n ]"
        return json.dumps(value, ensure_ascii=False)

    return "{\n" + ",\n".join(f" {json.dumps(key)}: {text(value)}" for key, value in document.items()) + "\n}\n"


def _or_null(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


TABLE: dict[str, Callable[[Row], str]] = {
    "task": lambda row: row.task,
    "controller": lambda row: row.controller,
    "physics": lambda row: row.physics,
    "success": lambda row: success_text(row.success, row.near),
    "falls": lambda row: f"{row.falls}/{row.episodes}" + (f" ({row.failed_by})" if row.failed_by else ""),
    "regret mean": lambda row: Interval(row.regret_low, row.regret_high).text(row.regret_mean),
    "regret median": lambda row: _percent(row.regret_median),
    "peak tilt": lambda row: shown(row.peak_tilt_median, ".1f", "°"),
    "settle": lambda row: shown(row.settle_time_median, ".2f", " s"),
    "mean force": lambda row: shown(row.effort_mean, ".0f", " N"),
    "plan": lambda row: shown(row.plan_ms_median, ".0f", " ms"),
    "per step": lambda row: shown(row.step_us_median, ".0f", " µs"),
}
"""What the leaderboard's table shows of a row: behind the mean regret its interval; what does not exist is a dash."""


def table_cells(
    shown: Mapping[str, Callable[[Any], str]], rows: Sequence[Any], ways: Mapping[str, str] = {}
) -> list[list[str]]:
    """Rows as text, one cell for each entry of `shown`. Paths of policies are as short as possible while they differ.

    `ways` are the whole ways of shipped policies by "TASK/NAME", see `MeasuredRun`.
    """
    table = [[text(row) for text in shown.values()] for row in rows]
    if "controller" in shown:
        place = list(shown).index("controller")
        short = shortened(line[place] for line in table)
        for row, line in zip(rows, table, strict=True):
            labels, key = getattr(row, "labels", {}), f"{shown['task'](row)}/{line[place]}"
            if "made_for" in labels and labels["made_for"] != labels["robot"]:
                key = f"{labels['made_for']}/{key}"
            line[place] = with_way(short[line[place]], ways.get(key, ""))
    return table


def _percent(share: float) -> str:
    """A share in words, "–" where there is none."""
    return f"{100 * share:.2f} %" if math.isfinite(share) else "–"
