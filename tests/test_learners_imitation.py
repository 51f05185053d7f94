"""Behaviour cloning and DAgger: they fit, and go on from a state as if never stopped."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from resuming import goes_on_as_if_never_stopped

from ballbot_baselines import Backoff, TvlqrController, find_optima, find_optimum
from ballbot_baselines.optimum import batched
from ballbot_baselines.solvers.riccati import tube_gains
from ballbot_gym.env import make_task
from ballbot_gym.robot import Randomization, default_params
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation import fresh
from ballbot_train.learning import dagger, routing, training
from ballbot_train.learning.actors import spec_for
from ballbot_train.learning.datasets import load_demos
from ballbot_train.learning.fitting import Fit, Samples
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.network import PolicyNetwork

CLONING = dagger.DaggerConfig(iterations=4, gathering_iterations=0, gradient_steps=20, batch_size=128, hidden=(16,))
TINY_DAGGER = dagger.DaggerConfig(
    iterations=4,
    gathering_iterations=2,
    episodes_per_iteration=4,
    gradient_steps=5,
    batch_size=64,
    hidden=(8,),
)


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    monkeypatch.setattr(dagger, "_SECONDS", 1.0)


def test_cloning_lowers_the_loss_and_comes_near_its_expert(demos):
    learner = dagger.make(make_task("stabilize"), default_params(), CLONING, 0, demos)
    losses = [learner.iterate()["loss/imitation"] for _ in range(learner.iterations)]
    assert losses[-1] < losses[0]
    data = load_demos(demos, make_task("stabilize"))
    with torch.no_grad():
        error = learner.network(torch.as_tensor(data.observations)).numpy() - data.actions
    assert np.square(error).mean() < 0.1 * np.square(data.actions).mean()


def test_cloning_without_demonstrations_says_what_it_needs():
    with pytest.raises(ValueError, match="ballbot demos"):
        dagger.make(make_task("stabilize"), default_params(), CLONING, 0, None)


def test_dagger_goes_on_from_its_state_as_if_never_stopped(demos):
    task, params, config = make_task("stabilize"), default_params(), replace(TINY_DAGGER, episodes_per_iteration=2)
    assert goes_on_as_if_never_stopped(lambda seed: dagger.make(task, params, config, 0, demos))


def test_expert_of_a_track_knows_the_robot_and_the_forces_on_their_way(monkeypatch):
    """A label is the optimal force from where the robot will be once the last force, which the learner sees, has acted."""
    task, params = make_task("stabilize"), default_params()
    drawn = Randomization(body_mass=(1.3, 1.3), force=(0.9, 0.9), actuator_delay=(0.02, 0.02))
    monkeypatch.setattr(dagger, "_SECONDS", 0.5)  # of every state a sample is made
    config = replace(TINY_DAGGER, episodes_per_iteration=32)
    learner = dagger.make(task, params, config, 0, None, randomization=drawn, history=1)
    assert learner.iterate()["train/labelled"] > 0.5  # from some states no robot so heavy and weak can be saved
    samples = learner.state_dict()["samples"]
    observations, actions = (samples[name].double().numpy()[:64] for name in ("observations", "actions"))
    robot = replace(params, body_mass=1.3 * params.body_mass, force_limit=0.9 * params.force_limit)
    x, under_way = observations[:, :8] * task.observation_scale, robot.force_limit * observations[:, 16:]
    later = np.stack(robot.step(tuple(x.T), tuple(under_way.T), task.control_dt, 2), 1)
    found = enumerate(find_optima(task, robot, later, np.zeros((len(x), 0))))
    first = {i: optimum.trajectory.u[0] for i, optimum in found if optimum}
    solved, forces = list(first), np.array(list(first.values()))
    off = np.abs(actions[solved] - np.clip(forces / robot.force_limit, -1, 1)).max(1)
    assert np.percentile(off, 25) < 1e-5  # where the expert acts: an optimum goes on being optimal
    assert np.percentile(off, 90) < 0.1  # where the learner acts: feedback about it is linear


def test_dagger_says_where_no_optimum_was_found(monkeypatch):
    monkeypatch.setattr(dagger, "find_optima", lambda task, robot, x, *_, **__: [None] * len(x))
    learner = dagger.Dagger(make_task("stabilize"), default_params(), TINY_DAGGER)
    with pytest.raises(ValueError, match=r"nothing to learn from: .* of BallbotStabilize-v0 with the robot paper"):
        learner.iterate()


@pytest.mark.parametrize("name", ["turn", "weave"])
def test_dagger_labels_what_it_meets(name, monkeypatch):
    monkeypatch.setattr(routing, "EPISODES", 60)
    monkeypatch.setattr(routing, "_STEPS", 5)
    monkeypatch.setattr(routing, "_DISTANCES", 1)
    task = TASKS[name]()
    settings = ("iterations", "episodes_per_iteration", "gradient_steps", "batch_size", "hidden")
    config = replace(LEARNERS["dagger"].settings(name), **{field: getattr(TINY_DAGGER, field) for field in settings})
    learner = dagger.Dagger(task, default_params(), config)
    samples = [learner.iterate()["train/samples"] for _ in range(2)]
    assert samples[1] > samples[0] > 0
    state = learner.state_dict()["samples"]
    assert state["observations"].shape[1] == len(task.observation_scale)
    assert state["observations"].isfinite().all()
    assert state["actions"].abs().max() <= 1


@pytest.mark.parametrize("hard", [dagger._HARD, dagger._HARD_OF_MANY])
def test_a_share_of_a_later_round_begins_where_the_learner_fails(hard, monkeypatch):
    share, _, seconds, again = hard
    task, learner = make_task("stabilize"), dagger.make(make_task("stabilize"), default_params(), TINY_DAGGER)
    monkeypatch.setattr(learner, "_hard", (share, 16, seconds, again))

    def failures():
        x, c = learner._beginnings(64, np.random.default_rng(0))
        return int(fresh.run_policy(learner.network, task, x, c, np.zeros((64, 0))).failure.sum())

    random = failures()
    learner.iteration = 1
    assert 0 < random < 32
    assert failures() >= 64 * share + (1 - share) * random / 2


def test_the_hardest_slaloms_are_those_in_which_the_learner_comes_nearest_to_an_obstacle():
    task, rng = make_task("weave"), np.random.default_rng(0)
    learner = dagger.make(task, default_params(), replace(TINY_DAGGER, symmetry="routes"))
    x, c = map(np.array, zip(*(task.sample(rng, default_params()) for _ in range(64)), strict=True))
    c[:20] = task.without_obstacles(c[0])
    order = learner._hardest(x, c, 1.0)
    ran = fresh.run_policy(learner.network, replace(task, duration=1.0), x, c, np.zeros((64, 0)), margins=True)
    failures = int(ran.failure.sum())
    assert 0 < failures < 44
    assert ran.failure[torch.as_tensor(order[:failures])].all()
    assert (np.diff(ran.margin.numpy()[order[failures:]]) >= 0).all()


@pytest.mark.parametrize("squash", ["tanh", "clip"])
@pytest.mark.parametrize(
    ("name", "symmetry"), [("stabilize", "odd"), ("orbit", "centred"), ("turn", "frame"), ("weave", "routes")]
)
def test_fits_act_as_the_policy_does(name, symmetry, squash):
    """What depends on observations alone is computed for many batches at once, and gives the same actions."""
    task, params, rng = make_task(name), default_params(), np.random.default_rng(0)
    network = PolicyNetwork(spec_for(task, symmetry, (16,), True, activation="silu", squash=squash))
    for part in network.mlp[-1].parameters():  # a new policy is its linear part
        torch.nn.init.normal_(part)
    x, c = map(np.array, zip(*(task.sample(rng, params) for _ in range(50)), strict=True))
    seen = torch.as_tensor(np.asarray(task.observe(x + 0.1 * rng.standard_normal(x.shape), c), np.float32))
    actions = network(seen)
    assert actions.abs().max() > 0.1
    torch.testing.assert_close(network.acting(network.prepared(seen)), actions)


def test_a_policy_that_acts_at_the_wrong_limit_learns_its_label():
    """There a clip has no slope."""
    torch.manual_seed(0)
    network = PolicyNetwork(spec_for(make_task("stabilize"), "none", (16,), True, activation="silu", squash="clip"))
    rng = np.random.default_rng(0)
    seen, label = rng.standard_normal((64, 8)), np.tile([-0.5, 1.0], (64, 1))
    torch.nn.init.constant_(network.mlp[-1].bias, 3.0)
    observations = torch.as_tensor(seen, dtype=torch.float32)
    assert (network(observations) == 1).all()
    Fit(network, network.acting).run(Samples.of(seen, label), 500, 64, 1e-2, rng)
    assert np.abs(network(observations).detach().numpy() - label).mean() < 0.05


def feedback_errors(task, plan, c, backoff, gains, scale):
    """What the optimum's force changes by in disturbed states, and by how much each of several gains misses that, N."""
    params, rng = default_params(), np.random.default_rng(3)
    changes, errors = [], []
    for k in (3, 10, 20):
        off = scale * np.array([0.1, 0.1, 0.05, 0.05, 0.3, 0.3, 0.3, 0.3]) * rng.standard_normal(8)
        path = plan.trajectory.x[k:, :2]
        again = find_optimum(task, params, plan.trajectory.x[k] + off, c, backoff, paths=[path])
        changes.append(again.trajectory.u[0] - plan.trajectory.u[k])
        errors.append([np.abs(changes[-1] + gain[k] @ off).mean() for gain in gains])
    return np.abs(changes).mean(), np.mean(errors, axis=0)


