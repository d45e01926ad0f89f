"""The nonlinear least-squares problem of all steps: built with CasADi, solved with IPOPT.

A problem is a sum of terms. A term is one equation of the paper: a CasADi function of a few
unknowns, mapped over its observations. It is also a function of the errors of the observed values:
its derivative by these propagates covariances of axes to covariances of residuals, which are the
weights. Observed values are parameters of the compiled solver, so that problems of one structure
(other numbers, other weights) are compiled once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.sparse import csc_array

from legcal.errors import DidNotConverge
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.signals import held_back_signals, is_waiting

_RANK = 1e-7  # minimum singular value of the scaled Jacobian of a determined direction
_REWEIGHTINGS = 10
_OUTLIER = 4.0  # multiple of the median residual at which an observation has half its weight
_CONVERGED = 0.01  # maximum relative change of converged weights
_MIN_THRESHOLD = 1e-3  # standard deviations: smaller residuals are rounding
_LEAST = 1e-13  # minimum information of a determined direction, relative to the largest
_NONE = np.zeros(0, dtype=np.intp)
_CACHE_SIZE = 20  # compiled structures, enough for one run of the steps with either criteria
_INTERRUPTED = ("NonIpopt_Exception_Thrown", "User_Requested_Stop")  # return statuses
_OPTIONS: dict[str, bool | int | float | str] = {
    "print_time": False,
    "calc_lam_p": False,
    "no_nlp_grad": True,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.acceptable_tol": 1e-6,  # in standard deviations: rounding prevents further progress
    "ipopt.acceptable_iter": 8,
    "ipopt.max_iter": 300,
    "ipopt.mu_init": 1e-9,
    "ipopt.nlp_scaling_method": "none",
}


@dataclass(frozen=True, eq=False)
class Term:
    """One equation, and its observations."""

    # (local, error, *observed) -> residuals of one observation, as printed; error (k,) of the
    # observed values, zero in the evaluation of the residuals
    function: ca.Function
    # (n, n_local): indices of the local unknowns among all, none twice in a row; -1 is zero
    index: IntArray
    # (n,), (n, a) or (n, a, b) each: the other arguments of the function
    observed: tuple[Array, ...]
    covariance: Array | None = None  # (n, k, k) of the errors; None: the weight is one
    n_printed: int | None = None  # number of first residuals in the paper; others have no weight

    @property
    def n_rows(self) -> int:
        """Number of residuals of one observation."""
        return int(self.function.size1_out(0))

    @property
    def unit_weights(self) -> Array:
        """Weights of one, (n, r, r), or as numbers (n, r) without a covariance."""
        n, r = len(self.index), self.n_rows
        if self.covariance is None:
            return np.ones((n, r))
        printed = np.arange(r) < (r if self.n_printed is None else self.n_printed)
        return np.tile(np.diag(printed.astype(np.float64)), (n, 1, 1))


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half the sum of squared residuals, to be minimised from a start."""

    name: str  # the unknowns, for messages: "The base joints (eq 9)"
    terms: tuple[Term, ...]
    start: Array  # (n,)
    # Second derivatives instead of J'J: for criteria that do not determine some unknown, such as z
    # in (9) and (16), where J'J vanishes; and for (18) of poses from few legs, one of which is
    # wrong.
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

    def derivative_at_start(self, *, weighted: bool) -> csc_array[np.float64]:
        """Return the derivative (m, n) of the residuals at the start; in sigmas with weights."""
        J = self.jacobian(self.start)
        return csc_array(_matrix(self._weights(self.start, None)) @ J) if weighted else J

    def _weights(self, x: Array, residuals: Array | None) -> list[Array]:
        """Return the matrices (n, r, r) that whiten the residuals of each term at x.

        They are one, (n, r), without a covariance. With residuals, outliers are downweighted by
        Cauchy's function.
        """
        matrices, first = list[Array](), 0
        for term in self.terms:
            n, r = len(term.index), term.n_rows
            W = term.unit_weights
            if term.covariance is not None:
                local = np.append(x, 0.0)[term.index]
                slope = derivatives(term.function, 1, local, *term.observed)
                spread = slope @ term.covariance @ np.swapaxes(slope, 1, 2)
                W = whitener(spread)
                if residuals is not None:
                    whitened = W @ residuals[first : first + n * r].reshape(n, r, 1)
                    W *= _cauchy(np.linalg.norm(whitened, axis=(1, 2)))[:, None, None]
            matrices.append(W)
            first += n * r
        return matrices

    def _structure(self) -> _Structure:
        """Return the structure, common to problems with other observed values or another start."""
        terms = [term for term in self.terms if len(term.index)]
        keys = tuple(
            (
                term.function,
                term.covariance is None,
                term.index.shape,
                np.ascontiguousarray(term.index, dtype=np.int64).tobytes(),
                tuple((*values.shape[1:], 1, 1)[:2] for values in term.observed),
            )
            for term in terms
        )
        return len(self.start), keys, self.exact_hessian

    def _observed(self) -> ca.DM:
        """Return all observed values as one vector, observations side by side."""
        parts = [np.zeros(0)]
        for term in self.terms:
            for values in term.observed if len(term.index) else ():
                parts.append(_side_by_side(values).ravel(order="F"))
        return ca.DM(np.concatenate(parts))


