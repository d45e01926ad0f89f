"""The nonlinear least-squares problem of all steps: built with CasADi, solved with IPOPT.

A problem is a sum of terms; a term is one CasADi function of a few unknowns, mapped over its
observations. What the observations saw are parameters of the compiled solver, so that problems
of one structure (other numbers, other weights) are compiled once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.sparse import csc_array, diags_array

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.signals import held_back_signals, is_waiting

_RANK = 1e-7  # singular values of the scaled Jacobian below this are undetermined directions
_REWEIGHTINGS = 4
_OUTLIER = 4.0  # an observation this many times the median has half its weight
_CONVERGED = 0.01  # change of a weight that no longer matters
_MIN_THRESHOLD = 1e-3  # standard deviations: smaller residuals are rounding
_CACHE_SIZE = 8  # compiled structures: those of one run of the steps, with either criteria
_INTERRUPTED = ("NonIpopt_Exception_Thrown", "User_Requested_Stop")  # return statuses
_OPTIONS: dict[str, bool | int | float | str] = {
    "print_time": False,
    "calc_lam_p": False,
    "no_nlp_grad": True,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.acceptable_tol": 1e-6,  # of a standard deviation: where rounding ends the progress
    "ipopt.acceptable_iter": 8,
    "ipopt.max_iter": 300,
    "ipopt.mu_init": 1e-9,
    "ipopt.nlp_scaling_method": "none",
}


@dataclass(frozen=True, eq=False)
class Term:
    """One kind of residual, and the observations that have it."""

    # (local, *observed) -> residuals of one observation, in standard deviations or as printed
    function: ca.Function
    # (n, n_local): places of the local unknowns among all, none twice in a row; -1 is zero
    index: IntArray
    # (n,), (n, a) or (n, a, b) each: the other arguments of the function
    observed: tuple[Array, ...]
    robust: bool = False  # an outlier loses weight, all residuals of an observation together

    @property
    def n_rows(self) -> int:
        """Number of residuals of one observation."""
        return int(self.function.size1_out(0))


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half the sum of squared residuals, to be minimised from a start."""

    name: str  # what is looked for, for messages: "The base joints (eq 9)"
    terms: tuple[Term, ...]
    start: Array  # (n,)
    # The first unknowns belong to many observations; the others come in groups, such as the pose
    # of one image, that no residual ties to each other. None: all are shared.
    n_shared: int | None = None
    # Second derivatives instead of J'J: for criteria that do not decide some unknown, as (9) and
    # (16) with z; J'J vanishes in that direction.
    exact_hessian: bool = False

    @property
    def n_residuals(self) -> int:
        """Number of residuals of all terms."""
        return sum(term.n_rows * len(term.index) for term in self.terms)

    def residuals(self, x: Array) -> Array:
        """Return the unweighted residuals (m,)."""
        return _dense(_compiled(self._structure()).residuals(x, self._observed()))

    def jacobian(self, x: Array) -> csc_array[np.float64]:
        """Return the derivative (m, n) of the unweighted residuals."""
        return _sparse(_compiled(self._structure()).jacobian(x, self._observed()))

    def _structure(self) -> _Structure:
        """Return what problems share that differ only in what was observed and in the start."""
        terms = [term for term in self.terms if len(term.index)]
        keys = tuple(
            (
                term.function,
                term.index.shape,
                np.ascontiguousarray(term.index, dtype=np.int64).tobytes(),
                tuple((*values.shape[1:], 1, 1)[:2] for values in term.observed),
            )
            for term in terms
        )
        robust = any(term.robust for term in terms)
        return len(self.start), keys, self.exact_hessian, robust

    def _observed(self) -> ca.DM:
        """Return what all observations saw as one vector, observations side by side."""
        parts = [np.zeros(0)]
        for term in self.terms:
            for values in term.observed if len(term.index) else ():
                if values.ndim < 3:
                    columns = np.atleast_2d(values.T)
                else:
                    columns = np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)
                parts.append(columns.ravel(order="F"))
        return ca.DM(np.concatenate(parts))

    def _robust_blocks(self) -> IntArray:
        """Return the observation that each residual belongs to, (m,); -1 where not robust."""
        blocks, n_blocks = [], 0
        for term in self.terms:
            number = np.arange(n_blocks, n_blocks + len(term.index))
            blocks.append(np.repeat(number if term.robust else -1 + 0 * number, term.n_rows))
            n_blocks += len(term.index)
        return np.concatenate(blocks)


