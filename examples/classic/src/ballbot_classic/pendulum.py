"""Gymnasium's Pendulum-v1: swing a pendulum up with a motor that is too weak to lift it."""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ballbot_gym import (
    Cylinder,
    Quantity,
    Reference,
    Robot,
    Shape,
    Sphere,
    Task,
    ops,
    register_robot,
    register_task,
)

_TURN = 2 * math.pi
# families of guessed swing-ups: torque, side of the first push, how many control steps it and that to the other side last,
# and energy
_FAMILIES = (
    ((2.0, 1.7, 1.4, 1.0), (1.0, -1.0), (0, 2, 4, 6, 8, 10, 14, 18), (0, 4, 8, 12, 16, 20), (0.0, 0.5, 1.0, 1.5)),
    ((2.0, 1.4), (1.0, -1.0), (0, 3, 6, 10, 14, 18), (0, 4, 8, 12, 16, 20), (0.0, 1.0)),
    ((2.0,), (1.0, -1.0), range(21), range(26, 49), (0.0,)),  # all of the torque until upright
)
_RANDOM = 2000  # more swing-ups, after up to `_PUSHES` pushes of up to `_LONGEST` control steps
_PUSHES, _LONGEST = 4, 24
_SAME = 1e-3  # relative: guesses of a family whose costs differ by less are the same


@dataclass(frozen=True)
class Pendulum(Robot):
    """A rod on a hinge with a motor.

    | field | meaning | unit |
    |---|---|---|
    | mass, length | of the rod | kg, m |
    | gravity | | m/s² |
    | speed_limit | at which the rate is clipped | rad/s |
    | force_limit | largest torque | N·m |
    """

    mass: float = 1.0
    length: float = 1.0
    gravity: float = 10.0
    speed_limit: float = 8.0
    force_limit: float = 2.0

    # θ is the angle from upright
    STATE = (Quantity("θ", "rad"), Quantity("θ̇", "rad/s"))
    ACTION = (Quantity("torque", "N·m"),)
    DISCRETE = True

    def derivative(self, x: ops.Vector, u: ops.Vector) -> ops.Vector:
        _, rate = ops.components(x)
        return ops.stack((rate, self._acceleration(x, u)), like=x)

    def step(self, x: ops.Vector, u: ops.Vector, dt: Any, substeps: int = 1, derivative: Any = None) -> ops.Vector:
        """Gymnasium's step: Euler's rule for the rate, which is clipped, and then for the angle with the new rate."""
        theta, rate = ops.components(x)
        rate = ops.clip(rate + self._acceleration(x, u) * dt, -self.speed_limit, self.speed_limit)
        return ops.stack((theta + rate * dt, rate), like=x)

    def _acceleration(self, x: ops.Vector, u: ops.Vector) -> Any:
        (torque,) = ops.components(u)
        fall = 3 * self.gravity / (2 * self.length) * ops.sin(ops.components(x)[0])
        return fall + 3.0 / (self.mass * self.length * self.length) * torque

    def shapes(self, x: np.ndarray) -> list[Shape]:
        hinge = (0.0, 0.0, 1.1)
        tip = (self.length * math.sin(x[0]), 0.0, 1.1 + self.length * math.cos(x[0]))
        return [Cylinder(hinge, tip, 0.05, "#b03a2e"), Sphere(hinge, 0.07, "#292e3b")]


