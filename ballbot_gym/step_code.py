"""What one environment computes in a control step, in machine code: the closed form, and what a task says of the step.

`traced` writes the C code, and `machine_code` compiles it in the background, within a fraction of a second, once per machine
and content. Until then, and where there is no compiler, Python computes the same: machine code is used only where it gave
the very bits of Python in a trial, and not for results that are no finite numbers, where Python may raise an error. So
nobody can tell from the results which of both computed them.
"""

import contextlib
import ctypes
import logging
import os
import struct
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ballbot_gym import dynamics, machine_code, traced
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.transition import outcome

_log = logging.getLogger(__name__)

ROBOT = (
    "moving_mass",
    "first_moment",
    "pivot_inertia",
    "axial_inertia",
    "gravity",
    "ball_radius",
    "ball_inertia",
    "force_limit",
)
"""What the equations of motion take of a robot."""

_TRIALS = 64
_YIELD = 1e-4  # s, at every reset until the code is there
_JUDGED = 9  # an outcome, and the tilt

State = tuple[float, ...]


class Code(NamedTuple):
    """A function of `traced.function`."""

    call: Callable[[ctypes.c_void_p], None]
    results: int
    arguments: int


class Work:
    """A function's numbers in memory: of one simulator or one env.

    `pack` writes the first arguments, `call` calls it, `unpack` reads the first results, and check[0] is 0 if all are finite.
    """

    def __init__(self, code: Code, given: int, told: int, in_place: bool = False):
        self.first = 1 if in_place else 1 + code.results  # of the arguments
        memory = bytearray(8 * (self.first + code.arguments))
        self.numbers, self.check = np.frombuffer(memory), memoryview(memory).cast("d")
        self.pack = partial(struct.Struct(f"{given}d").pack_into, memory, 8 * self.first)
        self.unpack = partial(struct.Struct(f"{told}d").unpack_from, memory, 8)
        self.call = partial(code.call, ctypes.c_void_p(self.numbers.ctypes.data))


def motion(params: BallbotParams, start: bool) -> Code | None:
    """The code of an RK4 step for robots of the same kind, with the same wheels; see `_code`.

    It computes in place, from a state and a force, then the step, s, and what `ROBOT` names.
    """
    kind = {"rolls": params.rolls, "wheels": params.wheels}

    def compute(x: tuple, u: tuple, dt: tuple, robot: tuple) -> tuple:
        model: Any = SimpleNamespace(**kind, **dict(zip(ROBOT, robot, strict=True)))
        return dynamics.step(model, x, u, dt[0], 1)

    sizes = params.state_size, params.action_size, 1, len(ROBOT)
    return _code(("motion", *kind.values()), compute, sizes, True, start)


class Judge:
    """What a task says of control steps.

    Of the step that was judged last, `seen` is the (no) observation without noise, `x` the (8,) state after it, and `force`
    (2,) in N; they are longer with wheels. They are overwritten by the next.
    """

    def __init__(self, code: Code, task: Task, params: BallbotParams):
        states, held = params.state_size, params.state_size + params.action_size
        # states before and after, between them the force; the number of steps, and whether grip is kept
        given = held + states + 2
        work = Work(code, given, _JUDGED)
        self._pack, self._call, self._check, self._unpack = work.pack, work.call, work.check, work.unpack
        self.seen = work.numbers[10 : 10 + task.observation_size(params)]
        ends = (states, held, held + states, given)
        _, self.force, self.x, _, self._constants = np.split(work.numbers[work.first :], ends)

    @staticmethod
    def made(task: Task, params: BallbotParams, start: bool) -> Code | None:
        """The code for a task, and robots with as large states; see `_code`."""

        def compute(before: tuple, u: tuple, x: tuple, step: tuple, c: tuple) -> tuple:
            steps, kept = step
            did = outcome(task, before, u, x, c, steps, (kept,))
            c = task.at(c, steps * task.control_dt)
            finite = (*task.limits(x, c), *task.goal(x, c))  # an outcome does not tell
            return (*did, dynamics.tilt(x), *task.seen(x, c), *finite)

        states, forces = params.state_size, params.action_size
        sizes = states, forces, states, 2, len(task.constant_names)
        return _code((task, states), compute, sizes, False, start)

    def set_constants(self, c: State) -> None:
        """Makes c the constants of the episode."""
        self._constants[:] = c

    def judge(self, before: State, force: tuple[float, ...], x: State, steps: int, kept: float) -> State | None:
        """(9,) what a force, N, did that led from one state to the state x: an `Outcome`, and the tilt at its end, rad.

        None where Python must compute it.

        Args:
            before: (8,) state.
            force: (2,), N.
            x: (8,) state after the step.
            steps: of the episode, this one included.
            kept: ≥ 0 if the ball keeps its grip.
        """
        self._pack(*before, *force, *x, steps, kept)
        self._call()
        return self._unpack() if self._check[0] == 0 else None


_codes: dict[Any, Code | None] = {}
_begun: set[Any] = set()


def _code(
    key: Any, compute: Callable[..., Sequence[Any]], counts: Sequence[int], in_place: bool, start: bool
) -> Code | None:
    """The code of a function; None where there is none, or none yet. If start, it is made in the background."""
    try:
        if start and key not in _begun:
            _begun.add(key)
            if machine_code.compiler() is not None:
                with contextlib.suppress(RuntimeError):  # there can be no more threads
                    threading.Thread(target=_make, args=(key, compute, counts, in_place), name="ballbot-code").start()
        if key in _begun and key not in _codes:
            # A loop of steps hardly leaves the interpreter to other threads, which then need seconds for what takes 13 ms.
            time.sleep(_YIELD)
        return _codes.get(key)
    except TypeError:  # a task that has no hash
        return None


def _make(key: Any, compute: Callable[..., Sequence[Any]], counts: Sequence[int], in_place: bool) -> None:
    try:
        _codes[key] = _checked(compute, counts, in_place)
    except Exception as error:  # no cache, or whatever code of users raises that meets a traced number
        _log.info("%s stays in Python: %s: %s", key, type(error).__name__, error)
        _codes[key] = None


def _checked(compute: Callable[..., Sequence[Any]], counts: Sequence[int], in_place: bool) -> Code:
    """The code of a function, once it has given the bits that Python gives.

    Raises:
        ArithmeticError: it does not.
        NoMachineCodeError: see `machine_code.library`.
        Exception: whatever compute raises that cannot compute with traced numbers.
    """
    source = traced.function("compute", compute, counts, in_place)
    call = ctypes.PyDLL(
        str(machine_code.library("step", source, traced.FLAGS))
    ).compute  # it keeps the GIL: it is short
    call.argtypes, call.restype = (ctypes.c_void_p,), None
    rng, ends = np.random.default_rng(0), np.cumsum(counts)[:-1]
    code = Code(call, 0, sum(counts))
    for _ in range(_TRIALS):
        given = rng.uniform(-1.5, 1.5, sum(counts))
        expected = compute(*(tuple(part.tolist()) for part in np.split(given, ends)))
        code = code._replace(results=len(expected))
        work = Work(code, 1, 1, in_place)
        work.numbers[work.first : work.first + len(given)] = given
        work.call()
        if work.check[0] == 0 and work.numbers[1 : 1 + len(expected)].tobytes() != np.array(expected, float).tobytes():
            raise ArithmeticError("machine code computes other bits than Python")
    return code


if hasattr(os, "register_at_fork"):
    # a child does not have the threads
    os.register_at_fork(after_in_child=lambda: _begun.intersection_update(_codes))
