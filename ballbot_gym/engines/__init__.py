"""The engines: one simulator a file behind the `Simulator` protocol."""

import warnings
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from ballbot_gym.engines import bullet, mujoco
from ballbot_gym.engines.bullet_client import HOW_TO_GET_IT, import_pybullet
from ballbot_gym.engines.closed_form import Rk4Simulator
from ballbot_gym.engines.simulator import Simulator, State
from ballbot_gym.lazy import install
from ballbot_gym.robot import Robot

__all__ = [
    "PHYSICS",
    "PHYSICS_ALIASES",
    "PHYSICS_NAMES",
    "Simulator",
    "State",
    "checked_physics",
    "default_physics",
    "installed_physics",
    "make_simulator",
]

PHYSICS: dict[str, dict[type[Robot], Callable[..., Simulator]]] = {
    "bullet": bullet.SIMULATORS,
    "mujoco": mujoco.SIMULATORS,
    "rk4": {Robot: Rk4Simulator},
}
"""Simulators by the name that `gymnasium.make(..., physics=name)` takes, and by the kind of robot that they simulate.

The first that is installed, and simulates the robot, is the default.
"""

PHYSICS_NAMES = {"bullet": "PyBullet", "mujoco": "MuJoCo", "rk4": "the closed-form model"}
"""What people call each physics."""

PHYSICS_ALIASES = {"pybullet": "bullet"}
"""Other names that people type."""

_noticed: list[bool] = []


def installed_physics() -> list[str]:
    """The physics that this machine can run, in the order of `PHYSICS`."""
    libraries = {"bullet": "pybullet", "mujoco": "mujoco", "rk4": "numpy"}
    return [name for name in PHYSICS if find_spec(libraries[name]) is not None]


def checked_physics(physics: Any, params: Robot | None = None) -> str:
    """The name in `PHYSICS` of a physics that is given by it or by another of `PHYSICS_ALIASES`; None is the default.

    With a robot the default is one that simulates it.

    Raises:
        ValueError: no physics of that name.
        ImportError: this machine cannot run it; the message says how to get it.
    """
    if physics is None:
        return default_physics(params)
    name = PHYSICS_ALIASES.get(physics, physics) if isinstance(physics, str) else physics
    if not isinstance(name, str) or name not in PHYSICS:
        raise ValueError(f"unknown physics {physics!r}; known: {', '.join(map(repr, PHYSICS))}")
    if name == "bullet":
        import_pybullet()
    elif name == "mujoco":
        mujoco.import_mujoco()
    return name


def default_physics(params: Robot | None = None) -> str:
    """What `physics` is by default: the first that is installed, and simulates the robot if one is given.

    "rk4" comes with one warning per process where other physics could be installed.
    """
    able = [name for name in PHYSICS if params is None or _simulator_of(name, params)]
    best = next(name for name in able if name in installed_physics())
    if len(able) > 1 and best == "rk4" and not _noticed:
        _noticed.append(True)
        warnings.warn(
            f'Neither PyBullet nor MuJoCo is installed: physics="rk4" is used. For MuJoCo: {install("mujoco")}. '
            f"PyBullet: {HOW_TO_GET_IT}",
            stacklevel=4,
        )
    return best


def make_simulator(physics: str, params: Robot, control_dt: float, physics_dt: float | None = None) -> Simulator:
    """The simulator of a robot, with contact where its ball rolls, except in "rk4".

    Args:
        physics: a name in `PHYSICS`.
        params: the robot.
        control_dt: s, how long each force is held.
        physics_dt: s, the engine's step, a whole fraction of control_dt; default, one that suits the engine.

    Raises:
        ValueError: this physics does not simulate this kind of robot.
    """
    simulator = _simulator_of(physics, params)
    if simulator is None:
        able = ", ".join(repr(name) for name in PHYSICS if _simulator_of(name, params))
        raise ValueError(f"{PHYSICS_NAMES[physics]} does not simulate a {type(params).__name__}; give physics={able}")
    return simulator(params, control_dt, physics_dt)


def _simulator_of(physics: str, params: Robot) -> Callable[..., Simulator] | None:
    """The simulator that was made for the nearest of a robot's classes."""
    return next((PHYSICS[physics][kind] for kind in type(params).__mro__ if kind in PHYSICS[physics]), None)
