"""The calibration boards of a dataset: relative camera poses before any fit.

A board on the base is fixed: each camera that sees it is placed relative to it, so that one rough
camera pose, or a rough pose of the board, places all of them, and the four steps may treat all
views of it as one camera. A board on the platform moves by the nominal kinematics: hand-eye
calibration places cameras without any rough pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data.corners import Corners, join_corners
from legcal.data.dataset import CORNERS_NAME, MIN_CORNERS, Dataset
from legcal.data.measurements import Measurements, few_views
from legcal.data.outlines import LegAxes
from legcal.data.reasons import Reason
from legcal.errors import Cause, DatasetError, LegcalError, NotVisible, by_cause
from legcal.geometry.motions import components, pose_distance
from legcal.geometry.types import IntArray
from legcal.perception.free_poses import require_rough_cameras, require_standing_joints
from legcal.perception.photographs import nominal_placement
from legcal.perception.placement import Placement
from legcal.vision.board import FixedBoard

Poses = Sequence[RigidTransform | None]  # by view
# Largest distance of two rough poses of a board that agree [mean leg lengths, rad]
_MAX_DISTANCE, _MAX_ANGLE = 0.15, np.deg2rad(6.0)
_FEWEST = 4  # smallest number of images of a board on the platform that place a camera


@dataclass(frozen=True, eq=False)
class BoardViews:
    """The boards, their corners and the poses of cameras relative to them."""

    boards: tuple[FixedBoard, ...]
    corners: Corners  # corners in all images
    # by view: pose relative to the board on the base; None if the view does not show it
    T_board_camera: tuple[RigidTransform | None, ...]
    T_camera_board: Mapping[int, RigidTransform]  # board on the platform, by image row
    view_of_row: tuple[str, ...]
    size: float  # mean leg length of the machine [m]

    def at(self, rows: IntArray) -> BoardCorners:
        """Return the boards with their corners in selected images."""
        return BoardCorners(self.boards, self.corners.at(rows))

    def reject_outliers(self, solution: Solution, fitted: OrderedDataset) -> Corners:
        """Return the corners of all images, with the outliers of a fit rejected."""
        left_out = set(solution.rejected_corners)
        if not left_out:
            return self.corners
        corners = self.corners
        poses = fitted.measurements.pose.tolist()
        pose_of_row = dict(zip(fitted.rows.tolist(), poses, strict=True))
        places = zip(corners.row.tolist(), corners.corner.tolist(), strict=True)
        is_wrong = np.array(
            [
                any((self.view_of_row[row], p, corner) in left_out
                    for p in (-1, pose_of_row.get(row, -1)))
                for row, corner in places
            ],
            dtype=np.bool_,
        )  # fmt: skip
        return corners.reject(is_wrong & corners.used, Reason.DISAGREES)

    def poses_by_view(self, T_x_camera: Poses) -> dict[int, RigidTransform]:
        """Return T_x_board of the board on the base by view, for any frame x."""
        return {
            v: camera * T.inv()
            for v, (camera, T) in enumerate(zip(T_x_camera, self.T_board_camera, strict=True))
            if camera is not None and T is not None
        }

    def pose_by_cameras(self, T_x_camera: Poses) -> RigidTransform | None:
        """Return T_x_board of the board on the base by majority of the cameras; None without any.

        Outliers are left out, so that one wrong camera pose does not affect the others.
        """
        return _agreed(list(self.poses_by_view(T_x_camera).values()), self.size)

    def pose_on_platform(
        self, data: OrderedDataset, T_x_camera: Poses, T_x_platform: Sequence[RigidTransform]
    ) -> RigidTransform | None:
        """Return T_platform_board of the board on the platform by majority of the images.

        *T_x_platform* is by pose, for any frame x. None if no image shows the board.
        """
        place = zip(data.rows.tolist(), data.measurements.view.tolist(),
                    data.measurements.pose.tolist(), strict=True)  # fmt: skip
        return _agreed(
            [
                T_x_platform[pose].inv() * camera * self.T_camera_board[row]
                for row, view, pose in place
                if row in self.T_camera_board and (camera := T_x_camera[view]) is not None
            ],
            self.size,
        )

    def cameras(
        self, T_x_board: RigidTransform, others: Poses
    ) -> tuple[RigidTransform | None, ...]:
        """Return T_x_camera of every view: by the board on the base, else from *others*."""
        return tuple(
            other if T is None else T_x_board * T
            for T, other in zip(self.T_board_camera, others, strict=True)
        )

    def cameras_by_platform(self, data: OrderedDataset, T_base_camera: Poses) -> Poses:
        """Return T_base_camera of every view, with missing ones from the board on the platform.

        The board moves by the nominal kinematics. Its pose on the platform is estimated with the
        cameras; views that also show the board on the base are treated as one camera.
        """
        view, pose = data.measurements.view, data.measurements.pose
        frames: dict[int, list[int]] = {}  # rows of views with known relative poses, by first view
        tied = [v for v, T in enumerate(self.T_board_camera) if T is not None]
        for row in sorted(self.T_camera_board):
            v = int(view[row])
            frames.setdefault(tied[0] if v in tied else v, []).append(row)
        T_base_platform = data.T_base_platform
        stated = next((b.T_link_board for b in self.boards if b.link == "platform"), None)
        T_platform_board = stated
        if T_platform_board is None:
            T_platform_board = self.pose_on_platform(data, T_base_camera, T_base_platform)
        if T_platform_board is None and frames:
            largest = max(frames.values(), key=len)
            if len(np.unique(pose[largest])) >= _FEWEST:
                T_platform_board = _hand_eye(
                    [T_base_platform[pose[row]] for row in largest],
                    [self._in_frame(row, view) for row in largest],
                )
        if T_platform_board is None:
            return T_base_camera
        T_base_frame = {
            v: _agreed(
                [
                    T_base_platform[pose[row]] * T_platform_board * self._in_frame(row, view).inv()
                    for row in rows
                ],
                self.size,
            )
            for v, rows in frames.items()
        }
        cameras = list(T_base_camera)
        for v, T in enumerate(T_base_camera):
            frame = T_base_frame.get(tied[0] if v in tied else v)
            if T is None and frame is not None:
                T_board_camera = self.T_board_camera[v]
                cameras[v] = frame if T_board_camera is None else frame * T_board_camera
        return tuple(cameras)

    def _in_frame(self, row: int, view: IntArray) -> RigidTransform:
        """Return the pose of the platform's board in the base's board, or else in the camera."""
        T_board_camera = self.T_board_camera[view[row]]
        T_camera_board = self.T_camera_board[row]
        return T_camera_board if T_board_camera is None else T_board_camera * T_camera_board


def _hand_eye(
    T_base_platform: Sequence[RigidTransform], T_frame_board: Sequence[RigidTransform]
) -> RigidTransform:
    """Return T_platform_board from poses of platform and board, by hand-eye calibration."""
    from legcal.calibration.location.frames import PosePairs, search, transforms

    R, t = components(T_base_platform)
    M, p = components(T_frame_board)
    length = float(np.linalg.norm(np.ptp(t, axis=0))) + float(np.linalg.norm(p, axis=1).mean())
    pairs = PosePairs(R, t, M, p, np.ones(len(R), dtype=np.bool_), length)
    return transforms(search(pairs, _FEWEST).frames[0])[1]


def _agreed(poses: Sequence[RigidTransform], size: float) -> RigidTransform | None:
    """Return the mean of the largest set of agreeing poses; None without poses."""
    if not poses:
        return None
    agreeing = [
        [other for other in poses if _agree(pose, other, size, reach=2.0)] for pose in poses
    ]
    together = RigidTransform.concatenate(max(agreeing, key=len))
    middle = np.median(together.translation, axis=0)
    return RigidTransform.from_components(middle, together.rotation.mean())


def observe_board(data: OrderedDataset) -> BoardViews | None:
    """Return the boards of a dataset as seen in its images; None without boards.

    Raises NotVisible if no image shows a board, or most of the hand-held views do not show the
    board on the base (other views are placed by the legs or left out); DatasetError if the images
    contradict the description of the board, or it has moved.
    """
    dataset, measurements = data.dataset, data.measurements
    if not dataset.boards:
        return None
    # most datasets have no board
    from legcal.perception.board_adjustment import board_poses_in_images, camera_poses_by_board
    from legcal.perception.board_corners import detect_corners, require_board

    used = [measurements.views[v] for v in np.unique(measurements.view).tolist()]
    view_of_row = np.array(measurements.view_names)[measurements.view]
    hand_held = {view.name for view in used if view.hand_held}
    corners_in_table = None if dataset.corners is None else data.order.reorder(dataset.corners)
    T_board_camera: tuple[RigidTransform | None, ...] = (None,) * len(measurements.views)
    T_camera_board: dict[int, RigidTransform] = {}
    tables = []
    for fixed in dataset.boards:
        on_base = fixed.link == "base"
        if corners_in_table is not None:
            corners_of_board = corners_in_table.choose(fixed.has(corners_in_table.corner))
            corners_of_board = replace(
                corners_of_board, corner=corners_of_board.corner - fixed.first
            )
        else:
            rows = [row for row, image in enumerate(measurements.image) if image]
            corners_of_board = detect_corners(
                fixed.board, data.photographs.load, rows, data.pool, data.progress
            )
        shown_in = set(view_of_row[corners_of_board.row].tolist())
        is_rarely_shown = on_base and 2 * len(hand_held & shown_in) < len(hand_held)
        needed = hand_held if is_rarely_shown else set[str]()
        if corners_in_table is None:
            required = needed if len(corners_of_board) else {view.name for view in used}
            require_board(
                fixed.board, corners_of_board, data.photographs.load, measurements, required
            )
        if on_base:
            T_board_camera, corners_of_board = camera_poses_by_board(
                corners_of_board, fixed.board, measurements, needed
            )
            is_shown = any(T is not None for T in T_board_camera)
        else:
            T_camera_board, corners_of_board = board_poses_in_images(
                corners_of_board, fixed.board, measurements
            )
            is_shown = bool(T_camera_board)
        if not is_shown:
            where_fixed = "" if on_base else " on the platform"
            raise NotVisible(
                f"{dataset.yaml_path}: the calibration board{where_fixed} could not be used: found "
                f"no image with {MIN_CORNERS} of its corners or more, needed one; add corners to "
                f"{CORNERS_NAME}, or remove that table or the block board."
            )
        tables.append(replace(corners_of_board, corner=corners_of_board.corner + fixed.first))
    corners = join_corners(tables).sort()
    names, size = tuple(view_of_row.tolist()), dataset.machine.size
    return BoardViews(dataset.boards, corners, T_board_camera, T_camera_board, names, size)


def usable_board(data: OrderedDataset) -> BoardViews | None:
    """Return the boards as seen in images; None also where they cannot be used, told by others."""
    try:
        return observe_board(data)
    except LegcalError:
        return None


def base_of_board(dataset: Dataset, board: BoardViews, hints: Poses) -> RigidTransform | None:
    """Return a rough T_base_board: as stated, or from the rough T_base_camera of views.

    Raises DatasetError if none of these cameras agrees with the stated pose of the board.
    """
    fixed, by_cameras = dataset.board_on("base"), board.pose_by_cameras(hints)
    stated = None if fixed is None else fixed.T_link_board
    if stated is None or by_cameras is None:
        return by_cameras if stated is None else stated
    # Single wrong camera poses are reported later, when the images have placed the cameras.
    places = board.poses_by_view(hints).values()
    if not any(_agree(stated, place, board.size) for place in places):
        distance, turned = pose_distance(stated, by_cameras)
        raise DatasetError(
            f"{dataset.yaml_path}: board.T_base_board and the T_base_camera of the views "
            f"could not be used together: found the board {1e3 * distance:.0f} mm and "
            f"{np.degrees(turned):.1f} deg from where these cameras see it, needed "
            f"{1e3 * _MAX_DISTANCE * board.size:.0f} mm and {np.degrees(_MAX_ANGLE):.0f} deg; "
            "correct the pose of the board, those of the cameras, or the dimensions of the board."
        )
    return stated


def board_notes(dataset: Dataset, solution: Solution, corners: Corners | None) -> list[str]:
    """Return notes on views without the board on the base, and on wrong poses of boards."""
    if corners is None:
        return []
    lost = solution.outlines.row[solution.outlines.rejected_for(Reason.NOT_PLACED)]
    return [*notes_on_views(dataset, corners, lost), *_misplaced(dataset, solution)]


def notes_on_views(dataset: Dataset, corners: Corners, lost: IntArray) -> list[str]:
    """Return notes on views that the board on the base does not place, nor legs the rows *lost*."""
    measurements, notes = dataset.measurements, []
    fixed = dataset.board_on("base")
    if fixed is None:
        return []
    on_base = corners.used & fixed.has(corners.corner)
    shown_views = set(measurements.view[corners.row[on_base]].tolist())
    used = np.unique(measurements.view).tolist()
    why: dict[str, Cause] = {}  # single images of a camera in the hand were left out, by view
    for row, reason in zip(corners.row.tolist(), corners.reason, strict=True):
        view = measurements.views[measurements.view[row]]
        if reason and row in lost and view.hand_held:
            why.setdefault(view.name, reason.cause)
    for cause, views in by_cause(why):
        notes.append(
            f"{few_views(views)}{', each' * (len(views) > 1)}: left out, since neither board nor "
            f"legs place the camera; of the board: {cause}; correct its corners or take it again."
        )
    unseen = [measurements.view_names[v] for v in used if v not in shown_views]
    without = [name for name in unseen if name not in why]
    if without:
        others = "the legs and the board on the platform" if len(dataset.boards) > 1 else "the legs"
        notes.append(
            f"No image of {', '.join(without)} shows the calibration board so that it places "
            f"the camera: only {others} can."
        )
    return notes


def _misplaced(dataset: Dataset, solution: Solution) -> list[str]:
    notes = []
    for fixed in dataset.boards:
        stated, fitted = fixed.T_link_board, solution.T_frame_board.get(fixed.link)
        if stated is None or fitted is None:
            continue
        place = dataset.machine.T_link_frame(fixed.link) * fitted
        if not _agree(stated, place, dataset.machine.size):
            distance, turned = pose_distance(stated, place)
            key, where_fixed = (
                f"T_{fixed.link}_board",
                "" if fixed.link == "base" else " on the platform",
            )
            notes.append(
                f"The calibration board{where_fixed} stands {1e3 * distance:.0f} mm and "
                f"{np.degrees(turned):.1f} deg from where {key} of the dataset has it, far more "
                f"than joints can be off; the result does not depend on it; correct {key}."
            )
    return notes


def in_one_camera(
    axes: LegAxes, measurements: Measurements, T_board_camera: Poses
) -> tuple[LegAxes, Measurements, tuple[RigidTransform | None, ...], IntArray]:
    """Merge all views with the board into the first of them.

    Returns the axes and measurements, T_first_camera of each original view (None if it does not
    show the board), and the new number of each original view.
    """
    is_shown = np.array([T is not None for T in T_board_camera], dtype=np.bool_)
    first, others = int(np.argmax(is_shown)), np.flatnonzero(~is_shown).tolist()
    from_board = next(T.inv() for T in T_board_camera if T is not None)
    T_first_camera = tuple(None if T is None else from_board * T for T in T_board_camera)
    new_view = np.zeros(len(is_shown), dtype=np.intp)
    new_view[others] = 1 + np.arange(len(others))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    view = measurements.view[axes.row]
    for v, T in enumerate(T_first_camera):
        of_view = view == v
        if T is not None and of_view.any():
            u[of_view], M[of_view] = T.rotation.apply(u[of_view]), T.apply(M[of_view])
            basis[of_view] = T.rotation.apply(basis[of_view].reshape(-1, 3)).reshape(-1, 2, 3)
    views = [replace(measurements.views[first], legs=None)]
    views += [measurements.views[v] for v in others]
    return (
        replace(axes, u=u, M=M, basis=basis),
        replace(measurements, views=tuple(views), view=new_view[measurements.view]),
        T_first_camera,
        new_view,
    )


def _agree(pose: RigidTransform, other: RigidTransform, size: float, reach: float = 1.0) -> bool:
    distance, turned = pose_distance(pose, other)
    return distance <= reach * _MAX_DISTANCE * size and turned <= reach * _MAX_ANGLE


def needs_rough_cameras(data: OrderedDataset) -> bool:
    """Return whether the search of images needs rough camera poses."""
    hints = [view.T_base_camera for view in data.measurements.views]
    on_base = data.dataset.board_on("base")
    by_board = on_base is not None and (
        on_base.T_link_board is not None or any(T is not None for T in hints)
    )
    return not data.machine.is_determined and not by_board


def rough_placement(
    data: OrderedDataset, board: BoardViews | None = None
) -> tuple[Placement, BoardViews | None]:
    """Return the placement by the nominal model and rough cameras, and the boards in the images.

    Boards are looked for in the images if they have not been before.

    Raises NotIdentifiable if images are to be searched whose pose the readings do not determine,
    and a view of them has no rough camera pose or joints at A move; NotVisible if images are to be
    searched and no leg is visible.
    """
    if len(data.photographs.detect) and not any(leg.cylinders for leg in data.machine.legs):
        raise NotVisible(
            f"{data.machine.urdf_path}: the images could not be searched: found no <visual> "
            "cylinder along any leg, so that nothing of the legs is visible, needed one along each "
            "that images show; add them with their radii."
        )
    if not data.machine.is_determined and len(data.photographs.detect):
        require_standing_joints(data.machine)
    if needs_rough_cameras(data):
        hints = [view.T_base_camera for view in data.measurements.views]
        require_rough_cameras(data.measurements, data.photographs.detect.tolist(), hints)
    placement = nominal_placement(data.machine, data.measurements, data.T_base_platform)
    board = board or observe_board(data)
    if board is not None:
        T_base_board = base_of_board(data.dataset, board, placement.T_base_camera)
        if T_base_board is not None:
            cameras = board.cameras(T_base_board, placement.T_base_camera)
            placement = replace(placement, T_base_camera=cameras)
        if data.machine.is_determined:
            cameras = tuple(board.cameras_by_platform(data, placement.T_base_camera))
            placement = replace(placement, T_base_camera=cameras)
    return placement, board
