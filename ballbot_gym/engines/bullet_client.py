"""PyBullet's clients, and how the robot is loaded into one."""

import ctypes
import importlib.util
import locale
import math
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import ModuleType

from ballbot_gym.params import BallbotParams

_JOINTS = ("x", "y", "gamma", "theta", "psi")  # the last where wheels turn the body
_loading = threading.Lock()

HOW_TO_GET_IT = 'Get it with "pip install pybullet", under Python 3.11 or older: newer ones have no wheel.'


def has_pybullet() -> bool:
    """Whether PyBullet is installed."""
    return importlib.util.find_spec("pybullet") is not None


def import_pybullet() -> ModuleType:
    """PyBullet, or an ImportError that says how to get it, and what to do otherwise."""
    try:
        with _silenced() if "pybullet" not in sys.modules else nullcontext():  # it prints when it was built
            import pybullet
    except ImportError as error:
        raise ImportError(
            f'PyBullet is not installed. {HOW_TO_GET_IT} Or use physics="rk4", which needs only NumPy.'
        ) from error
    if not pybullet.isNumpyEnabled():
        raise ImportError(
            "This PyBullet was built without NumPy. Reinstall its wheel with "
            '"pip install --force-reinstall --only-binary=:all: pybullet", or install NumPy first and build again.'
        )
    return pybullet


@contextmanager
def _silenced() -> Iterator[None]:
    """Drops what C code prints within the block."""
    # C buffers what it prints into a pipe, so its buffer must be emptied before and after
    flush = getattr(ctypes.CDLL(None), "fflush", lambda _: None) if os.name == "posix" else lambda _: None
    kept: dict[int, int] = {}
    flush(None)
    with open(os.devnull, "wb") as nothing:
        for stream in (1, 2):
            with suppress(OSError):  # it is closed, so nothing can be printed to it
                kept[stream] = os.dup(stream)
                os.dup2(nothing.fileno(), stream)
    try:
        yield
    finally:
        flush(None)
        for stream, original in kept.items():
            os.dup2(original, stream)
            os.close(original)


def connect(bullet: ModuleType) -> int:
    """A new physics client."""
    client = bullet.connect(bullet.DIRECT)
    if client < 0:
        raise RuntimeError("PyBullet has no free physics client; close() environments that are no longer used")
    return client


def load_robot(bullet: ModuleType, client: int, params: BallbotParams) -> tuple[int, tuple[int, ...]]:
    """Loads the robot without motors, damping or joint speed limits; returns its body and its joints in order."""
    with tempfile.TemporaryDirectory() as folder, _loading:
        path = Path(folder) / "ballbot.urdf"
        path.write_text(params.to_urdf(), encoding="utf-8")
        # Bullet reads numbers by the process's locale: with decimal commas it would take "0.5" for 0 without a word.
        found = locale.setlocale(locale.LC_NUMERIC)
        locale.setlocale(locale.LC_NUMERIC, "C")
        try:
            # Without this flag Bullet recomputes inertias from collision shapes.
            options = {"useFixedBase": True, "flags": bullet.URDF_USE_INERTIA_FROM_FILE, "physicsClientId": client}
            robot = bullet.loadURDF(str(path), **options)
        finally:
            locale.setlocale(locale.LC_NUMERIC, found)
    bullet.setGravity(0, 0, -params.gravity, physicsClientId=client)
    index = joint_indices(bullet, client, robot)
    joints = tuple(index[name] for name in _JOINTS if name in index)
    for joint in range(-1, len(index)):
        bullet.changeDynamics(
            robot,
            joint,
            linearDamping=0,
            angularDamping=0,
            jointDamping=0,
            maxJointVelocity=1e4,
            physicsClientId=client,
        )
    # Bullet's joints start with a velocity motor that holds them.
    bullet.setJointMotorControlArray(
        robot, joints, bullet.VELOCITY_CONTROL, forces=[0] * len(joints), physicsClientId=client
    )
    return robot, joints


def joint_indices(bullet: ModuleType, client: int, robot: int) -> dict[str, int]:
    """The index of every joint, and of the link that it carries, by the joint's name."""
    count = bullet.getNumJoints(robot, physicsClientId=client)
    return {bullet.getJointInfo(robot, i, physicsClientId=client)[1].decode(): i for i in range(count)}


def set_surface(bullet: ModuleType, client: int, body: int, link: int, friction: float) -> None:
    """Friction as given, and nothing else that acts at a contact."""
    # A call that sets damping too would drop lateralFriction without a word.
    bullet.changeDynamics(
        body,
        link,
        lateralFriction=friction,
        rollingFriction=0,
        spinningFriction=0,
        restitution=0,
        physicsClientId=client,
    )
    found = bullet.getDynamicsInfo(body, link, physicsClientId=client)[1]
    if not math.isclose(found, friction, rel_tol=1e-6):
        raise RuntimeError(f"PyBullet took {found} for a friction of {friction}")
