"""Optima of many episodes at once agree with those found one by one, and say where they are none."""

import contextlib
import math
import runpy
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("casadi")

from ballbot_baselines import Optimum, find_optima, find_optimum
from ballbot_baselines.optimum.batched import multistart, search_many
from ballbot_baselines.solvers.shooting import SAME_BARRIER, Backoff, Shooting
from ballbot_gym import certified, machine_code, ops
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_gym.tasks.orbit import Orbit
from ballbot_gym.tasks.paths import sides_passed
from ballbot_gym.tasks.stabilize import Stabilize

COUNT, ALONE = 12, 4  # drawn episodes, and how many of them are searched one by one too
NO_CONSTANTS = np.zeros(0)
FALLEN = np.array([0, 0, 1.3, 0, 0, 0, 5.0, 0])


class Eight(Orbit):
    """A task of a user: a figure eight, with no line of code for its optima."""

    id = "BallbotEight-v0"

    def cost(self, x, u, c):
        px, py, *_ = ops.components(x)
        return super().cost(x, u, c) + 0.5 * (px * py) * (px * py)


TASK_KINDS = (*TASKS.values(), Eight)


@dataclass(frozen=True)
class Drawn:
    """Fresh episodes of a task, with their optima found at once, and the costs of the first ones that are found alone."""

    task: object
    c: np.ndarray
    x0: np.ndarray
    optima: list[Optimum | None]
    costs: np.ndarray


@pytest.fixture(scope="module", params=TASK_KINDS, ids=lambda kind: kind.__name__)
def drawn(request, params):
    task, rng = request.param(), np.random.default_rng(3)
    x0, c = (np.array(part) for part in zip(*(task.sample(rng, params) for _ in range(COUNT)), strict=True))
    found = [find_optimum(task, params, *problem) for problem in zip(x0[:ALONE], c, strict=False)]
    costs = np.array([optimum.cost if optimum.is_optimal else math.nan for optimum in found])
    return Drawn(task, c, x0, find_optima(task, params, x0, c), costs)


@pytest.fixture(scope="module")
def optima(params):
    """Of Stabilize; the last robot has fallen."""
    rng = np.random.default_rng(3)
    x0 = np.array([*(Stabilize().sample(rng, params)[0] for _ in range(COUNT)), FALLEN])
    return find_optima(Stabilize(), params, x0, np.zeros((COUNT + 1, 0)))


def costs_of(optima):
    """Costs of B optima, NaN where there is none."""
    return np.array([math.nan if optimum is None else optimum.cost for optimum in optima])


def followed(task, params, x0, c, steps, feedback):
    """Cost of an episode from x0 (8,) under feedback(k, x), in the closed form, and its states."""
    x, cost, states = x0, 0.0, [x0]
    for k in range(steps):
        u = np.clip(feedback(k, x), -params.force_limit, params.force_limit)
        cost += task.control_dt * task.cost(x, u, c)
        x = params.step(x, u, task.control_dt, params.substeps(task.control_dt))
        states.append(x)
    return cost, np.array(states)


def tracking(optimum):
    states, forces, gains = optimum.trajectory.x, optimum.trajectory.u, optimum.gains
    return lambda k, x: forces[k] - gains[k] @ (x - states[k])


def test_they_cost_what_optima_one_by_one_cost_or_less(drawn):
    costs = costs_of(drawn.optima)
    assert np.isfinite(costs).mean() > 0.95
    excess = costs[:ALONE] / drawn.costs - 1
    excess = excess[np.isfinite(excess)]
    assert (excess < 1e-4).mean() > 0.9  # the others are other local optima
    assert excess.max() < 0.1


@pytest.mark.parametrize("name", TASKS)
def test_no_certified_optimum_costs_more(name, params):
    known, task = certified.load(name, "paper"), TASKS[name]()
    found = find_optima(task, params, known.states[::2], known.constants[::2])
    ratios = costs_of(found) / known.costs[::2]
    assert (ratios[np.isfinite(ratios)] > 1 - 1e-4).all()