def test_the_tube_gives_the_forces_that_the_optimum_from_there_would():
    task, c = make_task("stabilize"), np.zeros(0)
    plan = find_optimum(task, default_params(), np.array([1.0, 0, 0, 0, 0, 3, 0, 0]), c)
    change, (error,) = feedback_errors(
        task, plan, c, Backoff(), [tube_gains(task, default_params(), plan.trajectory, c)], 0.5
    )
    assert error < 0.15 * change


def test_where_the_goal_ends_the_episode_the_tube_leaves_the_freedom_that_the_optimum_has():
    """Tracking wants to arrive in the goal's middle at the planned time, which a short turn does not need."""
    task, params, c, backoff = make_task("turn"), default_params(), np.array([2.3]), Backoff(goal=0.3, force=0.02)
    plan = find_optimum(task, params, np.array([0, -1, 0, 0, 0, 2.3, 0, 0]), c, backoff)
    tracking = TvlqrController.for_task(task, params, plan.trajectory, c).gains.k
    _, errors = feedback_errors(task, plan, c, backoff, [tube_gains(task, params, plan.trajectory, c), tracking], 0.3)
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("name", ["stabilize", "orbit"])
def test_labels_are_what_the_optimum_from_there_would_do(name):
    """Also those of the states around, which are drawn for every batch."""
    task, params = make_task(name), default_params()
    learner = dagger.Dagger(task, params, replace(TINY_DAGGER, episodes_per_iteration=16))
    assert learner.iterate()["train/labelled"] > 0.5  # some of those that the learner reaches cannot be recovered
    seen, actions, _ = (part.double().numpy() for part in learner._samples.draw(100, np.random.default_rng(0)))
    seen = seen * task.observation_scale
    found = find_optima(task, params, seen[:, :8], seen[:, len(seen[0]) - len(task.constant_names) :])
    off = [
        np.abs(action - np.clip(best.trajectory.u[0] / params.force_limit, -1, 1)).max()
        for action, best in zip(actions, found, strict=True)
        if best is not None
    ]
    assert len(off) > 80
    assert np.median(off) < 0.02
    assert np.percentile(off, 80) < 0.1  # feedback about an optimum is linear