@dataclass(frozen=True, eq=False)
class IpoptSolution:
    """A converged least-squares problem."""

    x: Array  # (n,)
    residuals: Array  # (m,), weighted
    jacobian: csc_array[np.float64]  # (m, n), the same

    def covariances(self, columns: IntArray) -> Array:
        """Return covariances (n, k, k) of groups of unknowns (n, k) that share no residual.

        The residuals are assumed to have unit variance.
        """
        information = (self.jacobian.T @ self.jacobian).tocsr()
        return np.array([inverse_of(information[c][:, c].toarray()) for c in columns])


def solve_least_squares(problem: LeastSquares, *, weighted: bool = False) -> IpoptSolution:
    """Minimise half the sum of squared residuals with IPOPT and a Gauss-Newton Hessian.

    All weights are one, or from covariances: these depend on the unknowns, and outliers are
    downweighted, so that the problem is solved again until the weights have converged. Unknowns
    are relative to the start, scaled by the residuals: tolerances do not depend on units of length
    or on the noise. Raises DidNotConverge.
    """
    with held_back_signals():  # CasADi swallows exceptions in its conversions
        return _solved(problem, weighted=weighted)


def undetermined(jacobian: csc_array[np.float64]) -> BoolArray:
    """Return a mask of the unknowns that can move without changing any residual."""
    scaled = jacobian.toarray() * _column_scale(jacobian)
    n = scaled.shape[1]
    rows = np.vstack([scaled, np.zeros((n, n))])
    _, singular, directions = np.linalg.svd(rows, full_matrices=False)
    null = directions[singular < _RANK]
    return np.asarray(np.abs(null).max(axis=0, initial=0.0) > 1e-3)


def inverse_of(information: Array) -> Array:
    """Return the inverse of an information matrix, large in directions without information."""
    size = np.sqrt(np.diag(information))
    size = np.maximum(size, _LEAST * float(size.max()))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    inverse = (vectors / np.maximum(values, _LEAST * values[-1])) @ vectors.T
    return np.asarray(inverse / np.outer(size, size))


def evaluated(function: ca.Function, local: Array, *observed: Array) -> Array:
    """Return the residuals (n, r) of a function of a term, of local unknowns (n, n_local)."""
    n, none = len(local), np.zeros((len(local), function.size1_in(1)))
    arguments = [_side_by_side(values) for values in (local, none, *observed)]
    return np.asarray(function.map(n)(*arguments).full()).T if n else _nothing(function)


def derivatives(function: ca.Function, input_index: int, local: Array, *observed: Array) -> Array:
    """Return the derivatives (n, r, k) by the local unknowns (0) or the errors (1)."""
    n, none = len(local), np.zeros((len(local), function.size1_in(1)))
    r, k = function.size1_out(0), function.size1_in(input_index)
    arguments = [_side_by_side(values) for values in (local, none, *observed)]
    derivative = _derivative(function, input_index).map(n)(*arguments).full()
    return np.asarray(derivative.reshape(r, n, k).swapaxes(0, 1))


def adjusted(
    function: ca.Function,
    local: Array,  # (n, n_local)
    observed: tuple[Array, ...],
    covariance: Array,  # (n, k, k) of the errors
    local_covariance: Array,  # (n, n_local, n_local)
) -> tuple[Array, Array, Array]:
    """Return the likeliest errors (n, k) of observations given an equation, and covariances.

    The covariances (n, k, k) of the remaining errors are inflated where the equation contradicts
    the observation. The last result is this contradiction in standard deviations (n,).
    """
    residual = evaluated(function, local, *observed)[..., None]
    by_local, by_error = (
        derivatives(function, input_index, local, *observed) for input_index in (0, 1)
    )
    mixed = covariance @ np.swapaxes(by_error, 1, 2)
    spread = by_error @ mixed + by_local @ local_covariance @ np.swapaxes(by_local, 1, 2)
    gain = mixed @ np.linalg.inv(spread)
    left = covariance - gain @ np.swapaxes(mixed, 1, 2)
    chi = np.linalg.norm(whitener(spread) @ residual, axis=(1, 2))
    return -(gain @ residual)[..., 0], left / (_cauchy(chi) ** 2)[:, None, None], chi


