"""Functions of one stage of a problem, and their derivatives.

Of RK4 steps, only the rates and their derivatives are printed as C, and loops apply the chain rule. Written out, two steps
and their derivatives have 28,000 operations, which a compiler needs eight seconds for.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import casadi
import numpy as np

from ballbot_baselines.solvers import compiled
from ballbot_baselines.solvers.compiled import LANES, SIMD, in_lanes
from ballbot_gym import machine_code
from ballbot_gym.machine_code import codegen
from ballbot_gym.robot import Robot

_SHORT = 300  # operations of rates, whose steps are interpreted faster written out; for longer ones that takes seconds


class Stage:
    """A vector function out(z, p) of one stage, with the nonzeros of its Jacobian and of its Lagrangian's Hessian.

    A function takes the parameters up to the last one that it depends on. So problems that differ only in the others share
    their compiled dynamics. With `of_stages` the functions are compiled, and compute `LANES` stages at once, a column each.

    | attribute | meaning |
    |---|---|
    | `value` | (z, p) -> out |
    | `jacobian` | (z, p) -> out, nonzeros of ∂out/∂z in the order of `jacobian_at` |
    | `hessian` | (z, p, l) -> gradient of lᵀout, nonzeros of its Hessian in the order of `hessian_at` |
    | `jacobian_at`, `hessian_at` | sparsity patterns |
    | `size`, `width`, `params` | lengths of out, of z, and of the p that is taken |
    """

    def __init__(self, name: str, z: Any, p: Any, out: Any, of_stages: bool, order: int = 2):
        """Differentiates and compiles the function.

        Args:
            name: what the compiled functions are called, for humans who look into the cache.
            z, p, out: symbols and an expression, of CasADi's SX, or MX where stages are not compiled.
            of_stages: see above.
            order: of the derivatives that are called; with 1 there is no `hessian`.
        """
        p = self.taken(p, out)
        options, jacobian = {"cse": True}, casadi.jacobian(out, z)
        functions = [
            casadi.Function("value", [z, p], [out], options),
            casadi.Function("jacobian", [z, p], [out, _nonzeros(jacobian)], options),
        ]
        self._patterns = [jacobian.sparsity()]
        if order > 1:
            multipliers = type(out).sym("l", out.shape[0])
            hessian, gradient = casadi.hessian(casadi.dot(multipliers, out), z)
            self._patterns.append(hessian.sparsity())
            results = casadi.densify(gradient), _nonzeros(hessian)
            functions.append(casadi.Function("hessian", [z, p, multipliers], results, options))
        self._functions = in_lanes(name, tuple(functions)) if of_stages else tuple(functions)
        self.size, self.width, self.params = out.shape[0], z.shape[0], p.shape[0]

    @classmethod
    def of_steps(cls, name: str, rates: casadi.Function, steps: int, order: int = 2) -> "Stage":
        """RK4 steps over a time of 1, of `LANES` stages at once.

        Args:
            name, order: as above.
            rates: (z, p) -> the rates of the first entries of z, dense columns; the other entries are held. They depend on
                the last entry of p.
            steps: how many.
        """
        stage = cls(name, *_written_out(rates, steps), of_stages=False, order=order)
        assert stage.params == rates.size1_in(1)
        functions = _steps_in_lanes(name, rates, steps, stage._patterns)
        if functions is None:
            functions = stage._functions
            if rates.n_instructions() < _SHORT:
                functions = tuple(each.expand(each.name(), {"cse": True}) for each in functions)
            functions = tuple(each.map(LANES) for each in functions)
        stage._functions = functions
        return stage

    @staticmethod
    def taken(p: Any, out: Any) -> Any:
        """The parameters p up to the last one that out depends on."""
        used = int(max(np.flatnonzero(casadi.which_depends(out, p, 1)) + 1, default=0))
        return p[:used] if used else type(p).sym("p", 0)

    @property
    def value(self) -> casadi.Function:
        return self._functions[0]

    @property
    def jacobian(self) -> casadi.Function:
        return self._functions[1]

    @property
    def hessian(self) -> casadi.Function:
        return self._functions[2]

    @property
    def jacobian_at(self) -> casadi.Sparsity:
        return self._patterns[0]

    @property
    def hessian_at(self) -> casadi.Sparsity:
        return self._patterns[1]


def _written_out(rates: casadi.Function, steps: int) -> tuple[casadi.MX, casadi.MX, casadi.MX]:
    """Symbols z and p, and the state after the steps as an expression of calls of the rates."""
    states, z, p = rates.size1_out(0), casadi.MX.sym("z", rates.size1_in(0)), casadi.MX.sym("p", rates.size1_in(1))
    x, held = (z[:states],), (z[states:],)  # the state is one component, a column

    def slope(x: tuple[casadi.MX], u: tuple[casadi.MX]) -> tuple[casadi.MX]:
        return (rates(casadi.vertcat(*x, *u), p),)

    for _ in range(steps):
        x = Robot.rk4(slope, x, held, 1 / steps)
    return z, p, x[0]


def _steps_in_lanes(
    name: str, rates: casadi.Function, steps: int, patterns: Sequence[casadi.Sparsity]
) -> tuple[casadi.Function, ...] | None:
    """The functions of RK4 steps as machine code; None where they cannot be compiled.

    `patterns` are those of the derivatives that are wanted.
    """
    library = f"{name}-lanes"

    def source() -> str:
        # printing takes longer than solving; files that print are part of what determines the code
        files = (codegen.text(name, __file__) for name in ("stage.py", "rk4.c"))
        problem = LANES, steps, len(patterns), rates.serialize(), *files
        return machine_code.printed(library, problem, (), lambda: _steps_source(rates, steps, patterns))

    try:
        return compiled._loaded(library, source, ("value", "jacobian", "hessian")[: len(patterns) + 1], SIMD)
    except NotImplementedError:  # an operation that only CasADi can write as C
        return None


def _steps_source(rates: casadi.Function, steps: int, patterns: Sequence[casadi.Sparsity]) -> str:
    states, width, params = rates.size1_out(0), rates.size1_in(0), rates.size1_in(1)
    z, p, weights = (casadi.SX.sym(*symbol) for symbol in (("z", width), ("p", params), ("l", states)))
    rate, moved = rates(z, p), casadi.SX.sym("moved", patterns[0])
    slopes, of_place = casadi.jacobian(rate, z), casadi.vertcat(moved, casadi.SX.eye(width)[states:, :])
    changed = casadi.project(slopes @ of_place, patterns[0])
    same = [int(i == j) for i, j in zip(*patterns[0].get_triplet(), strict=True)]
    parts = [
        _block("rates", [("at", z), ("p", p)], [("rate", rate)]),
        _block("change", [("at", z), ("moved", moved), ("p", p)], [("rate", rate), ("changed", changed)]),
        f"static const real same[] = {{{', '.join(map(str, same))}}};",
    ]
    sizes = {"LANES": LANES, "STEPS": steps, "STATES": states, "WIDTH": width, "MOVED": len(same)}
    read = {"z": width, "p": params}
    functions = {"value": (read, {"next": states}), "jacobian": (read, {"next": states, "moved": len(same)})}
    if len(patterns) > 1:
        upper = casadi.triu(casadi.DM(patterns[1], 1)).sparsity()
        bent = casadi.triu(of_place.T @ casadi.hessian(casadi.dot(weights, rate), z)[0] @ of_place)
        back, gradient = slopes[:, :states].T @ weights, moved.T @ weights
        given = [("at", z), ("moved", moved), ("p", p), ("weights", weights)]
        numbers = {(i, j): k for k, (i, j) in enumerate(zip(*upper.get_triplet(), strict=True))}
        bent_at = [numbers[min(entry), max(entry)] for entry in zip(*patterns[1].get_triplet(), strict=True)]
        parts += [
            _block("bend", given, [("bent", casadi.project(bent, upper)), ("back", casadi.densify(back))]),
            _block("weigh", [given[1], given[3]], [("gradient", casadi.densify(gradient))]),
            f"static const int bent_at[] = {{{', '.join(map(str, [*bent_at, 0]))}}};",  # no array of C is empty
        ]
        sizes |= {"BENT": len(numbers), "HESSIAN": len(bent_at)}
        functions["hessian"] = (read | {"l": states}, {"gradient": width, "entries": len(bent_at)})
    return codegen.externals(sizes, [*parts, codegen.text("rk4.c", __file__)], functions)


def _block(name: str, *sides: Iterable[tuple[str, casadi.SX]]) -> str:
    inputs, outputs = ([(pointer, casadi.vertsplit(part.nz[:])) for pointer, part in side] for side in sides)
    return codegen.block(name, inputs, outputs)


def _nonzeros(matrix: Any) -> Any:
    # CasADi's type stubs do not know that vertcat takes scalar expressions.
    return casadi.vertcat(*matrix.nonzeros()) if matrix.nnz() else casadi.SX(0, 1)  # pyright: ignore[reportCallIssue, reportArgumentType]
