"""The measurement noise of a dataset with repeated images, as section 4.2 estimates it.

The same images go through both methods: legcal's detection, and Canny's edge points with lines by
least squares; the spread of repeats is that of :mod:`legcal.calibration.repeatability`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from legcal.calibration.canny import canny_parts
from legcal.calibration.repeatability import (
    OUTLINE,
    QUANTITIES,
    LegOrientation,
    Repeats,
    Sample,
    Spread,
    group_rows,
    leg_orientations,
    pool,
)
from legcal.calibration.session import start_session
from legcal.data import Dataset, Measurements, Outlines, load_dataset, no_outlines
from legcal.errors import DatasetError, NotIdentifiable, NotVisible
from legcal.files import Document
from legcal.geometry import Array, BoolArray
from legcal.machine import forward_kinematics_many
from legcal.perception import (
    BEFORE_FIT,
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
from legcal.vision import EPSILON
from legcal.workers import worker_pool

METHODS: dict[str, tuple[Method, str]] = {
    "detector": (measure, "Measuring outlines"),
    "canny": (canny_parts, "Canny and least squares"),
}
CALLED = {"detector": "detector", "canny": "Canny"}  # methods, in words
EVERY = (*QUANTITIES, OUTLINE)
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


@dataclass(frozen=True, eq=False)
class LegNoise:
    """What one method finds of one leg."""

    name: str
    orientations: tuple[LegOrientation, ...]  # by view and pose; empty if no image shows the leg

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
        return [sample for o in self.orientations for sample in o.samples(quantity)]

    def spread(self, quantity: str) -> Spread | None:
        """Return the spread over all orientations, None where nothing was found twice."""
        return pool(self.samples(quantity))


@dataclass(frozen=True, eq=False)
class MethodNoise:
    """What one method finds of all legs, in the order of the mechanism."""

    name: str  # one of METHODS
    legs: tuple[LegNoise, ...]

    def spread(self, quantity: str) -> Spread | None:
        """Return the spread over all legs and orientations; its largest is that of Table 1."""
        return pool([sample for leg in self.legs for sample in leg.samples(quantity)])

    def bounding(self, quantity: str) -> LegOrientation | None:
        """Return the orientation whose standard deviation is the largest, None without any."""
        every = [o for leg in self.legs for o in leg.orientations if o.samples(quantity)]
        return max(every, key=lambda o: max(s.sd for s in o.samples(quantity)), default=None)


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
    leg_names : tuple of str
        What the legs of orientations mean.
    differences : mapping of str to array
        How far Canny's outlines lie outside the detector's, averaged over repeats, at both ends
        (n, 2) [px], by leg.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    view_names: tuple[str, ...]
    pose_labels: tuple[str, ...]
    repeats: tuple[Repeats, ...]
    methods: tuple[MethodNoise, ...]
    leg_names: tuple[str, ...]
    differences: Mapping[str, Array]
    notes: tuple[str, ...]

    def difference(self, leg: str | None = None) -> tuple[float, float] | None:
        """Return mean and rms of the differences of a leg, or of all [px]; None without any."""
        outward = [d for name, d in self.differences.items() if leg in (None, name)]
        if not outward:
            return None
        every = np.concatenate(outward)
        return float(np.mean(every)), float(np.sqrt(np.mean(np.square(every))))

    def place(self, orientation: LegOrientation) -> Place:
        """Return leg, view and pose of an orientation, by their names."""
        return Place(
            leg=self.leg_names[orientation.leg],
            view=self.view_names[orientation.view],
            pose=self.pose_labels[orientation.pose],
        )

    def document(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        counts = [len(group.rows) for group in self.repeats]
        return NoiseDocument(
            legcal_noise=1,
            mechanism=self.dataset.machine.name,
            images=sum(counts),
            orientations=len(counts),
            repeats=RepeatCounts(least=min(counts), most=max(counts)),
            methods={method.name: self._method(method) for method in self.methods},
            difference={
                name or "all": None if found is None else MeanAndRms(mean=found[0], rms=found[1])
                for name in (None, *(leg.name for leg in self.methods[0].legs))
                for found in [self.difference(name)]
            },
            notes=list(self.notes),
        ).document()

    def _method(self, method: MethodNoise) -> MethodBlock:
        spreads = {name: method.spread(name) for name in EVERY}
        largest = {name: s.largest for name, s in spreads.items() if s is not None}
        bounding = {name: method.bounding(name) for name in EVERY}
        at = {name: self.place(o) for name, o in bounding.items() if o is not None}
        return MethodBlock(
            legs=[
                LegBlock(
                    leg=leg.name,
                    images=leg.images,
                    axes=leg.axes,
                    outlines=sum(o.outlines for o in leg.orientations),
                    outlines_found=sum(o.outlines_found for o in leg.orientations),
                    without_M_LS=leg.without_M_LS,
                    **{name: leg.spread(name) for name in EVERY},
                    orientations=[self._orientation(o) for o in leg.orientations],
                )
                for leg in method.legs
            ],
            all=ByQuantity[Spread](**spreads),
            upper_bound=ByQuantity[float](**largest),
            upper_bound_at=ByQuantity[Place](**at),
        )

    def _orientation(self, o: LegOrientation) -> OrientationBlock:
        line = pool(o.lines)
        found = {name: o.quantities[name].sd for name in QUANTITIES if name in o.quantities}
        return OrientationBlock(
            view=self.view_names[o.view],
            pose=self.pose_labels[o.pose],
            images=o.images,
            axes=o.axes,
            **found,
            outline=None if line is None else line.sd,
        )


T = TypeVar("T")


class ByQuantity(Document, Generic[T]):
    """Something of every quantity, or null."""

    psi: T | None = None
    theta: T | None = None
    x: T | None = None
    z: T | None = None
    angle: T | None = None
    across: T | None = None
    tilt: T | None = None
    depth: T | None = None
    outline: T | None = None


class Place(Document):
    """Which orientation."""

    leg: str
    view: str
    pose: str


class OrientationBlock(Document):
    """The standard deviations of one orientation."""

    view: str
    pose: str
    images: int
    axes: int
    psi: float | None = None
    theta: float | None = None
    x: float | None = None
    z: float | None = None
    angle: float | None = None
    across: float | None = None
    tilt: float | None = None
    depth: float | None = None
    outline: float | None = None


class LegBlock(Document):
    """What one method finds of one leg."""

    leg: str
    images: int
    axes: int
    outlines: int
    outlines_found: int
    without_M_LS: int
    psi: Spread | None
    theta: Spread | None
    x: Spread | None
    z: Spread | None
    angle: Spread | None
    across: Spread | None
    tilt: Spread | None
    depth: Spread | None
    outline: Spread | None
    orientations: list[OrientationBlock]


class MethodBlock(Document):
    """What one method finds."""

    legs: list[LegBlock]
    all: ByQuantity[Spread]
    upper_bound: ByQuantity[float]
    upper_bound_at: ByQuantity[Place]


class MeanAndRms(Document):
    """Of the differences between both methods [px]."""

    mean: float
    rms: float


class RepeatCounts(Document):
    """Images of one orientation."""

    least: int
    most: int


class NoiseDocument(Document):
    """What ``legcal noise --json`` prints."""

    legcal_noise: int
    mechanism: str
    images: int
    orientations: int
    repeats: RepeatCounts
    methods: dict[str, MethodBlock]
    difference: dict[str, MeanAndRms | None]
    notes: list[str]


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
    with worker_pool(workers) as pool_of_workers:
        session = start_session(dataset, pool_of_workers, progress)
        machine, measurements = session.machine, session.measurements
        paths = [dataset.image_path(row) for row in session.order.rows.tolist()]
        has_image = np.array(
            [path is not None and os.path.exists(path) for path in paths], dtype=np.bool_
        )
        repeats = find_repeats(measurements, has_image, dataset.table_path)
        every = replace(session.photographs, detect=np.flatnonzero(has_image), keep=no_outlines())
        placement, outlines = _search(every, repeats, progress)
    methods = []
    for name, table in outlines.items():
        found = leg_orientations(table, measurements, machine.legs, repeats)
        legs = []
        for leg in dataset.machine.leg_names:
            j = machine.leg_names.index(leg)
            legs.append(LegNoise(leg, tuple(o for o in found if o.leg == j)))
        methods.append(MethodNoise(name, tuple(legs)))
    if not any(method.spread(OUTLINE) for method in methods):
        raise NotVisible(
            f"{dataset.table_path}: the measurement noise could not be estimated: found no outline "
            "in two images of the same pose, needed one; check the images and the radii of the "
            "legs."
        )
    views = measurements.views
    hints = hint_notes(
        [view.name for view in views],
        [view.T_base_camera for view in views],
        placement.T_base_camera,
        BEFORE_FIT,
    )
    return Noise(
        dataset=dataset,
        view_names=tuple(view.name for view in views),
        pose_labels=measurements.pose_labels,
        repeats=tuple(repeats),
        methods=tuple(methods),
        leg_names=tuple(machine.leg_names),
        differences=_differences(
            outlines["detector"], outlines["canny"], measurements, repeats, machine.leg_names
        ),
        notes=(
            *dataset.notes,
            *placement.all_notes,
            *hints,
            *noise_notes(measurements, methods),
        ),
    )


def find_repeats(measurements: Measurements, has_image: BoolArray, where: Path) -> list[Repeats]:
    """Return the repeated images of a dataset, by view and pose; ``where`` is its table.

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


