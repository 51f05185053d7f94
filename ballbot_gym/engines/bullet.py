"""The robot's URDF in PyBullet, as a chain of joints, and with contact where the ball rolls."""

import locale
import math
import tempfile
import threading
import weakref
from pathlib import Path
from typing import Any

from ballbot_gym.engines.bullet_client import import_pybullet
from ballbot_gym.engines.simulator import MOST_FRICTION, Simulator, State
from ballbot_gym.robot import Omni, PointBall, RollingBall, urdf_text

_JOINTS = ("x", "y", "gamma", "theta", "psi")  # the last where wheels turn the body
_loading = threading.Lock()

_0 = (0.0, 0.0)
_PRESSED = -1e-5  # m: height of the ball at reset, about where its weight presses it


class _BulletSimulator(Simulator):
    """The URDF of a robot whose ball translates in PyBullet, in a physics client that this object owns."""

    def __init__(self, params: Any, control_dt: float, physics_dt: float | None = None):
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
        substeps = self._whole_substeps(control_dt, 0.001 if physics_dt is None else physics_dt)
        self._bullet = bullet = import_pybullet()
        self._client = bullet.connect(bullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("PyBullet has no free physics client; close() environments that are no longer used")
        self._release = weakref.finalize(self, bullet.disconnect, self._client)
        self._load(params)
        # Substeps run in C++ with the force held. Results are bit-identical to single steps, a third faster.
        bullet.setPhysicsEngineParameter(fixedTimeStep=control_dt, numSubSteps=substeps, physicsClientId=self._client)

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        # Joints are reset in place: reloading the URDF takes a hundred times longer.
        for i, joint in enumerate(self._joints[:4]):
            self._bullet.resetJointState(self._robot, joint, x[i], x[i + 4], self._client)

    def set_params(self, params: Any) -> None:
        bullet, client, old = self._bullet, self._client, self._params
        if (params.com_height, params.gravity, type(params)) != (old.com_height, old.gravity, type(old)):
            self._reload(params)  # changeDynamics cannot move a link's centre of mass
            return
        self._params = params
        ball, body = self._joints[1], self._joints[3]  # a link has the index of the joint that carries it
        inertia = (params.inertia, params.inertia, params.axial_inertia)
        bullet.changeDynamics(self._robot, ball, mass=params.ball_mass, physicsClientId=client)
        bullet.changeDynamics(
            self._robot, body, mass=params.body_mass, localInertiaDiagonal=inertia, physicsClientId=client
        )
        self._check_held()

    def step(self, u: tuple[float, ...]) -> State:
        bullet, client, robot, joints = self._bullet, self._client, self._robot, self._joints
        # PyBullet takes twice as long for keywords. No targets and gains matter to a torque.
        bullet.setJointMotorControlArray(robot, joints[:2], bullet.TORQUE_CONTROL, _0, _0, u, _0, _0, client)
        bullet.stepSimulation(client)
        a, b, c, d = bullet.getJointStates(robot, joints, client)
        return (a[0], b[0], c[0], d[0], a[1], b[1], c[1], d[1])

    def close(self) -> None:
        self._release()

    def _reload(self, params: Any) -> None:
        self._check_kind(params, self._params)
        self._bullet.removeBody(self._robot, physicsClientId=self._client)
        self._load(params)

    def _load(self, params: Any) -> None:
        """Loads the robot without motors, damping or joint speed limits."""
        bullet, client, self._params = self._bullet, self._client, params
        with tempfile.TemporaryDirectory() as folder, _loading:
            path = Path(folder) / "ballbot.urdf"
            path.write_text(urdf_text(params), encoding="utf-8")
            # Bullet reads numbers by the process's locale: with decimal commas it would silently take "0.5" for 0.
            found = locale.setlocale(locale.LC_NUMERIC)
            locale.setlocale(locale.LC_NUMERIC, "C")
            try:
                # Without this flag Bullet recomputes inertias from collision shapes.
                options = {"useFixedBase": True, "flags": bullet.URDF_USE_INERTIA_FROM_FILE, "physicsClientId": client}
                self._robot = robot = bullet.loadURDF(str(path), **options)
            finally:
                locale.setlocale(locale.LC_NUMERIC, found)
        bullet.setGravity(0, 0, -params.gravity, physicsClientId=client)
        joints = range(bullet.getNumJoints(robot, physicsClientId=client))
        # of every joint, and of the link that it carries, by the joint's name
        self._index = {bullet.getJointInfo(robot, i, physicsClientId=client)[1].decode(): i for i in joints}
        self._joints = tuple(self._index[name] for name in _JOINTS if name in self._index)
        free = {"linearDamping": 0, "angularDamping": 0, "jointDamping": 0, "maxJointVelocity": 1e4}
        for joint in (-1, *joints):
            bullet.changeDynamics(robot, joint, physicsClientId=client, **free)
        # Bullet's joints start with a velocity motor that holds them.
        none = [0] * len(self._joints)
        bullet.setJointMotorControlArray(
            robot, self._joints, bullet.VELOCITY_CONTROL, forces=none, physicsClientId=client
        )
        self._check_held()

    def _ball_link(self) -> tuple[int, tuple[float, ...]]:
        """The link that is the ball, and the inertias that it must have, kg·m²; none where they have no effect."""
        return self._joints[1], ()

    def _check_held(self) -> None:
        """Raises a RuntimeError if PyBullet holds other masses, inertias or a lower centre of mass than the robot has."""
        robot, (link_of_ball, inertia) = self._params, self._ball_link()
        wanted = {
            link_of_ball: (robot.ball_mass, *inertia),
            self._joints[-1]: (
                robot.body_mass,
                robot.inertia,
                robot.inertia,
                robot.axial_inertia,
                *robot.centre_of_mass,
            ),
        }
        for link, numbers in wanted.items():
            mass, _, inertia, place, *_ = self._bullet.getDynamicsInfo(self._robot, link, physicsClientId=self._client)
            found = (mass, *inertia, *place)[: len(numbers)]
            if any(not math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-12) for a, b in zip(found, numbers, strict=True)):
                raise RuntimeError(f"PyBullet has {found} for {numbers}, kg, kg·m² and m; it cannot simulate {robot}")


