"""Outlines that a view is fitted to, and how far predicted ones are from them."""

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import main_cylinders
from legcal.observations.outlines import Outlines
from legcal.recognition.groups import Group
from legcal.recognition.searching import Search
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

EDGE_SIGMA = 0.3  # of an outline: what its covariance does not know, as a wrong gamma [px]
NUDGE = 1e-6  # of finite differences [m]


@dataclass(frozen=True, eq=False)
class Lines:
    """Outlines to fit, by item: a leg in an image."""

    view: IntArray  # (n,)
    item: IntArray  # (n,)
    leg: IntArray  # (n,)
    A: Array  # (n, 3) by the model, in the base link [m]
    B: Array
    radius: Array  # (n,)
    edge: IntArray  # (n,) 0 where epsilon is +1, 1 where it is -1
    ends: Array  # (n, 2, 2) on the sensor plane
    metric: Array  # (n, 2, 2, 2), see metric_of
    whitening: Array  # (n, 2, 2)
    item_row: IntArray  # (n_items,)
    item_leg: IntArray
    first: IntArray  # (n_items,) its first outline: those of an item follow each other
    size: IntArray  # (n_items,) offsets that were measured

    @property
    def n_items(self) -> int:
        """Number of legs in images."""
        return len(self.item_row)

    def summed(self, values: Array) -> Array:
        """Return sums of values (n, ...) over the outlines of each item, (n_items, ...)."""
        return np.asarray(np.add.reduceat(values, self.first, axis=0))


def lines_of(search: Search, group: Group, outlines: Outlines) -> Lines | None:
    """Return the used outlines of a group."""
    used = np.flatnonzero(outlines.used & np.isin(outlines.row, group.rows))
    if len(used) == 0:
        return None
    used = used[np.lexsort([outlines.leg[used], outlines.row[used]])]
    row, leg = outlines.row[used], outlines.leg[used]
    of_leg = [main_cylinders(cylinders) for cylinders in search.cylinders]
    parts = zip(leg.tolist(), used.tolist(), strict=True)
    radius = np.array([of_leg[j][outlines.part[i]].radius for j, i in parts])
    view = search.measurements.view[row]
    ends, metric = np.empty((len(used), 2, 2)), np.empty((len(used), 2, 2, 2))
    for v in np.unique(view).tolist():
        own, camera = view == v, search.measurements.views[v].camera
        ends[own] = camera.undistort(outlines.ends[used[own]])
        metric[own] = metric_of(camera, ends[own])
    covariance = outlines.covariance[used] + EDGE_SIGMA**2 * np.eye(2)
    begins = (np.diff(row, prepend=-1) != 0) | (np.diff(leg, prepend=-1) != 0)
    first = np.flatnonzero(begins)
    return Lines(
        view,
        np.cumsum(begins) - 1,
        leg,
        search.A_base[row, leg],
        search.B_base[row, leg],
        radius,
        outlines.edge[used] - 1,
        ends,
        metric,
        np.linalg.inv(np.linalg.cholesky(covariance)),
        row[first],
        leg[first],
        first,
        2 * np.diff(np.append(first, len(used))),
    )


def offsets_of(
    X: Array, radius: Array, edge: IntArray, ends: Array, metric: Array
) -> tuple[Array, Array]:
    """Return how far points are from outlines, and the derivatives by the joints of the legs.

    Parameters
    ----------
    X : (n, 2, 3) array
        A and B in the frame of the camera [m].
    radius : (n,) array
        Radii [m].
    edge : (n,) array of int
        0 for the outline of epsilon +1, 1 for that of epsilon -1.
    ends : (n, 2, 2) array
        Two points on the sensor plane.
    metric : (n, 2, 2, 2) array
        What makes normals of lines on the sensor plane those in the picture there [1/px].

    Returns
    -------
    offset : (n, 2) array
        In the picture [px].
    derivative : (n, 2, 2, 3) array
        By A and B [px/m].
    """
    nudges = NUDGE * np.concatenate([np.zeros((1, 6)), np.eye(6)]).reshape(7, 1, 2, 3)
    moved = X + nudges
    u = moved[:, :, 1] - moved[:, :, 0]
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    both = outlines_of_axis(u, moved[:, :, 0], radius)
    h = both[:, np.arange(len(X)), edge]  # (7, n, 3)
    value = np.einsum("knx,nex->kne", h[..., :2], ends) + h[..., 2:]
    normal = np.einsum("nexy,kny->knex", metric, h[..., :2])
    offset = value / np.linalg.norm(normal, axis=-1)
    derivative = np.moveaxis((offset[1:] - offset[0]) / NUDGE, 0, -1)
    return offset[0], derivative.reshape(-1, 2, 2, 3)


def metric_of(camera: Camera, ends: Array) -> Array:
    """Return what makes normals of lines (..., 2) those in the picture at points (..., 2)."""
    return np.asarray(np.swapaxes(np.linalg.inv(camera.pixels_per_unit(ends)), -1, -2))


def derivatives_by(D: Array, from_centre: Array, R: Array) -> Array:
    """Return derivatives (n, 2, 15) from those by A and B in the frame of the group."""
    turning = np.cross(from_centre[:, None], D).sum(axis=2)
    in_base = D @ R
    of_A, of_B = in_base[:, :, 0], in_base[:, :, 1]
    return np.concatenate([turning, D.sum(axis=2), of_A, of_B, of_B], axis=-1)
