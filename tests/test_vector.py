import logging
import math
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

pytest.importorskip("torch")

import torch

from ballbot_gym import seeding
from ballbot_gym.robot import default_params
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.turn import Turn
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector import batch as batch_module
from ballbot_gym.vector.batch import BallbotBatch
from ballbot_gym.vector.episodes import run_episodes
from ballbot_gym.vector.native import BallbotNative

INFO = (
    *("state", "cost", "reward_survive", "reward_cost", "reward_goal", "tilt", "success", "is_success", "failure"),
    *("violated", "constraint_cost", "force", "clipped", "constants"),
)


@pytest.fixture(params=["native", "torch"])
def make_vec(request):
    """Makes vector envs that are closed after the test; float64 and eager unless said otherwise."""
    envs = []

    def make(num_envs, task="stabilize", dtype=torch.float64, compile=False, **kwargs):
        kwargs.setdefault("engine", request.param)
        envs.append(BallbotVectorEnv(num_envs, task, dtype=dtype, compile=compile, **kwargs))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


def column(infos, i):
    """The info of env i, with everything it holds marked by its mask."""
    assert all(infos[f"_{key}"][i] for key in INFO)
    return {key: infos[key][i] for key in INFO}


def assert_same_info(got, expected, tolerance):
    for key in INFO:
        np.testing.assert_allclose(got[key], expected[key], rtol=tolerance, atol=tolerance, err_msg=key)


def test_episodes_of_a_policy_carry_no_gradient():
    task = TASKS["stabilize"](duration=0.1)
    weights = torch.zeros(8, 2, requires_grad=True)
    run = run_episodes(
        BallbotBatch(task, 2, compile=False),
        lambda seen: seen @ weights,
        np.zeros((2, 8)),
        np.zeros((2, 0)),
        margins=True,
    )
    assert not run.cost.requires_grad
    assert run.success.all()
    assert run.steps.tolist() == [5, 5]
    assert run.margin.numpy() == pytest.approx(1 - np.cos(task.max_tilt), abs=1e-6)  # upright


def test_episodes_of_a_policy_in_machine_code_are_those_in_torch(task, rng):
    """Some end at the goal or at a limit; then the robot begins again, and what it does does not count any more."""
    task = replace(task, duration=0.5)
    params = default_params()
    starts = [task.sample(np.random.default_rng(seed), params) for seed in range(8)]
    x, c = (np.array(part, float).reshape(8, -1) for part in zip(*starts, strict=True))
    weights = torch.from_numpy(rng.normal(size=(task.observation_size(params), 2)).astype(np.float32))
    runs = [
        run_episodes(batch, lambda seen: (3 * seen.float() @ weights).clamp(-1, 1), x, c, margins=True)
        for batch in (
            BallbotBatch(task, 8, compile=False, dtype=torch.float64),
            BallbotNative(task, 8, np.float64, params),
        )
    ]
    for name, ours, theirs in zip(runs[0]._fields, *runs, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6, err_msg=name)


def test_batch_follows_single_envs_step_for_step_over_the_ends_of_episodes(task, make_vec, make_env, rng):
    """Actuated in the same way, in float64 they differ by the last digits of sine and cosine, which an unstable robot
    multiplies by up to e^(7.8 · 0.5) here.
    """
    duration = 0.5
    vec = make_vec(4, task.id.removeprefix("Ballbot").removesuffix("-v0").lower(), duration=duration)
    singles = [make_env(type(task)(duration=duration), physics="rk4") for _ in range(4)]
    observations, infos = vec.reset(seed=1)
    ends = 0
    for i, env in enumerate(singles):
        observation, info = env.reset(options={"state": infos["state"][i], "constants": infos["constants"][i]})
        np.testing.assert_allclose(observations[i], observation, rtol=1e-6, atol=1e-12)
        assert_same_info(column(infos, i), info, 1e-12)
    for _ in range(60):
        actions = rng.uniform(-1, 1, (4, 2)) * [[0.05], [0.05], [1.2], [1.2]]
        observations, rewards, terminations, truncations, infos = vec.step(actions)
        for i, env in enumerate(singles):
            observation, reward, terminated, truncated, info = env.step(actions[i])
            assert (terminations[i], truncations[i]) == (terminated, truncated)
            assert rewards[i] == pytest.approx(reward, rel=1e-11)
            if terminated or truncated:
                ends += 1
                np.testing.assert_allclose(infos["final_obs"][i], observation, rtol=1e-6, atol=1e-6)
                assert_same_info(column(infos["final_info"], i), info, 1e-11)
                start = {"state": infos["state"][i], "constants": infos["constants"][i]}
                observation, info = env.reset(options=start)
            np.testing.assert_allclose(observations[i], observation, rtol=1e-6, atol=1e-6)  # float32, as the spaces are
            assert_same_info(column(infos, i), info, 1e-11)
    assert ends >= 8


