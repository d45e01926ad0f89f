"""Section 3.2: the base joint centres in the camera frames, eq (6).

All axes of one leg in the images of one view meet in its base joint centre A. The centre is
the point nearest to them: linear least squares, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.stages.nominal import Criteria, NominalMechanism

_REWEIGHTINGS = 10
_OUTLIER = 3.0  # an axis that misses A by this many times the median has half its weight
_NO_NOISE = 1e-3  # standard deviations: smaller misses are rounding
_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one
_LARGEST_SIGMA = 0.1  # of the distance to the camera


@dataclass(frozen=True, eq=False)
class JointsInCamera:
    """Base joint centres in the frame of each view.

    Attributes
    ----------
    A_camera : (n_views, n_legs, 3) array
        Centres in the camera frame [m]; zero where not located.
    located : (n_views, n_legs) array of bool
        Which centres were located.
    covariance : (n_views, n_legs, 3, 3) array
        Covariance of the centres [m^2]; zero where not located.
    diagnostics : tuple of str
        Which legs were left out of which views, and why.
    """

    A_camera: Array
    located: BoolArray
    covariance: Array
    diagnostics: tuple[str, ...]


def locate_joints_in_cameras(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> JointsInCamera:
    """Locate each base joint centre in each camera frame, eq (6).

    Parameters
    ----------
    mechanism : NominalMechanism
        Names and number of the legs.
    axes : LegAxes
        Leg axes in the camera frames.
    measurements : Measurements
        The view of each image.
    criteria : {"default", "literal"}
        ``literal`` solves (6) as printed, every equation with the same weight.

    Returns
    -------
    JointsInCamera

    Raises
    ------
    NotIdentifiable
        If some leg is not located in any view: each needs two different directions in one.

    Notes
    -----
    The default weights the distance of A from each axis by the covariance of the axis there:
    an outline pair says very exactly in which plane through the camera centre A lies, and
    little about its depth. The covariance at A depends on A, so the weights are computed
    again a few times, and axes that miss the others by far are given less.
    """
    n_views, n_legs = len(measurements.views), mechanism.n_legs
    A_camera = np.zeros((n_views, n_legs, 3))
    covariance = np.zeros((n_views, n_legs, 3, 3))
    located = np.zeros((n_views, n_legs), dtype=np.bool_)
    key = measurements.view[axes.row] * n_legs + axes.leg
    views, legs = np.divmod(np.unique(key), n_legs)
    bundles = _Bundles.of(key)
    information = plain_information(axes, bundles)
    counts = bundles.counts.tolist()
    reasons = [_too_few_directions(*told) for told in zip(information[0], counts, strict=True)]
    clear = np.array([not reason for reason in reasons], dtype=np.bool_)
    A, C = nearest_points((information[0][clear], information[1][clear]))
    if criteria == "default" and clear.any():
        A, C = weighted_points(axes, bundles.some(clear), A)
        for k, i in enumerate(np.flatnonzero(clear)):
            reasons[i] = _too_uncertain(A[k], C[k])
    found = np.array([not reason for reason in reasons], dtype=np.bool_)
    v, j = views[found], legs[found]
    A_camera[v, j], covariance[v, j], located[v, j] = A[found[clear]], C[found[clear]], True
    diagnostics = [
        f"The base joint of leg {mechanism.leg_names[int(j)]} in view "
        f"{measurements.views[int(v)].name} was left out: {reason}."
        for v, j, reason in zip(views, legs, reasons, strict=True)
        if reason
    ]
    _check_every_leg(mechanism, located, diagnostics)
    return JointsInCamera(A_camera, located, covariance, tuple(diagnostics))


@dataclass(frozen=True, eq=False)
class _Bundles:
    """Axes in bundles, each of one leg in one view, whose axes meet in one point.

    ``rows`` (k,) are the axes, bundle by bundle, and ``counts`` how many each bundle has.
    """

    rows: IntArray
    counts: IntArray

    @classmethod
    def of(cls, key: IntArray) -> _Bundles:
        """Return the bundles of axes with equal keys, by key."""
        return cls(np.argsort(key, kind="stable"), np.unique(key, return_counts=True)[1])

    @property
    def bundle(self) -> IntArray:
        """The bundle of each of ``rows``, (k,)."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def some(self, wanted: BoolArray) -> _Bundles:
        """Return some of the bundles."""
        return _Bundles(self.rows[wanted[self.bundle]], self.counts[wanted])

    def total(self, values: Array) -> Array:
        """Return the sum over each bundle of values of ``rows``."""
        return np.asarray(np.add.reduceat(values, np.cumsum(self.counts) - self.counts))

    def median(self, values: Array) -> Array:
        """Return the median over each bundle of values (k,) of ``rows``."""
        ordered = values[np.lexsort((values, self.bundle))]
        first = np.cumsum(self.counts) - self.counts
        low, high = first + (self.counts - 1) // 2, first + self.counts // 2
        return np.asarray(0.5 * (ordered[low] + ordered[high]))


