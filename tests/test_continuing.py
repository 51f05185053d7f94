"""A run continues with the problem, robot, policies and settings with which it began, or is refused with what changed."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from ballbot_gym import TASKS, Stabilize, certified, named_robot, ops
from ballbot_gym.robot import (
    ROBOTS,
    ROLLING_URDF_PATH,
    Registered,
    Robot,
    read_urdf,
    registered_name,
    robot_name,
)
from ballbot_gym.tasks.identity import PARTS, changed_parts, problem_parts
from ballbot_train.commands.certify import certify
from ballbot_train.commands.demos import demos
from ballbot_train.evaluation.runner import MeasuredRun
from ballbot_train.learning import apg, training
from ballbot_train.learning.demonstrations import DemoConfig
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import PolicySpec
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.work import jobs

PAPER = named_robot("paper")
TINY = apg.ApgConfig(iterations=1, evaluations=1, num_envs=2, episode_seconds=0.04, hidden=(4,))


@dataclass(frozen=True)
class Dearer(Stabilize):
    """Stabilize with another cost, under its name and with its fields."""

    def cost(self, x, u, c):
        return 1.001 * super().cost(x, u, c)


@dataclass(frozen=True)
class Nearer(Stabilize):
    """With other episodes."""

    def draw_state(self, z, c, params):
        x, *rest = super().draw_state(z, c, params)
        return 0.9 * x, *rest


@dataclass(frozen=True)
class Stricter(Stabilize):
    """With another limit and another goal."""

    def margins(self, x, c):
        return tuple(margin - 0.01 for margin in super().margins(x, c))

    def goal(self, x, c):
        return tuple(excess + 0.01 for excess in super().goal(x, c))


@dataclass(frozen=True)
class Blurred(Stabilize):
    """With another observation."""

    def observe(self, x, c):
        return ops.stack(tuple(0.5 * value for value in ops.components(super().observe(x, c))), like=x)


CHANGES = {
    "costs": Dearer,
    "episodes": Nearer,
    "limits and goal": Stricter,
    "observations": Blurred,
}
for kind in CHANGES.values():
    kind.__name__ = "Stabilize"


def edited(urdf: Path, into: Path, mass: str) -> Robot:
    """The robot of a file in which the body has another mass."""
    into.write_text(urdf.read_text().replace('<mass value="15', f'<mass value="{mass}'))
    return read_urdf(into)


@pytest.mark.parametrize("change", CHANGES)
def test_the_part_of_a_problem_that_changed_is_named(change: str, tmp_path: Path) -> None:
    held, wanted = (problem_parts(kind(), PAPER) for kind in (Stabilize, CHANGES[change]))
    assert set(held) == set(PARTS)
    verb = "has" if change == "goal" else "have"
    with pytest.raises(ValueError, match=f"another problem: its {change} {verb} changed since; give another --out"):
        jobs.check_same({"problem": held}, {"problem": wanted}, tmp_path, "a run")
    robot = problem_parts(CHANGES[change](), replace(PAPER, body_mass=15.1))
    assert changed_parts(held, robot) == ["robot"]
    assert changed_parts(held, problem_parts(Stabilize(duration=4.0), PAPER)) == ["fields"]


def claim_of_benchmark(out: Path) -> None:
    MeasuredRun.open(out, 1, {"paper": {"stabilize": ["lqr"]}}, episodes=5)
    jobs.RunFolder(out).unfinished.mkdir(exist_ok=True)
    (jobs.RunFolder(out).unfinished / "job.json").write_text("[]")


def claim_of_training(out: Path) -> None:
    task = TASKS["stabilize"]()
    training.train(apg.make(task, named_robot("paper"), TINY), task, {"learner": "apg", "task": "stabilize"}, out, True)


def claim_of_demos(out: Path) -> None:
    demos(DemoConfig("stabilize", "lqr", 1, "rk4"), out=out / "lqr-v0", workers=1)


def claim_of_shards(out: Path) -> None:
    demos(DemoConfig("stabilize", "lqr", 1, "rk4"), shards=str(out / "set"), out=out / "unfinished", workers=1)


def claim_of_certify(out: Path) -> None:
    certify(("stabilize",), 1, shards=str(out / "set"), out=out / "unfinished", workers=1)


CLAIMS = (claim_of_benchmark, claim_of_training, claim_of_demos, claim_of_shards, claim_of_certify)


@pytest.mark.parametrize("claim", CLAIMS)
def test_a_run_is_not_continued_with_another_cost_or_another_robot(
    claim: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training._Run, "learn", lambda run: None)
    monkeypatch.setattr(training._Run, "measure", lambda run, count: None)
    claim(tmp_path)
    claim(tmp_path)
    jobs.RunFolder(tmp_path).unlock()
    with monkeypatch.context() as patch:
        patch.setitem(TASKS, "stabilize", Dearer)
        with pytest.raises(ValueError, match=r"another problem.*: its costs have changed since"):
            claim(tmp_path)
    with monkeypatch.context() as patch:
        patch.setitem(ROBOTS, "paper", Registered(replace(PAPER, body_mass=14.0), {}))
        with pytest.raises(ValueError, match=r"another problem.*: its robot has changed since"):
            claim(tmp_path)
    jobs.RunFolder(tmp_path).unlock()


def test_a_run_is_not_continued_after_its_urdf_was_edited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = {"mine": {"stabilize": ["lqr"]}}
    for mass in ("12", "14"):
        robot = edited(ROLLING_URDF_PATH, tmp_path / "robot.urdf", mass)
        monkeypatch.setitem(ROBOTS, "mine", Registered(robot, {}))
        if mass == "14":
            with pytest.raises(ValueError, match="another problem stabilize: its robot has changed since"):
                MeasuredRun.open(tmp_path / "run", 1, chosen, "mine", episodes=5)
            break
        MeasuredRun.open(tmp_path / "run", 1, chosen, "mine", episodes=5)
        jobs.RunFolder(tmp_path / "run").unfinished.mkdir()
        (jobs.RunFolder(tmp_path / "run").unfinished / "job.json").write_text("[]")
        jobs.RunFolder(tmp_path / "run").unlock()


@pytest.mark.parametrize("part", ["weights", "description"])
def test_a_run_is_not_continued_with_another_policy_in_the_same_file(part: str, tmp_path: Path) -> None:
    spec = PolicySpec.of(Stabilize(), hidden=(4,))
    path, out = PolicyNetwork(spec).save(tmp_path / "policy", {}), tmp_path / "out"
    chosen = {"paper": {"stabilize": [str(path)]}}
    MeasuredRun.open(out, 1, chosen, episodes=5)
    jobs.RunFolder(out).unfinished.mkdir()
    (jobs.RunFolder(out).unfinished / "job.json").write_text("[]")
    MeasuredRun.open(out, 1, chosen, episodes=5)
    if part == "weights":
        PolicyNetwork(spec).save(path, {})
    else:
        document = json.loads(path.read_text())
        document["spec"]["activation"] = "relu"
        path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=rf"the policy stabilize/.*policy\.json, whose {part} ha(s|ve) changed since"):
        MeasuredRun.open(out, 1, chosen, episodes=5)
    jobs.RunFolder(out).unlock()


EARLIER: dict[str, tuple[Mapping[str, Any], Mapping[str, Any], str]] = {
    "a run without a digest": (
        {},
        {"problem": certified.named_problem("turn", "paper")},
        "an unknown problem, because an earlier",
    ),
    "one with one digest": (
        {"problem": "12ab"},
        {"problem": certified.named_problem("turn", "paper")},
        "an unknown problem, because",
    ),
    "a benchmark": (
        {},
        {"problems": {"turn": certified.named_problem("turn", "paper")}},
        "unknown problems, because an earlier version",
    ),
    "a start": ({}, {"start_policy": "12ab"}, "an unknown policy to start from, because an earlier version made it"),
    "another start": ({"start_policy": "a"}, {"start_policy": "b"}, "a file of --start that has changed since"),
    "other demonstrations": (
        {"demonstrations": "a"},
        {"demonstrations": "b"},
        "a file of --demos that has changed since",
    ),
}


@pytest.mark.parametrize("case", EARLIER)
def test_what_cannot_be_compared_is_said_in_words(case: str, tmp_path: Path) -> None:
    held, wanted, said = EARLIER[case]
    with pytest.raises(ValueError, match=said) as refused:
        jobs.check_same(held, wanted, tmp_path, "a run")
    assert "None" not in str(refused.value)
    assert "{" not in str(refused.value)


def test_training_a_robot_without_a_name_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    light, task = replace(PAPER, body_mass=12.0), Stabilize()
    for learner in LEARNERS.values():
        with pytest.raises(ValueError, match=r"this robot has no name.*register_robot"):
            learner.make(task, light, learner.settings("stabilize"), 0)
    monkeypatch.setitem(ROBOTS, "light", Registered(light, {}))
    made = apg.make(task, light, TINY)
    with pytest.raises(ValueError, match="""the learner trains 'light', and "robot" of config is 'paper'"""):
        training.train(made, task, {"learner": "apg", "task": "stabilize"}, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_robot_that_differs_in_its_friction_alone_has_its_own_name(monkeypatch: pytest.MonkeyPatch) -> None:
    ice = replace(named_robot("rolling"), friction=0.3)
    assert robot_name(ice) == "rolling"
    with pytest.raises(ValueError, match="its numbers are not those of 'rolling'"):
        registered_name(ice)
    monkeypatch.setitem(ROBOTS, "ice", Registered(ice, {}))
    assert robot_name(ice) == registered_name(ice) == "ice"
    assert robot_name(named_robot("rolling")) == "rolling"