def _search(
    every: Photographs, repeats: Sequence[Repeats], progress: Report
) -> tuple[Placement, dict[str, Outlines]]:
    """Place the cameras; return the outlines that each method finds in all repeated images."""
    measurements = every.measurements
    poses = forward_kinematics_many(every.machine, measurements.q[measurements.first_rows])
    nominal = nominal_placement(every.machine, measurements, poses)
    views = {group.view for group in repeats}  # placed by one image of every pose
    groups = group_rows(measurements, every.detect)
    rows = np.sort([group.rows[0] for group in groups if group.view in views])
    placement = place(replace(every, detect=rows), nominal, progress)
    placement.require_one()
    repeated = replace(every, detect=np.sort(np.concatenate([group.rows for group in repeats])))
    found = {
        name: measure_photographs(repeated, placement, progress, method=method, stage=stage)
        for name, (method, stage) in METHODS.items()
    }
    return placement, found


def _differences(
    first: Outlines,
    second: Outlines,
    measurements: Measurements,
    repeats: Sequence[Repeats],
    leg_names: Sequence[str],
) -> dict[str, Array]:
    """Return how far lines of the second method lie outside the first's, means over repeats."""
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
    by_leg: dict[str, list[Array]] = {}
    for (_, leg, _, _), offsets in sorted(found.items(), key=lambda item: item[0]):
        by_leg.setdefault(leg_names[leg], []).append(np.mean(offsets, axis=0))
    return {leg: np.array(outward) for leg, outward in by_leg.items()}


