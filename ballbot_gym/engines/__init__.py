"""The engines: one simulator a file behind the `Simulator` protocol."""

import warnings
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from ballbot_gym.engines.bullet import BulletContactSimulator, BulletOmniSimulator, BulletSimulator
from ballbot_gym.engines.bullet_client import HOW_TO_GET_IT, import_pybullet
from ballbot_gym.engines.closed_form import Rk4Simulator
from ballbot_gym.engines.mujoco import MujocoContactSimulator, MujocoOmniSimulator, MujocoSimulator, import_mujoco
from ballbot_gym.engines.simulator import Simulator, State
from ballbot_gym.lazy import install
from ballbot_gym.params import BallbotParams

__all__ = [
    "PHYSICS",
    "PHYSICS_ALIASES",
    "PHYSICS_NAMES",
    "Simulator",
    "State",
    "check_installed",
    "checked_physics",
    "default_physics",
    "installed_physics",
    "make_simulator",
]

PHYSICS: dict[str, tuple[Callable[..., Simulator], Callable[..., Simulator], Callable[..., Simulator]]] = {
    "bullet": (BulletSimulator, BulletContactSimulator, BulletOmniSimulator),
    "mujoco": (MujocoSimulator, MujocoContactSimulator, MujocoOmniSimulator),
    "rk4": (Rk4Simulator, Rk4Simulator, Rk4Simulator),
}
"""Simulators by the name that `gymnasium.make(..., physics=name)` takes: of a ball that translates, of one that rolls, and of
one that wheels drive.

The first that is installed is the default.
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


def checked_physics(physics: Any) -> str:
    """The name in `PHYSICS` of a physics that is given by it or by another of `PHYSICS_ALIASES`; None is the default.

    Raises:
        ValueError: no physics of that name.
    """
    if physics is None:
        return default_physics()
    name = PHYSICS_ALIASES.get(physics, physics) if isinstance(physics, str) else physics
    if not isinstance(name, str) or name not in PHYSICS:
        raise ValueError(f"unknown physics {physics!r}; known: {', '.join(map(repr, PHYSICS))}")
    return name


def check_installed(physics: str) -> None:
    """Raises an ImportError that says how to get a physics that this machine cannot run."""
    if physics == "bullet":
        import_pybullet()
    elif physics == "mujoco":
        import_mujoco()


def default_physics() -> str:
    """What `physics` is by default: the first that is installed. "rk4" comes with one warning per process."""
    best = installed_physics()[0]
    if best == "rk4" and not _noticed:
        _noticed.append(True)
        warnings.warn(
            f'Neither PyBullet nor MuJoCo is installed: physics="rk4" is used. For MuJoCo: {install("mujoco")}. '
            f"PyBullet: {HOW_TO_GET_IT}",
            stacklevel=4,
        )
    return best


def make_simulator(
    physics: str, params: BallbotParams, control_dt: float, physics_dt: float | None = None
) -> Simulator:
    """The simulator of a robot, with contact where its ball rolls, except in "rk4". Args: as for `BulletSimulator`."""
    kind = params.rolls if params.wheels is None else 2
    return PHYSICS[physics][kind](params, control_dt, physics_dt)
