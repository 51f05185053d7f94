"""Submissions to the leaderboard, which anyone can verify without the policy and without trust; and the leaderboard's rows.

A submission is a recording of all certified episodes with a name and a link. `verify` starts every episode at its certified
start. From each recorded state it takes one control step with the recorded action, and the next recorded state must follow.
So it holds on any machine, though the motion as a whole is unstable. Costs, ends and regret are computed from the motion.
"""

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import urlsplit

import numpy as np

import ballbot_train
from ballbot_gym import certified, dynamics, files
from ballbot_gym.certified import version
from ballbot_gym.engines import PHYSICS, make_simulator
from ballbot_gym.env import make_task
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import PAPER, ROBOTS, named_robot
from ballbot_gym.tasks import TASKS, Task
from ballbot_gym.tasks.transition import limit_names, outcome
from ballbot_train.evaluation import recordings
from ballbot_train.evaluation.results import Result, read_results, summarize, to_json

TOLERANCE = 1e-6
"""Largest difference of a recorded state from the one that follows, m, rad and per second, where the state is all that
decides. Rounding to the grids makes at most 1.2e-7 of it. As a force it is 1e-4 N, so nobody can steer with it."""
CONTACT_TOLERANCE = 1e-4
"""The same where an engine simulates the contact of a rolling ball; as a force 0.01 N. Each step then starts with a ball that
rolls without slipping, which honest motions in grip keep within 1e-5. A ball that slips has a spin that none holds."""

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
_SUCCESS, _MISSED, _NO_PLAN = "success", "missed", "no plan"


class SubmissionError(ValueError):
    """A submission that is refused; the message says where and why."""


@dataclass(frozen=True)
class Entry:
    """A row of the leaderboard, as `verify` computes it."""

    name: str
    link: str
    task: str
    robot: str
    physics: str
    policy: str
    """SHA-256 of the weights; "" where there are none, or nobody knows them."""
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

    def results(self) -> list[Result]:
        """Its episodes, beside the certified optima as they are now."""
        optima = certified.load(self.task, self.robot).costs
        return [
            Result(
                task=self.task,
                controller=self.name,
                episode=i,
                physics=self.physics,
                cost=cost,
                optimum=float(optima[i]),
                success=end == _SUCCESS,
                failure=end not in (_SUCCESS, _MISSED),
            )
            for i, (cost, end) in enumerate(zip(self.costs, self.ends, strict=True))
        ]

    @property
    def file(self) -> str:
        """Name of its file."""
        physics = "" if self.physics == next(iter(PHYSICS)) else f"-{self.physics}"
        return recordings.file_of(self.task, self.robot, self.name + physics, ".json")

    def write(self, folder: Path) -> Path:
        """Writes it as JSON."""
        return files.write(folder / self.file, to_json(asdict(self)))


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
            wrong = _wrong_name(entry.name, entry.link)
            version.check(entry.benchmark, path, "record and verify it again")
        except TypeError as error:
            raise files.FileError(f"{path} holds no row of a leaderboard: {error}") from error
        if wrong:
            raise files.FileError(f"{path}: {wrong}")
        entries.append(entry)
    return entries


def read_run(source: Path) -> tuple[dict[str, Any], list[Result]]:
    """`read_results` of a path, or the same of the leaderboard's rows of that name, with the paper's robot.

    Raises:
        ValueError: there is neither.
    """
    if source.exists():
        return read_results(source)
    entries = [entry for entry in read_entries() if entry.robot == PAPER]
    first = sorted(entries, key=lambda entry: list(PHYSICS).index(entry.physics), reverse=True)
    chosen = {entry.task: entry for entry in first if entry.name == str(source)}.values()
    if not chosen:
        names = ", ".join(dict.fromkeys(entry.name for entry in entries))
        raise ValueError(f"{source}: no such file or folder, and no row of the leaderboard, which has {names}")
    policies = {f"{entry.task}/{entry.name}": entry.policy for entry in chosen if entry.policy}
    return {"policies": policies}, [result for entry in chosen for result in entry.results()]


