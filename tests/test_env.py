import copy
import hashlib
import itertools
import json
import math
import pickle
import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from ballbot_gym import BallbotEnv, Randomization
from ballbot_gym.engines import installed_physics
from ballbot_gym.robot import default_params, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.turn import Turn

REWARD_PARTS = ("reward_survive", "reward_cost", "reward_goal")
UPRIGHT = np.zeros(8)


def leaning(gamma):
    return np.array([0.0, 0.0, gamma, 0.0, 0.0, 0.0, 0.0, 0.0])


def play(env, actions):
    """Steps through actions until the episode ends; returns (reward, terminated, truncated, info) of each step."""
    steps = []
    for action in actions:
        _, reward, terminated, truncated, info = env.step(action)
        steps.append((reward, terminated, truncated, info))
        if terminated or truncated:
            break
    return steps


def digest(task, physics):
    """Hash of everything that two seeded episodes return."""
    env = BallbotEnv(task, physics=physics)
    sha = hashlib.sha256()
    rng = np.random.default_rng(5)
    for seed in (3, None):
        observation, info = env.reset(seed=seed)
        done = False
        while not done:
            sha.update(observation.tobytes() + info["state"].tobytes() + info["constants"].tobytes())
            observation, reward, terminated, truncated, info = env.step(rng.uniform(-1, 1, 2))
            sha.update(np.float64(reward).tobytes())
            done = terminated or truncated
    env.close()
    return sha.hexdigest()


OWN = replace(default_params(), body_mass=12.0)
VARIED = Randomization(body_mass=(0.8, 1.2), lean_noise=0.01)


@pytest.mark.parametrize(
    "keywords",
    [
        {},
        {"duration": 2.0},
        {"duration": np.float32(2.0), "max_episode_steps": 50},
        {"robot": "rolling"},
        {"robot": OWN, "randomization": VARIED},
        {"params": OWN},
        {"task": Turn(duration=4.0, max_speed=3.0)},
    ],
    ids=str,
)
@pytest.mark.parametrize("through", ["the spec", "JSON", "pickle"])
def test_the_spec_of_an_env_makes_the_same_env_again(keywords, through):
    env = gymnasium.make("BallbotStabilize-v0", physics="rk4", **keywords)
    spec = env.spec
    if through == "JSON":
        spec = EnvSpec.from_json(spec.to_json())
    if through == "pickle":
        spec = pickle.loads(pickle.dumps(spec))
        assert spec == env.spec
    again = gymnasium.make(spec)
    assert again.spec.max_episode_steps == env.spec.max_episode_steps
    for name in ("task", "params", "randomization", "physics"):
        assert getattr(again.unwrapped, name) == getattr(env.unwrapped, name)
    for mode in ("sync", "vector_entry_point"):
        vector = gymnasium.make_vec(spec, num_envs=2, vectorization_mode=mode)
        for name in ("task", "params", "randomization"):
            assert vector.get_attr(name) == (getattr(env.unwrapped, name),) * 2
        vector.close()


def test_a_reward_threshold_is_of_the_papers_robot_alone():
    for keywords, threshold in (
        ({}, Stabilize.reward_threshold),
        ({"robot": OWN}, None),
        ({"randomization": VARIED}, None),
    ):
        assert gymnasium.make("BallbotStabilize-v0", physics="rk4", **keywords).spec.reward_threshold == threshold


@pytest.mark.parametrize(
    ("mode", "limit", "steps"),
    [
        *((mode, 7, 7) for mode in (None, "sync", "vector_entry_point")),
        *((mode, limit, 20) for mode in (None, "vector_entry_point") for limit in (1000, -1, None)),
    ],
)
def test_max_episode_steps_cuts_episodes_short_and_lengthens_none(mode, limit, steps):
    keywords = {"physics": "rk4", "duration": 0.4, "max_episode_steps": limit}
    if mode is None:
        env = gymnasium.make("BallbotStabilize-v0", **keywords)
        action = np.zeros(2)
    else:
        env = gymnasium.make_vec("BallbotStabilize-v0", num_envs=1, vectorization_mode=mode, **keywords)
        action = np.zeros((1, 2))
    env.reset(options={"state": UPRIGHT})
    ends = []
    while not any(ends):
        *_, terminated, truncated, _ = env.step(action)
        assert not terminated
        ends.append(bool(truncated))
    assert len(ends) == steps
    if mode == "vector_entry_point":
        assert env.spec.max_episode_steps == steps
    env.close()


