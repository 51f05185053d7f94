import ctypes
import logging
import multiprocessing
import os
import subprocess
import time
from pathlib import Path

import pytest

pytest.importorskip("casadi")

import casadi
import numpy as np

from ballbot_baselines.solvers import compiled, nlp
from ballbot_gym.machine_code import codegen, libraries
from ballbot_gym.robot import named_robot

needs_compiler = pytest.mark.skipif(libraries.compiler() is None, reason="no C compiler")
posix = pytest.mark.skipif(os.name != "posix", reason="programs and permissions of POSIX")


def powers(factor=1.0):
    """Graphs like those of the solvers, small enough to compile in a moment."""
    x = casadi.SX.sym("x")
    return casadi.Function("square", [x], [factor * x * x]), casadi.Function("cube", [x], [x**3])


def values(functions):
    return [float(f(3.0)) for f in functions]


def is_interpreted(function):
    return function.is_a("SXFunction")


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """An empty cache."""
    path = tmp_path / "cache"
    monkeypatch.setenv("BALLBOT_CACHE", str(path))
    return path


@needs_compiler
def test_compiled_functions_give_the_interpreted_ones_values(folder):
    fast = compiled.compiled("powers", powers())
    assert not any(is_interpreted(f) for f in fast)
    assert values(fast) == values(powers()) == [9.0, 27.0]


def blocks():
    """Functions of one stage, with an argument of no rows, and an angle; and arguments of a whole block of stages."""
    x, y, none = casadi.SX.sym("x", 3), casadi.SX.sym("y"), casadi.SX.sym("none", 0)
    turned = casadi.Function("turned", [x, none, y], [casadi.vertcat(casadi.sin(y), casadi.cos(y)) * x[0], x / y])
    product = casadi.Function("product", [x], [x[0] * x[1] * x[2]])
    rng = np.random.default_rng(0)
    return (turned, product), rng.normal(size=(3, compiled.LANES)), rng.normal(size=(1, compiled.LANES))


@needs_compiler
def test_lanes_give_the_values_of_every_stage(folder, caplog):
    (turned, product), x, y = blocks()
    fast_turned, fast_product = compiled.in_lanes("blocks", (turned, product))
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    none = np.zeros((0, compiled.LANES))
    for k in range(compiled.LANES):
        for expected, found in zip(turned(x[:, k], [], y[:, k]), fast_turned(x, none, y), strict=True):
            # vector versions of sine and cosine are wrong by up to 4 units in the last place
            np.testing.assert_allclose(np.array(found)[:, k], np.array(expected).ravel(), rtol=1e-15, atol=2e-15)
        assert float(fast_product(x)[k]) == pytest.approx(float(product(x[:, k])), rel=1e-15)


@needs_compiler
@pytest.mark.parametrize("name", ["paper", "rolling", "omni"])
def test_steps_of_rk4_have_the_derivatives_of_a_robot_s_step(folder, name):
    robot, steps = named_robot(name), 3
    kind, states = robot.kind, robot.state_size
    z, p = casadi.SX.sym("z", states + robot.action_size), casadi.SX.sym("p", 1 + len(kind.numbers))
    model, multipliers = kind.model(p[1:]), casadi.SX.sym("l", states)
    x, u = z[:states], z[states:]
    after, rates = casadi.SX(model.step(x, u, p[0], steps)), p[0] * model.derivative(x, u)
    made = nlp.Stages.motion(z, p, rates, steps)
    hessian, gradient = casadi.hessian(casadi.dot(multipliers, after), z)
    expected = casadi.Function("expected", [z, p, multipliers], [after, casadi.jacobian(after, z), gradient, hessian])
    rng = np.random.default_rng(0)
    lanes = (
        rng.uniform(-0.5, 0.5, size=(z.shape[0], compiled.LANES)),
        np.tile(np.array([0.03, *robot.numbers()])[:, None], compiled.LANES),
        rng.normal(size=(states, compiled.LANES)),
    )
    values = lanes[0], lanes[1][: made.params]
    found = made.value(*values), *made.jacobian(*values), *made.hessian(*values, lanes[2])
    for k in range(compiled.LANES):
        after, jacobian, gradient, hessian = expected(*(part[:, k] for part in lanes))
        patterns = made.jacobian_at, made.hessian_at
        entries = [
            np.array(casadi.project(part, at).nonzeros())
            for part, at in zip((jacobian, hessian), patterns, strict=True)
        ]
        for got, wanted in zip(found, (after, after, entries[0], gradient, entries[1]), strict=True):
            wanted = np.array(wanted).ravel()
            np.testing.assert_allclose(np.array(got)[:, k], wanted, rtol=1e-10, atol=1e-10 * np.abs(wanted).max())


