"""What each engine gets wrong: order of convergence, slip against friction, free fall over, spin, and a flight.

Closed form, PyBullet and MuJoCo, those that are installed, one after another, in seconds. Writes engine_errors.csv.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from ballbot_gym import dynamics, files
from ballbot_gym.engines import Simulator, installed_physics, make_simulator
from ballbot_gym.params import BallbotParams
from ballbot_gym.robots import named_robot

_DT = 0.02  # s, a control step
_EXACT = 0.0001  # s, a step of the closed form whose error is rounding's
_LEANING = (0.1, -0.2, 0.2, -0.1, 1.0, -0.5, 0.5, 0.3)
_FALLING = (0.0, 0.0, 0.02, 0.01, 0.0, 0.0, 0.0, 0.0)
_THROWN = (0.0, 0.0, 1.2, 0.0, 0.0, 0.0, -9.0, 0.0)  # the body swings up and pulls the ball off the floor


def main(out: Path = Path("runs/engine-errors")) -> None:
    """Measures, prints and writes.

    Args:
        out: folder of the results.
    """
    rows: list[dict[str, Any]] = []
    for physics in installed_physics():
        for robot in ("paper", "rolling"):
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
        error = math.dist(_run(make_simulator(physics, robot, _DT, dt), _LEANING, force, 15)[-1][:2], end[:2])
        errors.append(error)
        yield f"distance after 0.3 s, steps of {1e3 * dt:g} ms", error, "m"
    # of the longest two: the error of shorter steps may be rounding's, or the contact's
    yield "order of convergence", math.log(errors[0] / errors[1]) / math.log(steps[0] / steps[1]), ""


def free_fall(physics: str, name: str) -> Iterator[tuple[str, float, str]]:
    """Energy gained until a robot without forces leans by 1 rad, in parts of the potential energy that it fell through."""
    robot = replace(named_robot(name), friction=math.inf)
    states = _run(make_simulator(physics, robot, _DT), _FALLING, (0.0, 0.0), 100)
    end = next(x for x in states if dynamics.tilt(x) > 1)
    fallen = _potential(robot, _FALLING) - _potential(robot, end)
    yield "energy of a free fall over, gained", (_energy(robot, end) - _energy(robot, _FALLING)) / fallen, ""


def slips(physics: str) -> Iterator[tuple[str, float, str]]:
    """Speed of the ball's lowest point after 40 ms of 200 N from rest, by friction; and the spin about the vertical."""
    for friction in (0.3, 0.6, 0.9, 1.2):
        robot = replace(named_robot("rolling"), friction=friction)
        simulator = make_simulator(physics, robot, _DT)
        _run(simulator, (0.0,) * 8, (200.0, 0.0), 2)
        yield f"slip after 40 ms of 200 N, friction {friction:g}", math.hypot(*simulator.slip()), "m/s"
        yield f"height of that ball, friction {friction:g}", simulator.height(), "m"
    simulator = make_simulator(physics, named_robot("rolling"), _DT)
    _run(simulator, _LEANING, (10.0, -5.0), 15)
    yield "spin about the vertical after 0.3 s in grip", _spin(simulator), "rad/s"


def flight(physics: str) -> Iterator[tuple[str, float, str]]:
    """A ball that a swinging body pulls off the floor: its greatest height, and how deep it presses in and rebounds."""
    simulator = make_simulator(physics, named_robot("rolling"), _DT)
    simulator.reset(_THROWN)
    heights = []
    for _ in range(75):
        simulator.step((0.0, 0.0))
        heights.append(simulator.height())
    top = int(np.argmax(heights))
    yield "thrown ball, greatest height", heights[top], "m"
    yield "thrown ball, lands after", _DT * (top + next(i for i, h in enumerate(heights[top:]) if h < 1e-3) + 1), "s"
    yield "thrown ball, deepest in the floor", -min(heights), "m"


def _run(simulator: Simulator, x: tuple[float, ...], force: tuple[float, float], steps: int) -> list[tuple[float, ...]]:
    simulator.reset(x)
    return [simulator.step(force) for _ in range(steps)]


def _potential(robot: BallbotParams, x: tuple[float, ...]) -> float:
    return robot.body_mass * robot.gravity * robot.com_height * math.cos(x[2]) * math.cos(x[3])


def _energy(robot: BallbotParams, x: tuple[float, ...]) -> float:
    """Kinetic and potential, J, of a robot whose ball translates, or rolls in grip."""
    _, _, gamma, theta, vx, vy, dgamma, dtheta = x
    m, arm = robot.body_mass, robot.com_height
    sine, cosine, lean, upright = math.sin(gamma), math.cos(gamma), math.sin(theta), math.cos(theta)
    wx = arm * (cosine * upright * dgamma - sine * lean * dtheta)
    wy = arm * upright * dtheta
    total = robot.body_mass + robot.ball_mass + (robot.ball_inertia / robot.ball_radius**2 if robot.rolls else 0.0)
    pivot = robot.inertia + m * arm**2
    turning = (pivot * upright**2 + robot.axial_inertia * lean**2) * dgamma**2 + pivot * dtheta**2
    return 0.5 * total * (vx**2 + vy**2) + m * (vx * wx + vy * wy) + 0.5 * turning + _potential(robot, x)


def _spin(simulator: Any) -> float:
    """Of the ball about the vertical, rad/s."""
    if hasattr(simulator, "_velocities"):  # MuJoCo's, in the ball's own axes
        w, x, y, z = simulator._positions[-4:]
        a, b, c = simulator._velocities[-3:]
        return float(2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c)
    bullet, client = simulator._bullet, simulator._client
    return bullet.getLinkState(simulator._robot, simulator._ball, computeLinkVelocity=1, physicsClientId=client)[7][2]


if __name__ == "__main__":
    tyro.cli(main)
