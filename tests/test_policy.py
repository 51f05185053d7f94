"""Policy files: what was saved comes back, and nothing else is accepted."""

import itertools
import json
import shlex
import subprocess
import sys

import numpy as np
import pytest
import torch
from builders import random_policy as network_of

from ballbot_gym.engines import default_physics
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import ROBOTS, default_params, named_robot
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import TASKS
from ballbot_gym.vector.batch import BallbotBatch
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.evaluation.evaluate import evaluate
from ballbot_train.policy.files import BEST, PolicyError, PolicyFile, PolicySpec, shipped_policies
from ballbot_train.policy.network import PolicyController, PolicyNetwork, load_policy


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("squash", ["tanh", "clip", "tanh_in_frame"])
def test_a_saved_policy_acts_as_before(name, squash, tmp_path):
    task = TASKS[name]()
    network = network_of(task, squash=squash, linear=squash == "tanh", activation="relu")
    path = network.save(tmp_path / "mine", {"measured": {"regret_mean": 0.1}})
    loaded = load_policy(path, task)
    observations = np.random.default_rng(0).normal(size=(5, len(task.observation_scale))).astype(np.float32)
    with torch.no_grad():
        expected = network(torch.tensor(observations)).numpy()
    np.testing.assert_array_equal(loaded.predict(observations)[0], expected)
    np.testing.assert_array_equal(load_policy(path).predict(observations)[0], expected)
    assert np.abs(expected).max() <= 1
    assert json.loads(path.read_text())["measured"]["regret_mean"] == 0.1


def test_forces_are_what_the_env_would_apply_for_the_predicted_actions(tmp_path):
    env = BallbotEnv("orbit", physics="rk4", duration=0.2)
    policy = PolicyController(env.task, env.params, network_of(env.task))
    episode = rollout(env, policy, seed=3)
    observation, _ = env.reset(seed=3)
    for force in episode.trajectory.u:
        action, state = policy.predict(observation)
        assert state is None
        observation, *_, info = env.step(action)
        np.testing.assert_allclose(info["force"], force, rtol=1e-6)


def test_wrong_files_are_refused_with_the_reason(tmp_path):
    task = TASKS["stabilize"]()
    path = network_of(task).save(tmp_path / "mine", {})
    with pytest.raises(PolicyError, match=r"trained on Stabilize.*not on Turn"):
        load_policy(path, "turn")
    with pytest.raises(PolicyError, match=r"trained on Stabilize.*duration=4.0"):
        load_policy(path, TASKS["stabilize"](duration=4.0))
    other = network_of(TASKS["stabilize"](duration=4.0)).save(tmp_path / "other", {})
    with pytest.raises(PolicyError, match=r"give that Task"):
        load_policy(other)


def test_a_policy_is_loaded_for_the_robot_that_its_file_names(tmp_path):
    task = make_task("stabilize", "kugle")
    path = PolicyNetwork(PolicySpec.of(task, robot="kugle", hidden=(4,))).save(tmp_path / "mine", {})
    controller, seen = load_policy(path), np.zeros(8)
    controller.reset(0.0, seen, np.zeros(0))
    force = controller.act(0.0, seen)
    np.testing.assert_allclose(force, named_robot("kugle").force_limit * controller.predict(seen)[0], rtol=1e-6)
    described = json.loads(path.read_text())
    for unknown in ("nobody", 3, ["kugle"]):
        described["spec"]["robot"] = unknown
        path.write_text(json.dumps(described))
        with pytest.raises(PolicyError, match=r"trained on the robot .* which is none of paper, rolling, kugle"):
            load_policy(path)


@pytest.mark.parametrize("name", TASKS)
def test_every_named_controller_can_be_made(name):
    task = TASKS[name]()
    for controller in ControllerName.known(task):
        assert hasattr(ControllerName(controller).make(task, default_params()), "act")
    with pytest.raises(ValueError, match="unknown controller 'lqrr'"):
        ControllerName("lqrr").make(task, default_params())


SHIPPED = [
    (name, robot, learner)
    for name, robot in itertools.product(TASKS, ROBOTS)
    for learner in shipped_policies(make_task(name, robot), robot)
]


@pytest.fixture
def others_defaults():
    """What a script may have set for torch."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(("name", "learner"), [("stabilize", "apg"), ("orbit", "sac"), ("weave", "dagger")])
def test_a_policy_computes_in_its_own_precision_whatever_torchs_default_is(name, learner, others_defaults):
    task = make_task(name)
    path = shipped_policies(task)[learner]
    policy = load_policy(path)
    observations = np.random.default_rng(0).normal(size=(3, len(task.observation_scale))).astype(np.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        actions = policy.predict(observations)[0]
    torch.set_default_dtype(torch.float32)
    np.testing.assert_array_equal(actions, load_policy(path).predict(observations)[0])
    assert actions.dtype == np.float32


@pytest.mark.parametrize("name", TASKS)
def test_a_batch_computes_in_its_own_precision_whatever_torchs_default_is(name, others_defaults):
    batch = BallbotBatch(name, 2, compile=False)
    observation = batch.reset(seed=0)
    result = batch.step(torch.zeros(2, 2, dtype=torch.float32))
    assert {part.dtype for part in (observation, result.observation, result.reward, result.cost)} == {torch.float32}


@pytest.mark.parametrize(("name", "robot", "learner"), SHIPPED)
def test_shipped_policies_say_how_they_were_made_and_do_what_they_say(name, robot, learner):
    """In the first certified episode they succeed, at a regret of the order that they claim."""
    described = PolicyFile(shipped_policies(make_task(name, robot), robot)[learner]).read()
    assert described["training"]["command"].startswith("ballbot ")
    measured = described["measured"]
    assert measured["physics"] == default_physics()
    assert measured["episodes"] == 200
    row = evaluate(learner, name, 1, robot=robot)
    assert row.success >= measured["success"] - 0.2
    assert row.regret_mean < 3 * max(measured["regret_mean"], 0.01)


@pytest.mark.slow
def test_a_shipped_policy_is_made_again_from_nothing_by_its_command(tmp_path):
    """On another kind of processor, which rounds differently, it is another policy that is as good."""
    described = PolicyFile(shipped_policies(make_task("stabilize"))["ppo-scratch"]).read()
    command = shlex.split(described["training"]["command"])
    command[command.index("--out") + 1] = str(tmp_path / "run")
    subprocess.run([sys.executable, "-m", "ballbot_train.cli", *command[1:]], check=True)
    row = evaluate(tmp_path / "run" / "policy.json", "stabilize")
    assert row.success == 1
    assert row.regret_mean < 2 * described["measured"]["regret_mean"]


@pytest.mark.parametrize("name", TASKS)
def test_pages_show_the_policy_of_the_least_regret(name):
    described = {learner: PolicyFile(path).read() for learner, path in shipped_policies(make_task(name)).items()}
    regrets = {learner: each["measured"]["regret_mean"] for learner, each in described.items()}
    assert BEST[name] == min(regrets, key=regrets.__getitem__)
