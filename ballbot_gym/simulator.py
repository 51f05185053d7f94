"""Simulators of the ballbot with one interface.

`BulletSimulator` loads the URDF into PyBullet; `Rk4Simulator` integrates the closed form and needs no PyBullet.
"""

import ctypes
import importlib.util
import math
import os
import sys
import tempfile
import warnings
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import ModuleType
from typing import Protocol

from ballbot_gym import dynamics
from ballbot_gym.ops import is_number
from ballbot_gym.params import BallbotParams

State = tuple[float, ...]
"""(8,) state as a tuple of floats; order and units in `dynamics.STATE`."""

_MOST_SUBSTEPS = 10_000
_JOINTS = ("x", "y", "gamma", "theta")


class Simulator(Protocol):
    """One ballbot whose force is held over control steps."""

    def reset(self, x: State) -> None:
        """Puts the robot into state x."""

    def set_params(self, params: BallbotParams) -> None:
        """Replaces the robot; call `reset` after it."""

    def step(self, u: tuple[float, float]) -> State:
        """Holds force u, N, for one control step and returns the state after it."""
        ...

    def close(self) -> None:
        """Releases what the simulator holds; may be called again."""


class Rk4Simulator:
    """The closed-form model, integrated by RK4 steps of at most `dynamics.RK4_STEP`."""

    def __init__(self, params: BallbotParams, control_dt: float, physics_dt: float | None = None):
        """Args: as for `BulletSimulator`; physics_dt defaults to `dynamics.RK4_STEP`."""
        self._params = params
        self._dt = control_dt
        self._substeps = (
            dynamics.substeps_for(control_dt) if physics_dt is None else _whole_substeps(control_dt, physics_dt)
        )
        self._x: State = (0.0,) * 8

    def reset(self, x: State) -> None:
        self._x = x

    def set_params(self, params: BallbotParams) -> None:
        self._params = params

    def step(self, u: tuple[float, float]) -> State:
        self._x = dynamics.step(self._params, self._x, u, self._dt, self._substeps)
        return self._x

    def close(self) -> None:
        pass


class BulletSimulator:
    """The URDF in PyBullet, in a physics client that this object owns."""

    def __init__(self, params: BallbotParams, control_dt: float, physics_dt: float | None = None):
        """Loads the robot.

        Args:
            params: the robot.
            control_dt: s, how long each force is held.
            physics_dt: s, Bullet's step, a whole fraction of control_dt; default 1 ms. Bullet is of first order: its
                error halves with this step.

        Raises:
            ImportError: PyBullet is missing or was built without NumPy.
            RuntimeError: PyBullet has no client left.
        """
        substeps = _whole_substeps(control_dt, 0.001 if physics_dt is None else physics_dt)
        bullet = import_pybullet()
        self._client = connect(bullet, bullet.DIRECT)
        self._release = weakref.finalize(self, bullet.disconnect, self._client)
        self._robot, self._joints = load_robot(bullet, self._client, params)
        # Substeps run in C++ with the force held. Results are bit-identical to single steps, a third faster.
        bullet.setPhysicsEngineParameter(fixedTimeStep=control_dt, numSubSteps=substeps, physicsClientId=self._client)
        bullet.setGravity(0, 0, -params.gravity, physicsClientId=self._client)
        self._bullet, self._com_height = bullet, params.com_height

    def reset(self, x: State) -> None:
        # Joints are reset in place: reloading the URDF takes a hundred times longer.
        for i, joint in enumerate(self._joints):
            self._bullet.resetJointState(self._robot, joint, x[i], x[i + 4], physicsClientId=self._client)

    def set_params(self, params: BallbotParams) -> None:
        bullet, client = self._bullet, self._client
        if params.com_height != self._com_height:
            # The URDF is loaded again, because changeDynamics cannot move a link's centre of mass.
            bullet.removeBody(self._robot, physicsClientId=client)
            self._robot, self._joints = load_robot(bullet, client, params)
            self._com_height = params.com_height
            return
        ball, body = self._joints[1], self._joints[3]  # a link has the index of the joint that carries it
        inertia = (params.inertia, params.inertia, params.axial_inertia)
        bullet.changeDynamics(self._robot, ball, mass=params.ball_mass, physicsClientId=client)
        bullet.changeDynamics(
            self._robot, body, mass=params.body_mass, localInertiaDiagonal=inertia, physicsClientId=client
        )

    def step(self, u: tuple[float, float]) -> State:
        bullet, client, robot = self._bullet, self._client, self._robot
        bullet.setJointMotorControlArray(
            robot, self._joints[:2], bullet.TORQUE_CONTROL, forces=u, physicsClientId=client
        )
        bullet.stepSimulation(physicsClientId=client)
        a, b, c, d = bullet.getJointStates(robot, self._joints, physicsClientId=client)
        return (a[0], b[0], c[0], d[0], a[1], b[1], c[1], d[1])

    def close(self) -> None:
        self._release()


