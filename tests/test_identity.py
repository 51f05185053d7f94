"""What is continued, compared or read again is told apart by content, and not by a name."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ballbot_gym import TASKS, Stabilize, Turn, named_robot
from ballbot_gym.env import make_task
from ballbot_gym.robot import ROBOTS, Registered
from ballbot_gym.tasks.identity import observation_digest, problem_digest
from ballbot_train import evaluate, load_policy, shipped_policies
from ballbot_train.commands.export import export
from ballbot_train.evaluation.runner import MeasuredRun
from ballbot_train.policy.files import PolicyError, PolicyFile, PolicySpec
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.work import jobs

PAPER = named_robot("paper")


@dataclass(frozen=True)
class Dearer(Stabilize):
    """Stabilize with another cost, under its name and with its fields."""

    def cost(self, x, u, c):
        return 1.001 * super().cost(x, u, c)


@dataclass(frozen=True)
class Blurred(Stabilize):
    """Stabilize with another observation."""

    def observe(self, x, c):
        return 0.5 * super().observe(x, c)


def named_as_stabilize(kind: type[Stabilize]) -> Stabilize:
    kind.__name__ = "Stabilize"
    return kind()


def test_problems_of_one_name_differ_where_cost_observation_or_robot_differ() -> None:
    tasks = [Stabilize(), named_as_stabilize(Dearer), named_as_stabilize(Blurred)]
    assert len({task.problem() for task in tasks}) == 1
    heavier = replace(PAPER, body_mass=15.1)
    digests = [problem_digest(task, robot) for task in tasks for robot in (PAPER, heavier)]
    assert len(set(digests)) == 6
    assert (
        observation_digest(tasks[0], PAPER)
        == observation_digest(tasks[1], heavier)
        != observation_digest(tasks[2], PAPER)
    )
    assert problem_digest(Stabilize(), PAPER) == digests[0]


def folded(self, x, c):
    return np.abs(Stabilize.observe(self, x, c))


def clipped(self, x, c):
    return np.minimum(Stabilize.observe(self, x, c), 1.5)


def coarse_near_zero(self, x, c):
    seen = Stabilize.observe(self, x, c)
    return np.where(np.abs(seen) < 0.02, 0.0, seen)


@pytest.mark.parametrize("observe", [folded, clipped, coarse_near_zero])
def test_observations_differ_that_differ_only_for_negative_far_or_small_values(observe: Callable) -> None:
    changed = type("Stabilize", (Stabilize,), {"observe": observe})()
    assert observation_digest(changed, PAPER) != observation_digest(Stabilize(), PAPER)
    assert problem_digest(changed, PAPER) != problem_digest(Stabilize(), PAPER)


class FastTurn(Turn):
    """Observes fast turns alone in another way."""

    def observe(self, x, c):
        return Turn.observe(self, x, np.where(np.asarray(c) > 6.0, 6.0, c))


class LateTurn(Turn):
    """Costs more late in an episode."""

    clock = True

    def cost(self, x, u, c):
        return super().cost(x, u, c[:-1]) * (1.0 + 0.1 * (c[-1] > 4.0))

    def observe(self, x, c):
        return super().observe(x, c[:-1])


class EarlyTurn(LateTurn):
    """The same, and nothing costs more."""

    def cost(self, x, u, c):
        return Turn.cost(self, x, u, c[:-1])


def test_problems_differ_that_differ_only_for_some_constants_or_times() -> None:
    assert observation_digest(FastTurn(), PAPER) != observation_digest(Turn(), PAPER)
    assert observation_digest(Turn(max_speed=3.0), replace(PAPER, com_height=0.5)) == observation_digest(Turn(), PAPER)
    LateTurn.__name__ = EarlyTurn.__name__ = "Turn"
    LateTurn.goal = EarlyTurn.goal = lambda self, x, c: Turn.goal(self, x, c[:-1])
    assert problem_digest(LateTurn(), PAPER) != problem_digest(EarlyTurn(), PAPER)


class Picky(Stabilize):
    """Refuses to observe what is far from its episodes."""

    def observe(self, x, c):
        if abs(float(x[0])) > 5:
            raise ValueError("nobody has been there")
        return super().observe(x, c)


def test_a_task_may_refuse_states_that_no_episode_reaches() -> None:
    assert (
        observation_digest(Picky(), PAPER)
        == observation_digest(Picky(), PAPER)
        != observation_digest(Stabilize(), PAPER)
    )
    assert problem_digest(Picky(), PAPER) == problem_digest(Picky(), PAPER)


def test_a_policy_of_an_earlier_version_is_read_by_name_and_size(tmp_path: Path) -> None:
    path = PolicyNetwork(PolicySpec.of(Stabilize(), hidden=(4,))).save(tmp_path / "policy", {})
    document = json.loads(path.read_text())
    for field in ("robot_numbers", "observation_digest"):
        del document["spec"][field]
    path.write_text(json.dumps(document))
    assert load_policy(path, Stabilize()).network.spec.observation_digest == ""
    with pytest.raises(PolicyError, match="Turn"):
        load_policy(path, Turn())


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_every_task_of_every_robot_is_a_problem_of_its_own(robot: str) -> None:
    digests = {problem_digest(kind(), named_robot(robot)) for kind in TASKS.values()}
    assert len(digests) == len(TASKS)


def test_a_run_continues_with_the_same_problem_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = {"paper": {"stabilize": ["lqr"]}}
    MeasuredRun.open(tmp_path, 1, chosen, episodes=5)
    unfinished = jobs.RunFolder(tmp_path).unfinished
    unfinished.mkdir(exist_ok=True)
    (unfinished / "job.json").write_text("[]")
    MeasuredRun.open(tmp_path, 1, chosen, episodes=5)
    monkeypatch.setitem(TASKS, "stabilize", type(named_as_stabilize(Dearer)))
    with pytest.raises(ValueError, match="another problem stabilize: its costs have changed since"):
        MeasuredRun.open(tmp_path, 1, chosen, episodes=5)
    jobs.RunFolder(tmp_path).unlock()


def test_a_policy_is_read_for_the_numbers_of_its_robot_and_not_for_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    light, heavy = replace(PAPER, body_mass=12.0), replace(PAPER, body_mass=30.0, force_limit=900.0)
    monkeypatch.setitem(ROBOTS, "mine", Registered(light, {}))
    task = Stabilize()
    path = PolicyNetwork(PolicySpec.of(task, "mine", hidden=(4,))).save(tmp_path / "policy", {})
    load_policy(path)
    monkeypatch.setitem(ROBOTS, "mine", Registered(heavy, {}))
    for read in (
        load_policy,
        lambda path: PolicyNetwork.load(path, task, robot=None),
        lambda path: export(str(path), robot="mine"),
    ):
        with pytest.raises(PolicyError, match=r"with body_mass=12.0, force_limit=350.0, and .* body_mass=30.0"):
            read(path)


def test_a_policy_is_read_for_its_observation_and_not_for_its_size(tmp_path: Path) -> None:
    spec = PolicySpec.of(named_as_stabilize(Blurred), hidden=(4,))
    path = PolicyNetwork(spec).save(tmp_path / "policy", {})
    load_policy(path, named_as_stabilize(Blurred))
    with pytest.raises(PolicyError, match="was trained on other observations"):
        load_policy(path, Stabilize())
    with pytest.raises(PolicyError, match="was trained on other observations"):
        evaluate(path, "stabilize", 1)


def test_shipped_policies_say_their_robot_and_observation() -> None:
    for robot in ROBOTS:
        for name in TASKS:
            for path in shipped_policies(make_task(name, robot), robot, None).values():
                spec = PolicySpec.read(PolicyFile(path).read()["spec"])
                assert spec == spec.on(make_task(name, robot), robot)


def test_a_runs_folder_is_its_policy_and_a_checkpoint_of_others_is_named(tmp_path: Path) -> None:
    run = tmp_path / "run-1"
    PolicyNetwork(PolicySpec.of(Stabilize(), hidden=(4,))).save(run / "policy", {})
    rows = [evaluate(path, "stabilize", 1, "rk4").cost_mean for path in (str(run), run / "policy.json")]
    assert rows[0] == rows[1]
    with pytest.raises(
        PolicyError, match=r"model_100\.pt is neither a policy's \.json nor a model of Stable-Baselines3"
    ):
        evaluate("model_100.pt", "stabilize", 1, "rk4")
