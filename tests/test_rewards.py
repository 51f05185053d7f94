"""What rewards are worth: living pays, what survives would not have gained by failing sooner, and turning beats waiting."""

import functools
import math
from typing import NamedTuple

import gymnasium
import numpy as np
import pytest

from ballbot_gym import certified
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_gym.robot import default_params
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.vector.arrays import BallbotArrays
from ballbot_gym.vector.native import BallbotNative

torch = pytest.importorskip("torch")

ENVS = 32
"""Of each policy."""


def policies(task, params):
    """Policies by name: functions of state (8, B), observation (B, no) and a generator to actions (B, 2)."""
    pytest.importorskip("scipy")
    from ballbot_baselines.solvers.riccati import discrete_lqr
    from ballbot_train.policy.files import shipped_policies
    from ballbot_train.policy.network import PolicyNetwork

    k, _ = discrete_lqr(Stabilize(), params, np.zeros(8), np.zeros(2), np.zeros(0))
    k = torch.as_tensor(k) / params.force_limit
    upright = k.clone()
    upright[:, :2] = 0.0  # stands where it is
    away = torch.zeros(8, 1, dtype=torch.float64)
    away[4:6] = 3.0  # m/s

    chosen = {
        "random": lambda x, o, rng: torch.as_tensor(rng.uniform(-1, 1, (x.shape[1], 2))),
        "upright": lambda x, o, rng: -(upright @ x).T,
        "drive-away": lambda x, o, rng: -(upright @ (x - away)).T,
        "bang-bang": lambda x, o, rng: torch.sign(-(k @ x).T),
    }
    name, path = next(iter(shipped_policies(task).items()))
    network = PolicyNetwork.load(path, task)
    chosen[name] = lambda x, o, rng: network(o.float())
    return chosen


class Played(NamedTuple):
    """One episode of each of B envs, of at most T steps."""

    gains: np.ndarray
    """(T, B) pay of a step less what it cost, NaN after the episode's end; the pay of a first exit is not in it."""
    returns: np.ndarray
    failures: np.ndarray
    violated: np.ndarray
    """(B,) index of the limit that ended the episode, or −1."""


@functools.cache
def play(task):
    """`Played` by name of policy. All policies act in one batch."""
    params = default_params()
    chosen, rng = policies(task, params), np.random.default_rng(0)
    count = ENVS * len(chosen)
    try:
        envs = BallbotNative(task, count, np.float64, params)
    except NoMachineCodeError:  # then it takes longer
        envs = BallbotArrays(task, count, np.float64, params)
    parts = [slice(i * ENVS, (i + 1) * ENVS) for i in range(len(chosen))]
    envs.state = envs.initial_state(seed=0)
    observation = envs.observe(envs.state)
    running, steps = np.ones(envs.num_envs, bool), []
    for _ in range(task.steps):
        x, seen, c = torch.from_numpy(envs.state.x), torch.from_numpy(observation), tuple(envs.state.c)
        with torch.no_grad():
            actions = [policy(x[:, part], seen[part], rng) for policy, part in zip(chosen.values(), parts, strict=True)]
        before = tuple(envs.state.x)
        did = envs.step(torch.cat(actions).double().numpy())
        observation = did.observation
        gain = (task.survival_reward - task.cost(before, tuple(did.force), c)) * task.control_dt
        steps.append(np.where(running, [gain, did.reward, did.failure, did.violated], math.nan))
        running = running & ~(did.terminated | did.truncated)
    assert not running.any()
    gains, rewards, failures, violated = np.stack(steps, 1)
    return {
        name: Played(
            gains[:, part],
            np.nansum(rewards[:, part], axis=0),
            np.nanmax(failures[:, part], axis=0) > 0,
            np.nanmax(violated[:, part], axis=0),
        )
        for name, part in zip(chosen, parts, strict=True)
    }


FULL_FORCE = {("stabilize", "bang-bang"), ("weave", "bang-bang")}
"""Full force on both axes costs 122.5 /s in these tasks, more than the pay of 100 /s."""


@pytest.mark.parametrize("name", TASKS)
def test_no_episode_that_survives_would_have_scored_better_by_failing_sooner(name):
    """Had the episode failed at step k, it would have been paid for k steps less what they cost."""
    survived = 0
    for policy, played in play(TASKS[name]()).items():
        summed = np.where(np.isfinite(played.gains), np.nancumsum(played.gains, axis=0), math.nan)
        best_failure, alive = np.nanmax(summed, axis=0), ~played.failures
        better_failed = played.returns[alive] < best_failure[alive] - 1e-9
        if (name, policy) in FULL_FORCE:
            assert better_failed.all()
        else:
            assert not better_failed.any(), policy
        survived += int(alive.sum())
    assert survived > ENVS


def test_driving_away_ends_at_the_arena(task):
    assert task.limit_names[-1] == "arena"
    assert len(task.limit_names) - 1 in play(task)["drive-away"].violated


def test_every_stored_optimum_stays_inside_the_arena_by_far(task):
    evaluation = certified.load(task, "paper")
    for trajectory, c in zip(evaluation.trajectories, evaluation.constants, strict=False):
        x, y, radius = task.arena(tuple(c))
        assert np.hypot(trajectory.x[:, 0] - x, trajectory.x[:, 1] - y).max() < 0.8 * radius


def test_reward_threshold_is_the_mean_return_at_ten_percent_regret(task):
    costs = certified.load(task, "paper").costs
    assert task.reward_threshold == pytest.approx(np.mean(task.survival_pay - 1.1 * costs), abs=0.05)
    assert gymnasium.spec(task.id).reward_threshold == task.reward_threshold


def test_pay_and_arena_are_no_part_of_the_problem(task):
    arena = {"arena_factor": 3.0} if task.id == "BallbotOrbit-v0" else {"arena_radius": 30.0}
    other = type(task)(survival_reward=50.0, **arena)
    assert other.problem() == task.problem()
    assert type(task)(duration=4.0).problem() != task.problem()
    np.testing.assert_array_equal(certified.load(other, "paper").costs, certified.load(task, "paper").costs)
