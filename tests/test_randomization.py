import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from ballbot_gym import Randomization
from ballbot_gym.robot import TRACKS, normals
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector.batch import BallbotBatch

ROBOTS = Randomization(body_mass=(0.8, 1.3), ball_mass=(0.5, 2.0), com_height=(0.9, 1.1), inertia=(0.7, 1.4))
EVERYTHING = replace(
    ROBOTS,
    actuator_lag=(0.0, 0.05),
    actuator_delay=(0.0, 0.06),
    position_noise=0.01,
    lean_noise=0.02,
    velocity_noise=0.03,
    lean_rate_noise=0.04,
    push_impulse=(1.0, 5.0),
    push_interval=0.5,
)


def play(env, actions, seed=0):
    """(observation, reward, state) of each step, over ends of episodes."""
    observation, info = env.reset(seed=seed)
    results = [(observation, 0.0, info["state"])]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        results.append((observation, reward, info["state"]))
        if terminated or truncated:
            observation, info = env.reset()
            results.append((observation, 0.0, info["state"]))
    return results


def assert_same(got, expected):
    for a, b in zip(got, expected, strict=True):
        for left, right in zip(a, b, strict=True):
            np.testing.assert_array_equal(left, right)


def test_everything_is_off_by_default(physics, make_env, rng):
    assert not Randomization().active
    actions = rng.uniform(-1, 1, (60, 2))
    assert_same(
        play(make_env(physics=physics, randomization=Randomization()), actions),
        play(make_env(physics=physics), actions),
    )


def test_draws_fill_their_ranges(rng):
    drawn = np.array([EVERYTHING.draw(tuple(z), 0.02) for z in rng.random((4000, 6)).tolist()])
    for i, (low, high) in enumerate((ROBOTS.body_mass, ROBOTS.ball_mass, ROBOTS.com_height, ROBOTS.inertia)):
        assert low <= drawn[:, i].min() < low + 0.01 * (high - low)
        assert high >= drawn[:, i].max() > high - 0.01 * (high - low)
    assert drawn[:, 4].max() == pytest.approx(1, abs=1e-3)
    assert drawn[:, 4].min() == pytest.approx(1 - math.exp(-0.02 / 0.05), abs=1e-3)
    values, counts = np.unique(drawn[:, 5], return_counts=True)
    assert values.tolist() == [0, 1, 2, 3]
    assert counts.min() > 900


def test_each_episode_has_a_robot_of_its_own_within_the_ranges(physics, make_env, params):
    env = make_env(physics=physics, randomization=ROBOTS)
    robots = []
    for seed in range(5):
        env.reset(seed=seed)
        robots.append(env.episode_params)
        for name in ("body_mass", "ball_mass", "com_height", "inertia"):
            low, high = getattr(ROBOTS, name)
            assert low <= getattr(robots[-1], name) / getattr(params, name) <= high
        assert robots[-1].axial_inertia / params.axial_inertia == pytest.approx(robots[-1].inertia / params.inertia)
    assert len(set(robots)) == 5
    assert env.params == params


@pytest.mark.parametrize("robots", [ROBOTS, replace(ROBOTS, com_height=(1.0, 1.0))], ids=["all", "not the height"])
def test_randomized_robot_moves_as_one_made_with_its_parameters(robots, physics, make_env, rng):
    env = make_env(physics=physics, randomization=robots)
    for seed in range(3):
        _, info = env.reset(seed=seed)
        same = make_env(physics=physics, params=env.episode_params)
        same.reset(options={"state": info["state"]})
        for action in rng.uniform(-0.3, 0.3, (15, 2)):
            np.testing.assert_array_equal(env.step(action)[4]["state"], same.step(action)[4]["state"])


def test_seed_repeats_a_randomized_episode(physics, make_env, rng):
    env, actions = make_env(physics=physics, randomization=EVERYTHING), rng.uniform(-1, 1, (50, 2))
    assert_same(play(env, actions, seed=2), play(env, actions, seed=2))


