"""A control step of one environment in machine code.

`codegen` prints `step` and `observe` of `ballbot_gym.step` as C, and `libraries` compiles it within a fraction of a second,
once per machine and content. Where that is impossible, environments evaluate the same two functions in Python, several times
more slowly; the results agree to rounding.
"""

import ctypes
import logging
import struct
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from ballbot_gym import machine_code
from ballbot_gym.machine_code.libraries import NoMachineCodeError, shipped_source
from ballbot_gym.robot import Kind, Randomization, Robot, Sensors, first_of_kind, named_robot
from ballbot_gym.step import (
    Draws,
    Outcome,
    Step,
    StepState,
    by_engine,
    closed_form,
    observation_size,
    observe,
    step,
    unmoved,
)
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import digest, problem_digest

_log = logging.getLogger(__name__)

FLAGS = ("-O1", "-fno-math-errno", "-fno-trapping-math")

_TRIALS = 4
_BY_ENGINE = ("end", "floor", "stable")
"""Arguments that an engine gives."""
_new = tuple.__new__  # of a named tuple, several times as fast as `_make`, which also counts the numbers

Numbers = tuple[Any, ...]


class StepProblem(NamedTuple):
    """What the code of a step depends on.

    Constants, what is drawn, the robot's numbers, and the number of steps of an episode are arguments of the code.
    """

    task: Task
    kind: Kind
    variation: Randomization
    senses: bool
    """Whether sensors are observed, and not the state."""
    substeps: int
    """RK4 steps in a control step; 0 where an engine moves the robot."""
    contact: bool
    """Whether this engine simulates the floor's force on the ball."""

    def draws(self) -> Draws:
        """Zeros, as many as a step draws uniform numbers."""
        varied = self.variation
        counts = varied.PUSH_DRAWS * varied.pushes, Sensors.DRAWS * self.senses, varied.NOISE_DRAWS * varied.is_noisy
        return Draws._make((0.0,) * count for count in counts)

    def of_episode(self) -> dict[str, int]:
        """Arguments that stay the same during an episode: names, and how many numbers each has."""
        robot, drawn = len(self._numbers), self.variation.episode_draws * self.variation.varies_episodes
        return {
            "c": len(self.task.constant_names),
            "drawn": drawn,
            "robot": robot,
            "model": robot * self.variation.varies_robot,
            "episode_steps": 1,
        }

    def of_step(self) -> dict[str, int]:
        """The other arguments."""
        kind, variation, engine, z = self.kind.robot, self.variation, not self.substeps, self.draws()
        states, actions = len(kind.STATE), len(kind.ACTION)
        return {
            "x": states,
            "steps": 1,
            "actuator": len(variation.resting((0.0,) * actions, self.task.control_dt)),
            "sensors": Sensors.MEMORY * self.senses,
            "action": actions,
            "push": len(z.push),
            "read": len(z.sensors),
            "noise": len(z.noise),
            "end": states * engine,
            "floor": 3 * self.contact,
            "stable": int(engine),
        }

    def results(self) -> dict[str, int]:
        """Results: names, and how many numbers each has."""
        given, kind = self.of_step(), self.kind.robot
        return {
            "outcome": len(Outcome._fields),
            "clipped": 1,
            "x": given["x"],
            "actuator": given["actuator"],
            "sensors": given["sensors"],
            "force": given["action"],
            "grip": 4 * self.kind.grips,
            "measured": len(kind.MEASUREMENTS),
            "seen": observation_size(self.task, kind, "sensors" if self.senses else "state"),
        }

    def stepped(self, given: Mapping[str, Numbers]) -> dict[str, Numbers]:
        """The results of a step that follow from arguments: numbers, or symbols from which the code is printed."""
        task, dt = self.task, self.task.control_dt
        robot, state, z = self._read(given)
        model = self._robot(given["model"]) if self.variation.varies_robot else robot
        if self.substeps:
            move = closed_form(dt, self.substeps)
        else:
            move = by_engine(given["end"], given["floor"], given["stable"][0], dt)
        did = step(task, robot, self.variation, state, given["action"], z, move, model, given["episode_steps"][0])
        return self._written(robot, did, z)

    def started(self, given: Mapping[str, Numbers]) -> dict[str, Numbers]:
        """The same where an episode starts in the state, and nothing was done."""
        robot, state, z = self._read(given)
        return self._written(robot, unmoved(self.task, robot, state), z)

    def _read(self, given: Mapping[str, Numbers]) -> tuple[Any, StepState, Draws]:
        state = StepState(
            given["x"], given["c"], given["steps"][0], given["drawn"], given["actuator"], given["sensors"]
        )
        return self._robot(given["robot"]), state, Draws(given["push"], given["read"], given["noise"])

    def _written(self, robot: Any, made: Step, z: Draws) -> dict[str, Numbers]:
        after = made.state
        return {
            "outcome": made.outcome,
            "clipped": (made.clipped,),
            "x": after.x,
            "actuator": after.actuator,
            "sensors": after.sensors,
            "force": made.force,
            "grip": made.grip,
            "measured": robot.measurements(after.x),
            "seen": observe(self.task, robot, self.variation, after, z.noise),
        }

    @property
    def functions(self) -> dict[str, Callable[[Mapping[str, Numbers]], dict[str, Numbers]]]:
        """What the code computes, by the names of its functions."""
        return {"stepped": self.stepped, "started": self.started}

    def code_name(self, robot: Robot) -> str:
        """What the code is called where wheels keep it; the robot is one of the kind."""
        task, *rest = self
        problem = problem_digest(task, named_robot(first_of_kind(robot)))
        return f"one-{type(task).__name__.lower()}-{digest(problem, [repr(each) for each in rest])}"

    def source(self) -> str:
        """The C code of the functions; their arguments are those of the step, and then those of the episode.

        Raises:
            ImportError: CasADi is missing.
            Exception: any error of a task that cannot compute with symbols.
        """
        from ballbot_gym.machine_code import codegen  # it imports CasADi

        return codegen.single_source(self.of_step() | self.of_episode(), self.functions)

    def numbers(self, robot: Robot) -> list[float]:
        """A robot's numbers, as the code takes them."""
        return [_value(robot, name) for name in self._numbers]

    @property
    def _numbers(self) -> tuple[str, ...]:
        names = self.kind.numbers
        return (*names, *(name for name in self.kind.robot.SENSORS if self.senses and name not in names))

    def _robot(self, numbers: Numbers) -> Any:
        return Kind(self.kind.robot, self._numbers).model(numbers)


