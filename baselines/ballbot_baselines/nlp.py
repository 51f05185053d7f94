"""A staged problem as one nonlinear program, with the Jacobian and the Hessian that its solvers need.

    minimize    f(z) = Σ_{k<N} cost(s_k, w_k, p) + final_cost(s_N, p)
    subject to  g(z) = 0 or ≥ 0

Everything is a map of stage functions over the stages. `Stage` differentiates the functions of one stage, and `StagedNlp`
puts the nonzeros of all stages in their places.

Variables z:

| columns | variables |
|---|---|
| k·(ns + nw) … | s_k (ns,), then w_k (nw,), for k < N |
| N·(ns + nw) … | s_N (ns,) |

Constraints g, in the order that fatrop needs:

| rows | constraints |
|---|---|
| 0 … | s_1 − next(s_0, w_0, p) (ns,), then path_0 |
| ns + paths … | initial_matrix s_0 |
| then, for 0 < k < N | s_{k+1} − next(s_k, w_k, p) (ns,), then path_k |
| at the end | final_path(s_N, p) |
"""

import casadi
import numpy as np

from ballbot_baselines.compiled import LANES, SIMD, compiled, in_lanes


class Stage:
    """A vector function out(z, p) of one stage, with the nonzeros of its Jacobian and of its Lagrangian's Hessian.

    A function takes the parameters up to the last one that it depends on. So problems that differ only in the others share
    their compiled dynamics. With `of_stages` the functions are compiled, and compute `LANES` stages at once, a column each.

    | attribute | meaning |
    |---|---|
    | `value` | (z, p) -> out |
    | `jacobian` | (z, p) -> out, nonzeros of ∂out/∂z in the order of `jacobian_at` |
    | `hessian` | (z, p, l) -> gradient of lᵀout, nonzeros of its Hessian in the order of `hessian_at` |
    | `jacobian_at`, `hessian_at` | row and column of each nonzero |
    | `size`, `width`, `params` | lengths of out, of z, and of the p that is taken |
    """

    def __init__(
        self, name: str, z: casadi.SX, p: casadi.SX, out: casadi.SX, of_stages: bool, flags: tuple[str, ...] = SIMD
    ):
        used = max(np.flatnonzero(casadi.which_depends(out, p, 1)) + 1, default=0)
        p = p[:used] if used else casadi.SX.sym("p", 0)
        multipliers = casadi.SX.sym("l", out.shape[0])
        jacobian = casadi.jacobian(out, z)
        hessian, gradient = casadi.hessian(casadi.dot(multipliers, out), z)
        options = {"cse": True}
        functions = (
            casadi.Function("value", [z, p], [out], options),
            casadi.Function("jacobian", [z, p], [out, _nonzeros(jacobian)], options),
            casadi.Function("hessian", [z, p, multipliers], [casadi.densify(gradient), _nonzeros(hessian)], options),
        )
        self.value, self.jacobian, self.hessian = in_lanes(name, functions, flags=flags) if of_stages else functions
        self.size, self.width, self.params = out.shape[0], z.shape[0], p.shape[0]
        self.jacobian_at = _triplets(jacobian)
        self.hessian_at = _triplets(hessian)


_AHEAD, _SHARE = (0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)
"""Of RK4's four evaluations: how far ahead in a step, and the share of their rates in it."""


