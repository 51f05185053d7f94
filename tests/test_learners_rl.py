"""PPO and SAC, with and without demonstrations: they run, and go on from a state as if never stopped."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from resuming import goes_on_as_if_never_stopped, parameters, through_a_file

from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import default_params
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.symmetry import FRAMES, REACH
from ballbot_train.learning import model_free, ppo, sac
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.datasets import Demos, load_demos
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import shipped_policies
from ballbot_train.policy.network import PolicyNetwork

SHARED = {"gamma": 0.995, "final_gamma": 0.999, "iterations": 3, "num_envs": 4, "hidden": (16, 8)}
RELATIVE = {"relative_advantages": False, "relative_values": False}
TINY = {
    "ppo": ppo.PpoConfig(num_steps=16, episode_seconds=0.4, batch_size=32, gae_lambda=0.95, **RELATIVE, **SHARED),
    "sac": sac.SacConfig(
        products=True, num_steps=8, gradient_steps=2, episode_seconds=0.2, batch_size=16, n_steps=1, **SHARED
    ),
}
CLONED = 2  # iterations
SCALE = model_free._REWARD_SCALE


@pytest.fixture(autouse=True)
def little_imitation(monkeypatch):
    for constant, value in {
        "CLONE_ITERATIONS": CLONED,
        "CLONE_STEPS": 5,
        "CLONE_BATCH": 32,
        "WARMUP_ITERATIONS": 1,
    }.items():
        monkeypatch.setattr(model_free, f"_{constant}", value)
    monkeypatch.setattr(sac, "_CONTROL_DT", None)  # as in the task
    monkeypatch.setattr(ppo, "UPDATE_EPOCHS", 2)


@pytest.fixture(params=["ppo", "sac"])
def name(request):
    return request.param


def make(name, demos=None, seed=0, **settings):
    return LEARNERS[name].make(make_task("stabilize"), default_params(), replace(TINY[name], **settings), seed, demos)


def run(learner, iterations=None):
    for _ in range(learner.iterations - learner.iteration if iterations is None else iterations):
        figures = learner.iterate()
    assert all(np.isfinite(float(value)) for value in figures.values())
    return learner


def observed(batch, size=8):
    return torch.randn(batch, size, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("demonstrated", [False, True])
def test_a_learner_goes_on_from_its_state_as_if_never_stopped(name, demonstrated, demos):
    assert goes_on_as_if_never_stopped(lambda seed: make(name, demos if demonstrated else None, seed))


def test_the_policy_acts_as_the_actor_does(name, tmp_path):
    task, learner = make_task("stabilize"), make(name)
    run(learner, 1)
    observation = np.random.default_rng(0).normal(size=(100, 8)).astype(np.float32)
    learner.network.save(tmp_path / "policy", {})
    with torch.no_grad():
        actions = PolicyNetwork.load(tmp_path / "policy", task)(torch.as_tensor(observation))
    expected, _ = learner._model.predict(observation, deterministic=True)
    np.testing.assert_allclose(actions.numpy(), expected, atol=1e-6)  # float32


def test_learning_rate_and_deviation_fall_as_they_are_set(name):
    learner = make(name, learning_rate=1e-3, final_learning_rate_fraction=0.1)
    rates = [learner.iterate()["train/learning_rate"] for _ in range(2)]
    assert rates == pytest.approx([1e-3, 7e-4], rel=1e-3)
    if name == "ppo":
        learner = make(name, std=0.2, final_std=0.025)
        assert [learner.iterate()["train/std"] for _ in range(3)] == pytest.approx([0.2, 0.1, 0.05])


@pytest.mark.parametrize("setting", ["gamma", "final_gamma"])
def test_a_discount_that_is_no_discount_is_refused(name, setting):
    with pytest.raises(ValueError, match=f"^{setting} must be between 0 and 1, not 1"):
        make(name, **{setting: 1.0})


def test_with_demonstrations_it_first_imitates_and_then_teaches_its_critic_alone(name, demos):
    learner = make(name, demos)
    cloned = parameters(run(learner, CLONED))
    assert learner._model.num_timesteps == 0
    assert torch.equal(parameters(run(learner, 1)), cloned)
    assert learner._model.num_timesteps > 0
    assert not torch.equal(parameters(run(learner, 1)), cloned)


@pytest.mark.parametrize("linear", [False, True])
def test_ppo_trains_on_from_a_policy_of_any_shape_and_its_critic_first(linear):
    torch.manual_seed(4)
    task = make_task("turn")
    given = PolicyNetwork(spec_for(task, "frame", (5, 6), linear))
    settings = replace(TINY["ppo"], iterations=4)

    def started(seed=0):
        return LEARNERS["ppo"].make(task, default_params(), settings, seed, None, given)

    learner = started()
    assert learner.network.spec == given.spec
    critics = [learner._model.policy.branches.critic.linear.weight.detach().clone()]
    run(learner, 1)
    critics.append(learner._model.policy.branches.critic.linear.weight.detach().clone())
    given_weights = torch.cat([value.flatten() for value in given.state_dict().values()])
    assert torch.equal(parameters(learner), given_weights)
    assert not torch.equal(*critics)
    run(learner, 3)
    assert not torch.equal(parameters(learner), given_weights)
    seen = 9 * observed(50, 9)
    with torch.no_grad():
        expected = learner._actor(seen)
    shown = learner._env._seen(seen.numpy())  # in Turn's frame, whose axes are the world's
    actions, _ = learner._model.predict(shown, deterministic=True)
    np.testing.assert_allclose(actions.clip(-1, 1), expected, atol=1e-6)
    second = started(seed=1)
    second.load_state_dict(through_a_file(run(started(), 3).state_dict()))
    assert torch.equal(parameters(run(second, 1)), parameters(learner))


def test_sac_trains_on_from_its_own_policy_and_says_from_what_it_cannot():
    given = run(make("sac", n_steps=1), 1).network
    config = replace(TINY["sac"], iterations=2)
    learner = LEARNERS["sac"].make(make_task("stabilize"), default_params(), config, 3, None, given)
    assert torch.equal(parameters(learner), torch.cat([value.flatten() for value in given.state_dict().values()]))
    run(learner)
    with pytest.raises(ValueError, match="cannot start one of"):
        LEARNERS["sac"].make(make_task("stabilize"), default_params(), replace(config, hidden=(9,)), 3, None, given)


def test_a_warm_start_is_one_and_not_backwards(demos, name):
    given = make(name).network
    with pytest.raises(ValueError, match="give one of --demos and --start"):
        LEARNERS[name].make(make_task("stabilize"), default_params(), TINY[name], 0, demos, given)
    other, message = {
        "ppo": ({"backwards": True}, "--backwards works only from scratch"),
        "sac": ({"n_steps": 3}, "n_steps must be 1 with demonstrations"),
    }[name]
    with pytest.raises(ValueError, match=message):
        make(name, demos, **other)


@pytest.mark.parametrize("name", ["turn", "stabilize"])
def test_demonstrations_without_pay_cost_what_the_episodes_did(name):
    """One episode arrives or rests, one falls, one is cut short by the next."""
    task = make_task(name)
    env = BallbotEnv(task, physics="rk4")
    network = PolicyNetwork.load(next(iter(shipped_policies(task).values())), task)
    rewards, costs, ends = [], [], []
    for seed, act in ((0, network), (1, lambda seen: torch.ones(2)), (2, network)):
        observation, info = env.reset(seed=seed)
        terminated = truncated = False
        while not (terminated or truncated):
            with torch.no_grad():
                action = act(torch.as_tensor(observation)).numpy()
            observation, reward, terminated, truncated, info = env.step(action)
            rewards.append(reward)
            costs.append(40.0 * info["failure"] - info["reward_cost"])
            ends.append((terminated, truncated))
    env.close()
    terminations, truncations = np.array(ends).T
    assert terminations.sum() == (3 if task.first_exit else 1)
    none = np.zeros((len(rewards), len(task.observation_scale)), np.float32)
    paid = Demos(none, none[:, :2], np.array(rewards, np.float32), none, terminations, truncations, none[:, :2])
    np.testing.assert_allclose(paid.without_pay(task, 40.0).rewards, -np.array(costs), atol=1e-3)


@pytest.mark.parametrize(
    ("task", "symmetry"),
    [*((task, LEARNERS["ppo"].settings(task).symmetry) for task in TASKS), ("turn", "frame"), ("weave", "mirrors")],
)
def test_the_actor_of_ppo_has_the_symmetry_of_its_task(task, symmetry):
    settings = replace(TINY["ppo"], symmetry=symmetry, iterations=1)
    learner = LEARNERS["ppo"].make(make_task(task), default_params(), settings, 0, None)
    start = parameters(learner)
    run(learner)
    assert not torch.equal(parameters(learner), start)
    assert learner.network.spec == spec_for(make_task(task), symmetry, (16, 8))
    acts_as_its_policy(learner, observed(TINY["ppo"].num_envs, learner.network.spec.observations))


def acts_as_its_policy(learner, observation):
    """What the learner's model does in its envs is what the policy does that is saved."""
    envs = learner._env
    envs.step_async(learner._model.predict(envs._seen(observation.numpy()), deterministic=True)[0])
    with torch.no_grad():
        np.testing.assert_allclose(envs._actions.clip(-1, 1), learner.network(observation), atol=1e-6)  # float32


