"""The calibration board: searched in images, and where the cameras stand before it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from legcal.data import (
    Corners,
    Measurements,
    few,
    found_corners,
    join_corners,
    row_names,
)
from legcal.errors import DatasetError, NotVisible
from legcal.geometry import Array, IntArray
from legcal.perception.light import to_grey
from legcal.perception.placement import Load
from legcal.progress import Report
from legcal.vision import (
    Board,
    Camera,
    PlanePose,
    described,
    find_corners,
    plane_poses,
    refined_pose,
)
from legcal.workers import Run

STAGE = "Searching the board"
_ASKED = 2  # images of a view that are asked what they show instead
FEWEST = 4  # corners, not on a line, that place a camera
WORST_PX, WORST_SIGMA = 1.0, 5.0  # residual (root mean square) of corners that are of this board
REJECTED_PX, REJECTED_SIGMA = 0.3, 6.0  # a corner further off than both is rejected
SURELY = 25.0  # by which twice the cost of the second pose must exceed that of the first
LEAST_PX = 0.15  # by which corners must shift together
SIGNIFICANCE = 1e-6  # of a motion, for each pair of images


def detect_corners(
    board: Board,
    load: Load,
    rows: Sequence[int],
    run: Run,
    report: Report,
) -> Corners:
    """Return the corners of the board in the images of rows; one without the board has none.

    ``load`` returns the image of a row and can travel to another process.
    """
    report(STAGE, 0, len(rows))
    found = []
    search = partial(_search, board, load)
    for k, (row, (corner, px, sigma)) in enumerate(zip(rows, run(search, rows), strict=True)):
        found.append(found_corners(np.full(len(corner), row, dtype=np.intp), corner, px, sigma))
        report(STAGE, k + 1, len(rows))
    return join_corners(found)


def require_board(
    board: Board,
    corners: Corners,
    load: Load,
    measurements: Measurements,
    views: Collection[str],
) -> None:
    """Refuse needed views whose images do not show the board, and say what they show instead.

    Raises NotVisible with one sentence for each of them.
    """
    shown = set(measurements.view[corners.row].tolist())
    problems = []
    for v, view in enumerate(measurements.views):
        rows = [row for row in np.flatnonzero(measurements.view == v).tolist()
                if measurements.image[row]]  # fmt: skip
        if view.name not in views or v in shown or not rows:
            continue
        found = next(
            (what for row in rows[:_ASKED] if (what := described(board, to_grey(load(row))))), None
        )
        problems.append(
            f"view {view.name}: the board could not be found in any of its {len(rows)} "
            f"image{'s' * (len(rows) != 1)}: found {found or 'nothing like it'}, needed "
            f"{_words(board)}; correct the block board of the dataset file, or turn the camera."
        )
    if problems:
        raise NotVisible(problems)


def _words(board: Board) -> str:
    """Return a board in words."""
    what = "tags" if board.kind == "aprilgrid" else "squares"
    whole = ", the whole of it" if board.kind == "chessboard" else ""
    name = {"chessboard": "a chessboard", "charuco": "a ChArUco board", "aprilgrid": "an AprilGrid"}
    return f"{name[board.kind]} of {board.columns} x {board.rows} {what}{whole}"


def _search(board: Board, load: Load, row: int) -> tuple[IntArray, Array, Array]:
    """Return the corners, their pixels and sigmas in the image of a row."""
    return find_corners(board, to_grey(load(row)))


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """Cameras in front of the board."""

    rows: tuple[RigidTransform | None, ...]  # (n_rows,) T_board_camera by the corners of the image
    # itself, of two poses that these leave that nearer to the view's; None where they are too few
    views: tuple[RigidTransform | None, ...]  # (n_views,) by all images; None: none shows the board
    covariance: Array  # (n_views, 6, 6) of a shift [m] and a turn [rad] of the board, both in the
    # camera frame; NaN without a pose. As large as the residuals say where they exceed what corners
    # claim. What all images have in common, such as a shadow, counts as often as there are images
    corners: Corners  # those that contradict the others rejected


def camera_poses(
    corners: Corners,
    board: Board,
    measurements: Measurements,
    needed: Collection[str] = (),
) -> BoardPoses:
    """Return where the cameras of all views stand before the board, by corners that are used.

    Raises NotVisible if a needed view has no pose: the board is in none of its images, or is seen
    so that two poses explain it; DatasetError if corners are not those of this board by the camera
    file, or the board moved between images of a view.
    """
    names = row_names(measurements)
    rows: list[RigidTransform | None] = [None] * measurements.n_rows
    views: list[RigidTransform | None] = []
    covariance = np.full((len(measurements.views), 6, 6), np.nan)
    problems: dict[type[DatasetError] | type[NotVisible], list[str]] = {}
    for v, view in enumerate(measurements.views):
        here = np.flatnonzero((measurements.view[corners.row] == v) & corners.used)
        try:
            found = _view_pose(view.name, corners.choose(here), board, measurements, names)
        except (DatasetError, NotVisible) as error:
            if isinstance(error, DatasetError) or view.name in needed:
                problems.setdefault(type(error), []).extend(error.problems)
            views.append(None)
            continue
        views.append(None if found is None else found.T_board_camera)
        if found is not None:
            covariance[v] = found.covariance
            for row, T in found.rows.items():
                rows[row] = T
            off = np.full(len(corners), np.nan)
            off[here[found.wrong]] = found.off_px[found.wrong]
            why = [f"{px:.2g} px from where the other corners put it" for px in off]
            corners = corners.reject(~np.isnan(off), why)
        elif view.name in needed:
            n = int(np.sum(measurements.view == v))
            problems.setdefault(NotVisible, []).append(
                f"view {view.name}: its camera could not be placed: found {FEWEST} corners of the "
                f"board or more in none of its {n} image{'s' * (n != 1)}, needed them in one; turn "
                f"the camera so that it sees the board{_whole(board)}, or check what the dataset "
                "file says of the board."
            )
    for kind, sentences in problems.items():
        raise kind(sentences)
    return BoardPoses(tuple(rows), tuple(views), covariance, corners)


class _ViewPose(NamedTuple):
    """The pose of a view, those of its images, and the corners that contradict it."""

    T_board_camera: RigidTransform
    covariance: Array
    rows: dict[int, RigidTransform]
    wrong: IntArray
    off_px: Array


def _view_pose(
    name: str,
    corners: Corners,
    board: Board,
    measurements: Measurements,
    names: tuple[str, ...],
) -> _ViewPose | None:
    """Return the pose of a view by its corners; None if no image shows enough of them."""
    if not len(corners):
        return None
    camera = measurements.views[measurements.view[corners.row[0]]].camera
    candidates: list[PlanePose] = []
    of_row: dict[int, list[PlanePose]] = {}
    for row in np.unique(corners.row).tolist():
        own = corners.row == row
        points = board.points[corners.corner[own]]
        if _in_plane(points):
            sigma = corners.sigma_px[own]
            of_row[row] = plane_poses(camera, points, corners.px[own], sigma)
            candidates += of_row[row]
    if not candidates and of_row:
        raise DatasetError(_another_board(name, board, "no pose of", "showing them there"))
    if not candidates:
        return None
    everything = board.points[corners.corner], corners.px, corners.sigma_px
    joint = [
        pose
        for start in _distinct(candidates)
        if (pose := refined_pose(camera, *everything, start.T_camera_plane)) is not None
    ]
    joint = _distinct(sorted(joint, key=lambda pose: pose.cost))
    if not joint:
        raise DatasetError(
            _another_board(name, board, "no one pose of", "one that all its images show")
        )
    best = joint[0]
    scale = _scale(best, corners)
    single = {
        row: pose
        for row, poses in of_row.items()
        if (pose := _sure(poses, scale, best)) is not None
    }
    moved = _moved_board(name, single, scale, board, camera, names)
    if moved is not None:
        raise DatasetError(moved)
    _check_fit(name, best, corners, board)
    if len(joint) > 1 and 2.0 * (joint[1].cost - joint[0].cost) < SURELY * scale**2:
        raise NotVisible(
            f"view {name}: its camera could not be placed: found two poses that explain the "
            f"{len(corners)} corners of the board alike, "
            f"{np.rad2deg(_turn(joint[0], joint[1])):.0f} degrees apart, needed a board that is "
            "larger in the image and seen at a slant; move the camera nearer."
        )
    off = np.linalg.norm(best.residual_px, axis=1)
    limit = np.maximum(REJECTED_PX, REJECTED_SIGMA * scale * corners.sigma_px)
    return _ViewPose(
        T_board_camera=best.T_camera_plane.inv(),
        covariance=np.asarray(scale**2 * np.linalg.inv(best.information), dtype=np.float64),
        rows={row: pose.T_camera_plane.inv() for row, pose in single.items()},
        wrong=np.flatnonzero(off > limit),
        off_px=off,
    )


def _moved_board(
    name: str,
    single: Mapping[int, PlanePose],
    scale: float,
    board: Board,
    camera: Camera,
    names: tuple[str, ...],
) -> str | None:
    """Return in which images of a view the board stands elsewhere than in most, and how far.

    By the pose of each image alone, by its row; ``scale`` is by how much residuals exceed what
    corners claim, ``names`` what each row is called. None if nothing moved.
    """
    rows = list(single)
    if len(rows) < 2:
        return None
    limit = float(chi2.isf(SIGNIFICANCE / len(rows), 6)) * scale**2
    px = {
        row: camera.project(pose.T_camera_plane.apply(board.points)) for row, pose in single.items()
    }
    together = np.array(
        [[_agree(single[a], single[b], px[a] - px[b], limit) for b in rows] for a in rows]
    )
    most = int(np.argmax(together.sum(axis=1)))
    others = [row for row, same in zip(rows, together[most], strict=True) if not same]
    if not others:
        return None
    reference = single[rows[most]].T_camera_plane
    moves = [reference.inv() * single[row].T_camera_plane for row in others]
    middle = board.points.mean(axis=0)
    far = max(float(np.linalg.norm(T.apply(middle) - middle)) for T in moves)
    turn = max(float(T.rotation.magnitude()) for T in moves)
    told = few([names[row] for row in others])
    return (
        f"view {name}: its camera could not be placed: found the board elsewhere in {told} than in "
        f"{names[rows[most]]}, by up to {1e3 * far:.2g} mm and {np.rad2deg(turn):.2g} degrees, "
        "needed a camera and a board that stand still in all images of a view; leave those images "
        "out, or give them a view of their own."
    )


def _agree(one: PlanePose, other: PlanePose, shift_px: Array, limit: float) -> bool:
    """Say whether two poses of the board are one, within what is known of them."""
    if float(np.sqrt(np.mean(np.sum(shift_px**2, axis=1)))) < LEAST_PX:
        return True
    a, b = one.T_camera_plane, other.T_camera_plane
    turn = (b.rotation * a.rotation.inv()).as_rotvec()
    d = np.concatenate([b.translation - a.translation, turn])
    covariance = np.linalg.inv(one.information) + np.linalg.inv(other.information)
    return bool(d @ np.linalg.solve(covariance, d) < limit)


def _check_fit(name: str, pose: PlanePose, corners: Corners, board: Board) -> None:
    """Refuse corners that no pose of this board explains."""
    off = np.linalg.norm(pose.residual_px, axis=1)
    usual = float(np.median(off)) / np.sqrt(2.0 * np.log(2.0))  # as of one coordinate
    sigma = float(np.median(corners.sigma_px))
    if usual <= max(WORST_PX, WORST_SIGMA * sigma):
        return
    limit = f"{max(WORST_PX, WORST_SIGMA * sigma):.2g} px"
    raise DatasetError(_another_board(name, board, f"{usual:.2g} px from the best pose of", limit))


def _another_board(name: str, board: Board, found: str, needed: str) -> str:
    """Return that corners are not those of this board by the camera file."""
    sizes = {
        "chessboard": "the numbers of squares",
        "charuco": "the numbers of squares, marker and square",
        "aprilgrid": "the numbers of tags and tag_spacing",
    }[board.kind]
    return (
        f"view {name}: its camera could not be placed by the corners of the board: found {found} "
        f"the {board.kind} of the dataset file, needed {needed}; check {sizes} there, and that the "
        "camera file is of this camera and lens."
    )


def _scale(pose: PlanePose, corners: Corners) -> float:
    """Return by how much residuals exceed what corners claim, at least one."""
    t = np.linalg.norm(pose.residual_px, axis=1) / corners.sigma_px
    return max(1.0, float(np.median(t)) / float(np.sqrt(2.0 * np.log(2.0))))


def _sure(poses: list[PlanePose], scale: float, near: PlanePose) -> PlanePose | None:
    """Return the pose of an image; of two that both explain it that near the view's."""
    if len(poses) > 1 and 2.0 * (poses[1].cost - poses[0].cost) < SURELY * scale**2:
        return min(poses, key=lambda pose: _turn(pose, near))
    return poses[0] if poses else None


def _distinct(poses: list[PlanePose]) -> list[PlanePose]:
    """Return the poses that differ by more than a few degrees, the first ones of each kind."""
    kept: list[PlanePose] = []
    for pose in poses:
        if all(_turn(pose, other) > np.deg2rad(3.0) for other in kept):
            kept.append(pose)
    return kept


def _turn(one: PlanePose, other: PlanePose) -> float:
    """Return the angle between two poses [rad]."""
    turn = one.T_camera_plane.rotation * other.T_camera_plane.rotation.inv()
    return float(turn.magnitude())


def _in_plane(points: Array) -> bool:
    """Say whether points are enough, and not all on a line."""
    if len(points) < FEWEST:
        return False
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(size[1] > 1e-3 * size[0])


def _whole(board: Board) -> str:
    """Return how much of a board must be seen."""
    return ", the whole of it" if board.kind == "chessboard" else ""
