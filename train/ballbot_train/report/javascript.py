"""Prints functions as JavaScript: whatever `ballbot_gym` writes with `ops` runs in a browser too, from the same lines.

CasADi traces a function into a list of elementary instructions, and each instruction becomes a line of JavaScript. Both
compute in double precision.
"""

from collections.abc import Callable, Mapping
from typing import Any

import casadi

_BINARY = {
    casadi.OP_ADD: "{} + {}",
    casadi.OP_SUB: "{} - {}",
    casadi.OP_MUL: "{} * {}",
    casadi.OP_DIV: "{} / {}",
    casadi.OP_LT: "{} < {} ? 1 : 0",
    casadi.OP_LE: "{} <= {} ? 1 : 0",
    casadi.OP_EQ: "{} === {} ? 1 : 0",
    casadi.OP_NE: "{} !== {} ? 1 : 0",
    casadi.OP_AND: "{} && {} ? 1 : 0",
    casadi.OP_OR: "{} || {} ? 1 : 0",
    casadi.OP_IF_ELSE_ZERO: "{} ? {} : 0",
    casadi.OP_POW: "Math.pow({}, {})",
    casadi.OP_CONSTPOW: "Math.pow({}, {})",
    casadi.OP_ATAN2: "Math.atan2({}, {})",
    casadi.OP_FMIN: "Math.min({}, {})",
    casadi.OP_FMAX: "Math.max({}, {})",
}
_UNARY = {
    casadi.OP_ASSIGN: "{}",
    casadi.OP_NEG: "-{}",
    casadi.OP_SQ: "{0} * {0}",
    casadi.OP_TWICE: "2 * {}",
    casadi.OP_INV: "1 / {}",
    casadi.OP_NOT: "{} ? 0 : 1",
    casadi.OP_SQRT: "Math.sqrt({})",
    casadi.OP_EXP: "Math.exp({})",
    casadi.OP_LOG: "Math.log({})",
    casadi.OP_SIN: "Math.sin({})",
    casadi.OP_COS: "Math.cos({})",
    casadi.OP_TAN: "Math.tan({})",
    casadi.OP_ASIN: "Math.asin({})",
    casadi.OP_ACOS: "Math.acos({})",
    casadi.OP_ATAN: "Math.atan({})",
    casadi.OP_FABS: "Math.abs({})",
    casadi.OP_SIGN: "Math.sign({})",
}


def javascript_function(name: str, function: Callable[..., Any], arguments: Mapping[str, int]) -> str:
    """A JavaScript function that computes what a Python function computes.

    Args:
        name: of the JavaScript function.
        function: takes CasADi columns; returns a column, a number or a tuple of numbers.
        arguments: the name and the size of each argument.

    Returns:
        Its source. It takes arrays of numbers, and returns an array of numbers.

    Raises:
        ValueError: the function uses an operation that has no JavaScript here.
    """
    inputs = [casadi.SX.sym(argument, size) for argument, size in arguments.items()]
    found = function(*inputs)
    parts = found if isinstance(found, tuple) else (found,)
    column = casadi.densify(casadi.vertcat(*parts))
    return _printed(name, list(arguments), casadi.Function(name, inputs, [column], {"cse": True}))


def _printed(name: str, arguments: list[str], traced: casadi.Function) -> str:
    lines, names, returned = (
        [],
        {},
        ["0"] * traced.size1_out(0),
    )  # names: of what each place of the work vector holds now
    for k in range(traced.n_instructions()):
        operation, takes, gives = traced.instruction_id(k), traced.instruction_input(k), traced.instruction_output(k)
        if operation == casadi.OP_OUTPUT:
            returned[gives[1]] = names[takes[0]]
        elif operation == casadi.OP_INPUT:
            names[gives[0]] = f"{arguments[takes[0]]}[{takes[1]}]"
        elif operation == casadi.OP_CONST:
            value = traced.instruction_constant(k)
            names[gives[0]] = repr(value) if value >= 0 else f"({value!r})"
        else:
            template = _BINARY.get(operation) or _UNARY.get(operation)
            if template is None:
                raise ValueError(f"{name}: the CasADi operation {operation} has no JavaScript")
            value = template.format(*(names[place] for place in takes))
            names[gives[0]] = f"t{k}"
            lines.append(f"  const t{k} = {value};")
    body = "\n".join(lines)
    return f"function {name}({', '.join(arguments)}) {{\n{body}\n  return [{', '.join(returned)}];\n}}\n"
