"""PPO by rsl_rl: it goes on from a state as if never stopped, sees what it should, and refuses what a task has not."""

import io
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_train.learning.learners import LEARNERS, rsl_ppo

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


def test_the_critic_alone_fits_a_quadratic_form_with_its_linear_path():
    observation = torch.randn(200, 8)
    seen = TensorDict({"policy": observation}, batch_size=[200])
    critic = rsl_ppo.Critic(seen, (8,), None, products=True, value=4.0)
    torch.testing.assert_close(critic(seen), torch.full((200, 1), 4.0), atol=0.5, rtol=0)
    inputs = critic.get_latent(seen)
    form = torch.randn(8, 8)
    wanted = ((observation @ form) * observation).sum(1)
    solved = torch.linalg.lstsq(inputs, wanted[:, None]).solution
    torch.testing.assert_close((inputs @ solved)[:, 0], wanted, rtol=1e-3, atol=1e-3)
    assert inputs.shape[1] == 8 + 36


def test_the_deviation_and_the_step_size_fall_as_they_are_set():
    learner = make(std=0.2, final_std=0.05, learning_rate=1e-3, final_learning_rate=1e-4)
    logged = [learner.iterate() for _ in range(3)]
    assert [log["train/std"] for log in logged] == pytest.approx([0.2, 0.1, 0.05])
    assert [log["train/learning_rate"] for log in logged] == pytest.approx([1e-3, 10**-3.5, 1e-4])


@pytest.mark.parametrize(
    ("name", "symmetry"), [("turn", "mirrors"), ("turn", "odd"), ("weave", "odd"), ("weave", "frame")]
)
def test_a_symmetry_that_the_task_has_not_is_refused(name, symmetry):
    with pytest.raises(ValueError, match=r"Ballbot\w+-v0 (is not|has no)"):
        make(name, symmetry=symmetry)
