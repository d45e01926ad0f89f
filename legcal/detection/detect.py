"""Guided detection: photographs, readings and rough camera poses to outlines (3.1).

Two verbs. ``align_views`` finds one camera pose for each view from all of its images;
``detect_outlines`` finds and measures the outlines near the predictions of those poses. After a
first calibration the second verb is called again with the fitted poses and a narrower window.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.detection.align import align_camera
from legcal.detection.outline import OUTSIDE, PartOutlines, outline_parts
from legcal.detection.picture import Grey, reduce, to_grey
from legcal.detection.prediction import PredictedLeg, predict_legs
from legcal.detection.strips import Strips, find_strips, reduction
from legcal.errors import NotVisible
from legcal.geometry.types import Array, BoolArray, Image
from legcal.mechanism.leg import Cylinder
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.vision.camera import Camera
from legcal.workers import Run, in_turn

Load = Callable[[int], Image]
_Candidates = tuple[PredictedLeg, Strips, float]
Progress = Callable[[int], None]
Method = Callable[
    [Grey, Camera, Sequence[PredictedLeg], Sequence[str], BoolArray, Array], list[PartOutlines]
]
"""Finds the outlines of all parts in one image, as :func:`legcal.detection.outline.outline_parts`
does."""

ROUGH_POSITION, ROUGH_ANGLE = 0.02, np.deg2rad(2.0)  # of T_base_camera [m, rad]
JOINT_ERROR = 4e-3  # of predicted joint centres: the nominal model's joints and platform pose [m]
PIXEL_ERROR = 3.0  # added to every window [px]


def align_views(
    load: Load,
    measurements: Measurements,
    A_base: Array,
    B_base: Array,
    cylinders: Sequence[Sequence[Cylinder]],
    T_base_camera: Sequence[RigidTransform],
    wanted: BoolArray | None = None,
    *,
    joint_error: float = JOINT_ERROR,
    progress: Progress | None = None,
    run: Run = in_turn,
) -> list[RigidTransform]:
    """Find the camera pose of every view from all of its images.

    Parameters
    ----------
    load : callable
        Returns the image of a row as an array, 8 or 16 bit, grey or colour (BGR).
    measurements : Measurements
        The rows; those with image "" are left out.
    A_base, B_base : (n_rows, n_legs, 3) array
        Predicted joint centres of every row in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs.
    T_base_camera : sequence of RigidTransform, for each view
        Rough poses, 2 cm and 2 degrees off.
    wanted : (n_views, n_legs) array of bool, optional
        Legs to use in each view; all of them when it is missing.
    joint_error : float
        How far the predicted joint centres may be off [m].
    progress : callable, optional
        Called with the row of each image when it has been searched.
    run : callable
        How the images are searched: in turn, or by the processes of
        :func:`legcal.workers.worker_pool`.

    Returns
    -------
    list of RigidTransform
        T_base_camera of every view; that of a view without images is returned as given.

    Raises
    ------
    NotVisible
        One sentence for every view whose camera pose cannot be found.
    """
    guide = _Guide(load, measurements, A_base, B_base, cylinders, T_base_camera, wanted)
    rows = _rows_with_images(measurements)
    found: dict[int, list[_Candidates]] = {}
    for row, items in zip(
        rows, run(partial(_search_strips, guide, joint_error), rows), strict=True
    ):
        found.setdefault(int(measurements.view[row]), []).extend(items)
        if progress is not None:
            progress(row)
    poses = list(T_base_camera)
    problems: list[str] = []
    for view, candidates in found.items():
        legs, strips, tolerance = zip(*candidates, strict=True) if candidates else ((), (), ())
        name = measurements.views[view].name
        try:
            poses[view] = align_camera(name, poses[view], legs, strips, np.array(tolerance))
        except NotVisible as error:
            problems.extend(error.problems)
    if problems:
        raise NotVisible(problems)
    return poses


def detect_outlines(
    load: Load,
    measurements: Measurements,
    A_base: Array,
    B_base: Array,
    cylinders: Sequence[Sequence[Cylinder]],
    T_base_camera: Sequence[RigidTransform],
    wanted: BoolArray,
    leg_names: Sequence[str],
    *,
    joint_error: float = JOINT_ERROR,
    pixel_error: float = PIXEL_ERROR,
    progress: Progress | None = None,
    run: Run = in_turn,
    method: Method = outline_parts,
) -> Outlines:
    """Find and measure the outlines of all legs, near where aligned cameras should see them.

    Parameters
    ----------
    load, measurements, A_base, B_base, cylinders, progress, run
        As for :func:`align_views`.
    T_base_camera : sequence of RigidTransform, for each view
        Aligned poses.
    wanted : (n_views, n_legs) array of bool
        Legs to use in each view.
    leg_names : sequence of str, length n_legs
        Names of the legs, for reasons.
    joint_error : float
        How far the predicted joint centres may be off [m]; 0 after a fit.
    pixel_error : float
        How far outlines may be off besides [px].
    method : callable
        How the outlines of an image are found and measured; it travels to worker processes.

    Returns
    -------
    Outlines
        Two rows for each part of each wanted leg of each image, by row, leg and part from base to
        platform; what was not found or cannot be trusted is rejected with the reason.
    """
    guide = _Guide(load, measurements, A_base, B_base, cylinders, T_base_camera, wanted)
    search = partial(_search_outlines, guide, method, tuple(leg_names), joint_error, pixel_error)
    rows = _rows_with_images(measurements)
    found = []
    for row, parts in zip(rows, run(search, rows), strict=True):
        found.append(parts)
        if progress is not None:
            progress(row)
    return _table(rows, found)


@dataclass(frozen=True, eq=False)
class _Guide:
    """Where the legs of every image should be; it travels to worker processes."""

    load: Load
    measurements: Measurements
    A_base: Array
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]
    T_base_camera: Sequence[RigidTransform]
    wanted: BoolArray | None

    def legs(self, row: int) -> tuple[Camera, int, list[PredictedLeg]]:
        """Return the camera of a row, its view, and the legs that should be in the image."""
        view = int(self.measurements.view[row])
        camera, T = self.measurements.views[view].camera, self.T_base_camera[view]
        legs = predict_legs(camera, T, self.A_base[row], self.B_base[row], self.cylinders, row)
        return camera, view, legs


def _search_strips(guide: _Guide, joint_error: float, row: int) -> list[_Candidates]:
    """Find the candidate strips of all wanted legs of an image."""
    camera, view, legs = guide.legs(row)
    if guide.wanted is not None:
        legs = [leg for leg in legs if guide.wanted[view, leg.leg]]
    return _search_image(guide.load(row), camera, legs, joint_error)


def _search_outlines(
    guide: _Guide,
    method: Method,
    leg_names: tuple[str, ...],
    joint_error: float,
    pixel_error: float,
    row: int,
) -> list[PartOutlines]:
    """Find and measure the outlines of all wanted legs of an image."""
    camera, view, legs = guide.legs(row)
    wanted = np.ones(len(leg_names), np.bool_) if guide.wanted is None else guide.wanted[view]
    window = np.zeros(len(leg_names))
    for leg in legs:
        window[leg.leg] = pixel_error + joint_error * _pixels_per_metre(leg)
    grey = to_grey(guide.load(row))
    found = method(grey, camera, legs, leg_names, wanted, window)
    missing = set(np.flatnonzero(wanted).tolist()) - {leg.leg for leg in legs}
    cylinders = guide.cylinders
    found.extend(_outside(leg, cylinders[leg]) for leg in missing if len(cylinders[leg]))
    return sorted(found, key=lambda part: part.leg)


def _rows_with_images(measurements: Measurements) -> list[int]:
    return [row for row, image in enumerate(measurements.image) if image]


def _pixels_per_metre(leg: PredictedLeg) -> float:
    """Return how large a metre appears at the nearer joint of a leg [px/m]."""
    nearest = max(min(leg.A_camera[2], leg.B_camera[2]), 0.2 * leg.A_camera[2], 1e-3)
    return float(leg.band.scale / nearest)


def _search_image(
    image: Image, camera: Camera, legs: Sequence[PredictedLeg], joint_error: float
) -> list[_Candidates]:
    """Find the candidate strips of all legs of an image, with the tolerance of each [px]."""
    grey = to_grey(image)
    found = []
    for leg in legs:
        magnification = _pixels_per_metre(leg)
        tolerance = PIXEL_ERROR + joint_error * magnification
        window = leg.band.scale * ROUGH_ANGLE + ROUGH_POSITION * magnification
        tilt = 1.5 * ROUGH_ANGLE * leg.band.length + tolerance
        ends = leg.edge_offsets(np.array([0.02, 0.98]) * leg.band.length)
        factor = reduction(window, float(np.min(ends[1] - ends[0])))
        small = reduce(grey, factor)
        strips = find_strips(small, factor, camera, leg, window + tolerance, tilt)
        found.append((leg, strips, tolerance))
    return found


def _outside(leg: int, cylinders: Sequence[Cylinder]) -> PartOutlines:
    """Return the verdict on a leg that is not in the image."""
    h, square = np.full((2, 3), np.nan), np.full((2, 2, 2), np.nan)
    longest = max(cylinders, key=lambda cylinder: (cylinder.end - cylinder.start, cylinder.link))
    return PartOutlines(leg, longest.link, h, square, square, (OUTSIDE, OUTSIDE))


def _table(rows: Sequence[int], found: Sequence[Sequence[PartOutlines]]) -> Outlines:
    """Put the outlines of all images into one table."""
    items = [(row, part) for row, parts in zip(rows, found, strict=True) for part in parts]
    pairs = [(row, part, edge) for row, part in items for edge in (0, 1)]
    return Outlines(
        row=np.array([row for row, _, _ in pairs], dtype=np.intp),
        leg=np.array([part.leg for _, part, _ in pairs], dtype=np.intp),
        part=tuple(part.part for _, part, _ in pairs),
        edge=np.array([edge + 1 for _, _, edge in pairs], dtype=np.intp),
        h=np.array([part.h[edge] for _, part, edge in pairs]).reshape(-1, 3),
        ends=np.array([part.ends[edge] for _, part, edge in pairs]).reshape(-1, 2, 2),
        covariance=np.array([part.covariance[edge] for _, part, edge in pairs]).reshape(-1, 2, 2),
        used=np.array([part.reasons[edge] == "" for _, part, edge in pairs], dtype=np.bool_),
        reason=tuple(part.reasons[edge] for _, part, edge in pairs),
        source=("detected",) * len(pairs),
        contrast=np.array([part.contrast[edge] for _, part, edge in pairs]),
        length=np.array([part.length[edge] for _, part, edge in pairs]),
        residual=np.array([part.residual[edge] for _, part, edge in pairs]),
    )
