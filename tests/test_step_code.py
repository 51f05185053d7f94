"""Machine code of single environments computes what Python computes, to rounding, and the same bits every time."""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from ballbot_gym import TASKS, BallbotEnv, Randomization, machine_code, ops
from ballbot_gym.machine_code import libraries, single
from ballbot_gym.robot import named_robot
from ballbot_gym.step import Draws, StepState, outcome, step
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
    monkeypatch.setattr(single, "_functions", {})


def play(env: BallbotEnv, steps: int = 25) -> list[dict[str, Any]]:
    """What steps with random actions, some of them clipped, give from seed 0 on, with the starts of new episodes."""
    rng = np.random.default_rng(0)
    observation, info = env.reset(seed=0)
    given = [info | {"observation": observation}]
    for action in rng.uniform(-1.1, 1.1, (steps, env.params.action_size)).astype(np.float32):
        observation, reward, terminated, truncated, info = env.step(action)
        given.append(
            info | {"observation": observation, "reward": reward, "terminated": terminated, "truncated": truncated}
        )
        if terminated or truncated:
            observation, info = env.reset()
            given.append(info | {"observation": observation})
    return given


def types(info: dict[str, Any]) -> dict[str, Any]:
    return {
        name: (value.dtype, value.shape) if isinstance(value, np.ndarray) else type(value)
        for name, value in info.items()
    }


CASES = {
    "closed form": ("rk4", "paper", {}),
    "a ball that rolls, and everything varies": ("rk4", "rolling", {"randomization": EVERYTHING}),
    "sensors of a robot with wheels": ("rk4", "omni", {"observation": "sensors"}),
    "PyBullet, and everything varies": ("bullet", "paper", {"randomization": EVERYTHING}),
    "contact in MuJoCo": ("mujoco", "rolling", {"history": 2}),
}


@needs_compiler
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("task", ["stabilize", "weave"])
def test_machine_code_computes_what_python_computes(task, case, monkeypatch):
    physics, robot, keywords = CASES[case]
    pytest.importorskip({"bullet": "pybullet", "mujoco": "mujoco"}.get(physics, "numpy"))
    env: Any = BallbotEnv(task, physics, robot=robot, **keywords)
    with monkeypatch.context() as patch:
        patch.setattr(libraries, "compiler", lambda: None)
        python = play(env)
        assert env._code is None
    single._functions.clear()
    coded = play(env)
    assert env._code is not None
    for mine, theirs in zip(coded, python, strict=True):
        assert types(mine) == types(theirs)
        for name, value in mine.items():
            np.testing.assert_allclose(value, theirs[name], rtol=1e-7, atol=1e-7, err_msg=name)


@needs_compiler
@pytest.mark.parametrize("physics", ["rk4", "bullet"])
def test_every_env_gives_the_same_bits_for_the_same_seed(physics):
    if physics == "bullet":
        pytest.importorskip("pybullet")
    env = BallbotEnv("turn", physics, randomization=EVERYTHING)
    first, again, other = play(env), play(env), play(BallbotEnv("turn", physics, randomization=EVERYTHING))
    for mine, theirs, others in zip(first, again, other, strict=True):
        for name, value in mine.items():
            np.testing.assert_array_equal(value, theirs[name], err_msg=name)
            np.testing.assert_array_equal(value, others[name], err_msg=name)


