"""A task whose weights can change while it runs.

The weights become constants of the episode. Every solver takes constants as parameters, so that nothing is compiled again.
"""

import copy
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.base import Reference
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.tasks.stabilize import Stabilize

_SHARED = (
    "id",
    "observation_scale",
    "constant_names",
    "margin_names",
    "constant_draws",
    "state_draws",
    "first_exit",
    "clock",
    "frame",
    "mirrors",
)


def weight_names(task: Task) -> tuple[str, ...]:
    """The fields of a task that weigh parts of its cost."""
    return tuple(field.name for field in fields(task) if field.name.endswith("_weight"))


@dataclass(frozen=True)
class Tunable(Task):
    """A task with its weights at the end of the constants, in the order of `weight_names`."""

    base: Task = field(default_factory=Stabilize)

    @classmethod
    def of(cls, task: Task) -> "Tunable":
        """The tunable version of a task."""
        common = {f.name: getattr(task, f.name) for f in fields(Task)}
        return cls(**common, base=task)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in _SHARED:
            object.__setattr__(self, name, getattr(self.base, name))
        object.__setattr__(self, "constant_names", (*self.base.constant_names, *weight_names(self.base)))

    def constants(self, c: np.ndarray, weights: dict[str, float]) -> np.ndarray:
        """The constants of an episode (nc,) followed by its weights by name; those not given are the task's own."""
        own = [weights.get(name, getattr(self.base, name)) for name in weight_names(self.base)]
        return np.array([*c, *own], np.float64)

    def cost(self, x: Vector, u: Vector, c: Vector) -> Any:
        parts = ops.components(c)
        weighted = copy.copy(self.base)
        for name, value in zip(weight_names(self.base), parts[self._own : len(self.constant_names)], strict=True):
            object.__setattr__(weighted, name, value)  # it may be a symbol, which the task's own checks would refuse
        return weighted.cost(x, u, self._base_constants(c))

    def margins(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        return self.base.margins(x, self._base_constants(c))

    def goal(self, x: Vector, c: Vector) -> tuple[Any, ...]:
        return self.base.goal(x, self._base_constants(c))

    def arena(self, c: Vector) -> tuple[Any, Any, Any]:
        return self.base.arena(self._base_constants(c))

    def observe(self, x: Vector, c: Vector) -> Vector:
        return self.base.observe(x, self._base_constants(c))

    def reference(self, x: np.ndarray, c: np.ndarray, params: BallbotParams) -> Reference:
        return self.base.reference(x, c[: self._own], params)

    def guess_paths(self, x: np.ndarray, c: np.ndarray, params: BallbotParams) -> list[np.ndarray]:
        return self.base.guess_paths(x, c[: self._own], params)

    def draw_constants(self, z: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        return (*self.base.draw_constants(z, params), *(getattr(self.base, name) for name in weight_names(self.base)))

    def draw_state(self, z: tuple[Any, ...], c: tuple[Any, ...], params: BallbotParams) -> tuple[Any, ...]:
        return self.base.draw_state(z, c[: self._own], params)

    def markers(self, c: np.ndarray) -> list[Marker]:
        return self.base.markers(c[: self._own])

    @property
    def _own(self) -> int:
        return len(self.base.constant_names)

    def _base_constants(self, c: Vector) -> Vector:
        """The task's own constants, and the time if it has a clock, of the same kind as c."""
        parts = ops.components(c)
        own = parts[: self._own] + parts[len(self.constant_names) :]
        return ops.stack(own, like=c) if own else ()
