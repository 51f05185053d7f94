"""Curricula: what training makes easier, step by step, and what they leave as it is."""

import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from ballbot_gym.batch import BallbotBatch
from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_train.learning import curricula
from ballbot_train.learning.curricula import Curriculum, CurriculumBatch, widened
from ballbot_train.learning.learners import LEARNERS

TINY = {
    "rsl_ppo": {
        "total_iterations": 3,
        "num_envs": 8,
        "num_steps": 6,
        "episode_seconds": 0.2,
        "critic_hidden": (8,),
        "update_epochs": 1,
        "num_mini_batches": 2,
    },
    "ppo": {
        "rl_iterations": 3,
        "num_envs": 4,
        "num_steps": 12,
        "episode_seconds": 0.2,
        "batch_size": 16,
        "update_epochs": 1,
    },
    "sac": {"rl_iterations": 3, "num_envs": 4, "num_steps": 12, "episode_seconds": 0.2, "gradient_steps": 1},
}


def batch(name="turn", curriculum=Curriculum(), num_envs=6, gamma=0.99, duration=0.2, **options):
    task = make_task(name, duration=duration)
    made = CurriculumBatch(task, num_envs, default_params(), curriculum, gamma, full=make_task(name), **options)
    made.reset(0)
    return made


def given(made, starts):
    """The batch with starts that nobody has to search for."""
    made._starts = starts
    return made


def some_starts(task, count=20):
    x = torch.zeros(8, count, dtype=torch.float64)
    x[0], x[1], x[5] = -torch.rand(count) - 1, -0.5, 3.0
    c = torch.full((len(task.constant_names), count), 3.0, dtype=torch.float64)
    return curricula.Starts(x, c, torch.arange(count) % 5, 5 - torch.arange(count) % 5)


def run(made, steps=30):
    return [made.step(torch.zeros(made.num_envs, 2)) for _ in range(steps)]


def test_without_a_curriculum_episodes_and_rewards_are_those_of_the_batch(task):
    shorter = replace(task, duration=0.2)
    plain = BallbotBatch(shorter, 6, compile=False, params=default_params())
    plain.reset(0)
    made = CurriculumBatch(shorter, 6, default_params(), Curriculum(), 0.99)
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
    settings = Curriculum(goal_factor=4.0, episodes=10**6)
    ends = []
    for made in (batch(), batch(curriculum=settings)):
        x = torch.tensor([1.0, 0.5, 0, 0, 3.0, 0, 0, 0])[:, None].repeat(1, made.num_envs)
        made.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
        ends.append(bool(run(made, 1)[0].success.all()))
    assert ends == [False, True]


def test_the_goal_narrows_and_then_the_speed_rises_whenever_enough_episodes_succeed():
    settings = Curriculum(goal_factor=1.5, goal_step=0.8, ramp="max_speed", ramp_start=9.85, episodes=4, success=0.75)
    made = batch(curriculum=settings)
    reached = []
    for won in (2, 3, 4, 4, 4, 4):
        flags = torch.arange(4) < won
        made._count(torch.ones(4, dtype=torch.bool), flags)
        reached.append((made.difficulty["goal_factor"], made.difficulty["max_speed"], made.task.max_speed))
    assert [factor for factor, *_ in reached] == pytest.approx([1.5, 1.2, 1.0, 1.0, 1.0, 1.0])
    assert [speed for _, speed, _ in reached] == pytest.approx([9.85, 9.85, 9.85, 9.95, 10.0, 10.0])
    assert all(speed == drawn for _, speed, drawn in reached)
    assert made.task == make_task("turn", duration=0.2)


def test_easier_speeds_are_drawn_first():
    made = batch(curriculum=Curriculum(ramp="max_speed", ramp_start=2.5), num_envs=200)
    assert 2.0 <= float(made.state.c.min()) < float(made.state.c.max()) <= 2.5


