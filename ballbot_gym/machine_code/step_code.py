"""What one environment computes in a control step, in machine code: the closed form, and what a task says of the step.

`traced` writes the C code, and `machine_code` compiles it within a fraction of a second, once per machine and content. Where
there is no compiler, Python computes the same. Machine code is used only if its results were bit-identical to Python's in a
trial. Results that are not finite are computed by Python, which may raise an error. So the results are the same with and
without a compiler.
"""

import ctypes
import logging
import struct
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ballbot_gym import machine_code
from ballbot_gym.machine_code import traced
from ballbot_gym.robot import Robot
from ballbot_gym.step import Outcome, outcome
from ballbot_gym.tasks import Task

_log = logging.getLogger(__name__)

_TRIALS = 64
_JUDGED = len(Outcome._fields)

State = tuple[float, ...]


Code = tuple[Callable[[ctypes.c_void_p], None], bool, int, int]
"""A function of `traced.function`, whether its results replace its first arguments, and how many it has of each."""


class Work:
    """A function's numbers in memory, of one simulator or one env.

    `pack` writes the first arguments, `call` calls it, `unpack` reads the first results, and check[0] is 0 if all are finite.
    The other arguments, the last of `given`, stay as they were set.
    """

    def __init__(self, code: Code, arguments: int, results: int):
        function, in_place, given, made = code
        first = 1 if in_place else 1 + made  # of the arguments
        memory = bytearray(8 * (first + given))
        self.numbers, self.check = np.frombuffer(memory), memoryview(memory).cast("d")
        self.given = self.numbers[first:]
        self.pack = partial(struct.Struct(f"{arguments}d").pack_into, memory, 8 * first)
        self.unpack = partial(struct.Struct(f"{results}d").unpack_from, memory, 8)
        self.call = partial(function, ctypes.c_void_p(self.numbers.ctypes.data))


def motion(params: Robot, dt: float) -> Work | None:
    """An RK4 step of dt, s, in place, from a state and a force; None where there is no machine code.

    Its last arguments are `Robot.numbers` of any robot of the same kind.
    """
    kind = params.kind

    def compute(x: tuple, u: tuple, dt: tuple, robot: tuple) -> tuple:
        return kind.model(robot).step(x, u, dt[0], 1)

    states, held = params.state_size, params.state_size + params.action_size
    code = _code(kind, compute, (states, held - states, 1, len(kind.numbers)), in_place=True)
    if code is None:
        return None
    work = Work(code, held, states)
    work.given[held] = dt
    return work


class Judge(Work):
    """Computes the outcomes of control steps of a task, in an episode with the constants `c`, which may be set.

    After each step `seen` is the (no) observation without noise, `x` the (8,) state after the step, and `force` the (2,)
    force in N; they are longer with wheels. The next step overwrites them.
    """

    def __init__(self, code: Code, task: Task, params: Robot):
        states, held = params.state_size, params.state_size + params.action_size
        given = held + states + 2
        judged = _JUDGED + len(params.MEASUREMENTS)
        super().__init__(code, given, judged)
        self.seen = self.numbers[1 + judged :][: task.observation_size(params)]
        _, self.force, self.x, _, self.c = np.split(self.given, (states, held, held + states, given))

    def judge(self, before: State, force: tuple[float, ...], x: State, steps: int, kept: float) -> State | None:
        """What a force, N, did that led from one state to the state x: an `Outcome`, and the robot's measurements at its end.

        None where Python must compute it.

        Args:
            before: (8,) state.
            force: (2,), N.
            x: (8,) state after the step.
            steps: of the episode, this one included.
            kept: ≥ 0 if the ball keeps its grip.
        """
        self.pack(*before, *force, *x, steps, kept)
        self.call()
        return self.unpack() if self.check[0] == 0 else None


def judge(task: Task, params: Robot) -> Judge | None:
    """The judge of a task, for robots with as large states; None where there is no machine code."""

    def compute(before: tuple, u: tuple, x: tuple, step: tuple, c: tuple) -> tuple:
        steps, kept = step
        did = outcome(task, before, u, x, c, steps, (kept,))
        c = task.at(c, steps * task.control_dt)
        finite = (*task.limits(x, c), *task.goal(x, c))  # an outcome does not tell
        return (*did, *params.measurements(x), *task.seen(x, c, params), *finite)

    states, forces = params.state_size, params.action_size
    code = _code(
        (task, params.kind, states), compute, (states, forces, states, 2, len(task.constant_names)), in_place=False
    )
    return None if code is None else Judge(code, task, params)


_codes: dict[Any, Code | None] = {}


def _code(key: Any, compute: Callable[..., Sequence[Any]], counts: Sequence[int], in_place: bool) -> Code | None:
    """The code of a function, made at the first call with this key; None where there is none."""
    try:
        if key in _codes:
            return _codes[key]
    except TypeError:  # a task that has no hash
        return None
    _codes[key] = None
    try:
        _codes[key] = _checked(compute, counts, in_place)
    except Exception as error:  # no compiler or cache, or any error of users' code that gets a traced number
        _log.info("%s stays in Python: %s: %s", key, type(error).__name__, error)
    return _codes[key]


def _checked(compute: Callable[..., Sequence[Any]], counts: Sequence[int], in_place: bool) -> Code:
    """The code of a function, after a check that its results are bit-identical to Python's.

    Raises:
        ArithmeticError: they are not.
        NoMachineCodeError: see `machine_code.library`.
        Exception: any error of a `compute` that cannot compute with traced numbers.
    """
    source = traced.function("compute", compute, counts, in_place)
    call = ctypes.PyDLL(
        str(machine_code.library("step", source, traced.FLAGS))
    ).compute  # it keeps the GIL: it is short
    call.argtypes, call.restype = (ctypes.c_void_p,), None
    rng, ends = np.random.default_rng(0), np.cumsum(counts)[:-1]
    for _ in range(_TRIALS):
        given = rng.uniform(-1.5, 1.5, sum(counts))
        expected = compute(*(tuple(part.tolist()) for part in np.split(given, ends)))
        code = call, in_place, len(given), len(expected)
        work = Work(code, len(given), len(expected))
        work.given[:] = given
        work.call()
        if work.check[0] == 0 and np.array(work.unpack()).tobytes() != np.array(expected, float).tobytes():
            raise ArithmeticError("machine code computes other bits than Python")
    return code
