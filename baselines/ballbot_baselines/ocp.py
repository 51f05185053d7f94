"""Staged optimal-control problems, and their solution by CasADi's fatrop or ipopt.

    minimize    Σ_{k<N} cost(s_k, w_k, p) + final_cost(s_N, p)
    subject to  s_{k+1} = next(s_k, w_k, p)
                path_k(s_k, w_k, p) = 0 or ≥ 0,   final_path(s_N, p) = 0 or ≥ 0,   initial_matrix s_0 = 0
                bounds on s_k and w_k

Every problem of this package has this form: shooting on the env's discretization, and Hermite–Simpson collocation with
the next knot as input. The solvers see only stage functions and their derivatives, compiled once (`compiled.py`), so time
and memory grow linearly with N.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi
import numpy as np
import scipy.linalg
import scipy.sparse

from ballbot_baselines.compiled import compiled

StageFunction = Callable[[casadi.SX, casadi.SX, casadi.SX], casadi.SX]
FinalFunction = Callable[[casadi.SX, casadi.SX], casadi.SX]

_DAMPING = 1e-8  # of the Newton step toward consistency, where constraints repeat each other or have nothing to move


@dataclass(frozen=True)
class Ocp:
    """The functions of a staged problem; horizon, bounds and guess come with `OcpSolver` and its `solve`."""

    name: str
    states: int
    inputs: int
    params: int
    next: StageFunction
    """(s, w, p) -> (states,)."""
    cost: StageFunction
    """(s, w, p) -> scalar."""
    equalities: StageFunction | None = None
    """(s, w, p) -> (ne,), each 0."""
    inequalities: StageFunction | None = None
    """(s, w, p) -> (ni,), each ≥ 0."""
    final_cost: FinalFunction | None = None
    """(s, p) -> scalar."""
    final_equalities: FinalFunction | None = None
    """(s, p) -> (me,), each 0."""
    final_inequalities: FinalFunction | None = None
    """(s, p) -> (mi,), each ≥ 0."""
    initial_matrix: np.ndarray | None = None
    """(mo, states): linear equalities between the components of s_0, as periodic problems have."""


@dataclass(frozen=True)
class Bounds:
    """Lower and upper bounds: states (N+1, ns) and inputs (N, nw); ±inf where there is none."""

    state_lower: np.ndarray
    state_upper: np.ndarray
    input_lower: np.ndarray
    input_upper: np.ndarray

    @classmethod
    def free(cls, ocp: Ocp, intervals: int) -> "Bounds":
        """No bounds, to be filled in."""
        states, inputs = (intervals + 1, ocp.states), (intervals, ocp.inputs)
        return cls(np.full(states, -np.inf), np.full(states, np.inf), np.full(inputs, -np.inf), np.full(inputs, np.inf))


@dataclass(frozen=True)
class OcpSolution:
    """What a solver returned. Look at `success` before anything else.

    `states` is (N+1, ns), `inputs` (N, nw), `violation` the largest amount by which a constraint or bound is missed, in
    the constraint's unit, and `seconds` the wall time of this solve. `costates` (N, ns) are the slopes of the optimal cost
    with respect to s_1 … s_N, had the episode begun there: the multipliers of the dynamics.
    """

    success: bool
    status: str
    cost: float
    states: np.ndarray
    inputs: np.ndarray
    violation: float
    iterations: int
    seconds: float
    solver: str
    costates: np.ndarray


class _Stage:
    """A vector function of z and p with its Jacobian's and its Lagrangian Hessian's nonzeros, compiled.

    Where it does not depend on p it takes none of it: so problems whose parameters differ share their compiled dynamics.
    """

    def __init__(self, name: str, z: casadi.SX, p: casadi.SX, out: casadi.SX, compile: bool):
        p = p if casadi.depends_on(out, p) else casadi.SX.sym("p", 0)
        self.params = p.shape[0]
        multipliers = casadi.SX.sym("l", out.shape[0])
        jacobian = casadi.jacobian(out, z)
        hessian, gradient = casadi.hessian(casadi.dot(multipliers, out), z)
        options = {"cse": True}
        functions = (
            casadi.Function("value", [z, p], [out], options),
            casadi.Function("jacobian", [z, p], [out, _nonzeros(jacobian)], options),
            casadi.Function("hessian", [z, p, multipliers], [casadi.densify(gradient), _nonzeros(hessian)], options),
        )
        self.value, self.jacobian, self.hessian = compiled(name, functions) if compile else functions
        self.size = out.shape[0]
        self.jacobian_at = _triplets(jacobian)
        self.hessian_at = _triplets(hessian)


class OcpSolver:
    """An `Ocp` over N intervals, ready to be solved from many starts.

    Building it differentiates and, on first use on a machine, compiles; solving does neither.
    """

    def __init__(
        self, ocp: Ocp, intervals: int, solver: str = "fatrop", tolerance: float = 1e-8, max_iterations: int = 200
    ):
        """Args: solver is "fatrop" (structured, fast) or "ipopt" (more robust far from a solution)."""
        self.ocp, self.intervals, self.solver = ocp, intervals, solver
        s, w, p = (
            casadi.SX.sym("s", ocp.states),
            casadi.SX.sym("w", ocp.inputs),
            casadi.SX.sym("p", ocp.params),
        )
        z = casadi.vertcat(s, w)
        equal = [] if ocp.equalities is None else [ocp.equalities(s, w, p)]
        unequal = [] if ocp.inequalities is None else [ocp.inequalities(s, w, p)]
        final_equal = [] if ocp.final_equalities is None else [ocp.final_equalities(s, p)]
        final_unequal = [] if ocp.final_inequalities is None else [ocp.final_inequalities(s, p)]
        final_cost = 0 if ocp.final_cost is None else ocp.final_cost(s, p)
        path, final_path = casadi.vertcat(*equal, *unequal), casadi.vertcat(*final_equal, *final_unequal)
        dynamics = _Stage("dynamics", z, p, casadi.densify(casadi.SX(ocp.next(s, w, p))), compile=True)
        running = _Stage(ocp.name, z, p, casadi.densify(casadi.vertcat(ocp.cost(s, w, p), path)), compile=True)
        final = _Stage(f"{ocp.name}-final", s, p, casadi.densify(casadi.vertcat(final_cost, final_path)), compile=False)

        paths, finals = path.shape[0], final_path.shape[0]
        equal_paths, equal_finals = (casadi.vertcat(*part).shape[0] if part else 0 for part in (equal, final_equal))
        initials = 0 if ocp.initial_matrix is None else len(ocp.initial_matrix)
        stage_equal = [True] * (ocp.states + equal_paths) + [False] * (paths - equal_paths)
        equality = (
            stage_equal
            + [True] * initials
            + stage_equal * (intervals - 1)
            + [True] * equal_finals
            + [False] * (finals - equal_finals)
        )
        self._rows, self._initials = ocp.states + paths, initials
        self._g_lower = np.zeros(len(equality))
        self._g_upper = np.where(equality, 0.0, np.inf)

        functions = _nlp_functions(ocp, intervals, dynamics, running, final, paths)
        oracle = casadi.Function(
            "nlp",
            [functions["x"], functions["p"]],
            [functions["f"], functions["g"]],
            ["x", "p"],
            ["f", "g"],
        )
        options: dict = {"print_time": False, "error_on_fail": False, "calc_lam_p": False, "cache": functions["cache"]}
        if solver == "fatrop":
            options |= {
                "structure_detection": "manual",
                "N": intervals,
                "nx": [ocp.states] * (intervals + 1),
                "nu": [ocp.inputs] * intervals + [0],
                "ng": [paths + initials] + [paths] * (intervals - 1) + [finals],
                "equality": equality,
                "fatrop": {"print_level": 0, "tol": tolerance, "max_iter": max_iterations},
            }
        else:
            options |= {
                "grad_f": functions["ipopt_grad_f"],
                "jac_g": functions["cache"]["nlp_jac_g"],
                "hess_lag": functions["ipopt_hess_lag"],
                "ipopt": {"print_level": 0, "sb": "yes", "tol": tolerance, "max_iter": max_iterations},
            }
        self._nlpsol = casadi.nlpsol("ocp", solver, oracle, options)
        self._g, self._jac_g = functions["cache"]["nlp_g"], functions["cache"]["nlp_jac_g"]

    def solve(self, states: np.ndarray, inputs: np.ndarray, bounds: Bounds, p: np.ndarray | tuple = ()) -> OcpSolution:
        """Solves from a guess.

        Args:
            states: (N+1, ns) guess.
            inputs: (N, nw) guess.
            bounds: equal lower and upper bounds fix a variable, as the initial state's.
            p: (np,) parameters.

        Returns:
            The last iterate with the solver's status; `success` says whether it converged.
        """
        p = np.asarray(p, np.float64)
        lower = _interleave(bounds.state_lower, bounds.input_lower)
        upper = _interleave(bounds.state_upper, bounds.input_upper)
        start = time.perf_counter()
        result = self._nlpsol(
            x0=np.clip(_interleave(states, inputs), lower, upper),
            p=p,
            lbx=lower,
            ubx=upper,
            lbg=self._g_lower,
            ubg=self._g_upper,
        )
        seconds = time.perf_counter() - start
        stats = self._nlpsol.stats()
        z = np.array(result["x"]).ravel()
        g = np.array(self._g(z, p)).ravel()
        violation = max(
            np.max(np.maximum(self._g_lower - g, g - self._g_upper), initial=0.0),
            np.max(np.maximum(lower - z, z - upper), initial=0.0),
        )
        states, inputs = self._divide(z)
        return OcpSolution(
            success=bool(stats["success"]) and np.isfinite(z).all(),
            status=_status(self.solver, stats),
            cost=float(result["f"]),
            states=states,
            inputs=inputs,
            violation=float(violation),
            iterations=int(stats["iter_count"]),
            seconds=seconds,
            solver=self.solver,
            costates=self._costates(np.array(result["lam_g"]).ravel()),
        )

    def toward_consistency(
        self, states: np.ndarray, inputs: np.ndarray, bounds: Bounds, p: np.ndarray | tuple = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """A guess moved by the shortest Newton step toward all equality constraints, the dynamics first of all.

        For guesses that are consistent with nothing, as a straight line between two states: the step bends them into about
        the nearest motion. Guesses that obey the constraints stay where they are. The step takes about as long as one or two
        iterations.

        Args:
            states: as `solve` takes them.
            inputs: as `solve` takes them.
            p: as `solve` takes them.
            bounds: variables whose bounds are equal do not move from them; the others end within theirs.

        Returns:
            states (N+1, ns) and inputs (N, nw).
        """
        lower = _interleave(bounds.state_lower, bounds.input_lower)
        upper = _interleave(bounds.state_upper, bounds.input_upper)
        z = np.clip(_interleave(states, inputs), lower, upper)
        g, jacobian = self._jac_g(z, np.asarray(p, np.float64))
        matrix, equal = jacobian.sparse(), self._g_upper == 0
        matrix.data *= np.repeat(lower < upper, np.diff(matrix.indptr))
        step = _least_norm(matrix.tocsr()[equal], -np.array(g).ravel()[equal])
        if np.isfinite(step).all():
            z = np.clip(z + step, lower, upper)
        return self._divide(z)

    def _divide(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ns, width = self.ocp.states, self.ocp.states + self.ocp.inputs
        stages = z[: self.intervals * width].reshape(self.intervals, width)
        return np.vstack([stages[:, :ns], z[self.intervals * width :]]), stages[:, ns:].copy()

    def _costates(self, multipliers: np.ndarray) -> np.ndarray:
        # Constraints are s_{k+1} − next_k = 0: raising their right-hand side moves s_{k+1}, and costs minus the multiplier.
        first = self._rows + self._initials + self._rows * np.arange(-1, self.intervals - 1)
        first[0] = 0
        return -multipliers[first[:, None] + np.arange(self.ocp.states)]


def _nlp_functions(ocp: Ocp, n: int, dynamics: _Stage, running: _Stage, final: _Stage, paths: int) -> dict[str, object]:
    """The NLP and its derivatives, written as maps of the stage functions over the stages.

    Variables are ordered s_0, w_0, s_1, … s_N, constraints next_0, path_0, initial, next_1, … final_path, as fatrop wants
    them.
    """
    ns, width = ocp.states, ocp.states + ocp.inputs
    rows = ns + paths
    initial = np.zeros((0, ns)) if ocp.initial_matrix is None else ocp.initial_matrix
    constraints = n * rows + len(initial) + final.size - 1
    variables = n * width + ns
    z, p = casadi.MX.sym("z", variables), casadi.MX.sym("p", ocp.params)
    stages = casadi.reshape(z[: n * width], width, n)
    last = z[n * width :]
    next_states = casadi.horzcat(stages[:ns, 1:], last)
    p_all = casadi.repmat(p, 1, n)

    value_c = running.value.map(n)(stages, p_all[: running.params, :])
    value_f = final.value(last, p[: final.params])
    f = casadi.sum2(value_c[0, :]) + value_f[0]
    gaps = next_states - dynamics.value.map(n)(stages, p_all[: dynamics.params, :])
    stage_g = casadi.vertcat(gaps, value_c[1:, :])
    initial_g = casadi.mtimes(casadi.DM(initial), stages[:ns, 0])
    g = casadi.vertcat(stage_g[:, 0], initial_g, casadi.vec(stage_g[:, 1:]), value_f[1:, :])

    jac_d = dynamics.jacobian.map(n)(stages, p_all[: dynamics.params, :])[1]
    jac_c = running.jacobian.map(n)(stages, p_all[: running.params, :])[1]
    jac_f = final.jacobian(last, p[: final.params])[1]
    k = np.arange(n)[:, None]
    first_row = k * rows + len(initial) * (k > 0)
    final_row = n * rows + len(initial)
    initial_row, initial_col = np.nonzero(initial)
    (row_d, col_d), (row_c, col_c), (row_f, col_f) = dynamics.jacobian_at, running.jacobian_at, final.jacobian_at
    is_cost, is_final_cost = row_c == 0, row_f == 0

    # ∂f: row 0 of the running and the final Jacobians
    gradient = _scatter(
        [(k * width + col_c)[:, is_cost].ravel(), n * width + col_f[is_final_cost]],
        [np.zeros(n * is_cost.sum(), int), np.zeros(is_final_cost.sum(), int)],
        casadi.vertcat(_rows(jac_c, is_cost), _rows(jac_f, is_final_cost)),
        (variables, 1),
    )
    # ∂g: −∂next, +1 on the next state, the path rows, the final rows
    jacobian = _scatter(
        [
            (first_row + row_d).ravel(),
            (first_row + np.arange(ns)).ravel(),
            (first_row + ns - 1 + row_c)[:, ~is_cost].ravel(),
            rows + initial_row,
            final_row - 1 + row_f[~is_final_cost],
        ],
        [
            (k * width + col_d).ravel(),
            ((k + 1) * width + np.arange(ns)).ravel(),
            (k * width + col_c)[:, ~is_cost].ravel(),
            initial_col,
            n * width + col_f[~is_final_cost],
        ],
        casadi.vertcat(
            -casadi.vec(jac_d),
            casadi.MX.ones(n * ns),
            _rows(jac_c, ~is_cost),
            casadi.MX(casadi.DM(initial[initial_row, initial_col])),
            _rows(jac_f, ~is_final_cost),
        ),
        (constraints, variables),
    )

    lam_f, lam_g = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", constraints)
    lam_initial = lam_g[rows : rows + len(initial)]
    lam_stages = casadi.reshape(casadi.vertcat(lam_g[:rows], lam_g[rows + len(initial) : final_row]), rows, n)
    lam_next = lam_stages[:ns, :]
    grad_d, hess_d = dynamics.hessian.map(n)(stages, p_all[: dynamics.params, :], -lam_next)
    grad_c, hess_c = running.hessian.map(n)(
        stages, p_all[: running.params, :], casadi.vertcat(casadi.repmat(lam_f, 1, n), lam_stages[ns:, :])
    )
    grad_f, hess_f = final.hessian(last, p[: final.params], casadi.vertcat(lam_f, lam_g[final_row:]))
    of_initial = casadi.mtimes(casadi.DM(initial.T), lam_initial)
    shifted = casadi.vertcat(casadi.horzcat(of_initial, lam_next[:, :-1]), casadi.MX.zeros(ocp.inputs, n))
    grad_lagrangian = casadi.vertcat(casadi.vec(grad_d + grad_c + shifted), grad_f + lam_next[:, -1])
    hessian = _scatter(
        [
            (k * width + dynamics.hessian_at[0]).ravel(),
            (k * width + running.hessian_at[0]).ravel(),
            n * width + final.hessian_at[0],
        ],
        [
            (k * width + dynamics.hessian_at[1]).ravel(),
            (k * width + running.hessian_at[1]).ravel(),
            n * width + final.hessian_at[1],
        ],
        casadi.vertcat(casadi.vec(hess_d), casadi.vec(hess_c), hess_f),
        (variables, variables),
    )
    multipliers = [z, p, lam_f, lam_g]
    names = ["x", "p", "lam_f", "lam_g"]
    cache = {
        "nlp_f": casadi.Function("nlp_f", [z, p], [f], ["x", "p"], ["f"]),
        "nlp_g": casadi.Function("nlp_g", [z, p], [g], ["x", "p"], ["g"]),
        "nlp_grad_f": casadi.Function("nlp_grad_f", [z, p], [casadi.densify(gradient)], ["x", "p"], ["grad_f_x"]),
        # Of the parameters' multipliers nobody asks (calc_lam_p is off), but the signature has them.
        "nlp_grad": casadi.Function(
            "nlp_grad",
            multipliers,
            [f, g, lam_f * casadi.densify(gradient) + casadi.mtimes(jacobian.T, lam_g), casadi.MX(p.shape[0], 1)],
            names,
            ["f", "g", "grad_gamma_x", "grad_gamma_p"],
        ),
        "nlp_jac_g": casadi.Function("nlp_jac_g", [z, p], [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
        "nlp_hess_l": casadi.Function(
            "nlp_hess_l", multipliers, [grad_lagrangian, hessian], names, ["grad_gamma_x", "hess_gamma_x_x"]
        ),
    }
    return {
        "x": z,
        "p": p,
        "f": f,
        "g": g,
        "cache": cache,
        "ipopt_grad_f": casadi.Function(
            "nlp_grad_f", [z, p], [f, casadi.densify(gradient)], ["x", "p"], ["f", "grad_f_x"]
        ),
        "ipopt_hess_lag": casadi.Function(
            "nlp_hess_l", multipliers, [casadi.triu(hessian)], names, ["triu_hess_gamma_x_x"]
        ),
    }


def _scatter(rows: list[np.ndarray], cols: list[np.ndarray], values: casadi.MX, shape: tuple[int, int]) -> casadi.MX:
    """A sparse matrix from triplets whose values add up where they meet."""
    row, col = np.concatenate(rows), np.concatenate(cols)
    order = np.lexsort((row, col))
    place = col[order] * shape[0] + row[order]
    first = np.flatnonzero(np.diff(place, prepend=-1))
    pattern = casadi.Sparsity.triplet(*shape, row[order[first]].tolist(), col[order[first]].tolist())
    # the matrix that sums the (at most two) sources of every entry
    target = np.searchsorted(place[first], col * shape[0] + row)
    if len(first) == len(place):
        entries = values[order.tolist()]
    else:
        gather = casadi.Sparsity.triplet(len(first), len(place), target.tolist(), list(range(len(place))))
        entries = casadi.mtimes(casadi.MX(casadi.DM(gather, 1.0)), values)
    return casadi.MX(pattern, entries)


def _rows(matrix: casadi.MX, keep: np.ndarray) -> casadi.MX:
    """The rows to keep, column after column, as one column."""
    return casadi.vec(matrix[np.flatnonzero(keep).tolist(), :]) if keep.any() else casadi.MX(0, 1)


def _nonzeros(matrix: casadi.SX) -> casadi.SX:
    return casadi.vertcat(*matrix.nonzeros()) if matrix.nnz() else casadi.SX(0, 1)


def _triplets(matrix: casadi.SX) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = matrix.sparsity().get_triplet()
    return np.array(rows, int), np.array(cols, int)


def _least_norm(matrix: scipy.sparse.csr_array, right: np.ndarray) -> np.ndarray:
    """The shortest v with matrix v = right, but for `_DAMPING`; stage-wise rows make matrix·matrixᵀ a band."""
    normal = (matrix @ matrix.T).tocoo()
    below = normal.row >= normal.col
    row, col, values = normal.row[below], normal.col[below], normal.data[below]
    band = np.zeros((1 + np.max(row - col, initial=0), len(right)))
    band[row - col, col] = values
    band[0] += _DAMPING
    return matrix.T @ scipy.linalg.solveh_banded(band, right, lower=True)


def _interleave(states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """(N+1, ns) and (N, nw) as s_0, w_0, s_1, … s_N."""
    return np.concatenate([np.hstack([states[:-1], inputs]).ravel(), states[-1]])


def _status(solver: str, stats: dict) -> str:
    if solver == "ipopt":
        return str(stats["return_status"])
    return "Solve_Succeeded" if stats["success"] else f"fatrop stopped ({stats['unified_return_status']})"
