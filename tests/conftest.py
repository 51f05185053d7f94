"""Fixtures that parametrize tests over everything registered, so that a new task arrives tested."""

import contextlib
import functools
import gc
import importlib
import itertools
import os
import sys

# Before torch is imported, here and in the processes that tests start: nothing in them is big enough for a second thread,
# and on busy cores threads wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

if os.environ.get("PYTEST_XDIST_WORKER") == "gw1":
    # The first worker imports these after torch. So where there is no bytecode yet, as after an installation, each compiles
    # what the other then finds, and not both the same.
    for name in ("matplotlib.pyplot", "scipy.optimize", "casadi", "tyro", "minari"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)

import gymnasium
import numpy as np
import pytest

import ballbot_gym
from ballbot_gym.engines import installed_physics
from ballbot_gym.robot import ROBOTS, default_params
from ballbot_gym.tasks import TASKS

_NUMBERS = itertools.count()


def pytest_collection_finish():
    """What is imported stays, so the garbage collector needs not look at it again: that took 4 % of the tests' time."""
    gc.freeze()


@pytest.fixture(scope="session")
def params():
    return default_params()


@pytest.fixture(params=TASKS.values(), ids=TASKS.keys())
def task(request):
    return request.param()


@pytest.fixture(params=installed_physics())
def physics(request):
    return request.param


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def registries():
    """Forgets the tasks and robots that the test registered, and their modules."""
    before = dict(TASKS), dict(ROBOTS), dict(gymnasium.registry)
    yield
    for kind in TASKS.values():
        if kind not in before[0].values():
            sys.modules.pop(kind.__module__, None) if kind.__module__.startswith("ballbot_") else None
    for registry, kept in zip((TASKS, ROBOTS, gymnasium.registry), before, strict=True):
        if dict(registry) != kept:
            registry.clear()
            registry.update(kept)


@pytest.fixture(autouse=True)
def own_optima(tmp_path_factory, monkeypatch):
    """Optima that a test computes are its own, here and in the processes that it starts: an empty cache for each."""
    # not `mktemp`, which looks at all that there are
    monkeypatch.setenv("BALLBOT_OPTIMA", str(tmp_path_factory.getbasetemp() / "optima" / str(next(_NUMBERS))))


@pytest.fixture
def interpreted(monkeypatch):
    """The test's solvers are its own, and not compiled.

    For a problem that no other test solves, compiling takes longer than solving without machine code.
    """
    compiled, nlp, shooting = (
        pytest.importorskip(f"ballbot_baselines.solvers.{name}") for name in ("compiled", "nlp", "shooting")
    )
    monkeypatch.setattr(compiled, "_loaded", lambda *_: None)
    monkeypatch.setattr(nlp, "_dynamics_made", {})
    for name in ("ocp_of", "_solver"):
        monkeypatch.setattr(shooting, name, functools.cache(getattr(shooting, name).__wrapped__))


@pytest.fixture(scope="session")
def demos(tmp_path_factory):
    """Four episodes of Stabilize under LQR, as a dataset."""
    from ballbot_train.learning.demonstrations import DemoConfig, write_demos

    config = DemoConfig("stabilize", "lqr", episodes=4, physics="rk4")
    return write_demos(config, tmp_path_factory.mktemp("demos") / "tiny-v0", 1)


@pytest.fixture
def make_env():
    """Makes environments that are closed after the test."""
    envs = []

    def make(task="stabilize", **kwargs):
        envs.append(ballbot_gym.BallbotEnv(task, **kwargs))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@pytest.fixture
def typed(tmp_path, monkeypatch, capsys):
    """What `ballbot` does with arguments in an empty folder: its exit status, and all that it prints, in one line.

    It runs in this process, because each new one needs seconds to import what it needs.
    """
    from ballbot_train import cli

    def run(*arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", ["ballbot", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        printed = capsys.readouterr()
        return ended.value.code, " ".join((printed.out + printed.err).split())

    return run
