"""Controllers on unknown robots, delays and sensor errors."""

import csv
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("casadi")
pytest.importorskip("torch")


from ballbot_baselines import VARIANTS, LqrController
from ballbot_baselines.feedback.adaptive import AdaptiveNmpcController
from ballbot_baselines.feedback.kalman import TrackFilter
from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import ROBOT_FACTORS, TRACKS, Randomization, default_params
from ballbot_gym.rollout import rollout
from ballbot_gym.tasks import TASKS
from ballbot_gym.vector.batch import BallbotBatch
from ballbot_gym.vector.episodes import run_episodes
from ballbot_train import evaluate, load_policy
from ballbot_train.commands.benchmark import benchmark
from ballbot_train.evaluation import fresh
from ballbot_train.evaluation.controllers import ControllerName, controllers_of
from ballbot_train.evaluation.fresh import evaluate_fresh
from ballbot_train.evaluation.robustness import EXPERTS, groups_of
from ballbot_train.learning.actors import started
from ballbot_train.policy.export_onnx import export_onnx
from ballbot_train.policy.files import PolicyError, PolicyFile, shipped_policies, track_in
from ballbot_train.policy.network import PolicyNetwork


def test_table_of_tracks_splits_regret_and_says_what_evaluate_says(tmp_path):
    options = {"tasks": ("orbit",), "controllers": ("trajopt", "lqr"), "episodes": 2, "physics": "rk4", "workers": 1}
    benchmark(**options, randomization=("unknown", "late"), out=tmp_path)
    table = csv.DictReader((tmp_path / "tracks.csv").read_text().splitlines())
    rows = {(row["track"], row["controller"]): row for row in table}
    assert len(rows) == 4
    for (track, controller), row in rows.items():
        same = evaluate(controller, "orbit", 2, "rk4", randomization=track)
        assert float(row["regret_mean"]) == pytest.approx(same.regret_mean, nan_ok=True)
        if row["falls"] == "0" and rows[track, row["best"]]["falls"] == "0":
            parts = float(row["hidden_parameters_cost"]) + float(row["controller_adds"])
            assert parts == pytest.approx(same.regret_mean)
        known = certified.load("orbit", "paper", randomization=TRACKS[track])
        delay = (1 - known.ideal[:2] / known.costs[:2]).mean()
        assert float(row["delay_costs"]) == pytest.approx(delay)
        assert (delay > 0) == (track == "late")
    best = rows["unknown", rows["unknown", "lqr"]["best"]]
    assert float(best["controller_adds"]) == 0 < float(best["hidden_parameters_cost"])
    assert (tmp_path / "tracks.md").read_text().count("orbit") == 4


def test_experts_of_a_track_meet_that_track_alone_unless_they_are_named():
    def met(controllers, experts):
        groups = groups_of({"orbit": controllers}, ["late", "noisy"], "rk4", experts=experts)
        return [
            [group.controller for group in groups if group.labels["stress"] == track] for track in ("late", "noisy")
        ]

    assert met(["lqr", "apg-late"], EXPERTS) == [["lqr", "apg-late", "nmpc-adaptive"], ["lqr", "nmpc-ekf"]]
    assert met(["nmpc-ekf"], {}) == [["nmpc-ekf"], ["nmpc-ekf"]]
    assert set(EXPERTS) == set(TRACKS)


SHIPPED = [
    (name, learner, track)
    for name in TASKS
    for track in TRACKS
    for learner in shipped_policies(make_task(name), track=track)
    if track_in(learner) == track
]


@pytest.mark.parametrize(("name", "learner", "track"), SHIPPED, ids=["-".join(each[:2]) for each in SHIPPED])
def test_policy_of_a_track_is_what_its_file_says(name, learner, track):
    """It comes with the package, runs on its track alone unless it is named, and does there what it measured."""
    path = shipped_policies(make_task(name), track=track)[learner]
    described = PolicyFile(path).read()
    assert described["training"]["randomization"] == track
    assert learner not in shipped_policies(make_task(name))
    row = evaluate(learner, name, 2, "rk4", randomization=track)
    assert row.success >= described["measured"]["success"] - 0.3
    most = 95_000 if name == "weave" else 50_000  # as Weave's policies of the known robot
    assert sum(part.numel() for part in PolicyNetwork.load(path, make_task(name)).parameters()) <= most


