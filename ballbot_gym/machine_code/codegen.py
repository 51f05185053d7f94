"""C code of what a task and a robot compute, for many robots at once.

`ops` lets tasks and robots compute with CasADi's symbols. So a step is traced once, and written out as C functions that the
rest of the code, native.c, calls. They compute blocks of `LANES` robots. This number is a constant, so that compilers make
SIMD instructions of the loops. Every robot is computed by the same instructions, for any size of the batch and any place in
it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ballbot_gym import ops
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.step import FLAGS, PAY, StepState, step
from ballbot_gym.tasks import Task

with imports_of("the machine code of batches", "baselines"):
    import casadi

LANES = 16
"""Robots per block: as many float32 as an AVX-512 register holds."""

_LONGEST, _PIECE = 40_000, 500  # lines of a C function, and of its pieces where it is longer

Part = tuple[str, Sequence[Any]]
"""A pointer's name in C, and the symbols that are read from its rows, or the expressions that are written to them."""

OPERATIONS = {
    casadi.OP_ASSIGN: "{0}",
    casadi.OP_ADD: "{0} + {1}",
    casadi.OP_SUB: "{0} - {1}",
    casadi.OP_MUL: "{0} * {1}",
    casadi.OP_DIV: "{0} / {1}",
    casadi.OP_NEG: "-{0}",
    casadi.OP_INV: "1 / {0}",
    casadi.OP_SQ: "{0} * {0}",
    casadi.OP_TWICE: "2 * {0}",
    casadi.OP_SQRT: "real_sqrt({0})",
    casadi.OP_SIN: "real_sin({0})",
    casadi.OP_COS: "real_cos({0})",
    casadi.OP_TAN: "real_tan({0})",
    casadi.OP_ATAN: "real_atan({0})",
    casadi.OP_ACOS: "real_acos({0})",
    casadi.OP_EXP: "real_exp({0})",
    casadi.OP_LOG: "real_log({0})",
    casadi.OP_FABS: "real_fabs({0})",
    casadi.OP_FLOOR: "real_floor({0})",
    casadi.OP_POW: "real_pow({0}, {1})",
    casadi.OP_CONSTPOW: "real_pow({0}, {1})",
    casadi.OP_FMIN: "{0} < {1} ? {0} : {1}",
    casadi.OP_FMAX: "{0} > {1} ? {0} : {1}",
    casadi.OP_LT: "{0} < {1} ? (real)1 : (real)0",
    casadi.OP_LE: "{0} <= {1} ? (real)1 : (real)0",
    casadi.OP_EQ: "{0} == {1} ? (real)1 : (real)0",
    casadi.OP_NE: "{0} != {1} ? (real)1 : (real)0",
}
"""Operations of CasADi as C, with the functions of real.h."""

_LOGIC = {
    casadi.OP_NOT: "1 - {0}",
    casadi.OP_AND: "{0} * {1}",
    casadi.OP_OR: "{0} + {1} - {0} * {1}",
}
"""Operations on truth values, which are the numbers 0 and 1. Compilers make branches of others, and no SIMD."""

_TRUTH = {casadi.OP_LT, casadi.OP_LE, casadi.OP_EQ, casadi.OP_NE, *_LOGIC}


def source(task: Task, params: Robot, double: bool) -> str:
    """The C code of a task and a robot, with the functions `step`, `ballbot_start` and `ballbot_observe` of native.c.

    Args:
        task: the task.
        params: the robot.
        double: whether numbers are float64, else float32.

    Raises:
        NotImplementedError: the task has an operation that is not supported here.
        Exception: any error of a task that cannot compute with CasADi's symbols.
    """
    x, c = _symbols("x", params.state_size), _symbols("c", len(task.constant_names))
    z = _symbols("z", task.constant_draws), _symbols("y", task.state_draws)
    # control steps that were taken, and of a whole episode, so that tasks of all durations share their code
    action, taken, whole = _symbols("a", params.action_size), _symbols("t", 1), _symbols("w", 1)
    now = task.at(c, taken[0] * task.control_dt)
    blocks = [
        block(
            "advance",
            (("x", x), ("c", c), ("a", action), ("t", taken), ("w", whole)),
            _advance(task, params, StepState(x, c, taken[0]), action, whole[0]),
        ),
        block(
            "look",
            (("x", x), ("c", c), ("t", taken)),
            (("seen", ops.components(task.seen(x, now, params))), ("measured", params.measurements(x))),
        ),
        block("draw_constants", (("z", z[0]),), (("c", task.draw_constants(z[0], params)),)),
        block("draw_state", (("z", z[1]), ("c", c)), (("x", task.start(z[1], c, params)),)),
    ]
    sizes = {
        "DOUBLE": int(double),
        "LANES": LANES,
        "CONSTANTS": len(c),
        "STATES": len(x),
        "ACTIONS": len(action),
        "SEEN": task.observation_size(params),
        "MEASURED": len(params.MEASUREMENTS),
        "GRIP": 4 if params.grips else 0,
        "FLAGS": len(FLAGS),
        "CONSTANT_DRAWS": task.constant_draws,
        "DRAWS": task.constant_draws + task.state_draws,
    }
    defined = [f"#define {name} {value}" for name, value in sizes.items()]
    return "\n".join([*defined, text("real.h"), text("native.c"), *blocks])


