"""The search of hyperparameters: it finds the better settings, goes on after a kill, and writes what tools read."""

import json
import shlex
from dataclasses import replace

import pytest

pytest.importorskip("optuna")

import optuna
import yaml
from builders import measured
from optuna.distributions import CategoricalDistribution as Categorical
from optuna.distributions import FloatDistribution as Float

from ballbot_gym import Stabilize
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.tune import tune
from ballbot_train.learning import tuning
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.learning.tuning import SPACES, Search, encoded, settings_of, zoo_yaml


@pytest.mark.parametrize("learner", SPACES)
@pytest.mark.parametrize("task", TASKS)
def test_the_tuned_settings_lie_in_the_space_that_is_searched(learner, task):
    for name, value in encoded(SPACES[learner], LEARNERS[learner].settings(task)).items():
        domain = SPACES[learner][name]
        inside = domain.low <= value <= domain.high if isinstance(domain, Float) else value in domain.choices
        assert inside, (name, value)


def test_a_training_has_the_env_steps_that_are_asked_for():
    search = Search("ppo", "stabilize", (0,), 500_000, 4)
    settings = settings_of(search, {"num_steps": 64})
    iteration = settings.num_envs * 64
    assert settings.iterations * iteration == pytest.approx(500_000, abs=iteration / 2)
    assert settings.evaluations == 4


class Fake:
    """A learner that gets better with every iteration, the more so the nearer its learning rate is to 2e-3."""

    def __init__(self, settings, seed):
        self.iteration, self.iterations = 0, settings.iterations
        self._off = abs(settings.learning_rate - 2e-3) * 1000 + 0.01 * seed

    def iterate(self):
        self.iteration += 1

    @property
    def network(self):
        return 1 + self._off + 1 / self.iteration


@pytest.fixture
def fakes(monkeypatch):
    made = []

    def make(self, task, params, settings, seed, demos=None):
        made.append(settings)
        if settings.batch_size == 2048:
            raise ValueError("not finite")
        return Fake(settings, seed)

    def measure(network, task, robot):
        return measured(network, network, network)

    monkeypatch.setattr(type(LEARNERS["ppo"]), "make", make)
    monkeypatch.setattr(tuning.training, "score_and_validate", measure)
    space = {"learning_rate": Float(1e-4, 5e-3, log=True), "batch_size": Categorical((512, 3072, 2048))}
    space["hidden"] = Categorical(("[64, 64]", "[128, 128]"))
    monkeypatch.setitem(tuning.SPACES, "ppo", space)
    monkeypatch.setattr(tuning, "_STARTUP_TRIALS", 2)
    return made


SEARCH = Search("ppo", "stabilize", (0, 1), 600_000, 3)


def test_a_search_starts_with_the_tuned_settings_and_keeps_the_best(fakes, tmp_path):
    best = tuning.run(SEARCH, 10, tmp_path)
    trials = tuning.open_study(SEARCH, tmp_path).trials
    assert len(trials) == 10
    assert trials[0].params["learning_rate"] == LEARNERS["ppo"].settings("stabilize").learning_rate
    assert best["validation_cost"] == min(trial.value for trial in trials if trial.state.name == "COMPLETE")
    assert json.loads((tmp_path / "best.json").read_text()) == json.loads(json.dumps(best))
    assert len(best["costs"]) == len(best["seeds"]) == 2
    assert {"COMPLETE", "PRUNED"} <= {trial.state.name for trial in trials}
    assert all(("error" in trial.user_attrs) == (trial.state.name == "FAIL") for trial in trials)


