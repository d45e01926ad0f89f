"""Where cameras stand before the calibration board (section 3.1): planar PnP, for each view one.

A plane that is seen with little perspective has two poses that show it almost alike (IPPE). Both
are refined in the image with the whole lens model, and kept while both explain it. A view has the
pose that all of its images show; these must agree on it one by one, or the board has moved.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from legcal.data.corners import Corners
from legcal.data.dataset import MIN_CORNERS
from legcal.data.measurements import Measurements, few, row_names
from legcal.data.reasons import Reason, Rejection
from legcal.errors import DatasetError, NotVisible, Problem
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.board_adjustment import BoardImages, adjust_board
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.point_pose import closed_form_poses

SAME_ANGLE, SIMILAR_ANGLE = 1e-3, np.deg2rad(3.0)  # between poses of one plane: of an image, a view
MAX_RESIDUAL_PX, MAX_RESIDUAL_SIGMA = 1.0, 5.0  # root mean square of corners of this board
OUTLIER_PX, OUTLIER_SIGMA = 0.3, 6.0  # a corner further off than both is rejected
MIN_CHI2_LEAD = 25.0  # of one pose over the other one, in squares
MIN_SHIFT_PX = 0.15  # by which corners must shift together where the board moved
SIGNIFICANCE = 1e-6  # of a motion, for each pair of images


@dataclass(frozen=True, eq=False)
class PlanePose:
    """A pose that explains the points of a plane."""

    T_camera_plane: RigidTransform
    cost: float  # half the sum of squares of whitened residuals, large ones by Huber's loss
    residual_px: Array  # (n, 2) pixels less where the points should be seen [px]
    information: Array  # (6, 6) of a rotation vector [rad] and a displacement [m] of the plane


def plane_poses(
    camera: Camera,
    points: Array,  # (n, 3) four points or more of the plane z = 0, not all on a line [m]
    px: Array,  # (n, 2) where they are seen [px]
    sigma_px: Array,  # (n,) standard deviations of either coordinate [px]
) -> list[PlanePose]:
    """Return the poses of a plane that explain where its points are seen, the better one first."""
    xy = camera.undistort(px)
    starts = list(closed_form_poses(points, xy, cv2.SOLVEPNP_IPPE))
    refined = [_refine(camera, points, px, sigma_px, start) for start in starts]
    poses = _distinct([pose for pose in refined if pose is not None], SAME_ANGLE)
    return sorted(poses, key=lambda pose: pose.cost)


def _refine(
    camera: Camera, points: Array, px: Array, sigma_px: Array, start: RigidTransform
) -> PlanePose | None:
    """Return the pose of least cost near a start; None if it puts points behind the camera."""
    one = BoardImages(np.zeros(len(px), dtype=np.intp), points, px, sigma_px)
    adjusted = adjust_board(camera, [start], one)
    if adjusted is None:
        return None
    return PlanePose(
        adjusted.T_camera_board[0], adjusted.cost, adjusted.residual, adjusted.information[0]
    )


def _distinct(poses: list[PlanePose], angle: float) -> list[PlanePose]:
    """Return the poses that differ by more than an angle, the first ones of each kind."""
    kept: list[PlanePose] = []
    for pose in poses:
        if all(_angle(pose, other) > angle for other in kept):
            kept.append(pose)
    return kept


def _angle(one: PlanePose, other: PlanePose) -> float:
    """Return the angle between two poses [rad]."""
    turn = one.T_camera_plane.rotation * other.T_camera_plane.rotation.inv()
    return float(turn.magnitude())


def camera_poses_by_board(
    corners: Corners,
    board: Board,
    measurements: Measurements,
    needed: Collection[str] = (),
) -> tuple[tuple[RigidTransform | None, ...], Corners]:
    """Return T_board_camera of all views by corners that are used, and corners without outliers.

    A view whose images do not show the board has None. Raises NotVisible if that is a needed one,
    or it is seen so that two poses explain it; DatasetError if corners are not those of this board
    by the camera file, or the board moved between images of a view.
    """
    T_board_camera: list[RigidTransform | None] = []
    problems: dict[type[DatasetError] | type[NotVisible], list[Problem]] = {}
    for v, view in enumerate(measurements.views):
        here = np.flatnonzero((measurements.view[corners.row] == v) & corners.used)
        pose = None
        try:
            pose = _joint_pose(view.name, corners.choose(here), board, measurements)
        except (DatasetError, NotVisible) as error:
            if isinstance(error, DatasetError) or view.name in needed:
                problems.setdefault(type(error), []).extend(error.facts)
        else:
            if pose is None and view.name in needed:
                n = int(np.sum(measurements.view == v))
                problems.setdefault(NotVisible, []).append(
                    Problem(
                        f"view {view.name}: its camera could not be placed",
                        f"{MIN_CORNERS} corners of the board or more in none of its {n} image"
                        f"{'s' * (n != 1)}",
                        "them in one",
                        "turn the camera so that it sees the board"
                        f"{', all of its rim' * (board.kind == 'chessboard')}, or check what the "
                        "dataset file says of the board",
                        name=view.name,
                    )
                )
        T_board_camera.append(None if pose is None else pose.T_camera_plane.inv())
        if pose is not None:
            corners = _without_outliers(corners, here, pose)
    for kind, of_kind in problems.items():
        raise kind(of_kind)
    return tuple(T_board_camera), corners


def board_poses_in_images(
    corners: Corners, board: Board, measurements: Measurements
) -> tuple[dict[int, RigidTransform], Corners]:
    """Return T_camera_board by the rows of images, and corners without outliers.

    The board moves with the platform: images of one view and one pose show one place of it. An
    image that shows too few corners, or two poses explain, has none; corners of one that no pose of
    this board explains are rejected. Raises DatasetError if most images are of that kind.
    """
    T_camera_board: dict[int, RigidTransform] = {}
    places = np.stack([measurements.view, measurements.pose], axis=1)[corners.row]
    wrong: list[Problem] = []
    for v, pose_number in np.unique(places[corners.used], axis=0).tolist():
        of_place = np.all(places == (v, pose_number), axis=1)
        here = np.flatnonzero(of_place & corners.used)
        rows = np.unique(corners.row[of_place]).tolist()
        name = f"{measurements.views[v].name}, {row_names(measurements)[rows[0]]}"
        try:
            pose = _joint_pose(name, corners.choose(here), board, measurements)
        except NotVisible:
            continue
        except DatasetError as error:
            wrong += error.facts
            corners = corners.reject(of_place, Reason.NO_BOARD_POSE)
            continue
        if pose is not None:
            T_camera_board |= dict.fromkeys(rows, pose.T_camera_plane)
            corners = _without_outliers(corners, here, pose)
    if len(wrong) > len(T_camera_board):
        raise DatasetError(wrong)
    return T_camera_board, corners


def _without_outliers(corners: Corners, here: IntArray, pose: PlanePose) -> Corners:
    """Return corners, those among *here* rejected that are far from where a pose puts them."""
    off = np.zeros(len(corners))
    off[here] = np.linalg.norm(pose.residual_px, axis=1)
    outlier = np.zeros(len(corners), dtype=np.bool_)
    outlier[here] = _outliers(pose, corners.choose(here))
    why = [Rejection(Reason.CORNER_OFF, f"{px:.2g}") for px in off]
    return corners.reject(outlier, why)


def _joint_pose(
    name: str, corners: Corners, board: Board, measurements: Measurements
) -> PlanePose | None:
    """Return the pose that images share; None if none of them shows enough corners."""
    if not len(corners):
        return None
    camera = measurements.views[measurements.view[corners.row[0]]].camera
    of_row: dict[int, list[PlanePose]] = {}
    for row in np.unique(corners.row).tolist():
        here = corners.row == row
        points = board.points[corners.corner[here]]
        if _span_plane(points):
            of_row[row] = plane_poses(camera, points, corners.px[here], corners.sigma_px[here])
    if not of_row:
        return None
    candidates = _distinct([pose for poses in of_row.values() for pose in poses], SIMILAR_ANGLE)
    if not candidates:
        raise DatasetError(_another_board(name, board, "no pose of", "showing them there"))
    everything = board.points[corners.corner], corners.px, corners.sigma_px
    refined = [_refine(camera, *everything, start.T_camera_plane) for start in candidates]
    joint = sorted((pose for pose in refined if pose is not None), key=lambda pose: pose.cost)
    joint = _distinct(joint, SIMILAR_ANGLE)
    if not joint:
        raise DatasetError(
            _another_board(name, board, "no one pose of", "one that all its images show")
        )
    best = joint[0]
    scale = _scale(best, corners)
    lead = MIN_CHI2_LEAD * scale**2

    def is_ambiguous(poses: list[PlanePose]) -> bool:
        return len(poses) > 1 and 2.0 * (poses[1].cost - poses[0].cost) < lead

    single = {  # of two poses that both explain an image that near the view's
        row: min(poses, key=lambda pose: _angle(pose, best)) if is_ambiguous(poses) else poses[0]
        for row, poses in of_row.items()
        if poses
    }
    _require_still(name, single, scale, board, camera, row_names(measurements))
    # Corners that no pose of this board explains.
    off = np.linalg.norm(best.residual_px, axis=1)
    rms = float(np.median(off)) / np.sqrt(2.0 * np.log(2.0))  # as of one coordinate
    limit = max(MAX_RESIDUAL_PX, MAX_RESIDUAL_SIGMA * float(np.median(corners.sigma_px)))
    if rms > limit:
        found = f"{rms:.2g} px from the best pose of"
        raise DatasetError(_another_board(name, board, found, f"{limit:.2g} px"))
    if is_ambiguous(joint):
        raise NotVisible(
            f"view {name}: its camera could not be placed: found two poses that explain the "
            f"{len(corners)} corners of the board alike, "
            f"{np.rad2deg(_angle(joint[0], joint[1])):.0f} degrees apart, needed a board that is "
            "larger in the image and seen at a slant; move the camera nearer."
        )
    return best


def _outliers(pose: PlanePose, corners: Corners) -> BoolArray:
    """Return the mask of corners that are outliers of a pose."""
    off = np.linalg.norm(pose.residual_px, axis=1)
    scaled = OUTLIER_SIGMA * _scale(pose, corners) * corners.sigma_px
    return np.asarray(off > np.maximum(OUTLIER_PX, scaled))


def _scale(pose: PlanePose, corners: Corners) -> float:
    """Return by how much residuals exceed the standard deviations of corners, at least one."""
    t = np.linalg.norm(pose.residual_px, axis=1) / corners.sigma_px
    return max(1.0, float(np.median(t)) / float(np.sqrt(2.0 * np.log(2.0))))


def _span_plane(points: Array) -> bool:
    """Return whether points are enough, and not all on a line."""
    if len(points) < MIN_CORNERS:
        return False
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(size[1] > 1e-3 * size[0])


def _require_still(
    name: str,
    single: Mapping[int, PlanePose],
    scale: float,
    board: Board,
    camera: Camera,
    names: tuple[str, ...],
) -> None:
    """Refuse images of a view in which the board stands elsewhere than in most of them.

    ``single`` are the poses of single images, by row; residuals are ``scale`` times the standard
    deviations of corners; ``names`` are those of the rows.
    """
    rows = list(single)
    if len(rows) < 2:
        return
    limit = float(chdtri(6, SIGNIFICANCE / len(rows))) * scale**2
    px = {
        row: camera.project(pose.T_camera_plane.apply(board.points)) for row, pose in single.items()
    }
    together = np.array(
        [[_agree(single[a], single[b], px[a] - px[b], limit) for b in rows] for a in rows]
    )
    most = int(np.argmax(together.sum(axis=1)))
    others = [row for row, same in zip(rows, together[most], strict=True) if not same]
    if not others:
        return
    reference = single[rows[most]].T_camera_plane
    moves = [reference.inv() * single[row].T_camera_plane for row in others]
    middle = board.points.mean(axis=0)
    far = max(float(np.linalg.norm(T.apply(middle) - middle)) for T in moves)
    turn = max(float(T.rotation.magnitude()) for T in moves)
    raise DatasetError(
        f"view {name}: its camera could not be placed: found the board elsewhere in "
        f"{few([names[row] for row in others])} than in {names[rows[most]]}, by up to "
        f"{1e3 * far:.2g} mm and {np.rad2deg(turn):.2g} degrees, needed a camera and a board that "
        "stand still in all images of a view; leave those images out, or give them a view of "
        "their own."
    )


def _agree(one: PlanePose, other: PlanePose, shift_px: Array, limit: float) -> bool:
    """Return whether two poses of the board agree, by their covariances."""
    if float(np.sqrt(np.mean(np.sum(shift_px**2, axis=1)))) < MIN_SHIFT_PX:
        return True
    a, b = one.T_camera_plane, other.T_camera_plane
    turn = (b.rotation * a.rotation.inv()).as_rotvec()
    d = np.concatenate([turn, b.translation - a.translation])
    covariance = np.linalg.inv(one.information) + np.linalg.inv(other.information)
    return bool(d @ np.linalg.solve(covariance, d) < limit)


def _another_board(name: str, board: Board, found: str, needed: str) -> Problem:
    """Return the rejection of corners that do not fit this board with the camera file."""
    sizes = {
        "chessboard": "the numbers of squares",
        "charuco": "the numbers of squares, marker and square",
        "aprilgrid": "the numbers of tags and tag_spacing",
    }[board.kind]
    return Problem(
        f"view {name}: its camera could not be placed by the corners of the board",
        f"{found} the {board.kind} of the dataset file",
        needed,
        f"check {sizes} there, and that the camera file is of this camera and lens",
        name=name,
    )