class StepCode:
    """The code of a step, with memory of its own: that of one environment.

    After a step `seen` is the (no,) observation, `x` the (n,) state and `force` the (m,) force that the actuators applied,
    all float64. The next step overwrites them.
    """

    def __init__(self, problem: StepProblem, functions: "Functions"):
        self._problem = problem
        self._nominal: Robot | None = None
        self._numbers: list[float] = []
        results, given, fixed = problem.results(), problem.of_step(), problem.of_episode()
        count, arguments, constant = (sum(sizes.values()) for sizes in (results, given, fixed))
        memory = bytearray(8 * (count + arguments + constant))
        numbers = np.frombuffer(memory)
        self._fixed = numbers[count + arguments :]
        self._pack = partial(struct.Struct(f"{arguments}d").pack_into, memory, 8 * count)
        self._step, self._start = (
            partial(functions[name], ctypes.c_void_p(numbers.ctypes.data)) for name in problem.functions
        )
        self._no_step = ((0.0,) * given["action"], *problem.draws()[:2], *((0.0,) * given[name] for name in _BY_ENGINE))
        self._unpack = struct.Struct(f"{count - results['seen']}d").unpack_from
        self._memory, self.seen = memory, numbers[count - results["seen"] : count]
        ends = np.cumsum(list(results.values())).tolist()
        places = {name: slice(end - size, end) for end, (name, size) in zip(ends, results.items(), strict=True)}
        self.x, self.force = (numbers[places[name]] for name in ("x", "force"))
        del places["seen"]
        self._parts = itemgetter(*places.values())  # of results, faster than a slice after the other

    @classmethod
    def compiled(cls, problem: StepProblem, robot: Robot) -> "StepCode | None":
        """The code of a step of robots of one kind, which is tried with this one.

        It is None where there is no code, and the log says why.
        """
        try:
            if problem not in _functions:
                _functions[problem] = None
                _functions[problem] = _compiled(problem, robot)
            functions = _functions[problem]
        except (
            Exception
        ) as error:  # no compiler, cache, CasADi or hash of the task, or any error of users' code given a symbol
            _log.info("%s stays in Python: %s: %s", problem.task.id, type(error).__name__, error)
            return None
        return None if functions is None else cls(problem, functions)

    def begin(self, c: Numbers, drawn: Numbers, robot: Robot, model: Robot) -> None:
        """Takes what stays the same during an episode: constants, draws, the nominal robot and that of the episode."""
        problem = self._problem
        if robot is not self._nominal:  # which is the same in every episode
            self._nominal, self._numbers = robot, problem.numbers(robot)
        varied = problem.numbers(model) if problem.variation.varies_robot else ()
        self._fixed[:] = (*c, *drawn, *self._numbers, *varied, problem.task.steps)

    def step(
        self, state: StepState, action: Numbers, z: Draws, moved: tuple[Numbers, Numbers, float] | None
    ) -> tuple[Step, Numbers]:
        """One control step, and what the robot measures after it; see `ballbot_gym.step.step`.

        Args:
            state: before the step.
            action: in units of the robot's force limit.
            z: uniform numbers.
            moved: where an engine moves the robot, the first three arguments of `by_engine`.
        """
        x, _, steps, _, actuator, read = state
        if moved is None:
            self._pack(*x, steps, *actuator, *read, *action, *z[0], *z[1], *z[2])
        else:
            end, floor, stable = moved
            self._pack(*x, steps, *actuator, *read, *action, *z[0], *z[1], *z[2], *end, *floor, stable)
        self._step()
        return self._made(state, steps + 1)

    def start(self, state: StepState, noise: Numbers) -> tuple[Step, Numbers]:
        """The start of an episode, and what the robot measures there; see `ballbot_gym.step.unmoved`.

        Args:
            state: in which it starts.
            noise: uniform numbers of the observation.
        """
        action, push, read, end, floor, stable = self._no_step
        self._pack(
            *state.x, state.steps, *state.actuator, *state.sensors, *action, *push, *read, *noise, *end, *floor, *stable
        )
        self._start()
        return self._made(state, state.steps)

    def _made(self, before: StepState, steps: int) -> tuple[Step, Numbers]:
        """The results, after a step that began in a state, or none."""
        did, (clipped,), x, actuator, read, force, grip, measured = self._parts(self._unpack(self._memory))
        end = _new(StepState, (x, before[1], steps, before[3], actuator, read))
        return _new(Step, (end, _new(Outcome, did), force, clipped, grip)), measured