def test_labels_on_a_slalom_go_past_obstacles_on_the_sides_that_the_learner_chose(monkeypatch):
    monkeypatch.setattr(dagger, "fit_routes", lambda *given: None)  # so that many sides are not the best
    task, params = make_task("weave"), default_params()
    small = ("iterations", "gathering_iterations", "gradient_steps", "batch_size", "hidden")
    config = replace(dagger.TUNED["weave"], **{name: getattr(TINY_DAGGER, name) for name in small})
    learner = dagger.Dagger(task, params, replace(config, episodes_per_iteration=8))
    learner.iterate()
    samples = learner.state_dict()["samples"]
    rows = np.random.default_rng(0).integers(len(samples["actions"]), size=40)
    seen, actions, states, constants = (
        samples[name][rows] for name in ("observations", "actions", "states", "constants")
    )
    x, c = states.double().numpy(), constants.double().numpy()
    sides = [tuple(chosen) for chosen in learner.network.routes(seen).int().tolist()]
    found = find_optima(task, params, x, c, config.backoff, sides=sides)
    off = [
        np.abs(action - np.clip(optimum.trajectory.u[0] / params.force_limit, -1, 1)).max()
        for action, optimum in zip(actions.numpy(), found, strict=True)
        if optimum
    ]
    assert len(off) > 30
    assert np.median(off) < 0.02
    best = find_optima(task, params, x, c, config.backoff)
    worse = [mine.cost > 1.001 * other.cost for mine, other in zip(found, best, strict=True) if mine and other]
    assert any(worse)  # so the sides do matter here