@dataclass(frozen=True, eq=False)
class IpoptSolution:
    """A converged least-squares problem."""

    x: Array  # (n,)
    residuals: Array  # (m,), times the square roots of their weights
    jacobian: csc_array[np.float64]  # (m, n), the same
    n_shared: int  # the first unknowns are shared by many observations
    status: str  # of IPOPT at the end

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(self.residuals @ self.residuals)

    def without_last(self, n_rows: int) -> IpoptSolution:
        """Return what is left without the last residuals, at the same place."""
        n_kept = len(self.residuals) - n_rows
        return replace(self, residuals=self.residuals[:n_kept], jacobian=self.jacobian[:n_kept])

    def covariance(self) -> Array:
        """Return the covariance of the shared unknowns for residuals of unit variance.

        Directions that no residual shows have none: see :meth:`undetermined`.
        """
        triangle, scale = _shared_triangle(self.jacobian, self.n_shared)
        scaled = np.linalg.pinv(triangle, rcond=_RANK) * scale[:, None]
        return np.asarray(scaled @ scaled.T)

    def information(self) -> Array:
        """Return whitened rows (n_shared, n_shared) of the shared unknowns, the others free."""
        triangle, scale = _shared_triangle(self.jacobian, self.n_shared)
        return np.asarray(triangle / scale)

    def undetermined(self, n_first: int) -> BoolArray:
        """Return which of the first (shared) unknowns can move without changing any residual."""
        triangle, _ = _shared_triangle(self.jacobian, self.n_shared)
        rows = _eliminated(triangle[None, :, n_first:], triangle[None, :, :n_first])
        _, singular, directions = np.linalg.svd(rows)
        null = directions[np.count_nonzero(singular >= _RANK) :]
        return np.asarray(np.abs(null).max(axis=0, initial=0.0) > 1e-3)


def solve_least_squares(problem: LeastSquares) -> IpoptSolution:
    """Minimise half the sum of squared residuals with IPOPT and a Gauss-Newton Hessian.

    Unknowns are counted from the start in units of what one residual unit shows: tolerances do
    not depend on units of length or on the noise. With robust terms the problem is solved again
    with Cauchy weights until these have converged. Raises DidNotConverge.
    """
    with held_back_signals():  # CasADi swallows what is raised in its conversions
        return _solved(problem)


def _solved(problem: LeastSquares) -> IpoptSolution:
    """Return :func:`solve_least_squares`; it ends early if a signal waits."""
    compiled, observed = _compiled(problem._structure()), problem._observed()
    scale = _column_scale(_sparse(compiled.jacobian(problem.start, observed)))
    if problem.exact_hessian:  # coordinates of one kind; some columns of J may vanish
        scale = np.full_like(scale, scale.min())
    block = problem._robust_blocks()
    root_weight, z, status = np.ones(len(block)), 0.0 * scale, ""
    for k in range(1 + (_REWEIGHTINGS if np.any(block >= 0) else 0)):
        if k > 0:
            residuals = _dense(compiled.residuals(problem.start + scale * z, observed))
            new = _cauchy_root_weights(residuals, block)
            if np.max(np.abs(new - root_weight)) < _CONVERGED:
                break
            root_weight = new
        parameters = ca.vertcat(ca.DM(root_weight), ca.DM(problem.start), ca.DM(scale), observed)
        z, stats = _minimum(compiled, z, parameters)
        if not stats["success"]:
            raise DidNotConverge(
                f"{problem.name} could not be computed: IPOPT stopped after "
                f"{stats['iter_count']} iterations with {stats['return_status']}, needed "
                "Solve_Succeeded or Solved_To_Acceptable_Level; check the nominal model and the "
                "observations, or reject the ones with large residuals."
            )
        status = str(stats["return_status"])
    x = problem.start + scale * z
    return IpoptSolution(
        x=x,
        residuals=root_weight * _dense(compiled.residuals(x, observed)),
        jacobian=csc_array(diags_array(root_weight) @ _sparse(compiled.jacobian(x, observed))),
        n_shared=len(x) if problem.n_shared is None else problem.n_shared,
        status=status,
    )


