"""The closed form as a simulator. It needs NumPy alone."""

from ballbot_gym.engines.simulator import Simulator, State
from ballbot_gym.robot import Robot


class Rk4Simulator(Simulator):
    """The closed-form model, integrated by RK4 steps of at most `RK4_STEP`."""

    def __init__(self, params: Robot, control_dt: float, physics_dt: float | None = None):
        """Args: as for `make_simulator`; physics_dt defaults to `RK4_STEP`."""
        self._params = params
        self._dt = control_dt
        self.substeps = (
            params.substeps(control_dt) if physics_dt is None else self._whole_substeps(control_dt, physics_dt)
        )
        self._x: State = (0.0,) * params.state_size

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        self._x = x

    def set_params(self, params: Robot) -> None:
        self._check_kind(params, self._params)
        self._params = params

    def step(self, u: tuple[float, ...]) -> State:
        self._x = self._params.step(self._x, u, self._dt, self.substeps)
        return self._x
