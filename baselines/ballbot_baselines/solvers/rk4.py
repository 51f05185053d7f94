"""RK4 steps and their derivatives as machine code: only the rates and their derivatives are printed.

Written out, two steps and their derivatives have 28,000 operations, which a compiler needs eight seconds for.
"""

from collections.abc import Sequence

import casadi

from ballbot_baselines.solvers import compiled
from ballbot_baselines.solvers.compiled import LANES, SIMD
from ballbot_gym import machine_code
from ballbot_gym.machine_code import codegen


def in_lanes(
    name: str, rates: casadi.Function, steps: int, jacobian_at: casadi.Sparsity, hessian_at: casadi.Sparsity
) -> tuple[casadi.Function, ...] | None:
    """The steps of `LANES` stages at once, a column each, as machine code; None where they cannot be compiled.

    Args:
        name: what the library is called, for humans who look into the cache.
        rates: (z, p) -> the rates of the first entries of z, dense columns; the other entries are held.
        steps: number of RK4 steps over a time of 1.
        jacobian_at, hessian_at: where the derivatives of the steps have entries.

    Returns:
        `value`, `jacobian` and `hessian`, as a stage of `nlp` has them.

    Raises:
        ValueError: $BALLBOT_CACHE is no absolute path.
    """
    library = f"{name}-lanes"

    def source() -> str:
        # printing takes longer than solving; files that print are part of what determines the code
        problem = LANES, steps, rates.serialize(), *(codegen.text(name, __file__) for name in ("rk4.py", "rk4.c"))
        return machine_code.printed(library, problem, (), lambda: _source(rates, steps, jacobian_at, hessian_at))

    try:
        return compiled._loaded(library, source, ("value", "jacobian", "hessian"), SIMD)
    except NotImplementedError:  # an operation that only CasADi can write as C
        return None


def _source(rates: casadi.Function, steps: int, jacobian_at: casadi.Sparsity, hessian_at: casadi.Sparsity) -> str:
    states, width, params = rates.size1_out(0), rates.size1_in(0), rates.size1_in(1)
    z, p, weights = (casadi.SX.sym(*symbol) for symbol in (("z", width), ("p", params), ("l", states)))
    rate = rates(z, p)
    slopes, curves = casadi.jacobian(rate, z), casadi.hessian(casadi.dot(weights, rate), z)[0]
    moved = casadi.SX.sym("moved", jacobian_at)
    of_place = casadi.vertcat(moved, casadi.SX.eye(width)[states:, :])
    changed = casadi.project(casadi.mtimes(slopes, of_place), jacobian_at)
    upper = casadi.triu(casadi.DM(hessian_at, 1)).sparsity()
    bent = casadi.project(casadi.triu(of_place.T @ curves @ of_place), upper)
    back = casadi.densify(slopes[:, :states].T @ weights)
    at, given = [("at", casadi.vertsplit(z))], [("p", casadi.vertsplit(p))]
    by_place, by_weights = [("moved", _entries(moved))], [("weights", casadi.vertsplit(weights))]
    blocks = [
        codegen.block("rates", [*at, *given], [("rate", _entries(rate))]),
        codegen.block("change", [*at, *by_place, *given], [("rate", _entries(rate)), ("changed", _entries(changed))]),
        codegen.block(
            "bend", [*at, *by_place, *given, *by_weights], [("bent", _entries(bent)), ("back", _entries(back))]
        ),
        codegen.block("weigh", [*by_place, *by_weights], [("gradient", _entries(casadi.densify(moved.T @ weights)))]),
    ]
    numbers = {(i, j): k for k, (i, j) in enumerate(zip(*upper.get_triplet(), strict=True))}
    bent_at = [numbers[min(entry), max(entry)] for entry in zip(*hessian_at.get_triplet(), strict=True)]
    same = [int(i == j) for i, j in zip(*jacobian_at.get_triplet(), strict=True)]
    sizes = {"STATES": states, "WIDTH": width, "MOVED": len(same), "BENT": len(numbers), "HESSIAN": len(bent_at)}
    parts = [
        f"static const real same[] = {{{', '.join(map(str, same))}}};",
        f"static const int bent_at[] = {{{', '.join(map(str, [*bent_at, 0]))}}};",  # no array of C is empty
        *blocks,
        codegen.text("rk4.c", __file__),
    ]
    read = {"z": width, "p": params}
    functions = {
        "value": (read, {"next": states}),
        "jacobian": (read, {"next": states, "moved": len(same)}),
        "hessian": (read | {"l": states}, {"gradient": width, "entries": len(bent_at)}),
    }
    return codegen.externals({"LANES": LANES, "STEPS": steps, **sizes}, parts, functions)


def _entries(part: casadi.SX) -> Sequence[casadi.SX]:
    return casadi.vertsplit(part.nz[:])
