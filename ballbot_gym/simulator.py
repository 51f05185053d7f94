"""Simulators of the ballbot with one interface.

`BulletSimulator` loads the URDF into PyBullet; `Rk4Simulator` integrates the closed form and needs no PyBullet.
"""

import ctypes
import importlib.util
import locale
import math
import os
import sys
import tempfile
import threading
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
from ballbot_gym.step_code import Motion

State = tuple[float, ...]
"""(8,) state as a tuple of floats; order and units in `dynamics.STATE`."""

_MOST_SUBSTEPS = 10_000
_JOINTS = ("x", "y", "gamma", "theta")
_0 = (0.0, 0.0)
_PRESSED = -1e-5  # m: height of the ball at reset, about where its weight presses it
_MOST_FRICTION = 1e3  # what Bullet takes for unlimited friction


class Simulator(Protocol):
    """One ballbot whose force is held over control steps."""

    def reset(self, x: State) -> None:
        """Puts the robot into state x."""

    def set_params(self, params: BallbotParams) -> None:
        """Replaces the robot by one whose ball rolls as well, or as little; call `reset` after it."""

    def step(self, u: tuple[float, float]) -> State:
        """Holds force u, N, for one control step and returns the state after it."""
        ...

    def floor_force(self) -> tuple[float, float, float] | None:
        """The floor's force on the ball, (f_x, f_y, N) in N, at the end of the last step; None where it is not simulated."""
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
        self._motion: Motion | None = None  # in machine code

    def reset(self, x: State) -> None:
        self._x = x

    def set_params(self, params: BallbotParams) -> None:
        _check_rolling(params, self._params.rolls)
        self._params = params
        if self._motion is not None:
            self._motion.set_params(params)

    def use_code(self, start: bool) -> None:
        """Takes machine code if there is some; if start, it is made in the background."""
        if self._motion is None and (code := Motion.made(self._params.rolls, start)) is not None:
            self._motion = Motion(code, self._params, self._dt, self._substeps)

    def step(self, u: tuple[float, float]) -> State:
        x = None if self._motion is None else self._motion.step(self._x, u)
        self._x = dynamics.step(self._params, self._x, u, self._dt, self._substeps) if x is None else x
        return self._x

    def floor_force(self) -> None:
        return None

    def close(self) -> None:
        pass


class BulletSimulator:
    """The URDF of a robot whose ball translates in PyBullet, in a physics client that this object owns."""

    def __init__(self, params: BallbotParams, control_dt: float, physics_dt: float | None = None):
        """Loads the robot.

        Args:
            params: the robot.
            control_dt: s, how long each force is held.
            physics_dt: s, Bullet's step, a whole fraction of control_dt; default 1 ms. Bullet is of first order: its
                error halves with this step.

        Raises:
            ImportError: PyBullet is missing or was built without NumPy.
            RuntimeError: PyBullet has no client left, or holds another robot than that of params.
        """
        substeps = _whole_substeps(control_dt, 0.001 if physics_dt is None else physics_dt)
        bullet = import_pybullet()
        self._client = connect(bullet, bullet.DIRECT)
        self._release = weakref.finalize(self, bullet.disconnect, self._client)
        self._robot, self._joints = load_robot(bullet, self._client, params)
        self._params = params
        # Substeps run in C++ with the force held. Results are bit-identical to single steps, a third faster.
        bullet.setPhysicsEngineParameter(fixedTimeStep=control_dt, numSubSteps=substeps, physicsClientId=self._client)
        self._bullet = bullet

    def reset(self, x: State) -> None:
        # Joints are reset in place: reloading the URDF takes a hundred times longer.
        for i, joint in enumerate(self._joints):
            self._bullet.resetJointState(self._robot, joint, x[i], x[i + 4], self._client)

    def set_params(self, params: BallbotParams) -> None:
        bullet, client, old = self._bullet, self._client, self._params
        if (params.com_height, params.gravity, params.rolls) != (old.com_height, old.gravity, old.rolls):
            self._reload(params)  # changeDynamics cannot move a link's centre of mass
            return
        self._params = params
        ball, body = self._joints[1], self._joints[3]  # a link has the index of the joint that carries it
        inertia = (params.inertia, params.inertia, params.axial_inertia)
        bullet.changeDynamics(self._robot, ball, mass=params.ball_mass, physicsClientId=client)
        bullet.changeDynamics(
            self._robot, body, mass=params.body_mass, localInertiaDiagonal=inertia, physicsClientId=client
        )

    def step(self, u: tuple[float, float]) -> State:
        bullet, client, robot, joints = self._bullet, self._client, self._robot, self._joints
        # PyBullet takes twice as long for keywords. No targets and gains matter to a torque.
        bullet.setJointMotorControlArray(robot, joints[:2], bullet.TORQUE_CONTROL, _0, _0, u, _0, _0, client)
        bullet.stepSimulation(client)
        a, b, c, d = bullet.getJointStates(robot, joints, client)
        return (a[0], b[0], c[0], d[0], a[1], b[1], c[1], d[1])

    def floor_force(self) -> tuple[float, float, float] | None:
        return None

    def close(self) -> None:
        self._release()

    def _reload(self, params: BallbotParams) -> None:
        _check_rolling(params, self._params.rolls)
        self._bullet.removeBody(self._robot, physicsClientId=self._client)
        self._robot, self._joints = load_robot(self._bullet, self._client, params)
        self._params = params


