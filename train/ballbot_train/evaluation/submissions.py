"""Submissions to the leaderboard, which anyone can verify without the policy and without trust; and the leaderboard's rows.

A submission is a recording of all certified episodes with a name and a link. `verify` starts every episode at its certified
start. From each recorded state it takes one control step with the recorded action, and the next recorded state must follow.
So it holds on any machine, though the motion as a whole is unstable. Costs, ends and regret are computed from the motion.
What the small errors of all steps can have changed in the cost is bounded too.
"""

import hashlib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

import ballbot_train
from ballbot_gym import certified, files
from ballbot_gym.certified import version
from ballbot_gym.engines import PHYSICS
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, file_name, named_robot
from ballbot_gym.step import limit_names
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation import recordings
from ballbot_train.evaluation.judge import MISSED, NO_PLAN, STEERED, SUCCESS, Steps, SubmissionError
from ballbot_train.evaluation.names import file_part
from ballbot_train.evaluation.results import Result, leaderboard, to_json
from ballbot_train.evaluation.statistics import Interval

LEAST_REGRET = {"rk4": (-1e-3, -1e-4), "bullet": (-0.01, -0.002), "mujoco": (-0.01, -0.002)}
"""Of an episode, and of the mean of a row: what the engine's difference from the optimum's closed form explains."""

_IN_WHEEL = Path(ballbot_train.__file__).parent / "leaderboard"
LEADERBOARD = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_WHEEL.parents[2] / "leaderboard"
"""The leaderboard's rows. A wheel holds them inside the package, a checkout in its root."""

