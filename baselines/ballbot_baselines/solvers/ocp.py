"""Staged optimal-control problems, and their solution by CasADi's fatrop or ipopt.

    minimize    Σ_{k<N} cost(s_k, w_k, p) + final_cost(s_N, p)
    subject to  s_{k+1} = next(s_k, w_k, p)
                path_k(s_k, w_k, p) = 0 or ≥ 0,   final_path(s_N, p) = 0 or ≥ 0,   initial_matrix s_0 = 0
                bounds on s_k and w_k

Every problem of this package has this form: shooting on the env's discretization, and Hermite–Simpson collocation with
the next knot as input. `nlp.py` builds the nonlinear program and its derivatives from stage functions, which are compiled
once (`compiled.py`). So time and memory grow linearly with N.
"""

import functools
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import casadi
import numpy as np

from ballbot_baselines.solvers.nlp import StagedNlp, Stages

StageFunction = Callable[[casadi.SX, casadi.SX, casadi.SX], casadi.SX]
FinalFunction = Callable[[casadi.SX, casadi.SX], casadi.SX]

FEASIBLE = 1e-6
"""Largest constraint violation of a solution, in SI units."""
SUCCEEDED = "Solve_Succeeded"
"""The status of a solver that met its tolerance."""
ACCEPTABLE = "Solved_To_Acceptable_Level"
"""The status of ipopt where it stopped early, at its acceptable tolerance."""


def _no_path(*arguments: casadi.SX) -> casadi.SX:
    """No constraint."""
    return casadi.SX(0, 1)