Function = Callable[[dict[str, Any]], Mapping[str, Sequence[Any]]]
"""From arguments by name to results by name."""


def single_source(arguments: Mapping[str, int], functions: Mapping[str, Function]) -> str:
    """The C code `void NAME(double *numbers)` of functions of the same named numbers, as of a step.

    The numbers are the results, then the arguments.

    Args:
        arguments: their names, and how many numbers each has.
        functions: by name; their results have the same names and sizes.

    Raises:
        Exception: as `source`.
    """
    given = {name: _symbols(f"{name}_", size) for name, size in arguments.items()}
    blocks = []
    for function, compute in functions.items():
        results = compute(given)
        count, pointers, at = len(results), [], 0
        for part in (*results.values(), *given.values()):
            pointers.append(f"numbers + {at}, 1")
            at += len(part)
        inputs = [(f"given_{name}", part) for name, part in given.items()]
        outputs = [(f"made_{name}", part) for name, part in results.items()]
        called = ", ".join((*pointers[count:], *pointers[:count]))
        blocks += [
            block(f"one_{function}", inputs, outputs),
            f"void {function}(double *numbers) {{\n    one_{function}({called});\n}}\n",
        ]
    return "\n".join(["#define DOUBLE 1\n#define LANES 1", text("real.h"), *blocks])


_CASADI = """
typedef long long casadi_int;
static void gather(int rows, const double *columns, real *out) {
    for (int k = 0; k < LANES; ++k)
        for (int i = 0; i < rows; ++i)
            out[i * LANES + k] = columns ? columns[k * rows + i] : 0;
}
static void scatter(int rows, const real *in, double *columns) {
    for (int k = 0; columns && k < LANES; ++k)
        for (int i = 0; i < rows; ++i)
            columns[k * rows + i] = in[i * LANES + k];
}
"""
"""CasADi's matrices have a column per stage, and blocks a row per variable. A null pointer is a 0, or not wanted."""


def in_lanes(functions: Sequence[casadi.Function], lanes: int) -> str:
    """The C code of functions that CasADi loads as external ones: each computes `lanes` stages, a column each, at once.

    Args:
        functions: with dense columns as arguments and results, and distinct names.
        lanes: stages per call, a number that SIMD instructions suit.

    Raises:
        NotImplementedError: a function has an operation that is not known here.
    """
    blocks, sizes = [], {}
    for function in functions:
        name = function.name()
        symbols = [casadi.SX.sym(f"in{i}", function.size1_in(i)) for i in range(function.n_in())]
        inputs = [(f"in{i}", casadi.vertsplit(part)) for i, part in enumerate(symbols)]
        outputs = [(f"out{i}", casadi.vertsplit(part)) for i, part in enumerate(function.call(symbols))]
        blocks.append(block(f"{name}_lanes", inputs, outputs))
        sizes[name] = tuple({pointer: len(rows) for pointer, rows in columns} for columns in (inputs, outputs))
    return externals({"LANES": lanes}, blocks, sizes, stride=", LANES")


Sizes = Mapping[str, int]
"""Numbers of rows by the names of pointers."""


def externals(
    defined: Mapping[str, int], parts: Sequence[str], functions: Mapping[str, tuple[Sizes, Sizes]], stride: str = ""
) -> str:
    """The C code of a library whose functions CasADi loads as external ones.

    Args:
        defined: numbers that the code knows by name, one of them LANES.
        parts: C code, with `NAME_lanes` of each function.
        functions: by name, what each reads and what it writes.
        stride: what follows a pointer in the call of `NAME_lanes`.
    """
    lines = [f"#define {name} {size}" for name, size in {"DOUBLE": 1, **defined}.items()]
    entries = [_external(name, *sizes, stride) for name, sizes in functions.items()]
    return "\n".join([*lines, text("real.h"), _CASADI, *parts, *entries])


