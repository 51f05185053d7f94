"""Registration of tasks: by a call in the module that defines one, or by an entry point of its package.

`register_robot` does the same for robots. Names reach other processes in two ways. Gymnasium's spec of a registered task
names its module, `MODULE:NAME`, and `gymnasium.make` imports that module. Processes that this package starts get
`registered()`.
"""

import enum
import inspect
import re
import sys
import warnings
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, replace
from importlib import import_module, metadata
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from ballbot_gym.robot import (
    PAPER,
    ROBOTS,
    Randomization,
    Registered,
    Robot,
    check_name,
    named_robot,
    register_robot,
    short_name,
)
from ballbot_gym.tasks import SHIPPED, TASKS, Task
from ballbot_gym.tasks.checks import check_methods

TASKS_GROUP, ROBOTS_GROUP = "ballbot_gym.tasks", "ballbot_gym.robots"
"""Groups of entry points. One of a task names its class; one of a robot names a function that calls `register_robot`."""

_MAIN = ("__main__", "__mp_main__")  # the same script, here and in the processes that multiprocessing starts
_SHIPPED_ROBOTS = tuple(ROBOTS)


def register_task(kind: type[Task], name: str | None = None) -> type[Task]:
    """Registers a class of tasks under a name and its Gymnasium id, which all commands accept. It may be used as a decorator.

    If a class of the same name is registered again, for example by a notebook cell that runs twice, it replaces the old one.

    Args:
        kind: a dataclass that derives from `Task`, with all of its methods.
        name: small letters, digits and underscores; default, the class's name: `FigureEight` is "figure_eight".

    Raises:
        TypeError: it is no such class, or a method or an attribute is missing; the message names it.
        ValueError: the name or the id is taken or malformed, or a method gives what nothing can use.
    """
    _check_class(kind)
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.__name__).lower() if name is None else name
    check_name(name, "task")
    for known, other in TASKS.items():
        if known == name and not _is_same(kind, other):
            raise ValueError(
                f"register_task: the name {name!r} is taken by {other.__module__}.{other.__qualname__}; "
                f'give another: register_task({kind.__name__}, "my_{name}")'
            )
        if known != name and other.id == kind.id:
            raise ValueError(
                f"register_task: the id {kind.id} of {kind.__name__} is taken by {other.__qualname__}; give it its own id"
            )
    if name not in TASKS and kind.id in gymnasium.registry:
        raise ValueError(
            f"register_task: the id {kind.id} of {kind.__name__} is taken in Gymnasium; give it another id"
        )
    if kind not in SHIPPED:
        task, robot = kind(), named_robot(kind.ROBOT)
        check_methods(task, robot, *task.sample(np.random.default_rng(0), robot))
    module = "" if kind in SHIPPED or kind.__module__ in _MAIN else f"{kind.__module__}:"
    gymnasium.registry.pop(kind.id, None)
    gymnasium.register(
        id=kind.id,
        entry_point="ballbot_gym.env:BallbotEnv",
        # imported, with torch, when first used
        vector_entry_point="ballbot_gym.vector:BallbotVectorEnv",
        kwargs={"task": f"{module}{name}"},
        reward_threshold=kind.reward_threshold,
    )
    TASKS[name] = kind
    return kind


def named_task(name: Any) -> str:
    """The name in `TASKS` of a task that is given by it, by its id or that of its counterpart, or by MODULE:NAME. Hyphens may
    take the place of underscores.

    Raises:
        ValueError: no task of that name.
    """
    known = {f"{kind.__module__}:{short}": short for short, kind in TASKS.items()}
    short = (known.get(name) or short_name(name)) if isinstance(name, str) else None
    short = next((known for known, kind in TASKS.items() if short and short in (kind.id, kind.counterpart)), short)
    if short not in TASKS and isinstance(short, str) and short.replace("-", "_") in TASKS:
        return short.replace("-", "_")
    if short not in TASKS:
        raise ValueError(
            f"unknown task {name!r}; known: {', '.join(map(repr, TASKS))}, or MODULE:NAME where your module calls "
            "register_task"
        )
    return short


def own_robot(task: str, robot: str = PAPER) -> str:
    """The name of the robot that does a task where one is named, or the default: then it is the one that the task names."""
    return TASKS[named_task(task)].ROBOT if robot == PAPER else robot


def name_of(task: Task) -> str | None:
    """The name in `TASKS` of a task's class; None where it has none."""
    return next((name for name, kind in TASKS.items() if type(task) is kind), None)


