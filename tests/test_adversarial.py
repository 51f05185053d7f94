"""A search for hard starts stays in the set of starts, and finds none that is easier than where it began."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

from ballbot_gym import BallbotEnv, Stabilize, rollout
from ballbot_gym.env import make_task
from ballbot_train import evaluate_fresh, load_policy, shipped_policies
from ballbot_train.evaluation import adversarial
from ballbot_train.evaluation.adversarial import hard_starts
from ballbot_train.evaluation.fresh import draw, numbers_of

FEW: dict[str, Any] = {"searches": 5, "rounds": 3}


@pytest.fixture(scope="module")
def fresh():
    return evaluate_fresh("apg", "stabilize", 10, seed=3)


@pytest.fixture(scope="module")
def found(fresh):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adversarial, "_CLIMBS", 3)
        return hard_starts("apg", fresh, **FEW)


def test_searches_begin_at_the_hardest_episodes_and_end_at_harder_ones(fresh, found):
    began, ended = found
    hardest = np.sort(fresh.with_optima(10, 1).regrets)[::-1][:5]
    assert ended.success.all()
    # many optima at once are found less exactly
    np.testing.assert_allclose(np.sort(began.regrets)[::-1], hardest, atol=0.005)
    assert (ended.hardness >= began.hardness).all()
    assert (np.diff(ended.hardness) <= 0).all()
    assert ended.regrets[0] > hardest[0]


def test_gradient_ascent_goes_on_from_the_hardest_ends(fresh, found, monkeypatch):
    monkeypatch.setattr(adversarial, "_CLIMBS", 0)
    _, random = hard_starts("apg", fresh, **FEW)
    assert (found[1].hardness >= random.hardness).all()
    assert found[1].hardness[0] > 1.01 * random.hardness[0]


def test_starts_are_in_the_set_from_which_episodes_are_drawn(found):
    x = np.abs(found[1].states)
    assert (x[:, :2] <= 2).all()
    assert (x[:, 2:4] <= 0.6).all()
    assert (x[:, 4:6] <= 5).all()


def test_costs_are_those_of_the_environment(found):
    _, ended = found
    env = BallbotEnv("stabilize", physics="rk4")
    policy = load_policy(shipped_policies(env.task)["apg"])
    for i in range(2):
        run = rollout(env, policy, options={"state": ended.states[i], "constants": ended.constants[i]})
        assert run.cost == pytest.approx(ended.costs[i], rel=1e-5)


@pytest.mark.slow
def test_processes_find_what_one_does(fresh, found, monkeypatch):
    monkeypatch.setattr(adversarial, "_TOGETHER", 3)
    one, two = (hard_starts("apg", fresh, workers, **FEW) for workers in (1, 2))
    for mine, theirs in zip(one, two, strict=True):
        np.testing.assert_array_equal(mine.states, theirs.states)
        np.testing.assert_array_equal(mine.optima, theirs.optima)
    np.testing.assert_array_equal(np.sort(one[0].costs), np.sort(found[0].costs))


@pytest.mark.parametrize("name", ["stabilize", "turn", "weave"])
def test_episodes_are_functions_of_their_numbers(name):
    task = make_task(name)
    x, c, _ = draw(task, [4, 1], seed=2)
    numbers, few = numbers_of(task, [4, 1], seed=2), task.constant_draws
    params = BallbotEnv(task, physics="rk4").params
    for row, state, constants in zip(numbers, x, c, strict=True):
        np.testing.assert_array_equal(task.draw_constants(tuple(row[:few]), params), constants)
        np.testing.assert_array_equal(task.start(tuple(row[few:]), tuple(constants), params), state)


@dataclass(frozen=True)
class Fixed(Stabilize):
    def sample(self, rng, params):
        return np.array([1.0, 0, 0, 0, 0, 0, 0, 0]), np.zeros(0)


def test_a_task_that_samples_in_its_own_way_and_hidden_parameters_are_refused():
    def still(seen):
        return 0 * seen[:, :2]

    with pytest.raises(ValueError, match="Fixed does not draw its episodes by draw_constants and draw_state"):
        hard_starts(still, evaluate_fresh(still, Fixed(), 2))
    with pytest.raises(ValueError, match="leave out --randomization"):
        hard_starts(still, evaluate_fresh(still, "stabilize", 2, randomization="late"))


def test_the_command_writes_the_starts_and_motions_that_replay_shows(typed, tmp_path, monkeypatch):
    monkeypatch.setattr(adversarial, "hard_starts", partial(hard_starts, rounds=2))
    monkeypatch.setattr(adversarial, "_CLIMBS", 0)  # other tests climb,
    monkeypatch.setattr(adversarial, "_CHECKED", 0)  # and search these optima twice
    code, said = typed(
        *("evaluate", "apg", "--task", "stabilize", "--fresh", "2", "--optima", "0"),
        *("--adversarial", "--workers", "1", "--out", str(tmp_path)),
    )
    assert code == 0, said
    assert "2 searches for hard starts: 0 ended in a failure, 0 in a missed goal" in said
    header, *lines = (tmp_path / "adversarial.csv").read_text().splitlines()
    assert header.split(",")[:6] == ["success", "failure", "cost", "optimum", "regret", "regret_before"]
    assert len(lines) == 2
    assert {path.name for path in (tmp_path / "adversarial").iterdir()} == {"start-0.npz", "start-1.npz"}


def test_the_command_needs_fresh_episodes(typed, tmp_path):
    code, said = typed("evaluate", "apg", "--task", "stabilize", "--adversarial", "--out", str(tmp_path))
    assert code == 1
    assert "give --fresh with --adversarial" in said
