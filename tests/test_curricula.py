"""Training episodes: what is easier in them, step by step, and what stays as it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from resuming import goes_on_as_if_never_stopped

from ballbot_gym.env import make_task
from ballbot_gym.robot import default_params
from ballbot_gym.seeding import spawned
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_train.evaluation.fresh import make_envs
from ballbot_train.learning import curricula, model_free
from ballbot_train.learning.curricula import CurriculumBatch
from ballbot_train.learning.learners import LEARNERS


def batch(name="turn", num_envs=6, gamma=0.99, duration=0.2, **options):
    task = make_task(name, duration=duration)
    made = CurriculumBatch(task, num_envs, default_params(), gamma, make_task(name), **options)
    made.reset(0)
    return made


def backwards(starts=None, **options):
    """A batch that learns backwards, with starts that nobody has to search for."""
    made = batch(backwards=True, **options)
    made._starts = some_starts(made.task) if starts is None else starts
    return made


def some_starts(task, count=20):
    x, passed = torch.zeros(8, count, dtype=torch.float64), torch.arange(count)[None] % 5
    x[0], x[1], x[5] = -torch.rand(count) - 1, -0.5, 3.0
    c = torch.full((len(task.constant_names), count), 3.0, dtype=torch.float64)
    return torch.cat([x, c, passed, 5 - passed])


@pytest.fixture
def constants(monkeypatch):
    """Sets constants of the curriculum."""

    def set_to(**values):
        for name, value in values.items():
            monkeypatch.setattr(curricula, f"_{name}", value)

    return set_to


def run(made, steps=30):
    return [made.step(torch.zeros(made.num_envs, 2)) for _ in range(steps)]


def training_envs(task, num_envs, **options):
    return model_free._TrainingEnv(make_envs(num_envs, task, True, params=default_params()), **options)


def test_without_a_curriculum_episodes_and_rewards_are_those_of_the_task(task):
    made, plain = training_envs(task, 6, reward_scale=0.5), BallbotVectorEnv(6, task, params=default_params())
    made.seed(0)
    made.reset()
    plain.reset(seed=spawned(0))
    actions = np.zeros((6, 2), np.float32)
    for _ in range(15):
        ours, theirs = made.step(actions), plain.step(actions)
        assert np.array_equal(ours[0], theirs[0])
        assert np.array_equal(ours[1], np.float32(0.5) * theirs[1].astype(np.float32))


def test_a_goal_that_is_twice_as_wide_holds_twice_as_far_out(constants):
    constants(GOAL_FACTOR=2.0)
    task, wide = batch().task, backwards().task
    x, c = task.sample(np.random.default_rng(0), default_params())
    for own, easier in zip(task.goal(x, c), wide.goal(x, c), strict=True):
        assert easier + 1 == pytest.approx((own + 1) / 4)
    assert (replace(wide, max_speed=task.max_speed).problem(), wide.id) == (task.problem(), task.id)
    assert batch().own_task is batch().task or batch().task == task


def test_a_wide_goal_is_reached_by_who_misses_the_gate_by_less_than_it():
    ends = []
    for made in (batch(), backwards()):
        x = torch.tensor([1.0, 0.5, 0, 0, 3.0, 0, 0, 0])[:, None].repeat(1, made.num_envs)
        made.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
        ends.append(bool(run(made, 1)[0].success.all()))
    assert ends == [False, True]


def test_the_goal_narrows_and_then_the_speed_rises_whenever_enough_episodes_succeed(constants):
    constants(GOAL_FACTOR=1.5, GOAL_STEP=0.8, RAMPS={"max_speed": (9.85, 0.1)}, EPISODES=4, REACH=1.0)
    made = backwards(num_envs=4)
    made._shares = {0: 0.0, 1: 1.0}
    reached = []
    for won in (2, 3, 4, 4, 4, 4):
        flags = torch.arange(4) < won
        if made._count(0, torch.ones(4, dtype=torch.bool), flags):
            made._harden()
        reached.append((made.difficulty["goal_factor"], made.difficulty["max_speed"], made.task.max_speed))
    assert [factor for factor, *_ in reached] == pytest.approx([1.5, 1.2, 1.0, 1.0, 1.0, 1.0])
    assert [speed for _, speed, _ in reached] == pytest.approx([9.85, 9.85, 9.85, 9.95, 10.0, 10.0])
    assert all(speed == drawn for _, speed, drawn in reached)
    assert made.task == make_task("turn", duration=0.2)


def test_shaping_adds_up_to_the_potential_of_the_start(constants):
    gamma = 0.9
    constants(RAMPS={})  # the same episodes are drawn
    plain, made = batch(gamma=gamma), backwards(gamma=gamma)
    start = made.state
    steps = made.task.steps
    assert not made.is_settled
    results = run(made, steps)
    difference = [a.reward - b.reward for a, b in zip(results, run(plain, steps), strict=True)]
    total = sum(gamma**k * part for k, part in enumerate(difference))
    distance = made.task.goal_distance(start.x.unbind(0), start.c.unbind(0))
    assert bool(results[-1].truncated.all())
    rest = made.task.goal_distance(results[-1].final_x.unbind(0), start.c.unbind(0))
    torch.testing.assert_close(total, curricula._SHAPING * (distance - gamma**steps * rest), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("name", ["stabilize", "turn"])
def test_without_pay_the_reward_is_minus_the_cost_and_a_failure_has_its_price(name):
    made = batch(name)
    plain = batch(name)
    for ours, theirs in zip(run(made), run(plain), strict=True):
        running = theirs.cost.clone()
        running[theirs.failure] = 0.0
        on = ~theirs.failure
        torch.testing.assert_close(ours.reward[on], -running[on], atol=1e-4, rtol=1e-4)
    x = torch.tensor([0.0, 0, 1.39, 0, 0, 0, 5.0, 0])[:, None].repeat(1, made.num_envs)
    c = torch.full((len(made.task.constant_names), made.num_envs), 3.0)
    made.reset(x=x, c=c)
    assert run(made, 1)[0].reward.max() < 1 - curricula.FAILURE_PRICE


def test_optimal_starts_lie_on_optima_of_episodes_that_are_no_certified_ones(constants):
    constants(OPTIMA=1, REACH=8.0)
    made, task = batch(backwards=True), make_task("turn", duration=8.0)
    run(made, 11)
    starts = made._starts
    assert starts[-2].tolist() == list(range(starts.shape[1]))
    assert starts[:2, 0].tolist() == [0.0, -1.0]
    assert float(starts[5, 0]) == pytest.approx(float(starts[8, 0]))
    assert not task.is_goal(starts[:8, -1].numpy(), starts[8:-2, -1].numpy())


def test_short_episodes_end_after_their_seconds_and_the_others_do_not():
    np.random.seed(0)
    task = replace(make_task("stabilize"), duration=2.0)
    envs = training_envs(task, 400, reward_scale=1.0, short_episodes=(0.5, 0.1))
    envs.reset()
    envs._set_steps(np.full(400, task.steps - 1))
    actions = np.zeros((400, 2), np.float32)
    assert envs.step(actions)[2].all()  # the next episodes begin, some of them short
    for _ in range(4):
        assert not envs.step(actions)[2].any()
    short = envs.step(actions)[2]
    assert 0.4 < short.mean() < 0.6
    for _ in range(10):  # no other than short ones ends before 2 s
        *_, done, infos = envs.step(actions)
        assert not any(infos[i]["TimeLimit.truncated"] for i in np.flatnonzero(done & ~short))


def test_training_backwards_goes_on_from_its_state_as_if_never_stopped(monkeypatch, constants):
    monkeypatch.setattr(curricula, "_optimal_starts", lambda task, params, count, steps: some_starts(task))
    constants(EPISODES=2, SUCCESS=0.0, OPTIMA_SUCCESS=0.0, REACH=0.04)
    tiny = {"iterations": 3, "num_envs": 4, "num_steps": 24, "episode_seconds": 0.2, "batch_size": 16, "hidden": (8,)}
    settings = replace(LEARNERS["ppo"].settings("turn"), **tiny)

    assert goes_on_as_if_never_stopped(
        lambda seed: LEARNERS["ppo"].make(make_task("turn"), default_params(), settings, seed)
    )


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        (
            "stabilize",
            {"backwards": True, "relative_advantages": False},
            "BallbotStabilize-v0 cannot be learned backwards",
        ),
        ("turn", {"short_episodes": (0.5, 0.6)}, "BallbotTurn-v0 pays at its goal"),
        ("weave", {"short_episodes": (1.5, 0.6)}, "short_episodes must be a share of 0 to 1"),
    ],
)
def test_what_a_task_has_not_is_refused(name, settings, message):
    wanted = replace(LEARNERS["ppo"].settings(name), num_envs=4, **settings)
    with pytest.raises(ValueError, match=message):
        LEARNERS["ppo"].make(make_task(name), default_params(), wanted, 0)
