"""The measurement noise of a dataset with repeated images, as section 4.2 estimates it.

The same images go through both methods: legcal's detection, and Canny's edge points with lines by
least squares. Each gives pairs of outlines, axes by (4) and (5), and their Euler angles and M_LS;
the repeats of a leg's orientation (one pose in one view) give standard deviations. Repeats agree on
what the images share: an edge that light, blur or the model of the outline moves is moved in all
of them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from legcal.calibration.canny import canny_parts
from legcal.data import (
    Dataset,
    LegAxes,
    Measurements,
    Outlines,
    axes_from_outlines,
    canonical_order,
    load_dataset,
    no_outlines,
    reorder_measurements,
)
from legcal.errors import DatasetError, NotIdentifiable, NotVisible
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import Leg, Mechanism, forward_kinematics_many
from legcal.perception import (
    BEFORE_FIT,
    HIDDEN,
    OUTSIDE,
    Method,
    Photographs,
    Placement,
    hint_notes,
    measure,
    measure_photographs,
    nominal_placement,
    place,
)
from legcal.progress import Report, no_progress
from legcal.vision import EPSILON, Camera, angles_of_direction
from legcal.workers import worker_pool


@dataclass(frozen=True, eq=False)
class Repeats:
    """Images of one pose from one camera position.

    Attributes
    ----------
    view, pose : int
        Indices of the view and the pose.
    rows : (n,) array of int
        The rows of the measurements.
    """

    view: int
    pose: int
    rows: IntArray


def find_repeats(measurements: Measurements, has_image: BoolArray, where: Path) -> list[Repeats]:
    """Return the repeated images of a dataset, by view and pose.

    Parameters
    ----------
    measurements : Measurements
        All rows.
    has_image : (n_rows,) array of bool
        Whether the image file of a row is there.
    where : Path
        The table, for messages.

    Raises
    ------
    DatasetError
        If no row has an image.
    NotIdentifiable
        If no view has two images of one pose.
    """
    rows = np.flatnonzero(has_image)
    what = f"{where}: the measurement noise could not be estimated: found no"
    if len(rows) == 0:
        raise DatasetError(
            f"{what} image in {measurements.n_rows} rows, needed repeated images of the same "
            "poses; name the images in the column image."
        )
    repeats = [group for group in group_rows(measurements, rows) if len(group.rows) > 1]
    if not repeats:
        found = "two images of one pose in any view" if measurements.pose_labels else "column pose"
        raise NotIdentifiable(
            f"{what} {found}, needed several images of each pose from one camera position; take "
            "every image several times and give its rows the same label in the column pose "
            "(legcal simulate --images 4 does, for a simulated machine)."
        )
    return repeats


def group_rows(measurements: Measurements, rows: IntArray) -> list[Repeats]:
    """Return rows by view and pose, also those that nothing repeats."""
    places = np.stack([measurements.view[rows], measurements.pose[rows]], axis=1)
    distinct, which = np.unique(places, axis=0, return_inverse=True)
    return [
        Repeats(int(view), int(pose), rows[which.ravel() == k])
        for k, (view, pose) in enumerate(distinct)
    ]


@dataclass(frozen=True, eq=False)
class Difference:
    """Where one outline of a leg lies by a second method, against a first.

    Attributes
    ----------
    leg : str
        The leg.
    outward : (2,) array
        Mean over repeats, at both ends: how far the second line lies outside the first [px].
    """

    leg: str
    outward: Array


def outline_differences(
    first: Outlines,
    second: Outlines,
    measurements: Measurements,
    repeats: Sequence[Repeats],
    leg_names: Sequence[str],
) -> list[Difference]:
    """Return the mean differences of all outlines that both methods found.

    Parameters
    ----------
    first, second : Outlines
        Outlines of the same images by both methods.
    measurements : Measurements
        The rows.
    repeats : sequence of Repeats
        The images over which differences are averaged.
    leg_names : sequence of str
        The legs, in the order of the measurements.
    """
    group_of = {row: k for k, group in enumerate(repeats) for row in group.rows.tolist()}
    place = {key: i for i, key in enumerate(second.row_keys()) if second.used[i]}
    found: dict[tuple[int, int, str, int], list[Array]] = {}
    for i, (row, leg, part, edge) in enumerate(first.row_keys()):
        j = place.get((row, leg, part, edge))
        if j is None or not first.used[i]:
            continue
        camera = measurements.views[int(measurements.view[row])].camera
        # Positive inside the second line, which then lies outside the first.
        h = np.broadcast_to(second.h[j], (2, 3))
        offset = EPSILON[edge - 1] * camera.line_offset(h, camera.undistort(first.ends[i]))
        found.setdefault((group_of[row], leg, part, edge), []).append(offset)
    return [
        Difference(leg_names[leg], np.asarray(np.mean(offsets, axis=0)))
        for (_, leg, _, _), offsets in sorted(found.items(), key=lambda item: item[0])
    ]


ANGLES = ("psi", "theta", "angle", "tilt")
QUANTITIES = ("psi", "theta", "x", "z", "angle", "across", "tilt", "depth")
OF_M_LS = ("x", "z")
SURELY = 3.0  # standard deviations by which an axis must be inclined to the plane of M_LS
_STEP = 1e-6  # of derivatives [rad, m]
_M_LS_ROWS = [QUANTITIES.index(name) for name in OF_M_LS]


@dataclass(frozen=True, eq=False)
class AxisValues:
    """Repeated axes of one leg as numbers.

    Attributes
    ----------
    values : (n, 8) array
        The ``QUANTITIES`` of each, as differences to the first one [rad, m].
    claimed : (n, 8, 8) array
        Their claimed covariances.
    inclination : (n,) array
        Angle between the image of each axis and the image x axis [rad].
    has_M_LS : bool
        False if any of the axes is seen so nearly parallel to the image x axis that the place in
        the image where M_LS is seen has an expected standard deviation above the leg's width, or
        is parallel to the plane y = 0 within ``SURELY`` of its standard deviations.
    """

    values: Array
    claimed: Array
    inclination: Array
    has_M_LS: bool


def axis_values(axes: LegAxes, chosen: BoolArray, radius: float) -> AxisValues:
    """Return what repeated axes of one leg are in numbers.

    Parameters
    ----------
    axes : LegAxes
        Axes in camera frames.
    chosen : (n_axes,) array of bool
        The repeats of one leg in one view and pose.
    radius : float
        Radius of the leg [m].
    """
    u, M = axes.u[chosen], axes.M[chosen]
    basis, covariance = axes.basis[chosen], axes.covariance[chosen]
    values = _values(u, M, u[0], M[0])
    derivative = np.empty((len(u), len(QUANTITIES), 4))
    for k in range(4):
        step = _STEP * basis[:, k % 2]
        du, dM = (step, np.zeros_like(M)) if k < 2 else (np.zeros_like(u), step)
        up, down = (_values(u + s * du, M + s * dM, u[0], M[0]) for s in (1.0, -1.0))
        derivative[..., k] = (up - down) / (2.0 * _STEP)
    claimed = derivative @ covariance @ derivative.swapaxes(1, 2)
    normal = np.cross(u, M)
    inclination = np.arctan2(np.abs(normal[:, 0]), np.abs(normal[:, 1]))
    e_y = basis[:, :, 1]
    sigma_u_y = np.sqrt(np.einsum("ni,nij,nj->n", e_y, covariance[:, :2, :2], e_y))
    has_M_LS = _has_M_LS(u, M, sigma_u_y, claimed, radius)
    return AxisValues(values, claimed, inclination, has_M_LS)


def _has_M_LS(u: Array, M: Array, sigma_u_y: Array, claimed: Array, radius: float) -> bool:
    """Say whether M_LS is expected to be seen at the same place up to the width of the leg."""
    if np.any(np.abs(u[:, 1]) <= np.maximum(SURELY * sigma_u_y, 10.0 * _STEP)):
        return False
    x, z = _M_LS(u, M)
    gradient = np.column_stack([1.0 / z, -x / z**2])  # of x / z, where M_LS is seen
    variance = np.einsum(
        "ni,nij,nj->n", gradient, claimed[:, _M_LS_ROWS][:, :, _M_LS_ROWS], gradient
    )
    return bool(np.all(np.sqrt(variance) < 2.0 * radius / np.linalg.norm(M, axis=1)))


def _values(u: Array, M: Array, u_0: Array, M_0: Array) -> Array:
    """Return the quantities of axes (n, 8) as differences to those of a reference axis."""
    n = np.cross(u_0, M_0)
    n /= np.linalg.norm(n)
    w = np.cross(n, u_0)  # the part of M_0 normal to u_0: away from the camera
    psi, theta = angles_of_direction(u)
    psi_0, theta_0 = angles_of_direction(u_0)
    x, z = _M_LS(u, M)
    x_0, z_0 = _M_LS(u_0[None], M_0[None])
    at_M = M - M_0 - u * (((M - M_0) @ u_0) / (u @ u_0))[:, None]  # where M_0 was along the leg
    columns = [
        psi - psi_0,
        np.remainder(theta - theta_0 + np.pi, 2.0 * np.pi) - np.pi,
        x - x_0,
        z - z_0,
        u @ n,
        at_M @ n,
        u @ w,
        at_M @ w,
    ]
    return np.column_stack(columns)


def _M_LS(u: Array, M: Array) -> tuple[Array, Array]:
    """Return x and z of the axis at y = 0; of any size where it is nearly parallel to it."""
    flat = np.abs(u[:, 1]) < 1e-12
    along = np.where(flat, 0.0, M[:, 1] / np.where(flat, 1.0, u[:, 1]))
    return M[:, 0] - along * u[:, 0], M[:, 2] - along * u[:, 2]


CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class Sample:
    """What the repeats of one orientation tell about one quantity.

    Attributes
    ----------
    covariance : (d, d) array
        Of the repeats, with n - 1 degrees of freedom.
    claimed : (d, d) array
        The mean covariance that the method claims.
    dof : int
        n - 1.
    """

    covariance: Array
    claimed: Array
    dof: int

    @property
    def sd(self) -> float:
        """Standard deviation, the root mean square over the components."""
        return float(np.sqrt(np.trace(self.covariance) / len(self.covariance)))

    @property
    def ratio(self) -> float:
        """Standard deviation in the claimed one."""
        return float(np.sqrt(np.trace(self.covariance) / np.trace(self.claimed)))


@dataclass(frozen=True)
class Spread:
    """A standard deviation pooled over orientations.

    Attributes
    ----------
    sd, claimed : float
        Standard deviation of the repeats, and the one that the method claims.
    median, largest : float
        The median and the largest standard deviation of one orientation.
    dof : float
        Degrees of freedom of ``sd``.
    samples : int
        How many were pooled: orientations, and each outline in each of them.
    """

    sd: float
    claimed: float
    median: float
    largest: float
    dof: float
    samples: int

    @property
    def ratio(self) -> float:
        """Standard deviation of the repeats in the claimed one."""
        return self.sd / self.claimed

    @property
    def ratio_range(self) -> tuple[float, float]:
        """Both ends of the 95 % confidence range of the ratio."""
        tail = 0.5 * (1.0 - CONFIDENCE)
        least, most = (
            self.ratio * float(np.sqrt(self.dof / chi2.ppf(p, self.dof)))
            for p in (1.0 - tail, tail)
        )
        return least, most


def sample_of(deviations: Array, claimed: Array) -> Sample:
    """Return the sample of repeats.

    Parameters
    ----------
    deviations : (n, d) array
        Values of n repeats, two or more, against any common origin.
    claimed : (n, d, d) array
        Their claimed covariances.
    """
    dof = len(deviations) - 1
    centred = deviations - deviations.mean(axis=0)
    return Sample(np.asarray(centred.T @ centred / dof), np.asarray(claimed.mean(axis=0)), dof)


def pool(samples: Sequence[Sample]) -> Spread | None:
    """Return the pooled standard deviation; None without a sample.

    Parameters
    ----------
    samples : sequence of Sample
        Of the same quantity and dimension.
    """
    if not samples:
        return None
    size = len(samples[0].covariance)
    dof = np.array([s.dof for s in samples], dtype=np.float64)
    found, claimed = (
        np.sqrt(float(dof @ [np.trace(c) for c in covariances]) / (size * dof.sum()))
        for covariances in ([s.covariance for s in samples], [s.claimed for s in samples])
    )
    traces = np.array([np.trace(s.claimed) for s in samples])
    squares = np.array([np.sum(s.claimed**2) for s in samples])  # tr C^2 of a symmetric C
    effective = float(dof @ traces) ** 2 / float(dof @ squares)
    each = [s.sd for s in samples]
    return Spread(
        sd=float(found),
        claimed=float(claimed),
        median=float(np.median(each)),
        largest=max(each),
        dof=effective,
        samples=len(samples),
    )


@dataclass(frozen=True, eq=False)
class LegOrientation:
    """One leg in repeated images of one pose in one view.

    Attributes
    ----------
    leg, view, pose : int
        Indices.
    images : int
        How many images show the leg by the model.
    axes : int
        In how many of them its axis was found.
    quantities : mapping from str to Sample
        Of the axis; empty with fewer than two axes, without x and z where M_LS does not exist.
    inclination : float or None
        Smallest angle between the image of the leg and the image x axis [rad] where M_LS does not
        exist.
    lines : tuple of Sample
        Of each outline that was found twice: its offsets at both ends [px].
    outlines, outlines_found : int
        How many outlines the images show by the model, and how many were found.
    """

    leg: int
    view: int
    pose: int
    images: int
    axes: int
    quantities: Mapping[str, Sample]
    inclination: float | None
    lines: tuple[Sample, ...]
    outlines: int
    outlines_found: int


def leg_orientations(
    outlines: Outlines,
    measurements: Measurements,
    legs: Sequence[Leg],
    repeats: Sequence[Repeats],
) -> list[LegOrientation]:
    """Return what repeats say of every leg that they show.

    Parameters
    ----------
    outlines : Outlines
        What one method found in all repeated images.
    measurements : Measurements
        The rows.
    legs : sequence of Leg
        The legs, in the order of the measurements.
    repeats : sequence of Repeats
        The images that belong together.
    """
    radii = {part: r for leg in legs for part, r in leg.radius_of_part.items()}
    try:
        axes = axes_from_outlines(outlines, measurements, radii)
    except NotVisible:
        axes = None
    shown = np.array(
        [reason != OUTSIDE and not reason.startswith(HIDDEN) for reason in outlines.reason],
        dtype=np.bool_,
    )
    return [
        _orientation(leg, legs[leg], group, outlines, here, axes, measurements)
        for group in repeats
        for leg in range(len(legs))
        if np.any(here := shown & (outlines.leg == leg) & np.isin(outlines.row, group.rows))
    ]


def _orientation(
    index: int,
    leg: Leg,
    group: Repeats,
    outlines: Outlines,
    here: BoolArray,
    axes: LegAxes | None,
    measurements: Measurements,
) -> LegOrientation:
    """Return what repeats say of one leg."""
    quantities: dict[str, Sample] = {}
    inclination, n_axes = None, 0
    if axes is not None:
        chosen = (axes.leg == index) & np.isin(axes.row, group.rows)
        n_axes = int(np.count_nonzero(chosen))
        if n_axes > 1:
            quantities, inclination = _axis_samples(axes, chosen, max(leg.radius_of_part.values()))
    return LegOrientation(
        leg=index,
        view=group.view,
        pose=group.pose,
        images=len(np.unique(outlines.row[here])),
        axes=n_axes,
        quantities=quantities,
        inclination=inclination,
        lines=_line_samples(outlines, here, measurements.views[group.view].camera),
        outlines=int(np.count_nonzero(here)),
        outlines_found=int(np.count_nonzero(here & outlines.used)),
    )


def _axis_samples(
    axes: LegAxes, chosen: BoolArray, radius: float
) -> tuple[dict[str, Sample], float | None]:
    """Return the samples of an axis, and its inclination if it has no M_LS."""
    found = axis_values(axes, chosen, radius)
    samples = {
        name: sample_of(found.values[:, [i]], found.claimed[:, [i]][:, :, [i]])
        for i, name in enumerate(QUANTITIES)
        if found.has_M_LS or name not in OF_M_LS
    }
    return samples, None if found.has_M_LS else float(found.inclination.min())


def _line_samples(outlines: Outlines, here: BoolArray, camera: Camera) -> tuple[Sample, ...]:
    """Return a sample of every outline (part and edge) that was found at least twice."""
    found: dict[tuple[str, int], list[int]] = {}
    for i in np.flatnonzero(here & outlines.used).tolist():
        found.setdefault((outlines.part[i], int(outlines.edge[i])), []).append(i)
    return tuple(
        line_sample(camera, outlines.h[i], outlines.ends[i], outlines.covariance[i])
        for _, i in sorted(found.items())
        if len(i) > 1
    )


def line_sample(camera: Camera, h: Array, ends: Array, covariance: Array) -> Sample:
    """Return how repeats of one outline lie, as offsets at two common ends [px].

    Parameters
    ----------
    camera : Camera
        The camera.
    h : (n, 3) array
        The outlines.
    ends : (n, 2, 2) array
        The ends of their used pieces [px]; their means are the common ends.
    covariance : (n, 2, 2) array
        Of the offsets at their own ends [px^2]; carried to the common ends along the line.
    """
    own = camera.undistort(ends)
    common = own.mean(axis=0)
    offsets = camera.line_offset(
        np.broadcast_to(h[:, None], (len(h), 2, 3)), np.broadcast_to(common, own.shape)
    )
    along = common[1] - common[0]
    place = (own - common[0]) @ along / (along @ along)
    carry = np.linalg.inv(np.stack([1.0 - place, place], axis=-1))
    return sample_of(offsets, carry @ covariance @ carry.swapaxes(1, 2))


OUTLINE = "outline"  # the spread of outlines, beside the QUANTITIES of axes
CALLED = {"detector": "detector", "canny": "Canny"}  # methods, in words


@dataclass(frozen=True, eq=False)
class LegNoise:
    """What one method finds of one leg.

    Attributes
    ----------
    name : str
        The leg.
    orientations : tuple of LegOrientation
        Its repeated images, by view and pose; empty if none show the leg.
    """

    name: str
    orientations: tuple[LegOrientation, ...]

    @property
    def images(self) -> int:
        """Images that show the leg by the model."""
        return sum(o.images for o in self.orientations)

    @property
    def axes(self) -> int:
        """Images in which the axis was found."""
        return sum(o.axes for o in self.orientations)

    @property
    def without_M_LS(self) -> int:
        """Orientations in which M_LS does not exist."""
        return sum(o.inclination is not None for o in self.orientations)

    def samples(self, quantity: str) -> list[Sample]:
        """Return the samples of one of the ``QUANTITIES`` or of the outlines."""
        return [sample for o in self.orientations for sample in samples_of(o, quantity)]

    def spread(self, quantity: str) -> Spread | None:
        """Return the spread over all orientations, None where nothing was found twice."""
        return pool(self.samples(quantity))


@dataclass(frozen=True, eq=False)
class MethodNoise:
    """What one method finds.

    Attributes
    ----------
    name : {"detector", "canny"}
        The method.
    legs : tuple of LegNoise
        In the order of the mechanism.
    """

    name: str
    legs: tuple[LegNoise, ...]

    def spread(self, quantity: str) -> Spread | None:
        """Return the spread over all legs and orientations; its largest is that of Table 1."""
        return pool([sample for leg in self.legs for sample in leg.samples(quantity)])

    def bounding(self, quantity: str) -> LegOrientation | None:
        """Return the orientation whose standard deviation is the largest, None without any."""
        every = [o for leg in self.legs for o in leg.orientations if samples_of(o, quantity)]
        return max(every, key=lambda o: max(s.sd for s in samples_of(o, quantity)), default=None)


def samples_of(orientation: LegOrientation, quantity: str) -> list[Sample]:
    """Return what repeats say of one of the ``QUANTITIES``, or of each outline."""
    if quantity == OUTLINE:
        return list(orientation.lines)
    return [orientation.quantities[quantity]] if quantity in orientation.quantities else []


@dataclass(frozen=True, eq=False)
class Noise:
    """The measurement noise of a dataset.

    Attributes
    ----------
    dataset : Dataset
        The dataset.
    view_names, pose_labels : tuple of str
        What the indices of orientations mean.
    repeats : tuple of Repeats
        The images that repeat each other.
    methods : tuple of MethodNoise
        Both methods.
    differences : tuple of Difference
        How far Canny's outlines lie outside the detector's.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    view_names: tuple[str, ...]
    pose_labels: tuple[str, ...]
    repeats: tuple[Repeats, ...]
    methods: tuple[MethodNoise, ...]
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    def difference(self, leg: str | None = None) -> tuple[float, float] | None:
        """Return mean and rms of the differences of a leg, or of all [px]; None without any."""
        outward = [d.outward for d in self.differences if leg in (None, d.leg)]
        if not outward:
            return None
        return float(np.mean(outward)), float(np.sqrt(np.mean(np.square(outward))))