@pytest.mark.parametrize("name", ["stabilize", "orbit"])
def test_they_keep_a_reserve_of_force(name, params):
    known, task = certified.load(name, "paper"), TASKS[name]()
    found = find_optima(task, params, known.states[:20], known.constants[:20], Backoff(force=0.06))
    assert np.isfinite(costs_of(found)).all()
    largest = max(np.abs(optimum.trajectory.u).max() for optimum in found if optimum is not None)
    assert largest == pytest.approx(0.94 * params.force_limit)


@pytest.mark.parametrize(("name", "episode"), [("stabilize", 79), ("turn", 37)])
def test_a_second_search_finds_what_the_first_one_misses(name, episode, params):
    known, task = certified.load(name, "paper"), TASKS[name]()
    once, twice = (
        find_optimum(task, params, known.states[episode], known.constants[episode], twice=twice)
        for twice in (False, True)
    )
    assert once.cost > 1.01 * twice.cost
    assert twice.is_optimal
    assert twice.cost == pytest.approx(known.costs[episode], rel=1e-6)


def test_from_another_solvers_optimum_no_search_ends_at_a_higher_cost(params):
    """Where its obstacles are touched differs from step to step, so that other optima are near."""
    known, task = certified.load("weave", "paper"), TASKS["weave"]()
    some = [0, 154]
    for i, found in zip(some, find_optima(task, params, known.states[some], known.constants[some]), strict=True):
        assert found is not None
        near = Shooting(task, params, known.states[i], known.constants[i], Backoff()).solve_to_the_end(
            found.trajectory.x, found.trajectory.u / params.force_limit, SAME_BARRIER
        )
        assert near[-1].cost <= found.cost * (1 + 1e-7)


def test_the_search_from_random_guesses_fails_where_a_stored_optimum_differs_in_its_fifth_digit(tmp_path, params):
    search = runpy.run_path(str(Path(__file__).parent.parent / "benchmarks" / "multistart.py"))["main"]
    options = {"tasks": ("turn",), "robots": ("paper",), "guesses": 4, "episodes": 2}
    search(**options, out=tmp_path / "stored")
    known, task = certified.load("turn", "paper"), TASKS["turn"]()
    for name, factor in (("higher", 1 + 1e-4), ("lower", 1 - 1e-4)):
        changed = replace(known, costs=np.concatenate([known.costs[:2] * factor, known.costs[2:]]))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(certified, "load", lambda *_, changed=changed: changed)
            with pytest.raises(SystemExit, match="1"):
                search(**options, out=tmp_path / name)
    assert [path.parent.name for path in tmp_path.rglob("*.npz")] == ["higher"]
    improved = certified.load(task, params, tmp_path / "higher" / certified.path_of(task).name)
    np.testing.assert_allclose(improved.costs, known.costs, rtol=1e-6)


def test_random_guesses_cost_no_more_and_depend_on_the_episode_alone(params):
    known, task = certified.load("weave", "paper"), TASKS["weave"]()
    x0, c = known.states[:3], known.constants[:3]
    more = costs_of(search_many(task, params, x0, c, Backoff(), slalom_guesses=8))
    assert (more <= costs_of(search_many(task, params, x0, c, Backoff()))).all()
    alone = search_many(task, params, x0[1:2], c[1:2], Backoff(), slalom_guesses=8)
    assert costs_of(alone)[0] == more[1]