def noise_notes(measurements: Measurements, methods: Sequence[MethodNoise]) -> list[str]:
    """Return what repeats cannot tell, and what is not known of which leg."""
    notes = [BIAS, RANGE]
    for leg in methods[0].legs:
        if not leg.orientations:
            notes.append(f"{leg.name} is in none of the repeated images.")
    for method in methods:
        called = CALLED[method.name]
        for leg in method.legs:
            if leg.orientations and not any(o.quantities for o in leg.orientations):
                notes.append(f"{leg.name}: {called} found its axis in no two images of one pose.")
            without = [o for o in leg.orientations if o.inclination is not None]
            if without:
                places = ", ".join(sorted({_view_and_pose(measurements, o) for o in without}))
                inclined = np.degrees(min(o.inclination or 0.0 for o in without))
                notes.append(
                    f"{leg.name}: M_LS does not exist for {called} in {len(without)} of "
                    f"{len(leg.orientations)} orientations ({places}), where the leg is parallel "
                    f"to the image x axis within {inclined:.2f} deg, or to the camera's plane "
                    "y = 0: M_LS would slide along it by more than its width, or lie at infinity."
                )
        notes += _jumps(measurements, method)
    return notes


def _jumps(measurements: Measurements, method: MethodNoise) -> list[str]:
    """Return a note on outlines that spread far more than the others, against what is claimed."""
    ratios = [line.ratio for leg in method.legs for o in leg.orientations for line in o.lines]
    least = JUMP * max(1.0, float(np.median(ratios))) if ratios else np.inf
    found = []
    for leg in method.legs:
        for o in leg.orientations:
            jumping = [line.sd for line in o.lines if line.ratio > least]
            if jumping:
                found.append((max(jumping), f"{leg.name} in {_view_and_pose(measurements, o)}"))
    if not found:
        return []
    found.sort(key=lambda jump: -jump[0])
    places = ", ".join(f"{where} ({sd:.3f} px)" for sd, where in found[:_NAMED])
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return [
        f"{CALLED[method.name]}: single outlines spread over {least:.2g} times as far as is "
        f"claimed of them: {places}{more}. Such an edge jumps between images; pooled "
        "standard deviations and upper bounds are of the jumps, medians are not."
    ]


def _view_and_pose(measurements: Measurements, o: LegOrientation) -> str:
    return f"{measurements.views[o.view].name}/{measurements.pose_labels[o.pose]}"
