"""What rewards are worth: living pays, failing sooner never scores better, and no clock or discount makes waiting best."""

import math

import gymnasium
import numpy as np
import pytest

from ballbot_gym import certified
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.tasks.turn import Turn

torch = pytest.importorskip("torch")

from ballbot_gym.batch import BallbotBatch  # noqa: E402

ENVS = 16


def policies(task, params):
    """Policies by name: functions of state (8, B), constants (nc, B), observation (B, no) and a generator to (B, 2)."""
    pytest.importorskip("scipy")
    from ballbot_baselines.lqr import discrete_lqr
    from ballbot_train.policy import load_network, shipped_policies

    k, _ = discrete_lqr(Stabilize(), params, np.zeros(8), np.zeros(2), np.zeros(0))
    k = torch.as_tensor(k) / params.force_limit
    upright = k.clone()
    upright[:, :2] = 0.0  # stands where it is
    away = torch.zeros(8, 1, dtype=torch.float64)
    away[4:6] = 1.5  # m/s

    def bang_bang(x, c, o, rng):
        return torch.sign(-(k @ x).T)

    chosen = {
        "random": lambda x, c, o, rng: torch.as_tensor(rng.uniform(-1, 1, (x.shape[1], 2))),
        "upright": lambda x, c, o, rng: -(upright @ x).T,
        "drive-away": lambda x, c, o, rng: -(upright @ (x - away)).T,
        "bang-bang": bang_bang,
    }
    for name, path in shipped_policies(task).items():
        network = load_network(path, task)
        chosen[name] = lambda x, c, o, rng, network=network: network(o.float())
    return chosen


def play(task, policy, envs=ENVS, steps=None, dtype=torch.float64, seed=0):
    """Running costs (T, B), NaN after an episode's end, and reward, cost, success, failure sums (B,) of one episode each."""
    batch = BallbotBatch(task, envs, dtype=dtype, compile=False)
    observation = batch.reset(seed=seed)
    rng = np.random.default_rng(seed)
    running = torch.ones(envs, dtype=torch.bool)
    total, cost = torch.zeros(envs, dtype=torch.float64), torch.zeros(envs, dtype=torch.float64)
    rates, failure = [], torch.zeros(envs, dtype=torch.bool)
    with torch.no_grad():
        for _ in range(task.steps):
            before = batch.state
            result = batch.step(policy(before.x.double(), before.c, observation, rng))
            rate = task.cost(before.x.unbind(0), result.force.unbind(0), before.c.unbind(0)) * task.control_dt
            rates.append(torch.where(running, rate.double(), math.nan))
            total += torch.where(running, result.reward, 0.0)
            cost += torch.where(running, result.cost, 0.0)
            failure |= running & result.failure
            running = running & ~(result.terminated | result.truncated)
            observation = result.observation
    return torch.stack(rates).numpy(), total.numpy(), cost.numpy(), failure.numpy()


def test_return_and_cost_add_up_to_the_survival_pay_however_an_episode_ends(task, params):
    for name, policy in policies(task, params).items():
        _, total, cost, _ = play(task, policy)
        np.testing.assert_allclose(total + cost, task.survival_pay, rtol=1e-9, err_msg=name)


def test_failing_sooner_never_scores_better_than_an_episode_that_survives(task, params):
    """Had the episode failed at step k, it would have been paid for k steps less what they cost.

    Of the steps in the arena some cost more than living them pays, as full force on both axes or a fast drive on a circle of
    3 m. No episode that survives has so many of them that any earlier failure would have scored better.
    """
    step_pay = task.survival_reward * task.control_dt
    survived = 0
    for name, policy in policies(task, params).items():
        running, total, _, failure = play(task, policy)
        gains = step_pay - running
        best_failure = np.nanmax(np.nancumsum(gains, axis=0), axis=0)
        survived += int((~failure).sum())
        assert (total[~failure] >= best_failure[~failure] - 1e-9).all(), name
        if name not in ("random", "bang-bang", "drive-away"):
            assert (gains[np.isfinite(gains)] < 0).mean() < 0.01, name
    assert survived >= ENVS


def test_policies_that_play_anything_stay_in_the_spaces_and_the_bounds_of_reward(task, params):
    """1e5 steps in all."""
    bounds = torch.tensor(task.observation_bounds(params))
    low, high = task.reward_bounds(params)
    for name in ("random", "bang-bang", "drive-away"):
        policy, rng = policies(task, params)[name], np.random.default_rng(1)
        batch = BallbotBatch(task, 500, compile=False)
        observation = batch.reset(seed=1)
        for _ in range(67):
            state = batch.state
            result = batch.step(policy(state.x.double(), state.c, observation, rng))
            observation = result.observation
            assert (result.final_observation.abs() <= bounds).all(), name
            assert low <= float(result.reward.min()) <= float(result.reward.max()) <= high, name