def submit(results: Path, name: str, link: str, out: Path, controller: str = "") -> list[Path]:
    """Writes the submissions of a results folder, one file per task and robot.

    Args:
        results: folder of `evaluate(out=...)`, `ballbot evaluate` or `ballbot benchmark`.
        name: of the rows.
        link: where one reads about the controller; http or https, or "".
        out: folder of the submissions.
        controller: which one, where the folder has several.

    Raises:
        ValueError: there is no recording in it, or one of several controllers.
    """
    found = [recordings.read(path) for path in sorted((results / recordings.FOLDER).glob("*.npz"))]
    names = list(dict.fromkeys(recording.about["controller"] for recording in found))
    if not found:
        raise ValueError(
            f"{results} holds no recordings; make them with evaluate(policy, task, out=...) or ballbot benchmark, without "
            "randomization"
        )
    if (controller or len(names) > 1) and controller not in names:
        raise ValueError(f"{results} holds recordings of {', '.join(names)}; say which with --controller")
    written = []
    for recording in found:
        if recording.about["controller"] == (controller or names[0]):
            about = recording.about | {"name": name, "link": link}
            path = out / recordings.file_of(about["task"], about["robot"], name)
            written.append(files.write(path, recordings.to_bytes(replace(recording, about=about))))
    return written


def verify(path: str | Path, episodes: int = certified.EPISODES) -> Entry:
    """The leaderboard row of a submission, computed from its motion alone.

    Args:
        path: the file.
        episodes: how many it must hold.

    Raises:
        SubmissionError: it breaks a rule; the message names the episode, the control step and the reason.
        FileError: as `recordings.read`.
        ImportError: its physics is not installed.
    """
    content = files.read(path, recordings.LARGEST_FILE)
    recording = recordings.read(path, content)
    facts = _checked_facts(recording.about, path)
    robot = named_robot(facts["robot"])
    task = make_task(facts["task"], facts["robot"])
    if facts["problem"] != task.problem():
        raise SubmissionError(f"{path} is of {facts['problem']}, and the certified episodes are of {task.problem()}")
    if len(recording.lengths) != episodes:
        raise SubmissionError(f"{path} holds {len(recording.lengths)} episodes, and not {episodes}")
    known = certified.load(task, robot, episodes=range(episodes))
    costs, ends = _judged(_Steps(recording, path), facts["physics"], task, robot, known)
    rounded = [float(f"{cost:.9g}") for cost in costs]  # more digits differ between machines
    digest = hashlib.sha256(content).hexdigest()
    entry = Entry(**{key: facts[key] for key in _FACTS}, submission=digest, costs=rounded, ends=ends)
    return replace(entry, **summary(entry))


def summary(entry: Entry) -> dict[str, Any]:
    """The fields of a row that follow from its episodes."""
    row = summarize(entry.results())
    regrets = {name: getattr(row, name) for name in ("regret_mean", "regret_low", "regret_high", "regret_median")}
    shown = {name: float(f"{value:.6g}") if math.isfinite(value) else None for name, value in regrets.items()}
    return {"success": row.success, "falls": row.falls, **shown}


_FACTS = ("name", "link", "task", "robot", "physics", "policy", "versions")


