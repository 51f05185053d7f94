"""PPO by rsl_rl: it goes on from a state as if never stopped, sees what it should, and refuses what a task has not."""

import copy
import io
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.critics import CriticInputs, relative_advantages, value_of_living
from ballbot_train.learning.learners import LEARNERS, rsl_ppo
from ballbot_train.policy import PolicyNetwork

TINY = {
    "total_iterations": 3,
    "num_envs": 8,
    "num_steps": 6,
    "episode_seconds": 0.2,
    "hidden": (8,),
    "critic_hidden": (8,),
    "update_epochs": 2,
    "num_mini_batches": 2,
}


def make(name="stabilize", seed=0, **settings):
    config = replace(LEARNERS["rsl_ppo"].settings(name), **(TINY | settings))
    return LEARNERS["rsl_ppo"].make(make_task(name), default_params(), config, seed, None)


def run(learner, iterations):
    for _ in range(iterations):
        learner.iterate()
    return learner


def weights(learner):
    parts = (learner.network, learner._actor, learner._ppo.critic)
    return torch.cat([value.flatten() for part in parts for value in part.state_dict().values()])


def through_a_file(state):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)


def test_it_goes_on_from_its_state_as_if_never_stopped(task):
    name = type(task).__name__.lower()
    whole = run(make(name), 3)
    for stop in (0, 1, 2):
        second = make(name, seed=1)
        second.load_state_dict(through_a_file(run(make(name), stop).state_dict()))
        torch.manual_seed(99)  # nothing depends on what else is drawn
        assert torch.equal(weights(run(second, 3 - stop)), weights(whole))
    assert not torch.equal(weights(run(make(name, seed=1), 3)), weights(whole))


@pytest.mark.parametrize("linear", [False, True])
def test_from_a_policy_the_critic_is_trained_first_and_the_policy_keeps_its_shape(linear):
    torch.manual_seed(4)
    given = PolicyNetwork(spec_for(make_task("turn"), "frame", (5, 6), linear))

    def started(seed=0):
        learner = make("turn", seed, critic_warmup_iterations=2, total_iterations=4)
        learner.start_from(given)
        return learner

    def same(one, other):
        return all(
            torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True)
        )

    learner = started()
    critics = [copy.deepcopy(learner._critic)]
    for _ in range(2):
        learner.iterate()
        critics.append(copy.deepcopy(learner._critic))
        assert same(learner.network, given)
    assert not same(critics[0], critics[1])
    assert not same(critics[1], critics[2])
    run(learner, 2)
    assert not same(learner.network, given)
    assert learner.network.spec == given.spec
    second = started(seed=1)
    second.load_state_dict(through_a_file(run(started(), 3).state_dict()))
    assert torch.equal(weights(run(second, 1)), weights(learner))


def test_from_a_policy_the_critic_may_take_larger_steps_than_the_actor():
    learner = make(finetune_learning_rate=1e-5, final_learning_rate=1e-5, finetune_critic_learning_rate=1e-3)
    assert [group["lr"] for group in run(learner, 1)._ppo.optimizer.param_groups] == [2e-3, 2e-3]  # it starts afresh
    learner.start_from(learner.network)
    run(learner, 1)
    of_actor, of_critic = learner._ppo.optimizer.param_groups
    assert of_actor["lr"] == pytest.approx(1e-5)
    assert of_critic["lr"] == 1e-3
    owned = {id(parameter) for parameter in learner._ppo.critic.parameters()}
    assert {id(parameter) for parameter in of_critic["params"]} == owned


def test_the_mean_action_of_a_squashed_policy_is_squashed():
    torch.manual_seed(5)
    network = PolicyNetwork(spec_for(make_task("turn"), "none", (5,), linear=True))
    learner = make("turn")
    learner.start_from(network)
    observation = 9 * torch.randn(50, 9)
    seen = TensorDict({"policy": observation, "critic": observation}, batch_size=[50])
    torch.testing.assert_close(learner._actor(seen), network(observation))


