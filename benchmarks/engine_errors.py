"""The errors of each engine: order of convergence, slip against friction, free fall over, spin, and a flight.

Measures the closed form, and PyBullet and MuJoCo if installed, one after another, in seconds. Drake, of the extra `[bench]`,
is the reference for the rolling robot: point contact, by its solver SAP. Writes engine_errors.csv.
"""

import importlib.util
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from ballbot_gym import files
from ballbot_gym.engines import Simulator, State, installed_physics, make_simulator
from ballbot_gym.engines.simulator import MOST_FRICTION
from ballbot_gym.robot import Robot, named_robot, tilt

_DT = 0.02  # s, a control step
_EXACT = 0.0001  # s, a step of the closed form whose error is rounding's
_LEANING = (0.1, -0.2, 0.2, -0.1, 1.0, -0.5, 0.5, 0.3)
_FALLING = (0.0, 0.0, 0.02, 0.01, 0.0, 0.0, 0.0, 0.0)
_ALMOST_NOTHING = 1e-9  # kg and kg·m²: Drake too wants a mass of whatever moves
_STIFF = 1e9  # N/m, of the floor
_THROWN = (0.0, 0.0, 1.2, 0.0, 0.0, 0.0, -9.0, 0.0)  # the body swings up and pulls the ball off the floor


def main(out: Path = Path("runs/engine-errors")) -> None:
    """Measures, prints and writes.

    Args:
        out: folder of the results.
    """
    rows: list[dict[str, Any]] = []
    drake = ["drake"] if importlib.util.find_spec("pydrake") else []
    for physics in installed_physics() + drake:
        for robot in ("rolling",) if drake == [physics] else ("paper", "rolling"):
            found = [*convergence(physics, robot), *free_fall(physics, robot)]
            if robot == "rolling" and physics != "rk4":
                found += [*slips(physics), *flight(physics)]
            for what, value, unit in found:
                rows.append({"physics": physics, "robot": robot, "what": what, "value": f"{value:.3g}", "unit": unit})
                print(" ".join(map(str, rows[-1].values())), flush=True)
    files.write_csv(out / "engine_errors.csv", rows)
    print(f"written: {out / 'engine_errors.csv'}")


def convergence(physics: str, name: str) -> Iterator[tuple[str, float, str]]:
    """The ball's distance from the closed form after 0.3 s of one force in grip, by step, and the order from the last two."""
    robot, force = named_robot(name), (10.0, -5.0)
    end = _run(make_simulator("rk4", robot, _DT, _EXACT), _LEANING, force, 15)[-1]
    errors, steps = [], (0.005, 0.002, 0.001, 0.0005)
    for dt in steps:
        error = math.dist(_run(_simulator(physics, robot, _DT, dt), _LEANING, force, 15)[-1][:2], end[:2])
        errors.append(error)
        yield f"distance after 0.3 s, steps of {1e3 * dt:g} ms", error, "m"
    # of the longest two: the error of shorter steps may be rounding's, or the contact's
    yield "order of convergence", math.log(errors[0] / errors[1]) / math.log(steps[0] / steps[1]), ""


def free_fall(physics: str, name: str) -> Iterator[tuple[str, float, str]]:
    """Energy gained until a robot without forces leans by 1 rad, in parts of the potential energy that it fell through."""
    robot = replace(named_robot(name), friction=math.inf)
    states = _run(_simulator(physics, robot, _DT), _FALLING, (0.0, 0.0), 100)
    end = next(x for x in states if tilt(x) > 1)
    fallen = _potential(robot, _FALLING) - _potential(robot, end)
    yield "energy of a free fall over, gained", (_energy(robot, end) - _energy(robot, _FALLING)) / fallen, ""


def slips(physics: str) -> Iterator[tuple[str, float, str]]:
    """Speed of the ball's lowest point after 40 ms of 200 N from rest, by friction; and the spin about the vertical."""
    for friction in (0.3, 0.6, 0.9, 1.2):
        robot = replace(named_robot("rolling"), friction=friction)
        simulator = _simulator(physics, robot, _DT)
        _run(simulator, (0.0,) * 8, (200.0, 0.0), 2)
        yield f"slip after 40 ms of 200 N, friction {friction:g}", math.hypot(*simulator.slip()), "m/s"
        yield f"height of that ball, friction {friction:g}", simulator.height(), "m"
    simulator = _simulator(physics, named_robot("rolling"), _DT)
    _run(simulator, _LEANING, (10.0, -5.0), 15)
    yield "spin about the vertical after 0.3 s in grip", _spin(simulator), "rad/s"


