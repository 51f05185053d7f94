"""PPO and SAC, with and without demonstrations: they run, and go on from a state as if never stopped."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC

from ballbot_gym import dynamics
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.params import default_params
from ballbot_gym.tasks.symmetry import FRAMES, REACH
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.critics import CriticInputs, cost_to_go, relative_advantages, value_of_living
from ballbot_train.learning.curricula import Curriculum
from ballbot_train.learning.demonstrations import DemoConfig, Demos, load_demos, write_demos
from ballbot_train.learning.frames import demos_in_frame
from ballbot_train.learning.learners import LEARNERS, ppo, sac
from ballbot_train.learning.learners.model_free import ScopedRng, TrainingEnv
from ballbot_train.policy import load_network, save_policy, shipped_policies

IMITATING = {"clone_iterations": 2, "clone_gradient_steps": 5, "clone_batch_size": 32, "critic_warmup_iterations": 1}
TINY = {
    "ppo": ppo.PpoConfig(
        rl_iterations=3,
        num_envs=4,
        num_steps=16,
        final_gamma=0.999,
        episode_seconds=0.4,
        hidden=(16, 8),
        batch_size=32,
        demo_batch_size=32,
        update_epochs=2,
        **IMITATING,
    ),
    "sac": sac.SacConfig(
        products=True,
        final_gamma=0.999,
        learning_rate_schedule="geometric",
        rl_iterations=3,
        num_envs=4,
        num_steps=8,
        gradient_steps=2,
        episode_seconds=0.2,
        hidden=(16, 8),
        batch_size=16,
        **IMITATING,
    ),
}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    config = DemoConfig("stabilize", "lqr", episodes=4, physics="rk4")
    return write_demos(config, tmp_path_factory.mktemp("demos") / "tiny-v0", 1, lambda count: None)


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


def parameters(learner):
    return torch.cat([value.flatten() for value in learner.network.state_dict().values()])


def through_a_file(state):
    """As a checkpoint does: tensors and plain values only."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)


