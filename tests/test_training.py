"""Training runs: they learn, are written as promised, and go on after an interruption as if there had been none."""

import csv
import importlib
import json
import shlex
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest
import torch
from builders import measured
from resuming import goes_on_as_if_never_stopped, parameters

from ballbot_baselines import Backoff
from ballbot_gym.env import make_task
from ballbot_gym.robot import default_params
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.identity import problem_parts
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_train.commands.train import Run, command_line, train
from ballbot_train.learning import apg, dagger, training
from ballbot_train.learning.demonstrations import DemoConfig
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import SHIPPED

# From a policy that does nothing, so that episodes end soon.
SETTINGS = [
    "--task",
    "turn",
    "--iterations",
    6,
    "--evaluations",
    1,
    "--num-envs",
    4,
    "--episode-seconds",
    0.06,
    "--hidden",
    8,
]
SETTINGS += ["--test-episodes", 3]


@pytest.mark.parametrize("name", TASKS)
def test_apg_goes_on_from_its_state_as_if_never_stopped(name):
    tiny = {"iterations": 4, "num_envs": 4, "episode_seconds": 0.06, "hidden": (8,)}
    config = replace(LEARNERS["apg"].settings(name), **tiny)
    assert goes_on_as_if_never_stopped(lambda seed: apg.make(TASKS[name](), default_params(), config, seed))


def test_apg_starts_at_lqr_and_lowers_the_cost():
    """From LQR's start a few iterations of small envs already save cost on the certified episodes."""
    task, params = TASKS["stabilize"](), default_params()
    config = replace(LEARNERS["apg"].settings("stabilize"), iterations=4, num_envs=8, episode_seconds=0.8, hidden=(32,))
    learner = apg.make(task, params, config)
    before = training.score_and_validate(learner.network, task, episodes=1)
    assert before["certified/success"] > 0.5  # LQR within the limits of tanh
    for _ in range(config.iterations):
        learner.iterate()
    after = training.score_and_validate(learner.network, task, episodes=1)
    assert after["certified/cost_ratio"] < 0.8 * before["certified/cost_ratio"]


def test_apg_starts_from_a_policy_of_any_shape_and_robot():
    task, params = TASKS["turn"](), default_params()
    config = apg.ApgConfig(iterations=2, num_envs=4, episode_seconds=0.04, hidden=(8,))
    donor = apg.make(task, params, config, 1)
    learner = apg.make(task, params, replace(config, hidden=(9,)), 2, donor.network)
    assert torch.equal(parameters(learner), parameters(donor))
    learner.iterate()
    assert not torch.equal(parameters(learner), parameters(donor))
    donor.network.spec = replace(donor.network.spec, robot="rolling", task=replace(task, max_speed=3.0).problem())
    assert apg.make(task, params, config, 2, donor.network).network.spec.robot == "paper"


def test_a_setting_of_apg_that_would_do_nothing_says_so():
    with pytest.raises(ValueError, match="needs margin_penalty above 0"):
        LEARNERS["apg"].make(TASKS["stabilize"](), default_params(), apg.ApgConfig(margin_clearance=0.1), 0, None)


class Killed(BaseException):
    """Ends a run as a kill does: nothing is saved any more."""


