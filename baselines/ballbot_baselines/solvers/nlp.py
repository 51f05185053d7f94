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

import itertools

import casadi
import numpy as np

from ballbot_baselines.solvers.compiled import LANES
from ballbot_baselines.solvers.stage import Stage

_dynamics_made: dict[tuple[str, int], Stage] = {}


class Stages:
    """What a program of any horizon is made of; see `ocp.Ocp`.

    | attribute | meaning |
    |---|---|
    | `dynamics` | the next state of [s, w] |
    | `running` | [cost, equalities, inequalities] of [s, w] |
    | `final` | the same of the end, of s |
    | `equalities`, `final_equalities` | how many there are |
    | `params` | length of p |
    | `initial_matrix` | as in `ocp.Ocp` |
    """

    def __init__(
        self,
        name: str,
        variables: tuple[casadi.SX, casadi.SX, casadi.SX],
        moves: tuple[casadi.SX, int],
        running: tuple[casadi.SX, casadi.SX, casadi.SX],
        final: tuple[casadi.SX, casadi.SX, casadi.SX],
        params: int,
        initial_matrix: np.ndarray,
    ):
        """Differentiates the functions of a stage, and compiles them on first use on a machine.

        Args:
            name: what the compiled functions are called, for humans who look into the cache.
            variables: s, w and p.
            moves: as `motion` takes them.
            running: cost, equalities and inequalities.
            final: the same of the end.
            params: length of p without the number of the stage.
            initial_matrix: as in `ocp.Ocp`.
        """
        s, w, p = variables
        z = casadi.vertcat(s, w)
        costs, final_costs = (casadi.densify(casadi.vertcat(*each)) for each in (running, final))
        self.dynamics = self.motion(z, p, *moves)
        self.running = Stage(name, z, p, costs, of_stages=True)
        self.final = Stage(f"{name}-final", s, p, final_costs, of_stages=False)
        self.equalities, self.final_equalities = running[1].shape[0], final[1].shape[0]
        self.params, self.initial_matrix = params, initial_matrix

    @staticmethod
    def motion(z: casadi.SX, p: casadi.SX, move: casadi.SX, steps: int) -> Stage:
        """The stage of dynamics, shared by problems of the same equations, as those of all tasks of a robot are.

        Args:
            z: states and inputs.
            p: parameters.
            move: the next states; or rates of the states, which RK4 steps integrate over a time of 1.
            steps: the number of these steps, or 0.
        """
        move = casadi.densify(move)
        function = casadi.Function("move", [z, Stage.taken(p, move)], [move], {"cse": True})
        same = function.serialize(), steps
        if same not in _dynamics_made:
            _dynamics_made[same] = (
                Stage.of_steps("dynamics", function, steps) if steps else Stage("dynamics", z, p, move, of_stages=True)
            )
        return _dynamics_made[same]