@pytest.mark.parametrize("demonstrated", [False, True])
def test_a_learner_goes_on_from_its_state_as_if_never_stopped(name, demonstrated, demos):
    demos = demos if demonstrated else None
    whole = make(name, demos)
    start = parameters(whole)
    run(whole)
    for stop in (0, whole.iterations // 2, whole.iterations - 1):
        first = run(make(name, demos), stop) if stop else make(name, demos)
        state = through_a_file(first.state_dict())
        second = make(name, demos, seed=1)
        second.load_state_dict(state)
        torch.manual_seed(99)  # nothing depends on what else is drawn
        np.random.seed(99)
        assert torch.equal(parameters(run(second)), parameters(whole))
    assert not torch.equal(parameters(whole), start)
    assert not torch.equal(parameters(run(make(name, demos, seed=1))), parameters(whole))


def test_the_policy_acts_as_the_actor_does(name, tmp_path):
    task, learner = make_task("stabilize"), make(name, products=True)
    run(learner, 1)
    observation = np.random.default_rng(0).normal(size=(100, 8)).astype(np.float32)
    save_policy(tmp_path / "policy", learner.network, {})
    with torch.no_grad():
        actions = load_network(tmp_path / "policy", task)(torch.as_tensor(observation))
    expected, _ = learner._model.predict(observation, deterministic=True)
    np.testing.assert_allclose(actions.numpy(), expected, atol=1e-6)  # float32


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_the_policy_is_a_running_average_of_the_actor(name):
    learner = make(name, averaged_iterations=2)
    seen, last = [], parameters(learner)
    for _ in range(3):
        learner.iterate()
        network = learner._actor.network if name == "ppo" else learner._actor
        actor = torch.cat([value.flatten() for value in network.state_dict().values()])
        seen.append(actor)
        share = max(1 / 2, 1 / len(seen))
        last = last + share * (actor - last)
        torch.testing.assert_close(parameters(learner), last)
    assert not torch.equal(last, seen[-1])


def test_the_discount_of_ppo_rises_and_takes_all_values_with_it():
    learner = make("ppo", gamma=0.99, final_gamma=0.999)
    policy, seen = learner._model.policy, observed(20)
    with torch.no_grad():
        before = policy.predict_values(seen)
        learner._raise_gamma(0.999)
        after = policy.predict_values(seen)
    task, scale = make_task("stabilize"), learner.config.reward_scale
    change = value_of_living(task, scale, 0.999) - value_of_living(task, scale, 0.99)
    torch.testing.assert_close(after, before + change)
    learner._raise_gamma(0.99)
    logged = [learner.iterate()["train/gamma"] for _ in range(3)]
    assert logged == pytest.approx([0.99, 1 - 10 ** (-2 - 1 / 3), 1 - 10 ** (-2 - 2 / 3)])
    assert learner._model.rollout_buffer.gamma == learner._env.batch.gamma == learner._model.gamma


@pytest.mark.parametrize("products", [False, True])
def test_the_discount_of_sac_rises_and_takes_all_values_with_it(products):
    learner = make("sac", gamma=0.99, final_gamma=0.999, products=products)
    seen, acted = observed(20), torch.zeros(20, 2)
    with torch.no_grad():
        before = learner._model.critic(seen, acted)
        learner._raise_gamma(0.999)
        after = learner._model.critic(seen, acted)
        highest = learner._highest()
        learner._raise_gamma(0.99)
    task, scale = make_task("stabilize"), learner.config.reward_scale
    change = value_of_living(task, scale, 0.999) - value_of_living(task, scale, 0.99)
    for ours, value in zip(after, before, strict=True):
        torch.testing.assert_close(ours, value + change)
    assert highest == pytest.approx(value_of_living(task, scale, 0.999))
    logged = [learner.iterate()["train/gamma"] for _ in range(3)]
    assert logged == pytest.approx([0.99, 1 - 10 ** (-2 - 1 / 3), 1 - 10 ** (-2 - 2 / 3)])
    assert learner._replay.gamma == learner._env.batch.gamma == learner._model.gamma


@pytest.mark.parametrize(("schedule", "second"), [("linear", 0.7), ("geometric", 0.1 ** (1 / 3))])
def test_the_learning_rate_falls_as_its_schedule_says(name, schedule, second):
    learner = make(name, learning_rate=1e-3, final_learning_rate_fraction=0.1, learning_rate_schedule=schedule)
    rates = [learner.iterate()["train/learning_rate"] for _ in range(2)]
    assert rates == pytest.approx([1e-3, 1e-3 * second], rel=1e-3)


def test_schedules_wait_until_the_task_is_its_own(name):
    settings = {"rl_iterations": 8, "gamma": 0.9, "final_gamma": 0.99, "curriculum_progress": 0.25}
    settings |= {"learning_rate": 1e-3, "final_learning_rate_fraction": 0.1, "last_learning_rate": 4e-4}
    learner = make(name, **settings, learning_rate_schedule="linear", curriculum=Curriculum(goal_factor=2.0))

    def gone(whole):  # shares of the schedule of the discount, by iteration
        figures = [whole.iterate() for _ in range(4)]
        return [-math.log10((1 - each["train/gamma"]) / 0.1) for each in figures], [
            each["train/learning_rate"] for each in figures
        ]

    shares, rates = gone(learner)
    assert shares == pytest.approx([0, 0.125, 0.25, 0.25])
    assert rates == pytest.approx([1e-3, 1e-3 * (1 - 0.9 / 8), 1e-3 * (1 - 0.9 / 4), 1e-3 * (1 - 0.9 / 4)])
    learner._env.batch._goal_factor = 1.0
    resumed = make(name, **settings, learning_rate_schedule="linear", curriculum=Curriculum(goal_factor=2.0))
    resumed.load_state_dict(learner.state_dict())
    shares, rates = gone(resumed)
    assert shares == pytest.approx([0.25, 0.4375, 0.625, 0.8125])
    assert rates == pytest.approx([4e-4 - 3e-4 * k / 4 for k in range(4)])


def test_demonstrations_have_their_own_learning_rate_to_the_end(name, demos):
    settings = {"clone_iterations": 0, "critic_warmup_iterations": 0, "learning_rate": 1e-4, "last_learning_rate": 1e-3}
    learner = make(name, demos, **settings)
    assert learner.iterate()["train/learning_rate"] == pytest.approx(1e-4)


@pytest.mark.parametrize("waits", [0.25, 1.0])
def test_schedules_do_not_wait_without_a_curriculum(name, waits):
    learner = make(name, gamma=0.9, final_gamma=0.99, curriculum_progress=waits)
    logged = [1 - learner.iterate()["train/gamma"] for _ in range(3)]
    assert logged == pytest.approx([0.1 * 10 ** (-k / 3) for k in range(3)])


def test_the_advantages_of_ppo_are_relative_to_the_cost_to_go():
    learner = make("ppo", relative_advantages=1.0)
    learner.iterate()
    buffer = learner._model.rollout_buffer
    living = value_of_living(make_task("stabilize"), learner.config.reward_scale, learner._model.gamma)
    returns, values = torch.as_tensor(buffer.returns), torch.as_tensor(buffer.values)
    torch.testing.assert_close(torch.as_tensor(buffer.advantages), relative_advantages(returns, values, living))
    assert buffer.advantages.std() == pytest.approx(1, abs=0.02)


def test_what_shaping_adds_to_values_is_no_cost_to_go():
    task = make_task("turn")
    settings = replace(TINY["ppo"], relative_advantages=1.0, pay=False, curriculum=Curriculum(shaping=10.0))
    learner = ppo.make(task, default_params(), settings, 0, None)
    learner.iterate()
    buffer = learner._model.rollout_buffer
    x, y, gamma, theta, vx, vy = (task.observation_scale[i] * buffer.observations[..., i] for i in range(6))
    away = np.sqrt(x**2 + y**2 + (0.3 * vx) ** 2 + (0.3 * vy) ** 2 + gamma**2 + theta**2)
    potentials = buffer.swap_and_flatten(buffer.potentials[..., np.newaxis])  # as SB3 does with the others
    np.testing.assert_allclose(potentials[:, 0], -10 * learner.config.reward_scale * away, rtol=1e-4)
    returns, values = torch.as_tensor(buffer.returns), torch.as_tensor(buffer.values)
    without_cost = -torch.as_tensor(potentials)  # who reaches the gate from there at once
    expected = relative_advantages(returns, values, without_cost)
    torch.testing.assert_close(torch.as_tensor(buffer.advantages).flatten(), expected.flatten())


def test_demonstrations_of_another_task_are_refused(name, demos):
    with pytest.raises(ValueError, match="not of Orbit"):
        LEARNERS[name].make(make_task("orbit"), default_params(), TINY[name], 0, demos)


def test_every_task_has_settings_of_ppo_and_sac(task, name):
    key = type(task).__name__.lower()
    settings = LEARNERS[name].settings(key)
    TrainingEnv(task, default_params(), 2, settings.episode_seconds, settings.reward_scale)


def test_with_demonstrations_it_first_imitates_and_then_teaches_its_critic_alone(name, demos):
    learner = make(name, demos)
    cloned = parameters(run(learner, TINY[name].clone_iterations))
    assert learner._model.num_timesteps == 0
    assert torch.equal(parameters(run(learner, TINY[name].critic_warmup_iterations)), cloned)
    assert learner._model.num_timesteps > 0
    assert not torch.equal(parameters(run(learner, 1)), cloned)


def test_cloning_comes_near_the_expert(name, demos):
    learner = LEARNERS[name].make(
        make_task("stabilize"), default_params(), replace(TINY[name], clone_gradient_steps=200), 0, demos
    )
    run(learner, TINY[name].clone_iterations)
    data = load_demos(demos, make_task("stabilize"))
    with torch.no_grad():
        error = learner.network(torch.as_tensor(data.observations)).numpy() - data.actions
    assert np.square(error).mean() < 0.3 * np.square(data.actions).mean()


def test_half_of_what_sac_learns_from_is_demonstrated(demos):
    learner = run(make("sac", demos))
    demonstrated = load_demos(demos, make_task("stabilize")).observations
    sample = learner._model.replay_buffer.sample(16).observations.numpy()
    shown = [(row == demonstrated).all(1).any() for row in sample]
    assert shown == [False] * 8 + [True] * 8


def test_rewards_beside_demonstrations_are_shaped_for_ppo_alone(params):
    task = make_task("turn")
    none, flags = np.zeros((1, len(task.observation_scale)), np.float32), np.ones(1, bool)
    shown = Demos(none, np.zeros((1, 2), np.float32), np.zeros(1, np.float32), none, flags, ~flags, none[:, :2])
    shaped = {"curriculum": Curriculum(shaping=10.0), "symmetry": "none"}
    assert ppo.Ppo(task, params, replace(TINY["ppo"], **shaped), 0, shown)
    with pytest.raises(ValueError, match="shaping cannot be used with sac's demonstrations"):
        sac.Sac(task, params, replace(TINY["sac"], **shaped), 0, shown)


@pytest.mark.parametrize("plain", [False, True])
def test_after_cloning_the_critic_of_ppo_may_take_larger_steps_than_its_actor(plain, demos):
    rates = {"demo_learning_rate": 1e-5, "demo_critic_learning_rate": 1e-3}
    learner = make("ppo", demos, products=not plain, symmetry="none", **rates)
    run(learner, TINY["ppo"].clone_iterations + 2)
    of_actor, of_critic = learner._optimizers[0].param_groups
    assert of_actor["lr"] <= 1e-5
    assert of_critic["lr"] == 1e-3
    assert {id(p) for p in of_actor["params"]} == {id(p) for p in learner._actor.parameters()}


def test_the_layers_of_sacs_critics_can_be_normalized():
    learner = make("sac", products=False, layer_norm=True)
    start = [value.clone() for value in learner._model.critic.parameters()]
    for critics in (learner._model.critic, learner._model.critic_target):
        for network in critics.q_networks:
            assert sum(isinstance(layer, torch.nn.LayerNorm) for layer in network) == len(TINY["sac"].hidden)
            living = value_of_living(make_task("stabilize"), learner.config.reward_scale, learner.config.gamma)
            assert float(network[-1].bias.detach()) == pytest.approx(living)
    run(learner)
    assert all(not torch.equal(*pair) for pair in zip(start, learner._model.critic.parameters(), strict=True))


def test_sac_without_pay_learns_from_demonstrations_without_pay():
    one, flag = np.ones((1, 8), np.float32), np.ones(1, bool)
    shown = Demos(one, one[:, :2], np.array([1.5], np.float32), one, ~flag, flag, one[:, :2])
    learner = sac.Sac(make_task("stabilize"), default_params(), replace(TINY["sac"], pay=False), 0, shown)
    run(learner, TINY["sac"].clone_iterations + 1)
    sample = learner._model.replay_buffer.sample(2)
    assert float(sample.rewards[1]) == pytest.approx(-0.5 * TINY["sac"].reward_scale)  # living pays 2 in a step


def test_without_pay_a_reward_is_minus_the_running_cost_and_a_failure_costs_its_price(name):
    learner = make(name, num_envs=1, pay=False, failure_price=7.0, reward_scale=0.5, episode_seconds=8.0)
    observation = torch.as_tensor(learner._env.reset())
    _, reward, done, _ = learner._env.step(np.zeros((learner._settings.num_envs, 2), np.float32))
    assert not done.any()
    assert (reward < 0).all()  # with pay, 1 less the cost
    assert (reward > -3.5).all()
    for _ in range(60):  # it falls
        _, reward, done, _ = learner._env.step(np.ones((learner._settings.num_envs, 2), np.float32))
        if done.any():
            break
    assert (reward[done] < -0.5 * 7.0).all()
    assert (reward[done] > -0.5 * (7.0 + 8.0)).all()
    with torch.no_grad():
        values = learner._model.policy.predict_values(observation) if name == "ppo" else torch.zeros(1)
    assert values.abs().max() < 1.0  # not the value of living


@pytest.mark.parametrize("name", ["turn", "stabilize"])
def test_demonstrations_without_pay_cost_what_the_episodes_did(name):
    """One episode arrives or rests, one falls, one is cut short by the next."""
    task = make_task(name)
    env = BallbotEnv(task, physics="rk4")
    network = load_network(next(iter(shipped_policies(task).values())), task)
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


def test_demonstrated_rewards_are_scaled_and_ends_by_time_are_no_ends():
    one = np.ones((1, 8), np.float32)
    action, flag = np.zeros((1, 2), np.float32), np.ones(1, bool)
    shown = Demos(one, action, np.array([-3.0], np.float32), one, ~flag, flag, action + 0.5)
    learner = sac.Sac(make_task("stabilize"), default_params(), TINY["sac"], 0, shown)
    run(learner, TINY["sac"].clone_iterations + 1)
    sample = learner._model.replay_buffer.sample(2)
    assert float(sample.rewards[1]) == pytest.approx(-3 * TINY["sac"].reward_scale)
    assert float(sample.dones[1]) == 0
    assert sample.actions[1].tolist() == [0.5, 0.5]


@pytest.mark.parametrize("frame", [None, "radial", "slalom"])
def test_a_quadratic_value_is_linear_in_what_the_critic_sees(frame):
    entries = 8 if frame is None else FRAMES[frame].size
    observation = observed(400, {None: 8, "radial": 13, "slalom": 23}[frame])
    seen = CriticInputs(observation.shape[1], products=True, frame=frame)(observation).double()
    plain = CriticInputs(observation.shape[1], products=False, frame=frame)(observation).double()
    form = torch.randn(entries, entries, dtype=torch.double)
    wanted = ((plain @ form) * plain).sum(1, keepdim=True) + plain[:, :1]
    fitted = seen @ torch.linalg.lstsq(seen, wanted, driver="gelsd").solution
    torch.testing.assert_close(fitted, wanted, rtol=1e-4, atol=1e-4)
    assert seen.shape[1] == entries + entries * (entries + 1) // 2


def test_critics_have_a_linear_path_and_start_at_the_value_of_living_for_ever(name):
    task, learner = make_task("stabilize"), make(name, products=True)
    value = value_of_living(task, TINY[name].reward_scale, TINY[name].gamma)
    assert value == pytest.approx(TINY[name].reward_scale * 100 * task.control_dt / (1 - TINY[name].gamma))
    observation, action = observed(50), torch.zeros(50, 2)
    policy = learner._model.policy
    if name == "ppo":
        values, critics = [policy.predict_values(observation)], [policy.mlp_extractor.critic]
    else:
        values, critics = policy.critic(observation, action), policy.critic.q_networks
        assert all(map(torch.equal, values, policy.critic_target(observation, action)))
    trained = {id(part) for optimizer in learner._optimizers for part in optimizer.param_groups[0]["params"]}
    for start, critic in zip(values, critics, strict=True):
        torch.testing.assert_close(start, torch.full((50, 1), value), atol=0.5, rtol=0)
        assert critic.linear.in_features == (44 if name == "ppo" else 65)
        assert trained >= {id(part) for part in critic.parameters()}


def test_the_value_of_living_is_finite_without_a_discount():
    task = make_task("stabilize")
    assert value_of_living(task, 1.0, 1.0) == pytest.approx(task.survival_pay)


def test_without_products_the_networks_are_those_of_stable_baselines3(name):
    learner = make(name, products=False)
    config, model = TINY[name], learner._model
    if name == "ppo":
        plain = PPO("MlpPolicy", learner._env, n_steps=16, batch_size=32, policy_kwargs={"net_arch": [16, 8]}, seed=0)
    else:
        kwargs = {"net_arch": [16, 8], "n_critics": config.num_critics, "activation_fn": torch.nn.SiLU}
        plain = SAC("MlpPolicy", learner._env, buffer_size=100, policy_kwargs=kwargs, seed=0)
    assert type(model.policy) is type(plain.policy)
    set_by_us = {"log_std", "actor.log_std.weight", "actor.log_std.bias"}
    set_by_us |= {f"{kind}.qf{i}.4.bias" for kind in ("critic", "critic_target") for i in range(2)}
    for key, expected in plain.policy.state_dict().items():
        assert key in set_by_us or torch.equal(model.policy.state_dict()[key], expected), key


def test_products_change_nothing_about_what_an_actor_sees(name):
    assert make(name, products=True).network.spec == make(name, products=False).network.spec


SYMMETRIES = {"stabilize": "odd", "turn": "fine_frame", "orbit": "centred", "weave": "centred"}


def test_ppo_uses_the_symmetry_of_every_task():
    assert {task: LEARNERS["ppo"].settings(task).symmetry for task in SYMMETRIES} == SYMMETRIES


@pytest.mark.parametrize(("task", "symmetry"), [*SYMMETRIES.items(), ("turn", "frame"), ("weave", "mirrors")])
def test_the_actor_of_ppo_has_the_symmetry_of_its_task(task, symmetry):
    settings = replace(TINY["ppo"], symmetry=symmetry, rl_iterations=1)
    learner = LEARNERS["ppo"].make(make_task(task), default_params(), settings, 0, None)
    start = parameters(learner)
    run(learner)
    assert not torch.equal(parameters(learner), start)
    assert learner.network.spec == spec_for(make_task(task), symmetry, (16, 8))
    observation = observed(20, learner.network.spec.observations)
    expected, _ = learner._model.predict(observation.numpy(), deterministic=True)
    with torch.no_grad():
        np.testing.assert_allclose(learner.network(observation).numpy(), expected, atol=1e-6)  # float32


def test_ppo_refuses_a_symmetry_that_the_task_has_not():
    with pytest.raises(ValueError, match="BallbotTurn-v0 has no mirror images"):
        LEARNERS["ppo"].make(make_task("turn"), default_params(), replace(TINY["ppo"], symmetry="mirrors"), 0, None)


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_forces_may_be_held_for_longer_in_training_and_living_pays_as_much(name):
    settings = replace(TINY[name], control_dt=0.05, gamma=0.9)
    learner = LEARNERS[name].make(make_task("stabilize"), default_params(), settings, 0, None)
    run(learner)
    assert learner._env.batch.task.control_dt == 0.05
    assert learner.network.spec.task == make_task("stabilize").problem()
    paid = settings.reward_scale * make_task("stabilize").survival_reward * 0.05
    assert make(name, control_dt=0.05, gamma=0.9)._model.gamma == pytest.approx(0.9**2.5)
    assert learner._value_of_living(0.9) == pytest.approx(paid / 0.1)


def test_longer_forces_are_refused_where_optima_are_shown():
    settings = replace(TINY["ppo"], control_dt=0.05, curriculum=Curriculum(starts_on_optima=0.5))
    with pytest.raises(ValueError, match="control_dt cannot be used with"):
        LEARNERS["ppo"].make(make_task("turn"), default_params(), settings, 0, None)


def assert_envs_act_as_its_policy(learner):
    """What SAC's envs do is what its policy says of what they show."""
    batch = learner._env.batch
    seen = learner._env._seen(batch.observe(batch.state).numpy())
    action, _ = learner._model.predict(seen, deterministic=True)
    learner._env.step_async(action)
    with torch.no_grad():
        expected = learner.network(batch.observe(batch.state))
    np.testing.assert_allclose(learner._env.venv._actions, expected, atol=1e-6)  # float32


@pytest.mark.parametrize("task", ["turn", "orbit", "weave"])
def test_sac_sees_and_acts_in_the_frame_of_its_task(task):
    settings = replace(TINY["sac"], symmetry=LEARNERS["sac"].settings(task).symmetry)
    learner = LEARNERS["sac"].make(make_task(task), default_params(), settings, 0, None)
    run(learner)
    assert learner.network.spec.frame == make_task(task).frame
    assert_envs_act_as_its_policy(learner)


@pytest.mark.parametrize("task", ["stabilize", "orbit", "weave"])
def test_sac_with_a_centred_actor_acts_as_its_policy_does_and_keeps_the_steady_motion(task):
    made = make_task(task)
    learner = LEARNERS["sac"].make(made, default_params(), replace(TINY["sac"], symmetry="centred"), 0, None)
    run(learner)
    assert learner.network.spec.centred
    assert_envs_act_as_its_policy(learner)
    if task == "stabilize":
        with torch.no_grad():
            assert learner.network(torch.zeros(8)).tolist() == [0.0, 0.0]


def test_targets_of_sac_can_add_up_the_rewards_of_several_steps():
    learner = run(make("sac", n_steps=3), 2)
    replay, gamma = learner._replay, learner._replay.gamma
    drawn = replay.sample(200)
    steps = replay.observations[: replay.pos]
    several = 0
    for seen, reward, discount in zip(*(part.numpy() for part in (drawn[0], drawn[4], drawn[5])), strict=True):
        begun, env = (int(found[0]) for found in np.nonzero((steps == seen).all(-1)))
        count = round(math.log(float(discount[0])) / math.log(gamma))
        summed = sum(gamma**k * float(replay.rewards[begun + k, env]) for k in range(count))
        assert float(reward[0]) == pytest.approx(summed, rel=1e-5)
        several += count == 3
    assert several > 100


def test_gradients_at_sacs_critics_are_relative_to_the_cost_to_go():
    plain, relative = make("sac"), make("sac", relative_values=1.0)
    seen, acted = torch.rand(16, 8), torch.rand(16, 2, requires_grad=True)
    gradients = [
        torch.autograd.grad(learner._model.critic(seen, acted)[0].sum(), acted)[0] for learner in (plain, relative)
    ]
    with torch.no_grad():
        lowest = torch.stack(relative._model.critic(seen, acted)).amin(0)
    assert_relative(relative, *gradients, lowest)


@pytest.mark.parametrize("plain", [False, True])
def test_gradients_at_ppos_critic_are_relative_to_the_cost_to_go(plain):
    kind = {"symmetry": "none", "products": False} if plain else {}
    gradients = []
    for learner in (make("ppo", **kind), relative := make("ppo", relative_values=1.0, **kind)):
        seen = torch.linspace(-1, 1, 128).reshape(16, 8).requires_grad_()
        values = learner._model.policy.evaluate_actions(seen, torch.zeros(16, 2))[0]
        gradients.append(torch.autograd.grad(values.sum(), seen)[0])
    assert_relative(relative, *gradients, values.detach())


def assert_relative(learner, plain, relative, values):
    """The learner's gradients (n, ...) are the plain ones divided by the cost to go that the values (n, 1) say."""
    weights = 1 / cost_to_go(values, learner._value_of_living(learner._model.gamma))
    torch.testing.assert_close(relative, plain * weights / weights.mean())
    assert float(weights.max() / weights.min()) > 1.01
    run(learner)


def test_beside_demonstrations_sac_learns_from_single_steps_of_the_task(demos):
    farther = {"n_steps": 3, "buffer_steps": 40, "control_dt": 0.05, "products": True, "relative_values": 1.0}
    learner = make("sac", demos, **farther)
    replay = learner._replay
    assert (replay.n_steps, replay.buffer_size, learner._env.batch.task.control_dt) == (1, 3 * 8, 0.02)
    assert type(learner._model.critic.q_networks[0]) is torch.nn.Sequential
    assert not learner._model.critic._forward_hooks
    assert make("sac", n_steps=3, buffer_steps=40)._replay.buffer_size == 40 // 4


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


def test_a_mirrored_sample_is_a_step_of_the_mirrored_robot():
    learner = run(make("sac", symmetry="mirrors"), 1)
    task, params = make_task("stabilize"), default_params()
    scale, substeps = np.array(task.observation_scale), dynamics.substeps_for(task.control_dt)
    drawn = learner._replay.sample(50)
    for before, action, after, done in zip(*(part.numpy() for part in drawn[:4]), strict=True):
        state = dynamics.step(params, tuple(scale * before), tuple(350.0 * action), task.control_dt, substeps)
        assert done or np.abs(np.array(state) / scale - after).max() < 1e-5


@pytest.mark.parametrize("products", [False, True])
def test_the_critics_of_sac_start_near_the_value_of_living(products):
    learner = make("sac", products=products)
    settings = learner.config
    value = settings.reward_scale * 100 * 0.02 / (1 - settings.gamma)
    with torch.no_grad():
        values = torch.cat(learner._model.critic(0.1 * observed(20), torch.zeros(20, 2)))
    assert (values - value).abs().max() < 0.3 * value


def test_demonstrations_in_a_frame_lead_back_to_the_same_actions(rng):
    task = make_task("orbit")
    frame = FRAMES[task.frame]
    observations = np.array([task.observe(*task.sample(rng, default_params())) for _ in range(20)], np.float32)
    actions = rng.uniform(-1, 1, (2, 20, 2)).astype(np.float32)
    flags, rewards = np.zeros(20, bool), np.zeros(20, np.float32)
    framed = demos_in_frame(Demos(observations, actions[0], rewards, observations, flags, flags, actions[1]), frame)
    assert framed.observations.shape == framed.next_observations.shape == (20, frame.size)
    for given, turned in zip(actions, (framed.actions, framed.executed), strict=True):
        for observation, action, there in zip(observations, given, turned, strict=True):
            _, back = frame.features(tuple(observation))
            np.testing.assert_allclose(REACH * np.array(back(tuple(there))), action, atol=1e-6)


@pytest.mark.parametrize(("task", "most"), [("stabilize", 4.0), ("turn", 16.0)])
def test_targets_of_sac_do_not_exceed_what_can_be_earned(task, most):
    settings = replace(TINY["sac"], gamma=0.99, reward_scale=0.02, products=False)
    model = LEARNERS["sac"].make(make_task(task), default_params(), settings, 0, None)._model
    for critic in (model.critic, model.critic_target):
        for network in critic.q_networks:
            torch.nn.init.constant_(network[-1].bias, 1e3)
    seen = torch.zeros(3, *model.observation_space.shape), torch.zeros(3, 2)
    with torch.no_grad():
        assert min(float(value.min()) for value in model.critic(*seen)) > 500
    for value in model.critic_target(*seen):
        torch.testing.assert_close(value, torch.full((3, 1), most))


def test_sac_in_a_frame_goes_on_from_a_state_as_if_never_stopped():
    def learner():
        settings = replace(TINY["sac"], symmetry="frame")
        return LEARNERS["sac"].make(make_task("orbit"), default_params(), settings, 0, None)

    whole, begun = run(learner()), run(learner(), 1)
    resumed = learner()
    resumed.load_state_dict(through_a_file(begun.state_dict()))
    assert torch.equal(parameters(run(resumed)), parameters(whole))


def test_training_envs_never_end_together():
    env = TrainingEnv(make_task("stabilize", max_tilt=1.5), default_params(), 5, 0.4, 0.1)
    env.seed(0)  # no robot falls with this seed
    env.reset()
    ends = [env.step(np.zeros((5, 2)))[2].sum() for _ in range(20)]
    assert max(ends) == 1
    assert sum(ends) == 5


def test_a_learners_random_numbers_are_its_own():
    own = ScopedRng()
    with own:
        first = torch.rand(3), np.random.rand(3)
    state = own.state_dict()
    with own:
        expected = torch.rand(3), np.random.rand(3)
    own.load_state_dict(state)
    torch.rand(5)
    with own:
        again = torch.rand(3), np.random.rand(3)
    assert torch.equal(again[0], expected[0])
    assert np.array_equal(again[1], expected[1])
    assert not torch.equal(first[0], expected[0])