class _BulletContactSimulator(_BulletSimulator):
    """The URDF of a robot whose ball rolls in PyBullet, on a floor: the ball may slip, and leave the floor.

    The force u represents the torque r e_z × u from the body on the ball, which is held over the control step.
    """

    def __init__(self, params: Any, control_dt: float, physics_dt: float | None = None):
        """Args: as for `make_simulator`. It is of first order too: 5 mm after 0.5 s at 1 ms."""
        super().__init__(params, control_dt, physics_dt)
        bullet, client = self._bullet, self._client
        self._substeps = self._whole_substeps(control_dt, 0.001 if physics_dt is None else physics_dt)
        self._floor = bullet.createMultiBody(
            0, bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client), physicsClientId=client
        )
        # Bullet multiplies the friction of both bodies. Rolling without slipping is friction's work alone.
        self._set_surface(self._floor, -1, 1.0)
        self._set_ball()

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        """Puts the robot into state x, with a ball that rolls without slipping."""
        super().reset(x)
        bullet, client, radius = self._bullet, self._client, self._params.ball_radius
        bullet.resetJointState(self._robot, self._height, _PRESSED, 0.0, physicsClientId=client)
        spin = (-x[5] / radius, x[4] / radius, 0.0)
        bullet.resetJointStateMultiDof(self._robot, self._ball, (0, 0, 0, 1), spin, physicsClientId=client)

    def set_params(self, params: Any) -> None:
        self._reload(params)  # in any case, so that nothing of the contact's settings is lost; see `_set_surface`
        self._set_ball()

    def step(self, u: tuple[float, ...]) -> State:
        bullet, client, robot, radius = self._bullet, self._client, self._robot, self._params.ball_radius
        tx, ty = -radius * u[1], radius * u[0]
        bullet.applyExternalTorque(robot, self._ball, (tx, ty, 0.0), bullet.WORLD_FRAME, client)
        bullet.applyExternalTorque(robot, self._joints[3], (-tx, -ty, 0.0), bullet.WORLD_FRAME, client)
        bullet.stepSimulation(client)
        a, b, c, d = bullet.getJointStates(robot, self._joints, client)
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
        return self._bullet.getJointState(self._robot, self._height, physicsClientId=self._client)[0]

    def slip(self) -> tuple[float, float]:
        bullet, client = self._bullet, self._client
        vx, vy = (s[1] for s in bullet.getJointStates(self._robot, self._joints[:2], physicsClientId=client))
        wx, wy, _ = bullet.getLinkState(self._robot, self._ball, computeLinkVelocity=1, physicsClientId=client)[7]
        return vx - wy * self._params.ball_radius, vy + wx * self._params.ball_radius

    def _ball_link(self) -> tuple[int, tuple[float, ...]]:
        return self._index["roll"], (self._params.ball_inertia,) * 3

    def _set_ball(self) -> None:
        bullet, client, robot = self._bullet, self._client, self._robot
        self._ball, self._height = self._index["roll"], self._index["z"]
        self._set_surface(robot, self._ball, min(self._params.friction, MOST_FRICTION))
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

    def _set_surface(self, body: int, link: int, friction: float) -> None:
        """Friction as given, and nothing else that acts at a contact."""
        none = {"rollingFriction": 0, "spinningFriction": 0, "restitution": 0, "physicsClientId": self._client}
        # A call that sets damping too would silently drop lateralFriction.
        self._bullet.changeDynamics(body, link, lateralFriction=friction, **none)
        found = self._bullet.getDynamicsInfo(body, link, physicsClientId=self._client)[1]
        if not math.isclose(found, friction, rel_tol=1e-6):
            raise RuntimeError(f"PyBullet has a friction of {found}, and it should have {friction}")