def _minimum(compiled: _Compiled, z: Array, parameters: ca.DM) -> tuple[Array, dict[str, Any]]:
    """Return where IPOPT ends and its statistics; raise KeyboardInterrupt if a signal stopped it.

    No exception passes through IPOPT. One that a signal handler raises while CasADi looks for
    signals ends it with a status that nothing else causes here: failed evaluations have others.
    """
    compiled.watch.is_stopped = False
    found = compiled.solver(x0=z, p=parameters)
    stats = compiled.solver.stats()
    if compiled.watch.is_stopped or stats["return_status"] in _INTERRUPTED:
        raise KeyboardInterrupt
    return _dense(found["x"]), stats


def _cauchy_root_weights(residuals: Array, block: IntArray) -> Array:
    """Return square roots of 1 / (1 + (chi / limit)^2), chi being the size of each block."""
    inside = block >= 0
    size = np.zeros(int(block.max(initial=0)) + 1)
    np.add.at(size, block[inside], residuals[inside] ** 2)
    chi = np.sqrt(size)
    limit = max(_OUTLIER * float(np.median(chi[np.unique(block[inside])])), _MIN_THRESHOLD)
    root_weight = np.ones(len(block))
    root_weight[inside] = 1.0 / np.sqrt(1.0 + (chi[block[inside]] / limit) ** 2)
    return root_weight


# Compiled problems


# Function, shape and bytes of the index, and shapes of what one observation saw
_TermKey = tuple[ca.Function, tuple[int, ...], bytes, tuple[tuple[int, ...], ...]]
_Structure = tuple[int, tuple[_TermKey, ...], bool, bool]  # unknowns, terms, exact Hessian, robust


class _Compiled(NamedTuple):
    """The functions of a structure."""

    solver: ca.Function  # parameters: square roots of weights, start, scale, observed
    residuals: ca.Function  # (x, observed) -> (m,)
    jacobian: ca.Function  # (x, observed) -> sparse (m, n)
    watch: _Watch  # of the solver


class _Watch(ca.Callback):
    """Called by IPOPT in every iteration: stops it when a signal waits."""

    def __init__(self, n_unknowns: int) -> None:
        super().__init__()
        self.is_stopped = False
        self._sizes = {"x": n_unknowns, "lam_x": n_unknowns, "f": 1}
        self.construct("watch")

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        size = self._sizes.get(ca.nlpsol_out(i))
        return ca.Sparsity(0, 0) if size is None else ca.Sparsity.dense(size)

    def eval(self, _found: Sequence[ca.DM]) -> list[int]:
        """Return 1 to stop."""
        try:
            self.is_stopped = self.is_stopped or is_waiting()
        except KeyboardInterrupt:  # out of the handler of Python, which runs here
            self.is_stopped = True
        return [int(self.is_stopped)]