def test_reaching_turns_goal_ends_the_episode_as_a_success_without_further_cost(make_vec):
    vec = make_vec(2, "turn")
    gate = np.array([0.98, 0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    vec.reset(seed=0, options={"state": gate, "constants": {"speed": [3.0, 5.0]}})
    _, rewards, terminations, truncations, infos = vec.step(np.zeros((2, 2)))
    assert terminations.tolist() == [True, False]
    assert not truncations.any()
    assert infos["final_info"]["success"].tolist() == [True, False]
    assert not infos["final_info"]["failure"].any()
    cost = vec.task.cost(tuple(gate), (0.0, 0.0), (3.0,)) * 0.02
    assert infos["final_info"]["cost"][0] == pytest.approx(cost)
    assert rewards[0] == pytest.approx(vec.task.survival_pay - cost)


def test_make_vec_gives_the_batched_env_with_the_spaces_of_the_single_one(task):
    vec = gymnasium.make_vec(task.id, num_envs=3)
    single = gymnasium.make(task.id, physics="rk4")
    assert isinstance(vec, BallbotVectorEnv)
    assert vec.spec.id == task.id
    assert vec.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert vec.single_observation_space == single.observation_space
    assert vec.single_action_space == single.action_space
    observations, _ = vec.reset(seed=0)
    assert observations in vec.observation_space
    observations, rewards, terminations, truncations, _ = vec.step(vec.action_space.sample())
    assert observations in vec.observation_space
    assert [a.dtype for a in (rewards, terminations, truncations)] == [np.float64, np.bool_, np.bool_]
    assert {a.shape for a in (rewards, terminations, truncations)} == {(3,)}
    vec.close()
    single.close()


@pytest.mark.parametrize(
    "keywords", [{"duration": 2.0}, {"max_episode_steps": 30}, {"task": Turn(duration=4.0)}], ids=str
)
def test_the_spec_of_vector_envs_makes_the_same_ones_again_also_from_json(keywords):
    settings = {"dtype": torch.float64, "device": torch.device("cpu"), "autoreset_mode": AutoresetMode.NEXT_STEP}
    vec = gymnasium.make_vec("BallbotStabilize-v0", num_envs=3, **settings, **keywords)
    for spec in (vec.spec, EnvSpec.from_json(vec.spec.to_json())):
        again = gymnasium.make_vec(spec)
        assert again.spec == vec.spec
        assert (again.num_envs, again.task, again.autoreset_mode) == (3, vec.task, AutoresetMode.NEXT_STEP)
        assert again.reset()[1]["state"].dtype == np.float64
        again.close()
    vec.close()


def test_only_masked_envs_are_reset(make_vec):
    vec = make_vec(3)
    vec.reset(seed=0)
    before, *_ = vec.step(np.zeros((3, 2)))
    mask = np.array([False, True, False])
    after, infos = vec.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal((before == after).all(1), ~mask)
    np.testing.assert_array_equal(infos["_state"], mask)
    assert vec.batch.state.steps.tolist() == [1, 0, 1]
    again, _ = vec.reset(seed=[None, 1, None], options={"reset_mask": mask})
    np.testing.assert_array_equal(again[1], vec.reset(seed=0)[0][1])


def test_bad_start_is_refused_and_changes_nothing(make_vec):
    vec = make_vec(2, "orbit")
    vec.reset(seed=0)
    before = vec.batch.state
    for options, message in (
        ({"state": np.array([np.zeros(8), [0, 0, 1.5, 0, 0, 0, 0, 0]])}, r"envs \[1\] violate limits"),
        ({"constants": {"tempo": 1.0}}, "no constants"),
        ({"constants": [[0.5, 1.0], [2.0, 1.0]]}, "radius must exceed"),
    ):
        with pytest.raises(ValueError, match=message):
            vec.reset(seed=5, options=options)
    for now, then in zip(vec.batch.state, before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_steps_before_reset_and_after_close_and_bad_actions_are_refused(make_vec):
    vec = make_vec(2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vec.step(np.zeros((2, 2)))
    vec.reset()
    with pytest.raises(ValueError, match="shape"):
        vec.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"envs \[1\]"):
        vec.step(np.array([[0, 0], [0, np.nan]]))
    for seed in ([1], [-1, 2]):
        with pytest.raises(ValueError, match="seed"):
            vec.reset(seed=seed)
    vec.close()
    for use in (vec.reset, lambda: vec.step(np.zeros((2, 2)))):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            use()


def test_every_env_is_drawn(make_vec):
    vec = make_vec(2, "weave", render_mode="rgb_array")
    vec.reset(seed=0)
    images = vec.render()
    assert len(images) == 2
    assert images[0].shape[2] == 3
    assert (images[0] != images[1]).any()


def play(batch, actions, first=0):
    """Everything that steps return, for actions (n, B, 2)."""
    batch.reset(seed=first)
    results = [batch.step(a) for a in actions]
    return [torch.stack([getattr(r, name) for r in results]) for name in ("observation", "reward", "terminated")]


def test_results_depend_neither_on_batch_size_nor_on_position(task):
    name = next(name for name, kind in TASKS.items() if isinstance(task, kind))
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(12, 37, 2, generator=generator) * 2 - 1
    whole = play(BallbotBatch(name, 37, compile=False, duration=0.16), actions)
    for first, count in ((0, 1), (3, 16), (19, 18), (36, 1)):
        part = play(BallbotBatch(name, count, compile=False, duration=0.16), actions[:, first : first + count], first)
        for a, b in zip(part, whole, strict=True):
            assert torch.equal(a, b[:, first : first + count])


def test_seed_repeats_everything_and_without_one_the_next_episodes_come():
    batch = BallbotBatch("weave", 5, compile=False)
    first = batch.reset(seed=3)
    second = batch.reset()
    assert (first != second).any(dim=1).all()
    assert torch.equal(batch.reset(seed=[3, 4, 5, 6, 7]), first)
    assert torch.equal(batch.reset(), second)
    other = BallbotBatch("weave", 5, compile=False)
    assert (other.reset() != BallbotBatch("weave", 5, compile=False).reset()).any()


def test_hashed_numbers_are_uniform_and_uncorrelated():
    n = 20_000
    seed = torch.arange(n)
    z = torch.stack(seeding.uniforms(seeding.key(seed, 0 * seed, 0 * seed), 8, torch.float64))
    later = torch.stack(seeding.uniforms(seeding.key(seed, 0 * seed + 1, 0 * seed), 8, torch.float64))
    assert z.min() >= 0
    assert z.max() < 1
    counts = torch.stack([torch.histc(row, 100, 0, 1) for row in z])
    chi2 = ((counts - n / 100) ** 2 / (n / 100)).sum(1)
    assert ((chi2 > 99 - 5 * 14.1) & (chi2 < 99 + 5 * 14.1)).all()  # 99 ± five standard deviations
    both = torch.corrcoef(torch.cat([z, later, z[:, torch.roll(seed, 1)]]))
    assert (both - torch.eye(24)).abs().max() < 5 / math.sqrt(n)
    assert len(seeding._mix(torch.arange(2**16)).unique()) == 2**16


def rollout_cost(batch, x0, gain, forces):
    """(B,) cost from x0 (8,) under u = −Kx + forces (n, B, 2) N."""
    limit = batch.params.force_limit
    batch.reset(x=x0[:, None].expand(8, batch.num_envs))
    cost = torch.zeros(batch.num_envs, dtype=torch.float64)
    for added in forces:
        action = (added - batch.state.x.T @ gain.T) / limit
        assert action.abs().max() < 1  # a clipped force would have no gradient
        result = batch.step(action)
        cost = cost + result.cost
    return cost


def casadi_gradient(task, params, x0, gain, forces):
    """d cost / d forces (n, 2) of the same rollout, by CasADi's reverse mode."""
    casadi = pytest.importorskip("casadi")
    x, w = casadi.SX.sym("x", 8), casadi.SX.sym("w", 2)
    u = w - casadi.DM(gain.numpy()) @ x
    step = casadi.Function(
        "step",
        [x, w],
        [params.step(x, u, task.control_dt), task.cost(x, u, casadi.SX(0, 1)) * task.control_dt],
    )
    w_all = casadi.MX.sym("w", 2, len(forces))
    _, costs = step.mapaccum(len(forces))(casadi.DM(x0.numpy()), w_all)
    gradient = casadi.Function("gradient", [w_all], [casadi.gradient(casadi.sum2(costs), w_all)])
    return np.array(gradient(forces.numpy().T)).T


@pytest.mark.parametrize(("steps", "feedback"), [(75, True), (25, False)], ids=["1.5 s under LQR", "0.5 s open loop"])
def test_gradient_of_the_cost_agrees_with_finite_differences_and_casadi(steps, feedback, params):
    lqr = pytest.importorskip("ballbot_baselines.solvers.riccati")
    batch = BallbotBatch("stabilize", 1, dtype=torch.float64, compile=False)
    gain = lqr.discrete_lqr(batch.task, params, np.zeros(8), np.zeros(2), np.zeros(0))[0] * feedback
    gain = torch.from_numpy(gain)
    x0 = torch.tensor([-1.0, 0.5, 0.1, -0.1, 0.2, 0.5, 0.0, 0.1], dtype=torch.float64)
    forces = torch.from_numpy(np.random.default_rng(0).normal(0, 2, (steps, 2)))

    leaf = forces.clone().requires_grad_()
    cost = rollout_cost(batch, x0, gain, leaf[:, None])
    (gradient,) = torch.autograd.grad(cost.sum(), leaf)

    # central differences in all 2n forces at once, each pair of perturbed rollouts in one batch
    count, eps = 2 * steps, 1e-3
    nudges = eps * torch.eye(count, dtype=torch.float64).reshape(count, steps, 2).transpose(0, 1)
    wide = BallbotBatch("stabilize", 2 * count, dtype=torch.float64, compile=False)
    with torch.no_grad():
        costs = rollout_cost(wide, x0, gain, forces[:, None] + torch.cat([nudges, -nudges], dim=1))
    differences = ((costs[:count] - costs[count:]) / (2 * eps)).reshape(steps, 2)

    scale = gradient.abs().max()
    assert (gradient - differences).abs().max() < 1e-4 * scale
    assert (gradient - differences).norm() < 1e-4 * differences.norm()
    exact = casadi_gradient(batch.task, params, x0, gain, forces)
    np.testing.assert_allclose(gradient, exact, rtol=1e-8, atol=1e-9 * scale.item())


def test_gradient_ends_with_the_episode():
    batch = BallbotBatch("stabilize", 2, dtype=torch.float64, compile=False, duration=0.04)
    batch.reset(seed=0)
    action = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    batch.step(action)
    within = batch.step(torch.zeros(2, 2)).reward.sum()
    beyond = batch.step(torch.zeros(2, 2)).reward.sum()
    assert torch.autograd.grad(within, action, retain_graph=True)[0].abs().min() > 0
    assert (torch.autograd.grad(beyond, action, allow_unused=True)[0] == 0).all()


ONE_STEP = {"duration": 0.1, "control_dt": 0.01}  # one RK4 step: two in a row compile twice as long
needs_compiler = pytest.mark.skipif(not batch_module._has_compiler(torch.device("cpu")), reason="no C++ compiler")


@pytest.mark.slow
@needs_compiler
def test_compiled_batch_agrees_with_eager_to_rounding_and_with_itself_bitwise_wherever_an_env_stands():
    """37 envs fill vector registers and leave a remainder, and turning the order round moves each elsewhere."""
    actions = torch.rand(30, 37, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    compiled, uncompiled = (BallbotBatch("stabilize", 37, compile=compile, **ONE_STEP) for compile in (True, False))
    with torch.no_grad():
        results, eager = (play(batch, actions, range(37)) for batch in (compiled, uncompiled))
        assert compiled.compiled
        turned = play(compiled, actions.flip(1), range(36, -1, -1))
        last, last_eager = compiled.step(actions[0]), uncompiled.step(actions[0])
    for a, b, c in zip(results, eager, turned, strict=True):
        assert torch.equal(c.flip(1), a)
        # 10 steps to an end, over which rounding grows by e^(7.8 · 0.1)
        torch.testing.assert_close(a, b, rtol=5e-5, atol=5e-5)
    for name in last._fields:
        a, b = getattr(last, name), getattr(last_eager, name)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name


def test_without_a_working_compiler_auto_falls_back_with_a_word_in_the_log(monkeypatch, caplog):
    def broken(*args, **kwargs):
        def run(*args):
            raise RuntimeError("no such compiler")

        return run

    monkeypatch.setattr(torch, "compile", broken)
    monkeypatch.setattr(batch_module, "COMPILE_FROM", 4)
    monkeypatch.setattr(batch_module, "_has_compiler", lambda device: True)
    with caplog.at_level(logging.WARNING):
        batch = BallbotBatch("stabilize", 4)
        batch.reset(seed=0)
        batch.step(torch.zeros(4, 2))
        batch.step(torch.zeros(4, 2))
    assert [record.name for record in caplog.records] == ["ballbot_gym.vector.batch"]
    assert "no such compiler" in caplog.text
    assert not batch.compiled
    must = BallbotBatch("stabilize", 4, compile=True)
    must.reset(seed=0)
    with pytest.raises(RuntimeError, match="no such compiler"):
        must.step(torch.zeros(4, 2))


@pytest.mark.parametrize("component", [0, 1, 2])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_component_of_an_action_in_a_vector_may_be_other_than_finite(bad, component, make_vec):
    actions = np.array([[0.5, 0.5, 0.5]] * 2)
    actions[1, component] = bad
    for kind in (np.float32, np.float64):
        envs = make_vec(2, robot="omni", dtype=torch.float32)
        envs.reset(seed=0)
        with pytest.raises(ValueError, match=r"finite; those of envs \[1\]"):
            envs.step(actions.astype(kind))
    batch = BallbotBatch("stabilize", 2, robot="omni", compile=False)
    batch.reset(seed=0)
    held = batch.state
    with pytest.raises(ValueError, match=r"finite; those of envs \[1\]"):
        batch.step(torch.as_tensor(actions))
    assert batch.state is held
