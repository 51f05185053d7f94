"""Robot: the one definition of a robot that simulators, optimizers, learners and pictures use.

A kind of robot is one class in one file: a frozen dataclass of numbers that fills in what is abstract here. Its equations
are written with `ops`, so that NumPy, CasADi and torch evaluate the same lines.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from ballbot_gym import ops
from ballbot_gym.ops import Vector, as_float, is_number, is_positive
from ballbot_gym.robot.shapes import Shape

Own = TypeVar("Own", bound="Robot")

RK4_STEP = 0.01
"""Longest RK4 step, s. At 10 ms the ballbot's model follows the exact solution to 1e-6 over 0.3 s at high lean."""


class Quantity(NamedTuple):
    """A component of a state, an action or an observation."""

    name: str
    unit: str


class Kind(NamedTuple):
    """What robots have in common that differ in numbers only. Compiled functions are made once for each kind."""

    robot: "type[Robot]"
    numbers: tuple[str, ...]
    """Names of the attributes that the equations of motion read."""

    @property
    def grips(self) -> bool:
        """Whether such robots can lose their grip on the floor."""
        return "friction" in self.numbers

    def model(self, numbers: Any) -> Any:
        """A robot of this kind for equations of motion, whose numbers may be symbols. Nothing is checked.

        Args:
            numbers: one for each name, as `Robot.numbers` gives them.
        """
        model = object.__new__(self.robot)
        _set(model, self.numbers, [numbers[i] for i in range(len(self.numbers))])
        return model