Functions = dict[str, Callable[..., None]]
"""Compiled `StepProblem.functions`."""

_functions: dict[StepProblem, Functions | None] = {}


def _compiled(problem: StepProblem, robot: Robot) -> Functions:
    """The compiled functions of a problem.

    Raises:
        NoMachineCodeError: there is no compiler, or the code computes something else than Python.
        ImportError: CasADi is missing, and no wheel has the code.
        Exception: any error of a task that cannot compute with symbols.
    """
    source = shipped_source(problem.code_name(robot)) if find_spec("casadi") is None else None
    name, kinds = f"one-{type(problem.task).__name__.lower()}", (type(problem.task), problem.kind.robot)
    source = machine_code.printed(name, problem, kinds, problem.source) if source is None else source
    path = machine_code.library(name, source, FLAGS)
    library, functions = ctypes.PyDLL(str(path)), {}  # it keeps the GIL: functions are short
    for name in problem.functions:
        functions[name] = function = getattr(library, name)
        function.argtypes, function.restype = (ctypes.c_void_p,), None
    _check(problem, functions, robot)
    return functions


def _check(problem: StepProblem, functions: Functions, robot: Robot) -> None:
    """Raises a NoMachineCodeError if code computes something else than Python, as where a symbol was taken for a number."""
    rng = np.random.default_rng(0)
    sizes = problem.of_step() | problem.of_episode()
    count = sum(problem.results().values())
    own = tuple(problem.numbers(robot))
    for name, compute in [*problem.functions.items()] * _TRIALS:
        given = {name: tuple(rng.uniform(0.05, 0.5, size).tolist()) for name, size in sizes.items()}
        given |= {name: own for name in ("robot", "model") if sizes[name]} | {
            "episode_steps": (float(problem.task.steps),)
        }
        expected = [float(part) for parts in compute(given).values() for part in parts]
        numbers = np.array([0.0] * count + [part for name in sizes for part in given[name]])
        functions[name](ctypes.c_void_p(numbers.ctypes.data))
        if not np.allclose(numbers[:count], expected, rtol=1e-6, atol=1e-9, equal_nan=True):
            raise NoMachineCodeError(f"{problem.task.id} gives other results with CasADi's symbols than with numbers")


def _value(robot: Any, name: str) -> float:
    for part in name.split("."):
        robot = getattr(robot, part)
    return robot
