"""Whitened residuals with their derivatives, kind by kind, and how they add up.

Every measurement depends on few unknowns and on one platform pose at most. Measurements that
depend on the same unknowns are summed by one matrix product; what couples them to their poses is
summed by constant sparse matrices that are built once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

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
    groups : tuple of (array of int, array of int)
        Measurements that depend on the same unknowns, and these.
    to_kept : sparse ((n_kept + 1) n_poses, n m) array
        Sums what couples unknowns to poses.
    to_pose : sparse (n_poses, n) array
        Sums over the measurements of a pose.
    """

    index: IntArray
    pose: IntArray
    n_kept: int
    n_poses: int
    groups: tuple[tuple[IntArray, IntArray], ...]
    to_kept: csr_array
    to_pose: csr_array


def places(index: IntArray, pose: IntArray, n_kept: int, n_poses: int) -> Places:
    """Return the places of measurements that depend on unknowns at *index* and on poses."""
    index = np.minimum(index, n_kept)
    n, m = index.shape
    if n:
        columns, group = np.unique(index, axis=0, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        members = np.split(order, np.cumsum(np.bincount(group.ravel()))[:-1])
    else:
        columns, members = index, []
    row = (index * n_poses + pose[:, None]).ravel()
    ones = np.ones(n * m)
    return Places(
        index,
        pose,
        n_kept,
        n_poses,
        tuple(zip(members, columns, strict=True)),
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
        n, _, m = rows.J.shape
        if n == 0:
            continue
        for member, column in where.groups:
            J = rows.J[member].reshape(-1, m)
            U[np.ix_(column, column)] += J.T @ J
            g_kept[column] += J.T @ rows.r[member].ravel()
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