def test_a_killed_run_resumes_to_the_same_result(tmp_path, typed, monkeypatch):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    iterate = apg.make.iterate

    def killed_after_four(self):
        if self.iteration == 4:
            raise Killed
        return iterate(self)

    common = ["apg", "--threads", 1, *SETTINGS, "--validation-episodes", 4]
    assert typed("train", *common, "--out", whole)[0] == 0
    with monkeypatch.context() as patch:
        patch.setattr(training, "_CHECKPOINT_SECONDS", 0.0)
        patch.setattr(apg.make, "iterate", killed_after_four)
        with pytest.raises(Killed):
            typed("train", *common, "--out", killed)
    ended, printed = typed("train", *common, "--out", killed)
    assert (ended, "--resume" in printed) == (1, True), printed
    ended, printed = typed("train", *common, "--out", killed, "--resume")
    assert ended == 0, printed
    assert (killed / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()
    described = [json.loads((out / "policy.json").read_text()) for out in (whole, killed)]
    assert described[0]["chosen_by"]["episodes"] == "4 fresh, for validation"
    assert described[0]["training"]["validation_episodes"] == 4
    measured = [each["measured"] for each in described]
    assert measured[0] == measured[1]
    assert (measured[0]["physics"], measured[0]["episodes"]) == ("bullet", 3)
    ended, printed = typed("train", *common, "--seed", 1, "--out", killed, "--resume")
    assert (ended, "holds a run of seed" in printed) == (1, True), printed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_after_ctrl_c_the_printed_command_continues_as_does_a_copy_of_the_folder(tmp_path, typed, monkeypatch, number):
    iterate = apg.make.iterate

    def interrupted(self):
        if self.iteration == 3:
            signal.raise_signal(number)
        return iterate(self)

    with monkeypatch.context() as patch:
        patch.setattr(apg.make, "iterate", interrupted)
        ended, printed = typed("train", "apg", *SETTINGS, "--out", "a run")
    assert (ended, "this continues where it stopped" in printed) == (130, True), printed
    shutil.copytree(tmp_path / "a run", tmp_path / "copy")
    words = shlex.split(printed.rpartition(": ")[2])
    assert (words[:2], words[-1]) == (["ballbot", "train"], "--resume")
    for command in (words[1:], [word.replace("a run", "copy") for word in words[1:]]):
        ended, printed = typed(*command)
        assert ended == 0, printed
    records = [json.loads((tmp_path / name / "config.json").read_text()) for name in ("a run", "copy")]
    assert "--out copy" in records[1].pop("command")
    assert "--out 'a run'" in records[0].pop("command")
    assert [record.pop("about")["commit"] for record in records]
    assert records[0] == records[1]
    weights = [(tmp_path / name / "policy.safetensors").read_bytes() for name in ("a run", "copy")]
    assert weights[0] == weights[1]
    described = json.loads((tmp_path / "copy" / "policy.json").read_text())
    assert described["chosen_by"]["episodes"] == "200 fresh, for validation"


def test_a_damaged_checkpoint_is_named(tmp_path):
    task, params = TASKS["stabilize"](), default_params()
    config = apg.ApgConfig(iterations=1, evaluations=1, num_envs=2, episode_seconds=0.04, hidden=(4,))
    about = {"learner": "apg", "task": "stabilize"}
    (tmp_path / "config.json").write_text(json.dumps(about | {"problem": problem_parts(task, params)}))
    for content in (b"", b"garbage", b"PK\x03\x04"):
        (tmp_path / "checkpoint.pt").write_bytes(content)
        with pytest.raises(ValueError, match=r"checkpoint\.pt is damaged"):
            training.train(apg.make(task, params, config), task, about, tmp_path, resume=True)


@pytest.fixture
def short_run(tmp_path, monkeypatch):
    """Trains for two iterations, each followed by an evaluation, without the measurement in PyBullet."""
    task, params = TASKS["stabilize"](), default_params()
    config = apg.ApgConfig(iterations=2, evaluations=2, num_envs=2, episode_seconds=0.04, hidden=(4,))
    monkeypatch.setattr(training._Run, "measure", lambda run, count: None)

    def start(resume=False):
        learner = apg.make(task, params, config)
        training.train(learner, task, {"learner": "apg", "task": "stabilize"}, tmp_path, resume)
        return learner

    return start


def evaluations(folder):
    with (folder / "evaluations.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_validation_set_chooses_the_policy_and_the_certified_episodes_only_test_it(
    short_run, tmp_path, monkeypatch
):
    figures = iter(measured(ratio, cost, 1.0) for ratio, cost in ((1.5, 30.0), (1.4, 20.0), (1.1, 25.0)))
    monkeypatch.setattr(training, "score_and_validate", lambda *policy: next(figures))
    short_run()
    rows = evaluations(tmp_path)
    assert [float(row["validation_cost"]) for row in rows] == [30.0, 20.0, 25.0]
    assert [float(row["cost_ratio"]) for row in rows] == [1.5, 1.4, 1.1]
    described = json.loads((tmp_path / "policy.json").read_text())
    assert described["iteration"] == 1
    assert described["chosen_by"]["cost"] == 20.0


def test_of_policies_that_never_succeed_the_one_with_the_least_mean_cost_is_kept(short_run, tmp_path, monkeypatch):
    figures = iter(measured(10.0, 800.0, mean, success=0.0) for mean in (700.0, 80.0, 90.0))
    monkeypatch.setattr(training, "score_and_validate", lambda *policy: next(figures))
    short_run()
    assert json.loads((tmp_path / "policy.json").read_text())["iteration"] == 1


def parsed(command):
    """Learner, options of the run and settings that a recorded command gives."""
    words, calls = shlex.split(command), []
    assert words[:2] == ["ballbot", "train"]
    command_line(words[2:], lambda *call: calls.append(call[:-1]))
    return calls[0]


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.json")))
def test_recorded_commands_give_the_recorded_settings(path):
    record = json.loads(path.read_text())["training"]
    *earlier, last = record["command"].split(" && ")
    learner, options, settings = parsed(last)
    assert json.loads(json.dumps(asdict(settings))) == record["settings"]
    assert (learner, options.task, options.seed) == (record["learner"], record["task"], record["seed"])
    assert [value and str(value) for value in (options.demos, options.start)] == [record["demos"], record["start"]]
    for command in earlier:
        words = shlex.split(command)
        if words[1] == "demos":
            given = {word.removeprefix("--").removeprefix("no-") for word in words if word.startswith("--")}
            assert given <= {f.name for f in fields(DemoConfig)} | {
                "out",
                *(f"backoff.{f.name}" for f in fields(Backoff)),
            }
        else:
            parsed(command)


@pytest.mark.slow
def test_a_recorded_command_makes_its_policy_again_from_nothing(tmp_path):
    """Rounding differs between kinds of processors, so its weights may differ, and what it measures hardly."""
    shipped = json.loads((SHIPPED / "orbit-dagger.json").read_text())
    command = shlex.split(shipped["training"]["command"])
    command[command.index("--out") + 1] = str(tmp_path)
    subprocess.run([sys.executable, "-m", "ballbot_train.cli", *command[1:]], check=True)
    again = json.loads((tmp_path / "policy.json").read_text())
    assert again["spec"] == shipped["spec"]
    assert again["measured"]["success"] == 1.0
    assert abs(again["measured"]["regret_mean"] - shipped["measured"]["regret_mean"]) < 0.002


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("task", TASKS)
def test_a_command_with_all_settings_gives_them_again(learner, task, monkeypatch):
    recorded, settings = [], LEARNERS[learner].settings(task)
    monkeypatch.setattr("ballbot_train.commands.train._train", lambda *given: recorded.append(given[-1]))
    options = Run(task=task, seed=3, out=Path("runs/mine"))
    train(learner, options, settings)
    assert parsed(recorded[0]) == (learner, options, settings)


@pytest.mark.parametrize("learner", LEARNERS)
def test_help_lists_every_setting_with_the_defaults_of_the_task_and_on_demand_what_it_means(
    learner, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    printed = {}
    for option in ("--help", "-H"):
        with pytest.raises(SystemExit):
            command_line([learner, "--task", "weave", option], lambda *call: None)
        printed[option] = capsys.readouterr().out
    settings = LEARNERS[learner].settings("weave")
    for field in fields(settings):
        assert f"--{field.name.replace('_', '-')}" in printed["--help"]
    assert "256 256" in printed["--help"] or learner != "apg"
    assert len(printed["--help"].splitlines()) <= 60
    assert "Evaluations, at equal distances." in printed["-H"]


class Stand(Stabilize):
    """A task that no learner knows."""

    id = "BallbotStand-v0"


SMALL = {
    "dagger": {"episodes_per_iteration": 1, "gradient_steps": 2},
    "ppo": {"num_envs": 4, "num_steps": 8, "batch_size": 32},
    "sac": {"num_envs": 2, "num_steps": 2, "batch_size": 4},
    "apg": {"num_envs": 4, "episode_seconds": 0.06, "iterations": 3},
}


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_task_that_no_learner_knows_trains_with_default_settings(learner, monkeypatch):
    monkeypatch.setitem(TASKS, "stand", Stand)
    monkeypatch.setattr(dagger, "_SECONDS", 0.5)
    algorithm, module = LEARNERS[learner], importlib.import_module(LEARNERS[learner].module)
    settings = algorithm.settings("stand")
    assert settings == module.TUNED[""]
    made = algorithm.make(make_task("stand"), default_params(), replace(settings, **SMALL.get(learner, {})), 0, None)
    before = parameters(made)
    for _ in range(2):
        made.iterate()
    after = parameters(made)
    assert torch.isfinite(after).all()
    assert not torch.equal(before, after)


def test_a_training_in_another_thread_comes_to_its_end(short_run, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "score_and_validate", lambda *policy: measured(1.5, 30.0, 1.0))
    with ThreadPoolExecutor(1) as pool:
        pool.submit(short_run).result()
    assert (tmp_path / "policy.json").exists()


@pytest.mark.parametrize(
    ("number", "again"), [(signal.SIGINT, "press Ctrl-C again"), (signal.SIGTERM, "send the signal again")]
)
def test_a_training_that_is_stopped_says_how_to_stop_it_at_once(number, again, capsys):
    with training._interruptible() as interrupted:
        signal.raise_signal(number)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert f"saving; {again} to stop at once" in capsys.readouterr().out


def test_the_handler_of_a_program_that_embeds_python_stays(monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with training._interruptible() as interrupted:
        monkeypatch.undo()
        assert signal.getsignal(signal.SIGTERM) is before
        assert not interrupted()
    assert signal.getsignal(signal.SIGTERM) is before