@needs_compiler
@pytest.mark.parametrize("task", TASKS)
def test_goals_limits_and_ends_are_those_of_python(task):
    """Random actions reach no goal, so an engine puts states near it."""
    env: Any = BallbotEnv(task, "rk4")
    robot = env.params
    problem = env.step_problem._replace(substeps=0)
    code = single.StepCode.compiled(problem, robot)
    assert code is not None
    rng, ends = np.random.default_rng(0), set()
    for i in range(100):
        x, c = env.task.sample(rng, robot)
        reference = env.task.reference(x, c, robot).x
        before, after = (tuple((reference[-1] + rng.normal(0, (0.05, 0.5)[i % 2], 8)).tolist()) for _ in range(2))
        c, action = tuple(c.tolist()), tuple(rng.uniform(-0.2, 0.2, 2).tolist())
        steps, stable = env.task.steps - (i % 3 > 0), (0.0, -1.0)[i % 7 == 0]
        code.begin(c, (), robot, robot)
        made, _ = code.step(StepState(before, c, steps - 1), action, Draws(), (after, (), stable))
        force = tuple(robot.force_limit * part for part in action)
        did = outcome(env.task, before, force, after, c, steps, (stable,))
        np.testing.assert_allclose(made.outcome, did, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(code.seen, env.task.observe(after, c), rtol=1e-12, atol=1e-12)
        ends.add(did.success)
    assert ends == {1.0, 0.0}


@needs_compiler
def test_robots_of_one_kind_share_the_code(params):
    heavier = params.varied(body_mass=1.2)
    env, other = BallbotEnv("orbit", "rk4"), BallbotEnv("orbit", "rk4", robot=heavier)
    play(env, 1), play(other, 1)
    assert len(single._functions) == 1
    start = {"state": (0.1,) * 8, "constants": (1.5, 2.0)}
    other.reset(options=start)
    end = other.step((0.1, 0.2))[-1]["state"]
    expected = step(Stabilize(), heavier, Randomization(), StepState((0.1,) * 8, (), 0.0), (0.1, 0.2)).state.x
    np.testing.assert_allclose(end, expected, rtol=1e-12)


@dataclass(frozen=True)
class Branching(Stabilize):
    """A task that machine code cannot compute."""

    def cost(self, x, u, c):
        return 1.0 if x[0] > 0 else 2.0


def test_tasks_that_machine_code_does_not_know_stay_in_python():
    env: Any = BallbotEnv(Branching(), "rk4")
    env.reset()
    assert env._code is None
    assert env.step([0.1, 0.1])[-1]["cost"] >= 0


@dataclass(frozen=True)
class Converting(Stabilize):
    """A task that silently makes other numbers of symbols."""

    def cost(self, x, u, c):
        return 2.0 if isinstance(x[0], float) else 1.0 + 0.0 * x[0]


@needs_compiler
def test_code_that_computes_something_else_than_python_is_refused():
    env: Any = BallbotEnv(Converting(), "rk4")
    with pytest.raises(machine_code.NoMachineCodeError, match="gives other results"):
        single._compiled(env.step_problem, env.params)
    env.reset()
    assert env._code is None


@dataclass(frozen=True)
class Everything(Stabilize):
    """A task with every operation of `ops`."""

    def cost(self, x, u, c):
        a, b, *_ = ops.components(x)
        squares = 1.0 + a * a, 1.0 + ops.squared(a, b) ** 2
        condition = ops.where(a < b, a, -b) + ops.minimum(a, b) - ops.maximum(a, 2 * b)
        functions = ops.sin(a), ops.cos(b), ops.sqrt(squares[0]), ops.exp(a), ops.log(squares[1]), ops.arctan(b)
        angle = ops.arccos(ops.clip(a / b, -1.0, 1.0))
        return condition + angle + abs(a) + 2 / squares[0] - a + squares[1] ** 1.5 + ops.floor(10 * a) + sum(functions)


@needs_compiler
def test_whatever_ops_computes_is_computed_alike_in_machine_code():
    env: Any = BallbotEnv(Everything(), "rk4")
    assert single._compiled(env.step_problem, env.params)  # it compares


@needs_compiler
def test_an_episode_goes_on_after_a_reset_that_is_refused():
    env, other = BallbotEnv("orbit", "rk4"), BallbotEnv("orbit", "rk4")
    start = env.reset(seed=0)[1]
    other.reset(seed=0)
    with pytest.raises(ValueError, match="out of range"):
        env.reset(options={"state": [50.0] * 8, "constants": start["constants"] + 0.1})
    np.testing.assert_array_equal(env.step([0.3, -0.2])[-1]["state"], other.step([0.3, -0.2])[-1]["state"])


@needs_compiler
def test_a_motion_that_is_not_finite_fails():
    env = BallbotEnv("stabilize", "rk4")
    env.reset(seed=0)
    _, _, terminated, _, info = env.step([0.0, 0.0])
    assert not terminated
    state = env.get_state()
    env.set_state(state._replace(x=(*state.x[:4], float("inf"), *state.x[5:])))
    _, _, terminated, _, info = env.step([0.0, 0.0])
    assert terminated
    assert info["failure"]
    assert info["violated"] >= 0


def test_sensors_of_machine_code_read_the_robots_numbers():
    robot = named_robot("omni")
    env: Any = BallbotEnv("stabilize", "rk4", robot=robot, observation="sensors")
    assert env.step_problem.numbers(robot)[-1] == robot.com_height


STEPPED = """
import sys

import gymnasium
import numpy as np

import ballbot_gym


class Own(ballbot_gym.Stabilize):
    pass


fields = {"shipped": {}, "other": {"heading_weight": 1.0, "effort_weight": 1e-2}, "own": {"task": Own()}}
env = gymnasium.make("BallbotStabilize-v0", physics="rk4", **fields[sys.argv[1]])
env.reset(seed=0)
print(env.step(np.full(2, 0.3, np.float32))[1], "casadi" in sys.modules)
"""


@needs_compiler
def test_code_of_this_package_is_printed_once_on_a_machine_and_that_of_users_by_each_process(monkeypatch, tmp_path):
    monkeypatch.setenv("BALLBOT_CACHE", str(tmp_path / "cache"))

    def reward_and_print(which: str) -> list[str]:
        command = [sys.executable, "-c", STEPPED, which]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    reward, printed = reward_and_print("shipped")
    assert printed == "True"
    assert reward_and_print("shipped") == [reward, "False"]
    other, printed = reward_and_print("other")
    assert printed == "True"
    assert other != reward
    assert [reward_and_print("own") for _ in range(2)] == [[reward, "True"]] * 2


def test_copies_of_this_package_share_its_printed_code_until_a_file_changes(monkeypatch, tmp_path):
    digest = libraries._digests_of_package.__wrapped__
    own = digest()
    copy = shutil.copytree(libraries._PACKAGE, tmp_path / "ballbot_gym", copy_function=shutil.copyfile)
    monkeypatch.setattr(libraries, "_PACKAGE", copy)
    assert digest() == own
    (copy / "ops.py").write_text((copy / "ops.py").read_text() + "\n")
    assert digest() != own
