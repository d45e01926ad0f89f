"""The measurement noise of a dataset with repeated images, as section 4.2 estimates it.

The same images go through both methods: legcal's detection, and Canny's edge points with lines by
least squares. Each gives pairs of outlines, axes by (4) and (5), and their Euler angles and M_LS;
the repeats of a leg's orientation (one pose in one view) give standard deviations. Repeats agree on
what the images share: an edge that light, blur or the model of the outline moves is moved in all
of them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.dataset.folder import Dataset, load_dataset
from legcal.detection.detect import Method
from legcal.detection.observe import Photographs, align, detect, scene_at_poses
from legcal.detection.outline import outline_parts
from legcal.detection.workers import worker_pool
from legcal.errors import NotVisible
from legcal.geometry.types import BoolArray, IntArray
from legcal.mechanism.kinematics import forward_kinematics_many
from legcal.mechanism.model import Mechanism
from legcal.observations.canonical_order import canonical_order, reorder_measurements
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.observations.sets import no_outlines
from legcal.progress import Report, no_progress
from legcal.repeatability.canny import canny_parts
from legcal.repeatability.difference import Difference, outline_differences
from legcal.repeatability.repeats import Repeats, find_repeats, group_rows
from legcal.repeatability.samples import LegOrientation, leg_orientations
from legcal.repeatability.spread import Sample, Spread, pool

METHODS: dict[str, tuple[Method, str]] = {
    "detector": (outline_parts, "Measuring outlines"),
    "canny": (canny_parts, "Canny and least squares"),
}
OUTLINE = "outline"  # the spread of outlines, beside the QUANTITIES of axes
BIAS = (
    "Repeats show what differs between images of one pose, not the bias that they share: an edge "
    "that light, blur or rounding to whole pixels displaces in all of them shows no spread. What "
    "the detector claims allows for such bias, so that a ratio below one is expected of it."
)


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
        if quantity == OUTLINE:
            return [line for o in self.orientations for line in o.lines]
        return [o.quantities[quantity] for o in self.orientations if quantity in o.quantities]

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
    poses = forward_kinematics_many(mechanism, measurements.q[measurements.first_rows])
    scene = scene_at_poses(mechanism, measurements, poses)
    outlines: dict[str, Outlines] = {}
    with worker_pool(workers) as run:

        def photographs(rows: IntArray) -> Photographs:
            return Photographs(mechanism, measurements, load, run, rows, no_outlines())

        scene = align(
            photographs(_rows_to_align(measurements, has_image, repeats)), scene, progress
        )
        repeated = photographs(np.sort(np.concatenate([group.rows for group in repeats])))
        for name, (method, stage) in METHODS.items():
            outlines[name] = detect(repeated, scene, progress, method=method, stage=stage)
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
        notes=(*dataset.notes, *_notes(measurements, methods)),
    )


def _rows_to_align(
    measurements: Measurements, has_image: BoolArray, repeats: Sequence[Repeats]
) -> IntArray:
    """Return one image of every pose of the views that have repeats."""
    views = {group.view for group in repeats}
    groups = group_rows(measurements, np.flatnonzero(has_image))
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


def _notes(measurements: Measurements, methods: Sequence[MethodNoise]) -> list[str]:
    """Return what is not known of which leg, and what repeats cannot tell."""
    notes = [BIAS]
    for leg in methods[0].legs:
        if not leg.orientations:
            notes.append(f"{leg.name} is in none of the repeated images.")
    for method in methods:
        for leg in method.legs:
            if leg.orientations and not any(o.quantities for o in leg.orientations):
                notes.append(
                    f"{leg.name}: {method.name} found its axis in no two images of one pose."
                )
            notes += _without_M_LS(measurements, method.name, leg)
    return notes


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
        f"parallel to the image x axis within {inclination:.2f} deg, or to the camera's plane y = 0: M_LS would "
        "slide along it by more than its width, or lie at infinity."
    ]