class BulletContactSimulator(BulletSimulator):
    """The URDF of a robot whose ball rolls in PyBullet, on a floor: the ball may slip, and leave the floor.

    The force u stands for the torque r e_z × u from the body on the ball, which is held over the control step.
    """

    def __init__(self, params: BallbotParams, control_dt: float, physics_dt: float | None = None):
        """Args: as for `BulletSimulator`. It is of first order too: 5 mm after 0.5 s at 1 ms."""
        super().__init__(params, control_dt, physics_dt)
        bullet, client = self._bullet, self._client
        self._substeps = _whole_substeps(control_dt, 0.001 if physics_dt is None else physics_dt)
        self._floor = bullet.createMultiBody(
            0, bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client), physicsClientId=client
        )
        # Bullet multiplies the friction of both bodies. Rolling without slipping is friction's work alone.
        _set_surface(bullet, client, self._floor, -1, 1.0)
        self._set_ball()

    def reset(self, x: State) -> None:
        """Puts the robot into state x, with a ball that rolls without slipping."""
        super().reset(x)
        bullet, client, radius = self._bullet, self._client, self._params.ball_radius
        bullet.resetJointState(self._robot, self._height, _PRESSED, 0.0, physicsClientId=client)
        spin = (-x[5] / radius, x[4] / radius, 0.0)
        bullet.resetJointStateMultiDof(self._robot, self._ball, (0, 0, 0, 1), spin, physicsClientId=client)

    def set_params(self, params: BallbotParams) -> None:
        self._reload(params)  # in any case, so that nothing of the contact's settings is lost; see `_set_surface`
        self._set_ball()

    def step(self, u: tuple[float, float]) -> State:
        bullet, client, robot, radius = self._bullet, self._client, self._robot, self._params.ball_radius
        torque = (-radius * u[1], radius * u[0], 0.0)
        bullet.applyExternalTorque(robot, self._ball, torque, bullet.WORLD_FRAME, physicsClientId=client)
        opposite = (-torque[0], -torque[1], 0.0)
        bullet.applyExternalTorque(robot, self._joints[3], opposite, bullet.WORLD_FRAME, physicsClientId=client)
        bullet.stepSimulation(physicsClientId=client)
        a, b, c, d = bullet.getJointStates(robot, self._joints, physicsClientId=client)
        return (a[0], b[0], c[0], d[0], a[1], b[1], c[1], d[1])

    def floor_force(self) -> tuple[float, float, float]:
        """Of the last step of Bullet; 0 where the ball is in the air."""
        points = self._bullet.getContactPoints(self._robot, self._floor, physicsClientId=self._client)
        total = [0.0, 0.0, 0.0]
        for point in points:
            for force, direction in ((point[9], point[7]), (point[10], point[11]), (point[12], point[13])):
                for i in range(3):
                    # Bullet divides a substep's impulse by the whole step
                    total[i] += self._substeps * force * direction[i]
        return total[0], total[1], total[2]

    def height(self) -> float:
        """How far the ball is above the floor, m; negative where it presses into it."""
        return self._bullet.getJointState(self._robot, self._height, physicsClientId=self._client)[0]

    def slip(self) -> tuple[float, float]:
        """Velocity of the ball's lowest point over the floor, m/s."""
        bullet, client = self._bullet, self._client
        vx, vy = (s[1] for s in bullet.getJointStates(self._robot, self._joints[:2], physicsClientId=client))
        wx, wy, _ = bullet.getLinkState(self._robot, self._ball, computeLinkVelocity=1, physicsClientId=client)[7]
        return vx - wy * self._params.ball_radius, vy + wx * self._params.ball_radius

    def _set_ball(self) -> None:
        bullet, client, robot = self._bullet, self._client, self._robot
        index = joint_indices(bullet, client, robot)
        self._ball, self._height = index["roll"], index["z"]
        _set_surface(bullet, client, robot, self._ball, min(self._params.friction, _MOST_FRICTION))
        bullet.setJointMotorControl2(robot, self._height, bullet.VELOCITY_CONTROL, force=0, physicsClientId=client)
        bullet.setJointMotorControlMultiDof(
            robot,
            self._ball,
            bullet.POSITION_CONTROL,
            targetPosition=(0, 0, 0, 1),
            positionGain=0,
            velocityGain=0,
            force=(0, 0, 0),
            physicsClientId=client,
        )


