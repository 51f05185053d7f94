"""How controllers drive a MuJoCo model that others wrote, as the robot that `ballbot identify` finds in a log of that model.

    python benchmarks/foreign_model.py MODEL.xml --controllers lqr nmpc --leans 5 11 17 --torques 2 2 4

LQR with the numbers of the file records a log of 60 s, as docs/identify.md says, and `identify` finds robot and errors in it
alone. A controller with that robot, behind the filter with these errors, then drives from random leans, speeds and places for
8 s. The sensors have the noise of those of `omni`, in the log too. The motors may give less torque than in the file: then the
robot that was identified has the same share of its force. Episodes that are in the file of results are not repeated. The
column "least torque" has the torque in N m with which the unstable part of the identified robot's linear model would just not
grow from the start: a start that needs more than the motors give can hardly be saved.

The controller `policy` is trained by DAgger for each of the leans, on starts like those that it drives from. Its optima are
those of the robot without dry friction, and it overcomes this friction as LQR does. Policies in the folder of a log are used
again.
"""

import argparse
import csv
import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import schur
from scipy.optimize import linprog

from ballbot_baselines import LqrController, NmpcController
from ballbot_baselines.feedback.adaptive import FilteredController
from ballbot_baselines.identification.identify import identify
from ballbot_baselines.identification.likelihood import Readings
from ballbot_baselines.identification.logs import Log
from ballbot_baselines.solvers.linearize import LinearQuadratic
from ballbot_gym import MujocoModel, files, named_robot, register_robot, urdf_text
from ballbot_gym.env import make_task
from ballbot_gym.robot import Sensors, read_urdf, tilt
from ballbot_gym.rollout import Controller, PlanError
from ballbot_gym.tasks.stabilize import Stabilize
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.network import PolicyController, PolicyNetwork