def test_model_of_another_library_is_shown_the_past_that_it_was_trained_with():
    class Model:
        observation_space = BallbotEnv(physics="rk4", history=2).observation_space

        def predict(self, observation, **_):
            seen.append(observation)
            return np.zeros(2), None

    seen = []
    evaluate(Model(), "stabilize", 1, "rk4", randomization="late")
    assert seen[2].shape == Model.observation_space.shape
    np.testing.assert_array_equal(seen[2][8:16], seen[1][:8])
    np.testing.assert_array_equal(seen[2][18:26], seen[0][:8])
    np.testing.assert_array_equal(seen[0][8:16], seen[0][:8])


def test_fresh_episodes_of_a_track_draw_robots_and_say_what_each_costs():
    result = evaluate_fresh("apg", "turn", 20, randomization="unknown")
    plain = evaluate_fresh("apg", "turn", 20)
    np.testing.assert_array_equal(result.states, plain.states)
    assert (result.costs != plain.costs).all()
    assert set(result.measures) > {"body_mass", "com_height", "force"}
    assert 0.7 <= result.measures["body_mass"].min() < result.measures["body_mass"].max() <= 1.4


@pytest.mark.parametrize(
    ("task", "track", "policy", "filtered"),
    [("stabilize", "noisy", "apg", "apg-ekf"), ("turn", "late", "apg", "apg-adaptive")],
)
def test_a_policy_behind_a_filter_succeeds_on_a_track_that_it_never_saw(task, track, policy, filtered):
    alone, behind = (evaluate(name, task, 4, "rk4", randomization=track) for name in (policy, filtered))
    assert alone.success < behind.success
    assert behind.success > 0.9
    assert controllers_of([task], [filtered]) == {"paper": {task: [filtered]}}


def test_a_batch_of_filters_does_what_one_does():
    result = evaluate_fresh("apg-adaptive", "turn", 3, randomization="late")
    env = BallbotEnv("turn", physics="rk4", randomization="late")
    controller = ControllerName("apg-adaptive").make(env.task, env.params)
    for i in range(3):
        given = {"state": result.states[i], "constants": result.constants[i], "drawn": result.drawn[i]}
        assert rollout(env, controller, options=given).cost == pytest.approx(result.costs[i], rel=1e-4)


def test_a_policy_file_may_be_named_with_its_filter():
    named = f"{shipped_policies(make_task('stabilize'))['apg']}-ekf"
    by_path, by_name = (evaluate(name, "stabilize", 1, "rk4", randomization="noisy") for name in (named, "apg-ekf"))
    alone = load_policy(shipped_policies(make_task("stabilize"))["apg"])
    for policy in ("apg", alone):
        filtered = evaluate(policy, "stabilize", 1, "rk4", randomization="noisy", filter="ekf")
        assert filtered.cost_mean == by_name.cost_mean
        assert filtered.controller.endswith("-ekf")
    with pytest.raises(ValueError, match="apg-ekf has a filter in front of it already"):
        evaluate("apg-ekf", "stabilize", 1, "rk4", filter="adaptive")
    assert by_path.regret_mean == by_name.regret_mean


def test_adaptive_nmpc_learns_robot_and_delay_in_a_second():
    drawn = Randomization(body_mass=(1.3, 1.3), com_height=(0.9, 0.9), force=(0.9, 0.9), actuator_delay=(0.04, 0.04))
    env = BallbotEnv("stabilize", physics="rk4", randomization=drawn)
    controller = AdaptiveNmpcController(env.task, env.params, "-adaptive")  # it is told the nominal robot
    _, info = env.reset(seed=0, options=certified.load("stabilize", "paper").options(0))
    controller.reset(0.0, info["state"], info["constants"])
    for k in range(50):
        info = env.step(controller.act(k * env.task.control_dt, info["state"]) / env.params.force_limit)[-1]
    assert controller.filter.factors == pytest.approx([1.3, 0.9, 0.9], rel=0.01)
    assert controller.filter.delay == 2