def test_ppo_refuses_a_symmetry_that_the_task_has_not():
    with pytest.raises(ValueError, match="BallbotTurn-v0 has no mirror images"):
        LEARNERS["ppo"].make(make_task("turn"), default_params(), replace(TINY["ppo"], symmetry="mirrors"), 0, None)


@pytest.mark.parametrize(
    ("task", "symmetry"),
    [("turn", "frame"), ("orbit", "frame"), ("stabilize", "centred"), ("orbit", "centred"), ("weave", "centred")],
)
def test_sac_sees_and_acts_in_the_frame_of_its_task_and_keeps_the_steady_motion(task, symmetry, monkeypatch):
    monkeypatch.setattr(model_free, "_AVERAGED_ITERATIONS", 1)
    settings = replace(TINY["sac"], symmetry=symmetry)
    learner = run(LEARNERS["sac"].make(make_task(task), default_params(), settings, 0, None))
    expected = spec_for(make_task(task), symmetry, (16, 8))
    assert (learner.network.spec.frame, learner.network.spec.centred) == (expected.frame, expected.centred)
    batch = learner._env.batch
    acts_as_its_policy(learner, torch.as_tensor(batch.observe(batch.state)))
    if task == "stabilize":
        with torch.no_grad():
            assert learner.network(torch.zeros(8)).tolist() == [0.0, 0.0]