PHYSICS: dict[str, type[BulletSimulator] | type[Rk4Simulator]] = {"bullet": BulletSimulator, "rk4": Rk4Simulator}
"""Simulators by the name that `gymnasium.make(..., physics=name)` takes."""


def default_physics() -> str:
    """What `physics` is by default: "bullet" where PyBullet is installed; else "rk4", with one warning per process."""
    if importlib.util.find_spec("pybullet") is not None:
        return "bullet"
    if not _noticed:
        _noticed.append(True)
        warnings.warn(f'PyBullet is not installed: physics="rk4" is used. {_HOW_TO_GET_IT}', stacklevel=3)
    return "rk4"


PHYSICS_NAMES = {"bullet": "PyBullet", "rk4": "the closed-form model"}
"""What people call each physics."""

_noticed: list[bool] = []

_HOW_TO_GET_IT = 'Get it with "pip install pybullet" (wheels exist up to Python 3.11).'


def import_pybullet() -> ModuleType:
    """PyBullet, or an ImportError that says what to do."""
    try:
        with _silenced() if "pybullet" not in sys.modules else nullcontext():  # it prints when it was built
            import pybullet
    except ImportError as error:
        raise ImportError(
            f'PyBullet is not installed. {_HOW_TO_GET_IT} Or use physics="rk4", which needs only NumPy.'
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


def connect(bullet: ModuleType, mode: int) -> int:
    """A new physics client."""
    client = bullet.connect(mode)
    if client < 0:
        raise RuntimeError("PyBullet has no free physics client; close() environments that are no longer used")
    return client


def load_robot(bullet: ModuleType, client: int, params: BallbotParams) -> tuple[int, tuple[int, ...]]:
    """Loads the robot without motors, damping or joint speed limits; returns its body and its four joints in order."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ballbot.urdf"
        path.write_text(params.to_urdf())
        robot = bullet.loadURDF(
            str(path),
            useFixedBase=True,
            # Without this flag Bullet recomputes inertias from collision shapes.
            flags=bullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
    count = bullet.getNumJoints(robot, physicsClientId=client)
    index = {bullet.getJointInfo(robot, i, physicsClientId=client)[1].decode(): i for i in range(count)}
    joints = tuple(index[name] for name in _JOINTS)
    for joint in range(-1, count):
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


def _whole_substeps(control_dt: float, physics_dt: float) -> int:
    if not is_number(physics_dt):
        raise ValueError(f"physics_dt must be a number of seconds, not {physics_dt!r}")
    substeps = round(control_dt / physics_dt) if physics_dt > control_dt / (_MOST_SUBSTEPS + 0.5) else 0
    if substeps < 1 or not math.isclose(substeps * physics_dt, control_dt, rel_tol=1e-9):
        raise ValueError(
            f"physics_dt = {physics_dt} s must be a whole fraction of control_dt = {control_dt} s, and at least "
            f"1/{_MOST_SUBSTEPS} of it"
        )
    return substeps
