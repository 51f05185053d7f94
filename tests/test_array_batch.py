"""Envs in NumPy, for machines without a compiler and without torch: the same episodes as in machine code."""

import copy
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

from ballbot_gym import machine_code
from ballbot_gym.robot import ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector.arrays import BallbotArrays

MODES = ("SameStep", "NextStep")


def played(env, steps=60):
    """Everything that steps return, with infos."""
    env.reset(seed=3)
    rng, told = np.random.default_rng(0), []
    for _ in range(steps):
        told.append(env.step(rng.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)))
    return told


@pytest.mark.skipif(machine_code.compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("task", "robot"), [*((task, "paper") for task in TASKS), ("orbit", "kugle"), ("stabilize", "omni")]
)
def test_envs_in_numpy_do_what_machine_code_does(task, robot, mode):
    pytest.importorskip("casadi")
    make = {"robot": robot, "autoreset_mode": mode, "duration": 0.5, "dtype": "float64"}
    told = [played(BallbotVectorEnv(21, task, engine=engine, **make)) for engine in ("numpy", "native")]
    assert any((step[2] | step[3]).any() for step in told[0])  # episodes end, and others begin
    for ours, theirs in zip(*told, strict=True):
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)  # observations are float32
            assert a.dtype == b.dtype
        assert ours[4].keys() == theirs[4].keys()
        infos = [(ours[4], theirs[4])]
        if "final_info" in ours[4]:
            infos.append((ours[4]["final_info"], theirs[4]["final_info"]))
            np.testing.assert_allclose(ours[4]["final_obs"], theirs[4]["final_obs"], rtol=1e-6, atol=1e-6)
        for a, b in infos:
            for name in b.keys() - {"final_info", "final_obs"}:
                np.testing.assert_allclose(a[name], b[name], rtol=1e-6, atol=1e-6, err_msg=name)
                assert a[name].dtype == b[name].dtype, name


def test_actions_that_are_not_finite_are_refused_and_change_nothing():
    env = BallbotVectorEnv(3, engine="numpy")
    env.reset(seed=0)
    before = env.batch.state
    with pytest.raises(ValueError, match="finite"):
        env.step(np.array([[0, 0], [np.nan, 0], [0, 0]], np.float32))
    assert env.batch.state is before
    with pytest.raises(ValueError, match='engine="numpy" does not support Randomization'):
        BallbotVectorEnv(3, engine="numpy", history=2)


def test_a_copy_goes_on_alike():
    env = BallbotVectorEnv(5, "weave", engine="numpy")
    env.reset(seed=0)
    other = copy.deepcopy(env)
    assert isinstance(other.batch, BallbotArrays)
    action = np.ones((5, 2), np.float32)
    for a, b in zip(env.step(action)[:4], other.step(action)[:4], strict=True):
        np.testing.assert_array_equal(a, b)


def test_without_torch_casadi_and_a_compiler_all_vector_envs_pass_gymnasiums_checks():
    code = """
import sys
for name in ("torch", "casadi", "scipy"):
    sys.modules[name] = None
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name in ("torch", "casadi", "scipy") else find(name, *rest)
import gymnasium, numpy as np, ballbot_gym
for task in ballbot_gym.TASKS.values():
    envs = gymnasium.make_vec(task.id, num_envs=3)
    observations, infos = envs.reset(seed=0)
    assert observations.shape == (3, *envs.single_observation_space.shape)
    for _ in range(20):
        observations, rewards, *_ = envs.step(envs.action_space.sample())
        assert np.isfinite(observations).all() and np.isfinite(rewards).all()
    print(task.id, type(envs.unwrapped.batch).__name__)
try:
    gymnasium.make_vec("BallbotTurn-v0", num_envs=3, randomization="late")
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={"PATH": "", "CC": "no-compiler"}
    )
    *envs, last = done.stdout.splitlines()
    assert envs == [f"{task.id} BallbotArrays" for task in TASKS.values()], done.stderr
    assert 'pip install "ballbot-gym[train]"' in last
    assert "Warning" not in done.stderr


def test_every_robot_has_vector_envs_in_numpy():
    for robot in ROBOTS:
        envs = gymnasium.make_vec("BallbotOrbit-v0", num_envs=2, robot=robot, engine="numpy")
        envs.reset(seed=0)
        envs.step(envs.action_space.sample())