PHYSICS: dict[str, type[BulletSimulator] | type[Rk4Simulator]] = {"bullet": BulletSimulator, "rk4": Rk4Simulator}
"""Simulators by the name that `gymnasium.make(..., physics=name)` takes."""


def default_physics() -> str:
    """What `physics` is by default: "bullet" where PyBullet is installed; else "rk4", with one warning per process."""
    if has_pybullet():
        return "bullet"
    if not _noticed:
        _noticed.append(True)
        warnings.warn(f'PyBullet is not installed: physics="rk4" is used. {_HOW_TO_GET_IT}', stacklevel=3)
    return "rk4"


def make_simulator(
    physics: str, params: BallbotParams, control_dt: float, physics_dt: float | None = None
) -> Simulator:
    """The simulator of a robot: "rk4", or "bullet" with contact where the ball rolls. Args: as for `BulletSimulator`."""
    kind = PHYSICS[physics]
    if kind is BulletSimulator and params.rolls:
        kind = BulletContactSimulator
    return kind(params, control_dt, physics_dt)


PHYSICS_NAMES = {"bullet": "PyBullet", "rk4": "the closed-form model"}
"""What people call each physics."""

_noticed: list[bool] = []
_loading = threading.Lock()

_HOW_TO_GET_IT = 'Get it with "pip install pybullet", under Python 3.11 or older: newer ones have no wheel.'


def has_pybullet() -> bool:
    """Whether PyBullet is installed."""
    return importlib.util.find_spec("pybullet") is not None


def import_pybullet(otherwise: str = 'Or use physics="rk4", which needs only NumPy.') -> ModuleType:
    """PyBullet, or an ImportError that says how to get it, and what to do otherwise."""
    try:
        with _silenced() if "pybullet" not in sys.modules else nullcontext():  # it prints when it was built
            import pybullet
    except ImportError as error:
        raise ImportError(f"PyBullet is not installed. {_HOW_TO_GET_IT} {otherwise}") from error
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
    try:
        client = bullet.connect(mode)
    except bullet.error as error:
        raise RuntimeError(
            'PyBullet opens one window per process; close() the environment that has it, or take render_mode="rgb_array"'
        ) from error
    if client < 0:
        raise RuntimeError("PyBullet has no free physics client; close() environments that are no longer used")
    return client


