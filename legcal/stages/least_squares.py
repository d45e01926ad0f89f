"""Least-squares problems as the steps build them: small CasADi functions, mapped.

A residual depends on a few unknowns and on what one observation saw. Each kind is written once,
as a small function (:mod:`legcal.stages.residuals`), and a step lists for every observation
which unknowns it has. Residuals and their sparse Jacobian follow from that, at a cost that
grows with the number of observations and no faster. What was observed are parameters of both, so
that they serve all problems of one :class:`Structure`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

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


@dataclass(frozen=True)
class Structure:
    """What problems of one kind share: which unknowns each observation has, and how.

    Attributes
    ----------
    n_unknowns : int
        Number of unknowns.
    terms : tuple
        Of each term the function, the shape and the bytes of its index, and the shapes of what
        one observation saw.
    exact_hessian : bool
        As of the problem.
    reweighted : bool
        Some terms are robust: the problem is solved several times, with other weights.
    """

    n_unknowns: int
    terms: tuple[tuple[ca.Function, tuple[int, ...], bytes, tuple[tuple[int, int], ...]], ...]
    exact_hessian: bool
    reweighted: bool

    @property
    def n_residuals(self) -> int:
        """Number of residuals."""
        return sum(function.size1_out(0) * shape[0] for function, shape, _, _ in self.terms)

    @property
    def n_observed(self) -> int:
        """Number of parameters."""
        return sum(n * a * b for _, (n, _), _, seen in self.terms for a, b in seen)


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
    def structure(self) -> Structure:
        """What it shares with problems that saw other numbers."""
        terms = [
            (
                term.function,
                term.index.shape,
                np.ascontiguousarray(term.index, dtype=np.int64).tobytes(),
                tuple(_shape(values) for values in term.observed),
            )
            for term in self.terms
            if len(term.index)
        ]
        reweighted = any(term.robust for term in self.terms if len(term.index))
        return Structure(len(self.start), tuple(terms), self.exact_hessian, reweighted)

    @property
    def observed(self) -> Array:
        """What all observations saw, as one vector: the parameters of the structure."""
        parts = [
            _side_by_side(values).ravel(order="F")
            for term in self.terms
            if len(term.index)
            for values in term.observed
        ]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def block(self) -> IntArray:
        """Number of the observation that each residual belongs to, (m,); -1 where not robust."""
        blocks, n_blocks = [], 0
        for term in self.terms:
            number = np.arange(n_blocks, n_blocks + len(term.index))
            blocks.append(np.repeat(number if term.robust else -1 + 0 * number, term.n_rows))
            n_blocks += len(term.index)
        return np.concatenate(blocks)


def structure_residuals(structure: Structure) -> ca.Function:
    """Return the function (x, observed) -> residuals of all terms, (m,)."""
    x, seen = _symbols(structure)
    found = [
        ca.vec(_mapped(function, index, x, observed))
        for (function, _, _, _), index, observed in _terms(structure, seen)
    ]
    return ca.Function("residuals", [x, seen], [ca.vertcat(ca.MX(0, 1), *found)])


def structure_jacobian(structure: Structure) -> ca.Function:
    """Return the function (x, observed) -> sparse Jacobian of the residuals, (m, n)."""
    n_unknowns = structure.n_unknowns
    x, seen = _symbols(structure)
    values, n_before = [ca.MX(0, 1)], 0
    rows, columns = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for (function, _, _, _), index, observed in _terms(structure, seen):
        n, n_local = index.shape
        n_rows = int(function.size1_out(0))
        values.append(ca.vec(_mapped(_derivative(function), index, x, observed)))
        # CasADi stores columns: of one observation all residuals by its first unknown come first.
        of_observation = np.arange(n * n_rows).reshape(n, 1, n_rows)
        rows.append(n_before + np.repeat(of_observation, n_local, axis=1).ravel())
        columns.append(np.repeat(index.ravel(), n_rows))
        n_before += n * n_rows
    row, column = np.concatenate(rows), np.concatenate(columns)
    order = np.lexsort((row, column))
    order = order[column[order] >= 0]
    first = np.searchsorted(column[order], np.arange(n_unknowns + 1))
    pattern = ca.Sparsity(n_before, n_unknowns, first.tolist(), row[order].tolist())
    jacobian = ca.MX(pattern, ca.vertcat(*values)[order.tolist()])
    return ca.Function("jacobian", [x, seen], [jacobian])


def _symbols(structure: Structure) -> tuple[ca.MX, ca.MX]:
    """Return the unknowns and the parameters of a structure."""
    return ca.MX.sym("x", structure.n_unknowns), ca.MX.sym("observed", structure.n_observed)


def _terms(
    structure: Structure, seen: ca.MX
) -> Iterator[tuple[tuple[ca.Function, tuple[int, ...], bytes, Any], IntArray, list[ca.MX]]]:
    """Return each term with its index and its part of the parameters, observations side by side."""
    place = 0
    for term in structure.terms:
        _, shape, index, shapes = term
        observed = []
        for a, b in shapes:
            size = shape[0] * a * b
            observed.append(ca.reshape(seen[place : place + size], a, shape[0] * b))
            place += size
        yield term, np.frombuffer(index, dtype=np.int64).reshape(shape), observed


def _mapped(function: ca.Function, index: IntArray, x: ca.MX, observed: list[ca.MX]) -> ca.MX:
    """Return a function of (local, *observed) for all observations of a term, side by side."""
    n, n_local = index.shape
    place = np.where(index >= 0, index, x.numel())
    local = ca.reshape(ca.vertcat(x, 0.0)[place.ravel().tolist()], n_local, n)
    mapped: ca.MX = function.map(n)(local, *observed)
    return mapped


def _shape(values: Array) -> tuple[int, int]:
    """Return the shape of what one observation saw, as a matrix."""
    rows, columns = (*values.shape[1:], 1, 1)[:2]
    return rows, columns


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