BIAS = (
    "Repeats show what differs between images of one pose, not the bias that they share: an edge "
    "that light, blur or rounding to whole pixels displaces in all of them shows no spread. What "
    "the detector claims allows for such bias, so that a ratio below one is expected of it."
)
RANGE = (
    "The 95 % ranges hold for normal errors: where a method falls on one edge in some images and "
    "on another in others, they are too narrow."
)
JUMP = 3.0  # ratio of spread to claim, from which an edge is said to jump: as it is, and in the
# median ratio, lest all edges of a method that claims too little do
_NAMED = 4  # places in a note


def noise_notes(measurements: Measurements, methods: Sequence[MethodNoise]) -> list[str]:
    """Return what repeats cannot tell, and what is not known of which leg.

    Parameters
    ----------
    measurements : Measurements
        The rows, whose views and poses the notes name.
    methods : sequence of MethodNoise
        Both methods.
    """
    notes = [BIAS, RANGE]
    for leg in methods[0].legs:
        if not leg.orientations:
            notes.append(f"{leg.name} is in none of the repeated images.")
    for method in methods:
        for leg in method.legs:
            if leg.orientations and not any(o.quantities for o in leg.orientations):
                notes.append(
                    f"{leg.name}: {CALLED[method.name]} found its axis in no two images of one "
                    "pose."
                )
            notes += _without_M_LS(measurements, CALLED[method.name], leg)
        notes += _jumps(measurements, method)
    return notes


