"""What the repeats of each leg orientation say: samples from the outlines that a method found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from legcal.detection.outline import HIDDEN, OUTSIDE
from legcal.errors import NotVisible
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.leg import Leg
from legcal.observations.leg_axes import LegAxes, axes_from_outlines
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.repeatability.quantities import OF_M_LS, QUANTITIES, axis_values
from legcal.repeatability.repeats import Repeats
from legcal.repeatability.spread import Sample, sample_of
from legcal.vision.camera import Camera


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
