"""Whitened residuals with their derivatives, kind by kind, and how they add up.

Every measurement depends on few unknowns and on one platform pose at most. Measurements that
depend on the same unknowns are summed by one matrix product; what couples them to their poses is
summed by constant sparse matrices that are built once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

from legcal.geometry.types import Array, IntArray


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened residuals of n measurements of a kind.

    Attributes
    ----------
    r : (n, q) array
        Residuals.
    slope : (n, q, l) array
        Derivatives by what the residuals depend on directly.
    chain : callable
        Turns slopes into derivatives J by unknowns and J_pose by poses.
    """

    r: Array
    slope: Array
    chain: Callable[[Array], tuple[Array, Array]]

    @cached_property
    def _derivatives(self) -> tuple[Array, Array]:
        return self.chain(self.slope)

    @property
    def J(self) -> Array:
        """Derivatives by the unknowns of the kind's :class:`Places`, (n, q, m)."""
        return self._derivatives[0]

    @property
    def J_pose(self) -> Array:
        """Derivatives by rotation [rad] and displacement [m] of the platform, (n, q, 6)."""
        return self._derivatives[1]

    @cached_property
    def squared_norms(self) -> Array:
        """Squared norms of the residuals, (n,)."""
        return np.asarray(np.einsum("nq,nq->n", self.r, self.r))

    def whitened(self, T: Array) -> Rows:
        """Return the rows times lower triangular T (n, q, q)."""
        return Rows((T @ self.r[..., None])[..., 0], T @ self.slope, self.chain)

    def scaled(self, factor: float) -> Rows:
        """Return the rows times a number."""
        return Rows(factor * self.r, factor * self.slope, self.chain)

    def softened(self, k: float) -> Rows:
        """Return rows whose plain squares have gradient and curvature of the robust loss.

        The loss of narrowness k has the gradient w r and the curvature w (1 - k w^2 r r^T), with w
        = 1 / sqrt(1 + k s); both are positive, so that its square root is a factor of the rows.
        """
        if k == 0.0:
            return self
        s = self.squared_norms
        root = np.sqrt(1.0 + k * s)
        along = (1.0 - 1.0 / root) / np.maximum(s, 1e-300)
        part = along[:, None] * np.einsum("nq,nqm->nm", self.r, self.slope)
        slope = self.slope - self.r[..., None] * part[:, None]
        slope /= np.sqrt(root)[:, None, None]
        return Rows(np.sqrt(root)[:, None] * self.r, slope, self.chain)


@dataclass(frozen=True, eq=False)
class Places:
    """What the measurements of a kind depend on, and the constant matrices that add them up.

    Attributes
    ----------
    index : (n, m) array of int
        Positions in x; ``n_kept`` or more for what is no unknown.
    pose : (n,) array of int
    n_kept, n_poses : int
    order : (n,) array of int
        Measurements that depend on the same unknowns one after the other: they are a group.
    bounds : tuple of (int, int)
        Where each group begins and ends in that order.
    columns : (n_groups, m) array of int
        The unknowns of each group.
    to_kept : sparse ((n_kept + 1) n_poses, n m) array
        Sums what couples unknowns to poses.
    to_pose : sparse (n_poses, n) array
        Sums over the measurements of a pose.
    """

    index: IntArray
    pose: IntArray
    n_kept: int
    n_poses: int
    order: IntArray
    bounds: tuple[tuple[int, int], ...]
    columns: IntArray
    to_kept: csr_array
    to_pose: csr_array

    @property
    def groups(self) -> list[tuple[IntArray, IntArray]]:
        """The measurements of each group and its unknowns."""
        members = [self.order[start:end] for start, end in self.bounds]
        return list(zip(members, self.columns, strict=True))


def places(index: IntArray, pose: IntArray, n_kept: int, n_poses: int) -> Places:
    """Return the places of measurements that depend on unknowns at *index* and on poses."""
    index = np.minimum(index, n_kept)
    n, m = index.shape
    columns, group = np.unique(index, axis=0, return_inverse=True) if n else (index, pose)
    ends = np.cumsum(np.bincount(group.ravel())).tolist()
    row = (index * n_poses + pose[:, None]).ravel()
    ones = np.ones(n * m)
    return Places(
        index,
        pose,
        n_kept,
        n_poses,
        np.argsort(group.ravel(), kind="stable"),
        tuple(pairwise([0, *ends])),
        columns,
        csr_array((ones, (row, np.arange(n * m))), shape=((n_kept + 1) * n_poses, n * m)),
        csr_array((ones[:n], (pose, np.arange(n))), shape=(n_poses, n)),
    )


@dataclass(frozen=True, eq=False)
class Sums:
    """J^T J and J^T r of all measurements, by blocks.

    Attributes
    ----------
    U : (n_kept, n_kept) array
    W : (n_kept, n_poses, 6) array
    V : (n_poses, 6, 6) array
    g_kept, g_pose : (n_kept,) and (n_poses, 6) array
    """

    U: Array
    W: Array
    V: Array
    g_kept: Array
    g_pose: Array


def summed(kinds: list[tuple[Places, Rows]], n_kept: int, n_poses: int) -> Sums:
    """Sum the measurements of all kinds."""
    U, g_kept = np.zeros((n_kept + 1, n_kept + 1)), np.zeros(n_kept + 1)
    W = np.zeros(((n_kept + 1) * n_poses, 6))
    V, g_pose = np.zeros((n_poses, 36)), np.zeros((n_poses, 6))
    for where, rows in kinds:
        n, q, m = rows.J.shape
        if n == 0:
            continue
        J, r = rows.J[where.order].reshape(n * q, m), rows.r[where.order].ravel()
        squares, products = np.empty((len(where.bounds), m, m)), np.empty((len(where.bounds), m))
        for group, (start, end) in enumerate(where.bounds):
            of_group = slice(q * start, q * end)
            squares[group] = J[of_group].T @ J[of_group]
            products[group] = r[of_group] @ J[of_group]
        np.add.at(U, (where.columns[:, :, None], where.columns[:, None, :]), squares)
        np.add.at(g_kept, where.columns, products)
        J_pose = rows.J_pose
        W += where.to_kept @ (np.swapaxes(rows.J, 1, 2) @ J_pose).reshape(n * m, 6)
        V += where.to_pose @ (np.swapaxes(J_pose, 1, 2) @ J_pose).reshape(n, 36)
        g_pose += where.to_pose @ np.einsum("nqi,nq->ni", J_pose, rows.r)
    return Sums(
        U[:n_kept, :n_kept],
        W.reshape(n_kept + 1, n_poses, 6)[:n_kept],
        V.reshape(n_poses, 6, 6),
        g_kept[:n_kept],
        g_pose,
    )
