"""BallbotNative: the envs of `BallbotArrays` in machine code, which is compiled once per task and robot.

`codegen` writes the C code, `machine_code` compiles it within a second or two, and it serves batches of all sizes. Episodes
are those of `BallbotBatch`: the same `seeding` numbers for the same seeds. Motions agree to rounding. They are
bit-identical for any size of the batch and any place of the env in it.
"""

import ctypes
import itertools
import os
from functools import cache
from importlib.util import find_spec
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np

from ballbot_gym import machine_code
from ballbot_gym.checks import check_finite
from ballbot_gym.machine_code import NoMachineCodeError
from ballbot_gym.robot import Robot
from ballbot_gym.step import FLAGS, PAY
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import problem_digest
from ballbot_gym.vector.arrays import BallbotArrays, State, _batch_step
from ballbot_gym.vector.state import BatchStep

# With GCC, -O3 takes half as much time again, and steps of large batches of robots without wheels take 6 to 8 % longer.
_COMPILER_FLAGS = (
    *("-O2", "-ftree-vectorize"),
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fopenmp-simd"),
)
_PARALLEL_FROM = 4096
"""Smallest number of envs whose steps several threads share. Two threads take as long as one for 2,048 envs, and a seventh
less for 4,096."""


class BallbotNative(BallbotArrays):
    """A `BallbotArrays` in machine code, checked against that before it is used. Arrays of a state are never written into."""

    compiled = True

    def __init__(
        self,
        task: Task,
        num_envs: int,
        dtype: type[np.floating],
        params: Robot,
        threads: int = 1,
        code: Any = None,
    ):
        """Makes the envs.

        Args:
            task, num_envs, dtype, params: same as in `BallbotArrays`.
            threads: among which large batches are divided.
            code: the library of `codegen`'s functions; default, that of the task and the robot.

        Raises:
            NoMachineCodeError: CasADi or a C compiler is missing, or the task cannot be traced.
            ValueError: num_envs out of range.
        """
        super().__init__(task, num_envs, dtype, params)
        self.threads = threads
        self._code = code or _code(task, params, dtype is np.float64)
        self._all = np.arange(self.num_envs)
        acted = params.action_size, 4 * params.grips
        rows = params.state_size, len(params.MEASUREMENTS), *acted, task.observation_size(params)
        self._rows_end = list(itertools.accumulate(rows))  # of what a step computes

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_code": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._code = _code(self.task, self.params, self.dtype is np.float64)

    def _start(self, which: np.ndarray, state: State, given: bool) -> None:
        """Starts episodes in some envs of a state, in place; their constants are drawn unless they are given."""
        arrays = _pointers(which, state.seed, state.episode)
        self._code.ballbot_start(self.num_envs, len(which), *arrays, given, *_pointers(state.x, state.c))

    def _stepped(self, old: State, actions: np.ndarray, waiting: np.ndarray | None) -> tuple[State, BatchStep]:
        """The state after a step, and what the step did."""
        size, dtype = self.num_envs, self.dtype
        states, measured, force, grip, all_rows = self._rows_end
        if self.restarts:  # observations come first, so that they take the memory of earlier ones
            seen, now = np.empty((all_rows - grip, size), dtype), np.empty((measured, size), dtype)
        c, end = np.empty(old.c.shape, dtype), np.empty((all_rows, size), dtype)
        if not self.restarts:
            seen, now = end[grip:], end
        pay, flags = np.empty((len(PAY), size)), np.empty((len(FLAGS), size), bool)
        counts = np.empty((3, size), np.int64)
        (env, component), item = actions.strides, actions.itemsize
        if env % item or component % item:
            actions = actions.copy()
            env, component = actions.strides
        if actions.flags.f_contiguous:
            actions = actions.T  # the same memory, in the order that `_pointer` needs
        read = _pointers(old.x, old.c, actions, old.steps, old.episode, old.seed)
        idle = 0 if waiting is None else _pointer(waiting)
        written = _pointers(end, now, seen, c, pay, flags, counts)
        memory = _Memory(
            *(0, 0, size, self.most_steps, self.task.steps, 0, env // item, component // item),
            *(*read, idle, self.restarts, *written),
        )
        self._run(memory)
        if memory.bad:  # what was computed is forgotten
            check_finite(actions)
        violated, steps, episode = counts
        did = _batch_step(
            pay,
            flags,
            observation=seen.T,
            final_observation=end[grip:].T,
            final_x=end[:states],
            violated=violated,
            force=end[measured:force],
            grip=end[force:grip],
            measured=now[states:measured],
            final_measured=end[states:measured],
        )
        return old._replace(x=now[:states], c=c, steps=steps, episode=episode), did

    def _seen(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """(no, B) what all envs see, and their measurements, a row (B,) each."""
        seen = np.empty((self.task.observation_size(self.params), self.num_envs), self.dtype)
        measured = np.empty((len(self.params.MEASUREMENTS), self.num_envs), self.dtype)
        arrays = self._all, state.steps, state.x, state.c, seen, measured
        self._code.ballbot_observe(self.num_envs, self.num_envs, *_pointers(*arrays))
        return seen, measured

    def _run(self, memory: "_Memory") -> None:
        """A step, by several threads where that is faster."""
        if self.num_envs >= _PARALLEL_FROM:
            for jobs in _helpers(self.threads - 1):
                if jobs.empty():  # otherwise a late helper still has the same call in its queue
                    jobs.put((self._code.step, memory))
        self._code.step(memory)


class _Memory(ctypes.Structure):
    """What a step reads and writes; native.c says what each is."""

    _fields_ = (
        *(
            (name, ctypes.c_int64)
            for name in ("taken", "done", "size", "most", "episode_steps", "bad", "env", "component")
        ),
        *((name, ctypes.c_void_p) for name in ("x", "c", "action", "steps", "episode", "seed", "idle")),
        ("restarts", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("end", "now", "seen", "new_c", "pay", "flags", "counts")),
    )


def _pointers(*arrays: np.ndarray) -> list[int]:
    return [_pointer(array) for array in arrays]


def _pointer(array: np.ndarray) -> int:
    """Where an array's memory begins; `array.ctypes.data` takes five times as long, which is a third of a step of one env."""
    if not array.size:
        return 0
    try:
        # NumPy's type stubs do not know that arrays are buffers
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):  # it is read-only, or not contiguous
        return array.ctypes.data


def _check(code: ctypes.CDLL, task: Task, params: Robot, double: bool) -> None:
    """Raises a NoMachineCodeError unless functions compute the same with CasADi's symbols as with numbers.

    For example, a symbol that is converted to a float silently becomes NaN.
    """
    dtype = np.float64 if double else np.float32
    actions = [[0.1, -0.2, 0.3], [-0.3, 0.4, -0.5], [1.2, 0.5, 0.1], [-0.6, -1.2, 0.2]]
    actions = np.asfortranarray(np.array(actions, dtype)[:, np.arange(params.action_size) % 3])
    outcomes = []
    batch = (
        BallbotNative(task, len(actions), dtype, params, code=code),
        BallbotArrays(task, len(actions), dtype, params),
    )
    for envs in batch:
        envs.state = start = envs.initial_state(seed=0)
        values = {"first observation": envs.observe(start), "start": start.x, "start constants": start.c}
        outcomes.append(values | envs.step(actions)._asdict() | envs.state._asdict())
    found, expected = outcomes
    for name in expected:
        if not np.allclose(found[name], expected[name], rtol=1e-3, atol=1e-3, equal_nan=True):
            raise NoMachineCodeError(f"{name} of {task.id} gives other results with CasADi's symbols than with numbers")


def _source(task: Task, params: Robot, double: bool) -> str:
    """The C code of a task and a robot: `codegen`'s, or where CasADi is missing what a wheel has of it.

    Raises:
        ImportError: CasADi is missing, and no wheel has the code.
        Exception: as `codegen.source`.
    """
    if find_spec("casadi") is None and (written := machine_code.shipped_source(code_name(task, params, double))):
        return written

    def print_it() -> str:
        from ballbot_gym.machine_code import codegen  # it imports CasADi

        return codegen.source(task, params, double)

    kinds = type(task), type(params)
    return machine_code.printed(type(task).__name__.lower(), (task, params, double), kinds, print_it)


def code_name(task: Task, params: Robot, double: bool) -> str:
    """What the code of a task and a robot is called where wheels keep it."""
    return f"{type(task).__name__.lower()}-{problem_digest(task, params)}-{'double' if double else 'float'}"


@cache
def _code(task: Task, params: Robot, double: bool) -> ctypes.CDLL:
    """The library of a task and a robot, once it was checked.

    Raises:
        NoMachineCodeError: see `BallbotNative`.
    """
    try:
        source = _source(task, params, double)
    except (ImportError, NoMachineCodeError):
        raise
    except Exception as error:  # users' code may raise any error when it gets CasADi's symbols
        raise NoMachineCodeError(f"{task.id} cannot be traced: {type(error).__name__}: {error}") from error
    try:
        library = ctypes.CDLL(str(machine_code.library(type(task).__name__.lower(), source, _COMPILER_FLAGS)))
    except (OSError, NoMachineCodeError) as error:
        raise NoMachineCodeError(str(error) or "there is no C compiler that works") from error
    count, pointer = ctypes.c_int64, ctypes.c_void_p
    memory = ctypes.POINTER(_Memory)
    signatures = {
        "step": [memory],
        "ballbot_start": [count] * 2 + [pointer] * 3 + [ctypes.c_int] + [pointer] * 2,
        "ballbot_observe": [count] * 2 + [pointer] * 6,
    }
    for name, signature in signatures.items():
        function = getattr(library, name)
        function.argtypes, function.restype = signature, None
    _check(library, task, params, double)
    return library


@cache
def _helpers(count: int) -> tuple["SimpleQueue[Any]", ...]:
    """The queues of `count` threads, which call functions with an argument."""
    queues = tuple(SimpleQueue() for _ in range(count))
    for jobs in queues:
        Thread(target=_help, args=(jobs,), name="ballbot", daemon=True).start()
    return queues


def _help(jobs: "SimpleQueue[Any]") -> None:
    while True:
        function, argument = jobs.get()
        function(argument)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a child does not have the threads