class RatesStage(Stage):
    """A stage whose result is the state after RK4 steps of given rates, for rates of so many operations that the steps and
    their derivatives, written out, would take minutes to compile.

    The chain rule is applied to the derivatives of the rates, which are functions of their own.
    """

    def __init__(self, z: casadi.SX, p: casadi.SX, rates: casadi.SX, steps: int):
        n, width = rates.shape[0], z.shape[0]
        used = max(np.flatnonzero(casadi.which_depends(rates, p, 1)) + 1, default=0)
        p, weights = p[:used], casadi.SX.sym("l", n)
        slopes, curve = casadi.jacobian(rates, z), casadi.hessian(casadi.dot(weights, rates), z)[0]
        first = casadi.Function("rates_jacobian", [z, p], [rates, casadi.densify(slopes)], {"cse": True})
        second = casadi.Function("rates_hessian", [z, p, weights], [casadi.densify(curve)], {"cse": True})

        z_all, p_all, l_all = (casadi.MX.sym("zpl"[i], part.shape[0]) for i, part in enumerate((z, p, weights)))
        x, w, h = z_all[:n], z_all[n:], 1 / steps
        inputs = casadi.DM.eye(width)[n:, :]
        moved = casadi.MX(casadi.densify(casadi.DM.eye(width)[:n, :]))  # ∂x/∂z
        stages = []  # where rates are evaluated, ∂ of that place/∂z, and ∂rates/∂place
        for _ in range(steps):
            rate, change, end, ends = casadi.MX(n, 1), casadi.MX(n, width), x, moved
            for ahead, share in zip(_AHEAD, _SHARE, strict=True):
                at = casadi.vertcat(x + h * ahead * rate, w)
                moves = casadi.densify(casadi.vertcat(moved + h * ahead * change, inputs))
                rate, slope = first(at, p_all)
                change = slope @ moves
                stages.append((at, moves, slope))
                end, ends = end + h * share * rate, ends + h * share * change
            x, moved = end, ends
        price, total = l_all, casadi.MX.zeros(width, width)
        for step in reversed(range(steps)):
            before, behind = price, casadi.MX(n, 1)
            for i in reversed(range(4)):
                at, moves, slope = stages[4 * step + i]
                of_rate = h * _SHARE[i] * price + behind
                total += moves.T @ (second(at, p_all, of_rate) @ moves)
                back = (of_rate.T @ slope)[:, :n].T
                before, behind = before + back, h * _AHEAD[i] * back
            price = before
        functions = (
            casadi.Function("value", [z_all, p_all], [x]),
            casadi.Function("jacobian", [z_all, p_all], [x, casadi.vec(moved)]),
            casadi.Function("hessian", [z_all, p_all, l_all], [(l_all.T @ moved).T, casadi.vec(total)]),
        )
        self.value, self.jacobian, self.hessian = (function.map(LANES) for function in compiled("dynamics", functions))
        self.size, self.width, self.params = n, width, used
        self.jacobian_at, self.hessian_at = (_triplets(casadi.SX.ones(rows, width)) for rows in (n, width))


