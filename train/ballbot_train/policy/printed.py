"""Prints functions as JavaScript and as C: whatever `ballbot_gym` writes with `ops`, and what policies compute around their
networks, runs in browsers and on robots too, from the same lines.

CasADi traces a function into a list of elementary instructions, and each instruction becomes a line. JavaScript computes in
double precision, and the C code in single precision.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ballbot_gym.lazy import imports_of
from ballbot_gym.machine_code.codegen import OPERATIONS
from ballbot_gym.tasks.symmetry import REACH
from ballbot_train.policy.network import PolicyNetwork

with imports_of(__name__):
    import casadi

_SHARED = {
    **OPERATIONS,
    casadi.OP_NOT: "{0} ? 0 : 1",
    casadi.OP_AND: "{0} && {1} ? 1 : 0",
    casadi.OP_OR: "{0} || {1} ? 1 : 0",
    casadi.OP_IF_ELSE_ZERO: "{0} ? {1} : 0",
    casadi.OP_ATAN2: "real_atan2({0}, {1})",
    casadi.OP_ASIN: "real_asin({0})",
    casadi.OP_TANH: "real_tanh({0})",
    casadi.OP_ATANH: "real_atanh({0})",
    casadi.OP_SIGN: "({0} > 0 ? 1 : {0} < 0 ? -1 : 0)",
    casadi.OP_FMIN: "real_fmin({0}, {1})",
    casadi.OP_FMAX: "real_fmax({0}, {1})",
}
"""Operations of CasADi in C and JavaScript alike, but for the names of the functions."""


def policy_function(network: PolicyNetwork) -> Callable[[casadi.SX], casadi.SX]:
    """What a policy computes around its networks, of what it sees: its actions (2,) in [−1, 1], with wheels (3,).

    The networks are calls, from arrays to arrays. `networks[0]` is the sum of the network and the linear part. `networks[1]`
    maps the layout of all obstacles to 1 for each one that is passed on its nearer side, and to −1 for the others.
    """
    spec, split = network.spec, casadi.vertsplit
    reach = REACH if spec.squash == "tanh_in_frame" else 1.0

    def total(inputs: casadi.SX) -> casadi.SX:
        return _network(0, inputs, spec.actions)

    def in_frame(features: tuple[Any, ...]) -> casadi.SX:
        output = total(casadi.vertcat(*features))
        if spec.centred:
            kept, action = network.kept(features)
            needed = casadi.vertcat(*action)
            if spec.squash != "clip":
                needed = casadi.atanh(casadi.fmax(casadi.fmin(needed / reach, 0.999), -0.999))
            output += needed - total(casadi.vertcat(*kept))
        return reach * casadi.tanh(output) if spec.squash == "tanh_in_frame" else output

    def action(o: casadi.SX) -> casadi.SX:
        seen = tuple(split(o))
        if network.routes is not None:
            route = network.routes.route
            farther = _network(1, casadi.vertcat(*route.layout(seen)), route.obstacles)
            seen += route.sides(seen, tuple(split(farther)))
        if spec.frame is not None:
            features, back = network.features(seen)
            output = in_frame(features)
            raw = casadi.vertcat(*back((output[0], output[1])))
        else:
            raw = total(o)
            for signs, own in spec.mirrors:
                raw += casadi.DM(own) * total(casadi.DM([*signs, *(spec.history * (*signs, *own))]) * o)
            raw /= 1 + len(spec.mirrors)
        return casadi.tanh(raw) if spec.squash == "tanh" else casadi.fmax(casadi.fmin(raw, 1), -1)

    return action


def _network(i: int, inputs: casadi.SX, outputs: int) -> casadi.SX:
    """A call that is printed as that of `networks[i]`. An argument holds i."""
    arguments = [casadi.SX.sym("i"), casadi.SX.sym("inputs", inputs.numel())]
    call = casadi.Function("network", arguments, [casadi.SX.zeros(outputs)], {"never_inline": True})
    return call(i, inputs)


def _number(value: float) -> str:
    return repr(value) if value >= 0 else f"({value!r})"


def _c_number(value: float) -> str:
    """A number as C, rounded to single precision."""
    text = str(np.float32(value))
    text = {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}.get(text, f"{text}f")
    return f"({text})" if text.startswith("-") else text


def _javascript(name: str, arguments: Sequence[str], lines: Sequence[str], returned: Sequence[str]) -> str:
    """A JavaScript function. It takes arrays of numbers, and returns an array of numbers."""
    body = "\n  ".join([*lines, f"return [{', '.join(returned)}];"])
    return f"function {name}({', '.join([*arguments, 'networks'])}) {{\n  {body}\n}}\n"


def _c(real: str, name: str, arguments: Sequence[str], lines: Sequence[str], returned: Sequence[str]) -> str:
    """A C99 function. It takes pointers to numbers, and another one, `out`, to where its results go, which are no
    argument's.
    """
    takes = ", ".join(f"const {real} *{argument}" for argument in arguments)
    body = [*lines, *(f"(void){argument};" for argument in arguments)]  # whether it is used or not
    body += [f"out[{i}] = {value};" for i, value in enumerate(returned)]
    return f"static void {name}({takes}, {real} *out)\n{{\n    " + "\n    ".join(body) + "\n}\n"


@dataclass(frozen=True)
class _Language:
    """How a language writes what C and JavaScript write differently."""

    mathematics: Callable[[str], str]
    """A function of mathematics, by its name in C for double precision."""
    number: Callable[[float], str]
    variable: str
    """The line that gives a variable {0} the value {1}."""
    frame: Callable[[str, Sequence[str], Sequence[str], Sequence[str]], str]
    """The function of a name, of arguments, lines and results."""
    network: str = ""
    """The line that gives an array {0} of {1} numbers what network {2} makes of the values {3}."""

    def function(self, name: str, function: Callable[..., Any], arguments: Mapping[str, int]) -> str:
        """The source of a function that computes what a Python function computes.

        Args:
            name: of the function.
            function: takes CasADi columns; returns a column, a number or a tuple of numbers.
            arguments: the name and the size of each argument.

        Raises:
            ValueError: the function uses an operation that cannot be printed.
        """
        inputs = [casadi.SX.sym(argument, size) for argument, size in arguments.items()]
        found = function(*inputs)
        parts = found if isinstance(found, tuple) else (found,)
        traced = casadi.Function(name, inputs, [casadi.densify(casadi.vertcat(*parts))], {"cse": True})
        names, lines = list(arguments), []
        values: dict[int, str] = {}  # what each place of the work vector holds now
        returned = ["0"] * traced.size1_out(0)
        for k in range(traced.n_instructions()):
            operation, takes, gives = (
                traced.instruction_id(k),
                traced.instruction_input(k),
                traced.instruction_output(k),
            )
            if operation == casadi.OP_OUTPUT:
                returned[gives[1]] = values[takes[0]]
            elif operation == casadi.OP_INPUT:
                values[gives[0]] = f"{names[takes[0]]}[{takes[1]}]"
            elif operation == casadi.OP_CONST:
                values[gives[0]] = self.number(traced.instruction_constant(k))
            elif operation == casadi.OP_CALL:
                which, *given = (values[place] for place in takes)
                lines.append(self.network.format(f"t{k}", len(gives), which[0], ", ".join(given)))
                values |= {place: f"t{k}[{i}]" for i, place in enumerate(gives)}
            elif operation not in _SHARED:
                raise ValueError(f"{name}: the CasADi operation {operation} cannot be printed")
            else:
                form = re.sub(r"real_(\w+)", lambda found: self.mathematics(found[1]), _SHARED[operation])
                value = form.replace("(real)", "").format(*(values[place] for place in takes))
                lines.append(self.variable.format(f"t{k}", value))
                values[gives[0]] = f"t{k}"
        return self.frame(name, names, lines, returned)


JAVASCRIPT = _Language(
    lambda name: f"Math.{name.removeprefix('f') if name in ('fabs', 'fmin', 'fmax') else name}",
    _number,
    "const {0} = {1};",
    _javascript,
    "const {0} = networks[{2}]([{3}]);",
)
"""In double precision."""

C = _Language(
    lambda name: {"tanh": "squeezed"}.get(name, f"{name}f"),  # as exact, without branches
    _c_number,
    "const float {0} = {1};",
    partial(_c, "float"),
    "const float {0}_in[] = {{{3}}}; float {0}[{1}]; networks[{2}]({0}_in, {0});",
)
"""C99 in single precision."""

C_IN_DOUBLE = _Language(str, _number, "const double {0} = {1};", partial(_c, "double"))
"""C99 in double precision, without networks."""