def plain_information(axes: LegAxes, bundles: _Bundles) -> tuple[Array, Array]:
    """Return the normal equations of (6), (n, 3, 3) and (n, 3): sums of I - u u' and of its M."""
    u, M = axes.u[bundles.rows], axes.M[bundles.rows]
    normal = np.eye(3) - u[:, :, None] * u[:, None, :]
    return bundles.total(normal), bundles.total(np.einsum("kij,kj->ki", normal, M))


def nearest_points(information: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the least-squares points A (n, 3) and the inverses of their normal matrices."""
    inverse = np.asarray(np.linalg.inv(information[0]))
    return np.asarray((inverse @ information[1][..., None])[..., 0]), inverse


def weighted_points(axes: LegAxes, bundles: _Bundles, A: Array) -> tuple[Array, Array]:
    """Return the points nearest to axes in units of their covariances, and their covariances."""
    E, M = axes.basis[bundles.rows], axes.M[bundles.rows]
    across, bundle = np.swapaxes(E, -1, -2), bundles.bundle
    C = np.zeros((len(A), 3, 3))
    for _ in range(_REWEIGHTINGS):
        residual, spread = miss(axes, bundles.rows, A[bundle])
        weight = np.linalg.inv(spread)
        chi = np.sqrt(np.einsum("ki,kij,kj->k", residual, weight, residual))
        limit = np.maximum(_OUTLIER * bundles.median(chi), _NO_NOISE)[bundle]
        weight = weight / (1.0 + (chi / limit) ** 2)[:, None, None]
        normal = across @ weight @ E
        right = (normal @ M[..., None])[..., 0]
        A, C = nearest_points((bundles.total(normal), bundles.total(right)))
    return A, C


def miss(axes: LegAxes, here: IntArray, A: Array) -> tuple[Array, Array]:
    """Return by how much axes miss points, in e1 and e2, and the covariance of that.

    Parameters
    ----------
    axes : LegAxes
        Axes.
    here : (k,) array of int
        Which of them.
    A : (3,) or (k, 3) array
        Points in the same frame [m].

    Returns
    -------
    (k, 2) array [m], (k, 2, 2) array [m^2]
        The axis at the height s of the point is M + s u + e (beta + s alpha).
    """
    arm = A - axes.M[here]
    residual = np.einsum("kia,ka->ki", axes.basis[here], arm)
    s = np.sum(arm * axes.u[here], axis=-1)
    C, s = axes.covariance[here], s[:, None, None]
    mixed = C[:, :2, 2:]
    spread = s**2 * C[:, :2, :2] + s * (mixed + np.swapaxes(mixed, 1, 2)) + C[:, 2:, 2:]
    return residual, spread


def _too_few_directions(information: Array, n_images: int) -> str:
    """Return why (6) has no single solution, or an empty string."""
    smallest = float(np.linalg.eigvalsh(information)[0])
    if smallest > _SAME_DIRECTION * n_images:
        return ""
    if n_images == 1:
        return "it was found in one image, and at least two different directions are needed"
    return f"its direction is the same in all {n_images} images, and two are needed"


def _too_uncertain(A: Array, covariance: Array) -> str:
    """Return why a centre says nothing, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    distance = float(np.linalg.norm(A))
    if sigma <= _LARGEST_SIGMA * distance:
        return ""
    return (
        f"its directions differ too little to say where they meet (sigma {1e3 * sigma:.0f} mm "
        f"at {1e3 * distance:.0f} mm from the camera)"
    )


def _check_every_leg(
    mechanism: NominalMechanism, located: BoolArray, diagnostics: list[str]
) -> None:
    """Refuse when a leg was located in no view."""
    missing = [mechanism.leg_names[int(j)] for j in np.flatnonzero(~located.any(axis=0))]
    if missing:
        raise NotIdentifiable(
            [
                f"The base joint of leg {name} could not be located: found no view that shows the "
                "leg in two different directions, needed one; add images in which it is visible."
                for name in missing
            ]
            + diagnostics
        )
