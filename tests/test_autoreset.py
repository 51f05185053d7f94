"""Vector environments restart episodes as Gymnasium's own do, in each of its three modes and with every engine."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

torch = pytest.importorskip("torch")

from ballbot_gym import Randomization  # noqa: E402
from ballbot_gym.tasks import TASKS  # noqa: E402
from ballbot_gym.vector import BallbotVectorEnv  # noqa: E402

INFO = (
    *("reward_survive", "reward_cost", "reward_goal", "cost", "tilt", "success", "is_success", "failure"),
    *("violated", "constraint_cost", "force", "clipped"),
)
ROBOTS = Randomization(body_mass=(0.8, 1.2), actuator_delay=(0.0, 0.06), position_noise=0.01, push_impulse=(0.0, 3.0))


@pytest.mark.parametrize(
    ("name", "limit", "mode"),
    [
        ("turn", None, AutoresetMode.NEXT_STEP),
        ("turn", None, AutoresetMode.DISABLED),
        ("weave", 7, AutoresetMode.SAME_STEP),
    ],
)
@pytest.mark.parametrize("engine", ["native", "torch"])
def test_ends_rewards_and_infos_are_those_of_gymnasiums_sync(name, mode, engine, limit):
    """The sync envs draw other episodes, so that both are started alike at each restart of ours.

    An episode may have 10 control steps; max_episode_steps=7 cuts it short.
    """
    size, duration = 4, 0.2
    ours = BallbotVectorEnv(
        size,
        TASKS[name](duration=duration),
        dtype=torch.float64,
        compile=False,
        engine=engine,
        autoreset_mode=mode,
        max_episode_steps=limit,
    )
    sync = gymnasium.make_vec(
        TASKS[name].id,
        num_envs=size,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        physics="rk4",
        duration=duration,
        max_episode_steps=limit,
    )
    assert ours.metadata["autoreset_mode"] is ours.autoreset_mode is mode
    _, infos = ours.reset(seed=5)

    def follow(which, infos):
        """Starts the sync envs named in the episodes that ours began."""
        for i in np.flatnonzero(which):
            start = {"state": infos["state"][i], "constants": infos["constants"][i]}
            sync.envs[i].reset(options=start)

    sync.reset(seed=5)
    follow(np.ones(size, bool), infos)
    rng, ends, pending = np.random.default_rng(1), 0, np.zeros(size, bool)
    for _ in range(100):
        actions = rng.uniform(-1, 1, (size, 2)) * np.array([[0.05], [0.3], [1.0], [1.2]])
        observation, *got, infos = ours.step(actions)
        its_observation, *expected, its_infos = sync.step(actions)
        for a, b in zip(got, expected, strict=True):  # rewards, terminations, truncations
            assert a.dtype == b.dtype
            np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7)
        assert infos.keys() == its_infos.keys()
        for key in (key for key in infos if key.startswith("_")):
            np.testing.assert_array_equal(infos[key], its_infos[key], err_msg=key)
        done = got[1] | got[2]
        ends += done.sum()
        begun = done if mode is AutoresetMode.SAME_STEP else pending
        same = ~begun  # the others began episodes that were drawn apart
        np.testing.assert_allclose(observation[same], its_observation[same], rtol=1e-5, atol=1e-5)
        for key in INFO:
            assert (infos[key].shape, infos[key].dtype) == (its_infos[key].shape, its_infos[key].dtype)
            np.testing.assert_allclose(infos[key][same], its_infos[key][same], rtol=1e-6, atol=1e-6, err_msg=key)
        if mode is AutoresetMode.SAME_STEP:
            for i in np.flatnonzero(done):
                np.testing.assert_allclose(infos["final_obs"][i], its_infos["final_obs"][i], rtol=1e-5, atol=1e-5)
                for key, told in its_infos["final_info"].items():
                    np.testing.assert_allclose(
                        infos["final_info"][key][i], told[i], rtol=1e-5, atol=1e-5, err_msg=f"final {key}"
                    )
        if mode is AutoresetMode.DISABLED and done.any():
            _, infos = ours.reset(options={"reset_mask": done})
            sync.reset(options={"reset_mask": done.copy()})
            np.testing.assert_array_equal(infos["_state"], done)
            follow(done, infos)
            pending = np.zeros(size, bool)
        else:
            follow(begun, infos)
            pending = done if mode is AutoresetMode.NEXT_STEP else pending
    assert ends > 30  # and as many restarts


@pytest.mark.parametrize("engine", ["native", "torch"])
def test_disabled_wants_a_reset_of_what_has_ended(engine):
    envs = BallbotVectorEnv(2, duration=0.04, engine=engine, compile=False, autoreset_mode="Disabled")
    envs.reset(seed=0, options={"state": np.zeros(8)})
    envs.step(np.zeros((2, 2)))
    *_, truncated, _ = envs.step(np.zeros((2, 2)))
    assert truncated.all()
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"envs \[0, 1\] have ended.*reset_mask"):
        envs.step(np.zeros((2, 2)))


@pytest.mark.parametrize("randomization", [None, ROBOTS], ids=["nominal", "randomized"])
def test_all_engines_and_all_modes_run_the_same_episodes(randomization):
    def starts(engine, mode):
        envs = BallbotVectorEnv(
            3,
            TASKS["weave"](duration=0.1),
            dtype=torch.float64,
            compile=False,
            engine=engine,
            autoreset_mode=mode,
            randomization=randomization,
        )
        _, infos = envs.reset(seed=[7, 8, 2**40])
        found = [infos["state"]]
        while len(found) < 4:
            *_, terminated, truncated, infos = envs.step(np.zeros((3, 2)))
            done = terminated | truncated
            if done.all():
                if mode == "NextStep":
                    *_, infos = envs.step(np.ones((3, 2)))
                if mode == "Disabled":
                    _, infos = envs.reset(options={"reset_mask": done})
                found.append(infos["state"])
        return np.array(found)

    expected = starts("torch", "SameStep")
    for engine in ("torch",) if randomization else ("native", "torch"):
        for mode in ("SameStep", "NextStep", "Disabled"):
            np.testing.assert_allclose(starts(engine, mode), expected, rtol=1e-12, atol=1e-12)
