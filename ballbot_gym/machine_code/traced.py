"""Numbers that are computed later: what robot and tasks compute with `ops` for floats, written down as C.

The C code does the operations that Python does, in the same order, in float64, and with the same libm. So it computes the
very bits that Python computes. `codegen` is faster for many robots at once: CasADi simplifies, and compilers may reorder.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

FLAGS = ("-O2", "-ffp-contract=off", "-fno-builtin")
"""Of compilers, which must neither fuse a product and a sum nor join a sine and a cosine."""


class _Number:
    """A float64 that C code will have; a truth value is 1 or 0. Python cannot branch on it."""

    __array_ufunc__ = None  # so that NumPy's floats leave the operators to this class

    def __init__(self, name: str, lines: dict[str, str]):
        """Args: name: its name in C. lines: what C computes, an expression in each line, with the names of the results."""
        self.name, self.lines = name, lines

    def made(self, form: str, *others: Any) -> "_Number":
        """The number that an expression gives of this one, {0}, and of others, {1} and so on."""
        expression = form.format(self.name, *(_name(other) for other in others))
        return _Number(self.lines.setdefault(expression, f"v{len(self.lines)}"), self.lines)

    __hash__: Any = None

    def __bool__(self) -> bool:
        raise TypeError("a traced number is neither true nor false; take ops.where")


def _operation(form: str) -> Callable[..., _Number]:
    return lambda number, *others: number.made(form, *others)


_OPERATORS = {
    "add": "{0} + {1}",
    "radd": "{1} + {0}",
    "sub": "{0} - {1}",
    "rsub": "{1} - {0}",
    "mul": "{0} * {1}",
    "rmul": "{1} * {0}",
    "truediv": "{0} / {1}",
    "rtruediv": "{1} / {0}",
    "pow": "pow({0}, {1})",
    "neg": "-{0}",
    "abs": "fabs({0})",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "gt": "{0} > {1}",
    "ge": "{0} >= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
}
for _name_of, _form in _OPERATORS.items():
    setattr(_Number, f"__{_name_of}__", _operation(_form))

# the functions of `ops` under their names
_FUNCTIONS = ("sin({0})", "cos({0})", "sqrt({0})", "exp({0})", "log({0})", "acos({0})", "atan({0})")
sin, cos, sqrt, exp, log, arccos, arctan = map(_operation, _FUNCTIONS)


def where(condition: _Number, a: Any, b: Any) -> _Number:
    """a where the condition holds, else b."""
    return condition.made("{0} != 0 ? {1} : {2}", a, b)


def minimum(a: _Number, b: Any) -> _Number:
    """The lesser of two numbers."""
    return a.made("{1} < {0} ? {1} : {0}", b)


def maximum(a: _Number, b: Any) -> _Number:
    """The greater of two numbers."""
    return a.made("{1} > {0} ? {1} : {0}", b)


def clip(a: _Number, low: Any, high: Any) -> _Number:
    """The nearest number in [low, high], as max(min(a, high), low)."""
    below = a.made("{1} < {0} ? {1} : {0}", high)
    return below.made("{1} > {0} ? {1} : {0}", low)


def function(name: str, compute: Callable[..., Sequence[Any]], counts: Sequence[int], in_place: bool = False) -> str:
    """C code of a function `void name(double *v)`.

    v[0] becomes 0 if all results are finite, else not a number. The results come next, then the arguments, one after the
    other.

    Args:
        name: what it is called.
        compute: takes tuples of numbers, and gives the results. It uses `ops` for all but arithmetic.
        counts: how many numbers each of these tuples has.
        in_place: whether the results replace the first arguments.

    Raises:
        Exception: any error of a `compute` that cannot compute with a `_Number`.
    """
    lines: dict[str, str] = {}
    given = [_Number(f"a{i}", lines) for i in range(sum(counts))]
    starts = [sum(counts[:i]) for i in range(len(counts))]
    results = compute(*(tuple(given[at : at + count]) for at, count in zip(starts, counts, strict=True)))
    first = 1 if in_place else 1 + len(results)
    names = [_name(result) for result in results]
    body = [f"const double a{i} = v[{first + i}];" for i in range(len(given))]
    body += [f"const double {made} = {expression};" for expression, made in lines.items()]
    body += [f"v[0] = {' + '.join(f'0 * {n}' for n in names)};"]
    body += [f"v[{i}] = {n};" for i, n in enumerate(names, start=1)]
    return f"#include <math.h>\nvoid {name}(double *v) {{\n    " + "\n    ".join(body) + "\n}\n"


def _name(value: Any) -> str:
    """A traced or an ordinary number in C."""
    if isinstance(value, _Number):
        return value.name
    number = float(value)
    if math.isnan(number):
        return "NAN"
    return f"({'-' if number < 0 else ''}INFINITY)" if math.isinf(number) else f"({number.hex()})"