def flight(physics: str) -> Iterator[tuple[str, float, str]]:
    """A ball that a swinging body pulls off the floor: its greatest height, and how deep it presses in and rebounds."""
    simulator = _simulator(physics, named_robot("rolling"), _DT)
    simulator.reset(_THROWN)
    heights = []
    for _ in range(75):
        simulator.step((0.0, 0.0))
        heights.append(simulator.height())
    top = int(np.argmax(heights))
    yield "thrown ball, greatest height", heights[top], "m"
    yield "thrown ball, lands after", _DT * (top + next(i for i, h in enumerate(heights[top:]) if h < 1e-3) + 1), "s"
    yield "thrown ball, deepest in the floor", -min(heights), "m"


class DrakeContactSimulator(Simulator):
    """A robot whose ball rolls in Drake, with point contact: a chain of joints like MuJoCo's."""

    def __init__(self, params: Robot, control_dt: float, physics_dt: float | None = None):
        """Args: same as for the engines; physics_dt is 1 ms by default."""
        from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
        from pydrake.math import RigidTransform, RotationMatrix
        from pydrake.multibody import plant as drake
        from pydrake.multibody import tree
        from pydrake.multibody.math import SpatialForce
        from pydrake.systems.analysis import Simulator as Clock
        from pydrake.systems.framework import DiagramBuilder

        self._params, self._dt, self._drake, self._spatial = params, control_dt, drake, SpatialForce
        builder = DiagramBuilder()
        self._plant, _ = plant, _ = drake.AddMultibodyPlantSceneGraph(builder, physics_dt or 0.001)
        plant.set_discrete_contact_approximation(drake.DiscreteContactApproximation.kLagged)
        plant.mutable_gravity_field().set_gravity_vector([0, 0, -params.gravity])

        def link(name: str, mass: float, centre: float, *moments: float) -> Any:
            inertia = tree.RotationalInertia(*moments)
            return plant.AddRigidBody(name, tree.SpatialInertia.MakeFromCentralInertia(mass, [0, 0, centre], inertia))

        x, y, z, yoke = (link(name, _ALMOST_NOTHING, 0.0, *[_ALMOST_NOTHING] * 3) for name in ("x", "y", "z", "yoke"))
        self._body = link(
            "body", params.body_mass, params.com_height, params.inertia, params.inertia, params.axial_inertia
        )
        self._ball = link("ball", params.ball_mass, 0.0, *[params.ball_inertia] * 3)
        world, slide, hinge = plant.world_body(), tree.PrismaticJoint, tree.RevoluteJoint
        chain = [(slide, world, x, (1, 0, 0)), (slide, x, y, (0, 1, 0)), (hinge, z, yoke, (0, 1, 0))]
        chain += [(hinge, yoke, self._body, (-1, 0, 0)), (slide, y, z, (0, 0, 1))]
        frames = [(kind, a.body_frame(), b.body_frame(), axis) for kind, a, b, axis in chain]
        *self._joints, self._height = [plant.AddJoint(kind(f"{i}", *rest)) for i, (kind, *rest) in enumerate(frames)]
        # its three angles begin with that about y, about which the ball rolls most: the second must not reach 90°
        turned = tree.FixedOffsetFrame(
            "turned", z.body_frame(), RigidTransform(RotationMatrix.MakeZRotation(math.pi / 2))
        )
        self._roll = plant.AddJoint(tree.BallRpyJoint("roll", plant.AddFrame(turned), self._ball.body_frame()))
        surface = ProximityProperties()
        friction = drake.CoulombFriction(*[min(params.friction, MOST_FRICTION)] * 2)
        AddContactMaterial(dissipation=0.0, point_stiffness=_STIFF, friction=friction, properties=surface)
        below = RigidTransform([0.0, 0.0, -params.ball_radius])
        plant.RegisterCollisionGeometry(world, below, HalfSpace(), "floor", surface)
        plant.RegisterCollisionGeometry(self._ball, RigidTransform(), Sphere(params.ball_radius), "sphere", surface)
        plant.Finalize()
        self._clock = Clock(builder.Build())
        self._context = plant.GetMyMutableContextFromRoot(self._clock.get_mutable_context())
        self._places = [joint.position_start() for joint in self._joints]

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        positions, velocities = np.zeros(self._plant.num_positions()), np.zeros(self._plant.num_velocities())
        positions[self._places], velocities[self._places] = x[:4], x[4:]
        radius, roll = self._params.ball_radius, self._roll.velocity_start()
        velocities[roll : roll + 2] = x[4] / radius, x[5] / radius  # about the turned axes
        self._plant.SetPositionsAndVelocities(self._context, np.concatenate([positions, velocities]))
        self._steps = 0
        self._clock.get_mutable_context().SetTime(0.0)
        self._clock.Initialize()

    def step(self, u: tuple[float, float]) -> State:
        radius, forces = self._params.ball_radius, []
        for body, sign in ((self._ball, 1), (self._body, -1)):
            forces.append(self._drake.ExternallyAppliedSpatialForce())
            forces[-1].body_index = body.index()
            forces[-1].F_Bq_W = self._spatial(sign * radius * np.array([-u[1], u[0], 0.0]), np.zeros(3))
        self._plant.get_applied_spatial_force_input_port().FixValue(self._context, forces)
        self._steps += 1
        self._clock.AdvanceTo(self._steps * self._dt)
        both = self._plant.GetPositions(self._context), self._plant.GetVelocities(self._context)
        return tuple(float(part[place]) for part in both for place in self._places)

    def height(self) -> float:
        return float(self._height.get_translation(self._context))

    def slip(self) -> tuple[float, float]:
        moved = self._plant.EvalBodySpatialVelocityInWorld(self._context, self._ball)
        (wx, wy, _), (vx, vy, _), radius = moved.rotational(), moved.translational(), self._params.ball_radius
        return float(vx - wy * radius), float(vy + wx * radius)

    def spin(self) -> float:
        """Of the ball about the vertical, rad/s."""
        return float(self._plant.EvalBodySpatialVelocityInWorld(self._context, self._ball).rotational()[2])


