"""The nonlinear least-squares problem of all steps: built with CasADi, solved with IPOPT.

A problem is a sum of terms. A term is one equation of the paper: a CasADi function of a few
unknowns, mapped over its observations. It is also a function of the errors of the observed values:
its derivative by these propagates covariances of axes to covariances of residuals, which are the
weights. Cost, gradient and Hessian of one observation are one compiled function of an equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from scipy.sparse import csc_array

from legcal.errors import DidNotConverge
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.signals import held_back_signals

_RANK = 1e-7  # minimum singular value of the scaled Jacobian of a determined direction
_REWEIGHTINGS = 10
_OUTLIER = 4.0  # multiple of the median residual at which an observation has half its weight
_CONVERGED = 0.01  # maximum relative change of converged weights
_MIN_THRESHOLD = 1e-3  # standard deviations: smaller residuals are rounding
_LEAST = 1e-13  # minimum information of a determined direction, relative to the largest
_NONE = np.zeros(0, dtype=np.intp)
_OPTIONS: dict[str, bool | int | float | str] = {
    "print_time": False,
    "calc_lam_p": False,
    "no_nlp_grad": True,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.acceptable_tol": 1e-6,  # in standard deviations: rounding prevents further progress
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

    def __len__(self) -> int:
        return len(self.index)

    @property
    def n_rows(self) -> int:
        """Number of residuals of one observation."""
        return int(self.function.size1_out(0))

    @property
    def unit_weights(self) -> Array | None:
        """Weights of one, (n, r, r); None if they have no covariance."""
        if self.covariance is None:
            return None
        printed = np.arange(self.n_rows) < (self.n_printed or self.n_rows)
        return np.tile(np.diag(printed.astype(np.float64)), (len(self), 1, 1))

    def weights(self, x: Array, *, robust: bool) -> Array | None:
        """Return the matrices (n, r, r) that whiten the residuals at x; None without a covariance.

        Robust ones have outliers downweighted by Cauchy's function.
        """
        if self.covariance is None:
            return None
        slope = derivatives(self.function, 1, self.local(x), *self.observed)
        W = whitener(slope @ self.covariance @ np.swapaxes(slope, 1, 2))
        if robust:
            chi = np.linalg.norm(W @ self.residuals(x)[..., None], axis=(1, 2))
            W *= _cauchy(chi)[:, None, None]
        return W

    def local(self, x: Array) -> Array:
        """Return the local unknowns (n, n_local)."""
        return np.append(x, 0.0)[self.index]

    def residuals(self, x: Array) -> Array:
        """Return the unweighted residuals (n, r)."""
        return evaluated(self.function, self.local(x), *self.observed)


Weights = Sequence[Array | None]  # of terms, (n, r, r) each; None for one


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
        return sum(term.n_rows * len(term) for term in self.terms)

    def jacobian(self, x: Array, weights: Weights | None = None) -> csc_array[np.float64]:
        """Return the derivative (m, n) of the residuals, unweighted without weights."""
        entries, rows, columns, first = [np.zeros(0)], [_NONE], [_NONE], 0
        for term, W in zip(self.terms, weights or [None] * len(self.terms), strict=True):
            J = derivatives(term.function, 0, term.local(x), *term.observed)
            J = J if W is None else W @ J
            row = first + np.arange(len(term) * term.n_rows).reshape(len(term), -1, 1)
            first += len(term) * term.n_rows
            column, row = np.broadcast_arrays(term.index[:, None], row)
            kept = column >= 0
            entries.append(J[kept])
            rows.append(row[kept])
            columns.append(column[kept])
        place = np.concatenate(rows), np.concatenate(columns)
        return csc_array((np.concatenate(entries), place), shape=(first, len(self.start)))


@dataclass(frozen=True, eq=False)
class IpoptSolution:
    """A converged least-squares problem."""

    x: Array  # (n,)
    jacobian: csc_array[np.float64]  # (m, n), weighted

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


def _solved(problem: LeastSquares, *, weighted: bool) -> IpoptSolution:
    """Return :func:`solve_least_squares`."""
    x, weights = problem.start, [term.unit_weights for term in problem.terms]
    solver = _solver(problem, weighted=weighted)
    for k in range(_REWEIGHTINGS if weighted else 1):
        if weighted:
            before = weights
            weights = [term.weights(x, robust=k > 0) for term in problem.terms]
            if k > 0 and _change(weights, before) < _CONVERGED:
                break
        scale = _column_scale(problem.jacobian(x, weights))
        if problem.exact_hessian and not weighted:  # some columns of J may vanish
            scale = np.full_like(scale, scale.min())
        entries = [np.swapaxes(W, 1, 2).ravel() for W in weights if W is not None]
        step = solver(x0=np.zeros(len(x)), p=np.concatenate([x, scale, *entries]))["x"]
        stats = solver.stats()
        if not stats["success"]:
            raise DidNotConverge(
                f"{problem.name} could not be computed: IPOPT stopped after "
                f"{stats['iter_count']} iterations with {stats['return_status']}, needed "
                "Solve_Succeeded or Solved_To_Acceptable_Level; check the nominal model and the "
                "observations, or reject the ones with large residuals."
            )
        x = x + scale * step.full().ravel()
    return IpoptSolution(x, problem.jacobian(x, weights))


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
    none = np.zeros((len(local), function.size1_in(1)))
    values = _called(function, local, none, *observed).reshape(len(local), function.size1_out(0))
    return np.asfortranarray(values)  # the layout of CasADi: products keep their last digits


def derivatives(function: ca.Function, input_index: int, local: Array, *observed: Array) -> Array:
    """Return the derivatives (n, r, k) by the local unknowns (0) or the errors (1)."""
    none = np.zeros((len(local), function.size1_in(1)))
    by_column = _called(_derivative(function, input_index), local, none, *observed)
    shape = len(local), function.size1_in(input_index), function.size1_out(0)
    return np.ascontiguousarray(by_column.reshape(shape).transpose(2, 0, 1)).swapaxes(0, 1)


def _called(function: ca.Function, *arguments: Array) -> Array:
    """Return the dense values of a function of n observations, column by column.

    CasADi reads and writes the memory of arrays: it would convert them number by number.
    """
    n = len(arguments[0])
    values = np.zeros(n * function.nnz_out(0))
    if n:
        buffer, run = _mapped(function, n).buffer()
        inputs = [
            np.ascontiguousarray(x if x.ndim < 3 else np.swapaxes(x, 1, 2), dtype=np.float64)
            for x in arguments
        ]
        for k, numbers in enumerate(inputs):
            buffer.set_arg(k, numbers.data)  # type: ignore[call-arg]
        buffer.set_res(0, values.data)  # type: ignore[call-arg]
        run()
    return values


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


@lru_cache(maxsize=64)
def _mapped(function: ca.Function, n: int) -> ca.Function:
    """Return a function of n observations side by side."""
    return function.map(n)


def _side_by_side(values: Array) -> Array:
    """Return observed values (n,), (n, a) or (n, a, b) as columns, observation by observation."""
    if values.ndim < 3:
        return np.atleast_2d(values.T)
    return np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)


def _solver(problem: LeastSquares, *, weighted: bool) -> ca.Function:
    """Return IPOPT for z, the unknowns x + scale z; its parameters are x, scale and weights."""
    n = len(problem.start)
    sizes = [term.n_rows**2 * len(term) * (term.covariance is not None) for term in problem.terms]
    z, p = ca.MX.sym("z", n), ca.MX.sym("p", 2 * n + sum(sizes))
    x, scale, *weights = ca.vertsplit(p, np.cumsum([0, n, n, *sizes]).tolist())
    unknowns = ca.vertcat(x + scale * z, 0.0)
    cost, slopes, curves = ca.MX(0), [ca.MX(0, 1)], [ca.MX(0, 1)]
    places, rows, columns = [_NONE], [_NONE], [_NONE]
    for term, W in zip(problem.terms, weights, strict=True):
        if not len(term):
            continue
        place = np.where(term.index < 0, n, term.index)
        local = ca.reshape(unknowns[place.ravel().tolist()], place.shape[1], len(term))
        values: list[ca.MX | ca.DM] = [ca.DM(_side_by_side(x)) for x in term.observed]
        if W.size1():
            values.insert(0, ca.reshape(W, term.n_rows, term.n_rows * len(term)))
        functions = _half_square(term.function, W.size1() > 0, problem.exact_hessian)
        (value, slope), curve = (part.map(len(term))(local, *values) for part in functions)
        cost += ca.sum2(value)
        slopes.append(ca.vec(slope))
        curves.append(ca.vec(curve))
        places.append(place.ravel())
        row, column = np.broadcast_arrays(place[:, None], place[:, :, None])
        rows.append(row.ravel())
        columns.append(column.ravel())
    row, column = np.concatenate(rows), np.concatenate(columns)
    upper, entry = np.unique(
        np.where((row <= column) & (column < n), column * n + row, n * n), return_inverse=True
    )
    upper = upper[upper < n * n]
    first = np.searchsorted(upper // n, np.arange(n + 1)).tolist()
    pattern = ca.Sparsity(n, n, first, (upper % n).tolist())
    curvature = _summed(entry.ravel(), len(upper), curves)
    curvature *= scale[(upper % n).tolist()] * scale[(upper // n).tolist()]
    gradient = scale * _summed(np.concatenate(places), n, slopes)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", 0)
    options = _OPTIONS | {
        # Weighted problems are solved again in any case; printed criteria may converge slowly.
        "ipopt.acceptable_iter": 2 if weighted else 8,
        "grad_f": ca.Function(
            "nlp_grad_f", [z, p], [cost, gradient], ["x", "p"], ["f", "grad_f_x"]
        ),
        "hess_lag": ca.Function(
            "nlp_hess_l",
            [z, p, lam_f, lam_g],
            [lam_f * ca.MX(pattern, curvature)],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
    }
    return ca.nlpsol("solver", "ipopt", {"x": z, "p": p, "f": cost}, options)


def _summed(place: IntArray, n: int, entries: Sequence[ca.MX]) -> ca.MX:
    """Return sums (n,) of entries by their places; those of a place n are dropped."""
    kept = np.flatnonzero(place < n)
    pattern = ca.Sparsity.triplet(n, len(place), place[kept].tolist(), kept.tolist())
    return ca.densify(ca.mtimes(ca.DM(pattern, 1.0), ca.vertcat(*entries)))


@lru_cache(maxsize=64)
def _half_square(
    function: ca.Function, has_weights: bool, exact: bool
) -> tuple[ca.Function, ca.Function]:
    """Return (local, W, *observed) -> half the squared residuals and gradient; Hessian, or J'J."""
    inputs = [ca.SX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    local, error, *observed = inputs
    residuals = ca.substitute(function(*inputs), error, ca.SX.zeros(*error.shape))
    W = ca.SX.sym("W", *[residuals.size1()] * 2)
    weighted = W @ residuals if has_weights else residuals
    value, J = 0.5 * ca.sumsqr(weighted), ca.jacobian(weighted, local)
    hessian = ca.hessian(value, local)[0] if exact else J.T @ J
    inputs = [local, *([W] if has_weights else []), *observed]
    return (
        ca.Function("half_square", inputs, [value, ca.densify(J.T @ weighted)]),
        ca.Function("curvature", inputs, [ca.densify(hessian)]),
    )


def _cauchy(chi: Array) -> Array:
    """Return the square roots (n,) of Cauchy's weights of residuals of size chi (n,)."""
    limit = max(_OUTLIER * float(np.median(chi)), _MIN_THRESHOLD)
    return np.asarray(1.0 / np.sqrt(1.0 + (chi / limit) ** 2))


@lru_cache(maxsize=64)
def _derivative(function: ca.Function, input_index: int) -> ca.Function:
    """Return the full derivative of a term's function by its local unknowns (0) or errors (1)."""
    inputs = [ca.SX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    jacobian = ca.densify(ca.jacobian(function(*inputs), inputs[input_index]))
    return ca.Function("derivative", inputs, [jacobian])


def _change(weights: Weights, before: Weights) -> float:
    """Return the largest relative change of a weight."""
    pairs = [
        (W, V) for W, V in zip(weights, before, strict=True) if W is not None and V is not None
    ]
    changes = [
        np.linalg.norm(W - V, axis=(1, 2)) / np.linalg.norm(V, axis=(1, 2)) for W, V in pairs
    ]
    return max((float(change.max()) for change in changes), default=0.0)


def _column_scale(jacobian: csc_array[np.float64]) -> Array:
    """Return the change of each unknown that moves the residuals by one unit, (n,)."""
    norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=0)).ravel())
    floor = 1e-6 * float(norms.max(initial=0.0)) or 1.0
    return np.asarray(1.0 / np.maximum(norms, floor))