@pytest.mark.slow
def test_adaptive_nmpc_passes_the_gate_in_an_engine_of_first_order():
    """Its errors are the same in many steps on end, and no other robot explains them."""
    row = evaluate("nmpc-adaptive", "turn", 1, "bullet", randomization="unknown")
    assert row.success == 1
    assert row.regret_mean < 0.05


def test_filter_errs_less_than_half_of_what_noisy_sensors_do():
    track = TRACKS["noisy"]
    env = BallbotEnv("stabilize", physics="rk4", randomization=track)
    estimate, lqr = TrackFilter(env.task, env.params, track), LqrController(env.task, env.params)
    errors, noise = [], []
    for seed in range(3):
        _, info = env.reset(seed=seed, options={"state": [0.5, 0, 0.1, 0, 0, 1, 0, 0]})
        lqr.reset(0.0, info["state"], info["constants"])
        u = np.zeros(2)
        for k in range(env.task.steps):
            t, x, drawn = k * env.task.control_dt, info["state"], tuple(info["drawn"])
            seen = np.array(track.sensed(tuple(x), tuple(env.np_random.random(8)), drawn, t))
            if k:
                estimate.update(t, seen, u)
            else:
                estimate.reset(seen)
            u = np.clip(lqr.act(t, estimate.x), -env.params.force_limit, env.params.force_limit)
            info = env.step(u / env.params.force_limit)[-1]
            if k > 50:  # a second
                errors.append(estimate.x - x)
                noise.append(seen - x)
    filtered, raw = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (errors, noise))
    assert (filtered[2:] < 0.5 * raw[2:]).all()  # odometry drifts, and nothing tells


def test_noise_alone_keeps_no_robot_from_rest():
    """Nobody knows better than this filter where the robot is, so no policy rests more often than its errors allow."""
    task, track = make_task("stabilize"), TRACKS["noisy"]
    estimate = TrackFilter(task, default_params(), track)
    estimate.reset(np.zeros(8))
    for k in range(1, task.steps + 1):
        estimate.update(k * task.control_dt, np.zeros(8), np.zeros(2))
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(8), estimate.covariance[:8, :8], 100_000)
    share = np.mean(np.all(np.array(task.goal(errors, np.zeros(0))) <= 0, axis=0))
    assert 0.9995 < share < 0.9999  # odometry's drift over 8 s, 2.4 cm, takes the rest


def test_cautious_plan_leaves_the_force_that_the_weakest_robot_lacks():
    env = BallbotEnv("stabilize", physics="rk4")
    cautious = VARIANTS["cautious"](env.task, env.params)
    cautious.reset(0.0, np.array([0, 0, 0.6, 0, 5.0, 0, 1.0, 0]), np.zeros(0))
    asked = np.abs(cautious.plan.trajectory.u).max() / env.params.force_limit
    assert asked == pytest.approx(TRACKS["unknown"].force[0], rel=1e-3)


def test_the_past_of_an_episode_with_given_draws_begins_with_their_sensors(rng):
    import torch

    batch = BallbotBatch("stabilize", 3, randomization="noisy", history=2, compile=False)
    batch.reset(seed=5)
    drawn = batch.state.drawn.T.numpy()[::-1].copy()
    seen = []

    def policy(observation):
        seen.append(observation)
        return torch.zeros(len(observation), 2)

    run_episodes(
        batch,
        policy,
        *(np.array(part) for part in zip(*(batch.task.sample(rng, batch.params) for _ in range(3)), strict=True)),
        drawn=drawn,
    )
    first = seen[0]
    assert torch.equal(first[:, :8], first[:, 8:16])
    assert torch.equal(first[:, :8], first[:, 18:26])
    assert torch.equal(first[:, 16:18], torch.zeros(3, 2))