def _nothing(function: ca.Function) -> Array:
    return np.zeros((0, function.size1_out(0)))


def _side_by_side(values: Array) -> Array:
    """Return observed values (n,), (n, a) or (n, a, b) as columns, observation by observation."""
    if values.ndim < 3:
        return np.atleast_2d(values.T)
    return np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)


def _solved(problem: LeastSquares, *, weighted: bool) -> IpoptSolution:
    """Return :func:`solve_least_squares`; it ends early if a signal waits."""
    compiled, observed = _compiled(problem._structure()), problem._observed()
    x = problem.start
    weights = [term.unit_weights for term in problem.terms]
    for k in range(_REWEIGHTINGS if weighted else 1):
        if weighted:
            residuals = None if k == 0 else _dense(compiled.residuals(x, observed))
            before, weights = weights, problem._weights(x, residuals)
            if k > 0 and _change(weights, before) < _CONVERGED:
                break
        W = _matrix(weights)
        jacobian = csc_array(W @ _sparse(compiled.jacobian(x, observed)))
        scale = _column_scale(jacobian)
        if problem.exact_hessian and not weighted:  # some columns of J may vanish
            scale = np.full_like(scale, scale.min())
        parameters = ca.vertcat(_entries(weights), ca.DM(x), ca.DM(scale), observed)
        z, stats = _minimum(compiled, 0.0 * scale, parameters)
        if not stats["success"]:
            raise DidNotConverge(
                f"{problem.name} could not be computed: IPOPT stopped after "
                f"{stats['iter_count']} iterations with {stats['return_status']}, needed "
                "Solve_Succeeded or Solved_To_Acceptable_Level; check the nominal model and the "
                "observations, or reject the ones with large residuals."
            )
        x = x + scale * z
    return IpoptSolution(
        x=x,
        residuals=np.asarray(W @ _dense(compiled.residuals(x, observed))),
        jacobian=csc_array(W @ _sparse(compiled.jacobian(x, observed))),
    )


def _minimum(compiled: _Compiled, z: Array, parameters: ca.DM) -> tuple[Array, dict[str, Any]]:
    """Return the solution of IPOPT and its statistics; raise KeyboardInterrupt after a signal.

    No exception passes through IPOPT. An exception of a signal handler while CasADi checks for
    signals ends it with a status of no other cause here: failed evaluations have other ones.
    """
    compiled.watch.is_stopped = False
    solution = compiled.solver(x0=z, p=parameters)
    stats = compiled.solver.stats()
    if compiled.watch.is_stopped or stats["return_status"] in _INTERRUPTED:
        raise KeyboardInterrupt
    return _dense(solution["x"]), stats


def _cauchy(chi: Array) -> Array:
    """Return the square roots (n,) of Cauchy's weights of residuals of size chi (n,)."""
    limit = max(_OUTLIER * float(np.median(chi)), _MIN_THRESHOLD)
    return np.asarray(1.0 / np.sqrt(1.0 + (chi / limit) ** 2))


# Compiled problems


# Function, whether its weights are all one, shape and bytes of the index, and shapes of the values
# of one observation
_TermKey = tuple[ca.Function, bool, tuple[int, ...], bytes, tuple[tuple[int, ...], ...]]
_Structure = tuple[int, tuple[_TermKey, ...], bool]  # unknowns, terms, exact Hessian


class _Compiled(NamedTuple):
    """The functions of a structure."""

    solver: ca.Function  # parameters: weights, start, scale, observed
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
        except KeyboardInterrupt:  # from the signal handler of Python, which runs here
            self.is_stopped = True
        return [int(self.is_stopped)]


@lru_cache(maxsize=_CACHE_SIZE)
def _compiled(structure: _Structure) -> _Compiled:
    """Return the functions of a structure, the solver in scaled unknowns."""
    n, terms, exact_hessian = structure
    residuals, jacobian = _residuals_and_jacobian(n, terms)
    blocks = list[ca.Sparsity]()
    for function, is_plain, (n_of_term, _), _, _ in terms:
        r = function.size1_out(0)
        block = ca.Sparsity.diag(n_of_term * r) if is_plain else ca.Sparsity.dense(r, r)
        blocks += [block] * (1 if is_plain else n_of_term)
    pattern = ca.diagcat(*blocks)
    n_weights = pattern.nnz()
    z, p = ca.MX.sym("z", n), ca.MX.sym("p", n_weights + 2 * n + residuals.size1_in(1))
    weights, start, scale, observed = ca.vertsplit(
        p, [0, n_weights, n_weights + n, n_weights + 2 * n, p.size1()]
    )
    W = ca.MX(pattern, weights)
    x = start + scale * z
    weighted = ca.mtimes(W, residuals(x, observed))
    slope = ca.mtimes(W, jacobian(x, observed)) @ ca.diag(scale)
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
    watch = _Watch(n)
    options["iteration_callback"] = watch
    nlp: dict[str, Any] = {"x": z, "p": p, "f": cost}
    return _Compiled(ca.nlpsol("solver", "ipopt", nlp, options), residuals, jacobian, watch)


