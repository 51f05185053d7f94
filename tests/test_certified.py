import math
from dataclasses import replace

import numpy as np
import pytest

from ballbot_gym import certified, tasks
from ballbot_gym.certified import version
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, ROBOTS, TRACKS, Randomization, default_params, named_robot
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.identity import digest, problem_digest
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_train.evaluation.results import Result, leaderboard, read_results, write_results
from ballbot_train.evaluation.submissions import read_entries

SHIPPED = [(robot, name) for robot in ROBOTS for name in TASKS if not (robot.startswith("omni") and name == "weave")]
"""Robots and tasks whose sets come with the package."""


@pytest.fixture(params=SHIPPED, ids="-".join)
def robot_and_task(request):
    return request.param


@pytest.fixture
def robot(robot_and_task):
    return robot_and_task[0]


@pytest.fixture
def params(robot):
    return named_robot(robot)


@pytest.fixture
def task(robot_and_task, robot):
    return make_task(robot_and_task[1], robot)


@pytest.fixture
def evaluation(task, robot):
    return certified.load(task, robot)


def test_set_has_200_episodes_and_20_trajectories(evaluation):
    assert len(evaluation) == certified.EPISODES == 200
    wheels = evaluation.states.shape[1] > 8
    assert len(evaluation.trajectories) == (5 if wheels else certified.TRAJECTORIES)
    assert certified.TRAJECTORIES == 20
    for name in ("states", "constants", "durations", "violations", "statuses"):
        assert len(getattr(evaluation, name)) == 200


def test_episodes_are_the_tasks_own_and_all_different(task, evaluation, params):
    for i in (0, 1, 199):  # a start that has no optimum is drawn again
        drawn = (np.concatenate(certified.cache.episode(task, params, i, draw)) for draw in range(20))
        start = np.concatenate([evaluation.states[i], evaluation.constants[i]])
        assert any(np.array_equal(start, each) for each in drawn)
    assert len({(*x, *c) for x, c in zip(evaluation.states, evaluation.constants, strict=True)}) == 200


def test_every_episode_can_be_started_and_is_certified(task, evaluation, params, make_env):
    env = make_env(task, robot=params, physics="rk4")
    for i in range(len(evaluation)):
        _, info = env.reset(seed=0, options=evaluation.options(i))
        np.testing.assert_array_equal(info["state"], evaluation.states[i])
    assert evaluation.violations.max() < 1e-6
    assert all("Solve_Succeeded" in status for status in evaluation.statuses)
    assert (evaluation.costs > 0).all()
    assert (evaluation.costs < task.survival_pay).all()
    assert (evaluation.durations <= task.duration + 1e-9).all()


def test_each_stored_state_follows_from_the_one_before(task, evaluation, params):
    for trajectory in evaluation.trajectories:
        after = params.step(trajectory.x[:-1], trajectory.u, task.control_dt)
        np.testing.assert_allclose(after, trajectory.x[1:], atol=1e-6)


def test_stored_trajectories_are_feasible_and_cost_what_is_stored(task, evaluation, params):
    for i, trajectory in enumerate(evaluation.trajectories):
        c = evaluation.constants[i]
        np.testing.assert_array_equal(trajectory.x[0], evaluation.states[i])
        assert trajectory.duration == pytest.approx(evaluation.durations[i])
        cost = task.cost(trajectory.x[:-1], trajectory.u, c).sum() * task.control_dt
        assert evaluation.costs[i] == pytest.approx(cost, rel=1e-9)
        assert np.abs(trajectory.u).max() <= params.force_limit
        assert min(np.min(margin) for margin in task.margins(trajectory.x, c)) >= 0
        grip = params.limits(trajectory.x[:-1], trajectory.u, hold=task.control_dt)
        assert all(limit.min() > -1e-6 for limit in grip)
        if task.first_exit:
            assert task.is_goal(tuple(trajectory.x[-1]), tuple(c))


@pytest.mark.parametrize(
    "robot_and_task",
    [
        pytest.param(each, id="-".join(each), marks=[] if each[0] == PAPER else pytest.mark.slow)  # it compiles
        for each in SHIPPED
    ],
    indirect=True,
)
def test_solving_again_from_another_guess_finds_nothing_cheaper(task, evaluation, params):
    """And the same, but for a slalom whose floor slips: its narrow passages have dearer local optima too."""
    pytest.importorskip("casadi")
    from ballbot_baselines import find_optimum

    for i in (0, 4):
        path = evaluation.trajectories[i].x[:, :2]
        s = np.linspace(0, np.pi, len(path))
        detour = path + 0.15 * np.column_stack([np.sin(2 * s), -np.sin(s)])
        again = find_optimum(task, params, evaluation.states[i], evaluation.constants[i], paths=[detour])
        assert again.cost >= (1 - 1e-4) * evaluation.costs[i]
        if not (task.id.startswith("BallbotWeave") and params.grips):
            assert again.cost == pytest.approx(evaluation.costs[i], rel=1e-4)


def test_set_survives_saving(task, robot, evaluation, tmp_path):
    loaded = certified.load(task, robot, evaluation.save(task, tmp_path / "set.npz", robot))
    np.testing.assert_array_equal(loaded.costs, evaluation.costs)
    np.testing.assert_array_equal(loaded.statuses, evaluation.statuses)
    for a, b in zip(loaded.trajectories, evaluation.trajectories, strict=True):
        np.testing.assert_array_equal(a.x, b.x)
        np.testing.assert_array_equal(a.u, b.u)


class Nearer(Stabilize):
    """Another problem under its parent's id."""


class Dearer(Stabilize):
    """Another cost under its parent's id, name and fields."""

    def cost(self, x, u, c):
        return 2 * super().cost(x, u, c)