def test_the_first_reading_of_sensors_is_of_the_robot_that_was_given():
    import torch

    varied = Randomization(body_mass=(0.7, 1.4))
    batch = BallbotBatch(
        "stabilize", 3, robot="omni", observation="sensors", randomization=varied, compile=False, dtype=torch.float64
    )
    by_seed = batch.reset(seed=5)
    drawn = batch.state.drawn
    assert torch.equal(batch.reset(seed=5, drawn=drawn), by_seed)
    assert (batch.reset(seed=5, drawn=drawn.flip(1))[[0, 2], :6] != by_seed[[0, 2], :6]).any()
    with pytest.raises(ValueError, match="drawn"):
        batch.reset(seed=5, drawn=drawn[:2])


def test_an_informed_policy_acts_as_its_start_at_first_and_runs_behind_a_filter(tmp_path):
    import torch

    start = PolicyNetwork.load(shipped_policies(make_task("stabilize"))["apg"], make_task("stabilize"))
    informed = started(start, replace(start.spec, informed=True))
    told = torch.tensor([[1.0, 1.0, 1.0], [1.3, 0.9, 0.9]])
    observations = torch.rand(2, 8, generator=torch.Generator().manual_seed(0)) - 0.5
    torch.testing.assert_close(informed(torch.cat([observations, told], 1)), start(observations))
    for part in informed.parameters():
        part.data += 0.1
    mirrored = informed(torch.cat([-observations, told], 1))
    torch.testing.assert_close(mirrored, -informed(torch.cat([observations, told], 1)))
    path = started(start, replace(start.spec, informed=True)).save(tmp_path / "policy", {})
    named, behind = (evaluate(name, "stabilize", 1, "rk4", randomization="unknown") for name in (path, "apg-adaptive"))
    assert named.cost_mean == pytest.approx(behind.cost_mean)
    with pytest.raises(PolicyError, match="informed"):
        export_onnx(path, tmp_path / "policy.onnx", make_task("stabilize"))
    with pytest.raises(ValueError, match="give --informed"):
        started(informed, start.spec)


def test_an_informed_policy_is_told_at_first_what_the_filter_knows_then_and_the_drawn_robot_afterwards(
    tmp_path, monkeypatch
):
    import torch

    task = make_task("stabilize")
    start = PolicyNetwork.load(shipped_policies(task)["apg"], task)
    informed = started(start, replace(start.spec, informed=True))
    for part in informed.parameters():
        part.data += 0.01
    firsts, episodes = [], fresh.draw(task, range(4), 3, randomization=TRACKS["unknown"])
    for policy in (informed, informed.save(tmp_path / "policy", {})):
        given = []
        monkeypatch.setattr(fresh, "run_episodes", lambda batch, act, *_, given=given, **__: given.extend([batch, act]))
        fresh.run_policy(policy, task, *episodes, randomization=TRACKS["unknown"], dtype=torch.float64)
        batch, act = given
        seen = batch.reset(seed=3)
        firsts.append(act(seen).detach().double().clamp(-1, 1))  # one of them may ask for more than the limit
        if policy is informed:
            drawn = batch.state.drawn[[Randomization.DRAWN.index(name) for name in ROBOT_FACTORS]].T
            as_drawn = [informed(torch.cat([seen, drawn], 1).float()) / drawn[:, -1:]]
            seen = batch.step(firsts[0]).observation
            as_drawn.append(informed(torch.cat([seen, drawn], 1).float()) / drawn[:, -1:])
            torch.testing.assert_close(act(seen).double(), as_drawn[1], rtol=1e-5, atol=1e-5)
            assert not torch.allclose(as_drawn[0], firsts[0], rtol=1e-3)
    torch.testing.assert_close(*firsts, rtol=1e-3, atol=1e-4)
