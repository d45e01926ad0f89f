"""What was measured, as arrays that the residuals take: outlines in the image, readings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.errors import DatasetError
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import LegKind
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.legs import FittedLegs
from legcal.refinement.unknown_gammas import cameras_of, mixed_gammas, movements_by_gamma
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.intrinsics import shared_cameras


@dataclass(frozen=True, eq=False)
class ObservedOutlines:
    """The outlines that enter the fit, n of them.

    Attributes
    ----------
    index : (n,) array of int
        Rows of the table of outlines.
    leg, view, pose, radius : (n,) array of int
        Indices; ``radius`` counts in ``parts``.
    feet : (n, 2, 2) array
        Points of the measured outline at both ends of the used piece, on the sensor plane.
    pixels : (n, 2, 2) array
        The same points in the image [px].
    constants : (n, 9) array
        What the residual needs besides: the inverse transposed derivative of pixels at
        these points [1/px], column by column, and epsilon of eq (5).
    covariance : (n, 2, 2) array
        Claimed covariance of the offsets at both ends [px^2].
    parts : tuple of (int, str)
        Leg index and part of each radius, sorted by leg and name.
    views : tuple of str
        Names of the views.
    series : (n_views,) array of int
        The view that stands for each: the first of those that show one image each with the same
        camera, as one that is held in the hand does; else itself.
    cameras : tuple of str
        The view that stands for the camera of each view.
    by_gamma : (n,) array
        How far each moves towards the inside with the logarithm of the gamma of its camera [px];
        zero where that gamma is told, or nothing is known of it.
    bias_index : (n, c) array of int
        The shared shifts that each outline has a part in.
    bias_shift : (n, c, 2) array
        How far one pixel of each shifts both ends [px].
    """

    index: IntArray
    leg: IntArray
    view: IntArray
    pose: IntArray
    radius: IntArray
    feet: Array
    pixels: Array
    constants: Array
    covariance: Array
    parts: tuple[tuple[int, str], ...]
    views: tuple[str, ...]
    series: IntArray
    cameras: tuple[str, ...]
    by_gamma: Array
    bias_index: IntArray
    bias_shift: Array

    @property
    def epsilon(self) -> Array:
        """+1 or -1 of eq (5), (n,)."""
        return np.asarray(self.constants[:, 8])

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, eq=False)
class Readings:
    """The encoder readings that enter the fit, n of them.

    Attributes
    ----------
    leg, pose : (n,) array of int
        Indices.
    length : (n,) array
        sign * q: the leg length without its offset [m].
    sigma : float
        Standard deviation [m].
    """

    leg: IntArray
    pose: IntArray
    length: Array
    sigma: float

    def __len__(self) -> int:
        return len(self.leg)


def observed_outlines(
    outlines: Outlines, measurements: Measurements, legs: FittedLegs
) -> ObservedOutlines:
    """Return the used outlines in the form that the residuals take.

    Raises
    ------
    DatasetError
        If an outline has a covariance that is not positive definite, or shows a part that the
        mechanism does not have, or outlines of a camera were measured with several gammas.
    """
    index = np.flatnonzero(outlines.used)
    row, leg = outlines.row[index], outlines.leg[index]
    view = measurements.view[row]
    keys = [(int(j), outlines.part[i]) for i, j in zip(index, leg, strict=True)]
    parts = tuple(sorted(set(keys)))
    covariance = outlines.covariance[index]
    cameras, by_gamma = cameras_of(measurements), movements_by_gamma(outlines, measurements)[index]
    problems = [
        *mixed_gammas(by_gamma, outlines.gamma[index], [cameras[v] for v in view.tolist()]),
        *_bad_covariances(covariance, row, leg, measurements, legs),
        *(
            f"The outlines of {legs.names[j]}.{part} could not be used: the mechanism has no such "
            "cylinder; correct the part in the observations."
            for j, part in parts
            if (j, part) not in legs.radii
        ),
    ]
    if problems:
        raise DatasetError(problems)
    feet, pixels = np.zeros((len(index), 2, 2)), np.zeros((len(index), 2, 2))
    constants = np.empty((len(index), 9))
    constants[:, 8] = EPSILON[outlines.edge[index] - 1]
    for v in np.unique(view):
        camera, of_view = measurements.views[v].camera, np.flatnonzero(view == v)
        at = index[of_view]
        feet[of_view], lens = feet_of_ends(camera, outlines.h[at], outlines.ends[at])
        constants[of_view, :8] = np.swapaxes(lens, -1, -2).reshape(-1, 8)
        pixels[of_view] = camera.distort(feet[of_view])
    numbers = {part: i for i, part in enumerate(parts)}
    return ObservedOutlines(
        index,
        leg,
        view,
        measurements.pose[row],
        np.array([numbers[key] for key in keys], dtype=np.intp),
        feet,
        pixels,
        constants,
        covariance,
        parts,
        tuple(view.name for view in measurements.views),
        _series(measurements),
        cameras,
        by_gamma,
        np.zeros((len(index), 0), dtype=np.intp),
        np.zeros((len(index), 0, 2)),
    )


def _series(measurements: Measurements) -> IntArray:
    """Return the view that stands for each, (n_views,)."""
    views = measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    images = np.bincount(measurements.view, minlength=len(views))
    first: dict[str, int] = {}
    found = [
        first.setdefault(owner, v) if n == 1 else v
        for v, (owner, n) in enumerate(zip(owners, images.tolist(), strict=True))
    ]
    return np.array(found, dtype=np.intp)


def of_parts(outlines: ObservedOutlines, parts: Sequence[tuple[int, str]]) -> ObservedOutlines:
    """Return the same outlines with their radii counted in given parts, then in those of no other.

    Parameters
    ----------
    outlines : ObservedOutlines
    parts : sequence of (int, str)
        Leg index and part of each radius.
    """
    together = tuple(dict.fromkeys((*parts, *outlines.parts)))
    number = np.array([together.index(part) for part in outlines.parts], dtype=np.intp)
    return replace(outlines, radius=number[outlines.radius], parts=together)


def seen_by(outlines: ObservedOutlines, cameras: Sequence[Camera]) -> ObservedOutlines:
    """Return the same outlines in the image, on the sensor planes of other cameras.

    Parameters
    ----------
    outlines : ObservedOutlines
    cameras : sequence of Camera
        One a view.
    """
    feet, constants = outlines.feet.copy(), outlines.constants.copy()
    for v in np.unique(outlines.view):
        of_view = outlines.view == v
        feet[of_view] = cameras[v].undistort(outlines.pixels[of_view])
        lens = np.linalg.inv(cameras[v].pixels_per_unit(feet[of_view]))
        constants[of_view, :8] = lens.reshape(-1, 8)
    return replace(outlines, feet=feet, constants=constants)


def feet_of_ends(camera: Camera, h: Array, ends: Array) -> tuple[Array, Array]:
    """Return the points of measured lines nearest to their ends, and the lens there.

    Parameters
    ----------
    camera : Camera
    h : (n, 3) array
        Measured outlines (a, b, c).
    ends : (n, 2, 2) array
        Ends of the used pieces [px].

    Returns
    -------
    feet : (n, 2, 2) array
        Points of the sensor plane on the lines.
    J_inverse_transposed : (n, 2, 2, 2) array
        Inverse transposed derivative of pixels with respect to the sensor plane there [1/px].
    """
    xy = camera.undistort(ends)
    normal = h[:, None, :2]
    value = np.sum(normal * xy, axis=-1, keepdims=True) + h[:, None, 2:]
    feet = xy - normal * value / np.sum(normal**2, axis=-1, keepdims=True)
    J = camera.pixels_per_unit(feet)
    return feet, np.swapaxes(np.linalg.inv(J), -1, -2)


def readings(measurements: Measurements, legs: FittedLegs) -> Readings:
    """Return the encoder readings, one row of them for each platform pose.

    Images of one pose share one reading: that of the first row. Legs without a motor have none.
    """
    length = legs.sign * measurements.q[measurements.first_rows]
    actuated = np.array([leg.kind is LegKind.ACTUATED for leg in legs.nominal], dtype=np.bool_)
    pose, leg = np.nonzero(np.isfinite(length) & actuated)
    return Readings(leg, pose, length[pose, leg], measurements.sigma_q)


def _bad_covariances(
    covariance: Array, row: IntArray, leg: IntArray, measurements: Measurements, legs: FittedLegs
) -> list[str]:
    """Return one sentence for each covariance that is not positive definite."""
    s00, s01, s11 = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    good = (s00 > 0.0) & (s11 > 0.0) & (s00 * s11 > s01**2)
    return [
        f"The outline of {legs.names[leg[i]]} in {measurements.image[row[i]] or f'row {row[i]}'} "
        f"could not be used: its covariance s00 = {s00[i]:g}, s01 = {s01[i]:g}, s11 = {s11[i]:g} "
        "px^2 is not positive definite; correct it in the observations."
        for i in np.flatnonzero(~good)
    ]