def test_shaping_adds_up_to_the_potential_of_the_start():
    gamma, weight = 0.9, 10.0
    plain, made = batch(gamma=gamma), batch(curriculum=Curriculum(shaping=weight), gamma=gamma)
    start = made.state
    steps = made.task.steps
    difference = [a.reward - b.reward for a, b in zip(run(made, steps), run(plain, steps), strict=True)]
    end = run(plain, 0)
    total = sum(gamma**k * part for k, part in enumerate(difference))
    distance = made.task.goal_distance(start.x.unbind(0), start.c.unbind(0))
    last = batch(gamma=gamma)
    final = [*end, *run(last, steps)][-1]
    assert bool(final.truncated.all())
    rest = made.task.goal_distance(final.final_x.unbind(0), start.c.unbind(0))
    torch.testing.assert_close(total, weight * (distance - gamma**steps * rest), rtol=1e-4, atol=1e-3)


def test_a_terminal_state_has_no_potential():
    made = batch(curriculum=Curriculum(shaping=1.0), gamma=1.0)
    x = torch.tensor([0.0, 0, 1.39, 0, 0, 0, 5.0, 0])[:, None].repeat(1, made.num_envs)  # about to fall
    made.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
    plain = batch()
    plain.reset(x=x, c=torch.full((1, made.num_envs), 3.0))
    ours, theirs = run(made, 1)[0], run(plain, 1)[0]
    assert bool(ours.failure.all())
    distance = made.task.goal_distance(x.unbind(0), torch.full((1, 6), 3.0).unbind(0))
    torch.testing.assert_close(ours.reward - theirs.reward, distance)


@pytest.mark.parametrize("name", ["stabilize", "turn"])
def test_without_pay_the_reward_is_minus_the_cost_and_a_failure_has_its_price(name):
    made = batch(name, pay=False, failure_price=300.0)
    plain = batch(name)
    for ours, theirs in zip(run(made), run(plain), strict=True):
        running = theirs.cost.clone()
        running[theirs.failure] = 0.0
        on = ~theirs.failure
        torch.testing.assert_close(ours.reward[on], -running[on], atol=1e-4, rtol=1e-4)
    x = torch.tensor([0.0, 0, 1.39, 0, 0, 0, 5.0, 0])[:, None].repeat(1, made.num_envs)
    c = torch.full((len(made.task.constant_names), made.num_envs), 3.0)
    made.reset(x=x, c=c)
    assert run(made, 1)[0].reward.max() < -299


def test_without_an_arena_driving_away_does_not_fail():
    task = curricula.without_arena(make_task("stabilize"))
    x = np.array([500.0, 0, 0, 0, 0, 0, 0, 0])
    assert make_task("stabilize").violated(x, np.zeros(0)) == "arena"
    assert task.violated(x, np.zeros(0)) == ""
    assert task.problem() == make_task("stabilize").problem()


def test_a_share_of_the_episodes_begins_on_optima_with_the_time_that_is_left():
    made = batch(curriculum=Curriculum(starts_on_optima=0.5), num_envs=400)
    given(made, starts := some_starts(made.task))
    torch.manual_seed(0)
    for _ in range(made.task.steps):
        result = made.step(torch.zeros(400, 2))
    moved = made._kind == curricula._ON_OPTIMUM
    assert 0.4 < float(moved.double().mean()) < 0.6
    known = {(*x, int(k)) for x, k in zip(starts.x.float().T.tolist(), starts.steps, strict=True)}
    assert {(*x, int(k)) for x, k in zip(made.state.x.T[moved].tolist(), made.state.steps[moved], strict=True)} <= known
    torch.testing.assert_close(result.observation, made.observe(made.state))
    own = made.state.x[:, ~moved]
    assert torch.equal(own[:2], torch.tensor([[0.0], [-1.0]]).expand(2, own.shape[1]))