def test_the_critic_alone_fits_a_quadratic_form_with_its_linear_path():
    observation = torch.randn(200, 8)
    inputs = CriticInputs(8)(observation)
    seen = TensorDict({"policy": observation, "critic": inputs}, batch_size=[200])
    critic = rsl_ppo.Critic(seen, (8,), value=4.0)
    torch.testing.assert_close(critic(seen), torch.full((200, 1), 4.0), atol=0.5, rtol=0)
    form = torch.randn(8, 8)
    wanted = ((observation @ form) * observation).sum(1)
    solved = torch.linalg.lstsq(inputs, wanted[:, None]).solution
    torch.testing.assert_close((inputs @ solved)[:, 0], wanted, rtol=1e-3, atol=1e-3)
    assert inputs.shape[1] == 8 + 36


def test_a_relative_advantage_is_that_of_the_logarithm_of_the_cost_to_go():
    cost = torch.tensor([100.0, 10.0, 1.0, 0.1]).reshape(4, 1, 1)
    saved = torch.tensor([10.0, 1.0, 0.1, 0.01]).reshape(4, 1, 1)  # a tenth each
    values = 500 - cost
    advantages = relative_advantages(values + saved, values, 500.0).flatten()
    assert advantages.mean().abs() < 1e-6
    assert advantages.std() == pytest.approx(1.0)
    torch.testing.assert_close(advantages[:3], advantages[0].expand(3), rtol=0, atol=1e-2)
    assert advantages[3] < advantages[0] - 1  # below 2 % of the mean cost it counts less


def test_every_pass_sees_every_sample_once_in_the_same_mini_batches():
    storage = rsl_ppo.Storage("rl", 5, 4, TensorDict({"policy": torch.zeros(5, 1)}, batch_size=[5]), (1,))
    storage.observations["policy"][:] = torch.arange(20.0).reshape(4, 5, 1)
    storage.returns[:] = storage.observations["policy"] + 100
    storage.distribution_params = (storage.observations["policy"] + 200,)
    batches = [
        (batch.observations["policy"], batch.returns, batch.old_distribution_params[0])
        for batch in storage.mini_batch_generator(2, 3)
    ]
    assert len(batches) == 6
    for seen, returns, parameters in batches:
        assert torch.equal(returns, seen + 100)
        assert torch.equal(parameters, seen + 200)
    for first, second in (batches[:2], batches[2:4], batches[4:]):
        assert torch.equal(torch.cat([first[0], second[0]]).sort(0).values[:, 0], torch.arange(20.0))
    assert torch.equal(batches[0][0], batches[2][0])


def test_the_deviation_and_the_step_size_fall_as_they_are_set():
    learner = make(std=0.2, final_std=0.05, learning_rate=1e-3, final_learning_rate=1e-4)
    logged = [learner.iterate() for _ in range(3)]
    assert [log["train/std"] for log in logged] == pytest.approx([0.2, 0.1, 0.05])
    assert [log["train/learning_rate"] for log in logged] == pytest.approx([1e-3, 10**-3.5, 1e-4])


def test_the_discount_rises_and_takes_all_values_with_it():
    learner = make(gamma=0.99, final_gamma=0.999)
    seen = learner._env.get_observations()
    living = []  # what the critic says beyond the value of living for ever
    for gamma in (0.99, 0.995, 0.999):
        learner._set_gamma(gamma)
        with torch.no_grad():
            value = learner._critic(seen)
        living.append(value - value_of_living(learner._task, learner.config.reward_scale, gamma))
    torch.testing.assert_close(living[1], living[0], atol=1e-4, rtol=0)
    torch.testing.assert_close(living[2], living[0], atol=1e-4, rtol=0)
    learner._set_gamma(0.99)
    logged = [learner.iterate()["train/gamma"] for _ in range(3)]
    assert logged == pytest.approx([0.99, 1 - 10**-2.5, 0.999])


@pytest.mark.parametrize("setting", ["gamma", "final_gamma"])
def test_a_discount_that_is_no_discount_is_refused(setting):
    with pytest.raises(ValueError, match=f"^{setting} must be between 0 and 1, not 1"):
        make(**{setting: 1.0})


@pytest.mark.parametrize(
    ("name", "symmetry"),
    [
        ("turn", "mirrors"),
        ("turn", "odd"),
        ("weave", "odd"),
        ("stabilize", "frame"),
        ("orbit", "fine_frame"),
        ("turn", "centred"),
    ],
)
def test_a_symmetry_that_the_task_has_not_is_refused(name, symmetry):
    with pytest.raises(ValueError, match=r"Ballbot\w+-v0 (is not|has no)"):
        make(name, symmetry=symmetry)