@needs_compiler
@pytest.mark.parametrize("piece", [2, 7, 40])
def test_a_long_function_is_computed_in_pieces(folder, monkeypatch, piece):
    """Of which later ones read what earlier ones computed, constants among them."""
    monkeypatch.setattr(codegen, "_LONGEST", 10)
    monkeypatch.setattr(codegen, "_PIECE", piece)
    x = casadi.SX.sym("x", 2)
    a = b = x[0]
    for i in range(30):
        a, b = casadi.sin(a) + 0.3 * b, casadi.if_else(a > 0.3, b - i * x[1], 2 * b / (2 + x[0] ** 2))
    plain = casadi.Function("mixed", [x], [casadi.vertcat(a, b), a * b, a + 0.3])
    (fast,) = compiled.in_lanes("mixed", (plain,))
    states = np.random.default_rng(0).normal(size=(2, compiled.LANES))
    for got, expected in zip(fast(states), plain.map(compiled.LANES)(states), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


@needs_compiler
def test_functions_are_compiled_once_and_then_read_from_the_cache(folder, monkeypatch):
    compiled.compiled("powers", powers())
    (library,) = folder.iterdir()  # nothing else is left there
    assert library.name.startswith("powers-")
    monkeypatch.setattr(subprocess, "Popen", lambda *args, **kwargs: pytest.fail("compiled again"))
    assert values(compiled.compiled("powers", powers())) == [9.0, 27.0]


@needs_compiler
def test_the_code_of_lanes_is_printed_once_and_then_read_from_the_cache(folder, monkeypatch):
    compiled.in_lanes("powers", powers())
    assert sorted(path.suffix for path in folder.iterdir()) == [".c", libraries.SUFFIX]
    printed = []
    real = codegen.in_lanes
    monkeypatch.setattr(codegen, "in_lanes", lambda *given: printed.append(given) or real(*given))
    x = np.full((1, compiled.LANES), 3.0)
    for factor, times in ((1.0, 0), (2.0, 1)):  # another function is printed
        square, cube = compiled.in_lanes("powers", powers(factor))
        assert (float(square(x)[0]), float(cube(x)[0])) == (9.0 * factor, 27.0)
        assert len(printed) == times


@needs_compiler
def test_library_depends_on_processor_and_content(folder, monkeypatch):
    compiled.compiled("powers", powers())
    compiled.compiled("powers", powers(2.0))
    monkeypatch.setattr(libraries, "_machine", lambda compiler: "another processor")
    compiled.compiled("powers", powers())
    assert len(list(folder.iterdir())) == 3


@needs_compiler
@pytest.mark.parametrize("damage", ["cut", "changed", "emptied"])
def test_damaged_library_is_built_anew(folder, damage):
    library = libraries.library("two", "int two() { return 2; }")
    content = library.read_bytes()
    broken = {"cut": content[: len(content) // 2], "changed": b"x" + content[1:], "emptied": b""}[damage]
    library.write_bytes(broken)
    assert libraries.library("two", "int two() { return 2; }") == library
    assert library.read_bytes() != broken
    assert ctypes.CDLL(str(library)).two() == 2


@needs_compiler
def test_processes_that_compile_at_once_all_get_a_whole_library(folder):
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        assert pool.map(compile_and_evaluate, [str(folder)] * 2) == [([9.0, 27.0], False)] * 2
    assert len(list(folder.iterdir())) == 1


@posix
@needs_compiler
def test_compilers_other_than_gcc_get_no_setting_that_only_gcc_knows(fake_compiler, caplog):
    fake_compiler(
        b'#!/bin/sh\n[ "$1" = --version ] && echo "clang version 19" && exit 0\n'
        b'case "$*" in *--param*|*-fira-*) echo "unknown argument" >&2; exit 1;; esac\nexec cc "$@"\n'
    )
    for function in compiled.in_lanes("powers", powers()):
        assert not is_interpreted(function)
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


@posix
@needs_compiler
def test_of_processes_that_need_a_library_at_once_one_compiles_it(folder, tmp_path, monkeypatch):
    program, runs = tmp_path / "slow-compiler", tmp_path / "runs"
    program.write_text(f'#!/bin/sh\n[ "$1" = --version ] || {{ echo run >> "{runs}"; sleep 1; }}\nexec cc "$@"\n')
    program.chmod(0o700)
    monkeypatch.setenv("CC", str(program))
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        assert pool.map(compile_and_evaluate, [str(folder)] * 2) == [([9.0, 27.0], False)] * 2
    assert runs.read_text().split() == ["run"]
    assert len(list(folder.iterdir())) == 1


def compile_and_evaluate(folder):
    os.environ["BALLBOT_CACHE"] = folder
    functions = compiled.compiled("powers", powers())
    return values(functions), any(is_interpreted(f) for f in functions)


@needs_compiler
def test_library_that_cannot_be_written_or_loaded_leaves_functions_interpreted(folder, monkeypatch, caplog):
    folder.write_text("a file where the folder should be")
    functions = powers()
    assert compiled.compiled("powers", functions) is functions
    assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) == 1

    def refuse(*args):
        raise RuntimeError("wrong ELF class")

    folder.unlink()
    monkeypatch.setattr(casadi, "external", refuse)
    assert compiled.compiled("powers", functions) is functions
    assert "wrong ELF class" in caplog.text


@pytest.fixture
def fake_compiler(folder, tmp_path, monkeypatch):
    """Makes CC a program with given content."""

    def make(content):
        program = tmp_path / "fake-cc"
        program.write_bytes(content)
        program.chmod(0o755)
        monkeypatch.setenv("CC", str(program))
        libraries.compiler.cache_clear()
        return str(program)

    yield make
    monkeypatch.undo()
    libraries.compiler.cache_clear()
    libraries._machine.cache_clear()
    libraries._hanging.clear()


@posix
@pytest.mark.parametrize(
    "content",
    [
        b"\x00\x01 no program",
        b"#!/no/such/interpreter\n",
        b"#!/bin/sh\nprintf '\\377\\376' >&2\nprintf '\\377'\nexit 1\n",
    ],
    ids=["no program", "no interpreter", "no UTF-8"],
)
def test_compiler_that_is_none_leaves_functions_interpreted(fake_compiler, caplog, content):
    fake_compiler(content)
    functions = powers()
    assert compiled.compiled("powers", functions) is functions
    assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) == 1
    assert "powers stay interpreted" in caplog.text


@posix
@pytest.mark.parametrize("hangs", ["at --version", "when it compiles"])
def test_compiler_that_hangs_is_ended_with_its_passes_and_not_asked_again(fake_compiler, monkeypatch, caplog, hangs):
    monkeypatch.setattr(libraries, "_VERSION_SECONDS", 0.2 if hangs == "at --version" else 10.0)
    monkeypatch.setattr(libraries, "_COMPILE_SECONDS", 0.2)
    answer = b"" if hangs == "at --version" else b'[ "$1" = --version ] && exit 0\n'
    program = fake_compiler(b"#!/bin/sh\n" + answer + b"sleep 30\n")
    functions, began = powers(), time.monotonic()
    assert compiled.compiled("powers", functions) is functions
    assert time.monotonic() - began < 15  # a pass that goes on would hold the pipes open
    assert f"{program} did not finish within 0.2 s" in caplog.text
    monkeypatch.setattr(libraries, "_run", lambda *args, **kwargs: pytest.fail("asked again"))
    assert compiled.compiled("others", functions) is functions
    assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) == 1


