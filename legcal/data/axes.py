"""Axes of legs in camera frames: from pairs of outlines, or as Table 1 of the paper states them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from legcal.brief import brief
from legcal.data.image_tables import ImageTable
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.errors import NotVisible
from legcal.geometry.lines import cross, nearest_point_to_line, normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.vision.camera import Camera
from legcal.vision.cylinder import axis_of_outlines, direction_derivative, direction_of_angles

_FLOOR_PX = 1e-3  # minimum standard deviation of an outline: keeps weights finite for any file


@brief
@dataclass(frozen=True, eq=False)
class LegAxes(ImageTable):
    """Axes of legs in camera frames, oriented from base to platform: the input of steps 1 to 4.

    The errors of an axis: ``u + alpha1 e1 + alpha2 e2`` through ``M + beta1 e1 + beta2 e2``.
    """

    leg: IntArray  # (n,)
    u: Array  # (n, 3) unit directions in the camera
    M: Array  # (n, 3) a point of each axis in the camera [m]
    basis: Array  # (n, 2, 3) unit vectors e1, e2 normal to u
    covariance: Array  # (n, 4, 4) of (alpha1, alpha2, beta1, beta2) [rad, rad, m, m]

    def row_keys(self) -> list[tuple[int, int]]:
        """Return image row and leg of each axis."""
        return list(zip(self.row.tolist(), self.leg.tolist(), strict=True))


def axes_from_outlines(
    outlines: Outlines,
    measurements: Measurements,
    radius_of_part: Mapping[str, float],  # radius of each cylinder by its URDF link [m]
) -> LegAxes:
    """Return the axis of every leg with two used outlines, eqs (4) and (5).

    The cylinders of one leg in one image (a tube and a rod) share an axis: they are joined,
    weighted by their covariances.
    """
    pairs = _pairs(outlines)
    if len(pairs) == 0:
        raise NotVisible(
            "Leg axes could not be computed: no leg has both outlines in any image; at least "
            "two images of every leg are needed; check the camera poses and the detection."
        )
    radius = np.array([radius_of_part[outlines.part[first]] for first in pairs[:, 0]])
    h = outlines.h[pairs]
    u, M = axis_of_outlines(h[:, 0], h[:, 1], radius)
    view = measurements.view[outlines.row[pairs[:, 0]]]
    rays, h_of_offset = _end_rays_and_derivatives(outlines, pairs, view, measurements)
    middle = rays.mean(axis=(1, 2))
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    M = nearest_point_to_line(u, M, middle, np.zeros(3))
    basis = normal_basis(u)
    derivative = axis_derivative(h, h_of_offset, u, M, basis)
    offsets = np.zeros((len(pairs), 4, 4))
    offsets[:, :2, :2] = outlines.covariance[pairs[:, 0]]
    offsets[:, 2:, 2:] = outlines.covariance[pairs[:, 1]]
    offsets += _FLOOR_PX**2 * np.eye(4)
    covariance = derivative @ offsets @ np.swapaxes(derivative, -1, -2)
    separate = LegAxes(
        outlines.row[pairs[:, 0]], outlines.leg[pairs[:, 0]], u, M, basis, covariance
    )
    return join_axes(separate, separate.row)


def axis_derivative(
    h: Array,  # (n, 2, 3) unit normals of both outlines
    h_of_offset: Array,  # (n, 2, 2
    u: Array,  # (n, 3)
    M: Array,  # (n, 3)
    basis: Array,  # (n, 2, 3) e1 and e2 of each axis
) -> Array:
    """Return the derivative of axes with respect to the offsets of both outlines.

    A change of h_i must keep h_i . u = 0 (4) and h_i . M = epsilon_i R (5), so the
    changes of u and of M solve the same 2 x 2 system.
    """
    system = np.einsum("nia,nja->nij", h, basis)
    change = np.zeros((len(u), 2, 2, 4))  # (n, equation i, of u or of M, offset)
    for i in range(2):
        for column, point in enumerate((u, M)):
            change[:, i, column, 2 * i : 2 * i + 2] = -np.einsum(
                "nea,na->ne", h_of_offset[:, i], point
            )
    solved = np.linalg.solve(system, change.reshape(len(u), 2, 8)).reshape(len(u), 2, 2, 4)
    return np.concatenate([solved[:, :, 0], solved[:, :, 1]], axis=1)


def join_axes(
    axes: LegAxes,
    group: IntArray,  # (n,) axes with the same group and leg are observations of one line
) -> LegAxes:
    """Return one axis for each leg in each group of rows, weighted by the covariances."""
    keys = np.stack([group, axes.leg], axis=1)
    _, first, which, count = np.unique(
        keys, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    u, M, basis, covariance = (
        part[first] for part in (axes.u, axes.M, axes.basis, axes.covariance)
    )
    several = np.flatnonzero(count > 1)
    if len(several):
        members = np.flatnonzero(count[which.ravel()] > 1)
        line = np.searchsorted(several, which.ravel()[members])
        u[several], M[several], basis[several], covariance[several] = _joined(
            axes, first[several], members, line
        )
    return LegAxes(axes.row[first], axes.leg[first], u, M, basis, covariance)


def _joined(
    axes: LegAxes,
    first: IntArray,  # (m,) the first observation of each line, in whose basis the mean is taken
    members: IntArray,  # (n,)
    line: IntArray,  # (n,)
) -> tuple[Array, Array, Array, Array]:
    """Return u, M, basis and covariance of the weighted mean of the observations of each line."""
    u, M, basis = axes.u[first], axes.M[first], axes.basis[first]
    E = basis[line]
    # Each observation at the height of the first one's M, written in its basis.
    slope = axes.u[members] / np.sum(axes.u[members] * u[line], axis=-1, keepdims=True)
    shift = np.sum(u[line] * (M[line] - axes.M[members]), axis=-1)
    point = axes.M[members] + shift[:, None] * slope - M[line]
    value = np.concatenate([E @ slope[..., None], E @ point[..., None]], axis=1)
    turn = E @ np.swapaxes(axes.basis[members], -1, -2)
    move = np.zeros((len(line), 4, 4))
    move[:, :2, :2] = move[:, 2:, 2:] = turn
    move[:, 2:, :2] = shift[:, None, None] * turn
    weight = np.linalg.inv(move @ axes.covariance[members] @ np.swapaxes(move, -1, -2))
    information, weighted = np.zeros((len(first), 4, 4)), np.zeros((len(first), 4, 1))
    np.add.at(information, line, weight)
    np.add.at(weighted, line, weight @ value)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    change = (covariance @ weighted)[..., 0]
    u += np.einsum("nia,ni->na", basis, change[:, :2])
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    M += np.einsum("nia,ni->na", basis, change[:, 2:])
    # Carry e1 along so that the covariance keeps its meaning.
    e1 = basis[:, 0] - u * np.sum(u * basis[:, 0], axis=-1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    return u, M, np.stack([e1, cross(u, e1)], axis=1), covariance


def _pairs(outlines: Outlines) -> IntArray:
    """Return the indices (edge 1, edge 2) of outlines of one cylinder in one image, (n, 2)."""
    edges_of_part: dict[tuple[int, int, str], dict[int, int]] = {}
    for i in np.flatnonzero(outlines.used):
        key = (int(outlines.row[i]), int(outlines.leg[i]), outlines.part[i])
        edges_of_part.setdefault(key, {})[int(outlines.edge[i])] = int(i)
    pairs = [(edges[1], edges[2]) for _, edges in sorted(edges_of_part.items()) if len(edges) == 2]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def _end_rays_and_derivatives(
    outlines: Outlines, pairs: IntArray, view: IntArray, measurements: Measurements
) -> tuple[Array, Array]:
    """Return the rays (x, y, 1) of the ends (n, 2, 2, 3) and d h / d offsets (n, 2, 2, 3)."""
    rays = np.empty((len(pairs), 2, 2, 3))
    derivative = np.empty((len(pairs), 2, 2, 3))
    for v in np.unique(view):
        view_pairs = pairs[view == v]
        camera = measurements.views[v].camera
        rays[view == v], derivative[view == v] = outline_derivative(
            camera, outlines.h[view_pairs], outlines.ends[view_pairs]
        )
    return rays, derivative


def outline_derivative(
    camera: Camera,
    h: Array,  # (..., 3) unit normals of outlines, in its frame
    ends: Array,  # (..., 2, 2) their ends [px]
) -> tuple[Array, Array]:
    """Return the rays of an outline's ends and the derivative of its normal by offsets of the ends.

    Returns rays (..., 2, 3); derivative (..., 2, 3) [1/px].
    """
    xy = camera.undistort(ends)
    ones = np.ones((*xy.shape[:-1], 1))
    rays = np.concatenate([xy, ones], axis=-1)
    # The line follows an offset of an end: (h + dh) . ray = -dvalue keeps the point on it.
    J = camera.pixels_per_unit(xy)
    ab = np.broadcast_to(h[..., None, :2], xy.shape)
    normal = np.linalg.solve(np.swapaxes(J, -1, -2), ab[..., None])[..., 0]
    moved = np.linalg.norm(normal, axis=-1)  # d (h . ray) / d offset
    # dh is normal to h, zero on the ray of the other end, and -moved on the ray of this end.
    other_rays = rays[..., ::-1, :]
    direction = cross(np.broadcast_to(h[..., None, :], rays.shape), other_rays)
    scale = -moved / np.sum(direction * rays, axis=-1)
    return rays, direction * scale[..., None]


def axes_of_table(
    row: IntArray,  # (n,)
    leg: IntArray,  # (n,)
    values: Array,  # (n, 4) psi, theta [rad] and x, z [m] in the camera frame
    sigmas: Array,  # (n, 4) their standard deviations; their errors are independent
) -> LegAxes:
    """Return axes from their Euler angles psi, theta and their points M_LS = (x, 0, z).

    See :mod:`legcal.vision.cylinder` for the angles.
    """
    psi, theta, x, z = values.T
    u = direction_of_angles(psi, theta)
    M = np.stack([x, np.zeros_like(x), z], axis=-1)
    basis = normal_basis(u)
    scaled = _table_derivative(basis, psi, theta) * sigmas[:, None, :]
    return LegAxes(row, leg, u, M, basis, scaled @ np.swapaxes(scaled, -1, -2))


def _table_derivative(basis: Array, psi: Array, theta: Array) -> Array:
    """Return d (alpha, beta) / d (psi, theta, x, z), (n, 4, 4)."""
    derivative = np.zeros((len(basis), 4, 4))
    derivative[:, :2, :2] = basis @ direction_derivative(psi, theta)
    derivative[:, 2:, 2:] = basis[:, :, [0, 2]]
    return derivative