_KNOWN = (
    "body_mass", "ball_mass", "com_height", "inertia", "axial_inertia", "zenith", "force_limit", "wheels.no_load_speed",
    "wheels.inertia", "delay", "lag",
)  # fmt: skip
"""What the file says exactly."""
_NAMES = (
    *(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"),
    *(f"wheel_angle_{i}" for i in (1, 2, 3)),
)
_LOGS = {"rest": (0.0, 0.0), "turned": (0.05, 0.6)}
"""Lean and heading, rad, from which the robot starts whenever it is put up for a log."""
_LOST = 0.4  # rad of lean, at which the robot is lifted while it records
_SPEED, _PLACE = 0.5, 0.5  # m/s and m, of the starts along each axis
_SECONDS, _FALLEN, _NEAR = 8.0, 1.0, 0.1  # s; rad of tilt; m
_SMALL, _AHEAD = np.radians(2), 0.3  # rad; s
_RECOVERED = 0.9  # of the torque of the motors, which starts need in training
_GROWS = 1.001  # in a control step: what grows faster is unstable


class FullTorque(LqrController):
    """The greatest torque against the lean while that is more than 2°, and then LQR: what falls nevertheless is hardly saved.

    It is for controllers that see the state.
    """

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        if tilt(x) < _SMALL:
            return super().act(t, x)
        falling, robot = x[2:4] + _AHEAD * x[6:8], self._robot
        return robot.force_limit * np.sign(robot.turning_ball(x, 1e6 * falling))  # pyright: ignore


class _Recoverable(Stabilize):
    """Its starts need at most a share of the robot's torque. The hardest of all are those that nothing can save."""

    def sample(self, rng: np.random.Generator, params: Any) -> tuple[np.ndarray, np.ndarray]:
        x, c = super().sample(rng, params)
        while least_torque(self, params, x) > _RECOVERED * params.force_limit * params.wheels.radius:
            x, c = super().sample(rng, params)
        return x, c


class TrainedPolicy:
    """A policy for a robot, which is trained if its file does not exist. It overcomes dry friction as LQR does."""

    def __init__(self, task: Any, robot: Any, file: Path):
        self._task, self._robot = task, robot
        urdf, name = file.with_suffix(".urdf"), re.sub(r"\W", "_", f"{file.parent.name}_{file.stem}").lower()
        if not urdf.exists():
            files.write(urdf, urdf_text(robot.without_dry_friction()))
        register_robot(name, urdf)
        smooth = named_robot(name)
        if not file.exists():
            given = {"iterations": 24, "gathering_iterations": 4, "episodes_per_iteration": 32, "symmetry": "none"}
            settings = replace(LEARNERS["dagger"].settings("stabilize"), **given)
            starts = _Recoverable(**{field.name: getattr(task, field.name) for field in fields(task)})
            learner = LEARNERS["dagger"].make(starts, smooth, settings, 0)
            while learner.iteration < learner.iterations:
                learner.iterate()
            learner.network.spec = replace(learner.network.spec, task=task.problem())
            learner.network.save(file, {"training": {"learner": "dagger", "settings": asdict(settings)}})
        self._policy = PolicyController(task, smooth, PolicyNetwork.load(file, task, name))

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._policy.reset(t, x, c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        return self._robot.overcoming(x, self._policy.act(t, x), self._task.control_dt)


_CONTROLLERS: dict[str, Callable[[Any, Any, Path], Controller]] = {
    "lqr": lambda task, robot, _: LqrController(task, robot),
    "nmpc": lambda task, robot, _: NmpcController(task, robot),
    "full": lambda task, robot, _: FullTorque(task, robot),
    "policy": TrainedPolicy,
}
"""Of a task, a robot and a file for what is trained."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--hold", nargs="*", default=[], metavar="JOINT=RAD", help="where joints are held")
    parser.add_argument("--logs", nargs="+", choices=_LOGS, default=list(_LOGS))
    parser.add_argument("--controllers", nargs="+", choices=_CONTROLLERS, default=["lqr"])
    parser.add_argument("--leans", nargs="+", type=float, default=[5.0, 11.0, 17.0], help="degrees, for each axis")
    parser.add_argument("--torques", nargs="+", type=float, default=[2.0, 2.0, 4.0], help="N m, for each of the leans")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--true-state", action="store_true", help="controllers see the state instead of the sensors")
    parser.add_argument("--out", type=Path, default=Path("runs/foreign_model"))
    options = parser.parse_args()
    pose = {name: float(value) for name, value in (each.split("=") for each in options.hold)}
    table, rows = options.out / "foreign_model.csv", []
    if table.exists():
        rows = list(csv.DictReader(table.read_text().splitlines()))
    model = MujocoModel(options.model, pose)
    for log in options.logs:
        held = "_".join(f"{name}_{angle:g}" for name, angle in pose.items())
        found = Identified.of(model, log, options.out / "_".join(filter(None, (options.model.stem, held, log))))
        for key in episodes(options, log, held):
            key = {name: str(value) for name, value in key.items()}
            if any(all(row[name] == value for name, value in key.items()) for row in rows):
                continue
            rows.append(key | driven(model, found, key))
            files.write_csv(table, rows)
            print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
    summarize(rows)


def episodes(options: argparse.Namespace, log: str, held: str) -> Iterator[dict[str, Any]]:
    """What names an episode."""
    for name in options.controllers:
        for lean, torque in zip(options.leans, options.torques, strict=True):
            for seed in range(options.first, options.first + options.seeds):
                seen = "state" if options.true_state else "sensors"
                setting = {"controller": name, "sees": seen, "lean": lean, "torque": torque}
                yield {"model": options.model.stem, "held": held, "log": log, **setting, "seed": seed}


@dataclass(frozen=True)
class Identified:
    """The robot and the errors that a log gave, with the force that its motors give in the file."""

    robot: Any
    errors: dict[str, float]
    folder: Path
    """With what the log gave, and policies for the robot."""

    @classmethod
    def of(cls, model: MujocoModel, start: str, folder: Path) -> "Identified":
        """What is found in a log; written to a folder, or read from there."""
        robot, numbers = folder / "robot.urdf", folder / "numbers.json"
        if not numbers.exists():
            log = Log.read(Log.write(recorded(model, *_LOGS[start]), folder / "log.csv"), model.robot)
            result = identify(model.robot, [log], _KNOWN)
            files.write(robot, urdf_text(result.found.robot))
            errors = result.predictions.errors[:, :, 1]
            found = {each.parameter.name: each.value for each in result.found.estimates}
            found["prediction error"] = float(np.exp(np.log(errors[1] / errors[0]).mean()))
            files.write(numbers, json.dumps(found, indent=1))
        found = json.loads(numbers.read_text())
        print(f"{folder.name}: " + ", ".join(f"{name} {value:.4g}" for name, value in found.items()), flush=True)
        return cls(read_urdf(robot), found, folder)


class Sensed:
    """What the noisy sensors of a model show."""

    def __init__(self, model: MujocoModel, rng: np.random.Generator):
        self._model, self._rng = model, rng
        self._bias, self._left = rng.normal(0, Sensors.GYROSCOPE_BIAS, 3), np.full(3, 0.5)
        samples = Sensors(model.robot, model.control_dt).samples
        self._noise = np.repeat([Sensors.GYROSCOPE_NOISE, Sensors.ACCELEROMETER_NOISE], 3) / np.sqrt(samples)

    def readings(self) -> np.ndarray:
        """(9,) those of the last control step, SI units."""
        read = self._model.readings.copy()
        read[:6] += self._rng.normal(0, self._noise)
        read[:3] += self._bias
        turned = read[6:] / Sensors.TICK + self._left
        self._left = turned % 1.0
        read[6:] = Sensors.TICK * np.floor(turned)
        return read

    def observed(self) -> np.ndarray:
        """As that of the model, of an episode without constants."""
        shown = self._model.observed(np.zeros(0))
        return np.concatenate([self.readings() / Sensors.SCALE, shown[9:]])


def recorded(model: MujocoModel, lean: float, heading: float, seconds: float = 60.0) -> Readings:
    """A log of LQR with the numbers of the file, which sees the state. The robot is put up again whenever it falls."""
    task, robot, dt = make_task("stabilize", "omni"), model.robot, model.control_dt
    controller, rows, restarts, t = LqrController(task, robot), [], [], 0.0
    sensors = Sensed(model, np.random.default_rng(0))
    start = robot.rest()
    start[[2, 8]] += lean, heading
    while t < seconds:
        x, angles, first = model.reset(start), np.zeros(3), len(rows)
        read = sensors.readings()
        controller.reset(0.0, x, np.zeros(0))
        while t < seconds and abs(x[2:4]).max() < _LOST:
            u = controller.act(0.0, x).clip(-robot.force_limit, robot.force_limit)
            rows.append([t, *read[:6], *angles, *u])
            x, t = model.step(u), t + dt
            read = sensors.readings()
            angles = angles + read[6:]
        del rows[first]  # its readings are not of a motion
        restarts.append(first)
        t += 1.0
    table = np.array(rows)
    delays, windows = (dt / 2,) * 6 + (0.0,) * 3, (dt,) * 6 + (0.0,) * 3
    return Readings(_NAMES, table[:, 0], table[:, 1:10], table[:, 10:], delays, tuple(restarts), None, windows)


def driven(model: MujocoModel, found: Identified, key: dict[str, str]) -> dict[str, Any]:
    """Whether the robot falls in an episode, how far from the origin it ends, and how wrong the estimate of its lean is."""
    rng, lean = np.random.default_rng(int(key["seed"])), np.radians(float(key["lean"]))
    robot = replace(found.robot, force_limit=found.robot.force_limit * float(key["torque"]) / torque_of(model))
    task = replace(
        make_task("stabilize", "omni"), start_position=_PLACE, start_speed=_SPEED, start_lean=lean, start_lean_rate=1e-3
    )
    senses = key["sees"] == "sensors"
    file = found.folder / f"policy_{float(key['lean']):g}_{float(key['torque']):g}.json"
    controller = _CONTROLLERS[key["controller"]](task, robot, file)
    if senses:
        controller = FilteredController(task, robot, "-ekf", controller, found.errors)
    x = np.zeros(11)
    x[:6] = rng.uniform(-1, 1, 6) * np.repeat([_PLACE, lean, _SPEED], 2)
    x, sensors, wrong = model.reset(x), Sensed(model, rng), []
    least = f"{least_torque(task, robot, x):.2f}"
    seen, begin, dt = sensors.observed() if senses else x, time.process_time(), model.control_dt
    try:
        controller.reset(0.0, seen, np.zeros(0))
    except PlanError:
        seconds = f"{time.process_time() - begin:.1f}"
        return {"least torque": least, "fell": "no plan", "distance": "", "lean error": "", "seconds": seconds}
    for step in range(round(_SECONDS / dt)):
        u = controller.act(step * dt, seen).clip(-robot.force_limit, robot.force_limit)
        if isinstance(controller, FilteredController):
            wrong.append(controller.filter.x[2:4] - x[2:4])
        x = model.step(u)
        seen = sensors.observed() if senses else x
        if tilt(x) > _FALLEN:
            break
    after = np.array(wrong[round(1 / dt) :])
    return {
        "least torque": least,
        "fell": str(bool(tilt(x) > _FALLEN)),
        "distance": f"{np.hypot(*x[:2]):.4f}",
        "lean error": f"{np.sqrt(np.mean(np.sum(after**2, axis=1))):.4f}" if len(after) else "",
        "seconds": f"{time.process_time() - begin:.1f}",
    }


def least_torque(task: Any, robot: Any, x: np.ndarray) -> float:
    """N m of every motor, with less than which the unstable part of the linear model about rest grows from state x.

    This model has no dry friction.
    """
    of_state, of_forces = _growth(task, robot)
    held = np.hstack([of_forces, np.zeros((len(of_forces), 1))])
    within = np.block([[np.eye(3), -np.ones((3, 1))], [-np.eye(3), -np.ones((3, 1))]])
    wanted = -of_state @ (x - robot.rest())
    found = linprog([0, 0, 0, 1], within, np.zeros(6), held, wanted, bounds=(None, None))
    return float(found.x[3] * robot.wheels.radius)


@lru_cache
def _growth(task: Any, robot: Any) -> tuple[np.ndarray, np.ndarray]:
    """Two matrices: by how much the unstable part grows in a control step for a state, from rest, and for the forces."""
    free, rest = robot.without_dry_friction(), robot.rest()
    ((a,), (b,)) = LinearQuadratic(task, free, rest[None], np.zeros((1, 3)), np.zeros(0)).dynamics
    _, own, count = schur(a.T, sort=lambda real, imaginary: np.hypot(real, imaginary) > _GROWS)
    unstable = own[:, :count].T
    return unstable @ (a - np.eye(len(a))), unstable @ b


def torque_of(model: MujocoModel) -> float:
    """N m that each motor of the file gives."""
    return model.robot.force_limit * model.robot.wheels.radius


def summarize(rows: list[dict[str, Any]]) -> None:
    """Prints how many episodes of each setting fall, and how many end near the origin, of all and of those not too hard."""
    names = ("model", "held", "log", "controller", "sees", "lean", "torque")
    for setting in dict.fromkeys(tuple(row[name] for name in names) for row in rows):
        own = [row for row in rows if tuple(row[name] for name in names) == setting]
        standing = [float(row["distance"]) for row in own if row["fell"] == "False"]
        ends = f"{min(standing):.3f} to {max(standing):.3f} m" if standing else "-"
        enough = [row for row in own if float(row["least torque"]) <= float(row["torque"])]
        print(
            f"{' '.join(filter(None, setting))}: {len(own)} seeds, {len(own) - len(standing)} fall, {at_rest(own)} rest, "
            f"{ends}; {at_rest(enough)} of the {len(enough)} that need at most this torque rest"
        )


def at_rest(rows: list[dict[str, Any]]) -> int:
    """How many episodes end near the origin."""
    return sum(row["fell"] == "False" and float(row["distance"]) < _NEAR for row in rows)


if __name__ == "__main__":
    main()