def test_episodes_that_begin_on_optima_do_not_make_the_task_harder():
    made = batch(curriculum=Curriculum(starts_on_optima=1.0, goal_factor=2.0, episodes=1, success=0.0))
    given(made, some_starts(made.task))
    run(made, 10)  # the task's own starts
    reached = made.difficulty["goal_factor"]
    run(made, 30)
    assert reached < 2
    assert made.difficulty["goal_factor"] == reached


def test_episodes_on_optima_begin_ever_earlier_as_they_succeed():
    settings = Curriculum(starts_on_optima=1.0, starts_seconds=0.04, starts_step=0.02, episodes=4, success=0.75)
    made = batch(curriculum=settings, num_envs=200)
    given(made, some_starts(made.task))
    of_four, everywhere = torch.ones(4, dtype=torch.bool), torch.ones(200, dtype=torch.bool)
    for steps_left in (2, 3, 4, 5):
        made.step(torch.zeros(200, 2))
        made._start_on_optima(everywhere)
        assert int((5 - made.state.steps).max()) == steps_left
        made._count_starts(of_four, torch.tensor([True, True, False, False]))
        assert made.difficulty["starts_seconds"] == pytest.approx(0.02 * steps_left)
        made._count_starts(of_four, torch.tensor([True, True, True, False]))
        assert made.difficulty["starts_seconds"] == pytest.approx(0.02 * (steps_left + 1))


@pytest.mark.parametrize(("easier", "kind"), [({}, curricula._OWN), ({"ramp": "max_speed"}, curricula._ON_OPTIMUM)])
def test_no_episode_begins_on_an_optimum_when_the_goal_has_narrowed_enough_and_all_are_drawn(easier, kind):
    settings = Curriculum(starts_on_optima=1.0, goal_factor=2.0, goal_step=0.7, starts_goal_factor=1.5)
    made = batch(curriculum=replace(settings, ramp_start=4.0, **easier), num_envs=50)
    given(made, some_starts(made.task))
    run(made, made.task.steps)
    assert (made._kind == curricula._ON_OPTIMUM).all()
    made._harden()
    run(made, made.task.steps)
    assert made.difficulty["goal_factor"] == pytest.approx(1.4)
    assert (made._kind == kind).all()


def test_a_share_of_the_episodes_repeats_starts_that_went_wrong():
    made = batch(curriculum=Curriculum(retries=0.5, goal_factor=2.0, episodes=1, success=0.0), num_envs=400)
    torch.manual_seed(0)
    first = made.state.c.clone()
    run(made, made.task.steps)  # nobody gets to the gate in so short a time
    again = made._again
    assert 0.4 < float(again.double().mean()) < 0.6
    assert set(made.state.c[0, again].tolist()) <= set(first[0].tolist())
    assert not set(made.state.c[0, ~again].tolist()) & set(first[0].tolist())
    assert torch.equal(made.state.x[5], made.state.c[0])  # each moves with the speed of the episode that it repeats
    assert not made.state.steps.any()
    result = made.step(torch.zeros(400, 2))
    torch.testing.assert_close(result.observation, made.observe(made.state))
    run(made, 40 * made.task.steps)
    assert [hard.shape for hard in made._hard] == [(10, curricula._KEPT_STARTS), (10, 0)]


def test_episodes_on_optima_that_went_wrong_are_repeated_as_such():
    made = batch(curriculum=Curriculum(retries=1.0, starts_on_optima=1.0), num_envs=50)
    given(made, starts := some_starts(made.task))
    torch.manual_seed(0)
    run(made, 2 * made.task.steps)
    assert made._again.all()
    assert (made._kind == curricula._ON_OPTIMUM).all()
    known = {(*x, int(k)) for x, k in zip(starts.x.float().T.tolist(), starts.steps, strict=True)}
    assert {(*x, int(k)) for x, k in zip(made._begun[:8].T.tolist(), made._begun[-1], strict=True)} <= known
    counts = made._on_optima.state()
    run(made, made.task.steps)
    assert counts == pytest.approx(made._on_optima.state(), nan_ok=True)


