"""The robot in MuJoCo, as a chain of joints, and with contact where the ball rolls."""

import logging
import math
from operator import itemgetter
from types import ModuleType
from typing import Any

import numpy as np

from ballbot_gym.engines.simulator import MOST_FRICTION, Simulator, State
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import Omni, PointBall, RollingBall

_PRESSED = -1e-9  # m: height of the ball at reset; at 0 the first step would find no contact
_ALMOST_NOTHING = 1e-9  # kg and kg·m²: MuJoCo requires a mass of every moving body
_BODY, _BALL = 2, 3  # after the world and the hub, in the order in which they are added
_LEANS = (((0, 1, 0), "gamma"), ((-1, 0, 0), "theta"))


class _MujocoSimulator(Simulator):
    """A robot whose ball translates in MuJoCo, integrated by RK4."""

    _places = (0, 1, 2, 3)  # of x, y, γ and θ among the joints
    _longest = 0.005  # s, of a step by default

    def __init__(self, params: Any, control_dt: float, physics_dt: float | None = None):
        """Makes the robot.

        Args:
            params: the robot.
            control_dt: s, how long each force is held.
            physics_dt: s, MuJoCo's step, a whole fraction of control_dt; default 5 ms, and 2 ms with contact, or less
                where control_dt is no multiple of it.

        Raises:
            ImportError: MuJoCo is not installed.
            RuntimeError: MuJoCo refuses the robot.
        """
        if physics_dt is None:
            physics_dt = control_dt / max(1, np.ceil(control_dt / self._longest - 1e-9))
        self._substeps = self._whole_substeps(control_dt, physics_dt)
        self._dt = physics_dt
        self._mujoco = import_mujoco()
        self._mj_step = self._mujoco.mj_step
        kinds = self._mujoco.mjtWarning
        instabilities = kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC, kinds.mjWARN_INERTIA
        self._instabilities = itemgetter(*map(int, instabilities))
        self._make(params)

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        self._mujoco.mj_resetData(self._model, self._data)
        if memory:
            self._mujoco.mj_setState(self._model, self._data, np.array(memory), self._kept)
            return
        for i, place in enumerate(self._places):
            self._positions[place], self._velocities[place] = x[i], x[i + 4]

    def set_params(self, params: Any) -> None:
        self._check_kind(params, self._params)
        self._make(params)

    def step(self, u: tuple[float, ...]) -> State:
        self._pushed[0], self._pushed[1] = u  # a third of the time that a slice takes
        self._mj_step(self._model, self._data, self._substeps)
        return (*self._positions.tolist(), *self._velocities.tolist())

    def is_unstable(self) -> bool:
        """Whether MuJoCo warned of numbers that are not finite or too large, or of a singular inertia.

        After most of these warnings MuJoCo puts the robot back to its origin, at rest.
        """
        return any(self._instabilities(self._warned.tolist()))

    def _make(self, params: Any) -> None:
        self._params = params
        mujoco, spec = self._mujoco, self._mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = self._dt, (0, 0, -params.gravity)
        spec.option.integrator, spec.option.tolerance = mujoco.mjtIntegrator.mjINT_RK4, 1e-12
        self._describe(spec)
        try:
            self._model = spec.compile()
        except ValueError as error:
            raise RuntimeError(f"MuJoCo refuses this robot: {error}; {params}") from error
        self._data = mujoco.MjData(self._model)
        # views of the data, because getting a view takes longer than using it
        self._positions, self._velocities, self._pushed = self._data.qpos, self._data.qvel, self._data.qfrc_applied
        self._twisted, self._warned = self._data.xfrc_applied, self._data.warning.number

    def _describe(self, spec: Any) -> None:
        """Adds the robot to an empty world."""
        self._add_body(self._add_ball(spec.worldbody, self._params.ball_mass, (1, 0, 0), (0, 1, 0)))

    def _add_ball(self, parent: Any, mass: float, *slides: tuple[int, int, int]) -> Any:
        """A body at the ball's centre that only translates."""
        body = parent.add_body(pos=(0, 0, self._params.ball_radius), **_inertial(mass, mass))
        for axis in slides:
            body.add_joint(type=self._mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        return body

    def _add_body(self, ball: Any) -> None:
        robot = self._params
        body = ball.add_body(
            name="body",
            ipos=robot.centre_of_mass,
            **_inertial(robot.body_mass, robot.inertia, robot.inertia, robot.axial_inertia),
        )
        for axis, name in _LEANS:
            body.add_joint(name=name, type=self._mujoco.mjtJoint.mjJNT_HINGE, axis=axis)

    @property
    def _kept(self) -> int:
        return int(self._mujoco.mjtState.mjSTATE_INTEGRATION)


class _MujocoContactSimulator(_MujocoSimulator):
    """A robot whose ball rolls in MuJoCo, on a floor: the ball may slip, and leave the floor.

    The force u represents the torque r e_z × u from the body on the ball, which is held over the control step.
    """

    _places = (0, 1, 3, 4)  # z is third, the ball's turn last
    _longest = 0.002

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        """Puts the robot into state x, with a ball that rolls without slipping, unless memory says otherwise."""
        super().reset(x, memory)
        if not memory:
            radius = self._params.ball_radius
            self._positions[2] = _PRESSED
            self._velocities[-3:] = (-x[5] / radius, x[4] / radius, 0.0)

    def memory(self) -> tuple[float, ...]:
        """MuJoCo's whole state: how the ball turns and slips, and where its solver starts."""
        kept = np.empty(self._mujoco.mj_stateSize(self._model, self._kept))
        self._mujoco.mj_getState(self._model, self._data, kept, self._kept)
        return tuple(kept.tolist())

    def floor_force(self) -> tuple[float, float, float]:
        """Of the last stage of MuJoCo's last step; 0 where the ball is in the air."""
        total, force = np.zeros(3), np.empty(6)
        for i in range(self._data.ncon):
            self._mujoco.mj_contactForce(self._model, self._data, i, force)
            total += force[:3] @ self._data.contact[i].frame.reshape(3, 3)
        fx, fy, normal = total.tolist()
        return fx, fy, normal

    def height(self) -> float:
        return float(self._positions[2])

    def slip(self) -> tuple[float, float]:
        vx, vy, *_, a, b, c = self._velocities.tolist()  # a, b, c: the ball's spin in its own axes
        *_, w, x, y, z = self._positions.tolist()
        # its first two components in the world's
        wx = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
        wy = 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
        radius = self._params.ball_radius
        return vx - wy * radius, vy + wx * radius

    def _describe(self, spec: Any) -> None:
        mujoco, robot = self._mujoco, self._params
        spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 100
        hub = self._add_ball(spec.worldbody, _ALMOST_NOTHING, (1, 0, 0), (0, 1, 0), (0, 0, 1))
        self._add_body(hub)  # before the ball, so that its joints come before the ball's
        ball = hub.add_body(name="ball", **_inertial(robot.ball_mass, *[robot.ball_inertia] * 3))
        ball.add_joint(type=mujoco.mjtJoint.mjJNT_BALL)
        nothing = {"contype": 0, "conaffinity": 0}  # they touch as the pair below alone
        ball.add_geom(name="sphere", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(robot.ball_radius, 0, 0), **nothing)
        spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1), **nothing)
        friction = min(robot.friction, MOST_FRICTION)
        # As hard as MuJoCo can be. With its softer defaults the ball creeps and sinks in, thousands of times as far.
        spec.add_pair(
            geomname1="floor",
            geomname2="sphere",
            condim=3,
            friction=(friction, friction, 0, 0, 0),
            solref=(2 * self._dt, 1),
            solimp=(0.9999, 0.9999, 0.0001, 0.5, 2),
        )

    def step(self, u: tuple[float, ...]) -> State:
        """Takes MuJoCo's steps one by one.

        MuJoCo's friction stops a slip within solreffriction, and its convex cone lifts the ball off the floor where
        friction is too weak for that. So friction is given the time that it needs under the robot's weight.
        """
        twisted, radius = self._twisted, self._params.ball_radius
        twisted[_BALL, 3], twisted[_BALL, 4] = -radius * u[1], radius * u[0]
        twisted[_BODY, 3], twisted[_BODY, 4] = radius * u[1], -radius * u[0]
        for _ in range(self._substeps):
            self._soften()
            self._mj_step(self._model, self._data)
        x, y, _, gamma, theta, *_ = self._positions.tolist()
        vx, vy, _, dgamma, dtheta, *_ = self._velocities.tolist()
        return x, y, gamma, theta, vx, vy, dgamma, dtheta

    def _soften(self) -> None:
        robot, softness = self._params, self._model.pair_solreffriction[0]
        strength = min(robot.friction, MOST_FRICTION) * robot.weight * robot.ball_radius**2 / robot.ball_inertia
        softness[0], softness[1] = max(2 * self._dt, 2 * math.hypot(*self.slip()) / strength), 1