def test_slaloms_pass_their_obstacles_on_the_sides_that_are_asked_for(params):
    """Also from the middle of an episode, where the sides of obstacles that are behind do not count."""
    known, task = certified.load("weave", "paper"), TASKS["weave"]()
    x0, c = known.states[:8], known.constants[:8]
    obstacles = [task.passed_obstacles(each) for each in c]
    best = find_optima(task, params, x0, c)
    sides = [sides_passed(optimum.trajectory.x, each) for optimum, each in zip(best, obstacles, strict=True)]
    np.testing.assert_array_equal(costs_of(find_optima(task, params, x0, c, sides=sides)), costs_of(best))
    others = [(-first, *rest) for first, *rest in sides]
    found = find_optima(task, params, x0, c, sides=others)
    solved = [i for i, optimum in enumerate(found) if optimum]
    assert len(solved) > 4  # some sides are no slalom that a robot could drive
    assert all(found[i].cost > best[i].cost for i in solved)
    assert all(sides_passed(found[i].trajectory.x, obstacles[i]) == others[i] for i in solved)
    middle = np.array([found[i].trajectory.x[60] for i in solved])
    again = find_optima(task, params, middle, c[solved], sides=[sides[i] for i in solved])
    for i, start, optimum in zip(solved, middle, again, strict=True):
        behind = obstacles[i][:, 0] < start[0]
        passed = np.array(sides_passed(optimum.trajectory.x, obstacles[i]))
        assert ((passed == sides[i]) | behind).all()


def test_sides_that_do_not_fit_are_refused(params):
    known, task = certified.load("weave", "paper"), TASKS["weave"]()
    x0, c = known.states[:1], known.constants[:1]
    for sides, said in (([], "1 slaloms"), ([(1,)], "slalom 0"), ([(0,) * 5], "slalom 0")):
        with pytest.raises(ValueError, match=said):
            find_optima(task, params, x0, c, sides=sides)
    with pytest.raises(ValueError, match="no obstacles"):
        find_optima(Stabilize(), params, FALLEN[None], np.zeros((1, 0)), sides=[(1,)])


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_random_guesses_reach_certified_optima_and_nothing_cheaper(name, params):
    known, task = certified.load(name, "paper"), TASKS[name]()
    found, costs = multistart(task, params, known.states[:8], known.constants[:8], 48)
    assert (costs_of(found) > known.costs[:8] * (1 - 1e-4)).all()
    assert ((costs / known.costs[:8]).min(axis=0) < 1 + 1e-3).mean() >= 0.75


def test_they_are_episodes_of_the_closed_form_that_obey_every_constraint(drawn, params):
    task, solved = drawn.task, [i for i, optimum in enumerate(drawn.optima) if optimum]
    for i in solved[:6]:
        optimum, c = drawn.optima[i], drawn.c[i]
        x, u = optimum.trajectory.x, optimum.trajectory.u
        assert optimum.is_optimal
        assert np.abs(u).max() <= params.force_limit
        cost, states = followed(task, params, x[0], c, len(u), tracking(optimum))
        assert cost == pytest.approx(optimum.cost, rel=1e-9)
        np.testing.assert_allclose(states, x, atol=1e-8)
        assert all(not task.violated(tuple(x), tuple(c)) for x in states[:-1])
        if task.first_exit:
            assert task.is_goal(tuple(states[-1]), tuple(c))
            assert not any(task.is_goal(tuple(x), tuple(c)) for x in states[:-1])


def test_the_feedback_is_optimal_nearby(optima, params, rng):
    optimum = next(filter(None, optima))
    x0 = optimum.trajectory.x[0] + rng.normal(scale=0.03, size=8)
    cost, _ = followed(Stabilize(), params, x0, NO_CONSTANTS, Stabilize().steps, tracking(optimum))
    assert cost < 1.01 * find_optimum(Stabilize(), params, x0, NO_CONSTANTS).cost


@pytest.mark.parametrize("alone", [False, True])
def test_slopes_are_those_of_the_cost_in_the_initial_state(optima, params, alone):
    optimum, step = next(filter(None, optima)), 1e-3
    x0 = optimum.trajectory.x[0]
    slopes = (find_optimum(Stabilize(), params, x0, NO_CONSTANTS) if alone else optimum).slopes[0]
    for direction in np.random.default_rng(0).normal(size=(3, 8)):
        costs = [find_optimum(Stabilize(), params, x0 + sign * step * direction, NO_CONSTANTS).cost for sign in (1, -1)]
        slope = (costs[0] - costs[1]) / (2 * step)
        assert slopes @ direction == pytest.approx(slope, rel=0.02, abs=0.02 * np.abs(slopes).max())