def test_only_failures_are_repeated_where_an_episode_that_runs_out_of_time_may_be_a_good_one():
    made = batch("stabilize", Curriculum(retries=1.0), num_envs=50)
    run(made, made.task.steps)
    assert not made._again.any()
    assert made._hard[0].shape[1] == 0
    made = batch("stabilize", Curriculum(retries=1.0), num_envs=50, duration=2.0)
    run(made, made.task.steps - 1)
    assert made._again.sum() > 10  # without any force the robot falls


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
    ("share", "seconds", "narrows"),
    [(0.5, 0.0, False), (0.7, 0.0, True), (float("nan"), 0.0, False), (0.7, 0.1, True), (0.7, 0.08, False)],
)
def test_the_goal_narrows_only_where_enough_episodes_on_optima_succeed_too_and_begin_anywhere(share, seconds, narrows):
    easier = Curriculum(goal_factor=2.0, starts_on_optima=0.5, starts_success=0.6, episodes=1, success=0.0)
    made = given(batch(curriculum=replace(easier, starts_seconds=seconds)), some_starts(make_task("turn")))
    made._on_optima.share = share
    made._count(torch.ones(6, dtype=torch.bool), torch.ones(6, dtype=torch.bool))
    assert (made.difficulty["goal_factor"] < 2) == narrows


def test_starts_on_optima_longer_than_an_episode_are_anywhere_where_an_episode_may_begin():
    easier = Curriculum(goal_factor=2.0, starts_on_optima=0.5, starts_success=0.6, starts_seconds=0.06)
    made = given(batch(curriculum=easier, duration=0.06), some_starts(make_task("turn")))
    made._on_optima.share = 1.0
    assert made._longest > made.task.duration
    assert made._optima_succeed


def test_what_is_drawn_widens_whatever_starts_on_optima_achieve():
    easier = Curriculum(ramp="max_speed", ramp_start=4.0, ramp_step=1.0, starts_on_optima=0.5, starts_success=0.6)
    made = given(batch(curriculum=replace(easier, episodes=1, success=0.0)), some_starts(make_task("turn")))
    made._on_optima.share = 0.5
    made._count(torch.ones(6, dtype=torch.bool), torch.ones(6, dtype=torch.bool))
    assert made.difficulty["max_speed"] == 5.0


@pytest.mark.parametrize(
    ("most", "share", "factor", "retried"),
    [(0.0, 0.9, 1.0, 0.4), (2.0, 0.9, 1.0, 0.2), (2.0, 0.9, 2.0, 0.4), (2.0, 0.5, 1.0, 0.4), (2.0, 1.0, 1.0, 0.0)],
)
def test_fewer_starts_are_repeated_as_fewer_go_wrong(most, share, factor, retried):
    made = batch(curriculum=Curriculum(retries=0.4, retries_per_failure=most, goal_factor=factor))
    assert made._retried_share == 0.4  # nothing is known yet
    made._own_episodes.share = share
    assert made._retried_share == pytest.approx(retried)


@pytest.mark.parametrize(
    ("easier", "price"), [({}, 40.0), ({"goal_factor": 2.0}, 300.0), ({"ramp": "max_speed"}, 300.0)]
)
def test_a_failure_has_its_last_price_once_the_task_is_its_own(easier, price):
    easier = Curriculum(last_failure_price=40.0, ramp_start=3.0, **easier)
    made = batch(curriculum=easier, duration=2.0, pay=False, failure_price=300.0)
    results = [made.step(torch.ones(made.num_envs, 2)) for _ in range(made.task.steps - 1)]
    fell = torch.cat([result.reward[result.failure] for result in results])
    assert len(fell) >= made.num_envs
    assert fell == pytest.approx(-price, abs=10.0)  # besides the cost of the step