Dearer.__name__ = "Stabilize"

ROLLING = named_robot("rolling")
OTHERS = {
    "half the mass": ("stabilize", replace(default_params(), body_mass=7.5), "--tasks stabilize --robot NAME"),
    "more mass": ("stabilize", replace(default_params(), body_mass=20.0), "--tasks stabilize --robot NAME"),
    "less force": ("orbit", replace(default_params(), force_limit=300.0), "--tasks orbit --robot NAME"),
    "the moon": ("turn", replace(default_params(), gravity=1.62), "--tasks turn --robot NAME"),
    "a smoother floor": ("turn", replace(ROLLING, friction=0.6), "--tasks turn --robot NAME"),
    "a floor without limit": ("turn", replace(ROLLING, friction=math.inf), "--tasks turn --robot NAME"),
    "control steps": (make_task("turn", control_dt=0.01), PAPER, "--tasks turn --robot NAME"),
    "a weight": (make_task("turn", effort_weight=1e-3), PAPER, "--tasks turn --robot NAME"),
    "draws": (make_task("stabilize", start_position=1.0), PAPER, "--tasks stabilize --robot NAME"),
    "draws of another robot": (make_task("orbit", "rolling"), PAPER, "--tasks orbit --robot NAME"),
    "a subclass": (Nearer(), PAPER, "--tasks NAME"),
    "a subclass of the same name": (Dearer(), PAPER, "--tasks NAME"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_set_is_of_one_problem_and_one_robot(name):
    task, robot, options = OTHERS[name]
    with pytest.raises(certified.CertificateError, match=f'"ballbot certify {options}"'):
        certified.load(task, robot)


def test_all_sets_together_are_under_8_megabytes():
    assert sum(certified.path_of(make_task(task, robot), robot).stat().st_size for robot, task in SHIPPED) < 8e6


@pytest.mark.parametrize(
    ("track", "name", "robot"),
    [
        *((track, name, PAPER) for track in ("unknown", "late", "real") for name in TASKS),
        *(("unknown", name, "rolling") for name in ("stabilize", "turn", "orbit")),
    ],
)
def test_optimum_of_a_track_is_that_of_the_episodes_own_robot_and_delay(track, name, robot, make_env):
    """The env moves as the optimum does, until the robot, which is unstable, makes rounding show; the first forces are none
    while none can come.
    """
    task, randomization = make_task(name, robot), TRACKS[track]
    evaluation = certified.load(task, robot, randomization=randomization)
    assert len(evaluation) == 200
    env = make_env(task, physics="rk4", robot=robot, randomization=randomization)
    for i, trajectory in enumerate(evaluation.trajectories):
        _, info = env.reset(seed=0, options=evaluation.options(i))
        np.testing.assert_array_equal(info["drawn"], evaluation.drawn[i])
        delay = round(evaluation.drawn[i, 5])
        assert not trajectory.u[:delay].any()
        for force, after in zip(trajectory.u[delay:25], trajectory.x[1:], strict=False):
            info = env.step(force / env.episode_params.force_limit)[4]
            np.testing.assert_allclose(info["state"], after, atol=1e-4)
        cost = task.cost(trajectory.x[:-1], trajectory.u, evaluation.constants[i]).sum() * task.control_dt
        assert cost == pytest.approx(evaluation.costs[i], rel=1e-9)
        assert np.abs(trajectory.u).max() <= env.episode_params.force_limit
        assert evaluation.ideal[i] <= evaluation.costs[i] * (1 + 1e-6)
        assert (evaluation.ideal[i] == evaluation.costs[i]) == (delay == 0)


def test_no_optimum_is_known_where_the_actuator_lags_or_nobody_named_the_randomization():
    with pytest.raises(certified.CertificateError, match="leave actuator_lag out"):
        certified.load("stabilize", PAPER, randomization=Randomization(actuator_lag=(0.0, 0.02)))
    with pytest.raises(certified.CertificateError, match="not in TRACKS"):
        certified.load("stabilize", PAPER, randomization=Randomization(body_mass=(0.9, 1.0)))


def test_the_version_of_the_benchmark_is_raised_when_episodes_costs_observations_or_optima_change():
    """If this fails, raise BENCHMARK, put the new digest here, certify the sets, and measure and verify the rows again."""
    robot, parts = named_robot(PAPER), []
    for kind in tasks.SHIPPED:
        known = certified.load(kind.id, PAPER)
        numbers = [*known.states.ravel(), *known.constants.ravel(), *known.costs]
        parts.append([problem_digest(make_task(kind.id, PAPER), robot), [f"{value:.9g}" for value in numbers]])
    assert (version.BENCHMARK, digest(parts)) == ("2", "3156b23f6850facd7c641c64")


def test_what_is_of_another_version_of_the_benchmark_is_refused(tmp_path, monkeypatch):
    known, task = certified.load("stabilize", PAPER), make_task("stabilize", PAPER)
    path = known.save(task, tmp_path / "set.npz", PAPER)
    assert certified.load("stabilize", PAPER, path).costs[0] == known.costs[0]
    result = Result("stabilize", "lqr", 0, "rk4", 1.0, 1.0, True, False)
    write_results(leaderboard([result]), [result], {}, tmp_path)
    assert read_results(tmp_path)[0]["benchmark"] == "2"
    assert {entry.benchmark for entry in read_entries()} == {"2"}
    monkeypatch.setattr(version, "BENCHMARK", "3")
    certified.load.__globals__["_read"].cache_clear()
    for read in (lambda: certified.load("stabilize", PAPER, path), lambda: read_results(tmp_path), read_entries):
        with pytest.raises(ValueError, match="is of version '2' of the benchmark, and this is version 3"):
            read()