def test_delayed_force_comes_the_drawn_number_of_steps_later(make_env):
    env = make_env(physics="rk4", randomization=Randomization(actuator_delay=(0.04, 0.04)))
    env.reset(seed=0, options={"state": np.zeros(8)})
    forces = [env.step([0.01 * k, 0.0])[4]["force"][0] for k in range(1, 6)]
    assert forces == pytest.approx([0, 0, 3.5, 7.0, 10.5])
    env.reset(options={"state": np.zeros(8)})
    assert env.step([1, 1])[4]["force"].tolist() == [0, 0]  # commands of the last episode are forgotten


def test_lagging_force_approaches_its_command_exponentially(make_env):
    env = make_env(physics="rk4", randomization=Randomization(actuator_lag=(0.05, 0.05)))
    env.reset(seed=0, options={"state": np.zeros(8)})
    forces = [env.step([0.1, 0.0])[4]["force"][0] for _ in range(6)]
    expected = 35 * (1 - np.exp(-0.02 * np.arange(1, 7) / 0.05))
    np.testing.assert_allclose(forces, expected, rtol=1e-6)  # the tiny constant in the gain is 2e-8 of the lag


def test_cost_charges_the_force_applied(make_env, rng):
    env = make_env(physics="rk4", randomization=EVERYTHING)
    _, info = env.reset(seed=0)
    for action in rng.uniform(-0.2, 0.2, (10, 2)):
        x, c = info["state"], info["constants"]
        _, _, terminated, truncated, info = env.step(action)
        assert not terminated
        assert not truncated
        assert info["cost"] == pytest.approx(env.task.cost(x, info["force"], c) * 0.02)


def test_normal_numbers_are_normal(rng):
    sample = np.array(normals(tuple(rng.random((8, 20_000)))))
    assert np.abs(sample.mean(1)).max() < 5 / math.sqrt(20_000)
    assert np.abs(np.cov(sample) - np.eye(8)).max() < 5 * math.sqrt(2 / 20_000)
    assert np.abs((sample**4).mean(1) - 3).max() < 5 * math.sqrt(96 / 20_000)


def test_sensors_err_by_the_standard_deviations_given_and_info_tells_the_truth(make_env):
    noise = Randomization(position_noise=0.05, lean_noise=0.02, velocity_noise=0.1, lean_rate_noise=0.2)
    env = make_env(physics="rk4", randomization=noise)
    errors = []
    for _ in range(2000):
        observation, info = env.reset(seed=None if errors else 0, options={"state": np.full(8, 0.1)})
        np.testing.assert_array_equal(info["state"], np.full(8, 0.1))
        errors.append(observation * env.task.observation_scale - 0.1)
    assert np.abs(np.mean(errors, axis=0) / noise.noise).max() < 5 / math.sqrt(2000)
    np.testing.assert_allclose(np.std(errors, axis=0), noise.noise, rtol=5 / math.sqrt(4000))


def test_push_delivers_its_impulse_as_often_as_asked(rng):
    pushes = Randomization(push_impulse=(2.0, 4.0), push_interval=0.2)
    n = 50_000
    impulse = 0.02 * np.hypot(*pushes.push(tuple(rng.random((3, n))), 0.02))
    came = impulse > 0
    assert came.mean() == pytest.approx(0.1, abs=5 * math.sqrt(0.09 / n))
    assert impulse[came].min() >= 2
    assert impulse[came].max() <= 4
    assert impulse[came].mean() == pytest.approx(3, abs=0.05)


def test_push_moves_the_ball_and_is_not_charged(physics, make_env, params):
    """A push J in one control step changes ẋ by about c·J, the paper's c of its linearization."""
    env = make_env(physics=physics, randomization=Randomization(push_impulse=(0.5, 0.5), push_interval=0.02))
    env.reset(seed=0, options={"state": np.zeros(8)})
    info = env.step([0, 0])[-1]
    speed = np.hypot(*info["state"][4:6])
    assert speed == pytest.approx(0.295172 * 0.5, rel=0.01)
    assert info["cost"] == 0
    assert info["force"].tolist() == [0, 0]


def batch(count, randomization, **kwargs):
    return BallbotBatch("stabilize", count, dtype=torch.float64, compile=False, randomization=randomization, **kwargs)