def test_a_killed_search_goes_on_with_the_trial_that_was_running(fakes, tmp_path, monkeypatch):
    tuning.run(SEARCH, 2, tmp_path)

    def killed(*arguments):
        fakes.append("killed")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tuning, "attempt", killed)
        with pytest.raises(KeyboardInterrupt):
            tuning.run(SEARCH, 4, tmp_path)
    before = len(fakes)
    tuning.run(SEARCH, 4, tmp_path)
    asked = tuning.open_study(SEARCH, tmp_path).trials
    (interrupted,) = (trial for trial in asked if "cpu_minutes" not in trial.user_attrs)
    assert len(asked) == 5
    assert asked[interrupted.number + 1].params == interrupted.params
    assert fakes[before].learning_rate == pytest.approx(interrupted.params["learning_rate"])


def test_a_damaged_study_is_named(fakes, tmp_path):
    (tmp_path / "study.db").write_bytes(b"no database" * 100)
    with pytest.raises(ValueError, match=r"study\.db cannot be read or written \(.*file is not a database"):
        tuning.run(SEARCH, 1, tmp_path)


def test_another_search_is_not_mixed_into_a_folder(fakes, tmp_path):
    tuning.run(SEARCH, 1, tmp_path)
    with pytest.raises(ValueError, match="env_steps"):
        tuning.run(replace(SEARCH, env_steps=5), 2, tmp_path)


def test_a_search_is_not_continued_with_another_problem_of_its_name(fakes, tmp_path, monkeypatch):
    tuning.run(SEARCH, 1, tmp_path)

    class Dearer(Stabilize):
        def cost(self, x, u, c):
            return 1.001 * super().cost(x, u, c)

    Dearer.__name__ = "Stabilize"
    monkeypatch.setitem(TASKS, "stabilize", Dearer)
    with pytest.raises(ValueError, match="another problem: its costs have changed since"):
        tuning.run(SEARCH, 2, tmp_path)


@pytest.mark.parametrize("name", ["what?", "50%25", "a#b", "it's", "mode=ro&x", "[red]", "{x}"])
def test_a_study_is_in_its_folder_whatever_that_is_called(fakes, tmp_path, name, capsys, monkeypatch):
    out = tmp_path / name
    tune("ppo", trials=1, env_steps=100_000, evaluations=2, out=out)
    assert {"best.json", "config.json", "ppo.yml", "study.db"} == {path.name for path in out.iterdir()}
    assert [path.name for path in tmp_path.iterdir()] == [name]
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("trials: "))
    *_, into, _, _, _, _, _, _, storage = shlex.split(line)
    monkeypatch.chdir(into)
    assert len(optuna.load_study(study_name="tune", storage=storage).trials) == 1


@pytest.mark.parametrize("learner", ["ppo", "sac"])
def test_the_file_for_rl_zoo3_has_the_four_ids(learner):
    read = yaml.safe_load(zoo_yaml(learner, {task: LEARNERS[learner].settings(task) for task in TASKS}))
    assert list(read) == [task.id for task in TASKS.values()]
    for settings in read.values():
        assert settings["policy"] == "MlpPolicy"
        assert isinstance(settings["n_timesteps"], int)
        assert settings["learning_rate"].startswith("lin_")
        assert settings["policy_kwargs"].startswith("dict(net_arch=[")


def test_a_learner_without_a_space_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no search space for dagger; there is one for ppo"):
        tuning.run(replace(SEARCH, learner="dagger"), 1, tmp_path)


def test_the_command_prints_the_best_and_how_to_train_with_it(fakes, tmp_path, capsys):
    tune("ppo", trials=2, env_steps=100_000, evaluations=2, out=tmp_path)
    printed = capsys.readouterr().out
    assert "ballbot train ppo --task stabilize" in printed
    assert (tmp_path / "ppo.yml").exists()


def test_real_trainings_have_an_outcome_per_seed():
    tiny = {"num_envs": 4, "num_steps": 4, "hidden": (4,), "batch_size": 8}
    search = Search("ppo", "stabilize", (0, 1), 32, 1, "rolling")
    reached = tuning.attempt(search, settings_of(search, tiny))
    assert len(set(reached["costs"])) == 2
    assert reached["steps"] == [pytest.approx(sum(reached["costs"]) / 2)]
