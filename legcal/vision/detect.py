"""Guided detection: photographs, readings and rough camera poses to outlines (3.1, hazard 14).

Two verbs. ``align_views`` finds one camera pose for each view from all of its images;
``detect_outlines`` finds and measures the outlines near the predictions of those poses. After a
first calibration the second verb is called again with the fitted poses and a narrower window.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotVisible
from legcal.geometry.types import Array, BoolArray, Image
from legcal.mechanism.leg import Cylinder
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.vision.align import align_camera
from legcal.vision.camera import Camera
from legcal.vision.outline import PartOutlines, outline_parts
from legcal.vision.picture import reduce, to_grey
from legcal.vision.prediction import PredictedLeg, predict_legs
from legcal.vision.strips import Strips, find_strips, reduction

Load = Callable[[int], Image]
Progress = Callable[[int], None]

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
    workers: int = 1,
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
    workers : int
        Threads; more than one pays only where loading an image is slow.

    Returns
    -------
    list of RigidTransform
        T_base_camera of every view; that of a view without images is returned as given.

    Raises
    ------
    NotVisible
        One sentence for every view whose camera pose cannot be found.
    """

    def search(row: int) -> list[tuple[PredictedLeg, Strips, float]]:
        view = int(measurements.view[row])
        camera, T = measurements.views[view].camera, T_base_camera[view]
        legs = predict_legs(camera, T, A_base[row], B_base[row], cylinders, row)
        if wanted is not None:
            legs = [leg for leg in legs if wanted[view, leg.leg]]
        found = _search_image(load(row), camera, legs, joint_error)
        if progress is not None:
            progress(row)
        return found

    poses = list(T_base_camera)
    problems: list[str] = []
    with ThreadPoolExecutor(max_workers=workers) as pool:
        for index, view in enumerate(measurements.views):
            rows = [
                row for row in _rows_with_images(measurements) if measurements.view[row] == index
            ]
            if not rows:
                continue
            found = [item for items in pool.map(search, rows) for item in items]
            legs, strips = [item[0] for item in found], [item[1] for item in found]
            tolerance = np.array([item[2] for item in found])
            try:
                poses[index] = align_camera(view.name, poses[index], legs, strips, tolerance)
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
    workers: int = 1,
) -> Outlines:
    """Find and measure the outlines of all legs, near where aligned cameras should see them.

    Parameters
    ----------
    load, measurements, A_base, B_base, cylinders, progress, workers
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

    Returns
    -------
    Outlines
        Two rows for each part of each wanted leg of each image, by row, leg and part from base to
        platform; what was not found or cannot be trusted is rejected with the reason.
    """

    def search(row: int) -> list[PartOutlines]:
        view = int(measurements.view[row])
        camera, T = measurements.views[view].camera, T_base_camera[view]
        legs = predict_legs(camera, T, A_base[row], B_base[row], cylinders, row)
        window = np.zeros(A_base.shape[1])
        for leg in legs:
            window[leg.leg] = pixel_error + joint_error * _pixels_per_metre(leg)
        found = outline_parts(to_grey(load(row)), camera, legs, leg_names, wanted[view], window)
        missing = set(np.flatnonzero(wanted[view]).tolist()) - {leg.leg for leg in legs}
        found.extend(_outside(leg, cylinders[leg]) for leg in missing if len(cylinders[leg]))
        if progress is not None:
            progress(row)
        return sorted(found, key=lambda part: part.leg)

    rows = _rows_with_images(measurements)
    with ThreadPoolExecutor(max_workers=workers) as pool:
        return _table(rows, list(pool.map(search, rows)))


def _rows_with_images(measurements: Measurements) -> list[int]:
    return [row for row, image in enumerate(measurements.image) if image]


def _pixels_per_metre(leg: PredictedLeg) -> float:
    """Return how large a metre appears at the nearer joint of a leg [px/m]."""
    nearest = max(min(leg.A_camera[2], leg.B_camera[2]), 0.2 * leg.A_camera[2], 1e-3)
    return float(leg.band.scale / nearest)


def _search_image(
    image: Image, camera: Camera, legs: Sequence[PredictedLeg], joint_error: float
) -> list[tuple[PredictedLeg, Strips, float]]:
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
    return PartOutlines(leg, longest.link, h, square, square, "outside the image")


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
        used=np.array([part.reason == "" for _, part, _ in pairs], dtype=np.bool_),
        reason=tuple(part.reason for _, part, _ in pairs),
        source=("detected",) * len(pairs),
    )
