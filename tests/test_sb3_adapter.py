import gymnasium
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from ballbot_gym.seeding import spawned
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_train.learning.sb3 import BallbotVecEnv


def make(num_envs=4, **kwargs):
    return BallbotVecEnv(BallbotVectorEnv(num_envs, **kwargs))


def test_what_make_vec_returns_can_be_wrapped():
    env = BallbotVecEnv(gymnasium.make_vec("BallbotTurn-v0", num_envs=2))
    assert env.reset().shape == (2, 9)
    assert env.observation_space == gymnasium.make("BallbotTurn-v0", physics="rk4").observation_space
    env.close()


def test_only_a_ballbot_vector_env_is_taken():
    with pytest.raises(TypeError, match="SyncVectorEnv"):
        BallbotVecEnv(gymnasium.make_vec("BallbotTurn-v0", num_envs=1, vectorization_mode="sync", physics="rk4"))


def test_terminal_observation_is_the_last_of_the_old_episode_and_the_returned_one_the_first_of_the_next():
    env, same = make(duration=0.1, engine="torch"), BallbotVectorEnv(4, duration=0.1, engine="torch")
    env.seed(3)
    first = env.reset()
    np.testing.assert_array_equal(first, same.reset(seed=spawned(3))[0])
    for _ in range(5):
        observation, _, done, infos = env.step(np.zeros((4, 2)))
        x = same.batch.state.x
        expected, *_ = same.step(np.zeros((4, 2)))
    assert done.all()
    np.testing.assert_array_equal(observation, expected)
    end = same.params.step(x.unbind(0), (0 * x[0], 0 * x[0]), 0.02, 2)
    terminal = np.stack([info["terminal_observation"] for info in infos])
    np.testing.assert_array_equal(terminal, np.stack(same.task.observe(end, ()), axis=-1))
    assert np.abs(observation - terminal).max() > 0.1


def test_running_out_of_time_is_truncation_and_falling_is_not():
    env = make(2, duration=0.2)
    env.set_options([{"state": np.zeros(8)}, {"state": np.array([0, 0, 1.39, 0, 0, 0, 2.0, 0])}])
    env.reset()
    ends = {}
    for _ in range(10):
        _, reward, done, infos = env.step(np.zeros((2, 2)))
        assert reward.dtype == np.float32
        for i in np.flatnonzero(done):
            ends.setdefault(int(i), (infos[i]["TimeLimit.truncated"], infos[i]["is_success"], infos[i]["failure"]))
        assert all(info == {} for info, ended in zip(infos, done, strict=True) if not ended)
    assert ends == {0: (True, True, False), 1: (False, False, True)}


def test_seeds_and_options_are_used_once():
    env = make()
    env.seed(7)
    first, second = env.reset(), env.reset()
    assert not np.array_equal(first, second)
    env.seed(7)
    np.testing.assert_array_equal(env.reset(), first)
    env.set_options({"state": np.zeros(8)})
    np.testing.assert_array_equal(env.reset(), np.zeros((4, 8)))
    assert np.abs(env.reset()).max() > 0


def test_ends_of_episodes_report_what_a_vec_monitor_reports():
    env = make(6, duration=0.2)
    with pytest.warns(UserWarning, match="Monitor"):
        both = VecMonitor(make(6, duration=0.2))
    env.seed(1), both.seed(1)
    env.reset(), both.reset()
    rng, ends = np.random.default_rng(0), 0
    for _ in range(25):
        actions = rng.uniform(-1, 1, (6, 2))
        ours, theirs = env.step(actions)[3], both.step(actions)[3]
        for a, b in zip(ours, theirs, strict=True):
            assert ("episode" in a) == ("episode" in b)
            if "episode" in a:
                ends += 1
                assert a["episode"]["l"] == b["episode"]["l"] <= 10
                assert a["episode"]["r"] == pytest.approx(b["episode"]["r"], rel=1e-5)
                assert a["episode"]["t"] >= 0
    assert ends >= 12


def test_only_same_step_autoreset_is_taken():
    with pytest.raises(ValueError, match='autoreset_mode="SameStep"'):
        make(2, autoreset_mode="NextStep")


def test_ppo_learns_on_it_and_logs_episodes():
    env = make(16, duration=0.4)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=256, n_epochs=2, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(3000)
    assert model.num_timesteps >= 3000
    assert len(model.ep_info_buffer) > 20
    assert {"r", "l"} <= set(model.ep_info_buffer[0])
    assert len(model.ep_success_buffer) > 20
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