@lru_cache(maxsize=_CACHE_SIZE)
def _compiled(structure: _Structure) -> _Compiled:
    """Return the functions of a structure, the solver in scaled unknowns."""
    n, terms, exact_hessian, robust = structure
    residuals, jacobian = _residuals_and_jacobian(n, terms)
    m = residuals.size1_out(0)
    z, p = ca.MX.sym("z", n), ca.MX.sym("p", m + 2 * n + residuals.size1_in(1))
    root_weight, start, scale = p[:m], p[m : m + n], p[m + n : m + 2 * n]
    observed = p[m + 2 * n :]
    x = start + scale * z
    weighted = root_weight * residuals(x, observed)
    slope = ca.diag(root_weight) @ jacobian(x, observed) @ ca.diag(scale)
    cost = 0.5 * ca.sumsqr(weighted)
    gradient = ca.densify(ca.mtimes(slope.T, weighted))  # IPOPT reads it as full
    options: dict[str, Any] = dict(_OPTIONS)
    options["grad_f"] = ca.Function(
        "nlp_grad_f", [z, p], [cost, gradient], ["x", "p"], ["f", "grad_f_x"]
    )
    if not exact_hessian:
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
        options["hess_lag"] = ca.Function(
            "nlp_hess_l",
            [z, p, lam_f, lam_g],
            [lam_f * ca.triu(ca.mtimes(slope.T, slope))],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        )
    if robust:  # more iterations only look for a descent below rounding
        options["ipopt.acceptable_iter"] = 2
    watch = _Watch(n)
    options["iteration_callback"] = watch
    nlp: dict[str, Any] = {"x": z, "p": p, "f": cost}
    return _Compiled(ca.nlpsol("solver", "ipopt", nlp, options), residuals, jacobian, watch)


def _residuals_and_jacobian(
    n_unknowns: int, terms: Sequence[_TermKey]
) -> tuple[ca.Function, ca.Function]:
    """Return (x, observed) -> residuals of all terms, and their sparse derivative by x."""
    n_observed = sum(shape[0] * a * b for _, shape, _, sizes in terms for a, b in sizes)
    x, seen = ca.MX.sym("x", n_unknowns), ca.MX.sym("observed", n_observed)
    residuals, values = [ca.MX(0, 1)], [ca.MX(0, 1)]
    rows, columns = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    n_before = place = 0
    for function, (n, n_local), content, sizes in terms:
        observed = []
        for a, b in sizes:
            size = n * a * b
            observed.append(ca.reshape(seen[place : place + size], a, n * b))
            place += size
        index = np.frombuffer(content, dtype=np.int64).reshape(n, n_local)
        padded = np.where(index >= 0, index, n_unknowns).ravel().tolist()
        local = ca.reshape(ca.vertcat(x, 0.0)[padded], n_local, n)
        residuals.append(ca.vec(function.map(n)(local, *observed)))
        values.append(ca.vec(_derivative(function).map(n)(local, *observed)))
        # CasADi stores columns: of one observation all residuals by its first unknown come first.
        n_rows = int(function.size1_out(0))
        of_observation = n_before + np.arange(n * n_rows).reshape(n, 1, n_rows)
        rows.append(np.repeat(of_observation, n_local, axis=1).ravel())
        columns.append(np.repeat(index.ravel(), n_rows))
        n_before += n * n_rows
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((row, column))
    order = order[column[order] >= 0]
    first = np.searchsorted(column[order], np.arange(n_unknowns + 1))
    pattern = ca.Sparsity(n_before, n_unknowns, first.tolist(), row[order].tolist())
    jacobian = ca.MX(pattern, ca.vertcat(*values)[order.tolist()])
    return (
        ca.Function("residuals", [x, seen], [ca.vertcat(*residuals)]),
        ca.Function("jacobian", [x, seen], [jacobian]),
    )


def _derivative(function: ca.Function) -> ca.Function:
    """Return the derivative of a function of (local, *observed) by its local unknowns, full."""
    inputs = [ca.SX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    jacobian = ca.densify(ca.jacobian(function(*inputs), inputs[0]))
    return ca.Function("derivative", inputs, [jacobian])


def _dense(column: ca.DM) -> Array:
    """Return a CasADi column as an array."""
    return np.asarray(column.full()).ravel()


def _sparse(matrix: ca.DM) -> csc_array[np.float64]:
    """Return a CasADi matrix as a sparse array."""
    first, row = matrix.sparsity().get_ccs()
    return csc_array((np.array(matrix.nonzeros()), row, first), shape=matrix.shape)


# Elimination of what belongs to one group of observations


def _column_scale(jacobian: csc_array[np.float64]) -> Array:
    """Return the change of each unknown that moves the residuals by one unit, (n,)."""
    norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=0)).ravel())
    floor = 1e-6 * float(norms.max(initial=0.0)) or 1.0
    return np.asarray(1.0 / np.maximum(norms, floor))