@dataclass(frozen=True)
class Ocp:
    """The functions of a staged problem; horizon, bounds and guess come with `OcpSolver` and its `solve`."""

    name: str
    states: int
    inputs: int
    params: int
    next: StageFunction
    """(s, w, p) -> (states,) the next states; with `rk4_steps` the rates of the states, whose time is 1."""
    cost: StageFunction
    """(s, w, p) -> scalar."""
    equalities: StageFunction = _no_path
    """(s, w, p) -> (ne,), each 0."""
    inequalities: StageFunction = _no_path
    """(s, w, p) -> (ni,), each ≥ 0."""
    final_cost: FinalFunction = lambda s, p: casadi.SX(0)
    """(s, p) -> scalar."""
    final_equalities: FinalFunction = _no_path
    """(s, p) -> (me,), each 0."""
    final_inequalities: FinalFunction = _no_path
    """(s, p) -> (mi,), each ≥ 0."""
    counts_stages: bool = False
    """Whether p of every function has one entry more, at its end: the stage's number k, and N at the end."""
    rk4_steps: int = 0
    """How many RK4 steps integrate the rates; 0 where `next` gives the next states."""
    initial_matrix: np.ndarray | None = None
    """(mo, states): linear equalities between the components of s_0, as periodic problems have."""

    @functools.cached_property
    def stages(self) -> Stages:
        """The stage functions with their derivatives, made once for solvers of every horizon."""
        params = self.params + self.counts_stages
        s, w, p = (casadi.SX.sym(*symbol) for symbol in (("s", self.states), ("w", self.inputs), ("p", params)))
        return Stages(
            self.name,
            (s, w, p),
            (casadi.SX(self.next(s, w, p)), self.rk4_steps),
            running=(self.cost(s, w, p), self.equalities(s, w, p), self.inequalities(s, w, p)),
            final=(self.final_cost(s, p), self.final_equalities(s, p), self.final_inequalities(s, p)),
            params=self.params,
            initial_matrix=np.zeros((0, self.states)) if self.initial_matrix is None else self.initial_matrix,
        )

    def no_bounds(self, intervals: int) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds (N+1, ns + nw) of [s_k, w_k] to be filled in; the last inputs do not exist."""
        infinite = np.full((intervals + 1, self.states + self.inputs), np.inf)
        return -infinite, infinite


@dataclass(frozen=True)
class Solution:
    """What a solver returned. Look at `success` before anything else.

    `success` means that the solver met its tolerance; ipopt's "Solved_To_Acceptable_Level" does not. `states` is (N+1, ns)
    and `inputs` is (N, nw). `violation` is the largest amount by which a constraint or bound is missed, in the constraint's
    unit. Row k of `slopes` (N+1, ns) is the slope, with respect to s_k, of the optimal cost
    from stage k on. It follows from the multipliers of the dynamics, and row 0 from those of the given initial state.
    """

    success: bool
    status: str
    cost: float
    states: np.ndarray
    inputs: np.ndarray
    violation: float
    iterations: int
    solver: str
    slopes: np.ndarray

    @property
    def is_within_limits(self) -> bool:
        """Whether it is within `FEASIBLE` of every constraint, converged or not."""
        return bool(self.violation < FEASIBLE and np.isfinite(self.cost))

    @property
    def is_optimal(self) -> bool:
        """Whether the solver converged to a solution within `FEASIBLE` of every constraint."""
        return self.success and self.is_within_limits


class OcpSolver:
    """An `Ocp` over N intervals, ready to be solved from many starts.

    Building it differentiates and, on first use on a machine, compiles; solving does neither.
    """

    def __init__(
        self,
        ocp: Ocp,
        intervals: int,
        solver: str = "fatrop",
        tolerance: float = 1e-8,
        max_iterations: int = 200,
        barrier: float = 0.1,
    ):
        """Makes the solver.

        Args:
            ocp: the problem.
            intervals: N.
            solver: "fatrop" (structured, fast) or "ipopt" (more robust far from a solution).
            tolerance: of the solver.
            max_iterations: after which it gives up.
            barrier: the interior-point method's barrier parameter at the start. From near a solution, less takes fewer
                iterations.
        """
        self.ocp, self.intervals, self.solver = ocp, intervals, solver
        stages = ocp.stages
        paths, finals = stages.running.size - 1, stages.final.size - 1
        nlp = StagedNlp(stages, intervals)
        self._g_lower, self._g_upper = np.zeros(len(nlp.equal)), np.where(nlp.equal, 0.0, np.inf)
        oracle, derivatives, for_ipopt = nlp.functions()
        self._gaps = nlp.gaps
        options: dict = {"print_time": False, "error_on_fail": False, "calc_lam_p": False, "cache": derivatives}
        own = {"print_level": 0, "tol": tolerance, "max_iter": max_iterations, "mu_init": barrier}
        if solver == "fatrop":
            options |= {
                "structure_detection": "manual",
                "N": intervals,
                "nx": [ocp.states] * (intervals + 1),
                "nu": [ocp.inputs] * intervals + [0],
                "ng": [paths + len(stages.initial_matrix)] + [paths] * (intervals - 1) + [finals],
                "equality": nlp.equal.tolist(),
                "fatrop": own,
            }
        else:
            options |= for_ipopt | {"ipopt": own | {"sb": "yes"}}
        self._nlpsol = casadi.nlpsol("ocp", solver, oracle, options)
        self._g = derivatives["nlp_g"]

    def solve(
        self,
        states: np.ndarray,
        inputs: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        p: np.ndarray | Sequence[float] = (),
    ) -> Solution:
        """Solves from a guess.

        Args:
            states: (N+1, ns) guess.
            inputs: (N, nw) guess.
            lower: bounds, same as in `Ocp.no_bounds`. Equal bounds fix a variable, for example the initial state.
            upper: as `lower`.
            p: (np,) parameters.

        Returns:
            The last iterate with the solver's status; `success` says whether it converged.
        """
        p = np.asarray(p, np.float64)
        lower, upper = (bound.ravel()[: -self.ocp.inputs] for bound in (lower, upper))
        guess = np.concatenate([np.hstack([states[:-1], inputs]).ravel(), states[-1]])
        with _interrupts_kept():
            result = self._nlpsol(
                x0=np.clip(guess, lower, upper),
                p=p,
                lbx=lower,
                ubx=upper,
                lbg=self._g_lower,
                ubg=self._g_upper,
            )
        stats = self._nlpsol.stats()
        status = _status(self.solver, stats)
        z = np.array(result["x"]).ravel()
        g = np.array(self._g(z, p)).ravel()
        with np.errstate(all="ignore"):  # an iterate that diverged may have overflown
            violation = max(
                np.max(np.maximum(self._g_lower - g, g - self._g_upper), initial=0.0),
                np.max(np.maximum(lower - z, z - upper), initial=0.0),
            )
        ns, width = self.ocp.states, self.ocp.states + self.ocp.inputs
        stages = z[: self.intervals * width].reshape(self.intervals, width)
        return Solution(
            success=bool(stats["success"] and status == SUCCEEDED and np.isfinite(z).all()),
            status=status,
            cost=float(result["f"]),
            states=np.vstack([stages[:, :ns], z[self.intervals * width :]]),
            inputs=stages[:, ns:].copy(),
            violation=float(violation),
            iterations=int(stats["iter_count"]),
            solver=self.solver,
            # Gaps are s_{k+1} − next_k. Slopes with respect to bounds and right-hand sides are minus the multipliers.
            slopes=-np.vstack([np.array(result["lam_x"])[:ns].T, np.array(result["lam_g"]).ravel()[self._gaps]]),
        )


def _status(solver: str, stats: dict) -> str:
    if solver == "ipopt":
        return str(stats["return_status"])
    return SUCCEEDED if stats["success"] else f"fatrop stopped ({stats['unified_return_status']})"


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Raises a KeyboardInterrupt at the end of the block if one came within it.

    CasADi prints it and continues, so that a command would not end and an interrupted search would look like a failed one.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    raised: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in handlers.items() if callable(handler)}

    def on_signal(number: int, frame: object) -> None:
        try:
            before[signal.Signals(number)](number, frame)  # pyright: ignore[reportArgumentType]
        except KeyboardInterrupt:
            raised.append(number)
            raise

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if raised:
            raise KeyboardInterrupt