def test_sac_weighs_errors_by_costs_and_not_by_the_entropies_that_are_to_come():
    learner = make("sac")
    learner._log_ent_coef.data.fill_(np.log(0.01))
    gamma = learner._model.gamma
    later = 0.01 * learner.config.target_entropy * gamma / (1 - gamma)
    without_costs = learner._value_of_living(gamma) + later
    values = (without_costs - torch.tensor([[0.1], [1.0], [10.0]])).requires_grad_()
    learner._weigh(None, None, values)
    values.sum().backward()
    weights = values.grad.flatten()
    np.testing.assert_allclose(weights / weights[1], [10, 1, 0.1], rtol=1e-4)


@pytest.mark.parametrize("demonstrated", [False, True])
def test_sac_with_mirrors_learns_from_mirror_images_and_acts_the_same_in_them(demonstrated, demos):
    learner = run(make("sac", demos if demonstrated else None, symmetry="mirrors"))
    spec = spec_for(make_task("stabilize"), "mirrors", (16, 8))
    assert learner.network.spec.mirrors == spec.mirrors
    observation = observed(20)
    with torch.no_grad():
        for signs, acted in spec.mirrors:
            given, there = learner.network(observation), learner.network(torch.tensor(signs) * observation)
            torch.testing.assert_close(there, torch.tensor(acted) * given)
    drawn = learner._replay.sample(400)
    steps = learner._replay.observations.reshape(-1, 8)
    if demonstrated:
        steps = np.concatenate([steps, load_demos(demos, make_task("stabilize")).observations])
    images = [np.ones(8), *(np.array(signs) for signs, _ in spec.mirrors)]
    for sample in drawn.observations.numpy()[:50]:
        assert any((steps == (signs * sample).astype(np.float32)).all(1).any() for signs in images)
    assert not all((steps == sample).all(1).any() for sample in drawn.observations.numpy())


def test_demonstrations_in_a_frame_lead_back_to_the_same_actions(rng):
    task = make_task("orbit")
    frame = FRAMES[task.frame]
    observations = np.array([task.observe(*task.sample(rng, default_params())) for _ in range(20)], np.float32)
    actions = rng.uniform(-1, 1, (2, 20, 2)).astype(np.float32)
    flags, rewards = np.zeros(20, bool), np.zeros(20, np.float32)
    framed = Demos(observations, actions[0], rewards, observations, flags, flags, actions[1]).in_frame(frame)
    assert framed.observations.shape == framed.next_observations.shape == (20, frame.size)
    for given, turned in zip(actions, (framed.actions, framed.executed), strict=True):
        for observation, action, there in zip(observations, given, turned, strict=True):
            _, back = frame.features(tuple(observation))
            np.testing.assert_allclose(REACH * np.array(back(tuple(there))), action, atol=1e-6)


def test_last_values_of_many_episodes_at_once_are_those_that_sb3_would_add_one_by_one() -> None:
    config = replace(ppo.TUNED["stabilize"], num_envs=32, num_steps=24, batch_size=128, hidden=(16,))
    rewards = []
    for together in (True, False):
        learner = ppo.make(make_task("stabilize"), default_params(), config, seed=3)
        if not together:
            learner._env.bootstrap = None
        learner.iterate()
        rewards.append(learner._model.rollout_buffer.rewards)
    assert np.abs(rewards[0]).max() > 1.0  # a last value is many times the pay of a step
    np.testing.assert_allclose(rewards[0], rewards[1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("living", [None, lambda gamma: 1.0])
def test_a_failure_among_thousands_of_steps_moves_actor_and_critic_about_as_much_as_others_do(
    living,
) -> None:
    env = BallbotEnv(physics="rk4")
    moved = []
    for failed in (False, True):
        buffer = ppo._Rollouts(32, env.observation_space, env.action_space, n_envs=128, living=living)
        buffer.rewards[:] = np.random.default_rng(0).normal(0.0, 0.1, (32, 128))
        buffer.rewards[-1, 7] -= 1000.0 * failed
        buffer.compute_returns_and_advantage(torch.zeros(128), np.zeros(128, bool))
        moved.append([np.abs(values).max() for values in (buffer.advantages, buffer.returns - buffer.values)])
    assert all(after < 11 * before for before, after in zip(*moved, strict=True))
