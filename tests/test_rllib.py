"""What RLlib trains on our ids is measured by our evaluation, from the algorithm and from its checkpoint alike."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ray.rllib", exc_type=ImportError)
pytestmark = pytest.mark.slow


def test_ppo_with_two_env_runners_is_measured_by_its_regret(capsys, tmp_path):
    import ray
    from ray.rllib.algorithms.algorithm import Algorithm

    from ballbot_gym.env import BallbotEnv

    spec = importlib.util.spec_from_file_location(
        "train_rllib", Path(__file__).parent.parent / "examples" / "train_rllib.py"
    )
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    saved = tmp_path / "checkpoint"
    example.main(
        iterations=1, envs_per_runner=2, batch=128, minibatch=64, epochs=1, episodes=2, physics="rk4", save=str(saved)
    )
    assert re.search(r"certified episodes: success .*, mean regret", capsys.readouterr().out)
    observation = BallbotEnv("stabilize", physics="rk4").reset(seed=0)[0]
    algorithm = Algorithm.from_checkpoint(str(saved))
    policy = example.RllibPolicy(algorithm)
    action, _ = policy.predict(observation)
    assert action.shape == (2,)
    batch, _ = policy.predict(np.stack([observation, 2 * observation]))
    assert np.allclose(batch[0], action)
    assert np.all(np.abs(batch) <= 1)
    algorithm.stop()
    ray.shutdown()
