"""Policies as ONNX files: onnxruntime gives the same actions, and the file says what it takes and gives."""

import json

import numpy as np
import pytest
from builders import random_policy, task_and_robot

from ballbot_gym.engines import default_physics
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import named_robot
from ballbot_train.commands.export import export
from ballbot_train.policy.export_onnx import export_onnx
from ballbot_train.policy.files import SHIPPED, PolicyFile, PolicySpec, track_in
from ballbot_train.policy.network import PolicyController, PolicyNetwork, load_policy

onnx, onnxruntime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")

CLOSE = 5e-6  # of actions in [−1, 1], in float32: where a policy turns into a frame and back, rounding grows
SHIPPED_NAMES = sorted(  # the filter in front of informed policies is not exported
    path.stem for path in SHIPPED.glob("*.json") if "-informed-" not in path.stem
)


def session(path):
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def observations_of_an_episode(env, policy):
    """What a policy observes in an episode of its own."""
    observation, _ = env.reset(seed=1)
    seen, done = [observation], False
    while not done:
        observation, _, terminated, truncated, _ = env.step(policy.predict(observation)[0])
        seen.append(observation)
        done = terminated or truncated
    return np.array(seen)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "orbit-sac" else pytest.mark.slow) for name in SHIPPED_NAMES]
)
def test_onnxruntime_acts_as_every_shipped_policy_over_an_episode(name, tmp_path):
    task, robot = task_and_robot(name)
    export(str(SHIPPED / f"{name}.json"), task=task, out=tmp_path / "policy.onnx", robot=robot)
    runtime = session(tmp_path / "policy.onnx")
    policy = load_policy(SHIPPED / f"{name}.json")
    history = PolicyFile(SHIPPED / f"{name}.json").read()["spec"].get("history", 0)
    world = {"randomization": track_in(name) or None, "history": history}
    # in the closed form a ball that would slip ends the episode
    physics = default_physics() if named_robot(robot).grips else "rk4"
    seen = observations_of_an_episode(BallbotEnv(task, physics=physics, robot=robot, **world), policy)
    assert len(seen) > 50
    one_by_one = [runtime.run(None, {"observation": row[None]})[0][0] for row in seen]
    (at_once,) = runtime.run(None, {"observation": seen})
    expected = policy.predict(seen)[0]
    np.testing.assert_allclose(one_by_one, expected, atol=CLOSE)
    np.testing.assert_allclose(at_once, expected, atol=CLOSE)
    assert np.abs(at_once).max() <= 1


@pytest.mark.parametrize(
    ("task", "fields"),
    [
        pytest.param("orbit", {"frame": "radial", "squash": "tanh_in_frame", "centred": True}, marks=pytest.mark.slow),
        pytest.param("weave", {"frame": "routed_slalom", "routes": (8,)}, marks=pytest.mark.slow),
        ("stabilize", {"mirrors": True, "odd": True, "linear": False, "squash": "clip"}),
    ],
)
def test_frame_routes_mirrors_and_oddness_are_inside_the_graph(task, fields, tmp_path):
    task = make_task(task)
    network = random_policy(task, **fields)
    policy = network.save(tmp_path / "mine", {})
    runtime = session(export_onnx(policy, tmp_path / "mine.onnx", task))
    observations = np.random.default_rng(0).normal(size=(100, len(task.observation_scale))).astype(np.float32)
    expected = PolicyController(task, None, network).predict(observations)[0]
    np.testing.assert_allclose(runtime.run(None, {"observation": observations})[0], expected, atol=CLOSE)
    if network.spec.odd:
        np.testing.assert_array_equal(
            runtime.run(None, {"observation": -observations})[0], -runtime.run(None, {"observation": observations})[0]
        )


def test_the_file_says_what_it_takes_and_gives_and_names_its_robot(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    task = make_task("turn", "kugle")
    policy = PolicyNetwork(PolicySpec.of(task, robot="kugle", hidden=(4,))).save(tmp_path / "mine", {})
    with pytest.raises(ValueError, match=r"of the robot kugle, which is none of .* give --task, or another --robot"):
        export(str(policy))
    with pytest.raises(ValueError, match="was trained on"):
        export(str(policy), task="turn")
    export(str(policy), robot="kugle")
    (path,) = (tmp_path / "runs" / "export").glob("turn-kugle-*-mine-*.onnx")
    assert path.name in capsys.readouterr().out
    runtime = session(path)
    (takes,), (gives,) = runtime.get_inputs(), runtime.get_outputs()
    assert (takes.name, takes.type, takes.shape[1]) == ("observation", "tensor(float)", 9)
    assert (gives.name, gives.type, gives.shape[1]) == ("action", "tensor(float)", 2)
    about = runtime.get_modelmeta().custom_metadata_map
    assert (about["task"], about["robot"]) == ("BallbotTurn-v0", "kugle")
    assert float(about["force_limit_newton"]) == pytest.approx(48.5, abs=0.1)
    assert about["control_dt_seconds"] == "0.02"
    assert json.loads(about["observation_scale"]) == list(task.observation_scale)
    assert "| 8 | speed v | 5 | m/s |" in about["observation"]
    assert str(tmp_path).encode() not in path.read_bytes()
    assert b"policy.py" not in path.read_bytes()  # of the machine that wrote it
    model = onnx.load(path)
    assert model.ir_version <= 7  # onnxruntime 1.16 reads up to 9
    assert max(each.version for each in model.opset_import) <= 14  # and up to 19
