"""The board searched in the images of a dataset, and what stands there instead of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import Corners, Measurements, Outlines, found_corners, join_corners
from legcal.errors import NotVisible
from legcal.geometry import Array, BoolArray, Image, IntArray
from legcal.machine import Cylinder
from legcal.perception.outline import OUTSIDE, PartOutlines, outline_parts
from legcal.perception.picture import Grey, to_grey
from legcal.progress import Report
from legcal.vision import Board, Camera, PredictedLeg, described, find_corners, predict_legs
from legcal.workers import Run, in_turn

Load = Callable[[int], Image]
Progress = Callable[[int], None]
Method = Callable[
    [Grey, Camera, Sequence[PredictedLeg], Sequence[str], BoolArray, Array], list[PartOutlines]
]
"""Finds the outlines of all parts in one image, as :func:`legcal.perception.outline.outline_parts`
does."""

NOT_PLACED = "the camera of its view could not be placed"  # a reason
JOINT_ERROR = 4e-3  # of predicted joint centres: the nominal model's joints and platform pose [m]
PIXEL_ERROR = 3.0  # added to every window [px]


def detect_outlines(
    load: Load,
    measurements: Measurements,
    A_base: Array,
    B_base: Array,
    cylinders: Sequence[Sequence[Cylinder]],
    T_base_camera: Sequence[RigidTransform | None],
    wanted: BoolArray,
    leg_names: Sequence[str],
    *,
    joint_error: float | Array = JOINT_ERROR,
    pixel_error: float = PIXEL_ERROR,
    window: Array | None = None,
    progress: Progress | None = None,
    run: Run = in_turn,
    method: Method | Sequence[Method] = outline_parts,
    blur_of_row: dict[int, float] | None = None,
) -> Outlines:
    """Find and measure the outlines of all legs, near where aligned cameras should see them.

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
    T_base_camera : sequence of RigidTransform or None, for each view
        Camera poses; the legs of a view without one are rejected.
    wanted : (n_views, n_legs) array of bool
        Legs to use in each view.
    leg_names : sequence of str, length n_legs
        Names of the legs, for reasons.
    joint_error : float or (n_views, n_legs) array
        How far the predicted joint centres may be off [m]; 0 after a fit.
    pixel_error : float
        How far outlines may be off besides [px].
    window : (n_rows, n_legs) array, optional
        Instead of both: how far outlines may be off in each image [px]; NaN for legs that are not
        searched for in it.
    progress : callable, optional
        Called with the row of each image when it has been searched.
    run : callable
        How the images are searched: in turn, or by the processes of
        :func:`legcal.workers.worker_pool`.
    method : callable, or one for each view
        How the outlines of an image are found and measured; it travels to worker processes.
    blur_of_row : dict, optional
        Takes the standard deviation of the blur of each image that was measured [px], by row.

    Returns
    -------
    Outlines
        Two rows for each part of each wanted leg of each image, by row, leg and part from base to
        platform; what was not found or cannot be trusted is rejected with the reason.
    """
    error = np.broadcast_to(np.asarray(joint_error, dtype=np.float64), np.shape(wanted))
    guide = _Guide(
        load, measurements, A_base, B_base, cylinders, T_base_camera, wanted, error, window
    )
    methods = (method,) * len(measurements.views) if callable(method) else tuple(method)
    search = partial(_search_outlines, guide, methods, tuple(leg_names), pixel_error)
    rows = _rows_with_images(measurements)
    if window is not None:
        rows = [row for row in rows if not np.isnan(window[row]).all()]
    found = []
    for row, parts in zip(rows, run(search, rows), strict=True):
        found.append(parts)
        blurs = [part.blur for part in parts if np.isfinite(part.blur)]
        if blur_of_row is not None and blurs:
            blur_of_row[row] = blurs[0]  # that of the image
        if progress is not None:
            progress(row)
    return _table(rows, found, measurements)


@dataclass(frozen=True, eq=False)
class _Guide:
    """Where the legs of every image should be; it travels to worker processes."""

    load: Load
    measurements: Measurements
    A_base: Array
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]
    T_base_camera: Sequence[RigidTransform | None]
    wanted: BoolArray
    joint_error: Array
    window: Array | None

    def legs(self, row: int, T_base_camera: RigidTransform) -> tuple[Camera, list[PredictedLeg]]:
        """Return the camera of a row, and the legs that should be in the image."""
        camera = self.measurements.views[self.measurements.view[row]].camera
        A, B = self.A_base[row], self.B_base[row]
        return camera, predict_legs(camera, T_base_camera, A, B, self.cylinders, row)


def _search_outlines(
    guide: _Guide,
    methods: Sequence[Method],
    leg_names: tuple[str, ...],
    pixel_error: float,
    row: int,
) -> list[PartOutlines]:
    """Find and measure the outlines of all wanted legs of an image."""
    view = int(guide.measurements.view[row])
    wanted, T = guide.wanted[view], guide.T_base_camera[view]
    cylinders = guide.cylinders
    if T is None:
        legs = [leg for leg in np.flatnonzero(wanted).tolist() if len(cylinders[leg])]
        return [_unsearched(leg, cylinders[leg], NOT_PLACED) for leg in legs]
    camera, predicted = guide.legs(row, T)
    window = np.zeros(len(leg_names))
    if guide.window is not None:
        wanted = wanted & ~np.isnan(guide.window[row])
        window = np.where(wanted, guide.window[row], 0.0)
    else:
        for leg in predicted:
            error = guide.joint_error[view, leg.leg] * _pixels_per_metre(leg)
            window[leg.leg] = pixel_error + error
    grey = to_grey(guide.load(row))
    found = methods[view](grey, camera, predicted, leg_names, wanted, window)
    missing = set(np.flatnonzero(wanted).tolist()) - {leg.leg for leg in predicted}
    found.extend(_unsearched(j, cylinders[j], OUTSIDE) for j in missing if len(cylinders[j]))
    return sorted(found, key=lambda part: part.leg)


def _rows_with_images(measurements: Measurements) -> list[int]:
    return [row for row, image in enumerate(measurements.image) if image]


def _pixels_per_metre(leg: PredictedLeg) -> float:
    """Return how large a metre appears at the nearer joint of a leg [px/m]."""
    nearest = max(min(leg.A_camera[2], leg.B_camera[2]), 0.2 * leg.A_camera[2], 1e-3)
    return float(leg.band.scale / nearest)


def _unsearched(leg: int, cylinders: Sequence[Cylinder], reason: str) -> PartOutlines:
    """Return the verdict on a leg that is not searched for in an image."""
    h, square = np.full((2, 3), np.nan), np.full((2, 2, 2), np.nan)
    longest = max(cylinders, key=lambda cylinder: (cylinder.end - cylinder.start, cylinder.link))
    return PartOutlines(leg, longest.link, h, square, square, (reason, reason))


def _table(
    rows: Sequence[int], found: Sequence[Sequence[PartOutlines]], measurements: Measurements
) -> Outlines:
    """Put the outlines of all images into one table."""
    gamma = [view.camera.gamma for view in measurements.views]
    items = [(row, part) for row, parts in zip(rows, found, strict=True) for part in parts]
    pairs = [(row, part, edge) for row, part in items for edge in (0, 1)]
    by_gamma = np.array([part.by_gamma[edge] for _, part, edge in pairs])
    of_row = np.array([gamma[measurements.view[row]] for row, _, _ in pairs])
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
        gamma=np.where(np.isnan(by_gamma), np.nan, of_row),
        by_gamma=by_gamma,
    )


STAGE = "Searching the board"
_ASKED = 2  # images of a view that are asked what they show instead


def detect_corners(
    board: Board,
    load: Callable[[int], Image],
    rows: Sequence[int],
    run: Run,
    report: Report,
) -> Corners:
    """Return the corners of the board in images; an image without the board has none.

    Parameters
    ----------
    board : Board
        The board.
    load : callable
        Returns the image of a row; it can travel to another process.
    rows : sequence of int
        The rows to search.
    run : callable
        How images are searched: in turn or by several processes.
    report : callable
        Called as ``report(stage, done, total)``.
    """
    report(STAGE, 0, len(rows))
    found = []
    search = _Search(board, load)
    for k, (row, (corner, px, sigma)) in enumerate(zip(rows, run(search, rows), strict=True)):
        found.append(found_corners(np.full(len(corner), row, dtype=np.intp), corner, px, sigma))
        report(STAGE, k + 1, len(rows))
    return join_corners(found)


def require_board(
    board: Board,
    corners: Corners,
    load: Callable[[int], Image],
    measurements: Measurements,
    views: Collection[str],
) -> None:
    """Refuse views whose images do not show the board, and say what they show instead.

    Parameters
    ----------
    board : Board
        The board.
    corners : Corners
        What :func:`detect_corners` found.
    load : callable
        Returns the image of a row.
    measurements : Measurements
        The rows.
    views : collection of str
        The views that need the board.

    Raises
    ------
    NotVisible
        With one sentence for each of them.
    """
    shown = set(measurements.view[corners.row].tolist())
    problems = []
    for v, view in enumerate(measurements.views):
        rows = [row for row in np.flatnonzero(measurements.view == v).tolist()
                if measurements.image[row]]  # fmt: skip
        if view.name not in views or v in shown or not rows:
            continue
        found = next((what for row in rows[:_ASKED] if (what := _shown(board, load, row))), None)
        problems.append(
            f"view {view.name}: the board could not be found in any of its {len(rows)} "
            f"image{'s' * (len(rows) != 1)}: found {found or 'nothing like it'}, needed "
            f"{_words(board)}; correct the block board of the dataset file, or turn the camera."
        )
    if problems:
        raise NotVisible(problems)


def _shown(board: Board, load: Callable[[int], Image], row: int) -> str | None:
    """Return what an image shows instead of a board, in words; None if there is nothing."""
    return described(board, to_grey(load(row)))


def _words(board: Board) -> str:
    """Return a board in words."""
    what = "tags" if board.kind == "aprilgrid" else "squares"
    whole = ", the whole of it" if board.kind == "chessboard" else ""
    name = {"chessboard": "a chessboard", "charuco": "a ChArUco board", "aprilgrid": "an AprilGrid"}
    return f"{name[board.kind]} of {board.columns} x {board.rows} {what}{whole}"


@dataclass(frozen=True, eq=False)
class _Search:
    """The search of an image, for any process."""

    board: Board
    load: Callable[[int], Image]

    def __call__(self, row: int) -> tuple[IntArray, Array, Array]:
        """Return what :func:`find_corners` does for the image of a row."""
        return find_corners(self.board, to_grey(self.load(row)))