def _external(name: str, inputs: Sizes, outputs: Sizes, stride: str) -> str:
    """What CasADi looks for in a library to call `NAME_lanes`: the function, and the sizes of what it reads and writes."""
    body = [f"real {pointer}[{max(rows, 1)} * LANES];" for pointer, rows in (*inputs.items(), *outputs.items())]
    body += [f"gather({rows}, arg[{i}], {pointer});" for i, (pointer, rows) in enumerate(inputs.items())]
    body.append(f"{name}_lanes({', '.join(f'{pointer}{stride}' for pointer in (*inputs, *outputs))});")
    body += [f"scatter({rows}, {pointer}, res[{i}]);" for i, (pointer, rows) in enumerate(outputs.items())]
    parts = []
    for direction, columns in (("in", inputs), ("out", outputs)):
        parts.append(f"casadi_int {name}_n_{direction}(void) {{ return {len(columns)}; }}")
        sizes = ", ".join(f"{{{rows}, LANES, 1}}" for rows in columns.values())  # 1 says that a matrix is dense
        parts.append(
            f"const casadi_int *{name}_sparsity_{direction}(casadi_int i) {{\n"
            f"    static const casadi_int sizes[][3] = {{{sizes}}};\n    return sizes[i];\n}}"
        )
    lines = "\n    ".join(body)
    parts.append(
        f"int {name}(const double **arg, double **res, casadi_int *iw, double *w, int mem) {{\n    {lines}\n"
        "    return 0;\n}"
    )
    return "\n".join(parts)


def text(name: str, module: str = __file__) -> str:
    """The text of a file of code in the folder of a module, which is given by its `__file__`; default, of this module."""
    return Path(module).with_name(name).read_text(encoding="utf-8")


def _advance(
    task: Task, params: Robot, state: StepState, action: tuple, episode_steps: Any
) -> tuple[tuple[str, Sequence[Any]], ...]:
    """One control step, up to the start of the next episode."""
    did = step(task, params, Randomization(), state, action, episode_steps=episode_steps)
    end = did.outcome
    return (
        ("end", did.state.x),
        ("force", did.force),
        ("grip", did.grip),
        ("pay", [getattr(end, name) for name in PAY]),
        ("flags", (end.terminated, end.truncated, end.success, end.failure, did.clipped)),
        ("violated", (end.violated,)),
    )


def _symbols(name: str, count: int) -> tuple[Any, ...]:
    return tuple(casadi.SX.sym(f"{name}{i}") for i in range(count))


class _Line(NamedTuple):
    """A line of C that computes one operation."""

    text: str
    made: int | None
    """The register that it writes; None where it writes a result."""
    given: Sequence[int]
    """The registers that it reads."""
    constant: bool
    """Whether it writes a constant."""


def block(name: str, inputs: Sequence[Part], outputs: Sequence[Part]) -> str:
    """A C function that computes expressions for `LANES` robots.

    Row i of every pointer p is at p + i * sp, so that rows may be those of a whole batch or of a block alone.
    """
    read = [(f"{pointer}[{i} * s{pointer} + k]", symbol) for pointer, part in inputs for i, symbol in enumerate(part)]
    write = [(f"{pointer}[{i} * s{pointer} + k]", value) for pointer, part in outputs for i, value in enumerate(part)]
    function = casadi.Function(name, [symbol for _, symbol in read], [casadi.SX(v) for _, v in write], {"cse": True})
    lines: list[_Line] = []
    truths, infinite = set(), set()  # registers that hold a truth value, and infinity
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        given, made = function.instruction_input(k), function.instruction_output(k)
        if operation == casadi.OP_OUTPUT:
            lines.append(_Line(f"{write[made[0]][0]} = w{given[0]};", None, given, False))
            continue
        if operation == casadi.OP_INPUT:
            value, given = read[given[0]][0], ()
        elif operation == casadi.OP_CONST:
            value, given = _literal(function.instruction_constant(k)), ()
        elif operation in OPERATIONS:
            value = OPERATIONS[operation].format(*(f"w{i}" for i in given))
        elif operation in _LOGIC:
            value = _LOGIC[operation].format(*(_truth(i, truths) for i in given))
        elif operation == casadi.OP_IF_ELSE_ZERO:
            condition, number = given
            form = "{0} != 0 ? w{1} : (real)0" if number in infinite else "{0} * w{1}"  # 0 times infinity is no number
            value = form.format(_truth(condition, truths), number)
        else:
            raise NotImplementedError(f"{name} has CasADi's operation {operation}, which is not known as C")
        constant = function.instruction_constant(k) if operation == casadi.OP_CONST else None
        lines.append(_Line(f"w{made[0]} = {value};", made[0], given, constant is not None))
        _note(truths, made[0], operation in _TRUTH or constant in (0.0, 1.0))
        _note(infinite, made[0], constant is not None and math.isinf(constant))
    arguments = [f"const real *restrict {pointer}, int64_t s{pointer}" for pointer, _ in inputs]
    arguments += [f"real *restrict {pointer}, int64_t s{pointer}" for pointer, _ in outputs]
    if len(lines) <= _LONGEST:
        return _loop(name, arguments, lines)
    return _in_pieces(name, [pointer for pointer, _ in (*inputs, *outputs)], arguments, lines)