def load_robot(bullet: ModuleType, client: int, params: BallbotParams) -> tuple[int, tuple[int, ...]]:
    """Loads the robot without motors, damping or joint speed limits; returns its body and its four joints in order.

    Raises:
        RuntimeError: Bullet holds another robot.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ballbot.urdf"
        path.write_text(params.to_urdf(), encoding="utf-8")
        # Without this flag Bullet recomputes inertias from collision shapes.
        robot = load_urdf(bullet, client, path, bullet.URDF_USE_INERTIA_FROM_FILE)
    bullet.setGravity(0, 0, -params.gravity, physicsClientId=client)
    index = joint_indices(bullet, client, robot)
    _check_loaded(bullet, client, robot, index, params)
    joints = tuple(index[name] for name in _JOINTS)
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


def load_urdf(bullet: ModuleType, client: int, path: Path, flags: int = 0) -> int:
    """Loads a URDF whose base is fixed; returns its body.

    Bullet reads numbers by C's locale: with decimal commas it would take "0.5" for 0 without a word. The locale is that of
    the whole process, because the thread of a window may be the one that reads.
    """
    with _loading:
        found = locale.setlocale(locale.LC_NUMERIC)
        locale.setlocale(locale.LC_NUMERIC, "C")
        try:
            return bullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=client)
        finally:
            locale.setlocale(locale.LC_NUMERIC, found)


def _check_loaded(bullet: ModuleType, client: int, robot: int, index: dict[str, int], params: BallbotParams) -> None:
    """Raises a RuntimeError if Bullet holds another robot than that of params."""
    ball_mass, _, ball_inertias, *_ = bullet.getDynamicsInfo(robot, index["roll" if params.rolls else "y"], client)
    body_mass, _, inertias, centre, *_ = bullet.getDynamicsInfo(robot, index["theta"], client)
    held = {
        "ball_mass": ball_mass,
        "ball_radius": bullet.getJointInfo(robot, index["x"], client)[14][2],  # where the chain begins
        "body_mass": body_mass,
        "com_height": centre[2],
        "inertia": inertias[0],
        "axial_inertia": inertias[2],
    }
    if params.rolls:
        held["ball_inertia"] = ball_inertias[0]
    wrong = [
        f"{name} {value:g} in place of {getattr(params, name):g}"
        for name, value in held.items()
        if not math.isclose(value, getattr(params, name), rel_tol=1e-9)
    ]
    if wrong:
        raise RuntimeError(
            f"PyBullet took another robot than the one given: {', '.join(wrong)}. It refuses inertias that no body can have, "
            "as axial_inertia of more than twice inertia; and no other thread may set LC_NUMERIC while an environment is made"
        )


def joint_indices(bullet: ModuleType, client: int, robot: int) -> dict[str, int]:
    """The index of every joint, and of the link that it carries, by the joint's name."""
    count = bullet.getNumJoints(robot, physicsClientId=client)
    return {bullet.getJointInfo(robot, i, physicsClientId=client)[1].decode(): i for i in range(count)}


def _set_surface(bullet: ModuleType, client: int, body: int, link: int, friction: float) -> None:
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


def _check_rolling(params: BallbotParams, rolls: bool) -> None:
    if params.rolls != rolls:
        raise ValueError(f"this simulator is of a ball with rolls={rolls}; make another with make_simulator()")


def _whole_substeps(control_dt: float, physics_dt: float) -> int:
    if not is_number(physics_dt):
        raise ValueError(f"physics_dt must be a number of seconds, not {physics_dt!r}")
    in_range = control_dt / (_MOST_SUBSTEPS + 0.5) < physics_dt <= 2 * control_dt
    substeps = round(control_dt / physics_dt) if in_range else 0
    if substeps < 1 or not math.isclose(substeps * physics_dt, control_dt, rel_tol=1e-9):
        raise ValueError(
            f"physics_dt = {physics_dt} s must be a whole fraction of control_dt = {control_dt} s, and at least "
            f"1/{_MOST_SUBSTEPS} of it"
        )
    return substeps