class Robot(ABC):
    """A robot: its state and action, its equations of motion, and what else depends on the robot and not on the task.

    A subclass is a frozen dataclass whose fields are its numbers in SI units, gravity included. x is a state (..., n) as
    `STATE` names it, and u what its actuators apply (..., m), as `ACTION` names it.
    """

    STATE: ClassVar[tuple[Quantity, ...]]
    """Name and unit of each component of a state."""
    ACTION: ClassVar[tuple[Quantity, ...]]
    """Name and unit of each component of what the actuators apply."""
    OUTPUTS: ClassVar[tuple[Quantity, ...]] = ()
    """What `outputs` gives."""
    OUTPUT_SCALE: ClassVar[tuple[float, ...]] = ()
    """What an observation divides each output by."""
    OUTPUT_STATES: ClassVar[int] = 0
    """Number n of components of the state, its last ones, that only the last n outputs observe."""
    MEASUREMENTS: ClassVar[tuple[Quantity, ...]] = ()
    """What `measurements` gives."""
    SYMMETRIES: ClassVar[frozenset[str]] = frozenset()
    """Symmetries of the equations of motion: "mirrors", "rotation". Learners and searches ask for those that they need."""
    LONG_EQUATIONS: ClassVar[bool] = False
    """Whether derivatives of a whole control step would take compilers minutes."""
    BATCHED_OPTIMA: ClassVar[bool] = False
    """Whether the optimizer of thousands of episodes at once was made for this kind."""
    DISCRETE: ClassVar[bool] = False
    """Whether `step` is overridden by a map over a control step of fixed length. It must then agree with `derivative` as to
    which states are equilibria."""
    CONTACT: ClassVar[bool] = False
    """Whether PyBullet and MuJoCo simulate the robot with contact on a floor, where it may slip."""
    DRY_FRICTION: ClassVar[bool] = False
    """Whether the drive may have dry friction, which stops a wheel within milliseconds."""
    PUSHABLE: ClassVar[bool] = False
    """Whether the action is the horizontal force on the robot, to which a push adds."""
    TRACK_FILTERS: ClassVar[bool] = False
    """Whether there are filters that estimate the hidden parameters of `TRACKS` for this kind of robot."""
    SENSORS: ClassVar[tuple[str, ...]] = ()
    """Numbers that sensors read, besides `number_names`; () where `observation="sensors"` is not modelled. See
    `ballbot_gym.robot.sensors`."""

    PARTS: ClassVar[dict[str, type]] = {}
    """Classes of the fields that hold several numbers each."""

    force_limit: float
    """What the actuators apply for an action of 1, in the units of `ACTION`."""

    def __post_init__(self) -> None:
        for field in fields(self):  # pyright: ignore[reportArgumentType]  subclasses are dataclasses
            value = as_float(getattr(self, field.name))
            object.__setattr__(self, field.name, value)
            self.check_number(field.name, value)

    def check_number(self, name: str, value: Any) -> None:
        """Raises a ValueError if the value of a field is out of its range. Tensors and symbols are not looked at."""
        if isinstance(value, str | bytes | bool | dict | list | tuple | type(None)):
            raise ValueError(f"{type(self).__name__}: {name} must be a number, not {value!r}")
        if is_number(value) and not is_positive(value):
            raise ValueError(f"{type(self).__name__}: {name} must be positive and finite, not {value}")

    @abstractmethod
    def derivative(self, x: Vector, u: Vector) -> Vector:
        """dx/dt (..., n) of state x (..., n) under u (..., m)."""

    @abstractmethod
    def shapes(self, x: np.ndarray) -> list[Shape]:
        """What is drawn of the robot in state x (n,)."""

    def position(self, x: np.ndarray) -> np.ndarray:
        """(2,) x and y of the robot, m, on which a picture is centred."""
        return np.zeros(2)

    def rest(self) -> np.ndarray:
        """(n,) the state of rest that stays as it is while the actuators apply nothing."""
        return np.zeros(self.state_size)

    def outputs(self, x: Vector) -> tuple[Any, ...]:
        """What is observed besides the observation of a task, in its unit."""
        return ()

    def measurements(self, x: Vector) -> tuple[Any, ...]:
        """What `info` reports of every state."""
        return ()

    def named_measurements(self, values: Iterable[Any]) -> dict[str, Any]:
        """Measurements by name."""
        return {each.name: value for each, value in zip(self.MEASUREMENTS, values, strict=True)}

    def limits(self, x: Vector, u: Vector, backoff: Any = 0.0, hold: Any = None) -> tuple[Any, ...]:
        """The robot's own limits, each ≥ 0 where it holds, while u is applied in state x, and held for `hold` seconds."""
        return ()

    def without_dry_friction(self: Own) -> Own:
        """The same robot without dry friction in its drive, near which it has a linear model. See `overcoming`."""
        return self

    def overcoming(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """The action (m,) that moves the robot from state x (n,) as u (m,) would for dt seconds without dry friction."""
        return u

    def extended(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (n, ...) and actions (m, ...) of a simpler model, in which tasks describe motions, as this robot's."""
        return x, u

    def held(self, x: Vector, u: Vector, hold: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """What the floor does to a robot that `grips` while u is held for `hold` seconds from state x.

        Returns:
            what `info` reports as "grip", and limits that are ≥ 0 while the robot keeps its grip; () and () if it cannot
            lose it.
        """
        return (), ()

    def grip_reserve(self, x: Vector, u: Vector, hold: Any) -> Any:
        """The greatest `backoff` of `limits` with which a robot that `grips` keeps its grip while u is held."""
        return math.inf

    def cone_curvature(self) -> float:
        """Curvature of the slip in `limits` with respect to an action in [−1, 1]; 0 if the robot cannot slip."""
        return 0.0

    def varied(self: Own, **factors: Any) -> Own:
        """The same robot with some of its numbers multiplied by factors.

        Raises:
            ValueError: a factor of what this kind of robot does not have.
        """
        for name in factors:
            if not hasattr(self, name):
                raise ValueError(f"{type(self).__name__} has no {name} that a randomization could vary")
        return replace(self, **{name: getattr(self, name) * factor for name, factor in factors.items()})  # pyright: ignore

    def displaced(self: Own, *errors: Any) -> Own:
        """The same robot with errors, m and rad, of where its centre of mass and its wheels are.

        Raises:
            ValueError: these are no numbers of this kind of robot.
        """
        raise ValueError(
            f"a {type(self).__name__} has no numbers for com_offset and wheel_error; leave them out, or give a GeneralOmni, "
            "for example GeneralOmni.of(named_robot('omni'))"
        )

    def on_floor(self: Own, friction: float) -> Own:
        """The same robot on a floor with this coefficient of friction.

        Raises:
            ValueError: no friction acts on this kind of robot.
        """
        raise ValueError(
            f"the friction of the floor has no effect on a {type(self).__name__}; give a robot whose ball rolls"
        )

    def pushed(self, x: Vector, impulse: Vector) -> Vector:
        """The state just after a horizontal impulse (..., 2), N·s.

        Raises:
            NotImplementedError: this kind of robot does not say how it moves then.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method `pushed`, so it cannot be pushed")

    def on_any_floor(self: Own) -> Own:
        """The same robot without what belongs to the floor, for comparisons."""
        return self

    def record(self) -> str:
        """The kind and all numbers as text. Files hold it, and robots are compared by it."""
        return repr(self)

    @property
    def grips(self) -> bool:
        """Whether the floor's force is limited by friction, so that the robot can lose its grip."""
        return False

    @property
    def state_size(self) -> int:
        """Components of a state."""
        return len(self.STATE)

    @property
    def action_size(self) -> int:
        """Components of an action."""
        return len(self.ACTION)

    @classmethod
    def substeps(cls, dt: float) -> int:
        """Steps in which `step` computes a control step of dt seconds: RK4 steps of at most `RK4_STEP`."""
        return 1 if cls.DISCRETE else max(1, math.ceil(dt / RK4_STEP - 1e-9))

    @property
    def kind(self) -> Kind:
        """What compiled functions are made for; `numbers` are their parameters."""
        return Kind(type(self), self._ordered_names())

    def number_names(self) -> tuple[str, ...]:
        """Names of the attributes that the equations of motion and limits read; "a.b" is attribute b of attribute a."""
        return tuple(field.name for field in fields(self))  # pyright: ignore[reportArgumentType]

    def _ordered_names(self) -> tuple[str, ...]:
        """`number_names` with friction last: robots with it and without have the other numbers in the same places.

        So they share their compiled equations of motion.
        """
        return tuple(sorted(self.number_names(), key="friction".__eq__))

    def numbers(self) -> list[Any]:
        """The values of `kind.numbers`."""
        return [attrgetter(name)(self) for name in self._ordered_names()]

    def step(
        self,
        x: Vector,
        u: Vector,
        dt: Any,
        substeps: int = 2,
        derivative: Callable[[Any, Any], Any] | None = None,
    ) -> Vector:
        """The state after dt seconds in which u is held, by RK4.

        Args:
            x: (..., n) state.
            u: (..., m), held over the step.
            dt: s.
            substeps: RK4 steps taken; `substeps(dt)` keeps each within `RK4_STEP`.
            derivative: what gives `derivative`, compiled perhaps.

        Returns:
            (..., n) state, of the same kind as x.
        """
        slope = self.derivative if derivative is None else derivative
        parts, force = ops.components(x), ops.components(u)
        for _ in range(substeps):
            parts = Robot.rk4(slope, parts, force, dt / substeps)
        return ops.stack(parts, like=x)

    @staticmethod
    def rk4(slope: Callable[..., tuple[Any, ...]], x: tuple[Any, ...], u: tuple[Any, ...], dt: Any) -> tuple[Any, ...]:
        """The components of the state one step of RK4 after x, where `slope` gives their rates of x and u."""
        half, sixth = dt / 2, dt / 6
        k1 = slope(x, u)
        k2 = slope(_advance(x, half, k1), u)
        k3 = slope(_advance(x, half, k2), u)
        k4 = slope(_advance(x, dt, k3), u)
        return tuple([a + sixth * (b + 2 * (c + d) + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)])


def _advance(x: tuple, dt: Any, slope: tuple) -> tuple:
    return tuple([a + dt * b for a, b in zip(x, slope, strict=True)])


def _set(model: Any, names: Sequence[str], values: Sequence[Any]) -> None:
    """Sets attributes of a frozen object that was made without its constructor; "a.b" in an object of the field's class."""
    nested: dict[str, tuple[list[str], list[Any]]] = {}
    for name, value in zip(names, values, strict=True):
        outer, _, inner = name.partition(".")
        if inner:
            parts = nested.setdefault(outer, ([], []))
            parts[0].append(inner)
            parts[1].append(value)
        else:
            object.__setattr__(model, name, value)
    for outer, (inner_names, inner_values) in nested.items():
        part = object.__new__(type(model).PARTS[outer])
        _set(part, inner_names, inner_values)
        object.__setattr__(model, outer, part)