def _jumps(measurements: Measurements, method: MethodNoise) -> list[str]:
    """Return a note on outlines that spread far more than the others, against what is claimed."""
    ratios = [line.ratio for leg in method.legs for o in leg.orientations for line in o.lines]
    least = JUMP * max(1.0, float(np.median(ratios))) if ratios else np.inf
    found = sorted(
        (
            (max(line.sd for line in o.lines if line.ratio > least), leg, o)
            for leg in method.legs
            for o in leg.orientations
            if any(line.ratio > least for line in o.lines)
        ),
        key=lambda jump: -jump[0],
    )
    if not found:
        return []
    places = [
        f"{leg.name} in {measurements.views[o.view].name}/{measurements.pose_labels[o.pose]} "
        f"({sd:.3f} px)"
        for sd, leg, o in found[:_NAMED]
    ]
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return [
        f"{CALLED[method.name]}: single outlines spread over {least:.2g} times as far as is "
        f"claimed of them: {', '.join(places)}{more}. Such an edge jumps between images; pooled "
        "standard deviations and upper bounds are of the jumps, medians are not."
    ]


def _without_M_LS(measurements: Measurements, method: str, leg: LegNoise) -> list[str]:
    """Return a note on a leg that has no M_LS in some orientations."""
    without = [o for o in leg.orientations if o.inclination is not None]
    if not without:
        return []
    places = {
        f"{measurements.views[o.view].name}/{measurements.pose_labels[o.pose]}" for o in without
    }
    inclination = np.degrees(min(o.inclination for o in without if o.inclination is not None))
    return [
        f"{leg.name}: M_LS does not exist for {method} in {len(without)} of "
        f"{len(leg.orientations)} orientations ({', '.join(sorted(places))}), where the leg is "
        f"parallel to the image x axis within {inclination:.2f} deg, or to the camera's plane "
        "y = 0: M_LS would slide along it by more than its width, or lie at infinity."
    ]