@dataclass(frozen=True)
class PendulumUp(Task):
    """Swing the pendulum up and hold it there: Gymnasium's Pendulum-v1, with the same rewards and the same resets by seed.

    The cost of a step is θ² + 0.1 θ̇² + 0.001 torque², with θ in [−π, π): it is min over k of (θ − 2πk)² + …, so it has a
    kink where the pendulum hangs. An action of 1 is 2 N·m.
    """

    duration: float = 10.0
    control_dt: float = 0.05
    survival_reward: float = 0.0
    start_rate: float = 1.0

    id = "ClassicPendulum-v0"
    counterpart = "Pendulum-v1"
    ROBOT = "pendulum"
    MAY_BE_ZERO = frozenset({"survival_reward"})
    state_draws = 2
    observation_scale = (1.0, 1.0, 1.0)
    pieces = True

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        return ops.between(z[0], -math.pi, math.pi), ops.between(z[1], -self.start_rate, self.start_rate)

    def counterpart_state(self, env: Any) -> tuple[np.ndarray, np.ndarray]:
        return np.array(env.state, np.float64), np.zeros(0)

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        (theta, rate), (torque,) = ops.components(x), ops.components(u)
        angle = theta - _TURN * ops.floor((theta + math.pi) / _TURN)
        return self.rate(angle, rate, torque)

    def rate(self, angle: Any, rate: Any, torque: Any) -> Any:
        """Cost rate at an angle from the nearest upright, or from any other."""
        return (angle * angle + 0.1 * rate * rate + 0.001 * torque * torque) / self.control_dt

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        theta, rate = ops.components(x)
        return (1 - ops.cos(theta)) / (1 - math.cos(0.1)) - 1, rate * rate / 0.3**2 - 1

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        theta, rate = ops.components(x)
        return ops.stack((ops.cos(theta), ops.sin(theta), rate), like=x)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Any) -> Reference:
        """Upright, by the nearer turn."""
        return Reference(np.array([[_TURN * round(x[0] / _TURN), 0.0]]), np.zeros((1, 1)))

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """Swing-ups by energy shaping, with less and with all of the torque, and to different speeds at the top, after a push
        to either side and one to the other, and after random pushes. The cheapest come first, and those of a family that cost
        the same are left out.
        """
        family, torque, surplus, pushed, until = _swing_ups(params.force_limit)
        theta, rate = np.full(len(torque), x[0]), np.full(len(torque), x[1])
        states, torques, costs = [(theta, rate)], [], np.zeros(len(torque))
        for k in range(self.steps):
            u = _shaped(params, theta, rate, torque, surplus)
            for push, end in zip(pushed.T[::-1], until.T[::-1], strict=True):
                u = np.where(k < end, push, u)
            costs += self.control_dt * self.cost((theta, rate), (u,), ())
            theta, rate = params.step((theta, rate), (u,), self.control_dt)
            states.append((theta, rate))
            torques.append(u)
        motions, applied = np.array(states).transpose(2, 0, 1), np.array(torques).T[..., None]
        kept = []
        for number in range(int(family[-1]) + 1):
            order = np.flatnonzero(family == number)
            order = order[np.argsort(costs[order], kind="stable")]
            kept.append(order[np.diff(costs[order], prepend=0.0) > _SAME * costs[order]])
        order = np.concatenate(kept)
        return [(motions[i], applied[i]) for i in order[np.argsort(costs[order], kind="stable")]]

    def search_cases(self, episode: Any) -> list[Any]:
        """Solutions from the guesses, in the cases of turns and clipped rates to which they lead."""
        from ballbot_classic.pendulum_cases import solutions  # it needs CasADi

        return solutions(self, episode)


class EnergyShaping:
    """A controller of few lines: it pumps until the energy suffices, and catches the pendulum near upright."""

    def __init__(self, task: Task, params: Any):
        self._params = params

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        """Nothing is planned."""

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        """(1,) torque, N·m, in state x (2,)."""
        return _shaped(self._params, x[:1], x[1:], self._params.force_limit, 0.0)


@lru_cache(maxsize=4)
def _swing_ups(limit: float) -> tuple[np.ndarray, ...]:
    """Of n guesses the families (n,), torques (n,) and surplus energies (n,), and the pushes (n, k) before, each until a
    control step (n, k).
    """
    grids = [np.array(list(itertools.product(*family))) for family in _FAMILIES]
    family = np.repeat(np.arange(len(grids) + 1), [*map(len, grids), _RANDOM])
    torque, side, first, second, surplus = np.concatenate(grids).T
    pushed, until = np.zeros((2, len(torque), _PUSHES))
    pushed[:, 0], pushed[:, 1] = side * torque, -side * torque
    until[:, 0], until[:, 1] = first, first + second
    rng = np.random.default_rng(0)
    ends = np.cumsum(rng.integers(1, _LONGEST, (_RANDOM, _PUSHES)), axis=1)
    ends[np.arange(_PUSHES) >= rng.integers(0, _PUSHES, (_RANDOM, 1))] = 0
    return (
        family,
        np.append(torque, rng.uniform(0.4, 1.0, _RANDOM) * limit),
        np.append(surplus, rng.uniform(0.0, 1.5, _RANDOM)),
        np.concatenate([pushed, rng.uniform(-limit, limit, (_RANDOM, _PUSHES))]),
        np.concatenate([until, ends]),
    )


def _shaped(params: Any, theta: np.ndarray, rate: np.ndarray, torque: Any, surplus: Any) -> np.ndarray:
    """(n,) torques, of at most `torque`: they pump up to the energy of upright and a surplus, and hold the pendulum."""
    angle = theta - _TURN * np.floor((theta + math.pi) / _TURN)
    energy = 0.5 * rate * rate + 1.5 * params.gravity / params.length * (np.cos(theta) - 1)
    pumping = -4.0 * (energy - surplus) * np.where(rate < 0, -1.0, 1.0)
    near = (np.abs(angle) < 0.5) & (np.abs(rate + 3.9 * angle) < 1.2)
    return np.clip(np.where(near, -10 * angle - 2.6 * rate, pumping), -torque, torque)


register_robot("pendulum", Pendulum())
register_task(PendulumUp, "pendulum")
