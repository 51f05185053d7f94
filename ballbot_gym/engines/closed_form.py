"""The closed form as a simulator. It needs NumPy alone."""

from ballbot_gym.engines.simulator import Simulator, State
from ballbot_gym.machine_code import step_code
from ballbot_gym.robot import Robot


class Rk4Simulator(Simulator):
    """The closed-form model, integrated by RK4 steps of at most `RK4_STEP`."""

    def __init__(self, params: Robot, control_dt: float, physics_dt: float | None = None):
        """Args: as for `make_simulator`; physics_dt defaults to `RK4_STEP`."""
        self._params = params
        self._dt = control_dt
        self._substeps = (
            params.substeps(control_dt) if physics_dt is None else self._whole_substeps(control_dt, physics_dt)
        )
        self._each = range(self._substeps)  # made once: it is a hundredth of a step
        self._x: State = (0.0,) * params.state_size
        self._code: step_code.Work | None = None

    def reset(self, x: State, memory: tuple[float, ...] = ()) -> None:
        self._x = x

    def set_params(self, params: Robot) -> None:
        self._check_kind(params, self._params)
        self._params = params
        if self._code is not None:
            self._code.given[-len(params.kind.numbers) :] = params.numbers()

    def use_code(self) -> None:
        """Takes machine code if there is some."""
        if self._code is None:
            self._code = step_code.motion(self._params, self._dt / self._substeps)
            self.set_params(self._params)

    def step(self, u: tuple[float, ...]) -> State:
        code = self._code
        if code is not None:
            code.pack(*self._x, *u)
            for _ in self._each:
                code.call()
            if code.check[0] == 0:
                self._x = code.unpack()
                return self._x
        self._x = self._params.step(self._x, u, self._dt, self._substeps)
        return self._x