class StagedNlp:
    """The nonlinear program of N intervals as CasADi expressions of z, p and the multipliers lam_f and lam_g.

    `gaps` (N, ns) are the rows of g that say that stages follow each other. `equal` says which rows are 0, and not ≥ 0.
    """

    def __init__(self, stages: Stages, intervals: int):
        dynamics, running, final = stages.dynamics, stages.running, stages.final
        equalities, final_equalities = stages.equalities, stages.final_equalities
        initial_matrix, params = stages.initial_matrix, stages.params
        self._dynamics, self._running, self._final, self._initial = dynamics, running, final, casadi.DM(initial_matrix)
        self._n, self._states, self._width = n, states, width = intervals, dynamics.size, dynamics.width
        # Results stand kind by kind: gaps of all stages, [cost, path] of all stages and of the end, and initial rows. Those
        # at `_order` are g, and the others add up to f.
        sizes = n * states, n * running.size, final.size, len(initial_matrix)
        self._parts = np.cumsum([0, *sizes]).tolist()
        gaps, of_stages, of_end, of_start = np.split(np.arange(sum(sizes)), self._parts[1:-1])
        first, *others = np.hstack([gaps.reshape(n, states), of_stages.reshape(n, -1)[:, 1:]])
        order = np.concatenate([first, of_start, *others, of_end[1:]])
        is_path = np.tile(np.arange(running.size) > equalities, n), np.arange(final.size) > final_equalities
        self.equal = ~np.concatenate([np.zeros(n * states, bool), *is_path, np.zeros(len(initial_matrix), bool)])[order]
        self._order, self._costs = order.tolist(), [*of_stages[:: running.size].tolist(), int(of_end[0])]
        self._place = np.full(sum(sizes), len(order))  # of each result in [g, f]
        self._place[order] = np.arange(len(order))
        self.gaps = self._place[gaps].reshape(n, states)

        self.z, self.p = casadi.MX.sym("z", n * width + states), casadi.MX.sym("p", params)
        self.lam_f, self.lam_g = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", len(order))
        self._stages, self._last = casadi.reshape(self.z[: n * width], width, n), self.z[n * width :]
        # stage functions take of these what they depend on, which may be the stage's number
        numbers = casadi.MX(casadi.DM(np.arange(n)[None]))
        self._p_all = casadi.vertcat(casadi.repmat(self.p, 1, n), numbers)
        self._p_last = casadi.vertcat(self.p, n)

    def functions(self) -> tuple[casadi.Function, dict[str, casadi.Function], dict[str, casadi.Function]]:
        """The program and its derivatives under the names that CasADi's solvers look for.

        Returns:
            The program; its derivatives for the solver option "cache", which fatrop reads; and the options that hand the
            same derivatives to ipopt.
        """
        z, p, lam_f, lam_g = self.z, self.p, self.lam_f, self.lam_g
        f, g = self.values()
        gradient, jacobian = self.first_derivatives()
        lagrangian_gradient, hessian = self.lagrangian_derivatives()
        inputs, names = [z, p, lam_f, lam_g], ["x", "p", "lam_f", "lam_g"]
        no_gradient = casadi.MX(p.shape[0], 1)  # with respect to p: the signature has it, but calc_lam_p is off
        cache = {
            "nlp_f": casadi.Function("nlp_f", [z, p], [f], ["x", "p"], ["f"]),
            "nlp_g": casadi.Function("nlp_g", [z, p], [g], ["x", "p"], ["g"]),
            "nlp_grad_f": casadi.Function("nlp_grad_f", [z, p], [gradient], ["x", "p"], ["grad_f_x"]),
            "nlp_grad": casadi.Function(
                "nlp_grad",
                inputs,
                [f, g, lam_f * gradient + casadi.mtimes(jacobian.T, lam_g), no_gradient],
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
        (reached,), (running,) = (self._over_stages(each, each.value) for each in (self._dynamics, self._running))
        gaps = casadi.horzcat(self._stages[: self._states, 1:], self._last) - reached
        final = self._final.value(self._last, self._p_of_end)
        initial = casadi.mtimes(self._initial, self._stages[: self._states, 0])
        results = casadi.vertcat(casadi.vec(gaps), casadi.vec(running), final, initial)
        return casadi.sum1(results[self._costs]), results[self._order]

    def first_derivatives(self) -> tuple[casadi.MX, casadi.MX]:
        """∂f/∂z, a dense column, and ∂g/∂z, sparse."""
        n, states, width = self._n, self._states, self._width
        of_stages = (self._over_stages(each, each.jacobian)[1] for each in (self._dynamics, self._running))
        slopes, more = map(casadi.vec, of_stages)
        _, at_end = self._final.jacobian(self._last, self._p_of_end)
        initial = casadi.sparsify(self._initial)
        values = casadi.vertcat(-slopes, casadi.MX.ones(n * states), more, at_end, casadi.DM(initial.nonzeros()))
        # where they stand among the derivatives of all results
        empty, count = casadi.Sparsity, itertools.count(1)
        same, last = casadi.Sparsity.diag(states, width), casadi.Sparsity.diag(states, states)
        numbered = [
            casadi.DM(pattern, list(itertools.islice(count, pattern.nnz())))
            for pattern in (
                casadi.diagcat(*[self._dynamics.jacobian_at] * n, empty(0, states)),
                casadi.horzcat(empty(n * states, width), casadi.diagcat(*[same] * (n - 1), last)),
                casadi.diagcat(*[self._running.jacobian_at] * n, self._final.jacobian_at),
                casadi.horzcat(initial.sparsity(), empty(initial.shape[0], self.z.shape[0] - states)),
            )
        ]
        of_results = casadi.vertcat(numbered[0] + numbered[1], *numbered[2:])

        def gathered(rows: list[int]) -> casadi.MX:
            found = of_results[rows, :]
            return casadi.MX(found.sparsity(), values[[int(number) - 1 for number in found.nonzeros()]])

        return casadi.densify(casadi.sum1(gathered(self._costs)).T), gathered(self._order)

    def lagrangian_derivatives(self) -> tuple[casadi.MX, casadi.MX]:
        """Gradient (dense) and Hessian (sparse) of lam_f·f + lam_gᵀg with respect to z."""
        n, states = self._n, self._states
        multipliers = casadi.vertcat(self.lam_g, self.lam_f)[self._place.tolist()]
        lam_next, lam_running, lam_final, lam_initial = casadi.vertsplit(multipliers, self._parts)
        lam_next = casadi.reshape(lam_next, states, n)
        gradient_next, hessian_next = self._over_stages(self._dynamics, self._dynamics.hessian, -lam_next)
        gradient, hessian = self._over_stages(
            self._running, self._running.hessian, casadi.reshape(lam_running, self._running.size, n)
        )
        final_gradient, final_hessian = self._final.hessian(self._last, self._p_of_end, lam_final)
        # s_k is also the next state of stage k − 1, and s_0 is in the initial rows.
        of_states = casadi.horzcat(casadi.mtimes(self._initial.T, lam_initial), lam_next[:, :-1])
        of_inputs = casadi.MX.zeros(self._width - states, n)
        stage_gradients = gradient_next + gradient + casadi.vertcat(of_states, of_inputs)
        of_stages = (
            casadi.MX(casadi.diagcat(*[each.hessian_at] * n), casadi.vec(nonzeros))
            for each, nonzeros in ((self._dynamics, hessian_next), (self._running, hessian))
        )
        return (
            casadi.vertcat(casadi.vec(stage_gradients), final_gradient + lam_next[:, -1]),
            casadi.diagcat(sum(of_stages), casadi.MX(self._final.hessian_at, final_hessian)),
        )

    def _over_stages(self, stage: Stage, function: casadi.Function, *multipliers: casadi.MX) -> list[casadi.MX]:
        """Results of all stages, a column each. The last block of stages is filled up with the last stage."""
        blocks = -(-self._n // LANES)
        last = [self._n - 1] * (blocks * LANES - self._n)
        columns = [*range(self._n), *last]
        given = (self._stages, self._p_all[: stage.params, :], *multipliers)
        results = function.map(blocks).call([part[:, columns] if last else part for part in given])
        return [part[:, : self._n] if last else part for part in results]

    @property
    def _p_of_end(self) -> casadi.MX:
        return self._p_last[: self._final.params]