def _simulator(physics: str, robot: Robot, control_dt: float, physics_dt: float | None = None) -> Any:
    make = DrakeContactSimulator if physics == "drake" else partial(make_simulator, physics)
    return make(robot, control_dt, physics_dt)


def _run(simulator: Simulator, x: tuple[float, ...], force: tuple[float, float], steps: int) -> list[tuple[float, ...]]:
    simulator.reset(x)
    return [simulator.step(force) for _ in range(steps)]


def _potential(robot: Robot, x: tuple[float, ...]) -> float:
    return robot.body_mass * robot.gravity * robot.com_height * math.cos(x[2]) * math.cos(x[3])


def _energy(robot: Robot, x: tuple[float, ...]) -> float:
    """Kinetic and potential, J, of a robot whose ball translates, or rolls in grip."""
    _, _, gamma, theta, vx, vy, dgamma, dtheta = x
    m, arm = robot.body_mass, robot.com_height
    sine, cosine, lean, upright = math.sin(gamma), math.cos(gamma), math.sin(theta), math.cos(theta)
    wx = arm * (cosine * upright * dgamma - sine * lean * dtheta)
    wy = arm * upright * dtheta
    total = robot.moving_mass
    pivot = robot.inertia + m * arm**2
    turning = (pivot * upright**2 + robot.axial_inertia * lean**2) * dgamma**2 + pivot * dtheta**2
    return 0.5 * total * (vx**2 + vy**2) + m * (vx * wx + vy * wy) + 0.5 * turning + _potential(robot, x)


def _spin(simulator: Any) -> float:
    """Of the ball about the vertical, rad/s."""
    if isinstance(simulator, DrakeContactSimulator):
        return simulator.spin()
    if hasattr(simulator, "_velocities"):  # MuJoCo's, in the ball's own axes
        w, x, y, z = simulator._positions[-4:]
        a, b, c = simulator._velocities[-3:]
        return float(2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c)
    bullet, client = simulator._bullet, simulator._client
    return bullet.getLinkState(simulator._robot, simulator._ball, computeLinkVelocity=1, physicsClientId=client)[7][2]


if __name__ == "__main__":
    tyro.cli(main)
