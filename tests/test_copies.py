"""Copies, pickles and saved states of environments go on bit-identically and independently."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

from ballbot_gym import BallbotEnv, Randomization
from ballbot_gym.env import EnvState

cloudpickle = pytest.importorskip("cloudpickle")

ALL = Randomization(
    body_mass=(0.8, 1.2),
    com_height=(0.9, 1.1),
    inertia=(0.8, 1.2),
    actuator_lag=(0.0, 0.05),
    actuator_delay=(0.0, 0.06),
    position_noise=0.01,
    push_impulse=(0.0, 3.0),
)
ONE_HEIGHT = Randomization(body_mass=(0.8, 1.2), com_height=(1.1, 1.1))  # the URDF is loaded once, then masses change
COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
}


def trace(env, steps=200):
    """Everything that many steps return, over the ends of episodes."""
    rng, seen = np.random.default_rng(9), []
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(rng.uniform(-0.2, 0.2, 2))
        seen.append(
            (observation.tobytes(), reward, terminated, truncated, info["state"].tobytes(), info["force"].tobytes())
        )
        if terminated or truncated:
            observation, info = env.reset()
            seen.append((observation.tobytes(), info["state"].tobytes()))
    return seen


@pytest.mark.parametrize("randomization", [None, ALL, ONE_HEIGHT], ids=["nominal", "randomized", "one height"])
def test_copies_go_on_bit_identically_from_the_middle_of_an_episode(physics, randomization):
    env = gymnasium.make("BallbotWeave-v0", physics=physics, randomization=randomization)
    env.reset(seed=3)
    env.reset()
    for _ in range(10):
        env.step([0.05, -0.02])
    copies = [make(env) for make in COPIES.values()]
    state = env.unwrapped.get_state()
    expected = trace(env)
    for other in copies:
        assert trace(other) == expected
        other.close()
    env.unwrapped.set_state(state)
    assert trace(env) == expected
    env.close()


@pytest.mark.parametrize("make", COPIES.values(), ids=COPIES)
def test_copy_of_a_closed_env_is_closed_and_of_one_never_reset_draws_the_same_episodes(physics, make):
    env = BallbotEnv(physics=physics)
    other = make(env)  # never seeded either
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError):
        make(env).step([0.0, 0.0])
    other.close()


def test_state_goes_to_another_env_made_alike(physics):
    first, second = (BallbotEnv("orbit", physics=physics, randomization=ALL) for _ in range(2))
    first.reset(seed=1)
    first.step([0.1, 0.1])
    second.set_state(pickle.loads(pickle.dumps(first.get_state())))
    assert trace(first, 60) == trace(second, 60)


def test_bad_states_are_refused():
    env = BallbotEnv(physics="rk4")
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"get_state\(\) before reset"):
        env.get_state()
    env.reset(seed=0)
    state = env.get_state()
    assert isinstance(state, EnvState)
    with pytest.raises(ValueError, match="the state is of Stabilize"):
        BallbotEnv("turn", physics="rk4").set_state(state)
    with pytest.raises(ValueError, match="another randomization"):
        BallbotEnv(physics="rk4", randomization=ALL).set_state(state)
    with pytest.raises(TypeError, match="takes what get_state"):
        env.set_state(np.zeros(8))


@pytest.mark.parametrize("engine", ["native", "torch"])
@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_vector_envs_copy_and_pickle(engine, mode):
    pytest.importorskip("torch")
    settings = {"engine": engine, "compile": False, "duration": 0.3, "autoreset_mode": mode}
    if engine != "native":  # which knows none
        settings["randomization"] = ALL
    envs = gymnasium.make_vec("BallbotWeave-v0", num_envs=3, **settings)

    def run(envs):
        rng, seen = np.random.default_rng(2), []
        for _ in range(20):  # an episode ends within them
            observation, reward, *_, info = envs.step(rng.uniform(-1, 1, (3, 2)))
            seen.append((observation.tobytes(), reward.tobytes(), info["state"].tobytes()))
        return seen

    envs.reset(seed=0)
    run(envs)
    copies = [copy.deepcopy(envs), pickle.loads(pickle.dumps(envs))]
    expected = run(envs)
    for other in copies:
        assert run(other) == expected
