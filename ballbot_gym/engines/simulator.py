"""The interface of every simulator, and what they share."""

import math
from typing import Protocol

from ballbot_gym.ops import is_number
from ballbot_gym.robot import Robot

State = tuple[float, ...]
"""(n,) state as a tuple of floats; order and units in the robot's `STATE`."""

MOST_FRICTION = 1e3
"""What engines of contact take for unlimited friction."""
_MOST_SUBSTEPS = 10_000


class Simulator(Protocol):
    """One robot whose action is held over control steps."""

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        """Puts the robot into state x, and restores the internal state of the engine that `memory` returned."""

    def set_params(self, params: Robot) -> None:
        """Replaces the robot by one of the same kind; call `reset` after it."""

    def step(self, u: tuple[float, ...]) -> State:
        """Holds force u, N, for one control step and returns the state after it."""
        ...

    def memory(self) -> tuple[float, ...]:
        """Internal state that affects later steps, besides the robot's; () if there is none, or if it cannot be restored."""
        return ()

    def floor_force(self) -> tuple[float, float, float] | None:
        """The floor's force on the ball, (f_x, f_y, N) in N, at the end of the last step; None where it is not simulated."""
        return None

    def height(self) -> float:
        """How far the ball is above the floor, m; negative where it presses into it. 0 where it cannot leave the floor."""
        return 0.0

    def slip(self) -> tuple[float, float]:
        """Velocity of the ball's lowest point over the floor, m/s; 0 where the ball cannot slip."""
        return 0.0, 0.0

    def is_unstable(self) -> bool:
        """Whether the engine gave up on the motion since the last reset, so that the state means nothing."""
        return False

    def close(self) -> None:
        """Releases what the simulator holds; may be called again."""

    @staticmethod
    def _whole_substeps(control_dt: float, physics_dt: float) -> int:
        """How many steps of an engine a control step is. Raises a ValueError if that is no whole number of them."""
        if not is_number(physics_dt):
            raise ValueError(f"physics_dt must be a number of seconds, not {physics_dt!r}")
        in_range = control_dt / (_MOST_SUBSTEPS + 0.5) < physics_dt <= 2 * control_dt
        substeps = round(control_dt / physics_dt) if in_range else 0
        if substeps < 1 or not math.isclose(substeps * physics_dt, control_dt, rel_tol=1e-9):
            raise ValueError(
                f"physics_dt = {physics_dt} s must be a whole fraction of control_dt = {control_dt} s, and at least "
                f"1/{_MOST_SUBSTEPS} of it"
            )
        return substeps

    @staticmethod
    def _check_kind(params: Robot, own: Robot) -> None:
        """Raises a ValueError if a robot is of another kind than a simulator's own."""
        if type(params) is not type(own):
            raise ValueError(
                f"this simulator was made for a {type(own).__name__}, and the robot is a {type(params).__name__}; make "
                "another with make_simulator()"
            )
