"""Logs of simulated robots: what a robot with sensors, delay and motors would have recorded."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ballbot_baselines.feedback.adaptive import FilteredController
from ballbot_baselines.feedback.lqr import LqrController
from ballbot_baselines.identification.likelihood import Readings
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import Ballbot, Randomization, Sensors
from ballbot_gym.rollout import Controller, rollout
from ballbot_gym.tasks import Task
from ballbot_gym.trajectory import Trajectory

Motion = Callable[[float], np.ndarray]
"""(3,) place, m, and heading, rad, at which the robot is asked to be at a time, s; only robots with wheels have a heading."""

RATE = 100.0
"""Readings per second of a recorded log."""
_STATES = tuple(f"{name}_{axis}" for name in ("position", "lean", "speed", "lean_rate") for axis in "xy")
_BEGIN = 2.0  # s, in which a motion grows to its whole size
_TURN = 0.15  # rad, of each wave of the heading
_STEP = 1e-3  # s, of the difference that gives a motion's speed


class Recorded(NamedTuple):
    """A log, and what made it."""

    readings: Readings
    robot: Ballbot
    """With the masses and lengths that were drawn."""
    strength: float
    """Ratio of the applied force to the command."""
    delay: float
    """s."""
    lean: float
    """The greatest, rad."""
    trajectory: Trajectory
    """The true states, and the forces that the robot applied."""


class Waves(NamedTuple):
    """A motion of sines."""

    amplitudes: np.ndarray
    """(3, k) m, m and rad."""
    frequencies: np.ndarray
    """(k,) Hz."""
    phases: np.ndarray
    """(3, k) rad."""

    def __call__(self, t: float) -> np.ndarray:
        waves = self.amplitudes * np.sin(2 * math.pi * self.frequencies * t + self.phases)
        return min(t / _BEGIN, 1.0) * waves.sum(axis=1)

    @classmethod
    def still(cls) -> "Waves":
        """The motion of a robot that balances in one place."""
        return cls(np.zeros((3, 1)), np.zeros(1), np.zeros((3, 1)))

    @classmethod
    def driving(cls, robot: Ballbot, rng: np.random.Generator) -> "Waves":
        """A motion of five waves of random phase, with leans of up to about ten degrees and half the force of the drive."""
        frequencies = np.array([0.07, 0.16, 0.31, 0.53, 0.87])
        most = min(1.0, 0.25 * robot.FORCE_SHARE * robot.force_limit / robot.total_mass)  # m/s², of all waves together
        acceleration = most / math.sqrt(len(frequencies)) * np.array([0.3, 0.8, 1.0, 1.0, 1.0])
        along = acceleration / (2 * math.pi * frequencies) ** 2
        amplitudes = np.minimum([along, along, np.full(len(along), _TURN)], 2.0)
        return cls(amplitudes, frequencies, rng.uniform(0, 2 * math.pi, amplitudes.shape))


class _Driver:
    """A controller that holds the robot in a moving place, and writes down what it asks for."""

    def __init__(self, controller: Controller, motion: Motion):
        self._controller, self._motion = controller, motion

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._controller.reset(t, x, c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        place = self._motion(t)
        speed = (self._motion(t + _STEP) - place) / _STEP
        moved = np.array(x, np.float64)
        moved[:2], moved[4:6] = x[:2] - place[:2], x[4:6] - speed[:2]
        if len(x) > len(_STATES):
            moved[8:10] = x[8] - place[2], x[9] - speed[2]
        return self._controller.act(t, moved)


class _Logger:
    """Passes everything on to a controller, and keeps what it was shown and what it answered."""

    def __init__(self, controller: Any):
        self._controller = controller
        self.senses = getattr(controller, "senses", False)
        self.seen: list[np.ndarray] = []
        self.commands: list[np.ndarray] = []

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._controller.reset(t, x, c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        self.seen.append(np.array(x, np.float64))
        self.commands.append(np.array(self._controller.act(t, x), np.float64))
        return self.commands[-1]


def record(
    robot: Ballbot,
    seconds: float = 60.0,
    motion: Motion | None = None,
    randomization: Randomization | str | None = "real",
    physics: str | None = None,
    seed: int = 0,
    controller: Controller | None = None,
    start: np.ndarray | None = None,
) -> Recorded:
    """Records a robot that LQR balances behind a filter, made for the nominal robot, or that a given controller drives.

    Robots without wheels report their state with the errors of the randomization. Robots with wheels report gyroscope,
    accelerometer and the angles of their wheels, with the errors of `ballbot_gym.robot.sensors`.

    Args:
        robot: the nominal one.
        seconds: of the log.
        motion: where it is asked to be; default, `Waves.driving`.
        randomization: what differs from the nominal robot, or a name in `TRACKS`.
        physics: same as in `BallbotEnv`.
        seed: of what is drawn; with the same seed and randomization it is the same robot.
        controller: of Stabilize in steps of 1 / `RATE`, which acts on the readings instead of LQR, without a motion.
        start: (n,) state in which the log begins; default, upright and at rest at the origin.

    Raises:
        ValueError: the robot fell, or a controller is given and a motion too.
    """
    if controller is not None and motion is not None:
        raise ValueError("give a motion or a controller; the controller decides where the robot goes")
    motion = Waves.driving(robot, np.random.default_rng(seed)) if motion is None else motion
    senses, fields = bool(robot.SENSORS), {"duration": seconds, "control_dt": 1 / RATE, "arena_radius": 100.0}
    task = make_task("stabilize", robot, **fields)
    env = BallbotEnv(
        task, physics, randomization=randomization, robot=robot, observation="sensors" if senses else "state"
    )
    driver: Any = _Driver(LqrController(task, robot), motion) if controller is None else controller
    if controller is None and (senses or env.randomization.active):
        driver = FilteredController(task, robot, "-ekf" if senses else "-adaptive-ekf", driver)
    logger, begin = _Logger(driver), np.zeros(robot.state_size) if start is None else start
    episode = rollout(env, logger, seed=seed, options={"state": begin})
    drawn = env.get_state().drawn
    env.close()
    if episode.failure:
        raise ValueError(
            f"the simulated robot fell after {episode.trajectory.duration:.1f} s ({episode.violated}); give another seed, or "
            "a randomization that varies less"
        )
    true = env.randomization.robot(robot, drawn) if drawn else robot
    delay = float(drawn[5]) / RATE if drawn else 0.0
    readings, strength = _readings(robot, task, logger), true.force_limit / robot.force_limit
    return Recorded(readings, true, strength, delay, episode.peak_tilt, episode.trajectory)  # pyright: ignore[reportArgumentType]


def _readings(robot: Ballbot, task: Task, logger: _Logger) -> Readings:
    seen, commands = np.array(logger.seen), np.array(logger.commands)
    t = np.arange(len(seen)) * task.control_dt
    names, delays, windows = _STATES, (), ()
    if robot.SENSORS:
        names = tuple(name for name in Readings.readable(robot) if name.startswith(("gyro", "accel", "wheel_angle")))
        seen = seen[:, :9] * Sensors.SCALE
        seen[:, 6:] = np.cumsum(seen[:, 6:], axis=0)
        # gyroscope and accelerometer show means over a step
        delays, windows = ((share * task.control_dt,) * 6 + (0.0,) * 3 for share in (0.5, 1.0))
    commands = commands.clip(-robot.force_limit, robot.force_limit)
    return Readings(names, t, seen, commands, delays, windows=windows)
