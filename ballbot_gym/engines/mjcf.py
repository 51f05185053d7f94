"""A ballbot that somebody described for MuJoCo: its numbers as a robot, and its motion behind our state and commands.

The file names nothing that this module knows. The floor is a plane that does not move. The ball is the only sphere, or round
mesh, that rests on it. A wheel is what a hinge with a motor turns next to the ball. All other bodies are held where the file
has them, and are one rigid body together.

A wheel that touches a ball of radius r does so on the line from the ball's centre to the nearest point of the wheel's axis,
at the distance r + R. So the axes alone give the wheels' radii R and the directions of their contacts, whatever the rollers
look like.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from ballbot_gym import ops
from ballbot_gym.engines.mujoco import import_mujoco
from ballbot_gym.engines.simulator import MOST_FRICTION
from ballbot_gym.robot import GeneralOmni, Sensors, UrdfError, Wheels
from ballbot_gym.robot.ballbot import STANDARD_GRAVITY

_ROUND, _DIRECTIONS = 0.02, 200  # deviation of a mesh's hull from a sphere, in radii, and where it is looked at
_NEAR_FLOOR, _NEAR_BALL = 0.1, 0.1  # how far floor and ball, or ball and wheels, may be apart in the file, in radii
_UPRIGHT = math.cos(math.radians(2))
_TILTED = math.radians(5)  # of a wheel's axis
_APART = math.radians(3)  # of the wheels' zenith angles
_ALIKE = 0.02  # of radii, motors and frictions of the wheels, relative
_NO_LOSS = 1e6  # rad/s: the speed without load of motors that do not weaken with speed


class _Wheel(NamedTuple):
    """A wheel of a model, in SI units."""

    name: str
    """Of its joint."""
    actuator: int
    dof: int
    angle: int
    """Of its joint in qpos."""
    sign: float
    """Of the joint's turning, where the wheel drives the ball counterclockwise about the body's axis."""
    radius: float
    zenith: float
    azimuth: float
    gear: float
    gain: float
    """Force of the actuator for each unit of its control."""
    torque: float
    """The greatest of the motor at standstill."""
    inertia: float
    damping: float
    friction: float


class MujocoModel:
    """A MuJoCo model of a ballbot with three omni-wheels.

    | attribute | shape | meaning |
    |---|---|---|
    | `robot` | | a `GeneralOmni` with the numbers of the model; the body's frame is the world's where the file has it |
    | `model`, `data` | | MuJoCo's own |
    | `control_dt` | | s, how long `step` holds a command |
    | `state` | (11,) | of the simulated robot, as `Omni.STATE` names it |
    | `readings` | (9,) | of its sensors over the last step, see `ballbot_gym.robot.sensors`: gyroscope, rad/s, accelerometer, m/s², and the angles by which the wheels turned, rad |
    """  # noqa: E501

    def __init__(self, path: str | Path, pose: Mapping[str, float] | None = None, control_dt: float = 0.02):
        """Reads a model.

        Args:
            path: its MJCF.
            pose: angles, rad, or places, m, of joints by name, at which they are held instead of where the file has them.
            control_dt: s, a whole number of the model's time steps.

        Raises:
            ImportError: MuJoCo is not installed.
            UrdfError: the file is no MJCF, or its model no ballbot; the message says what is missing.
            ValueError: control_dt is no whole number of time steps.
        """
        self._mujoco, self._path = import_mujoco(), Path(path)
        self.model = self._compiled()
        self.data = self._mujoco.MjData(self.model)
        self._place(pose or {})
        step = float(self.model.opt.timestep)
        self._substeps = round(control_dt / step)
        if self._substeps < 1 or abs(self._substeps * step - control_dt) > 1e-9:
            raise ValueError(
                f"control_dt must be a whole number of the model's time steps of {step:g} s, not {control_dt}"
            )
        self.control_dt = control_dt
        self._floor = self._find_floor()
        self._ball_geom, self._ball, self._radius = self._find_ball()
        self._centre = self.data.geom_xpos[self._ball_geom].copy()
        self._wheels = self._find_wheels()
        self._find_joints()
        self.robot = self._read()
        self._own = self.data.xmat[self._base].reshape(3, 3).T.copy()  # the robot's axes in those of its base
        self._to_ball = self._own @ (self._centre - self.data.xpos[self._base])
        self._held = self._holding()
        self.reset(self.robot.rest())

    def reset(self, x: np.ndarray) -> np.ndarray:
        """Puts the robot into state x (11,), with a ball that rolls without slipping; returns `state`.

        The accelerometer then reads what it would feel in a control step without force: contacts that were just made do not
        press yet as they will.
        """
        x = np.asarray(x, np.float64)
        self._put(x)
        self.step(np.zeros(3))
        accelerations = self.readings[3:6]
        speeds = self._put(x)
        # gyroscope and encoders read as if the state lasted for a control step
        self.readings = np.concatenate([self._felt()[:3], accelerations, self.control_dt * speeds])
        self._start = x[:2].copy()
        return self.state

    def _put(self, x: np.ndarray) -> np.ndarray:
        """Puts the robot into state x (11,); returns the speeds of the wheels (3,), rad/s."""
        mujoco, data, r = self._mujoco, self.data, self._radius
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = self._pose
        gamma, theta, psi = x[2], x[3], x[8]
        lean, frame = _lean(gamma, theta), _lean(gamma, theta) @ _yaw(psi)
        base, ball = frame @ self._own.T, np.array([x[0], x[1], self._centre[2]])
        turning = np.array([0.0, x[6], 0.0]) - x[7] * _lean(gamma, 0.0)[:, 0] + x[9] * lean[:, 2]
        spin, velocity = np.array([-x[5] / r, x[4] / r, x[10]]), np.array([x[4], x[5], 0.0])
        place = ball - base @ self._to_ball
        self._set_free(self._base_joint, place, base, velocity + np.cross(turning, place - ball), turning)
        own, dof = self.model.jnt_qposadr[self._ball_joint], self.model.jnt_dofadr[self._ball_joint]
        if self.model.jnt_type[self._ball_joint] == mujoco.mjtJoint.mjJNT_FREE:
            self._set_free(self._ball_joint, ball, np.eye(3), velocity, spin)
        else:
            data.qpos[own : own + 4] = self._pose[own : own + 4]
            mujoco.mj_kinematics(self.model, data)
            data.qvel[dof : dof + 3] = data.xmat[self._ball].reshape(3, 3).T @ (spin - turning)
        speeds = np.array(self.robot.readings(x, np.zeros(3))[6:])
        for wheel, speed in zip(self._wheels, speeds, strict=True):
            data.qvel[wheel.dof] = wheel.sign * speed
        data.ctrl[:] = self._held
        mujoco.mj_forward(self.model, data)
        return speeds

    def step(self, u: np.ndarray) -> np.ndarray:
        """Holds the wheels' forces u (3,), N, for a control step; returns `state`."""
        data = self.data
        u = np.clip(np.asarray(u, np.float64), -self.robot.force_limit, self.robot.force_limit)
        for wheel, force in zip(self._wheels, u.tolist(), strict=True):
            data.ctrl[wheel.actuator] = wheel.sign * force * self.robot.wheels.radius / (wheel.gear * wheel.gain)
        before = np.array([data.qpos[wheel.angle] for wheel in self._wheels])
        total = np.zeros(6)
        for _ in range(self._substeps):
            self._mujoco.mj_step(self.model, data)
            total += self._felt()
        after = np.array([data.qpos[wheel.angle] for wheel in self._wheels])
        turned = np.array([wheel.sign for wheel in self._wheels]) * (after - before)
        self.readings = np.concatenate([total / self._substeps, turned])
        self._mujoco.mj_forward(self.model, data)
        return self.state

    @property
    def state(self) -> np.ndarray:
        frame, spin = self.data.xmat[self._base].reshape(3, 3) @ self._own, self._velocity(self._ball)
        axis = frame[:, 2]
        gamma, theta = math.atan2(axis[0], axis[2]), math.asin(max(-1.0, min(1.0, axis[1])))
        own = _lean(gamma, theta).T @ frame
        columns = np.stack([[0.0, 1.0, 0.0], -_lean(gamma, 0.0)[:, 0], axis], axis=1)
        dgamma, dtheta, dpsi = np.linalg.solve(columns, self._velocity(self._base)[:3])
        x, y, _ = self.data.geom_xpos[self._ball_geom]
        psi = math.atan2(own[1, 0], own[0, 0])
        return np.array([x, y, gamma, theta, spin[3], spin[4], dgamma, dtheta, psi, dpsi, spin[2]])

    def observed(self, c: np.ndarray) -> np.ndarray:
        """What an environment with observation="sensors" observes, in an episode with constants c (nc,)."""
        return np.concatenate([self.readings / Sensors.SCALE, self._start, c])

    def _compiled(self) -> Any:
        mujoco: ModuleType = self._mujoco
        if not self._path.is_file():
            raise UrdfError(f"{self._path}: no such file; give the path of an MJCF")
        try:
            return mujoco.MjModel.from_xml_path(str(self._path))
        except ValueError as error:
            raise UrdfError(f"{self._path}: MuJoCo cannot read it: {str(error).strip()}") from None

    def _error(self, text: str) -> UrdfError:
        return UrdfError(f"{self._path}: {text}")

    def _name(self, kind: str, index: int) -> str:
        return getattr(self.model, kind)(index).name or f"number {index}"

    def _place(self, pose: Mapping[str, float]) -> None:
        mujoco, model = self._mujoco, self.model
        movable = {
            model.joint(j).name: j
            for j in range(model.njnt)
            if int(model.jnt_type[j]) in map(int, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
        }
        for name, value in pose.items():
            if name not in movable:
                raise self._error(f"there is no joint {name!r} to hold; known: {', '.join(map(repr, movable))}")
            self.data.qpos[model.jnt_qposadr[movable[name]]] = value
        self._pose = self.data.qpos.copy()
        mujoco.mj_forward(model, self.data)

    def _find_floor(self) -> int:
        model, kinds = self.model, self._mujoco.mjtGeom
        planes = [
            g
            for g in range(model.ngeom)
            if model.geom_type[g] == kinds.mjGEOM_PLANE and model.body_weldid[model.geom_bodyid[g]] == 0
        ]
        level = [g for g in planes if self.data.geom_xmat[g].reshape(3, 3)[2, 2] > _UPRIGHT]
        if not level:
            raise self._error("there is no floor; add a level geom of type plane to the world body")
        return level[0]

    def _find_ball(self) -> tuple[int, int, float]:
        """The geom and the body of the ball, and its radius, m."""
        model, height, found = self.model, self.data.geom_xpos[self._floor][2], {}
        for g in range(model.ngeom):
            radius = self._radius_of(g)
            body = int(model.geom_bodyid[g])
            if radius is None or model.body_weldid[body] == 0 or self._contact(g) is None:
                continue
            if abs(self.data.geom_xpos[g][2] - height - radius) < _NEAR_FLOOR * radius:
                found[body] = g, body, radius
        if not found:
            raise self._error(
                "there is no ball on the floor: no sphere, and no mesh that is round, touches the plane and can collide with "
                "it; give the file a pose in which the ball stands on the floor"
            )
        if len(found) > 1:
            names = ", ".join(repr(self._name("body", body)) for body in found)
            raise self._error(f"a ballbot stands on one ball, and here are several on the floor: {names}")
        return next(iter(found.values()))

    def _radius_of(self, g: int) -> float | None:
        """Of a geom that is a ball, m; None of any other."""
        model, kinds = self.model, self._mujoco.mjtGeom
        if model.geom_type[g] == kinds.mjGEOM_SPHERE:
            return float(model.geom_size[g][0])
        if model.geom_type[g] != kinds.mjGEOM_MESH:
            return None
        mesh = model.geom_dataid[g]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
        reach = (directions @ vertices.T).max(axis=1) / np.linalg.norm(
            directions, axis=1
        )  # of the hull, which collides
        mean = float(reach.mean())
        return mean if np.abs(reach - mean).max() < _ROUND * mean else None

    def _contact(self, g: int) -> tuple[float, float] | None:
        """Friction and torsional friction, m, between a geom and the floor; None where they do not collide."""
        model, floor = self.model, self._floor
        for pair in range(model.npair):
            if {int(model.pair_geom1[pair]), int(model.pair_geom2[pair])} == {g, floor}:
                friction, size = model.pair_friction[pair], model.pair_dim[pair]
                return float(friction[0]), float(friction[2]) if size >= 4 else 0.0
        types, affinities = model.geom_contype, model.geom_conaffinity
        if not (types[g] & affinities[floor] or types[floor] & affinities[g]):
            return None
        first, second = sorted((g, floor), key=lambda each: -model.geom_priority[each])
        friction, size = model.geom_friction[first], model.geom_condim[first]
        if model.geom_priority[first] == model.geom_priority[second]:
            friction = np.maximum(friction, model.geom_friction[second])
            size = max(size, model.geom_condim[second])
        return float(friction[0]) if size >= 3 else 0.0, float(friction[1]) if size >= 4 else 0.0

    def _find_wheels(self) -> list[_Wheel]:
        model, mujoco = self.model, self._mujoco
        joints: dict[int, int] = {}
        for a in range(model.nu):
            if int(model.actuator_trntype[a]) not in map(
                int, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
            ):
                continue
            j = int(model.actuator_trnid[a, 0])
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and self._is_at_ball(int(model.jnt_bodyid[j])):
                if j in joints:
                    raise self._error(f"joint {self._name('joint', j)!r} has several motors; leave one of them")
                joints[j] = a
        if not joints:
            raise self._error(
                "no wheels touch the ball: no hinge that an actuator drives turns a geom that is less than a tenth of the "
                "ball's radius from it"
            )
        if len(joints) != 3:
            names = ", ".join(repr(self._name("joint", j)) for j in joints)
            raise self._error(f"the ball must be driven by three wheels, and here are {len(joints)}: {names}")
        return [self._wheel(j, a) for j, a in joints.items()]

    def _is_at_ball(self, body: int) -> bool:
        """Whether a body, or one that it carries, has a geom next to the ball, and does not carry the ball itself."""
        inside = self._carried(body)
        if self._ball in inside:
            return False
        near = _NEAR_BALL * self._radius
        return any(
            self._mujoco.mj_geomDistance(self.model, self.data, g, self._ball_geom, near, None) < near
            for g in range(self.model.ngeom)
            if int(self.model.geom_bodyid[g]) in inside
        )

    def _carried(self, body: int) -> set[int]:
        """A body and all that it carries."""
        inside = {body}
        for each in range(body + 1, self.model.nbody):
            if int(self.model.body_parentid[each]) in inside:
                inside.add(each)
        return inside

    def _wheel(self, j: int, a: int) -> _Wheel:
        model, name = self.model, self._name("joint", j)
        axis, anchor = self.data.xaxis[j], self.data.xanchor[j] - self._centre
        nearest = anchor - (anchor @ axis) * axis
        distance = float(np.linalg.norm(nearest))
        if distance <= self._radius:
            raise self._error(
                f"the axis of wheel {name!r} goes through the ball; it must pass it at the wheel's radius"
            )
        normal = nearest / distance
        zenith, azimuth = ops.arccos(float(normal[2])), math.atan2(normal[1], normal[0])
        wanted = -normal[2] * math.cos(azimuth), -normal[2] * math.sin(azimuth), math.hypot(normal[0], normal[1])
        along = float(axis @ wanted)
        if abs(along) < math.cos(_TILTED):
            raise self._error(
                f"wheel {name!r} does not drive the ball around the body's axis: its own axis is "
                f"{math.degrees(ops.arccos(min(abs(along), 1.0))):.0f}° out of the plane of the body's axis and the contact"
            )
        dof = int(model.jnt_dofadr[j])
        gear, gain, limit, drag = self._motor(j, a, name)
        return _Wheel(
            name, a, dof, int(model.jnt_qposadr[j]), -math.copysign(1.0, along), distance - self._radius, zenith, azimuth,
            gear, gain, limit, float(model.dof_M0[dof]), float(model.dof_damping[dof]) + drag,
            float(model.dof_frictionloss[dof]),
        )  # fmt: skip

    def _motor(self, j: int, a: int, name: str) -> tuple[float, float, float, float]:
        """Gear, gain, greatest torque at standstill, N·m, and what falls of it per speed, N·m·s, of a wheel's motor."""
        model, kinds = self.model, self._mujoco
        gear, gain = float(model.actuator_gear[a, 0]), float(model.actuator_gainprm[a, 0])
        offset, stiffness, damping = model.actuator_biasprm[a, :3]
        if model.actuator_gaintype[a] != kinds.mjtGain.mjGAIN_FIXED or gear == 0 or gain == 0:
            raise self._error(
                f"the actuator of wheel {name!r} has no torque in proportion to its control; give a motor"
            )
        if model.actuator_biastype[a] == kinds.mjtBias.mjBIAS_NONE:
            offset = stiffness = damping = 0.0
        if offset != 0 or stiffness != 0 or int(model.actuator_biastype[a]) > int(kinds.mjtBias.mjBIAS_AFFINE):
            raise self._error(
                f"the actuator of wheel {name!r} is a servo; give a motor, whose torque is the control times its gear"
            )
        limits = []
        if model.actuator_ctrllimited[a]:
            limits.append(abs(gain * gear) * np.abs(model.actuator_ctrlrange[a]).min())
        if model.actuator_forcelimited[a]:
            limits.append(abs(gear) * np.abs(model.actuator_forcerange[a]).min())
        if model.jnt_actfrclimited[j]:
            limits.append(np.abs(model.jnt_actfrcrange[j]).min())
        if not limits or min(limits) <= 0:
            raise self._error(
                f"the motor of wheel {name!r} has no limit; give its actuator a ctrlrange or a forcerange"
            )
        return gear, gain, float(min(limits)), -float(damping) * gear**2

    def _find_joints(self) -> None:
        """The base of the robot, and the joints on which base and ball move."""
        model, kinds = self.model, self._mujoco.mjtJoint
        roots = {int(model.body_rootid[model.jnt_bodyid[self.model.dof_jntid[wheel.dof]]]) for wheel in self._wheels}
        self._base = roots.pop()
        first = int(model.body_jntadr[self._base])
        if roots or self._base == self._ball or first < 0 or model.jnt_type[first] != kinds.mjJNT_FREE:
            raise self._error("the body that carries the wheels must move freely; give it a freejoint")
        self._base_joint, self._ball_joint = first, int(model.body_jntadr[self._ball])
        turns = map(int, (kinds.mjJNT_FREE, kinds.mjJNT_BALL))
        if self._ball_joint < 0 or int(model.jnt_type[self._ball_joint]) not in turns:
            raise self._error("the ball must turn freely; give it a freejoint, or a joint of type ball at its centre")

    def _read(self) -> GeneralOmni:
        """The robot with the numbers of the model."""
        model, wheels = self.model, self._wheels
        zeniths = [wheel.zenith for wheel in wheels]
        if max(zeniths) - min(zeniths) > _APART:
            shown = ", ".join(f"{math.degrees(each):.1f}°" for each in zeniths)
            raise self._error(
                f"the wheels must touch the ball at one angle from the body's axis, and here it is {shown}"
            )
        mean = {name: self._common(name) for name in ("radius", "torque", "inertia", "damping", "friction")}
        radius, zenith = self._radius, float(np.mean(zeniths))
        # damping between ball and body, as much of it as turns the ball about a horizontal axis
        held = float(model.dof_damping[model.jnt_dofadr[self._ball_joint]])
        if model.jnt_type[self._ball_joint] == self._mujoco.mjtJoint.mjJNT_BALL:
            mean["damping"] += held * mean["radius"] ** 2 / (1.5 * (radius * math.cos(zenith)) ** 2)
        bodies = [
            b
            for b in range(1, model.nbody)
            if b not in self._carried(self._ball) and model.body_rootid[b] == self._base
        ]
        mass, centre, inertia = self._lumped(bodies)
        x, y, z = (centre - self._centre).tolist()
        if z <= 0:
            raise self._error(
                f"the body's centre of mass is {-z:.3g} m below the ball's centre; a ballbot balances above it"
            )
        ball_mass = float(model.body_subtreemass[self._ball])
        gravity = -float(model.opt.gravity[2]) or STANDARD_GRAVITY
        friction, torsion = self._contact(self._ball_geom) or (0.0, 0.0)
        length = 2 * max(z - radius, radius)
        return GeneralOmni(
            ball_mass=ball_mass,
            ball_radius=radius,
            body_mass=mass,
            body_radius=radius,
            body_length=length,
            com_height=z,
            inertia=float(inertia[0, 0] + inertia[1, 1]) / 2,
            axial_inertia=float(inertia[2, 2]),
            force_limit=mean["torque"] / mean["radius"],
            gravity=gravity,
            friction=min(friction, MOST_FRICTION),
            ball_inertia=float(model.body_inertia[self._ball].mean()),
            wheels=Wheels(
                radius=mean["radius"],
                no_load_speed=_NO_LOSS,
                inertia=mean["inertia"],
                damping=mean["damping"],
                spin_friction=torsion * (mass + ball_mass) * gravity,
            ),
            com_x=x,
            com_y=y,
            zenith=zenith,
            **{f"azimuth_{i}": wheel.azimuth for i, wheel in enumerate(wheels, 1)},
            axle_friction=mean["friction"],
        )

    def _common(self, name: str) -> float:
        """The mean over wheels of a number that must be the same for all."""
        values = [getattr(wheel, name) for wheel in self._wheels]
        mean = float(np.mean(values))
        if max(values) - min(values) > _ALIKE * abs(mean):
            shown = ", ".join(f"{each:.4g}" for each in values)
            raise self._error(f"the wheels must be alike, and their {name} is {shown}")
        return mean

    def _lumped(self, bodies: list[int]) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, kg, centre of mass (3,), m, and inertia about it (3, 3), kg·m², of bodies that are held together."""
        masses, places = self.model.body_mass[bodies], self.data.xipos[bodies]
        total = float(masses.sum())
        centre, inertia = masses @ places / total, np.zeros((3, 3))
        for body, mass, place in zip(bodies, masses, places, strict=True):
            axes, arm = self.data.ximat[body].reshape(3, 3), place - centre
            inertia += axes @ np.diag(self.model.body_inertia[body]) @ axes.T
            inertia += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        return total, centre, inertia

    def _holding(self) -> np.ndarray:
        """(nu,) the controls with which servos hold the pose; 0 of all others."""
        model, controls = self.model, np.zeros(self.model.nu)
        for a in range(model.nu):
            offset, stiffness, _ = model.actuator_biasprm[a, :3]
            if model.actuator_trntype[a] == self._mujoco.mjtTrn.mjTRN_JOINT and stiffness != 0:
                place = self._pose[model.jnt_qposadr[model.actuator_trnid[a, 0]]] * model.actuator_gear[a, 0]
                controls[a] = -(offset + stiffness * place) / model.actuator_gainprm[a, 0]
        return controls

    def _set_free(
        self, joint: int, place: np.ndarray, frame: np.ndarray, velocity: np.ndarray, turning: np.ndarray
    ) -> None:
        at, dof = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint]
        quaternion = np.empty(4)
        self._mujoco.mju_mat2Quat(quaternion, frame.flatten())
        self.data.qpos[at : at + 7] = np.concatenate([place, quaternion])
        self.data.qvel[dof : dof + 6] = np.concatenate([velocity, frame.T @ turning])

    def _velocity(self, body: int) -> np.ndarray:
        """(6,) how a body turns, rad/s, and how its centre of mass moves, m/s, in the world."""
        found = np.empty(6)
        self._mujoco.mj_objectVelocity(self.model, self.data, self._mujoco.mjtObj.mjOBJ_BODY, body, found, 0)
        return found

    def _felt(self) -> np.ndarray:
        """(6,) what gyroscope, rad/s, and accelerometer, m/s², read: on the axis, at the height of the centre of mass."""
        mujoco, data, base = self._mujoco, self.data, self._base
        mujoco.mj_rnePostConstraint(self.model, data)
        moved, turned = np.empty(6), np.empty(6)
        mujoco.mj_objectAcceleration(self.model, data, mujoco.mjtObj.mjOBJ_XBODY, base, moved, 0)
        mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_XBODY, base, turned, 0)
        axes, turning = data.xmat[base].reshape(3, 3), turned[:3]
        frame = axes @ self._own
        arm = axes @ self._to_ball + self.robot.com_height * frame[:, 2]
        force = moved[3:] + np.cross(moved[:3], arm) + np.cross(turning, np.cross(turning, arm))
        return np.concatenate([frame.T @ turning, frame.T @ force])


def _lean(gamma: float, theta: float) -> np.ndarray:
    """(3, 3) frame B of the leans."""
    sin_g, cos_g, sin_t, cos_t = math.sin(gamma), math.cos(gamma), math.sin(theta), math.cos(theta)
    return np.array(
        [[cos_g, -sin_g * sin_t, sin_g * cos_t], [0.0, cos_t, sin_t], [-sin_g, -cos_g * sin_t, cos_g * cos_t]]
    )


def _yaw(psi: float) -> np.ndarray:
    cos, sin = math.cos(psi), math.sin(psi)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
