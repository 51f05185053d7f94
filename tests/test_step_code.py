"""Machine code of single environments: it changes speed, and nothing else."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ballbot_gym import TASKS, BallbotEnv, Randomization, machine_code, ops
from ballbot_gym.engines.closed_form import Rk4Simulator
from ballbot_gym.machine_code import libraries, step_code, traced
from ballbot_gym.robot import tilt
from ballbot_gym.step import outcome
from ballbot_gym.tasks import Stabilize

needs_compiler = pytest.mark.skipif(machine_code.compiler() is None, reason="no C compiler")

EVERYTHING = Randomization(
    body_mass=(0.8, 1.2),
    com_height=(0.9, 1.1),
    inertia=(0.8, 1.2),
    actuator_lag=(0.01, 0.03),
    actuator_delay=(0.0, 0.04),
    lean_noise=0.01,
    push_impulse=(0.5, 2.0),
)


@pytest.fixture(autouse=True)
def nothing_made(monkeypatch):
    """Forgets all machine code, and what is made in a test afterwards."""
    monkeypatch.setattr(step_code, "_codes", {})


def begin_second_episode(env: BallbotEnv) -> None:
    """From there on an env has machine code, if it can have some."""
    env.reset()
    env.reset()


def play(env: BallbotEnv, steps: int = 120) -> list:
    """What steps with random actions, some of them clipped, give from seed 0 on, with the starts of new episodes."""
    rng = np.random.default_rng(0)
    given: list[Any] = [env.reset(seed=0)]
    for action in rng.uniform(-1.1, 1.1, (steps, 2)).astype(np.float32):
        given.append(env.step(action))
        if given[-1][2] or given[-1][3]:
            given.append(env.reset())
    return given


def bits(given: list) -> list:
    """The same with the bits of all numbers and the types of everything."""

    def of(part):
        if isinstance(part, np.ndarray):
            return part.dtype, part.shape, part.tobytes()
        if isinstance(part, dict):
            return [(key, of(value)) for key, value in part.items()]
        return type(part), part.hex() if isinstance(part, float) else part

    return [[of(part) for part in row] for row in given]


@needs_compiler
@pytest.mark.parametrize(
    ("physics", "robot", "randomization"),
    [("rk4", "paper", None), ("rk4", "rolling", EVERYTHING), ("bullet", "paper", EVERYTHING)],
    ids=["closed form", "rolling and randomized", "bullet and randomized"],
)
@pytest.mark.parametrize("task", TASKS)
def test_machine_code_gives_the_bits_of_python(task, physics, robot, randomization, monkeypatch):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    env: Any = BallbotEnv(task, physics, robot=robot, randomization=randomization)
    with monkeypatch.context() as patch:
        patch.setattr(libraries, "compiler", lambda: None)
        python = bits(play(env))
        assert env._judge is None
    step_code._codes.clear()
    begin_second_episode(env)
    assert env._judge is not None
    assert physics == "bullet" or env._simulator._code is not None
    assert bits(play(env)) == python


@needs_compiler
@pytest.mark.parametrize("task", TASKS)
def test_goals_limits_and_ends_are_those_of_python(task):
    """Random actions reach no goal, so states are put near it."""
    env: Any = BallbotEnv(task, "rk4")
    begin_second_episode(env)
    assert env._judge is not None
    rng, ends = np.random.default_rng(0), set()
    for i in range(100):
        x, c = env.task.sample(rng, env.params)
        reference = env.task.reference(x, c, env.params).x
        before, after = (tuple((reference[-1] + rng.normal(0, (0.05, 0.5)[i % 2], 8)).tolist()) for _ in range(2))
        c, force = tuple(c.tolist()), tuple(rng.uniform(-50, 50, 2).tolist())
        env._judge.c[:] = c
        steps, kept = env.task.steps - (i % 3 > 0), (0.0, -1.0)[i % 7 == 0]
        did = outcome(env.task, before, force, after, c, steps, (kept,))
        assert env._judge.judge(before, force, after, steps, kept) == (*did, tilt(after))
        assert env._judge.seen.tolist() == list(env.task.observe(after, c))
        ends.add(did.success)
    assert ends == {1.0, 0.0}


@needs_compiler
def test_numbers_that_are_not_finite_are_left_to_python(params):
    simulator: Any = Rk4Simulator(params, 0.02)
    simulator.use_code()
    judge: Any = step_code.judge(Stabilize(), params)
    good, bad = (0.1,) * 8, (0.1,) * 4 + (math.inf,) + (0.1,) * 3
    for x, finite in ((good, True), (bad, False)):
        simulator.reset(x)
        np.testing.assert_array_equal(simulator.step((1.0, 2.0)), params.step(x, (1.0, 2.0), 0.02, 2))
        assert (simulator._code.check[0] == 0) == finite
    assert judge.judge(good, (1.0, 2.0), bad, 1, 0.0) is None
    assert judge.judge(good, (1.0, 2.0), good, 1, 0.0) is not None


@dataclass(frozen=True)
class Branching(Stabilize):
    """A task that machine code cannot compute."""

    def cost(self, x, u, c):
        return 1.0 if x[0] > 0 else 2.0


def test_tasks_that_machine_code_does_not_know_stay_in_python():
    env = BallbotEnv(Branching(), "rk4")
    begin_second_episode(env)
    assert env._judge is None
    assert env.step([0.1, 0.1])[-1]["cost"] >= 0


@needs_compiler
def test_other_bits_than_pythons_are_refused(monkeypatch):
    written = traced.function
    monkeypatch.setattr(traced, "function", lambda *args: written(*args).replace("0x1.0", "0x1.00000000001"))
    with pytest.raises(ArithmeticError):
        step_code._checked(lambda x: (1.0 * x[0],), (1,), False)


@needs_compiler
def test_whatever_ops_computes_is_computed_alike_in_machine_code():
    def compute(x):
        a, b = x
        squares = 1.0 + a * a, 1.0 + ops.squared(a, b) ** 2
        condition = ops.where(a < b, a, -b) + (a == b) + (a >= 0.5) - (b <= 0.5) + (a != b) + (a > b)
        functions = ops.sin(a), ops.cos(b), ops.sqrt(squares[0]), ops.exp(a), ops.log(squares[1]), ops.arctan(b)
        angle = ops.arccos(ops.clip(a / b, -1.0, 1.0))
        return (condition, angle, abs(a), 2 / squares[0], 3 - a, ops.where(a > 0, math.inf, b), *functions)

    step_code._checked(compute, (2,), False)  # it compares


@needs_compiler
def test_an_episode_goes_on_after_a_reset_that_is_refused():
    env, other = BallbotEnv("orbit", "rk4"), BallbotEnv("orbit", "rk4")
    begin_second_episode(env)
    start = env.reset(seed=0)[1]
    other.reset(seed=0)
    with pytest.raises(ValueError, match="out of range"):
        env.reset(options={"state": [50.0] * 8, "constants": start["constants"] + 0.1})
    assert bits([env.step([0.3, -0.2])]) == bits([other.step([0.3, -0.2])])


def test_an_env_of_one_episode_makes_no_machine_code():
    env = BallbotEnv("stabilize", "rk4")
    env.reset()
    assert not step_code._codes