def noise_document(noise: Noise) -> dict[str, Any]:
    """Return the document of ``legcal noise --json``."""
    counts = [len(group.rows) for group in noise.repeats]
    return {
        "legcal_noise": 1,
        "mechanism": noise.dataset.mechanism.name,
        "images": sum(counts),
        "orientations": len(counts),
        "repeats": {"least": min(counts), "most": max(counts)},
        "methods": {method.name: _method(noise, method) for method in noise.methods},
        "difference": {
            "all": _difference(noise, None),
            **{leg.name: _difference(noise, leg.name) for leg in noise.methods[0].legs},
        },
        "notes": list(noise.notes),
    }


def _difference(noise: Noise, leg: str | None) -> dict[str, float] | None:
    found = noise.difference(leg)
    return None if found is None else {"mean": found[0], "rms": found[1]}


def _method(noise: Noise, method: MethodNoise) -> dict[str, Any]:
    return {
        "legs": [_leg(noise, leg) for leg in method.legs],
        "all": {name: _spread(method.spread(name)) for name in (*QUANTITIES, OUTLINE)},
        "upper_bound": {
            name: None if (spread := method.spread(name)) is None else spread.largest
            for name in (*QUANTITIES, OUTLINE)
        },
        "upper_bound_at": {
            name: None if (o := method.bounding(name)) is None else _place(noise, o)
            for name in (*QUANTITIES, OUTLINE)
        },
    }


