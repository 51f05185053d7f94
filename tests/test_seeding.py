"""Runs with neighbouring seeds meet different episodes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from ballbot_gym import seeding
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import Randomization, default_params
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector.batch import BallbotBatch
from ballbot_gym.vector.native import BallbotNative
from ballbot_train import BallbotVecEnv
from ballbot_train.evaluation import fresh, runner
from ballbot_train.learning import dagger, demonstrations
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.learning.rsl import RslVecEnv

ENVS = 64
SMALL = {
    "num_envs": ENVS,
    "hidden": (8,),
    "buffer_size": 1000,
    "gradient_steps": 1,
    "episodes_per_iteration": ENVS,
    "gathering_iterations": 1,
    "iterations": 1,
}


@pytest.fixture
def starts(monkeypatch):
    """Every initial state that is drawn, as bytes."""
    drawn = set()
    sample = Stabilize.sample

    def watched(initial):
        def of_batch(self, *arguments, **options):
            state = initial(self, *arguments, **options)
            drawn.update(x.tobytes() for x in np.asarray(state.x).T)
            return state

        return of_batch

    def of_task(self, *arguments, **options):
        x, c = sample(self, *arguments, **options)
        drawn.add(x.tobytes())
        return x, c

    for kind in (BallbotBatch, BallbotNative):
        monkeypatch.setattr(kind, "initial_state", watched(kind.initial_state))
    monkeypatch.setattr(Stabilize, "sample", of_task)
    return drawn


def shared(starts, begin):
    """How many starts two runs have in common, and how many they have."""
    sets = []
    for seed in (0, 1):
        starts.clear()
        begin(seed)
        sets.append(set(starts))
    probe = (
        Stabilize().sample(np.random.default_rng(0), default_params())[0].tobytes()
    )  # of LQR, which needs some episode
    return len(sets[0] & sets[1] - {probe}), min(map(len, sets))


class Drawn(Exception):
    """All starts of an iteration are drawn."""


@pytest.mark.parametrize("name", LEARNERS)
def test_trainings_with_neighbouring_seeds_share_no_start(name, starts, monkeypatch):
    def plan(*arguments, **options):
        raise Drawn

    monkeypatch.setattr(dagger, "find_optima", plan)
    settings = LEARNERS[name].settings("stabilize")
    known = {field.name for field in fields(settings)}
    settings = replace(settings, **{key: value for key, value in SMALL.items() if key in known})

    def begin(seed):
        learner = LEARNERS[name].make(Stabilize(), default_params(), settings, seed, None)
        if name == "dagger":
            with pytest.raises(Drawn):
                learner.iterate()

    both, each = shared(starts, begin)
    assert (both, each >= ENVS // 2) == (0, True)


@pytest.mark.parametrize(
    "begin",
    [
        lambda seed: PPO("MlpPolicy", BallbotVecEnv(BallbotVectorEnv(ENVS, engine="torch")), seed=seed).env.reset(),
        lambda seed: RslVecEnv(BallbotBatch(num_envs=ENVS), seed),
        lambda seed: fresh.draw(Stabilize(), range(ENVS), seed),
        lambda seed: fresh.draw(Stabilize(), range(ENVS), seed, "training"),
    ],
    ids=["stable-baselines3", "rsl_rl", "evaluation", "routes"],
)
def test_other_runs_with_neighbouring_seeds_share_no_start(begin, starts):
    both, each = shared(starts, begin)
    assert (both, each >= ENVS) == (0, True)


def test_vector_envs_are_seeded_as_gymnasium_does():
    first, second = (BallbotBatch(num_envs=ENVS) for _ in range(2))
    np.testing.assert_array_equal(first.reset(seed=70_000)[1:], second.reset(seed=70_001)[:-1])
    assert not torch.isin(first.reset(seed=seeding.spawned(0)), second.reset(seed=seeding.spawned(1))).any()


def test_sets_of_demonstrations_and_of_disturbed_episodes_share_no_seed(monkeypatch):
    env = BallbotEnv(
        "stabilize", physics="rk4", randomization=Randomization(push_impulse=(1.0, 1.0), push_interval=1.0)
    )
    used = {0: set(), 1: set()}

    def note(env, controller, seed, options):
        used[seed >= 1_000_000].add(seed)
        raise runner.PlanError("none")

    monkeypatch.setattr(runner, "rollout", note)
    for seed in (0, 1):
        runner.run_episodes(env, None, "none", "stabilize", range(200), seed)
    assert [len(seeds) for seeds in used.values()] == [200, 200]
    of = [demonstrations.DemoConfig(seed=seed, episodes=1000).episode_seed for seed in (0, 1)]
    assert not {of[0](i) for i in range(1000)} & {of[1](i) for i in range(1000)}


def test_a_seed_is_no_negative_number():
    with pytest.raises(ValueError, match="non-negative"):
        seeding.spawned(-1)
