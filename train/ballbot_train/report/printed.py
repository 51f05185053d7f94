"""Prints functions as JavaScript and as C: whatever `ballbot_gym` writes with `ops` runs in browsers and on robots too, from
the same lines.

CasADi traces a function into a list of elementary instructions, and each instruction becomes a line. JavaScript computes in
double precision, and the C code in single precision.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

import casadi
import numpy as np

from ballbot_gym.codegen import OPERATIONS
from ballbot_gym.tasks.symmetry import Frame

_SHARED = {
    **OPERATIONS,
    casadi.OP_NOT: "{0} ? 0 : 1",
    casadi.OP_AND: "{0} && {1} ? 1 : 0",
    casadi.OP_OR: "{0} || {1} ? 1 : 0",
    casadi.OP_IF_ELSE_ZERO: "{0} ? {1} : 0",
    casadi.OP_POW: "real_pow({0}, {1})",
    casadi.OP_CONSTPOW: "real_pow({0}, {1})",
    casadi.OP_ATAN2: "real_atan2({0}, {1})",
    casadi.OP_ASIN: "real_asin({0})",
    casadi.OP_SIGN: "({0} > 0 ? 1 : {0} < 0 ? -1 : 0)",
    casadi.OP_FMIN: "real_fmin({0}, {1})",
    casadi.OP_FMAX: "real_fmax({0}, {1})",
}
"""Operations of CasADi in C and JavaScript alike, but for the names of the functions."""


Functions = dict[str, tuple[Callable[..., Any], Mapping[str, int]]]
"""Functions of CasADi columns with the sizes of their arguments, by name."""


def frame_functions(frame: Frame, features: Callable[..., Any], observations: int, seen: int) -> Functions:
    """What a policy in a frame computes beside its networks.

    Args:
        frame: the frame.
        features: from what the policy sees, a tuple, to features and the way back, as of `Frame`.
        observations: numbers of an observation.
        seen: numbers that the policy sees, the sides of a route among them.
    """
    split, route = casadi.vertsplit, frame.route
    functions: Functions = {
        "features": (lambda o: features(tuple(split(o)))[0], {"o": seen}),
        "back": (lambda o, a: features(tuple(split(o)))[1]((a[0], a[1])), {"o": seen, "a": 2}),
    }
    if route is not None:
        functions["layout"] = (lambda o: route.layout(tuple(split(o))), {"o": observations})
        functions["chosen_sides"] = (
            lambda o, farther: route.sides(tuple(split(o)), tuple(split(farther))),
            {"o": observations, "farther": route.obstacles},
        )
    return functions


def javascript_function(name: str, function: Callable[..., Any], arguments: Mapping[str, int]) -> str:
    """A JavaScript function that computes what a Python function computes.

    Args:
        name: of the JavaScript function.
        function: takes CasADi columns; returns a column, a number or a tuple of numbers.
        arguments: the name and the size of each argument.

    Returns:
        Its source. It takes arrays of numbers, and returns an array of numbers.

    Raises:
        ValueError: the function uses an operation that cannot be printed.
    """
    lines, returned = _printed(name, function, arguments, r"Math.\1", _number)
    body = "\n".join(f"  const {line};" for line in lines)
    return f"function {name}({', '.join(arguments)}) {{\n{body}\n  return [{', '.join(returned)}];\n}}\n"


def c_function(name: str, function: Callable[..., Any], arguments: Mapping[str, int], real: str = "float") -> str:
    """A C99 function in single precision, or in that of another type; arguments and errors as `javascript_function`.

    Returns:
        Its source. It takes pointers to numbers, and another one, `out`, to where its results go, which are no argument's.
    """
    single = real == "float"
    lines, returned = _printed(name, function, arguments, r"\1f" if single else r"\1", c_number if single else _number)
    takes = ", ".join(f"const {real} *{argument}" for argument in arguments)
    body = [f"const {real} {line};" for line in lines]
    body += [f"(void){argument};" for argument in arguments]  # whether it is used or not
    body += [f"out[{i}] = {value};" for i, value in enumerate(returned)]
    return f"static void {name}({takes}, {real} *out)\n{{\n    " + "\n    ".join(body) + "\n}\n"


def c_number(value: float) -> str:
    """A number as C, rounded to single precision."""
    text = str(np.float32(value))
    text = {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}.get(text, f"{text}f")
    return f"({text})" if text.startswith("-") else text


def _number(value: float) -> str:
    return repr(value) if value >= 0 else f"({value!r})"


def _printed(
    name: str,
    function: Callable[..., Any],
    arguments: Mapping[str, int],
    call: str,
    number: Callable[[float], str],
) -> tuple[list[str], list[str]]:
    """The lines `variable = expression` of a function, and its results.

    Args:
        name: of the function, for errors.
        function: as of `javascript_function`.
        arguments: as of `javascript_function`.
        call: what a function of the language is called, as a replacement by `re` of the name in C.
        number: a constant in the language.
    """
    inputs = [casadi.SX.sym(argument, size) for argument, size in arguments.items()]
    found = function(*inputs)
    parts = found if isinstance(found, tuple) else (found,)
    traced = casadi.Function(name, inputs, [casadi.densify(casadi.vertcat(*parts))], {"cse": True})
    names = list(arguments)
    lines, values, returned = (
        [],
        {},
        ["0"] * traced.size1_out(0),
    )  # values: what each place of the work vector holds now
    for k in range(traced.n_instructions()):
        operation, takes, gives = traced.instruction_id(k), traced.instruction_input(k), traced.instruction_output(k)
        if operation == casadi.OP_OUTPUT:
            returned[gives[1]] = values[takes[0]]
        elif operation == casadi.OP_INPUT:
            values[gives[0]] = f"{names[takes[0]]}[{takes[1]}]"
        elif operation == casadi.OP_CONST:
            values[gives[0]] = number(traced.instruction_constant(k))
        elif operation not in _SHARED:
            raise ValueError(f"{name}: the CasADi operation {operation} cannot be printed")
        else:
            form = re.sub(r"real_(\w+)", call, _SHARED[operation].replace("(real)", ""))
            form = form.replace("Math.f", "Math.")  # of fabs, fmin and fmax
            lines.append(f"t{k} = {form.format(*(values[place] for place in takes))}")
            values[gives[0]] = f"t{k}"
    return lines, returned