def _place(noise: Noise, orientation: LegOrientation) -> dict[str, str]:
    return {
        "leg": noise.dataset.mechanism.leg_names[orientation.leg],
        "view": noise.view_names[orientation.view],
        "pose": noise.pose_labels[orientation.pose],
    }


def _leg(noise: Noise, leg: LegNoise) -> dict[str, Any]:
    return {
        "leg": leg.name,
        "images": leg.images,
        "axes": leg.axes,
        "outlines": sum(o.outlines for o in leg.orientations),
        "outlines_found": sum(o.outlines_found for o in leg.orientations),
        "without_M_LS": leg.without_M_LS,
        **{name: _spread(leg.spread(name)) for name in (*QUANTITIES, OUTLINE)},
        "orientations": [_orientation_document(noise, o) for o in leg.orientations],
    }


def _orientation_document(noise: Noise, orientation: LegOrientation) -> dict[str, Any]:
    line = pool(orientation.lines)
    return {
        "view": noise.view_names[orientation.view],
        "pose": noise.pose_labels[orientation.pose],
        "images": orientation.images,
        "axes": orientation.axes,
        **{
            name: orientation.quantities[name].sd if name in orientation.quantities else None
            for name in QUANTITIES
        },
        OUTLINE: None if line is None else line.sd,
    }


