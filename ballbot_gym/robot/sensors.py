"""The sensors of a robot with wheels: gyroscope, accelerometer and wheel encoders. Their readings replace its state.

Gyroscope and accelerometer sit at the body's centre of mass, along the axes of the body. Both are sampled at 200 Hz, and the
observation is their mean over each control step, with the noise of that mean. The mean is computed by Simpson's rule from the
beginning, the middle and the end of the step; the middle is interpolated. The accelerometer reads R⊤ (a + g e_z), which is g
upwards if the body stands still. The encoders count whole ticks of each wheel relative to the body. The sensor model assumes
that the ball rolls without slipping.

The first readings of an episode are those of a robot whose wheels are not driven. The start position is observed, because
the goal of a task is a place. Leans, speeds and later positions are not observed.
"""

import math
from dataclasses import dataclass
from typing import Any

from ballbot_gym import ops
from ballbot_gym.robot.randomization import normals

_SAMPLE_RATE = 200.0  # Hz


@dataclass(frozen=True)
class Sensors:
    """The sensors of a robot, which are read over control steps of dt, s."""

    robot: Any
    """With `readings`, as `Omni` has them."""
    dt: float

    GYROSCOPE_NOISE = 0.005  # rad/s, of a sample
    GYROSCOPE_BIAS = 0.005  # rad/s, drawn per episode
    ACCELEROMETER_NOISE = 0.05  # m/s², of a sample
    TICK = 2 * math.pi / 4096  # rad, of a wheel
    SCALE = (5.0, 5.0, 5.0, 10.0, 10.0, 10.0, 1.0, 1.0, 1.0)
    """What gyroscope, rad/s, accelerometer, m/s², and wheels, rad in the control step, are divided by in an observation."""

    FIRST_DRAWS, DRAWS = 10, 6
    """Uniform numbers that `first` and `following` take."""
    MEMORY = 17
    """Numbers that they give: the gyroscope's biases, what the encoders did not count yet, readings, and where it began."""

    @property
    def samples(self) -> int:
        """Samples of a reading in a control step."""
        return max(1, round(_SAMPLE_RATE * self.dt))

    def mean(self, before: tuple[Any, ...], u: tuple[Any, ...], x: tuple[Any, ...]) -> tuple[Any, ...]:
        """What perfect sensors read (9) over a control step from a state to x under u; of wheels the angle, rad."""
        slopes = (self.robot.derivative(state, u) for state in (before, x))
        middle = tuple(
            [
                0.5 * (a + b) + self.dt / 8 * (slope - later)
                for a, b, slope, later in zip(before, x, *slopes, strict=True)
            ]
        )
        first, second, third = (self.robot.readings(state, u) for state in (before, middle, x))
        return self._angles(tuple([(a + 4 * b + c) / 6 for a, b, c in zip(first, second, third, strict=True)]))

    def first(self, x: tuple[Any, ...], z: tuple[Any, ...]) -> tuple[Any, ...]:
        """The memory (17) when an episode begins in state x, of `FIRST_DRAWS` uniform numbers z."""
        biases = tuple([self.GYROSCOPE_BIAS * normal for normal in normals(z[:4])[:3]])
        undriven = self._angles(self.robot.readings(x, (0.0 * x[0],) * 3))  # as if the state lasted for a control step
        return self._noisy(undriven, biases, (0.5,) * 3, z[4:], x[:2])

    def following(
        self, memory: tuple[Any, ...], before: tuple[Any, ...], u: tuple[Any, ...], x: tuple[Any, ...], z: Any
    ) -> tuple[Any, ...]:
        """The memory after a control step; as `mean`, with `DRAWS` uniform numbers z."""
        return self._noisy(self.mean(before, u, x), memory[:3], memory[3:6], z, memory[15:])

    @classmethod
    def seen(cls, memory: tuple[Any, ...], c: tuple[Any, ...]) -> tuple[Any, ...]:
        """The observation: readings divided by `SCALE`, where the episode began, and the constants c, see `Task.at`."""
        return (*(a / s for a, s in zip(memory[6:15], cls.SCALE, strict=True)), *memory[15:], *c)

    def _angles(self, read: tuple[Any, ...]) -> tuple[Any, ...]:
        """Readings (9) with angles, rad, by which the wheels turn in a control step instead of their speeds, rad/s."""
        return (*read[:6], *(self.dt * speed for speed in read[6:]))

    def _noisy(self, read: Any, biases: Any, uncounted: Any, z: Any, place: Any) -> tuple[Any, ...]:
        share = 1 / math.sqrt(self.samples)  # of a sample's noise in the mean
        noise = normals(z)
        turning = [a + b + share * self.GYROSCOPE_NOISE * n for a, b, n in zip(read[:3], biases, noise, strict=False)]
        force = [a + share * self.ACCELEROMETER_NOISE * n for a, n in zip(read[3:6], noise[3:], strict=True)]
        turned = [a / self.TICK + rest for a, rest in zip(read[6:], uncounted, strict=True)]
        ticks = [ops.floor(each) for each in turned]
        left = [a - b for a, b in zip(turned, ticks, strict=True)]
        return (*biases, *left, *turning, *force, *(self.TICK * each for each in ticks), *place)