def test_leaving_the_arena_fails_by_that_name(task, params):
    policy = policies(task, params)["drive-away"]
    batch = BallbotBatch(type(task)(duration=16.0), 16, dtype=torch.float64, compile=False)
    observation = batch.reset(seed=0)
    arena, seen = task.limit_names.index("arena"), set()
    for _ in range(800):
        result = batch.step(policy(batch.state.x, batch.state.c, observation, None))
        assert torch.equal(result.failure, result.violated >= 0)
        seen |= set(result.violated.tolist())
        observation = result.observation
    assert arena in seen


def test_every_stored_optimum_stays_inside_the_arena_by_far(task):
    evaluation = certified.load(task)
    for trajectory, c in zip(evaluation.trajectories, evaluation.constants, strict=False):
        x, y, radius = task.arena(tuple(c))
        assert np.hypot(trajectory.x[:, 0] - x, trajectory.x[:, 1] - y).max() < 0.8 * radius


def test_no_certified_optimum_can_leave_the_arena_for_what_it_costs(task):
    """The cost alone bounds how far an optimum goes, of those without a stored trajectory too.

    With distance d from the goal, d(d²)/dt ≤ 2d|v| ≤ √2 (d² + ½|v|²), at most √2 times the cost rate; and so on the way back,
    to d = 0: 2 d_max² ≤ d_0² + √2 · cost.
    """
    if task.id not in ("BallbotStabilize-v0", "BallbotWeave-v0"):
        pytest.skip("its cost rate does not hold the distance")
    evaluation = certified.load(task)
    for x, c, cost in zip(evaluation.states, evaluation.constants, evaluation.costs, strict=True):
        x_centre, y_centre, radius = task.arena(tuple(c))
        start = (x[0] - x_centre) ** 2 + (x[1] - y_centre) ** 2
        assert math.sqrt((start + math.sqrt(2) * cost) / 2) < 0.95 * radius


def test_reward_threshold_is_the_mean_return_at_ten_percent_regret(task):
    costs = certified.load(task).costs
    assert task.reward_threshold == pytest.approx(np.mean(task.survival_pay - 1.1 * costs), abs=0.05)
    assert gymnasium.spec(task.id).reward_threshold == task.reward_threshold


def turning_less_waiting(gamma, bootstrapped):
    """(n,) by how much the certified turns, at their mean cost rate, are worth more than standing still.

    Time-outs end the sum, or, bootstrapped, standing still is worth what it would be for ever.
    """
    task, evaluation = Turn(), certified.load(Turn())
    steps, all_steps = np.round(evaluation.durations / task.control_dt), task.steps
    pay = task.survival_reward * task.control_dt

    def summed(n):
        return n if gamma == 1 else (1 - gamma**n) / (1 - gamma)

    bonus = gamma ** (steps - 1) * pay * (all_steps - steps)
    turning = (pay - evaluation.costs / steps) * summed(steps) + bonus
    waiting = (pay - task.time_weight * task.control_dt) * (1 / (1 - gamma) if bootstrapped else summed(all_steps))
    return turning - waiting


def test_turning_is_worth_more_than_waiting():
    assert all((turning_less_waiting(gamma, False) > 0).all() for gamma in (0.99, 0.995, 0.998, 1.0))
    assert all((turning_less_waiting(gamma, True) > 0).all() for gamma in (0.99, 0.995))
    assert (turning_less_waiting(0.998, True) < 0).all()  # as Turn's docstring warns


@pytest.mark.parametrize("duration", [1.0, 8.0, 16.0])
def test_made_envs_run_as_long_as_asked_and_their_spec_says_so(task, duration):
    env = gymnasium.make(task.id, physics="rk4", duration=duration)
    assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == round(duration / 0.02)
    assert env.spec.reward_threshold == (task.reward_threshold if duration == 8.0 else None)
    start = [0.0, 3.0, 0, 0, 0, 0, 0, 0] if task.id == "BallbotWeave-v0" else np.zeros(8)
    options = {"state": start}
    if task.id == "BallbotTurn-v0":
        options["constants"] = {"speed": 5.0}
    env.reset(seed=0, options=options)
    for k in range(round(duration / 0.02)):
        _, _, terminated, truncated, _ = env.step([0.0, 0.0])
        assert (terminated, truncated) == (False, k + 1 == round(duration / 0.02))
    again = gymnasium.make(env.spec)
    assert again.spec.max_episode_steps == env.spec.max_episode_steps
    assert again.unwrapped.task.duration == duration
    env.close()
    again.close()


def test_failure_cost_is_answered_with_what_replaced_it():
    with pytest.raises(TypeError, match=r"failure_cost.*give survival_reward"):
        gymnasium.make("BallbotStabilize-v0", failure_cost=300.0)


def test_pay_and_arena_are_no_part_of_the_problem(task):
    arena = {"arena_factor": 3.0} if task.id == "BallbotOrbit-v0" else {"arena_radius": 30.0}
    other = type(task)(survival_reward=50.0, **arena)
    assert other.problem() == task.problem()
    assert type(task)(duration=4.0).problem() != task.problem()
    np.testing.assert_array_equal(certified.load(other).costs, certified.load(task).costs)


def test_registry_is_complete():
    assert all(kind.reward_threshold > 0 for kind in TASKS.values())