class _MujocoOmniSimulator(_MujocoContactSimulator):
    """A robot with three omni-wheels in MuJoCo, on a floor: the ball may slip, and leave the floor.

    A wheel is an actuator between body and ball, whose force falls with its speed, and so is the floor's torque against the
    ball's spin. MuJoCo has no inertia of actuators between bodies. So the rotors' torque is found from the acceleration
    that it changes itself, which takes a linear system, and is held over a step of MuJoCo.
    """

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        """Puts the robot into state x, with a ball that rolls without slipping, unless memory says otherwise."""
        super().reset(x, memory)
        if not memory:
            self._positions[5], self._velocities[5], self._velocities[8] = x[8:]
        self._speeds: np.ndarray | None = None
        self._brake()

    def step(self, u: tuple[float, ...]) -> State:
        """Takes MuJoCo's steps one by one, as without wheels."""
        data = self._data
        data.ctrl[:3] = u
        torque = self._twisted[_BALL, 3:].copy()
        missing = self._rotor_torque() - torque
        slopes = np.empty((3, 3))
        for axis, unit in enumerate(np.eye(3)):
            self._twist(torque + unit)
            slopes[:, axis] = self._rotor_torque() - (torque + unit) - missing
        correction, before = np.linalg.inv(slopes), None
        for _ in range(self._substeps):
            self._twist(torque)
            torque = torque - correction @ (self._rotor_torque() - torque)
            self._twist(torque if before is None else torque + (torque - before) / 2)  # about that of the step's middle
            before = torque
            self._soften()
            self._mj_step(self._model, data)
            self._brake()
        x, y, _, gamma, theta, psi, *_ = self._positions.tolist()
        vx, vy, _, dgamma, dtheta, dpsi, *_ = self._velocities.tolist()
        return x, y, gamma, theta, vx, vy, dgamma, dtheta, psi, dpsi, self._brake()

    def _brake(self) -> float:
        """Sets the floor's torque against the ball's spin about the vertical, and returns that spin, rad/s."""
        turn, wheels = np.empty(9), self._params.wheels
        self._mujoco.mju_quat2Mat(turn, self._positions[6:])
        spin = float(turn[6:] @ self._velocities[6:])
        self._model.actuator_biasprm[3, 2] = wheels.floor_torque(spin) / spin if spin else 0.0
        if self._rubs:
            self._mujoco.mj_fwdPosition(self._model, self._data)  # else speeds are those before the last step
            self._mujoco.mj_fwdVelocity(self._model, self._data)
            speeds = self._data.actuator_velocity[:3].copy()
            before, self._speeds = speeds if self._speeds is None else self._speeds, speeds
            for i, speed in enumerate(
                (speeds + (speeds - before) / 2).tolist()
            ):  # about that of the next step's middle
                drag = wheels.drag(self._params.force_limit) + self._params.axle_drag(speed)
                self._model.actuator_biasprm[i, 2] = -drag
        return spin

    def _twist(self, torque: np.ndarray) -> None:
        """Applies a torque (3,), N·m, on the ball, and the opposite one on the body."""
        self._twisted[_BALL, 3:], self._twisted[_BODY, 3:] = torque, -torque

    def _rotor_torque(self) -> np.ndarray:
        """(3,) N·m, of the rotors on the ball, by the acceleration under all torques that are applied now."""
        mujoco, model, data = self._mujoco, self._model, self._data
        mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        spins, accelerations = data.cvel[:, :3], data.cacc[:, :3]
        # of the ball relative to the body, as seen from the body
        (a, b, c), (p, q, r) = spins[_BODY].tolist(), spins[_BALL].tolist()
        relative = accelerations[_BALL] - accelerations[_BODY] - (b * r - c * q, c * p - a * r, a * q - b * p)
        return self._params.rotor_torque(relative, data.xmat[_BODY].reshape(3, 3))

    def _describe(self, spec: Any) -> None:
        super()._describe(spec)
        mujoco, robot, wheels = self._mujoco, self._params, self._params.wheels
        body, ball = spec.body("body"), spec.body("ball")
        body.add_joint(name="psi", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
        for name, place in (("body", body), ("ball", ball), ("floor", spec.worldbody)):
            place.add_site(name=f"on_{name}")
        drag, self._rubs = wheels.drag(robot.force_limit), robot.axle_drag(0.0) > 0
        units = [robot.torque(tuple(unit)) for unit in np.eye(3).tolist()]
        for turning, damping, other in (*((unit, drag, "body") for unit in units), ((0, 0, 1), 0, "floor")):
            spec.add_actuator(
                target="on_ball",
                refsite=f"on_{other}",
                trntype=mujoco.mjtTrn.mjTRN_SITE,
                gear=(0, 0, 0, *turning),
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                biasprm=(0, 0, -damping, *[0] * 7),
                gainprm=(1, *[0] * 9),
            )


SIMULATORS = {PointBall: _MujocoSimulator, RollingBall: _MujocoContactSimulator, Omni: _MujocoOmniSimulator}
"""By the kind of robot that they simulate."""


def import_mujoco() -> ModuleType:
    """MuJoCo, or an ImportError that says how to get it."""
    with imports_of('physics="mujoco"', "mujoco"):
        import mujoco
    if mujoco.get_mju_user_warning() is None:  # by default a warning also goes to MUJOCO_LOG.TXT in the current folder
        mujoco.set_mju_user_warning(_log_warning)
    return mujoco


def _log_warning(text: str) -> None:
    logging.getLogger(__name__).warning("MuJoCo: %s", text)


def _inertial(mass: float, *inertia: float) -> dict[str, Any]:
    """A body's mass, kg, and inertia about its axes, kg·m², all as the one given."""
    return {"mass": mass, "inertia": inertia if len(inertia) == 3 else inertia * 3, "explicitinertial": True}