class StagedNlp:
    """The nonlinear program of N intervals as CasADi expressions of z, p and the multipliers lam_f and lam_g."""

    def __init__(
        self, dynamics: Stage, running: Stage, final: Stage, intervals: int, params: int, initial_matrix: np.ndarray
    ):
        """Makes the symbols.

        Args:
            dynamics: next state of [s, w].
            running: [cost, path] of [s, w].
            final: [final_cost, final_path] of s.
            intervals: N.
            params: length of p.
            initial_matrix: (mo, ns).
        """
        self._dynamics, self._running, self._final, self._initial = dynamics, running, final, initial_matrix
        self._n, self._states, self._width = intervals, dynamics.size, dynamics.width
        self._rows = self._states + running.size - 1  # of the constraints of a stage
        initials = len(initial_matrix)
        stages = np.arange(intervals)[:, None]
        self._first_column = stages * self._width
        self._first_row = stages * self._rows + initials * (stages > 0)
        self._final_column, self._final_row = intervals * self._width, intervals * self._rows + initials
        self._variables, self._constraints = self._final_column + self._states, self._final_row + final.size - 1

        self.z, self.p = casadi.MX.sym("z", self._variables), casadi.MX.sym("p", params)
        self.lam_f, self.lam_g = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", self._constraints)
        self._stages = casadi.reshape(self.z[: self._final_column], self._width, intervals)
        self._last = self.z[self._final_column :]
        # stage functions take of these what they depend on, which may be the stage's number
        numbers = casadi.MX(casadi.DM(np.arange(intervals)[None]))
        self._p_all = casadi.vertcat(casadi.repmat(self.p, 1, intervals), numbers)
        self._p_last = casadi.vertcat(self.p, intervals)

    def functions(self) -> tuple[casadi.Function, dict[str, casadi.Function], dict[str, casadi.Function]]:
        """The program and its derivatives under the names that CasADi's solvers look for.

        Returns:
            The program; its derivatives for the solver option "cache", which fatrop reads; and the options that hand the
            same derivatives to ipopt.
        """
        z, p, lam_f, lam_g = self.z, self.p, self.lam_f, self.lam_g
        f, g = self.values()
        gradient, jacobian = casadi.densify(self.gradient()), self.jacobian()
        lagrangian_gradient, hessian = self.lagrangian_derivatives()
        inputs, names = [z, p, lam_f, lam_g], ["x", "p", "lam_f", "lam_g"]
        full_gradient = lam_f * gradient + casadi.mtimes(jacobian.T, lam_g)
        no_gradient = casadi.MX(p.shape[0], 1)  # with respect to p: the signature has it, but calc_lam_p is off
        cache = {
            "nlp_f": casadi.Function("nlp_f", [z, p], [f], ["x", "p"], ["f"]),
            "nlp_g": casadi.Function("nlp_g", [z, p], [g], ["x", "p"], ["g"]),
            "nlp_grad_f": casadi.Function("nlp_grad_f", [z, p], [gradient], ["x", "p"], ["grad_f_x"]),
            "nlp_grad": casadi.Function(
                "nlp_grad",
                inputs,
                [f, g, full_gradient, no_gradient],
                names,
                ["f", "g", "grad_gamma_x", "grad_gamma_p"],
            ),
            "nlp_jac_g": casadi.Function("nlp_jac_g", [z, p], [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
            "nlp_hess_l": casadi.Function(
                "nlp_hess_l", inputs, [lagrangian_gradient, hessian], names, ["grad_gamma_x", "hess_gamma_x_x"]
            ),
        }
        ipopt = {
            "grad_f": casadi.Function("nlp_grad_f", [z, p], [f, gradient], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": cache["nlp_jac_g"],
            "hess_lag": casadi.Function("nlp_hess_l", inputs, [casadi.triu(hessian)], names, ["triu_hess_gamma_x_x"]),
        }
        return casadi.Function("nlp", [z, p], [f, g], ["x", "p"], ["f", "g"]), cache, ipopt

    def values(self) -> tuple[casadi.MX, casadi.MX]:
        """The objective f, and the constraints g in the order that this module's table gives."""
        (running,) = self._over_stages(self._running, self._running.value)
        final = self._final.value(self._last, self._p_of(self._final))
        f = casadi.sum2(running[0, :]) + final[0]
        next_states = casadi.horzcat(self._stages[: self._states, 1:], self._last)
        (reached,) = self._over_stages(self._dynamics, self._dynamics.value)
        gaps = next_states - reached
        stage_g = casadi.vertcat(gaps, running[1:, :])
        initial_g = casadi.mtimes(casadi.DM(self._initial), self._stages[: self._states, 0])
        return f, casadi.vertcat(stage_g[:, 0], initial_g, casadi.vec(stage_g[:, 1:]), final[1:, :])

    def gradient(self) -> casadi.MX:
        """∂f/∂z, sparse.

        Nonzeros: row 0 of every stage's Jacobian of [cost, path], then row 0 of the last stage's.
        """
        running, final = self._stage_jacobians(self._running), self._final_jacobian()
        (row, col), (final_row, final_col) = self._running.jacobian_at, self._final.jacobian_at
        is_cost, is_final_cost = row == 0, final_row == 0
        variable = self._first_column + col[is_cost]
        final_variable = self._final_column + final_col[is_final_cost]
        places = [(variable, np.zeros_like(variable)), (final_variable, np.zeros_like(final_variable))]
        values = casadi.vertcat(_rows(running, is_cost), _rows(final, is_final_cost))
        return _scatter(places, values, (self._variables, 1))

    def jacobian(self) -> casadi.MX:
        """∂g/∂z, sparse.

        Nonzeros, one block after the other: −∂next/∂[s_k, w_k] of every stage, +1 for the s_{k+1} of every stage, the path
        rows of every stage, the initial matrix, and the final path rows.
        """
        running, final = self._stage_jacobians(self._running), self._final_jacobian()
        next_row, next_col = self._dynamics.jacobian_at
        row, col = self._running.jacobian_at
        final_row, final_col = self._final.jacobian_at
        initial_row, initial_col = np.nonzero(self._initial)
        is_path, is_final_path = row > 0, final_row > 0
        component = np.arange(self._states)
        # Row 0 of [cost, path] is no constraint, so path rows start one row earlier.
        places = [
            (self._first_row + next_row, self._first_column + next_col),
            (self._first_row + component, self._first_column + self._width + component),
            (self._first_row + self._states - 1 + row[is_path], self._first_column + col[is_path]),
            (self._rows + initial_row, initial_col),
            (self._final_row - 1 + final_row[is_final_path], self._final_column + final_col[is_final_path]),
        ]
        values = casadi.vertcat(
            -casadi.vec(self._stage_jacobians(self._dynamics)),
            casadi.MX.ones(self._n * self._states),
            _rows(running, is_path),
            casadi.MX(casadi.DM(self._initial[initial_row, initial_col])),
            _rows(final, is_final_path),
        )
        return _scatter(places, values, (self._constraints, self._variables))

    def lagrangian_derivatives(self) -> tuple[casadi.MX, casadi.MX]:
        """Gradient (dense) and Hessian (sparse) of lam_f·f + lam_gᵀg with respect to z.

        Nonzeros of the Hessian: that of the dynamics of every stage, that of [cost, path] of every stage, and that of
        [final_cost, final_path]. The first two share places, and add up there.
        """
        lam_initial, lam_stages, lam_final = self._divided_multipliers()
        lam_next, lam_path = lam_stages[: self._states, :], lam_stages[self._states :, :]
        gradient_next, hessian_next = self._over_stages(self._dynamics, self._dynamics.hessian, -lam_next)
        lam_running = casadi.vertcat(casadi.repmat(self.lam_f, 1, self._n), lam_path)
        gradient, hessian = self._over_stages(self._running, self._running.hessian, lam_running)
        final_gradient, final_hessian = self._final.hessian(
            self._last, self._p_of(self._final), casadi.vertcat(self.lam_f, lam_final)
        )
        # s_k is also the next state of stage k − 1, and s_0 is in the initial rows.
        of_states = casadi.horzcat(casadi.mtimes(casadi.DM(self._initial.T), lam_initial), lam_next[:, :-1])
        of_inputs = casadi.MX.zeros(self._width - self._states, self._n)
        stage_gradients = gradient_next + gradient + casadi.vertcat(of_states, of_inputs)
        full_gradient = casadi.vertcat(casadi.vec(stage_gradients), final_gradient + lam_next[:, -1])
        places = [
            tuple(self._first_column + at for at in self._dynamics.hessian_at),
            tuple(self._first_column + at for at in self._running.hessian_at),
            tuple(self._final_column + at for at in self._final.hessian_at),
        ]
        values = casadi.vertcat(casadi.vec(hessian_next), casadi.vec(hessian), final_hessian)
        return full_gradient, _scatter(places, values, (self._variables, self._variables))

    def _divided_multipliers(self) -> tuple[casadi.MX, casadi.MX, casadi.MX]:
        """lam_g of the initial rows (mo,), of the stages' rows (rows, N), and of the final rows."""
        rows, after_initial = self._rows, self._rows + len(self._initial)
        of_stages = casadi.vertcat(self.lam_g[:rows], self.lam_g[after_initial : self._final_row])
        return self.lam_g[rows:after_initial], casadi.reshape(of_stages, rows, self._n), self.lam_g[self._final_row :]

    def _stage_jacobians(self, stage: Stage) -> casadi.MX:
        """(nonzeros, N)"""
        return self._over_stages(stage, stage.jacobian)[1]

    def _final_jacobian(self) -> casadi.MX:
        """(nonzeros,)"""
        return self._final.jacobian(self._last, self._p_of(self._final))[1]

    def _over_stages(self, stage: Stage, function: casadi.Function, *multipliers: casadi.MX) -> list[casadi.MX]:
        """Results of all stages, a column each. The last block of stages is filled up with the last stage."""
        blocks = -(-self._n // LANES)
        last = [self._n - 1] * (blocks * LANES - self._n)
        columns = [*range(self._n), *last]
        given = (self._stages, self._p_all[: stage.params, :], *multipliers)
        results = function.map(blocks).call([part[:, columns] if last else part for part in given])
        return [part[:, : self._n] if last else part for part in results]

    def _p_of(self, stage: Stage) -> casadi.MX:
        return self._p_last[: stage.params]


def _scatter(places: list[tuple[np.ndarray, ...]], values: casadi.MX, shape: tuple[int, int]) -> casadi.MX:
    """A sparse matrix from the rows and columns of its values. Values with the same place (at most two) add up."""
    row, col = (np.concatenate([np.ravel(part[i]) for part in places]) for i in (0, 1))
    order = np.lexsort((row, col))
    place = col[order] * shape[0] + row[order]
    first = np.flatnonzero(np.diff(place, prepend=-1))
    pattern = casadi.Sparsity.triplet(*shape, row[order[first]].tolist(), col[order[first]].tolist())
    if len(first) == len(place):
        entries = values[order.tolist()]
    else:
        target = np.searchsorted(place[first], col * shape[0] + row)
        add_up = casadi.Sparsity.triplet(len(first), len(place), target.tolist(), list(range(len(place))))
        entries = casadi.mtimes(casadi.MX(casadi.DM(add_up, 1.0)), values)
    return casadi.MX(pattern, entries)


def _rows(nonzeros: casadi.MX, keep: np.ndarray) -> casadi.MX:
    """The nonzeros to keep, stage after stage, as one column."""
    return casadi.vec(nonzeros[np.flatnonzero(keep).tolist(), :]) if keep.any() else casadi.MX(0, 1)


def _nonzeros(matrix: casadi.SX) -> casadi.SX:
    # CasADi's type stubs do not know that vertcat takes scalar expressions.
    return casadi.vertcat(*matrix.nonzeros()) if matrix.nnz() else casadi.SX(0, 1)  # pyright: ignore[reportCallIssue, reportArgumentType]


def _triplets(matrix: casadi.SX) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = matrix.sparsity().get_triplet()
    return np.array(rows, int), np.array(cols, int)
