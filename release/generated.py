"""All C code that the shipped robots and tasks generate, recorded while environments, optima and experts run.

    python release/generated.py FOLDER   writes each code to a file in the folder, and their flags to codes.json

The libraries are compiled too, into the user's cache, because optima and experts need them to run.
"""

import itertools
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np

from ballbot_baselines import CONTROLLERS, find_optima, find_optimum
from ballbot_gym import BallbotEnv, BallbotVectorEnv, machine_code, rollout
from ballbot_gym.engines import installed_physics
from ballbot_gym.env import make_task
from ballbot_gym.machine_code import Code, codegen
from ballbot_gym.robot import PAPER, ROBOTS
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import TASKS
from ballbot_gym.vector import native
from ballbot_train import evaluate_fresh

EXPERTS = ("nmpc", "trajopt")
"""The experts that compile something; LQR compiles nothing."""

_BATCH = 8  # episodes whose optima are found at once


@contextmanager
def recorded() -> Iterator[list[Code]]:
    """Collects the code of all libraries that are asked for within the block."""
    found: dict[Code, None] = {}
    library = machine_code.library

    def recording(name: str, source: str, flags: tuple[str, ...] = ("-O2",)) -> Path:
        found[Code(name, source, flags)] = None
        return library(name, source, flags)

    codes: list[Code] = []
    machine_code.library = recording
    try:
        yield codes
    finally:
        machine_code.library = library
        codes.extend(found)


def environments(task: str, robot: str) -> None:
    """Runs a single environment in every engine, and vector environments, those of the paper's robot in both precisions."""
    for physics in installed_physics():
        env = BallbotEnv(task, physics, robot=robot)
        env.reset(seed=0)
        env.step(np.zeros(env.params.action_size))
        env.close()
    for dtype in ("float32", "float64") if robot == PAPER else ("float32",):
        envs = BallbotVectorEnv(2, task, robot=robot, dtype=dtype, engine="native")
        envs.reset(seed=0)
        envs.step(np.zeros((2, envs.params.action_size), np.float32))


def experts(task: str, robot: str) -> None:
    """Finds optima one by one and many at once, and runs the experts for a few control steps."""
    made = make_task(task, robot)
    params = ROBOTS[robot].params
    rng = np.random.default_rng(0)
    starts = [made.sample(rng, params) for _ in range(_BATCH)]
    with suppress(PlanError):
        find_optimum(made, params, *starts[0])
    x, c = (np.array(part) for part in zip(*starts, strict=True))
    with suppress(PlanError, NotImplementedError, ValueError):
        find_optima(made, params, x, c)
    for name in EXPERTS:
        with suppress(PlanError):
            rollout(BallbotEnv(made, physics="rk4", robot=params), CONTROLLERS[name](made, params), seed=0)


def policies() -> None:
    """Runs a policy in many episodes at once. All policies run by the same code."""
    evaluate_fresh("apg", "stabilize", _BATCH, workers=1)


def runs() -> Iterator[tuple[str, Callable[[], None]]]:
    """What is run so that all code is asked for. Experts of robots with wheels are left out: they take minutes."""
    yield "policies", policies
    for robot, task in itertools.product(ROBOTS, TASKS):
        yield f"{robot} {task}", partial(environments, task, robot)
        if not ROBOTS[robot].params.LONG_EQUATIONS:
            yield f"{robot} {task} experts", partial(experts, task, robot)


def generated() -> Iterator[Code]:
    """The code of every shipped robot and task, each once."""
    seen: set[Code] = set()
    for name, run in runs():
        with recorded() as found:
            run()
        yield from (code for code in found if code not in seen)
        seen |= set(found)
        print(f"{name}: {len(seen)} libraries so far", flush=True)


def write(codes: Iterator[Code], folder: Path) -> None:
    """Writes code to a folder, from which `read` reads it."""
    folder.mkdir(parents=True, exist_ok=True)
    listed = []
    for code in codes:
        (folder / f"{code.stem()}.c").write_text(code.source, encoding="utf-8")
        listed.append({"name": code.name, "file": f"{code.stem()}.c", "flags": code.flags})
    (folder / "codes.json").write_text(json.dumps(listed, indent=1), encoding="utf-8")


def write_sources(folder: Path) -> None:
    """Writes the code of environments under the names by which they find it where CasADi is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for robot, task, double in itertools.product(ROBOTS, TASKS, (False, True)):
        made, params = make_task(task, robot), ROBOTS[robot].params
        source = codegen.source(made, params, double)
        (folder / f"{native.code_name(made, params, double)}.c").write_text(source, encoding="utf-8")
    for robot, task, physics in itertools.product(ROBOTS, TASKS, installed_physics()):
        params = ROBOTS[robot].params
        problem = BallbotEnv(task, physics, robot=robot).step_problem
        (folder / f"{problem.code_name(params)}.c").write_text(problem.source(), encoding="utf-8")


def read(folder: Path) -> list[Code]:
    """The code that `write` wrote."""
    listed = json.loads((folder / "codes.json").read_text(encoding="utf-8"))
    return [
        Code(each["name"], (folder / each["file"]).read_text(encoding="utf-8"), tuple(each["flags"])) for each in listed
    ]


if __name__ == "__main__":
    write_sources(Path(sys.argv[1]) / "source")
    write(generated(), Path(sys.argv[1]))