def test_the_curriculum_is_over_once_enough_episodes_of_the_task_itself_succeed():
    made = batch(curriculum=Curriculum(goal_factor=1.01, success=0.5, settled_success=0.75, episodes=4))
    all_ended = torch.ones(made.num_envs, dtype=torch.bool)[:4]

    def look(successes):
        made._count(all_ended, torch.arange(4) < successes)
        return made.difficulty["goal_factor"], made.is_settled

    assert look(1) == (1.01, False)
    assert look(4) == (1.0, False)  # that was with a wider goal
    assert look(2) == (1.0, False)
    assert look(3) == (1.0, True)
    assert look(0) == (1.0, True)
    resumed = batch(curriculum=made.curriculum)
    resumed.load_curriculum_state(made.curriculum_state())
    assert resumed.is_settled


def test_short_episodes_end_after_their_seconds_and_the_others_do_not():
    torch.manual_seed(0)
    task = replace(make_task("stabilize"), duration=2.0)
    curriculum = Curriculum(short_episodes=0.5, short_seconds=0.1)
    batch = CurriculumBatch(task, 400, default_params(), curriculum, gamma=0.99)
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


def test_a_task_that_ends_at_its_goal_has_no_short_episodes():
    with pytest.raises(ValueError, match="pays at its goal"):
        Curriculum(short_episodes=0.5).check(make_task("turn"))


@pytest.mark.parametrize("name", ["rsl_ppo", "ppo", "sac"])
def test_a_learner_with_a_curriculum_goes_on_from_its_state_as_if_never_stopped(name, monkeypatch):
    monkeypatch.setattr(curricula, "optimal_starts", lambda task, params, count, steps, reserve: some_starts(task))
    easier = Curriculum(
        goal_factor=3.0, ramp="max_speed", ramp_start=3.0, starts_on_optima=0.5, shaping=1.0, episodes=2, success=0.0
    )
    easier = replace(easier, starts_seconds=0.04, retries=0.5)
    settings = replace(LEARNERS[name].settings("turn"), hidden=(8,), curriculum=easier, **TINY[name])

    def make(seed):
        return LEARNERS[name].make(make_task("turn"), default_params(), settings, seed, None)

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
    assert 1 < whole.difficulty["goal_factor"] < 3
    assert figures["curriculum/goal_factor"] == whole.difficulty["goal_factor"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"goal_factor": 0.5}, "curriculum.goal_factor must be 1 to 1000, not 0.5"),
        ({"success": float("nan")}, "curriculum.success must be 0 to 1, not nan"),
        ({"retries": 2.0}, "curriculum.retries must be 0 to 1, not 2.0"),
        ({"starts_on_optima": 2.0}, "curriculum.starts_on_optima must be 0 to 1, not 2.0"),
    ],
)
def test_a_setting_out_of_its_range_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Curriculum(**settings)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("stabilize", {"shaping": 1.0}, "BallbotStabilize-v0 has no goal_distance"),
        (
            "stabilize",
            {"ramp": "max_speed"},
            "BallbotStabilize-v0 has no field 'max_speed' for curriculum.ramp; it has",
        ),
        ("turn", {"ramp": "max_speed", "ramp_start": 1.0}, "curriculum.ramp_start 1 is out of range"),
        ("turn", {"starts_seconds": 0.5}, "curriculum.starts_seconds needs curriculum.starts_on_optima above 0"),
        ("turn", {"starts_success": 0.5}, "curriculum.starts_success needs curriculum.starts_on_optima above 0"),
        ("turn", {"starts_reserve": 0.5}, "curriculum.starts_reserve needs curriculum.starts_on_optima above 0"),
        ("turn", {"retries_per_failure": 2.0}, "curriculum.retries_per_failure needs curriculum.retries above 0"),
        ("weave", {"starts_seconds": 0.5, "starts_on_optima": 0.5}, "BallbotWeave-v0 does not end at its goal"),
        (
            "turn",
            {"starts_on_optima": 0.5, "goal_factor": 2.0, "starts_goal_factor": 2.0},
            "starts_goal_factor must be less than curriculum.goal_factor 2, not 2",
        ),
    ],
)
def test_what_a_task_has_not_is_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        batch(name, Curriculum(**settings))
