"""Training episodes: what is easier in them, step by step, and what stays as it is."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballbot_gym.batch import BallbotBatch
from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_train.learning import curricula
from ballbot_train.learning.curricula import CurriculumBatch, widened
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


def of_its_own(made):
    """The batch, whose curriculum has come to the task itself."""
    made._goal_factor, made._ramp["max_speed"] = 1.0, made.own_task.max_speed
    made._set_difficulty()
    return made


def some_starts(task, count=20):
    x = torch.zeros(8, count, dtype=torch.float64)
    x[0], x[1], x[5] = -torch.rand(count) - 1, -0.5, 3.0
    c = torch.full((len(task.constant_names), count), 3.0, dtype=torch.float64)
    return curricula.Starts(x, c, torch.arange(count) % 5, 5 - torch.arange(count) % 5)


@pytest.fixture
def constants(monkeypatch):
    """Sets constants of the curriculum."""

    def set_to(**values):
        for name, value in values.items():
            monkeypatch.setattr(curricula, f"_{name}", value)

    return set_to


def run(made, steps=30):
    return [made.step(torch.zeros(made.num_envs, 2)) for _ in range(steps)]


def test_without_a_curriculum_episodes_and_rewards_are_those_of_the_batch(task):
    shorter = replace(task, duration=0.2)
    plain = BallbotBatch(shorter, 6, compile=False, params=default_params())
    plain.reset(0)
    made = CurriculumBatch(shorter, 6, default_params())
    made.reset(0)
    for ours, theirs in zip(run(made, 15), run(plain, 15), strict=True):
        assert torch.equal(ours.reward, theirs.reward)
        assert torch.equal(ours.observation, theirs.observation)
    assert made.difficulty == {}


def test_a_goal_that_is_twice_as_wide_holds_twice_as_far_out(task):
    rng = np.random.default_rng(0)
    x, c = task.sample(rng, default_params())
    wide = widened(task, 2.0)
    for own, easier in zip(task.goal(x, c), wide.goal(x, c), strict=True):
        assert easier + 1 == pytest.approx((own + 1) / 4)
    assert (wide.problem(), wide.id) == (task.problem(), task.id)
    assert widened(task, 1.0) is task


def test_a_wide_goal_is_reached_by_who_misses_the_gate_by_less_than_it():
    ends = []
    for made in (batch(), backwards()):
        x = torch.tensor([1.0, 0.5, 0, 0, 3.0, 0, 0, 0])[:, None].repeat(1, made.num_envs)
        made.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
        ends.append(bool(run(made, 1)[0].success.all()))
    assert ends == [False, True]


def test_the_goal_narrows_and_then_the_speed_rises_whenever_enough_episodes_succeed(constants):
    constants(GOAL_FACTOR=1.5, GOAL_STEP=0.8, RAMPS={"max_speed": (9.85, 0.1)}, EPISODES=4, REACH=1.0)
    made = backwards()
    made._on_optima.share = 1.0
    reached = []
    for won in (2, 3, 4, 4, 4, 4):
        flags = torch.arange(4) < won
        made._count(torch.ones(4, dtype=torch.bool), flags)
        reached.append((made.difficulty["goal_factor"], made.difficulty["max_speed"], made.task.max_speed))
    assert [factor for factor, *_ in reached] == pytest.approx([1.5, 1.2, 1.0, 1.0, 1.0, 1.0])
    assert [speed for _, speed, _ in reached] == pytest.approx([9.85, 9.85, 9.85, 9.95, 10.0, 10.0])
    assert all(speed == drawn for _, speed, drawn in reached)
    assert made.task == make_task("turn", duration=0.2)


def test_easier_speeds_are_drawn_first(constants):
    constants(RAMPS={"max_speed": (2.5, 0.1)})
    made = backwards(num_envs=200)
    assert 2.0 <= float(made.state.c.min()) < float(made.state.c.max()) <= 2.5


def test_shaping_adds_up_to_the_potential_of_the_start(constants):
    gamma = 0.9
    constants(RAMPS={})  # the same episodes are drawn
    plain, made = batch(gamma=gamma, pay=False), backwards(gamma=gamma)
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


def test_a_terminal_state_has_no_potential():
    made = backwards(gamma=1.0)
    x = torch.tensor([0.0, 0, 1.39, 0, 0, 0, 5.0, 0])[:, None].repeat(1, made.num_envs)  # about to fall
    made.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
    plain = batch(pay=False)
    plain.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
    ours, theirs = run(made, 1)[0], run(plain, 1)[0]
    assert bool(ours.failure.all())
    distance = curricula._SHAPING * made.task.goal_distance(x.unbind(0), torch.full((1, 6), 3.0).unbind(0))
    dearer = curricula._EARLY_FAILURE_PRICE - curricula.FAILURE_PRICE
    torch.testing.assert_close(ours.reward - theirs.reward, distance - dearer)


@pytest.mark.parametrize("name", ["stabilize", "turn"])
def test_without_pay_the_reward_is_minus_the_cost_and_a_failure_has_its_price(name):
    made = batch(name, pay=False)
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


def test_half_of_the_episodes_begin_on_optima_with_the_time_that_is_left():
    made = backwards(num_envs=400)
    starts = made._starts
    torch.manual_seed(0)
    made._hard = [torch.zeros(10, 0)] * 2
    for _ in range(made.task.steps):
        made._hard = [torch.zeros(10, 0)] * 2  # none are repeated
        result = made.step(torch.zeros(400, 2))
    moved = made._kind == curricula._ON_OPTIMUM
    assert 0.4 < float(moved.double().mean()) < 0.6
    known = {(*x, int(k)) for x, k in zip(starts.x.float().T.tolist(), starts.steps, strict=True)}
    own = ~moved & ~made._again
    assert {(*x, int(k)) for x, k in zip(made.state.x.T[moved].tolist(), made.state.steps[moved], strict=True)} <= known
    torch.testing.assert_close(result.observation, made.observe(made.state))
    assert torch.equal(made.state.x[:2, own], torch.tensor([[0.0], [-1.0]]).expand(2, int(own.sum())))


def test_episodes_that_begin_on_optima_do_not_make_the_task_harder(constants):
    constants(ON_OPTIMA=1.0, EPISODES=1, SUCCESS=0.0, OPTIMA_SUCCESS=0.0, RETRIES=0.0, REACH=1.0)
    made = backwards()
    made._on_optima.share = 1.0
    run(made, 10)  # the task's own starts
    reached = made.difficulty["goal_factor"]
    run(made, 30)
    assert reached < 5
    assert made.difficulty["goal_factor"] == reached


def test_episodes_on_optima_begin_ever_earlier_as_they_succeed(constants):
    constants(ON_OPTIMA=1.0, REACH=0.04, REACH_STEP=0.02, EPISODES=4)
    made = backwards(num_envs=200)
    of_four, everywhere = torch.ones(4, dtype=torch.bool), torch.ones(200, dtype=torch.bool)
    for steps_left in (2, 3, 4, 5):
        made.step(torch.zeros(200, 2))
        made._start_on_optima(everywhere)
        assert int((5 - made.state.steps).max()) == steps_left
        made._count_starts(of_four, torch.tensor([True, True, False, False]))
        assert made.difficulty["starts_seconds"] == pytest.approx(0.02 * steps_left)
        made._count_starts(of_four, torch.tensor([True, True, True, False]))
        assert made.difficulty["starts_seconds"] == pytest.approx(0.02 * (steps_left + 1))


def test_no_episode_begins_on_an_optimum_once_the_task_is_its_own(constants):
    constants(ON_OPTIMA=1.0, RETRIES=0.0)
    made = backwards(num_envs=50)
    run(made, made.task.steps)
    assert (made._kind == curricula._ON_OPTIMUM).all()
    run(of_its_own(made), made.task.steps)
    assert (made._kind == curricula._OWN).all()


def test_a_share_of_the_episodes_repeats_starts_that_went_wrong(constants):
    constants(ON_OPTIMA=0.0, RAMPS={})
    made = backwards(num_envs=400)
    torch.manual_seed(0)
    first = made.state.c.clone()
    run(made, made.task.steps)  # nobody gets to the gate in so short a time
    again = made._again
    assert 0.3 < float(again.double().mean()) < 0.5
    assert set(made.state.c[0, again].tolist()) <= set(first[0].tolist())
    assert not set(made.state.c[0, ~again].tolist()) & set(first[0].tolist())
    assert torch.equal(made.state.x[5], made.state.c[0])  # each moves with the speed of the episode that it repeats
    assert not made.state.steps.any()
    result = made.step(torch.zeros(400, 2))
    torch.testing.assert_close(result.observation, made.observe(made.state))
    run(made, 40 * made.task.steps)
    assert [hard.shape for hard in made._hard] == [(10, curricula._KEPT_STARTS), (10, 0)]


def test_optimal_starts_lie_on_optima_of_episodes_that_are_no_certified_ones():
    task = make_task("turn", duration=8.0)
    starts = curricula.optimal_starts(task, default_params(), 1, 100)
    assert torch.equal(starts.steps, torch.arange(len(starts.steps)))
    assert starts.x[:2, 0].tolist() == [0.0, -1.0]
    assert float(starts.x[5, 0]) == pytest.approx(float(starts.c[0, 0]))
    assert not task.is_goal(starts.x[:, -1].numpy(), starts.c[:, -1].numpy())


def test_optima_with_a_reserve_end_deeper_in_the_goal():
    task = make_task("turn", duration=8.0)

    def last_excess(reserve):
        starts = curricula.optimal_starts(task, default_params(), 1, 100, reserve)
        return max(float(excess) for excess in task.goal(starts.x[:, -1], starts.c[:, -1]))

    assert last_excess(0.5) < last_excess(0.0)


@pytest.mark.parametrize(
    ("share", "over", "retried"), [(0.99, True, 0.1), (0.99, False, 0.4), (0.5, True, 0.4), (1.0, True, 0.0)]
)
def test_fewer_starts_are_repeated_as_fewer_go_wrong(share, over, retried):
    made = backwards()
    assert made._retried_share == 0.4  # nothing is known yet
    made._own_episodes.share = share
    if over:
        of_its_own(made)._has_settled = True
    assert made._retried_share == pytest.approx(retried)


@pytest.mark.parametrize(("over", "price"), [(True, curricula.FAILURE_PRICE), (False, curricula._EARLY_FAILURE_PRICE)])
def test_a_failure_has_its_last_price_once_the_curriculum_is_over(over, price, constants):
    constants(SHAPING=0.0)
    made = backwards(duration=2.0)
    if over:
        of_its_own(made)._has_settled = True
    results = [made.step(torch.ones(made.num_envs, 2)) for _ in range(made.task.steps - 1)]
    fell = torch.cat([result.reward[result.failure] for result in results])
    assert len(fell) >= made.num_envs
    assert fell == pytest.approx(-price, abs=10.0)  # besides the cost of the step


def test_the_curriculum_is_over_once_enough_episodes_of_the_task_itself_succeed(constants):
    constants(EPISODES=4, SUCCESS=0.5, SETTLED_SUCCESS=0.75, RAMPS={}, GOAL_FACTOR=1.01, REACH=1.0)
    made = backwards()
    made._on_optima.share = 1.0
    all_ended = torch.ones(4, dtype=torch.bool)

    def look(successes):
        made._count(all_ended, torch.arange(4) < successes)
        return made.difficulty["goal_factor"], made.is_settled

    assert look(1) == (1.01, False)
    assert look(4) == (1.0, False)  # that was with a wider goal
    assert look(2) == (1.0, False)
    assert look(3) == (1.0, True)
    assert look(0) == (1.0, True)
    resumed = backwards()
    resumed.load_curriculum_state(made.curriculum_state())
    assert resumed.is_settled


def test_short_episodes_end_after_their_seconds_and_the_others_do_not():
    torch.manual_seed(0)
    task = replace(make_task("stabilize"), duration=2.0)
    batch = CurriculumBatch(task, 400, default_params(), short_episodes=(0.5, 0.1))
    batch.reset(seed=0)
    assert batch.state is not None
    batch.state = batch.state._replace(steps=torch.full((400,), task.steps - 1))
    actions = torch.zeros(400, 2)
    assert batch.step(actions).truncated.all()  # the next episodes begin, some of them short
    for _ in range(4):
        assert not batch.step(actions).truncated.any()
    short = batch.step(actions).truncated
    assert 0.4 < short.double().mean() < 0.6
    for _ in range(10):  # no other than short ones ends before 2 s
        assert not (batch.step(actions).truncated & ~short).any()


def test_training_backwards_goes_on_from_its_state_as_if_never_stopped(monkeypatch, constants):
    monkeypatch.setattr(curricula, "optimal_starts", lambda task, params, count, steps, reserve: some_starts(task))
    constants(EPISODES=2, SUCCESS=0.0, OPTIMA_SUCCESS=0.0, REACH=0.04)
    tiny = {"iterations": 3, "num_envs": 4, "num_steps": 24, "episode_seconds": 0.2, "batch_size": 16, "hidden": (8,)}
    settings = replace(LEARNERS["ppo"].settings("turn"), **tiny)

    def make(seed):
        return LEARNERS["ppo"].make(make_task("turn"), default_params(), settings, seed)

    whole = make(0)
    for _ in range(3):
        figures = whole.iterate()
    first, second = make(0), make(1)
    for _ in range(2):
        first.iterate()
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    second.load_state_dict(torch.load(io.BytesIO(buffer.getvalue()), weights_only=True))
    torch.manual_seed(99)
    second.iterate()
    for ours, theirs in zip(second.network.parameters(), whole.network.parameters(), strict=True):
        assert torch.equal(ours, theirs)
    assert second.difficulty == pytest.approx(whole.difficulty, nan_ok=True, rel=0, abs=0)
    assert 1 < whole.difficulty["goal_factor"] < 5
    assert figures["curriculum/goal_factor"] == whole.difficulty["goal_factor"]


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("stabilize", {"backwards": True}, "BallbotStabilize-v0 cannot be learnt backwards"),
        ("turn", {"short_episodes": (0.5, 0.6)}, "BallbotTurn-v0 pays at its goal"),
        ("weave", {"short_episodes": (1.5, 0.6)}, "short_episodes must be a share of 0 to 1"),
    ],
)
def test_what_a_task_has_not_is_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        batch(name, **settings)