def _loop(name: str, arguments: Sequence[str], lines: Sequence[_Line], kind: str = "") -> str:
    """A C function that computes lines for every lane."""
    registers = {i for line in lines for i in (*line.given, line.made) if i is not None}
    variables = ", ".join(f"w{i}" for i in sorted(registers))
    body = "\n        ".join([f"real {variables};" if registers else "", *(line.text for line in lines)])
    return (
        f"static {kind}void {name}({', '.join(arguments)}) {{\n"
        f"    #pragma omp simd\n    for (int k = 0; k < LANES; ++k) {{\n        {body}\n    }}\n}}\n"
    )


def _in_pieces(name: str, pointers: Sequence[str], arguments: Sequence[str], lines: Sequence[_Line]) -> str:
    """The same as C functions one after another, because the time of compilers grows with the square of the length.

    Registers that a later piece reads are kept in memory between them.
    """
    pieces = [lines[first : first + _PIECE] for first in range(0, len(lines), _PIECE)]
    writes = [
        {line.made: line for line in piece if line.made is not None} for piece in pieces
    ]  # its last of a register
    begins: list[set[int]] = []  # what each piece reads before it writes it
    for piece in pieces:
        begun, written = set(), set()
        for line in piece:
            begun.update(set(line.given) - written)
            written.add(line.made)
        begins.append(begun)
    needed: list[set[int]] = [set() for _ in pieces]  # after each piece
    for i in reversed(range(len(pieces) - 1)):
        needed[i] = begins[i + 1] | (needed[i + 1] - set(writes[i + 1]))
    kept = "kept[{0} * LANES + k]"
    functions, constants = [], {}  # of registers that hold one at the end of a piece, its line
    for i, (piece, last) in enumerate(zip(pieces, writes, strict=True)):
        before = [constants.get(r, _Line(f"w{r} = {kept.format(r)};", r, (), False)) for r in sorted(begins[i])]
        constants = {r: line for r, line in (constants | last).items() if line.constant}
        stored = sorted(needed[i] & set(last) - set(constants))
        after = [_Line(f"{kept.format(r)} = w{r};", None, (r,), False) for r in stored]
        whole = [*before, *piece, *after]
        functions.append(_loop(f"{name}_{i}", [*arguments, "real *restrict kept"], whole, "__attribute__((noinline)) "))
    given = ", ".join(f"{pointer}, s{pointer}" for pointer in pointers)
    calls = "\n    ".join(f"{name}_{i}({given}, kept);" for i in range(len(pieces)))
    size = 1 + max(max(last, default=0) for last in writes)
    return "".join(functions) + (
        f"static void {name}({', '.join(arguments)}) {{\n    real kept[{size} * LANES];\n    {calls}\n}}\n"
    )


def _truth(register: int, truths: set[int]) -> str:
    """A register as a truth value."""
    return f"w{register}" if register in truths else f"(w{register} != 0 ? (real)1 : (real)0)"


def _note(those: set[int], register: int, holds: bool) -> None:
    (those.add if holds else those.discard)(register)


def _literal(value: float) -> str:
    """A number as C."""
    text = {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}.get(repr(float(value)), repr(float(value)))
    return f"(real){text}"