def test_randomized_episodes_depend_neither_on_batch_size_nor_on_position():
    actions = torch.rand(40, 11, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    whole, part = batch(11, EVERYTHING, duration=0.4), batch(3, EVERYTHING, duration=0.4)
    assert torch.equal(whole.reset(seed=0)[5:8], part.reset(seed=5))
    for a in actions:
        expected, got = whole.step(a), part.step(a[5:8])
        assert torch.equal(expected.observation[5:8], got.observation)
        assert torch.equal(expected.reward[5:8], got.reward)


def test_batched_sensors_and_pushes_have_the_statistics_asked_for():
    n = 20_000
    noise = Randomization(velocity_noise=0.1, push_impulse=(0.5, 0.5), push_interval=0.08)
    vec = batch(n, noise)
    observation = vec.reset(seed=0, x=torch.zeros(8, n, dtype=torch.float64))
    assert observation[:, 4:6].std() * 5 == pytest.approx(0.1, rel=0.03)
    assert (observation[:, :4] == 0).all()
    assert torch.equal(vec.observe(vec.state), observation)  # looking twice shows the same
    result = vec.step(torch.zeros(n, 2))
    speed = torch.hypot(*result.final_x[4:6])
    assert (speed > 0).double().mean() == pytest.approx(0.25, abs=5 * math.sqrt(0.19 / n))
    assert speed[speed > 0].mean() == pytest.approx(0.295172 * 0.5, rel=0.01)
    assert (result.cost == 0).all()


def test_gradients_flow_through_randomized_robots_and_actuators():
    vec = batch(3, EVERYTHING)
    vec.reset(seed=0)
    actions = torch.zeros(6, 3, 2, dtype=torch.float64, requires_grad=True)
    cost = sum(vec.step(a).cost.sum() for a in actions)
    (gradient,) = torch.autograd.grad(cost, actions)
    assert torch.isfinite(gradient).all()
    assert (gradient[0] != 0).all()


@pytest.mark.parametrize("track", TRACKS)
def test_track_is_the_same_for_all_kinds_of_envs(track, make_env):
    """The same name, what it draws in info under one key, and the same motion for the same draw."""
    env = make_env(physics="rk4", randomization=track)
    many = BallbotVectorEnv(3, engine="torch", compile=False, dtype="float64", randomization=track)
    assert env.randomization == many.randomization == TRACKS[track]
    _, infos = many.reset(seed=5)
    assert len(infos["drawn"][0]) == TRACKS[track].episode_draws
    assert len(np.unique(infos["drawn"], axis=0)) == (3 if track != "late" else len(np.unique(infos["drawn"][:, 5])))
    options = {"state": infos["state"][1], "drawn": infos["drawn"][1]}
    np.testing.assert_array_equal(env.reset(options=options)[1]["drawn"], infos["drawn"][1])
    for action in np.random.default_rng(0).uniform(-0.2, 0.2, (8, 2)):
        infos, info = many.step(np.tile(action, (3, 1)).astype(np.float32))[4], env.step(action.astype(np.float32))[4]
        np.testing.assert_allclose(infos["state"][1], info["state"], atol=1e-6)
        np.testing.assert_allclose(infos["force"][1], info["force"], rtol=1e-6)
        assert (info["drawn"] == options["drawn"]).all()


def test_weak_actuator_gives_its_share_of_the_force_and_friction_is_a_share_too(make_env):
    robots = Randomization(force=(0.5, 0.5), friction=(0.5, 0.5))
    env = make_env(physics="rk4", robot="rolling", randomization=robots)
    env.reset(seed=0)
    assert env.step([0.2, -0.1])[4]["force"] == pytest.approx(0.5 * env.params.force_limit * np.array([0.2, -0.1]))
    assert env.episode_params.friction == env.params.friction / 2
    assert env.episode_params.force_limit == env.params.force_limit / 2
    batch = BallbotBatch("stabilize", 3, robot="rolling", randomization="unknown", compile=False)
    batch.reset(seed=0)
    batch.step(torch.zeros(3, 2))
    frictions = batch.model(batch.state.drawn.unbind(0)).friction.tolist()
    assert len(set(frictions)) == 3
    assert 0.549 < min(frictions) < max(frictions) < 1.001
    plain = make_env(physics="rk4", randomization=robots)
    plain.reset(seed=0)
    assert plain.episode_params.friction == math.inf


def test_biased_sensors_are_wrong_by_the_same_all_the_time_and_odometry_drifts(make_env):
    env = make_env(physics="rk4", randomization=Randomization(lean_bias=0.1, lean_rate_bias=0.2, odometry_drift=0.3))
    seen, info = env.reset(seed=3)
    errors = []
    for _ in range(4):
        seen, *_, info = env.step(np.zeros(2))
        errors.append(seen * env.task.observation_scale - info["state"])
    drift, lean, rate = info["drawn"][8:10], info["drawn"][10:12], info["drawn"][12:]
    for k, error in enumerate(errors, start=1):
        expected = [*(k * env.task.control_dt * drift), *lean, *drift, *rate]
        np.testing.assert_allclose(error, expected, atol=1e-5)


@pytest.mark.parametrize("task", ["stabilize", "orbit"])
def test_history_shows_the_last_observations_with_their_actions_in_every_kind_of_env(task, make_env):
    plain, env = make_env(task, physics="rk4"), make_env(task, physics="rk4", history=2)
    own = plain.observation_space.shape[0]
    assert env.observation_space.shape == (own + 2 * (own + 2),)
    many = BallbotVectorEnv(2, task, engine="torch", compile=False, dtype="float64", history=2)
    _, infos = many.reset(seed=0)
    options = {"state": infos["state"][0], "constants": infos["constants"][0]}
    observed, actions = [plain.reset(options=options)[0]], []
    first = np.append(observed[0], np.zeros(2, np.float32))
    np.testing.assert_array_equal(env.reset(options=options)[0], [*observed[0], *first, *first])
    for action in np.random.default_rng(0).uniform(-0.1, 0.1, (5, 2)).astype(np.float32):
        observed.append(plain.step(action)[0])
        actions.append(action)
        before = [*zip(observed[:-1], actions, strict=True)][::-1][:2]
        wanted = np.concatenate([observed[-1], *(part for pair in before for part in pair)])
        wanted = np.append(wanted, np.tile(first, 2 - len(before)))
        kept = env.get_state()
        np.testing.assert_array_equal(env.step(action)[0], wanted)
        env.set_state(kept)
        np.testing.assert_array_equal(env.step(action)[0], wanted)
        np.testing.assert_allclose(many.step(np.tile(action, (2, 1)))[0][0], wanted, atol=1e-5)


def test_history_and_sensors_of_a_vector_env_begin_in_the_state_that_is_given():
    state = np.zeros(8)
    many = BallbotVectorEnv(2, engine="torch", compile=False, history=1)
    seen, _ = many.reset(seed=0, options={"state": state})
    own = len(many.task.observation_scale)
    np.testing.assert_array_equal(seen[:, own : 2 * own], seen[:, :own])
    settings = {"robot": "omni", "observation": "sensors", "compile": False}
    many, batch = BallbotVectorEnv(2, engine="torch", **settings), BallbotBatch(num_envs=2, **settings)
    x = np.zeros(batch.params.state_size)
    x[3] = 0.2
    seen, _ = many.reset(seed=0, options={"state": x})
    given = torch.as_tensor(np.tile(x[:, None], 2), dtype=torch.float32)
    np.testing.assert_array_equal(seen, batch.reset(0, x=given))


def test_history_of_an_ended_episode_is_forgotten(make_env):
    env = make_env(physics="rk4", history=1)
    own = len(env.task.observation_scale)
    many = BallbotVectorEnv(2, engine="torch", compile=False, history=1, duration=0.04)
    env.reset(seed=0)
    env.step(np.ones(2))
    seen = env.reset()[0]
    np.testing.assert_array_equal(seen[own:], [*seen[:own], 0, 0])
    many.reset(seed=0)
    many.step(np.ones((2, 2), np.float32))
    seen, *_, infos = many.step(np.ones((2, 2), np.float32))
    np.testing.assert_array_equal(seen[:, own : 2 * own], seen[:, :own])
    assert not seen[:, 2 * own :].any()
    assert infos["final_obs"][0][own:].all()
