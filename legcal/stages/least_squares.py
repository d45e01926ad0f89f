"""Least-squares problems as the steps build them: small CasADi functions, mapped.

A residual depends on a few unknowns and on what one observation saw. Each kind is written once,
as a small function (:mod:`legcal.stages.residuals`), and a step lists for every observation
which unknowns it has. Residuals and their sparse Jacobian follow from that, at a cost that
grows with the number of observations and no faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from legcal.geometry.types import Array, IntArray


@dataclass(frozen=True, eq=False)
class Term:
    """One kind of residual, and the observations that have it.

    Attributes
    ----------
    function : casadi.Function
        (local, *observed) -> residuals of one observation, in units of their standard
        deviations or of eqs (9), (14), (16). *local* (n_local,) are the unknowns that it depends
        on.
    index : (n, n_local) array of int
        Positions of the local unknowns of each observation among all unknowns; -1 for
        coordinates that are zero by the choice of the frame. No unknown twice in a row.
    observed : tuple of (n,), (n, a) or (n, a, b) array
        What each observation saw: the other arguments of the function.
    robust : bool
        An observation that is an outlier loses weight, all its residuals together.
    """

    function: ca.Function
    index: IntArray
    observed: tuple[Array, ...]
    robust: bool = False

    @property
    def n_rows(self) -> int:
        """Number of residuals of one observation."""
        return int(self.function.size1_out(0))


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Half the sum of squared residuals, to be minimised from a start.

    Attributes
    ----------
    name : str
        What is looked for, for messages: "the base joints (eq 9)".
    terms : tuple of Term
        The residuals.
    start : (n,) array
        Values of the unknowns to start from.
    n_shared : int, optional
        How many unknowns, the first ones, belong to many observations. The others come in
        groups, such as the pose of one image, that no residual ties to each other. Without it
        all are shared.
    exact_hessian : bool
        Use second derivatives of the residuals instead of J'J. Criteria that do not decide some
        unknown, as (9) and (16) with z, need it: J'J vanishes in that direction.
    """

    name: str
    terms: tuple[Term, ...]
    start: Array
    n_shared: int | None = None
    exact_hessian: bool = False

    @property
    def n_residuals(self) -> int:
        """Number of residuals of all terms."""
        return sum(term.n_rows * len(term.index) for term in self.terms)

    @property
    def block(self) -> IntArray:
        """Number of the observation that each residual belongs to, (m,); -1 where not robust."""
        blocks, n_blocks = [], 0
        for term in self.terms:
            number = np.arange(n_blocks, n_blocks + len(term.index))
            blocks.append(np.repeat(number if term.robust else -1 + 0 * number, term.n_rows))
            n_blocks += len(term.index)
        return np.concatenate(blocks)


def term_of_all(x: ca.SX, residuals: ca.SX) -> Term:
    """Return residuals that may all depend on all unknowns, as a single observation."""
    function = ca.Function("all", [x], [residuals])
    return Term(function, np.arange(x.numel())[None, :], ())


def residuals_of(problem: LeastSquares) -> ca.Function:
    """Return the function x -> residuals of all terms, (m,)."""
    x = ca.MX.sym("x", len(problem.start))
    found = [ca.vec(_mapped(term.function, term, x)) for term in problem.terms if len(term.index)]
    return ca.Function("residuals", [x], [ca.vertcat(ca.MX(0, 1), *found)])


def jacobian_of(problem: LeastSquares) -> ca.Function:
    """Return the function x -> sparse Jacobian of the residuals, (m, n)."""
    n_unknowns = len(problem.start)
    x = ca.MX.sym("x", n_unknowns)
    values, n_before = [ca.MX(0, 1)], 0
    rows, columns = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for term in problem.terms:
        n, n_local = term.index.shape
        if n == 0:
            continue
        values.append(ca.vec(_mapped(_derivative(term.function), term, x)))
        # CasADi stores columns: of one observation all residuals by its first unknown come first.
        of_observation = np.arange(n * term.n_rows).reshape(n, 1, term.n_rows)
        rows.append(n_before + np.repeat(of_observation, n_local, axis=1).ravel())
        columns.append(np.repeat(term.index.ravel(), term.n_rows))
        n_before += n * term.n_rows
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((row, column))
    order = order[column[order] >= 0]
    first = np.searchsorted(column[order], np.arange(n_unknowns + 1))
    pattern = ca.Sparsity(n_before, n_unknowns, first.tolist(), row[order].tolist())
    jacobian = ca.MX(pattern, ca.vertcat(*values)[order.tolist()])
    return ca.Function("jacobian", [x], [jacobian])


def _mapped(function: ca.Function, term: Term, x: ca.MX) -> ca.MX:
    """Return a function of (local, *observed) for all observations of a term, side by side."""
    n, n_local = term.index.shape
    place = np.where(term.index >= 0, term.index, x.numel())
    local = ca.reshape(ca.vertcat(x, 0.0)[place.ravel().tolist()], n_local, n)
    observed = [ca.DM(_side_by_side(values)) for values in term.observed]
    mapped: ca.MX = function.map(n)(local, *observed)
    return mapped


def _side_by_side(values: Array) -> Array:
    """Return numbers, vectors or matrices of n observations as the columns of one matrix."""
    if values.ndim < 3:
        return np.atleast_2d(values.T)
    return np.swapaxes(values, 0, 1).reshape(values.shape[1], -1)


def _derivative(function: ca.Function) -> ca.Function:
    """Return the derivative of a function of (local, *observed) by its local unknowns, full."""
    inputs = [ca.SX.sym(f"i{k}", *function.size_in(k)) for k in range(function.n_in())]
    jacobian = ca.densify(ca.jacobian(function(*inputs), inputs[0]))
    return ca.Function("derivative", inputs, [jacobian])
