"""The closed form as a simulator. It needs NumPy alone."""

from ballbot_gym import dynamics
from ballbot_gym.engines.simulator import Simulator, State, check_kind, whole_substeps
from ballbot_gym.params import BallbotParams
from ballbot_gym.step_code import Motion


class Rk4Simulator(Simulator):
    """The closed-form model, integrated by RK4 steps of at most `dynamics.RK4_STEP`."""

    def __init__(self, params: BallbotParams, control_dt: float, physics_dt: float | None = None):
        """Args: as for `BulletSimulator`; physics_dt defaults to `dynamics.RK4_STEP`."""
        self._params = params
        self._dt = control_dt
        self._substeps = (
            dynamics.substeps_for(control_dt) if physics_dt is None else whole_substeps(control_dt, physics_dt)
        )
        self._x: State = (0.0,) * params.state_size
        self._motion: Motion | None = None  # in machine code

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        self._x = x

    def set_params(self, params: BallbotParams) -> None:
        check_kind(params, self._params)
        self._params = params
        if self._motion is not None:
            self._motion.set_params(params)

    def use_code(self, start: bool) -> None:
        """Takes machine code if there is some; if start, it is made in the background."""
        if self._motion is None and (code := Motion.made(self._params, start)) is not None:
            self._motion = Motion(code, self._params, self._dt, self._substeps)

    def step(self, u: tuple[float, ...]) -> State:
        x = None if self._motion is None else self._motion.step(self._x, u)
        self._x = dynamics.step(self._params, self._x, u, self._dt, self._substeps) if x is None else x
        return self._x