def _residuals_and_jacobian(
    n_unknowns: int, terms: Sequence[_TermKey]
) -> tuple[ca.Function, ca.Function]:
    """Return (x, observed) -> residuals of all terms, and their sparse derivative by x."""
    n_observed = sum(shape[0] * a * b for *_, shape, _, sizes in terms for a, b in sizes)
    x, all_observed = ca.MX.sym("x", n_unknowns), ca.MX.sym("observed", n_observed)
    residuals, values = [ca.MX(0, 1)], [ca.MX(0, 1)]
    rows, columns = [_NONE], [_NONE]
    n_before = place = 0
    for function, _, (n, n_local), content, sizes in terms:
        observed = []
        for a, b in sizes:
            size = n * a * b
            observed.append(ca.reshape(all_observed[place : place + size], a, n * b))
            place += size
        index = np.frombuffer(content, dtype=np.int64).reshape(n, n_local)
        padded = np.where(index >= 0, index, n_unknowns).ravel().tolist()
        local = ca.reshape(ca.vertcat(x, 0.0)[padded], n_local, n)
        arguments = local, ca.MX.zeros(function.size1_in(1), n), *observed
        residuals.append(ca.vec(function.map(n)(*arguments)))
        values.append(ca.vec(_derivative(function, 0).map(n)(*arguments)))
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
        ca.Function("residuals", [x, all_observed], [ca.vertcat(*residuals)]),
        ca.Function("jacobian", [x, all_observed], [jacobian]),
    )


@lru_cache(maxsize=64)
def _derivative(function: ca.Function, input_index: int) -> ca.Function:
    """Return the full derivative of a term's function by its local unknowns (0) or errors (1)."""
    inputs = [ca.SX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    jacobian = ca.densify(ca.jacobian(function(*inputs), inputs[input_index]))
    return ca.Function("derivative", inputs, [jacobian])


def _matrix(weights: Sequence[Array]) -> csc_array[np.float64]:
    """Return the weights of all terms as one matrix of blocks."""
    entries, rows, columns, first = [np.zeros(0)], [_NONE], [_NONE], 0
    for W in weights:
        n, r = W.shape[:2]
        place = first + np.arange(n * r).reshape(n, r)
        entries.append(W.ravel())
        rows.append((place if W.ndim == 2 else np.repeat(place, r, axis=1)).ravel())
        columns.append((place if W.ndim == 2 else np.tile(place, (1, r))).ravel())
        first += n * r
    indices = np.concatenate(rows), np.concatenate(columns)
    return csc_array((np.concatenate(entries), indices), shape=(first, first))


def _entries(weights: Sequence[Array]) -> ca.DM:
    """Return the weights of all terms as CasADi stores their matrix: column by column."""
    return ca.DM(np.concatenate([np.swapaxes(W, 1, W.ndim - 1).ravel() for W in weights]))


def _change(weights: Sequence[Array], before: Sequence[Array]) -> float:
    """Return the largest relative change of a weight."""
    return max(
        (
            float(np.max(np.linalg.norm(W - V, axis=(1, 2)) / np.linalg.norm(V, axis=(1, 2))))
            for W, V in zip(weights, before, strict=True)
            if V.ndim == 3  # others depend on nothing
        ),
        default=0.0,
    )


def _dense(column: ca.DM) -> Array:
    """Return a CasADi column as an array."""
    return np.asarray(column.full()).ravel()


def _sparse(matrix: ca.DM) -> csc_array[np.float64]:
    """Return a CasADi matrix as a sparse array."""
    first, row = matrix.sparsity().get_ccs()
    return csc_array((np.array(matrix.nonzeros()), row, first), shape=matrix.shape)


def _column_scale(jacobian: csc_array[np.float64]) -> Array:
    """Return the change of each unknown that moves the residuals by one unit, (n,)."""
    norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=0)).ravel())
    floor = 1e-6 * float(norms.max(initial=0.0)) or 1.0
    return np.asarray(1.0 / np.maximum(norms, floor))
