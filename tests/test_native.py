"""Envs in machine code: the same episodes as in torch, wherever an env stands, and a word where there is no machine code."""

import logging
import multiprocessing
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip("casadi")
torch = pytest.importorskip("torch")

import casadi  # noqa: E402

from ballbot_gym import Randomization, machine_code  # noqa: E402
from ballbot_gym.env import make_task  # noqa: E402
from ballbot_gym.machine_code import codegen  # noqa: E402
from ballbot_gym.tasks import TASKS  # noqa: E402
from ballbot_gym.tasks.stabilize import Stabilize  # noqa: E402
from ballbot_gym.vector import BallbotVectorEnv, native  # noqa: E402
from ballbot_gym.vector.batch import BallbotBatch  # noqa: E402

needs_compiler = pytest.mark.skipif(machine_code.compiler() is None, reason="no C compiler")


def actions_of(count, steps=40, scale=1.2):
    return np.random.default_rng(0).uniform(-scale, scale, (steps, count, 2)).astype(np.float32)


def play(env, actions, seed):
    """What every step returns, stacked: observations, rewards, states, tilts, constants."""
    env.reset(seed=seed)
    results = []
    for action in actions:
        observation, reward, *_, infos = env.step(action)
        results.append((observation, reward[:, None], infos["state"], infos["tilt"][:, None], infos["constants"]))
    return [np.stack(parts) for parts in zip(*results, strict=True)]


@needs_compiler
@pytest.mark.parametrize(("name", "dtype"), [*((name, torch.float32) for name in TASKS), ("weave", torch.float64)])
def test_an_env_is_the_same_bit_for_bit_wherever_it_stands(name, dtype):
    """In blocks that are full and in the remainder, alone, and where threads share the work."""
    actions = actions_of(37)
    make = {"task": make_task(name, duration=0.5), "engine": "native", "dtype": dtype}
    whole = play(BallbotVectorEnv(37, **make), actions, list(range(37)))
    for first, count in ((0, 1), (3, 16), (19, 18), (36, 1)):
        part = play(
            BallbotVectorEnv(count, **make), actions[:, first : first + count], list(range(first, first + count))
        )
        for a, b in zip(part, whole, strict=True):
            np.testing.assert_array_equal(a, b[:, first : first + count])


@needs_compiler
def test_threads_change_nothing(monkeypatch):
    """In a batch of several pieces, of which the last is not whole."""
    monkeypatch.setattr(native, "_PARALLEL_FROM", 64)
    actions, results = actions_of(2500, 30), []
    for threads in (1, 3):
        env = BallbotVectorEnv(2500, "weave", engine="native", duration=0.5)
        env.batch.threads = threads
        results.append(play(env, actions, 0))
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)


def arrays_in(value):
    """All arrays of numbers in what a step returns."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, (tuple, dict)):
        for part in value.values() if isinstance(value, dict) else value:
            yield from arrays_in(part)


@needs_compiler
def test_what_a_step_returned_never_changes_later_though_memory_is_used_again():
    """Some arrays are kept, and of others only a row; all others are dropped at once."""
    env = BallbotVectorEnv(19, "weave", robot="rolling", engine="native", duration=0.18)
    rng, kept, addresses = np.random.default_rng(0), [], set()
    env.reset(seed=0)
    for action in actions_of(19, 200):
        result = env.step(action)
        addresses.add(result[0].ctypes.data)
        chosen = [array for array in arrays_in(result) if rng.random() < 0.05]
        chosen += [array[3:5] for array in arrays_in(result) if rng.random() < 0.05]
        kept += [(array, array.copy()) for array in chosen]
    for array, copied in kept:
        np.testing.assert_array_equal(array, copied)
    assert len(kept) > 500
    assert len(addresses) < 100  # each step would have its own if memory were not used again


@needs_compiler
def test_actions_may_lie_in_memory_in_any_way():
    plain = actions_of(21, 30)
    packed = np.zeros((30, 21), np.dtype([("odd", "i1"), ("action", "f4", 2)]))
    packed["action"] = plain
    wide = np.zeros((30, 21, 7), np.float32)
    wide[..., 5:2:-2] = plain
    backwards = plain[:, ::-1].copy()[:, ::-1]
    by_component = plain.transpose(0, 2, 1).copy().transpose(0, 2, 1)
    expected = play(BallbotVectorEnv(21, "turn", engine="native"), plain, 0)
    for laid in (packed["action"], wide[..., 5:2:-2], backwards, by_component, plain.astype(float)):
        got = play(BallbotVectorEnv(21, "turn", engine="native"), laid, 0)
        assert all(map(np.array_equal, got, expected))
    one = np.broadcast_to(np.float32([0.3, -0.2]), (21, 2))
    assert not one.flags.writeable
    envs = BallbotVectorEnv(21, "turn", engine="native")
    assert all(map(np.array_equal, play(envs, [one] * 9, 0), play(envs, [one.copy()] * 9, 0)))


@needs_compiler
@pytest.mark.parametrize("count", [5, 16, 9000])
def test_an_action_that_is_not_finite_changes_nothing(count):
    envs, twin = (BallbotVectorEnv(count, "stabilize", engine="native") for _ in range(2))
    for env in (envs, twin):
        env.reset(seed=0)
    good = actions_of(count, 2)
    for bad_value in (np.nan, np.inf, -np.inf):
        bad = good[0].copy()
        bad[count - 1, 1] = bad_value
        with pytest.raises(ValueError, match=rf"those of envs \[{count - 1}\] are not"):
            envs.step(bad)
    for action in good:
        assert all(map(np.array_equal, envs.step(action)[:4], twin.step(action)[:4]))


@needs_compiler
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
def test_a_forked_process_has_threads_of_its_own_and_torch_is_not_imported():
    """In a process of its own, because this one may have threads that hold locks."""
    code = """