def _shared_triangle(jacobian: csc_array[np.float64], n_shared: int) -> tuple[Array, Array]:
    """Return R (n_shared, n_shared) of the scaled Jacobian without the others, and the scale."""
    scale = _column_scale(jacobian)
    entries = jacobian.tocoo()
    row, column = np.asarray(entries.row, np.intp), np.asarray(entries.col, np.intp)
    values = entries.data * scale[column]
    group_of_row, place_of_column = _groups(jacobian, n_shared)
    alone = group_of_row < 0
    shared_rows = np.zeros((int(alone.sum()), n_shared))
    here = alone[row]
    shared_rows[(np.cumsum(alone) - 1)[row[here]], column[here]] = values[here]
    n_groups = int(group_of_row.max(initial=-1)) + 1
    if n_groups:
        slot = _rank_in_group(group_of_row)
        n_local = int(place_of_column.max()) + 1
        filled = np.zeros((n_groups, int(slot.max()) + 1, n_local + n_shared))
        local, place = column >= n_shared, n_local + column
        place[local] = place_of_column[column[local] - n_shared]
        filled[group_of_row[row[~here]], slot[row[~here]], place[~here]] = values[~here]
        rest = _eliminated(filled[:, :, :n_local], filled[:, :, n_local:])
        shared_rows = np.concatenate([shared_rows, rest])
    reduced = np.asarray(np.linalg.qr(shared_rows, mode="r"))
    missing = np.zeros((n_shared - len(reduced), n_shared))
    return np.vstack([reduced, missing]), scale[:n_shared]


def _groups(jacobian: csc_array[np.float64], n_shared: int) -> tuple[IntArray, IntArray]:
    """Return the group of each row, -1 for none, and each other unknown's place in its group."""
    n_rows, n = jacobian.shape
    if n == n_shared:
        return np.full(n_rows, -1), np.zeros(0, dtype=np.intp)
    entries = jacobian[:, n_shared:].tocoo()
    row, column = np.asarray(entries.row, np.intp), np.asarray(entries.col, np.intp)
    # The first unknown of each group, by what shares a row; SciPy's graphs take 10 ms to load.
    first, before = np.arange(n - n_shared), np.zeros(0, dtype=np.intp)
    while not np.array_equal(first, before):
        before, of_row = first.copy(), np.full(n_rows, n)
        np.minimum.at(of_row, row, first[column])
        np.minimum.at(first, column, of_row[row])
    group = np.unique(first, return_inverse=True)[1].ravel()
    group_of_row = np.full(n_rows, -1)
    group_of_row[row] = group[column]
    return group_of_row, _rank_in_group(group)


def _rank_in_group(group: IntArray) -> IntArray:
    """Return the place of each entry in its group."""
    order = np.argsort(group, kind="stable")
    in_order = group[order]
    rank = np.zeros(len(group), dtype=np.intp)
    rank[order] = np.arange(len(group)) - np.searchsorted(in_order, in_order)
    return rank


def _eliminated(local: Array, shared: Array) -> Array:
    """Return what the rows [local, shared] of (k, r, n) groups say about the shared unknowns alone.

    Rows are rotated until as few as possible contain the local ones, which are then dropped.
    """
    n_local, n_shared = local.shape[2], shared.shape[2]
    if n_local == 0:
        return shared.reshape(-1, n_shared)
    rows = np.asarray(np.linalg.qr(np.concatenate([local, shared], axis=2), mode="r"))
    left, singular, _ = np.linalg.svd(rows[:, :, :n_local])
    rotated = np.swapaxes(left, 1, 2) @ rows[:, :, n_local:]
    rotated[:, : singular.shape[1]][singular >= _RANK] = 0.0
    return np.asarray(rotated.reshape(-1, n_shared))
