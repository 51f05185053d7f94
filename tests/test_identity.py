"""What is continued, compared or read again is told apart by content, and not by a name."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from ballbot_gym import TASKS, Stabilize, named_robot
from ballbot_gym.env import make_task
from ballbot_gym.identity import observation_digest, problem_digest, robot_digest
from ballbot_gym.robots import ROBOTS, Robot
from ballbot_train import evaluate, load_policy, shipped_policies
from ballbot_train.commands.export import export
from ballbot_train.evaluation.runner import open_run
from ballbot_train.policy.files import PolicyError, PolicySpec, read_description
from ballbot_train.policy.network import PolicyNetwork, load_network, save_policy
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
    assert robot_digest(PAPER) != robot_digest(heavier)
    assert (
        observation_digest(tasks[0], PAPER)
        == observation_digest(tasks[1], heavier)
        != observation_digest(tasks[2], PAPER)
    )
    assert problem_digest(Stabilize(), PAPER) == digests[0]


@pytest.mark.parametrize("robot", list(ROBOTS))
def test_every_task_of_every_robot_is_a_problem_of_its_own(robot: str) -> None:
    digests = {problem_digest(kind(), named_robot(robot)) for kind in TASKS.values()}
    assert len(digests) == len(TASKS)


def test_a_run_continues_with_the_same_problem_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = {"paper": {"stabilize": ["lqr"]}}
    open_run(tmp_path, 1, chosen, episodes=5)
    unfinished = jobs.unfinished(tmp_path)
    unfinished.mkdir(exist_ok=True)
    (unfinished / "job.json").write_text("[]")
    open_run(tmp_path, 1, chosen, episodes=5)
    monkeypatch.setitem(TASKS, "stabilize", Dearer)
    with pytest.raises(ValueError, match="stabilize: its episodes, costs, limits, observations or robot have changed"):
        open_run(tmp_path, 1, chosen, episodes=5)
    jobs.unlock(tmp_path)


def test_a_policy_is_read_for_the_numbers_of_its_robot_and_not_for_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    light, heavy = replace(PAPER, body_mass=12.0), replace(PAPER, body_mass=30.0, force_limit=900.0)
    monkeypatch.setitem(ROBOTS, "mine", Robot(light, {}))
    task = Stabilize()
    path = save_policy(tmp_path / "policy", PolicyNetwork(PolicySpec.of(task, "mine", hidden=(4,))), {})
    load_policy(path)
    monkeypatch.setitem(ROBOTS, "mine", Robot(heavy, {}))
    for read in (
        load_policy,
        lambda path: load_network(path, task, robot=None),
        lambda path: export(str(path), robot="mine"),
    ):
        with pytest.raises(PolicyError, match=r"with body_mass=12.0, force_limit=350.0, and .* body_mass=30.0"):
            read(path)


def test_a_policy_is_read_for_its_observation_and_not_for_its_size(tmp_path: Path) -> None:
    spec = PolicySpec.of(named_as_stabilize(Blurred), hidden=(4,))
    path = save_policy(tmp_path / "policy", PolicyNetwork(spec), {})
    load_policy(path, named_as_stabilize(Blurred))
    with pytest.raises(PolicyError, match="was trained on other observations"):
        load_policy(path, Stabilize())
    with pytest.raises(PolicyError, match="was trained on other observations"):
        evaluate(path, "stabilize", 1)


def test_shipped_policies_say_their_robot_and_observation() -> None:
    for robot in ROBOTS:
        for name in TASKS:
            for path in shipped_policies(make_task(name, robot), robot, None).values():
                spec = PolicySpec.read(read_description(path)["spec"])
                assert spec == spec.on(make_task(name, robot), robot)


def test_a_runs_folder_is_its_policy_and_a_checkpoint_of_others_is_named(tmp_path: Path) -> None:
    run = tmp_path / "run-1"
    save_policy(run / "policy", PolicyNetwork(PolicySpec.of(Stabilize(), hidden=(4,))), {})
    rows = [evaluate(path, "stabilize", 1, "rk4").cost_mean for path in (str(run), run / "policy.json")]
    assert rows[0] == rows[1]
    with pytest.raises(PolicyError, match=r"model_100\.pt is no policy's \.json, nor a model of Stable-Baselines3"):
        evaluate("model_100.pt", "stabilize", 1, "rk4")