import numpy as np, os, sys
os.environ["OMP_NUM_THREADS"] = "2"
from ballbot_gym.vector import native
from ballbot_gym.vector import BallbotVectorEnv
native._PARALLEL_FROM = 64
env = BallbotVectorEnv(100)
assert "torch" not in sys.modules and env.batch.threads == 2
env.reset(seed=0)
env.step(np.zeros((100, 2)))
child = os.fork()
if not child:
    env.step(np.zeros((100, 2)))
    os._exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@needs_compiler
def test_a_state_that_is_not_finite_fails_and_its_neighbours_go_on():
    env = BallbotVectorEnv(3, engine="native", autoreset_mode="NextStep")
    env.reset(seed=0)
    for bad in (np.nan, np.inf):
        x = env.batch.state.x.copy()
        x[2, 1] = bad
        env.batch.state = env.batch.state._replace(x=x)
        *_, terminated, _, infos = env.step(np.zeros((3, 2)))
        assert terminated.tolist() == [False, True, False]
        assert infos["failure"].tolist() == [False, True, False]
        assert infos["violated"][1] >= 0
        env.step(np.zeros((3, 2)))


@needs_compiler
def test_a_state_of_another_shape_is_refused_before_machine_code_reads_it():
    envs = BallbotVectorEnv(3, "weave", engine="native").batch
    state = envs.initial_state(seed=0)
    for name in ("x", "c", "steps", "episode", "seed"):
        with pytest.raises(ValueError, match=f"{name} of a state must have shape"):
            envs.state = state._replace(**{name: getattr(state, name)[..., :2]})
    envs.state = state._replace(x=np.asfortranarray(state.x, np.float64))  # another order and type are taken
    first = envs.step(np.zeros((3, 2), np.float32, order="F"))
    envs.state = state
    np.testing.assert_array_equal(envs.step(np.zeros((3, 2), np.float32, order="F")).final_x, first.final_x)


@needs_compiler
def test_auto_takes_machine_code_unless_something_speaks_against_it():
    assert isinstance(BallbotVectorEnv(1).batch, native.BallbotNative)
    assert isinstance(BallbotVectorEnv(2000).batch, native.BallbotNative)
    assert isinstance(BallbotVectorEnv(2, compile=False).batch, BallbotBatch)
    assert isinstance(BallbotVectorEnv(2, compile=True).batch, BallbotBatch)
    assert isinstance(BallbotVectorEnv(2, randomization=Randomization(body_mass=(0.9, 1.1))).batch, BallbotBatch)
    with pytest.raises(ValueError, match='"native" does not support Randomization, history or sensors; take'):
        BallbotVectorEnv(2, engine="native", randomization=Randomization(body_mass=(0.9, 1.1)))
    with pytest.raises(ValueError, match="engine='native' runs on the CPU, not on cuda"):
        BallbotVectorEnv(2, engine="native", device="cuda")


