"""Gymnasium's MountainCarContinuous-v0: a car in a valley whose motor is too weak for the hill."""

import itertools
import math
from dataclasses import dataclass
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

# of guessed motions: how hard the car pumps, how hard it climbs in the end, and how many control steps are between waits
_PUMPS, _CLIMB, _WAITS = (0.045, 0.06, 0.08, 0.1, 0.14), 0.2, 18


@dataclass(frozen=True)
class MountainCar(Robot):
    """A car in a valley of the height sin 3x, pushed by a motor. Time is counted in control steps, as Gymnasium does.

    | field | meaning | unit |
    |---|---|---|
    | power | acceleration by the motor | 1/step² |
    | gravity | acceleration by the steepest slope | 1/step² |
    | speed_limit | at which the speed is clipped | 1/step |
    | reach | from 0 to the wall at the left, where the car stops | 1 |
    | end | the largest position | 1 |
    | force_limit | largest action of the motor | 1 |
    """

    power: float = 0.0015
    gravity: float = 0.0025
    speed_limit: float = 0.07
    reach: float = 1.2
    end: float = 0.6
    force_limit: float = 1.0

    STATE = (Quantity("x", "1"), Quantity("ẋ", "1/step"))
    ACTION = (Quantity("force", "1"),)
    DISCRETE = True

    def derivative(self, x: ops.Vector, u: ops.Vector) -> ops.Vector:
        _, speed = ops.components(x)
        return ops.stack((speed, self._acceleration(x, u)), like=x)

    def step(self, x: ops.Vector, u: ops.Vector, dt: Any, substeps: int = 1, derivative: Any = None) -> ops.Vector:
        """Gymnasium's step, which takes 1: the speed is clipped, moves the car, and is lost at the wall.

        Gymnasium rounds the state to float32 after every step, and this does not.
        """
        place, speed = ops.components(x)
        speed = ops.clip(speed + self._acceleration(x, u), -self.speed_limit, self.speed_limit)
        moved = ops.clip(place + speed, -self.reach, self.end)
        return ops.stack((moved, ops.where(moved <= -self.reach, ops.clip(speed, 0.0, math.inf), speed)), like=x)

    def _acceleration(self, x: ops.Vector, u: ops.Vector) -> Any:
        (force,) = ops.components(u)
        return self.power * force - self.gravity * ops.cos(3 * ops.components(x)[0])

    def rest(self) -> np.ndarray:
        return np.array([-math.pi / 6, 0.0])

    def position(self, x: np.ndarray) -> np.ndarray:
        return np.array([x[0], 0.0])

    def shapes(self, x: np.ndarray) -> list[Shape]:
        def hill(place: float) -> tuple[float, float, float]:
            return (place, 0.0, 0.55 + 0.45 * math.sin(3 * place))

        ground = np.linspace(-self.reach, self.end, 19).tolist()
        slopes: list[Shape] = [Cylinder(hill(a), hill(b), 0.01, "#292e3b") for a, b in itertools.pairwise(ground)]
        at = hill(float(x[0]))
        return [*slopes, Sphere((at[0], at[1], at[2] + 0.06), 0.06, "#b03a2e")]


@dataclass(frozen=True)
class MountainCarUp(Task):
    """Drive out of the valley with little force: Gymnasium's MountainCarContinuous-v0, with the same rewards and the same
    resets by seed.

    The cost of a step is 0.1 force². To reach the goal at the right ends the episode and pays 100, and an episode that does
    not reach it in 999 steps costs 100 more.
    """

    duration: float = 999.0
    control_dt: float = 1.0
    survival_reward: float = 0.0
    goal_position: float = 0.45

    id = "ClassicMountainCar-v0"
    counterpart = "MountainCarContinuous-v0"
    ROBOT = "mountain_car"
    MAY_BE_ZERO = frozenset({"survival_reward"})
    state_draws = 1
    observation_scale = (1.0, 1.0)
    first_exit = True
    goal_reward = 100.0
    pieces = True

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: Any) -> tuple[Any, ...]:
        return ops.between(z[0], -0.6, -0.4), 0.0 * z[0]

    def counterpart_state(self, env: Any) -> tuple[np.ndarray, np.ndarray]:
        return np.array(env.state, np.float64), np.zeros(0)

    def cost(self, x: ops.Vector, u: ops.Vector, c: ops.Vector) -> Any:
        return 0.1 * ops.squared(*ops.components(u))

    def goal(self, x: ops.Vector, c: ops.Vector) -> tuple[Any, ...]:
        place, speed = ops.components(x)
        return self.goal_position - place, -speed

    def goal_error(self, x: ops.Vector, c: ops.Vector) -> Any:
        """1 in the goal, and 1 more for every 0.05 to it."""
        place, _ = ops.components(x)
        return 1.0 + ops.maximum(self.goal_position - place, 0.0) / 0.05

    def observe(self, x: ops.Vector, c: ops.Vector) -> ops.Vector:
        return ops.scaled(ops.components(x), self.observation_scale, like=x)

    def reference(self, x: np.ndarray, c: np.ndarray, params: Any) -> Reference:
        """Held in the goal against the slope."""
        force = params.gravity * math.cos(3 * self.goal_position) / params.power
        return Reference(np.array([[self.goal_position, 0.0]]), np.array([[force]]))

    def guesses(self, x: np.ndarray, c: np.ndarray, params: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """Free motions of different durations, then a pumping force along the speed, which is larger where the car climbs
        from the wall to the goal. The cheapest come first.
        """
        waits = np.arange(0, self.steps, _WAITS)
        wait, pump = (part.ravel() for part in np.meshgrid(waits, _PUMPS, indexing="ij"))
        place, speed = np.full(len(wait), x[0]), np.full(len(wait), x[1])
        states, forces = [np.stack([place, speed], axis=-1)], []
        arrival, high = np.full(len(wait), self.steps + 1), math.sin(-3 * params.reach)
        for k in range(self.steps):
            energy = 1.5 * speed * speed / params.gravity + np.sin(3 * place)
            force = np.where(
                k < wait, 0.0, np.where(energy > high - 0.05, _CLIMB, pump) * np.where(speed < 0, -1.0, 1.0)
            )
            force = np.where((energy > high) & (speed < 0), 0.0, force)  # the wall takes what is above it
            states.append(params.step(states[-1], force[:, None], 1.0))
            place, speed = states[-1].T
            forces.append(force)
            arrival = np.where((place >= self.goal_position) & (arrival > self.steps), k + 1, arrival)
        moved, applied = np.stack(states, axis=1), np.stack(forces, axis=1)
        costs = np.array([np.sum(row[:end] ** 2) for row, end in zip(applied, arrival, strict=True)])
        order = [i for i in np.argsort(costs, kind="stable") if arrival[i] <= self.steps]
        return [(moved[i, : arrival[i] + 1], applied[i, : arrival[i], None]) for i in order]

    def search_cases(self, episode: Any) -> list[Any]:
        """Solutions from the guesses, in the cases of arrival and of the wall to which they lead."""
        from ballbot_classic.mountain_car_cases import solutions  # it needs CasADi

        return solutions(self, episode)


register_robot("mountain_car", MountainCar())
register_task(MountainCarUp, "mountain_car")