class _BulletOmniSimulator(_BulletContactSimulator):
    """A robot with three omni-wheels in PyBullet, on a floor: the ball may slip, and leave the floor.

    The motors' torque falls with the wheels' speed over the real ball. The rotors' is that of the acceleration that the robot
    would have if its ball did not slip. Both are held over a step of Bullet.
    """

    def __init__(self, params: Any, control_dt: float, physics_dt: float | None = None):
        """Args: as for `make_simulator`."""
        super().__init__(params, control_dt, physics_dt)
        self._steps, self._substeps = self._substeps, 1
        self._bullet.setPhysicsEngineParameter(
            fixedTimeStep=control_dt / self._steps, numSubSteps=1, physicsClientId=self._client
        )

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        """Puts the robot into state x, with a ball that rolls without slipping."""
        super().reset(x[:8])
        bullet, client, radius = self._bullet, self._client, self._params.ball_radius
        bullet.resetJointState(self._robot, self._joints[4], x[8], x[9], client)
        spin = (-x[5] / radius, x[4] / radius, x[10])
        bullet.resetJointStateMultiDof(self._robot, self._ball, (0, 0, 0, 1), spin, physicsClientId=client)

    def step(self, u: tuple[float, ...]) -> State:
        bullet, client, robot, wheels = self._bullet, self._client, self._robot, self._params.wheels
        x, turning = self._state()
        for _ in range(self._steps):
            tx, ty, tz = self._params.torque_on_ball(x, turning, u)
            brake = wheels.floor_torque(turning[2])
            bullet.applyExternalTorque(robot, self._ball, (tx, ty, tz + brake), bullet.WORLD_FRAME, client)
            bullet.applyExternalTorque(robot, self._joints[4], (-tx, -ty, -tz), bullet.WORLD_FRAME, client)
            bullet.stepSimulation(client)
            x, turning = self._state()
        return x

    def _state(self) -> tuple[State, tuple[float, float, float]]:
        """The state (11,), and how the ball turns in the world, rad/s."""
        bullet, client = self._bullet, self._client
        a, b, c, d, e = bullet.getJointStates(self._robot, self._joints, client)
        turning = bullet.getLinkState(self._robot, self._ball, computeLinkVelocity=1, physicsClientId=client)[7]
        return (a[0], b[0], c[0], d[0], a[1], b[1], c[1], d[1], e[0], e[1], turning[2]), turning


SIMULATORS = {PointBall: _BulletSimulator, RollingBall: _BulletContactSimulator, Omni: _BulletOmniSimulator}
"""By the kind of robot that they simulate."""
