"""From logs to a robot: what is wrong with them, the most likely robot, and how well it predicts what was held back."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ballbot_baselines.identification.checks import Predictions, Suspect
from ballbot_baselines.identification.estimate import Found, Problem
from ballbot_baselines.identification.logs import Log, LogError
from ballbot_baselines.identification.scores import _Score, _scores
from ballbot_gym.robot import Ballbot

_HELD_BACK = 0.25  # the last part of every log
_BETTER = 0.95  # of the error of "nothing changes", above which the robot explains nothing
_FAR = 3.0  # spreads of the prior


@dataclass(frozen=True)
class Identified:
    """What was found about a robot.

    | field | meaning |
    |---|---|
    | found | the estimate, from all but the last quarter of each log |
    | predictions | errors on that quarter, of the nominal robot and of the identified one |
    | findings | what is wrong with the logs, and what is surprising about the estimate, in sentences |
    """

    found: Found
    predictions: Predictions
    findings: tuple[str, ...]

    def scores(self, log: Log) -> list[_Score]:
        """The regret of the controller that made a log, in those of its parts that are episodes of Stabilize.

        Returns:
            begin, s, duration, s, cost, optimum and regret of each, at most 3; none if the log has no part that begins away
            from rest and ends at rest, so that its controller cannot be scored.
        """
        return _scores(self.found, log.readings)


def identify(
    robot: Ballbot, logs: list[Log], known: tuple[str, ...] = (), watch: Callable[[int], object] = lambda done: None
) -> Identified:
    """Identifies a robot from logs with the same readings.

    Args:
        robot: the nominal one.
        logs: one or more.
        known: names of parameters that are held at the nominal values, because they were measured otherwise.
        watch: same as in `Problem.most_likely`.

    Raises:
        LogError: a column has the wrong sign or unit, or the robot does not explain the log.
        ValueError: logs with different readings, or an unknown parameter.
    """
    first = logs[0].readings
    for log in logs:
        same = (getattr(log.readings, each) == getattr(first, each) for each in ("names", "delays", "windows"))
        if not all(same):
            raise ValueError(f"{log.path} has other readings than {logs[0].path}; identify them one by one")
    problem = Problem(robot, first.names, known)
    for log in logs:
        _check(problem, log)
    cuts = [round((1 - _HELD_BACK) * len(log.readings.t)) for log in logs]
    found = problem.most_likely([log.readings.between(0, cut) for log, cut in zip(logs, cuts, strict=True)], watch)
    held = [log.readings.between(cut, len(log.readings.t)) for log, cut in zip(logs, cuts, strict=True)]
    lanes = np.stack([problem.z_of(robot, 0.0, found.z), found.z])
    every = [Predictions.of(problem, lanes, readings) for readings in held]
    predictions = _mean(every)
    errors = predictions.errors[1, :, 0] / predictions.constant[:, 0]
    if np.exp(np.mean(np.log(errors))) > _BETTER:
        raise LogError(
            f"{logs[0].path}: the most likely robot predicts readings after {predictions.horizons[0]:g} s no better than if "
            "nothing changed; this is no log of such a robot, or the robot hardly moves in it"
        )
    findings = [f"{log.path}: {finding}" for log in logs for finding in log.findings]
    if found.outliers:
        findings.append(f"readings that contradict the motion of the robot: {found.outliers} more; left out")
    findings += [
        f"{each.name} is {each.value(z):.4g} {each.unit}, far from the nominal {each.nominal:.4g}: are all columns in the "
        "right unit?"
        for each, z in zip(problem.parameters, found.z, strict=True)
        if abs(z) > _FAR and each.unit
    ]
    return Identified(found, predictions, tuple(findings))


def _check(problem: Problem, log: Log) -> None:
    """Raises a LogError that names columns with a wrong sign or unit."""
    try:
        wrong = Suspect.found(problem, log.readings)
    except ValueError as error:
        raise LogError(f"{log.path}: {error}") from None
    if wrong is None:
        return
    of = log.description.by_quantity

    def named(names: tuple[str, ...]) -> str:
        return " and ".join(repr(of[name].name) for name in names)

    what = "columns" if len(wrong.names) > 1 else "column"
    or_else = "".join(f" (or {named(names)})" for names in wrong.others)
    raise LogError(
        f"{log.path}: {what} {named(wrong.names)}{or_else} {wrong.fault}; correct it in the description of the columns"
    )


def _mean(every: list[Predictions]) -> Predictions:
    """The mean errors of several logs."""
    errors, constant = (np.mean([getattr(each, name) for each in every], axis=0) for name in ("errors", "constant"))
    return every[0]._replace(errors=errors, constant=constant)