@dataclass(frozen=True)
class Branching(Stabilize):
    """A task whose cost CasADi refuses."""

    def cost(self, x, u, c):
        px, *_ = x
        return px if px > 0 else -px


@needs_compiler
def test_a_task_that_cannot_be_traced_runs_in_torch_with_a_word_in_the_log(caplog):
    reason = "BallbotStabilize-v0 cannot be traced: RuntimeError"
    with caplog.at_level(logging.WARNING):
        assert isinstance(BallbotVectorEnv(100, Branching()).batch, BallbotBatch)
    assert len(caplog.records) == 1
    assert f"no machine code, so the envs are slower: {reason}" in caplog.text
    with pytest.raises(machine_code.NoMachineCodeError, match=reason):
        BallbotVectorEnv(100, Branching(), engine="native")


def test_without_a_compiler_envs_run_in_torch(monkeypatch, caplog):
    def refuse(*args):
        raise machine_code.NoMachineCodeError("cc failed: no such instruction")

    monkeypatch.setattr(machine_code, "library", refuse)
    native._code.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert isinstance(BallbotVectorEnv(2).batch, BallbotBatch)
    assert "no such instruction" in caplog.text
    with pytest.raises(machine_code.NoMachineCodeError, match="no such instruction"):
        BallbotVectorEnv(2, engine="native")
    native._code.cache_clear()


def test_an_operation_that_is_not_known_as_c_is_refused():
    x = casadi.SX.sym("x")
    with pytest.raises(NotImplementedError, match="not known as C"):
        codegen.block("odd", [("x", [x])], [("y", [casadi.erf(x)])])


@needs_compiler
def test_every_operation_that_is_known_as_c_does_what_casadis_does(tmp_path, monkeypatch):
    """Truth values as numbers, comparisons with and without equality, and choices of infinities too."""
    import ctypes

    a, b = casadi.SX.sym("a"), casadi.SX.sym("b")
    less, same = a < b, a == b
    values = [
        a + b, a - b, a * b, a / b, -a, 1 / a, a * a, 2 * a, casadi.fabs(a), casadi.sqrt(casadi.fabs(a)),
        casadi.sin(a), casadi.cos(a), casadi.tan(a), casadi.atan(a), casadi.acos(casadi.fmin(casadi.fabs(a), 1)),
        casadi.exp(a), casadi.log(casadi.fabs(a) + 1), casadi.fmin(a, b), casadi.fmax(a, b),
        less, a <= b, same, a != b, casadi.logic_not(less), casadi.logic_not(a), casadi.logic_and(less, a > 0),
        casadi.logic_or(less, same), casadi.logic_and(a, b), casadi.if_else(less, a, b), casadi.if_else(a, b, 3.0),
        casadi.if_else(less, a, np.inf), casadi.if_else(same, -np.inf, casadi.if_else(less, 1.0, 0.0)),
        casadi.floor(3 * a), casadi.fabs(a) ** b, casadi.fabs(a) ** 1.5,
    ]  # fmt: skip
    block = codegen.block("every", [("a", [a]), ("b", [b])], [("y", values)])
    head = f"#define LANES {codegen.LANES}\n#include <math.h>\n#include <stdint.h>\ntypedef double real;\n"
    names = ("sqrt", "fabs", "floor", "sin", "cos", "tan", "atan", "acos", "exp", "log", "pow")
    head += "".join(f"#define real_{name} {name}\n" for name in names)
    whole = "void whole(double *a, double *b, double *y) { every(a, LANES, b, LANES, y, LANES); }\n"
    monkeypatch.setenv("BALLBOT_CACHE", str(tmp_path))
    library = ctypes.CDLL(str(machine_code.library("every", head + block + whole, native._COMPILER_FLAGS)))
    rng = np.random.default_rng(0)
    given = rng.normal(size=(2, codegen.LANES))
    given[1, :3], given[0, 3], given[1, 4] = given[0, :3], 0.0, 0.0
    made = np.zeros((len(values), codegen.LANES))
    library.whole(*(ctypes.c_void_p(array.ctypes.data) for array in (given[0].copy(), given[1].copy(), made)))
    function = casadi.Function("every", [a, b], [casadi.vertcat(*values)])
    expected = np.column_stack([np.array(function(*pair)).ravel() for pair in given.T])
    np.testing.assert_allclose(made, expected, rtol=1e-12, atol=1e-12)