@needs_compiler
@pytest.mark.parametrize("home", ["none", "empty"])
def test_without_a_home_directory_functions_stay_interpreted(monkeypatch, caplog, home):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    for name in ("BALLBOT_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", no_home if home == "none" else Path)
    functions = powers()
    assert compiled.compiled("powers", functions) is functions
    assert "home directory" in caplog.text
    assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) == 1


@posix
@needs_compiler
def test_cache_is_closed_to_others_whatever_the_umask_and_not_read_where_they_can_write(folder, monkeypatch, caplog):
    before, user = os.umask(0), os.geteuid()
    try:
        compiled.compiled("powers", powers())
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(casadi, "external", lambda *args: pytest.fail("loaded"))
    functions = powers()
    for mode in (0o777, 0o770, 0o702):
        folder.chmod(mode)
        caplog.clear()
        assert compiled.compiled("powers", functions) is functions
        assert f"others may write into {folder}" in caplog.text
    folder.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    assert compiled.compiled("powers", functions) is functions
    assert f"{folder} belongs to another user" in caplog.text


@needs_compiler
@pytest.mark.parametrize("given", ["", "cache", "./cache"])
def test_cache_that_is_no_absolute_path_is_refused(monkeypatch, given):
    monkeypatch.setenv("BALLBOT_CACHE", given)
    with pytest.raises(ValueError, match="BALLBOT_CACHE must be an absolute path"):
        compiled.compiled("powers", powers())


def test_cache_lies_in_the_users_cache_folder_unless_told_otherwise_by_a_whole_path(monkeypatch, tmp_path):
    monkeypatch.delenv("BALLBOT_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert libraries.cache_folder() == tmp_path / "ballbot-gym"
    monkeypatch.setenv("BALLBOT_CACHE", str(tmp_path / "other"))
    assert libraries.cache_folder() == tmp_path / "other"
    monkeypatch.delenv("BALLBOT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert libraries.cache_folder() == tmp_path / ".cache" / "ballbot-gym"