def _spread(spread: Spread | None) -> dict[str, Any] | None:
    if spread is None:
        return None
    low, high = spread.ratio_range
    return {
        "sd": spread.sd,
        "claimed": spread.claimed,
        "ratio": spread.ratio,
        "ratio_low": low,
        "ratio_high": high,
        "median": spread.median,
        "largest": spread.largest,
        "dof": spread.dof,
        "samples": spread.samples,
    }


METHODS: dict[str, tuple[Method, str]] = {
    "detector": (measure, "Measuring outlines"),
    "canny": (canny_parts, "Canny and least squares"),
}


def measure_noise(
    source: str | Path | Dataset, *, progress: Report = no_progress, workers: int = 1
) -> Noise:
    """Estimate the noise of outlines and leg axes from repeated images of the same poses.

    Parameters
    ----------
    source : path or Dataset
        A dataset whose column ``pose`` says which images repeat each other. Its outlines, if it has
        any, are left alone: the images are searched.
    progress : callable
        Called as ``progress(stage, done, total)``.
    workers : int
        Search the images in that many processes, as :func:`legcal.calibrate` does.

    Raises
    ------
    DatasetError, ModelError, OutOfClass
        If the input is malformed or not covered, or has no images.
    NotIdentifiable
        If no image is repeated, or the motors do not determine where the legs are.
    NotVisible
        If the images do not show the legs where they should be, or no leg was found twice.
    """
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    order = canonical_order(dataset.measurements, dataset.mechanism.leg_names)
    measurements = reorder_measurements(dataset.measurements, order)
    names = dataset.mechanism.leg_names
    mechanism = dataset.mechanism.with_leg_order([names[leg] for leg in order.legs])
    paths = [dataset.image_path(row) for row in order.rows.tolist()]
    has_image = np.array(
        [path is not None and os.path.exists(path) for path in paths], dtype=np.bool_
    )
    repeats = find_repeats(measurements, has_image, dataset.table_path)
    load = dataset.image_reader(order.rows.tolist())
    with worker_pool(workers) as run:
        every = Photographs(
            mechanism, measurements, load, run, np.flatnonzero(has_image), no_outlines()
        )
        placement, outlines = _search(every, repeats, progress)
    methods = []
    for name, found in outlines.items():
        orientations = leg_orientations(found, measurements, mechanism.legs, repeats)
        methods.append(MethodNoise(name, _by_leg(orientations, mechanism, names)))
    _refuse_nothing_found(dataset, methods)
    return Noise(
        dataset=dataset,
        view_names=tuple(view.name for view in measurements.views),
        pose_labels=measurements.pose_labels,
        repeats=tuple(repeats),
        methods=tuple(methods),
        differences=tuple(
            outline_differences(
                outlines["detector"],
                outlines["canny"],
                measurements,
                repeats,
                mechanism.leg_names,
            )
        ),
        notes=(
            *dataset.notes,
            *placement.all_notes,
            *_hint_notes(measurements, placement),
            *noise_notes(measurements, methods),
        ),
    )