def test_batches_hold_new_states_near_optima_with_the_feedback_as_their_labels():
    task, params = make_task("stabilize"), default_params()
    learner = dagger.Dagger(task, params, replace(TINY_DAGGER, episodes_per_iteration=2))
    learner.iterate()
    samples = learner._samples
    observations, actions, _ = samples.draw(200, np.random.default_rng(0))
    rows = np.random.default_rng(0).integers(len(samples), size=200)
    off = (observations - samples.observations[rows])[:, :8] * torch.tensor(task.observation_scale[:8])
    change = -torch.einsum("bij,bj->bi", samples.gains[rows], off)
    inside = (samples.actions[rows] + change).abs().amax(1) < 1
    assert inside.float().mean() > 0.5  # the others are at the force limit
    torch.testing.assert_close(actions[inside], (samples.actions[rows] + change)[inside], atol=2e-4, rtol=0)
    assert 0.3 * 0.05 < off[:, 0].std() < 0.05
    assert 0.3 * 0.15 < off[:, 4].std() < 0.15


def test_optima_are_found_one_by_one_where_they_cannot_be_found_at_once(monkeypatch):
    task, params, config = make_task("stabilize"), default_params(), replace(TINY_DAGGER, episodes_per_iteration=2)
    at_once, alone = dagger.Dagger(task, params, config), dagger.Dagger(task, params, config)
    at_once.iterate()
    monkeypatch.setattr(batched, "_solves", lambda task, params: False)
    alone.iterate()
    first, second = (each.state_dict()["samples"]["actions"].numpy() for each in (at_once, alone))
    np.testing.assert_allclose(second[:20], first[:20], atol=0.02)


def test_dagger_falls_far_less_than_lqr_after_two_rounds():
    """LQR is where it starts; episodes and what the learner meets halve its falls."""
    task, params = make_task("stabilize"), default_params()
    small = {
        "iterations": 2,
        "gathering_iterations": 2,
        "episodes_per_iteration": 32,
        "gradient_steps": 400,
        "batch_size": 256,
        "hidden": (64,),
        "symmetry": "odd",
    }
    learner = dagger.Dagger(task, params, replace(dagger.DaggerConfig(), **small))
    before = training.score_and_validate(learner.network, task, episodes=1)
    for _ in range(small["iterations"]):
        learner.iterate()
    after = training.score_and_validate(learner.network, task, episodes=1)
    for name in ("certified/failures", "certified/cost_ratio"):
        assert after[name] < 0.6 * before[name]