def test_gymnasium_checker_has_no_complaint(task, physics):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(task.id, physics=physics)
        check_env(env.unwrapped, skip_render_check=True)  # its render check opens a page
        env.close()


def test_return_and_cost_recomputed_from_states_and_forces_add_up_to_the_survival_pay(task, physics, make_env, rng):
    env = make_env(task, physics=physics)
    for seed in range(3):
        _, info = env.reset(seed=seed)
        x, c, cost, total, lived = info["state"], info["constants"], 0.0, 0.0, 0.0
        for reward, *_, info in play(env, rng.uniform(-1.2, 1.2, (task.steps, 2))):
            running = task.cost(x, info["force"], c) * task.control_dt
            assert info["reward_cost"] == -running
            assert reward == sum(info[name] for name in REWARD_PARTS)
            cost += info["cost"]
            total += reward
            lived += task.control_dt
            x = info["state"]
            if not info["failure"]:
                assert info["cost"] == running
        # random forces topple it, so that a failure's price is among what was summed
        assert info["cost"] == pytest.approx(running + task.survival_reward * (task.duration - lived))
        assert total + cost == pytest.approx(task.survival_pay, rel=1e-12)  # the order of additions differs


def test_observation_is_the_tasks_of_the_state_reported(task, physics, make_env):
    env = make_env(task, physics=physics)
    env.reset(seed=1)
    for k in range(10):
        observation, *_, info = env.step([0.02 * k, -0.1])
        np.testing.assert_array_equal(observation, np.float32(task.observe(info["state"], info["constants"])))
        assert info["tilt"] == pytest.approx(math.acos(math.cos(info["state"][2]) * math.cos(info["state"][3])))


def test_same_seed_is_bit_identical_across_processes():
    result = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    theirs = json.loads(result.stdout.splitlines()[-1])
    assert theirs == {
        f"{task} {physics}": digest(task, physics) for task, physics in itertools.product(TASKS, installed_physics())
    }


def test_every_physics_draws_the_same_episodes(task, physics, make_env):
    (_, a), (_, b) = (make_env(task, physics=name).reset(seed=4) for name in (physics, "rk4"))
    np.testing.assert_array_equal(a["state"], b["state"])
    np.testing.assert_array_equal(a["constants"], b["constants"])


def test_given_constants_take_effect_by_name_and_as_a_vector(task, make_env):
    env = make_env(task, physics="rk4")
    _, drawn = env.reset(seed=0)
    _, other = env.reset(seed=1)
    _, info = env.reset(seed=0, options={"constants": other["constants"], "state": other["state"]})
    np.testing.assert_array_equal(info["constants"], other["constants"])
    for i, name in enumerate(task.constant_names[:2]):
        _, info = env.reset(seed=0, options={"constants": {name: other["constants"][i]}})
        expected = drawn["constants"].copy()
        expected[i] = other["constants"][i]
        np.testing.assert_array_equal(info["constants"], expected)


def test_options_do_not_shift_what_later_episodes_draw(task, make_env):
    env = make_env(task, physics="rk4")
    env.reset(seed=0)
    expected = env.reset()[1]
    env.reset(seed=0, options={"state": UPRIGHT})
    got = env.reset()[1]
    np.testing.assert_array_equal(got["state"], expected["state"])
    np.testing.assert_array_equal(got["constants"], expected["constants"])


