import multiprocessing
import os
import subprocess

import pytest

pytest.importorskip("casadi")

import casadi

from ballbot_baselines import compiled

needs_compiler = pytest.mark.skipif(compiled._compiler() is None, reason="no C compiler")


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


@needs_compiler
def test_nothing_but_the_library_is_left_in_the_cache(folder):
    compiled.compiled("powers", powers())
    assert [path.suffix for path in folder.iterdir()] == [".so"]


@needs_compiler
def test_library_depends_on_processor_and_content(folder, monkeypatch):
    compiled.compiled("powers", powers())
    compiled.compiled("powers", powers(2.0))
    monkeypatch.setattr(compiled, "_machine", lambda compiler: "another processor")
    compiled.compiled("powers", powers())
    assert len(list(folder.iterdir())) == 3


@needs_compiler
@pytest.mark.parametrize("damage", ["cut", "changed", "emptied"])
def test_damaged_library_is_built_anew(folder, damage):
    """In another process, because the loader would hand out the library that this one has open already."""
    compiled.compiled("powers", powers())
    (library,) = folder.iterdir()
    content = library.read_bytes()
    broken = {"cut": content[: len(content) // 2], "changed": b"x" + content[1:], "emptied": b""}[damage]
    library.unlink()  # a new file: the one that is loaded must not change under this process
    library.write_bytes(broken)
    assert in_another_process() == [9.0, 27.0]
    assert library.read_bytes() != broken
    assert compiled._is_whole(library)


@needs_compiler
def test_processes_that_compile_at_once_all_get_a_whole_library(folder):
    context = multiprocessing.get_context("spawn")
    with context.Pool(4) as pool:
        assert pool.map(compile_and_evaluate, [str(folder)] * 4) == [([9.0, 27.0], False)] * 4
    assert len(list(folder.iterdir())) == 1


def compile_and_evaluate(folder):
    os.environ["BALLBOT_CACHE"] = folder
    functions = compiled.compiled("powers", powers())
    return values(functions), any(is_interpreted(f) for f in functions)


def in_another_process():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        result, interpreted = pool.apply(compile_and_evaluate, [os.environ["BALLBOT_CACHE"]])
    assert not interpreted
    return result


def test_compiler_that_fails_leaves_functions_interpreted_and_the_cache_empty(folder, monkeypatch, caplog):
    def fail(command, **kwargs):
        if "--version" in command:
            return subprocess.CompletedProcess(command, 0, "", "")
        raise subprocess.CalledProcessError(1, command, stderr="no such instruction")

    monkeypatch.setattr(compiled, "_compiler", lambda: "broken-cc")
    monkeypatch.setattr(compiled, "_machine", lambda compiler: "any")
    monkeypatch.setattr(subprocess, "run", fail)
    functions = powers()
    assert compiled.compiled("powers", functions) is functions
    assert "no such instruction" in caplog.text
    assert len(caplog.records) == 1
    assert list(folder.iterdir()) == []


@needs_compiler
def test_cache_that_cannot_be_written_leaves_functions_interpreted(folder, caplog):
    folder.write_text("a file where the folder should be")
    functions = powers()
    assert compiled.compiled("powers", functions) is functions
    assert len(caplog.records) == 1


@needs_compiler
def test_library_that_does_not_load_leaves_functions_interpreted(folder, monkeypatch, caplog):
    def refuse(*args):
        raise RuntimeError("wrong ELF class")

    monkeypatch.setattr(casadi, "external", refuse)
    functions = powers()
    assert compiled.compiled("powers", functions) is functions
    assert "wrong ELF class" in caplog.text