def _checked_facts(about: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    def refuse(why: str) -> NoReturn:
        raise SubmissionError(f"{path}: {why}")

    if wrong := about.keys() ^ (_LENGTHS.keys() | {"versions"}):
        refuse(f"about must hold {', '.join(_LENGTHS)} and versions; it lacks or adds {', '.join(sorted(wrong))[:200]}")
    for key, length in _LENGTHS.items():
        if not isinstance(about[key], str) or len(about[key]) > length:
            refuse(f"{key} must be text of at most {length} characters")
    if wrong := _wrong_name(about["name"], about["link"]):
        refuse(wrong)
    if not re.fullmatch(r"([0-9a-f]{64})?", about["policy"]):
        refuse("policy must be a SHA-256, or empty")
    for key, names in (("task", TASKS), ("robot", ROBOTS), ("physics", PHYSICS)):
        if about[key] not in names:  # a name with a colon would import a module
            refuse(f"unknown {key} {about[key]!r}; known: {', '.join(names)}")
    versions = about["versions"]
    if not isinstance(versions, dict) or len(versions) > 10:
        refuse("versions must be an object of at most ten")
    if not all(isinstance(part, str) and _VERSION.fullmatch(part) for pair in versions.items() for part in pair):
        refuse("versions must be short words by name")
    return dict(about)


def _wrong_name(name: str, link: str) -> str:
    """What is wrong with a row's name or link; pages show both."""
    if not _NAME.fullmatch(name):
        return f"name must be of letters, digits, spaces and . + ( ) - _, not {name!r}"
    try:
        parts = urlsplit(link)
        right = parts.scheme in ("http", "https") and parts.hostname and re.fullmatch(r"[!#-\'*-;=?-~]+", link)
    except ValueError:
        right = False
    return "" if right or not link else f"link must be an address that begins with https:// or http://, not {link!r}"


class _Steps:
    """All control steps of a recording in turn: episode and number (from 1) of each, the states around it and its action."""

    def __init__(self, recording: recordings.Recording, path: str | Path):
        self.path, self.lengths = path, recording.lengths
        rows = recording.lengths + (recording.lengths > 0)
        self.first = np.cumsum(rows) - rows
        self.episode = np.repeat(np.arange(len(rows)), recording.lengths)
        self.step = np.arange(len(self.episode)) - (np.cumsum(self.lengths) - self.lengths)[self.episode] + 1
        before = self.first[self.episode] + self.step - 1
        self.states, self.before, self.after = recording.states, recording.states[before], recording.states[before + 1]
        self.action = recording.actions

    def refuse(self, where: np.ndarray, why: Any) -> None:
        """Refuses the recording if a condition holds of any step; `why` gives the reason of the first."""
        if where.any():
            i = int(np.argmax(where))
            raise SubmissionError(f"{self.path}: episode {self.episode[i]}, step {self.step[i]}: {why(i)}")


def _judged(
    steps: _Steps, physics: str, task: Task, robot: BallbotParams, known: certified.EvaluationSet
) -> tuple[list[float], list[str]]:
    """Cost and end of every episode of a recording that breaks no rule."""
    _check_starts(steps, known)
    longest = steps.lengths[steps.episode] > task.steps
    steps.refuse(longest, lambda i: f"the episode is longer than its {task.steps} control steps")
    steps.refuse(
        np.abs(steps.action).max(1) > 1, lambda i: f"the action {steps.action[i].tolist()} is beyond its limit of 1"
    )
    force = robot.force_limit * steps.action
    simulated = robot.rolls and physics != "rk4"
    tolerance = CONTACT_TOLERANCE if simulated else TOLERANCE
    missed = np.abs(_stepped(physics, robot, task, steps.before, force) - steps.after)
    steps.refuse(~(missed.max(1) <= tolerance), lambda i: _jump(missed[i], tolerance, simulated))
    c = known.constants[steps.episode]
    limits = dynamics.limits(robot, steps.before, force, hold=task.control_dt) if robot.grips and not simulated else ()
    grip = (np.minimum.reduce(limits),) if limits else ()
    did = outcome(task, steps.before, force, steps.after, c, steps.step, grip)
    over = np.broadcast_to(did.terminated + did.truncated > 0, steps.step.shape)
    last = steps.step == steps.lengths[steps.episode]
    steps.refuse(over & ~last, lambda i: "the episode has ended here, and the recording goes on")
    steps.refuse(last & ~over, lambda i: "the recording stops here, and the episode has not ended")
    n = len(steps.lengths)
    cost = np.bincount(steps.episode, np.broadcast_to(did.cost, steps.step.shape), n)
    cost[steps.lengths == 0] = task.survival_pay
    ends, names = [_NO_PLAN] * n, limit_names(task, robot)
    for i in np.flatnonzero(last):
        violated = int(did.violated[i])
        ends[steps.episode[i]] = names[violated] if violated >= 0 else _SUCCESS if did.success[i] > 0 else _MISSED
    return cost.tolist(), ends


def _check_starts(steps: _Steps, known: certified.EvaluationSet) -> None:
    begun = np.flatnonzero(steps.lengths)
    starts = np.rint(steps.states[steps.first[begun]] / recordings.GRID)
    wrong = begun[(starts != np.rint(known.states[begun] / recordings.GRID)).any(1)]
    if len(wrong):
        raise SubmissionError(f"{steps.path}: episode {wrong[0]}, step 0: it does not begin at its certified start")


def _stepped(physics: str, robot: BallbotParams, task: Task, before: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The states (n, 8) one control step after others."""
    dt = task.control_dt
    if physics == "rk4":
        return dynamics.step(robot, before, force, dt, dynamics.substeps_for(dt))
    simulator, reached = make_simulator(physics, robot, dt), np.empty_like(before)
    try:
        for i, (x, u) in enumerate(zip(before.tolist(), force.tolist(), strict=True)):
            simulator.reset(tuple(x))
            reached[i] = simulator.step(tuple(u))
    finally:
        simulator.close()
    return reached


def _jump(missed: np.ndarray, tolerance: float, contact: bool) -> str:
    """What is wrong with a step whose end is missed by so much."""
    i = int(np.argmax(np.where(np.isfinite(missed), missed, np.inf)))
    quantity, unit = dynamics.STATE[i]
    slips = ". Balls that slip cannot be verified; record with physics rk4, where slipping is a failure" * contact
    missed_by = f"{quantity} is off by {missed[i]:.2g} {unit}, and {tolerance:g} is allowed"
    return f"the next state does not follow: {missed_by}{slips}"