def test_falling_terminates_and_costs_the_time_not_lived(task, physics, make_env):
    env = make_env(task, physics=physics, render_mode=None)
    env.reset(seed=0, options={"state": leaning(1.0)})
    steps = play(env, [[0.0, 0.0]] * task.steps)
    _, terminated, truncated, info = steps[-1]
    assert (terminated, truncated, info["failure"], info["success"]) == (True, False, True, False)
    assert info["tilt"] > task.max_tilt
    assert env.limit_names[info["violated"]] == "tilt"
    assert info["cost"] > task.survival_reward * (task.duration - len(steps) * task.control_dt)
    assert info["constraint_cost"] == 1.0
    for *_, info in steps[:-1]:
        assert (info["failure"], info["violated"], info["constraint_cost"]) == (False, -1, 0.0)


def test_episode_is_truncated_at_its_duration(task, physics):
    env = gymnasium.make(task.id, physics=physics, duration=1.0)
    env.reset(seed=0, options={"state": UPRIGHT})
    steps = play(env, [[0.0, 0.0]] * 100)
    env.close()
    assert len(steps) == round(1.0 / task.control_dt)
    reward, terminated, truncated, info = steps[-1]
    assert (terminated, truncated, info["failure"]) == (False, True, False)
    assert info["reward_goal"] == 0
    assert reward == sum(info[name] for name in REWARD_PARTS)
    assert not any(step[1] or step[2] for step in steps[:-1])


def test_stabilize_succeeds_if_it_rests_at_the_end_and_not_before(make_env, physics):
    env = make_env(physics=physics, duration=0.1)
    env.reset(options={"state": UPRIGHT})
    steps = play(env, [[0.0, 0.0]] * 9)
    for name in ("success", "is_success"):  # as Stable-Baselines3 looks for it
        assert [step[-1][name] for step in steps] == [False] * 4 + [True]
    env.reset(options={"state": [0.2, 0, 0, 0, 0, 0, 0, 0]})
    assert not play(env, [[0.0, 0.0]] * 9)[-1][-1]["success"]


def test_turn_ends_in_success_at_the_gate_at_no_further_cost(make_env, physics):
    env = make_env("turn", physics=physics)
    _, info = env.reset(options={"constants": {"speed": 3.0}, "state": [0.75, 0, 0, 0, 3.0, 0, 0, 0]})
    steps = play(env, [[0.0, 0.0]] * 9)
    reward, terminated, truncated, info = steps[-1]
    assert (terminated, truncated, info["success"], info["failure"]) == (True, False, True, False)
    # 0.05 m at 3 m/s, upright and without force: a step is 0.06 m, and costs its time alone
    assert len(steps) == 1
    assert info["cost"] == pytest.approx(env.task.time_weight * env.task.control_dt)
    assert info["reward_goal"] == pytest.approx(env.task.survival_reward * (env.task.duration - env.task.control_dt))
    assert reward == pytest.approx(env.task.survival_pay - info["cost"])


def test_touching_an_obstacle_with_the_balls_rim_fails(make_env, physics):
    env = make_env("weave", physics=physics)
    _, info = env.reset(seed=0)
    x, y, radius = info["constants"][2:5]
    gap = 0.05  # m, between ball and obstacle
    start = np.array([x - radius - 0.1 - gap, y, 0, 0, 1.0, 0, 0, 0])
    env.reset(options={"constants": info["constants"], "state": start})
    steps = play(env, [[0.0, 0.0]] * 9)
    assert len(steps) == 3  # 0.05 m at 1 m/s
    assert steps[-1][1]
    assert steps[-1][-1]["failure"]


def test_bad_action_is_refused_and_changes_nothing(make_env, physics):
    env = make_env(physics=physics)
    env.reset(seed=0)
    for action in ([math.nan, 0.0], [0.0, math.inf], [0.0] * 3, [[0.0, 0.0]], 0.5, None):
        with pytest.raises(ValueError, match=r"action must (be finite|have shape \(2,\), not \()"):
            env.step(action)
    after = env.step([0.1, 0.1])[0]
    env.reset(seed=0)
    np.testing.assert_array_equal(env.step([0.1, 0.1])[0], after)


