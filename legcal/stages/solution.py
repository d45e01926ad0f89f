"""Converged least-squares problems: covariance, and what the residuals do not show.

Both are about the unknowns that many observations share. The others, such as poses, come in
small groups: an orthogonal transformation of the rows of each group leaves rows that do not
contain them, so that no large matrix is ever filled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.csgraph import connected_components

from legcal.geometry.types import Array, BoolArray, IntArray

_RANK = 1e-7  # singular values of the scaled Jacobian below this are directions that nothing shows


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged least-squares problem.

    Attributes
    ----------
    x : (n,) array
        The unknowns.
    residuals : (m,) array
        The residuals there, times the square root of their weights.
    jacobian : (m, n) sparse array
        Their derivative there.
    n_shared : int
        Number of unknowns, the first ones, that many observations share.
    n_iterations : int
        Iterations that IPOPT took, over all weights.
    status : str
        What IPOPT says about the end.
    """

    x: Array
    residuals: Array
    jacobian: csc_array[np.float64]
    n_shared: int
    n_iterations: int
    status: str

    @property
    def cost(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(self.residuals @ self.residuals)

    def without_last(self, n_rows: int) -> Solution:
        """Return what is left without the last residuals, at the same place."""
        n_kept = len(self.residuals) - n_rows
        return replace(self, residuals=self.residuals[:n_kept], jacobian=self.jacobian[:n_kept])

    def covariance(self) -> Array:
        """Return the covariance of the shared unknowns when residuals have unit variance.

        Directions that no residual shows are given none: see :meth:`unseen`.
        """
        scale = column_scale(self.jacobian)
        triangle = _shared_triangle(self.jacobian, scale, self.n_shared)
        scaled = np.linalg.pinv(triangle, rcond=_RANK) * scale[: self.n_shared, None]
        return np.asarray(scaled @ scaled.T)

    def information(self) -> Array:
        """Return whitened rows (n_shared, n_shared) that say the same of the shared unknowns.

        They are derivatives of residuals in standard deviations, the other unknowns being free.
        """
        scale = column_scale(self.jacobian)
        triangle = _shared_triangle(self.jacobian, scale, self.n_shared)
        return np.asarray(triangle / scale[: self.n_shared])

    def unseen(self, n_first: int) -> BoolArray:
        """Return which of the first unknowns can move without changing any residual, (n_first,).

        They are to be among the shared ones.
        """
        scale = column_scale(self.jacobian)
        triangle = _shared_triangle(self.jacobian, scale, self.n_shared)
        rows = _eliminated(triangle[None, :, n_first:], triangle[None, :, :n_first])
        _, singular, directions = np.linalg.svd(rows)
        null = directions[np.count_nonzero(singular >= _RANK) :]
        return np.asarray(np.abs(null).max(axis=0, initial=0.0) > 1e-3)


def column_scale(jacobian: csc_array[np.float64]) -> Array:
    """Return the change of each unknown that moves the residuals by one unit, (n,)."""
    norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=0)).ravel())
    floor = 1e-6 * float(norms.max(initial=0.0)) or 1.0
    return np.asarray(1.0 / np.maximum(norms, floor))


def _shared_triangle(jacobian: csc_array[np.float64], scale: Array, n_shared: int) -> Array:
    """Return R of the scaled Jacobian after the other unknowns are eliminated, square."""
    entries = jacobian.tocoo()
    row, column = np.asarray(entries.row, np.intp), np.asarray(entries.col, np.intp)
    values = entries.data * scale[column]
    own = column >= n_shared
    group_of_row, place_of_column = _groups(jacobian, n_shared)
    alone = group_of_row < 0
    shared_rows = np.zeros((int(alone.sum()), n_shared))
    here = alone[row]
    shared_rows[(np.cumsum(alone) - 1)[row[here]], column[here]] = values[here]
    n_groups = int(group_of_row.max(initial=-1)) + 1
    if n_groups:
        slot = _rank_in_group(group_of_row)
        n_slots, n_own = int(slot.max()) + 1, int(place_of_column.max()) + 1
        filled = np.zeros((n_groups, n_slots, n_own + n_shared))
        place = n_own + column
        place[own] = place_of_column[column[own] - n_shared]
        filled[group_of_row[row[~here]], slot[row[~here]], place[~here]] = values[~here]
        rest = _eliminated(filled[:, :, :n_own], filled[:, :, n_own:])
        shared_rows = np.concatenate([shared_rows, rest])
    reduced = np.asarray(np.linalg.qr(shared_rows, mode="r"))
    return np.vstack([reduced, np.zeros((n_shared - len(reduced), n_shared))])


def _groups(jacobian: csc_array[np.float64], n_shared: int) -> tuple[IntArray, IntArray]:
    """Return the group of each row, -1 for none, and each other unknown's place in its group."""
    n_rows, n = jacobian.shape
    if n == n_shared:
        return np.full(n_rows, -1), np.zeros(0, dtype=np.intp)
    own = jacobian[:, n_shared:]
    _, group = connected_components(own.T @ own, directed=False)
    group_of_row = np.full(n_rows, -1)
    entries = own.tocoo()
    group_of_row[entries.row] = group[entries.col]
    return group_of_row, _rank_in_group(np.asarray(group, np.intp))


def _rank_in_group(group: IntArray) -> IntArray:
    """Return the how-manieth of its group each entry is."""
    order = np.argsort(group, kind="stable")
    in_order = group[order]
    rank = np.zeros(len(group), dtype=np.intp)
    rank[order] = np.arange(len(group)) - np.searchsorted(in_order, in_order)
    return rank


def _eliminated(own: Array, shared: Array) -> Array:
    """Return what the rows [own, shared] of (k, r, n) groups say about the shared unknowns alone.

    Rows are turned until as few as possible contain the own unknowns, which are then dropped.
    """
    n_own, n_shared = own.shape[2], shared.shape[2]
    if n_own == 0:
        return shared.reshape(-1, n_shared)
    rows = np.asarray(np.linalg.qr(np.concatenate([own, shared], axis=2), mode="r"))
    left, singular, _ = np.linalg.svd(rows[:, :, :n_own])
    turned = np.swapaxes(left, 1, 2) @ rows[:, :, n_own:]
    turned[:, : singular.shape[1]][singular >= _RANK] = 0.0
    return np.asarray(turned.reshape(-1, n_shared))