def test_what_falls_is_not_solved(optima, params):
    assert optima[COUNT] is None


@pytest.mark.parametrize("duration", [2.0, 3.4])
def test_short_episodes_do_not_count_what_comes_after(params, duration):
    task, rng = Stabilize(duration=duration), np.random.default_rng(5)
    x0 = np.array([task.sample(rng, params)[0] for _ in range(4)])
    found = find_optima(task, params, x0, np.zeros((4, 0)))
    costs = [find_optimum(task, params, x, NO_CONSTANTS).cost for x in x0]
    np.testing.assert_allclose(costs_of(found), costs, rtol=1e-4)


def test_without_a_compiler_they_are_found_one_by_one(monkeypatch, params, interpreted):
    task, x0 = Stabilize(max_tilt=1.3, duration=0.5), np.array([[0.1] + [0.0] * 7, FALLEN])

    def missing(*arguments):
        raise machine_code.NoMachineCodeError

    monkeypatch.setattr(machine_code, "library", missing)
    found, fallen = find_optima(task, params, x0, np.zeros((2, 0)))
    assert found.solver == "fatrop"
    assert found.cost == find_optimum(task, params, x0[0], NO_CONSTANTS).cost
    assert fallen is None


@pytest.mark.parametrize(
    ("x0", "c", "message"),
    [
        (np.zeros(8), np.zeros((1, 0)), r"x0 must have the shape \(B, 8\), not \(8,\)"),
        (np.zeros((2, 8)), np.zeros((1, 0)), r"c must have the shape \(2, 0\), not \(1, 0\)"),
    ],
)
def test_wrong_shapes_are_refused(x0, c, message, params):
    with pytest.raises(ValueError, match=message):
        find_optima(Stabilize(), params, x0, c)


def test_no_episodes_are_no_error(params):
    assert find_optima(Stabilize(), params, np.zeros((0, 8)), np.zeros((0, 0))) == []


def test_an_optimum_does_not_depend_on_the_others(drawn, params):
    some = [10, 3, 8, 7, 1]
    found = find_optima(drawn.task, params, drawn.x0[some], drawn.c[some])
    for i, mine in zip(some, found, strict=True):
        other = drawn.optima[i]
        assert (mine is None) == (other is None)
        if mine is not None:
            assert mine.cost == other.cost
            for name in ("slopes", "gains"):
                np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), err_msg=name)
            np.testing.assert_array_equal(mine.trajectory.x, other.trajectory.x)
            np.testing.assert_array_equal(mine.trajectory.u, other.trajectory.u)


def test_threads_do_not_disturb_each_other(optima, params):
    starts = np.array([optimum.trajectory.x[0] for optimum in optima if optimum])[:8]
    costs = costs_of([optimum for optimum in optima if optimum][:8])
    with ThreadPoolExecutor(2) as threads:
        found = threads.map(lambda x0: find_optima(Stabilize(), params, x0, np.zeros((4, 0))), (starts[:4], starts[4:]))
    np.testing.assert_array_equal(np.concatenate([costs_of(part) for part in found]), costs)


def test_diverging_iterations_warn_of_nothing(params):
    """A robot that falls overflows whatever simulates it, and that is no news to the user."""
    task = Stabilize(duration=1.0)
    x0 = np.array([FALLEN, [0, 0, 1.2, 1.2, 40.0, -40.0, 9.0, 9.0], [9, -9, 0.6, -0.6, 60.0, 60.0, 3.0, -3.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        find_optima(task, params, x0, np.zeros((3, 0)))
        with contextlib.suppress(PlanError):
            find_optimum(task, params, x0[0], NO_CONSTANTS, twice=True)