def test_step_after_the_end_is_refused(physics, make_env):
    for start in (UPRIGHT, leaning(1.39)):  # truncated; terminated
        env = make_env(physics=physics, duration=0.2)
        env.reset(options={"state": start})
        play(env, [[0.0, 0.0]] * 10)
        with pytest.raises(gymnasium.error.ResetNeeded, match="episode has ended"):
            env.step([0.0, 0.0])


def test_closed_environment_refuses_everything_but_close(physics, make_env):
    env = make_env(physics=physics, render_mode="rgb_array")
    env.reset(seed=0)
    env.close()
    for use in (lambda: env.step([0.0, 0.0]), env.reset, env.render):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="closed"):
            use()
    env.close()


def test_frames_are_images_that_show_the_lean(task, physics, make_env):
    env = make_env(task, physics=physics, render_mode="rgb_array")
    frames = []
    for gamma in (0.0, 0.8):
        env.reset(seed=0, options={"state": leaning(gamma)})
        frames.append(env.render())
    assert [(frame.shape, frame.dtype) for frame in frames] == [((480, 640, 3), np.uint8)] * 2
    # the body is drawn orange, and nothing else is, but a few pixels between red and green
    orange = [(f[..., 0] > 120) & (f[..., 2] < 0.35 * f[..., 0]) & (f[..., 1] > 0.35 * f[..., 0]) for f in frames]
    heights, widths = np.transpose(
        [np.ptp(np.percentile(np.nonzero(mask), [2, 98], axis=1), axis=0) for mask in orange]
    )
    assert heights[0] > 3 * widths[0]  # upright: 1 m high, 0.2 m wide
    assert widths[1] > 2 * widths[0]


def test_without_its_library_there_is_no_page_and_the_error_says_how_to_get_one(monkeypatch, make_env):
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(ImportError, match=r'render_mode="human".*needs websockets.*ballbot-gym\[play\]'):
        make_env(render_mode="human")
    assert make_env().metadata["render_modes"] == ["rgb_array"]


@pytest.mark.parametrize(
    "name", ["task", "params", "randomization", "physics", "render_mode", "action_space", "observation_space"]
)
def test_what_an_env_is_made_of_cannot_be_set(name, make_env):
    env = make_env(physics="rk4")
    env.reset(seed=0)
    before = getattr(env, name)
    for set_it in (lambda: setattr(env, name, before), lambda: env.set_wrapper_attr(name, before)):
        with pytest.raises(
            AttributeError, match=f"'{name}' cannot be set: (make a new BallbotEnv|take a wrapper) instead"
        ):
            set_it()
    assert getattr(copy.deepcopy(env), name) == before


def test_render_before_reset_is_refused(make_env):
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"render\(\) before reset"):
        make_env(render_mode="rgb_array").render()


if __name__ == "__main__":  # the other process of test_same_seed_is_bit_identical_across_processes
    print(json.dumps({f"{task} {physics}": digest(task, physics) for task in TASKS for physics in installed_physics()}))


@pytest.mark.parametrize("component", [0, 1, 2])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_component_of_an_action_may_be_other_than_finite(bad, component, physics):
    action = np.array([0.5, 0.5, 0.5])
    action[component] = bad
    env = BallbotEnv("stabilize", physics=physics, robot="omni")
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match="action must be finite"):
        env.step(action)
    assert env.get_state() == before
    env.close()


@pytest.mark.parametrize("robot", ["paper", "rolling"])
def test_an_unstable_simulation_fails_and_says_so(robot, physics, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    if physics == "rk4":
        return  # no engine
    env = BallbotEnv("stabilize", physics=physics, robot=replace(named_robot(robot), force_limit=1e30))
    env.reset(seed=0)
    for _ in range(env.task.steps):
        before = env.get_state().x
        seen, reward, terminated, _, info = env.step([1.0, 0.5])
        if terminated:
            break
    assert (terminated, info["failure"], info["success"]) == (True, True, False)
    if physics == "mujoco":
        assert env.limit_names[info["violated"]] == "engine"
        assert info["state"].tolist() == list(before)
    assert np.isfinite(seen).all()
    assert np.isfinite(reward)
    assert env.reset(seed=0)[1]["violated"] == -1
    env.step([0.0, 0.0])
    env.close()
