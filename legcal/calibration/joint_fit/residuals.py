"""Whitened residuals with their derivatives, kind by kind, and how they add up.

Every measurement depends on few unknowns and on one platform pose at most. Measurements that
depend on the same unknowns are summed by one matrix product; what couples them to their poses is
summed by constant sparse matrices that are built once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse import csr_array

from legcal.geometry import Array, IntArray


@dataclass(frozen=True, eq=False)
class Residual:
    """A kind of measurement.

    Attributes
    ----------
    name : str
    n_local, n_data, n_rows : int
        Sizes of what it depends on, of the data and of the residual.
    jacobian : casadi.Function
        (local, data) -> residual and its dense Jacobian by *local*.
    """

    name: str
    n_local: int
    n_data: int
    n_rows: int
    jacobian: ca.Function

    def evaluate(self, local: Array, data: Array) -> tuple[Array, Array]:
        """Return residuals (n, n_rows) and Jacobians (n, n_rows, n_local) of n measurements.

        Parameters
        ----------
        local : (n, n_local) array
        data : (n, n_data) array
        """
        n = len(local)
        r = np.zeros((n, self.n_rows))
        by_local = np.zeros((n, self.n_local, self.n_rows))  # CasADi stores column by column
        if n:
            _fill(_mapped(self, n), [local, data], [r, by_local])
        return r, np.swapaxes(by_local, 1, 2)


def outline_of_leg(A: ca.SX, B: ca.SX, radius: ca.SX, epsilon: ca.SX) -> ca.SX:
    """Return the outline h of the cylinder about AB seen from the origin, eqs (1) and (3).

    Its length is that of A x B squared, of no matter for a line. With n = A x B and D = B - A
    eq (3) is h = epsilon r (D x n) - n sqrt(|n|^2 - |D|^2 r^2) up to that, without a division.
    """
    n, D = ca.cross(A, B), B - A
    depth = ca.sqrt(ca.dot(n, n) - radius**2 * ca.dot(D, D))
    return epsilon * radius * ca.cross(D, n) - depth * n


def offset_in_image(h: ca.SX, xy: ca.SX, J_inverse_transposed: ca.SX) -> ca.SX:
    """Return the signed distance [px] of a point of the sensor plane from the line h.

    The same as :meth:`legcal.vision.camera.Camera.line_offset`, with the derivative of the
    lens at the point given as a constant.
    """
    normal = J_inverse_transposed @ h[:2]
    return (h[0] * xy[0] + h[1] * xy[1] + h[2]) / ca.norm_2(normal)


@cache
def outline_residual() -> Residual:
    """Return the distances [px] of the predicted outline from both ends of the measured one.

    local (11): A and B in the camera frame, radius [m], both ends on the sensor plane. data (9):
    J^-T at the ends (2 x 4, column by column), epsilon.
    """
    local, data = ca.SX.sym("local", 11), ca.SX.sym("data", 9)
    h = outline_of_leg(local[0:3], local[3:6], local[6], data[8])
    offsets = [
        offset_in_image(
            h,
            local[7 + 2 * end : 9 + 2 * end],
            ca.reshape(data[4 * end : 4 + 4 * end], 2, 2),
        )
        for end in range(2)
    ]
    return _residual("outline", local, data, ca.vertcat(*offsets))


@cache
def axis_residual() -> Residual:
    """Return how far a leg's predicted axis is from a measured one: alpha1, alpha2, beta1, beta2.

    The measured axis passes through M along e1 x e2. alpha is the predicted direction in e1 and
    e2, over its part along the axis; beta is where the predicted axis meets the plane through
    M with these directions, from M [m].

    local (6): A and B in the camera frame [m]. data (9): M, e1, e2.
    """
    local, data = ca.SX.sym("local", 6), ca.SX.sym("data", 9)
    A, leg = local[0:3], local[3:6] - local[0:3]
    M, e1, e2 = data[0:3], data[3:6], data[6:9]
    basis, along = ca.horzcat(e1, e2).T, ca.cross(e1, e2)
    slope = leg / ca.dot(along, leg)
    to_A = A - M
    beta = basis @ (to_A - slope * ca.dot(along, to_A))
    return _residual("axis", local, data, ca.vertcat(basis @ slope, beta))


@cache
def corner_residual() -> Residual:
    """Return how far a predicted corner of the calibration board is from the measured one [px].

    local (5): the corner in the camera frame [m], the measured one on the sensor plane. data (4):
    the derivative of pixels by the sensor plane there (2 x 2, column by column).
    """
    local, data = ca.SX.sym("local", 5), ca.SX.sym("data", 4)
    away = local[:2] / local[2] - local[3:]
    return _residual("corner", local, data, ca.reshape(data, 2, 2) @ away)


@cache
def encoder_residual() -> Residual:
    """Return the closure of a leg, |AB| - sign q - q0 [m].

    local (7): A and B in R_b, q0 [m]. data (1): sign * q [m].
    """
    local, data = ca.SX.sym("local", 7), ca.SX.sym("data", 1)
    closure = ca.norm_2(local[3:6] - local[0:3]) - data - local[6]
    return _residual("encoder", local, data, closure)


@cache
def prior_residual() -> Residual:
    """Return the distance of an unknown from its prior in standard deviations.

    local (1): the unknown. data (2): mean, 1 / sigma.
    """
    local, data = ca.SX.sym("local", 1), ca.SX.sym("data", 2)
    return _residual("prior", local, data, (local - data[0]) * data[1])


def _residual(name: str, local: ca.SX, data: ca.SX, r: ca.SX) -> Residual:
    """Return a kind of measurement with its Jacobian."""
    options = {"cse": True}
    by_local = ca.densify(ca.jacobian(r, local))
    return Residual(
        name,
        local.size1(),
        data.size1(),
        r.size1(),
        ca.Function(f"{name}_jacobian", [local, data], [r, by_local], options),
    )


@lru_cache(maxsize=64)
def _mapped(residual: Residual, n: int) -> ca.Function:
    """Return the Jacobian over n measurements."""
    return residual.jacobian.map(n)


def _fill(function: ca.Function, inputs: list[Array], outputs: list[Array]) -> None:
    """Evaluate on NumPy's memory, row by row of measurements, without copies."""
    buffer: Any
    buffer, evaluate = function.buffer()
    kept = [np.ascontiguousarray(array, dtype=np.float64) for array in inputs]
    for i, array in enumerate(kept):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(outputs):
        buffer.set_res(i, array.data)
    evaluate()


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