def spec_of(
    spec: EnvSpec | None, task: Task, params: Robot, randomization: Randomization, steps: int | None = None
) -> EnvSpec | None:
    """The spec of an env, from its registered spec: with the env's own number of control steps, and without a reward
    threshold if another problem, robot or pay makes the threshold meaningless.

    Its keywords are such that `to_json` can write them and the env can be made of them again, unless the task is an object
    of a class that is not in `TASKS`.

    Episodes are truncated by the envs themselves, so no `TimeLimit` is registered: it would cut longer durations.
    """
    if spec is None:
        return None
    kind = type(task)()
    usual = task.problem() == kind.problem() and task.survival_reward == kind.survival_reward
    usual = usual and params == named_robot(PAPER) and not randomization.active
    keywords = {name: _plain(value) for name, value in spec.kwargs.items() if name != "max_episode_steps"}
    if isinstance(keywords.get("task"), Task):
        name = name_of(task)
        keywords |= {} if name is None else {"task": name, **asdict(task)}
    return replace(
        spec,
        max_episode_steps=task.steps if steps is None else steps,
        reward_threshold=spec.reward_threshold if usual else None,
        kwargs=keywords,
    )


def _plain(value: Any) -> Any:
    """The value of a keyword in JSON, if envs also take it as a word or a number."""
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, np.generic):
        return value.item()
    is_torchs = type(value).__module__ == "torch" and type(value).__name__ in ("device", "dtype")
    return str(value).removeprefix("torch.") if is_torchs else value


def _is_same(kind: type, other: type) -> bool:
    """Whether two classes are one definition, that ran twice perhaps."""
    module, known = ("__main__" if each.__module__ in _MAIN else each.__module__ for each in (kind, other))
    return (module, kind.__qualname__) == (known, other.__qualname__)


def _check_class(kind: Any) -> None:
    """Raises a TypeError that names what a class lacks to be a task, or a ValueError for a malformed id."""
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise TypeError(f"register_task takes a class that derives from ballbot_gym.Task, not {kind!r}")
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        raise TypeError(f"{kind.__name__} has no {', '.join(missing)}: define what ballbot_gym.Task declares")
    for name in ("id", "observation_scale"):
        if not hasattr(kind, name):
            raise TypeError(f"{kind.__name__} has no {name}: set the class attribute that ballbot_gym.Task declares")
    if not isinstance(kind.id, str) or not re.fullmatch(r"([\w-]+/)?[\w:.-]+-v\d+", kind.id):
        raise ValueError(f'{kind.__name__}.id must be an id of Gymnasium, such as "BallbotEight-v0", not {kind.id!r}')
    known = {field.name for field in fields(kind)}
    own = inspect.get_annotations(kind)
    unknown = [name for name in own if name not in known and "ClassVar" not in str(own[name])]
    if unknown:
        raise TypeError(
            f"{kind.__name__}.{unknown[0]} is not a field: decorate {kind.__name__} with @dataclass(frozen=True), or "
            "annotate it as a ClassVar"
        )
    for field in fields(kind):
        if field.default is MISSING and field.default_factory is MISSING:
            raise TypeError(f"{kind.__name__}.{field.name} has no default: every field of a task needs one")


def load_plugins() -> None:
    """Registers what installed packages announce. One that fails is left out with a warning that names it."""
    for group in (ROBOTS_GROUP, TASKS_GROUP):  # tasks name their robots
        for entry in metadata.entry_points(group=group):
            spec = getattr(sys.modules.get(entry.module), "__spec__", None)
            if getattr(spec, "_initializing", False):
                continue  # it imports us, and registers what it has itself
            try:
                found = entry.load()
                register_task(found, entry.name) if group == TASKS_GROUP else found()
            except (Exception, SystemExit) as error:  # a module that exits must not end the process that imports it
                package = entry.dist.name if entry.dist else "a package"
                warnings.warn(f"{package}: {group} {entry.name!r} ({entry.value}) fails: {error!r}", stacklevel=2)


def registered() -> tuple[tuple[str, ...], dict[str, Registered]]:
    """What `restore` needs in another process: modules that registered tasks, and the robots that do not come with us."""
    modules = {kind.__module__: None for kind in TASKS.values() if kind not in SHIPPED}
    robots = {name: robot for name, robot in ROBOTS.items() if name not in _SHIPPED_ROBOTS}
    return tuple(name for name in modules if name not in _MAIN and name in sys.modules), robots


def restore(modules: tuple[str, ...], robots: Mapping[str, Registered]) -> None:
    """Registers here what `registered` gave in another process."""
    for module in modules:
        import_module(module)
    for name, robot in robots.items():
        register_robot(name, robot.params, robot.fields)