def _search(
    every: Photographs, repeats: Sequence[Repeats], progress: Report
) -> tuple[Placement, dict[str, Outlines]]:
    """Place the cameras; return the outlines that each method finds in all repeated images."""
    measurements = every.measurements
    q = measurements.q[measurements.first_rows]
    poses = forward_kinematics_many(every.mechanism, q)
    nominal = nominal_placement(every.mechanism, measurements, poses)
    to_align = replace(every, detect=_rows_to_align(every, repeats))
    placement = place(to_align, nominal, progress)
    placement.require_one()
    repeated = replace(every, detect=np.sort(np.concatenate([group.rows for group in repeats])))
    found = {
        name: measure_photographs(repeated, placement, progress, method=method, stage=stage)
        for name, (method, stage) in METHODS.items()
    }
    return placement, found


def _hint_notes(measurements: Measurements, placement: Placement) -> list[str]:
    """Return what is to be said of rough camera poses that are wrong."""
    views = measurements.views
    hints = [view.T_base_camera for view in views]
    cameras = placement.T_base_camera
    return hint_notes([view.name for view in views], hints, cameras, BEFORE_FIT)


def _rows_to_align(every: Photographs, repeats: Sequence[Repeats]) -> IntArray:
    """Return one image of every pose of the views that have repeats."""
    views = {group.view for group in repeats}
    groups = group_rows(every.measurements, every.detect)
    return np.sort([group.rows[0] for group in groups if group.view in views])


def _by_leg(
    found: Sequence[LegOrientation], mechanism: Mechanism, names: Sequence[str]
) -> tuple[LegNoise, ...]:
    """Return the orientations of every leg, legs in the order of the model."""
    index = {name: mechanism.leg_names.index(name) for name in names}
    return tuple(LegNoise(name, tuple(o for o in found if o.leg == index[name])) for name in names)


def _refuse_nothing_found(dataset: Dataset, methods: Sequence[MethodNoise]) -> None:
    """Raise NotVisible if no method has found any outline twice."""
    if any(method.spread(OUTLINE) for method in methods):
        return
    raise NotVisible(
        f"{dataset.table_path}: the measurement noise could not be estimated: found no outline in "
        "two images of the same pose, needed one; check the images and the radii of the legs."
    )