_LENGTHS = {
    "name": 40,
    "link": 200,
    "task": 60,
    "problem": 2000,
    "robot": 60,
    "physics": 20,
    "controller": 300,
    "policy": 64,
}
_NAME = re.compile(r"\w[\w .+()-]*", flags=re.ASCII)
_VERSION = re.compile(r"[\w.+-]{1,60}", flags=re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?(:[0-9]{1,5})?")
_LINK = re.compile(r"[\w.~:/?#@!$&'*+,;=%-]+", flags=re.ASCII)  # a cell of a table ends at | and a link at ) or ]


@dataclass(frozen=True)
class Entry:
    """A row of the leaderboard, as `verify` computes it."""

    name: str
    link: str
    task: str
    robot: str
    physics: str
    policy: str
    """SHA-256 of the weights; "" if there are none, or they were not recorded."""
    submission: str
    """SHA-256 of the file that was verified."""
    versions: dict[str, str]
    costs: list[float]
    """Of each certified episode, in order, the price of a failure included."""
    ends: list[str]
    """How each ended: "success", "missed" (the goal, in time), "no plan", or the limit that was violated."""
    benchmark: str = version.BENCHMARK
    success: float = 0.0
    falls: int = 0
    regret_mean: float | None = None
    """Of the episodes that did not fail; null where all did."""
    regret_low: float | None = None
    regret_high: float | None = None
    regret_median: float | None = None
    steered: float | None = None
    """No more than this part of an episode's cost can be due to errors of the recording; null if it was not checked."""
    optima: int = 0
    """How many episodes are the certified optimal motions to 1e-6, of those whose optimal motions are known."""

    def results(self) -> list[Result]:
        """Its episodes, with the certified optima of the installed version."""
        optima = certified.load(self.task, self.robot).costs
        return [
            Result(
                task=self.task,
                controller=self.name,
                episode=i,
                physics=self.physics,
                cost=cost,
                optimum=float(optima[i]),
                success=end == SUCCESS,
                failure=end not in (SUCCESS, MISSED),
            )
            for i, (cost, end) in enumerate(zip(self.costs, self.ends, strict=True))
        ]

    def summary(self) -> dict[str, Any]:
        """The fields that follow from its episodes."""
        (row,) = leaderboard(self.results())
        regrets = {name: getattr(row, name) for name in ("regret_mean", "regret_low", "regret_high", "regret_median")}
        shown = {name: float(f"{value:.6g}") if math.isfinite(value) else None for name, value in regrets.items()}
        return {"success": row.success, "falls": row.falls, **shown}

    def too_good(self) -> str:
        """Why no controller can have earned it, "" if one can: it beats optima by more than its engine's difference."""
        of_episode, of_mean = LEAST_REGRET[self.physics]
        regrets = [result.cost / result.optimum - 1 if result.success else 0.0 for result in self.results()]
        worst = min(range(len(regrets)), key=regrets.__getitem__)
        where, regret, least = f"episode {worst}", regrets[worst], of_episode
        if regret >= least:
            where, regret, least = "the mean of all episodes", self.regret_mean or 0.0, of_mean
        if regret >= least:
            return ""
        return (
            f"{where} costs {-regret:.3%} less than the optimum, and {self.physics} explains at most {-least:.3%}. "
            "If you found a better optimum, open an issue with the recording"
        )

    def copies(self, others: Iterable["Entry"]) -> list[str]:
        """Names of the rows whose motions these are, as far as costs tell: half of the episodes or more agree to 1e-6."""
        same = []
        for other in others:
            board = (other.task, other.robot, other.physics) == (self.task, self.robot, self.physics)
            if board and other.name != self.name and len(other.costs) == len(self.costs):
                near = np.isclose(self.costs, other.costs, rtol=1e-6, atol=0)
                moved = np.array(self.ends) != NO_PLAN
                if 2 * np.count_nonzero(near & moved & (np.array(self.ends) == other.ends)) >= len(near):
                    same.append(other.name)
        return same

    @property
    def shown_regret(self) -> str:
        """The mean regret with its interval, %; a dash where every episode failed."""
        numbers = self.regret_mean, self.regret_low, self.regret_high
        mean, low, high = (math.nan if value is None else value for value in numbers)
        return Interval(low, high).text(mean)

    @property
    def file(self) -> str:
        """Name of its file."""
        physics = "" if self.physics == next(iter(PHYSICS)) else f"-{self.physics}"
        return f"{file_name(self.task, self.robot)}-{file_part(self.name)}{physics}.json"

    def write(self, folder: Path) -> Path:
        """Writes it as JSON.

        Raises:
            SubmissionError: the row of another submission has this name.
        """
        path = folder / self.file
        if path.exists() and files.read_json(path).get("submission") != self.submission:
            raise SubmissionError(
                f"{path} is the row of another submission of this name; submit under another --name, or delete that row "
                "first if it is yours"
            )
        return files.write(path, to_json(asdict(self)))


def read_entries(folder: Path = LEADERBOARD) -> list[Entry]:
    """The rows of a leaderboard, in the order of their files' names.

    Raises:
        FileError: a file that holds no row.
        ValueError: a row of another version of the benchmark.
    """
    entries = []
    for path in sorted(folder.glob("*.json")):
        try:
            entry = Entry(**{"benchmark": "1"} | files.read_json(path))
            version.check(entry.benchmark, path, "record and verify it again")
        except TypeError as error:
            raise files.FileError(f"{path} holds no row of a leaderboard: {error}") from error
        if wrong := _wrong_row(entry):
            raise files.FileError(f"{path}: {wrong}")
        entries.append(entry)
    return entries


def _wrong_row(entry: Entry) -> str:
    """What is wrong with a row as a file states it, before anything else reads it; "" if nothing."""
    costs, ends = entry.costs, entry.ends
    lists = isinstance(costs, list) and isinstance(ends, list) and len(costs) == len(ends) <= certified.EPISODES
    if not lists or not all(isinstance(cost, int | float) and math.isfinite(cost) for cost in costs):
        return f"costs and ends must be lists of one length, at most {certified.EPISODES}, and costs must be numbers"
    stated = {name: value for name, value in asdict(entry).items() if name in _FACTS}
    if wrong := _wrong_facts(stated):
        return wrong
    if not isinstance(entry.submission, str) or not re.fullmatch("[0-9a-f]{64}", entry.submission):
        return "submission must be a SHA-256"
    known = {SUCCESS, MISSED, NO_PLAN, *limit_names(make_task(entry.task, entry.robot), named_robot(entry.robot))}
    unknown = [end for end in ends if end not in known]
    return f"unknown end {unknown[0]!r}; known: {', '.join(sorted(known))}" if unknown else ""


def pack(results: Path, name: str, link: str, controller: str = "") -> dict[str, bytes]:
    """The submissions of a results folder, one for each task and robot: their content by the names of their files.

    Args:
        results: folder of `evaluate(out=...)`, `ballbot evaluate` or `ballbot benchmark`.
        name: of the rows.
        link: where one reads about the controller; http or https, or "".
        controller: which one, where the folder has several.

    Raises:
        SubmissionError: what a recording says about itself is wrong.
        ValueError: there is no recording in it, or one of several controllers.
    """
    paths = sorted((results / recordings.FOLDER).glob("*.npz"))
    found = [(path, recordings.Recording.read(path)) for path in paths]
    names = list(dict.fromkeys(str(recording.about.get("controller")) for _, recording in found))
    if not found:
        raise ValueError(
            f"{results} holds no recordings; make them with evaluate(policy, task, out=...) or ballbot benchmark, without "
            "randomization"
        )
    if (controller or len(names) > 1) and controller not in names:
        raise ValueError(f"{results} holds recordings of {', '.join(names)}; say which with --controller")
    packed: dict[str, bytes] = {}
    for path, recording in found:
        if recording.about.get("controller") == (controller or names[0]):
            about = _checked_facts(recording.about | {"name": name, "link": link}, path)
            row = Entry(**{key: about[key] for key in _FACTS}, submission="", costs=[], ends=[])
            file = Path(row.file).with_suffix(".npz").name  # so that it can lie in the folder of its row
            if file in packed:
                raise SubmissionError(
                    f"{results} holds two recordings for {file}; evaluate each into a folder of its own"
                )
            packed[file] = replace(recording, about=about).to_bytes()
    return packed


def verify(path: str | Path, episodes: int = certified.EPISODES, content: bytes | None = None) -> Entry:
    """The leaderboard row of a submission, computed from its motion alone.

    Args:
        path: the file.
        episodes: how many it must hold.
        content: what it will hold, if it is not written yet.

    Raises:
        SubmissionError: it breaks a rule; the message names the episode, the control step and the reason.
        FileError: as `Recording.read`.
        ImportError: its physics is not installed.
    """
    content = files.read(path, recordings.LARGEST_FILE) if content is None else content
    recording = recordings.Recording.read(path, content)
    facts = _checked_facts(recording.about, path)
    robot = named_robot(facts["robot"])
    task = make_task(facts["task"], facts["robot"])
    if facts["problem"] != task.problem():
        raise SubmissionError(
            f"{path} was recorded in {facts['problem']}, and the certified episodes are those of {task.problem()}"
        )
    if len(recording.lengths) != episodes:
        raise SubmissionError(f"{path} holds {len(recording.lengths)} episodes, and not {episodes}")
    known = certified.load(task, robot, episodes=range(episodes))
    steps = Steps(recording, path)
    costs, ends = steps.judged(facts["physics"], task, robot, known)
    rounded = [float(f"{cost:.9g}") for cost in costs]  # more digits differ between machines
    digest = hashlib.sha256(content).hexdigest()
    entry = Entry(**{key: facts[key] for key in _FACTS}, submission=digest, costs=rounded, ends=ends)
    entry = replace(entry, **entry.summary(), steered=STEERED, optima=_optimal_motions(steps, known))
    if why := entry.too_good():
        raise SubmissionError(f"{path}: {why}")
    return entry


def _optimal_motions(steps: Steps, known: certified.EvaluationSet) -> int:
    count = 0
    for trajectory, first, n in zip(known.trajectories, steps.first, steps.lengths, strict=False):
        states = steps.states[first : first + n + 1]
        count += states.shape == trajectory.x.shape and bool(np.abs(states - trajectory.x).max() <= 1e-6)
    return count


_FACTS = ("name", "link", "task", "robot", "physics", "policy", "versions")


def _checked_facts(about: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    if wrong := about.keys() ^ (_LENGTHS.keys() | {"versions"}):
        why = f"about must hold {', '.join(_LENGTHS)} and versions; it lacks or adds {', '.join(sorted(wrong))[:200]}"
    else:
        why = _wrong_facts(about)
    if why:
        raise SubmissionError(f"{path}: {why}")
    return dict(about)


def _wrong_facts(about: Mapping[str, Any]) -> str:
    """What is wrong with facts of a submission or of a row; "" if nothing. Nothing is imported."""
    for key in about.keys() - {"versions"}:
        if not isinstance(about[key], str) or len(about[key]) > _LENGTHS[key]:
            return f"{key} must be text of at most {_LENGTHS[key]} characters"
    if wrong := _wrong_name(about["name"], about["link"]):
        return wrong
    if not re.fullmatch(r"([0-9a-f]{64})?", about["policy"]):
        return "policy must be a SHA-256, or empty"
    for key, names in (("task", TASKS), ("robot", ROBOTS), ("physics", PHYSICS)):
        if about[key] not in names:  # a name with a colon would import a module
            return f"unknown {key} {about[key]!r}; known: {', '.join(names)}"
    versions = about["versions"]
    if not isinstance(versions, dict) or len(versions) > 10:
        return "versions must be an object of at most ten"
    if not all(isinstance(part, str) and _VERSION.fullmatch(part) for pair in versions.items() for part in pair):
        return "versions must be short words by name"
    return ""


def _wrong_name(name: str, link: str) -> str:
    """What is wrong with a row's name or link; pages show both."""
    if not _NAME.fullmatch(name):
        return f"name must be of letters, digits, spaces and . + ( ) - _, not {name!r}"
    try:
        parts = urlsplit(link)
        right = parts.scheme in ("http", "https") and _HOST.fullmatch(parts.netloc) and _LINK.fullmatch(link)
    except ValueError:
        right = False
    return "" if right or not link else f"link must be an address that begins with https:// or http://, not {link!r}"
