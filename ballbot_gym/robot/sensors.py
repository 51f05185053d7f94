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
from typing import Any

from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.robot import omni
from ballbot_gym.robot.randomization import normals

GYROSCOPE_NOISE = 0.005  # rad/s, of a sample
GYROSCOPE_BIAS = 0.005  # rad/s, drawn per episode
ACCELEROMETER_NOISE = 0.05  # m/s², of a sample
SAMPLE_RATE = 200.0  # Hz
TICK = 2 * math.pi / 4096  # rad, of a wheel
SCALE = (5.0, 5.0, 5.0, 10.0, 10.0, 10.0, 1.0, 1.0, 1.0)
"""What gyroscope, rad/s, accelerometer, m/s², and wheels, rad in the control step, are divided by in an observation."""

FIRST_DRAWS, DRAWS = 10, 6
"""Uniform numbers that `first` and `following` take."""
MEMORY = 17
"""Numbers that they give: the gyroscope's biases, what the encoders did not count yet, readings, and where it began."""


def samples(dt: float) -> int:
    """Samples of a reading in a control step of dt, s."""
    return max(1, round(SAMPLE_RATE * dt))


def ideal(params: Any, x: Vector, u: Vector) -> tuple[Any, ...]:
    """The body's turning (3), rad/s, its specific force (3), m/s², and the wheels' speeds (3), rad/s, in a state under u."""
    _, _, gamma, theta, _, _, gamma_dot, theta_dot, psi, psi_dot, _ = ops.components(x)
    ax, ay, gamma_ddot, theta_ddot, *_ = params.accelerations(x, u)
    sin_g, cos_g, sin_t, cos_t = ops.sin(gamma), ops.cos(gamma), ops.sin(theta), ops.cos(theta)
    rates2, product = gamma_dot * gamma_dot + theta_dot * theta_dot, gamma_dot * theta_dot
    height = params.com_height
    ax = ax + height * (
        cos_g * cos_t * gamma_ddot - sin_g * sin_t * theta_ddot - sin_g * cos_t * rates2 - 2 * cos_g * sin_t * product
    )
    ay = ay + height * (cos_t * theta_ddot - sin_t * theta_dot * theta_dot)
    az = params.gravity + height * (
        2 * sin_g * sin_t * product - sin_g * cos_t * gamma_ddot - cos_g * sin_t * theta_ddot - cos_g * cos_t * rates2
    )
    # in the frame of the leans; the body is turned by ψ in this frame
    turning = -theta_dot, cos_t * gamma_dot, sin_t * gamma_dot + psi_dot
    along = cos_g * ax - sin_g * az
    upright = sin_g * ax + cos_g * az
    force = along, cos_t * ay - sin_t * upright, sin_t * ay + cos_t * upright
    relative, _ = omni.relative_turning(params, x)
    cos, sin = ops.cos(psi), ops.sin(psi)
    turning, force, relative = ((cos * a + sin * b, cos * b - sin * a, c) for a, b, c in (turning, force, relative))
    return (*turning, *force, *omni.wheel_speeds(params, relative))


def mean(params: Any, before: tuple[Any, ...], u: tuple[Any, ...], x: tuple[Any, ...], dt: float) -> tuple[Any, ...]:
    """What perfect sensors read (9) over a control step of dt, s, from a state to x under u; of wheels the angle, rad."""
    slopes = (params.derivative(state, u) for state in (before, x))
    middle = tuple(
        [0.5 * (a + b) + dt / 8 * (slope - later) for a, b, slope, later in zip(before, x, *slopes, strict=True)]
    )
    first, second, third = (ideal(params, state, u) for state in (before, middle, x))
    read = tuple([(a + 4 * b + c) / 6 for a, b, c in zip(first, second, third, strict=True)])
    return (*read[:6], *(dt * speed for speed in read[6:]))


def undriven(params: Any, x: tuple[Any, ...], dt: float) -> tuple[Any, ...]:
    """What perfect sensors read (9) in a state in which no wheel is driven, as if it lasted for a control step of dt, s."""
    read = ideal(params, x, (0.0 * x[0],) * 3)
    return (*read[:6], *(dt * speed for speed in read[6:]))


def first(params: Any, x: tuple[Any, ...], z: tuple[Any, ...], dt: float) -> tuple[Any, ...]:
    """The memory (17) of sensors when an episode begins in state x, of `FIRST_DRAWS` uniform numbers z."""
    biases = tuple([GYROSCOPE_BIAS * normal for normal in normals(z[:4])[:3]])
    return _noisy(undriven(params, x, dt), biases, (0.5,) * 3, z[4:], x[:2], dt)


def following(
    params: Any,
    memory: tuple[Any, ...],
    before: tuple[Any, ...],
    u: tuple[Any, ...],
    x: tuple[Any, ...],
    z: Any,
    dt: float,
) -> tuple[Any, ...]:
    """The memory after a control step; as `mean`, with `DRAWS` uniform numbers z."""
    return _noisy(mean(params, before, u, x, dt), memory[:3], memory[3:6], z, memory[15:], dt)


def _noisy(read: Any, biases: Any, uncounted: Any, z: Any, place: Any, dt: float) -> tuple[Any, ...]:
    share = 1 / math.sqrt(samples(dt))  # of a sample's noise in the mean
    noise = normals(z)
    turning = [a + b + share * GYROSCOPE_NOISE * n for a, b, n in zip(read[:3], biases, noise, strict=False)]
    force = [a + share * ACCELEROMETER_NOISE * n for a, n in zip(read[3:6], noise[3:], strict=True)]
    turned = [a / TICK + rest for a, rest in zip(read[6:], uncounted, strict=True)]
    ticks = [ops.floor(each) for each in turned]
    left = [a - b for a, b in zip(turned, ticks, strict=True)]
    return (*biases, *left, *turning, *force, *(TICK * each for each in ticks), *place)


def seen(memory: tuple[Any, ...], c: tuple[Any, ...]) -> tuple[Any, ...]:
    """The observation: readings divided by `SCALE`, where the episode began, and the constants c as `Task.at` gives them."""
    return (*(a / s for a, s in zip(memory[6:15], SCALE, strict=True)), *memory[15:], *c)
