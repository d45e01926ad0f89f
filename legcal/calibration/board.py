"""The calibration boards of a dataset: how they tie cameras to each other before any fit.

A board on the base stands still: each camera that shows it is placed against it, so that one rough
camera pose, or a rough pose of the board, places all of them, and the four steps may take all views
that show it for one camera. A board on the platform goes where nominal kinematics say, from and to
places that are not known: as a hand-eye calibration, that places cameras without any rough pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.location.frames import PosePairs, transforms
from legcal.calibration.location.search import search
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data.axes import LegAxes
from legcal.data.corners import Corners, join_corners
from legcal.data.dataset import CORNERS_NAME, MIN_CORNERS, Dataset
from legcal.data.measurements import Measurements
from legcal.data.reasons import Reason
from legcal.errors import DatasetError, NotVisible
from legcal.geometry.motions import components, pose_distance
from legcal.geometry.types import IntArray
from legcal.perception.board_corners import detect_corners, require_board
from legcal.perception.board_poses import board_poses_in_images, camera_poses_by_board
from legcal.perception.free_poses import require_rough_cameras, require_standing_joints
from legcal.perception.photographs import nominal_placement
from legcal.perception.placement import Placement
from legcal.vision.board import FixedBoard

Poses = Sequence[RigidTransform | None]  # one a view
# Between two places of a board by rough poses: part of the mean leg length, angle
_MAX_DISTANCE, _MAX_ANGLE = 0.15, np.deg2rad(6.0)
_FEWEST = 4  # images of a board on the platform that place a camera


@dataclass(frozen=True, eq=False)
class BoardViews:
    """The boards and how each camera stands to them."""

    boards: tuple[FixedBoard, ...]
    corners: Corners  # of all images
    # To the board on the base, None where a view does not show it
    T_board_camera: tuple[RigidTransform | None, ...]
    T_camera_board: Mapping[int, RigidTransform]  # of the board on the platform, by image row
    view_of_row: tuple[str, ...]
    size: float  # mean leg length of the machine [m]

    def at(self, rows: IntArray) -> BoardCorners:
        """Return the boards in some of the images."""
        return BoardCorners(self.boards, self.corners.at(rows))

    def reject_outliers(self, solution: Solution, fitted: OrderedDataset) -> Corners:
        """Return the corners of all images, those that a fit of some images left out rejected."""
        left_out = set(solution.rejected_corners)
        if not left_out:
            return self.corners
        corners = self.corners
        poses = fitted.measurements.pose.tolist()
        pose_of_row = dict(zip(fitted.rows.tolist(), poses, strict=True))
        places = zip(corners.row.tolist(), corners.corner.tolist(), strict=True)
        wrong = np.array(
            [
                any((self.view_of_row[row], p, corner) in left_out
                    for p in (-1, pose_of_row.get(row, -1)))
                for row, corner in places
            ],
            dtype=np.bool_,
        )  # fmt: skip
        return corners.reject(wrong & corners.used, Reason.DISAGREES)

    def poses_by_view(self, T_x_camera: Poses) -> dict[int, RigidTransform]:
        """Return T_x_board of the base's by each camera that shows it, x any frame."""
        return {
            v: camera * T.inv()
            for v, (camera, T) in enumerate(zip(T_x_camera, self.T_board_camera, strict=True))
            if camera is not None and T is not None
        }

    def pose_by_cameras(self, T_x_camera: Poses) -> RigidTransform | None:
        """Return T_x_board of the base's on which most cameras agree; None if none shows it.

        Outliers are left out: one wrong camera pose must not turn all others.
        """
        return _agreed(list(self.poses_by_view(T_x_camera).values()), self.size)

    def pose_on_platform(
        self, data: OrderedDataset, T_x_camera: Poses, T_x_platform: Sequence[RigidTransform]
    ) -> RigidTransform | None:
        """Return T_platform_board of the platform's on which most of some images agree.

        *T_x_platform* is that of every pose, x any frame; None if no image shows the board.
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
        """Return T_x_camera of every view: by the base's board, *others* where it is not shown."""
        return tuple(
            other if T is None else T_x_board * T
            for T, other in zip(self.T_board_camera, others, strict=True)
        )

    def cameras_by_platform(self, data: OrderedDataset, known: Poses) -> Poses:
        """Return T_base_camera of every view, known ones as they are, others by the platform's.

        The board on the platform goes where the nominal kinematics carry it. Where it is fixed to
        the platform is found with the cameras; views that show the base's board too stand together.
        """
        view, pose = data.measurements.view, data.measurements.pose
        frames: dict[int, list[int]] = {}  # the rows of views that stand together, by one of these
        tied = [v for v, T in enumerate(self.T_board_camera) if T is not None]
        for row in sorted(self.T_camera_board):
            v = int(view[row])
            frames.setdefault(tied[0] if v in tied else v, []).append(row)
        T_base_platform = data.T_base_platform
        given = next((b.T_link_board for b in self.boards if b.link == "platform"), None)
        T_platform_board = given
        if T_platform_board is None:
            T_platform_board = self.pose_on_platform(data, known, T_base_platform)
        if T_platform_board is None and frames:
            most = max(frames.values(), key=len)
            if len(np.unique(pose[most])) >= _FEWEST:
                T_platform_board = _hand_eye(
                    [T_base_platform[pose[row]] for row in most],
                    [self._in_frame(row, view) for row in most],
                )
        if T_platform_board is None:
            return known
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
        found = list(known)
        for v, T in enumerate(known):
            frame = T_base_frame.get(tied[0] if v in tied else v)
            if T is None and frame is not None:
                own = self.T_board_camera[v]
                found[v] = frame if own is None else frame * own
        return tuple(found)

    def _in_frame(self, row: int, view: IntArray) -> RigidTransform:
        """Return the pose of the platform's board in the base's board, or else in the camera."""
        T_board_camera = self.T_board_camera[view[row]]
        seen = self.T_camera_board[row]
        return seen if T_board_camera is None else T_board_camera * seen


def _hand_eye(
    T_base_platform: Sequence[RigidTransform], T_frame_board: Sequence[RigidTransform]
) -> RigidTransform:
    """Return T_platform_board by which T_frame_base T_base_platform T_platform_board is as seen."""
    R, t = components(T_base_platform)
    M, p = components(T_frame_board)
    length = float(np.linalg.norm(np.ptp(t, axis=0))) + float(np.linalg.norm(p, axis=1).mean())
    pairs = PosePairs(R, t, M, p, np.ones(len(R), dtype=np.bool_), length)
    return transforms(search(pairs, _FEWEST).frames[0])[1]


def _agreed(found: Sequence[RigidTransform], size: float) -> RigidTransform | None:
    """Return the middle of those poses that most agree on; None of none."""
    if not found:
        return None
    agreeing = [[other for other in found if _agree(one, other, size, reach=2.0)] for one in found]
    together = RigidTransform.concatenate(max(agreeing, key=len))
    middle = np.median(together.translation, axis=0)
    return RigidTransform.from_components(middle, together.rotation.mean())


def observe_board(data: OrderedDataset) -> BoardViews | None:
    """Return what the images of a dataset show of its boards, None if it has none.

    Raises
    ------
    NotVisible
        If no image shows a board, or most of the hand-held views do not show the base's; the legs
        place the others, or they are left out.
    DatasetError
        If what is shown cannot be the board that the dataset describes, or it has moved.
    """
    dataset, measurements = data.dataset, data.measurements
    if not dataset.boards:
        return None
    used = [measurements.views[v] for v in np.unique(measurements.view).tolist()]
    hand_held = {view.name for view in used if view.hand_held}
    given = None if dataset.corners is None else data.order.reorder(dataset.corners)
    T_board_camera: tuple[RigidTransform | None, ...] = (None,) * len(measurements.views)
    T_camera_board: dict[int, RigidTransform] = {}
    tables = []
    for fixed in dataset.boards:
        on_base = fixed.link == "base"
        if given is not None:
            own = given.choose(fixed.has(given.corner))
            own = replace(own, corner=own.corner - fixed.first)
        else:
            rows = [row for row, image in enumerate(measurements.image) if image]
            own = detect_corners(fixed.board, data.photographs.load, rows, data.pool, data.progress)
        shown_in = {measurements.views[v].name for v in measurements.view[own.row].tolist()}
        few = on_base and 2 * len(hand_held & shown_in) < len(hand_held)
        needed = hand_held if few else set[str]()
        if given is None:
            asked = needed if len(own) else {view.name for view in used}
            require_board(fixed.board, own, data.photographs.load, measurements, asked)
        if on_base:
            T_board_camera, own = camera_poses_by_board(own, fixed.board, measurements, needed)
            found = any(T is not None for T in T_board_camera)
        else:
            T_camera_board, own = board_poses_in_images(own, fixed.board, measurements)
            found = bool(T_camera_board)
        if not found:
            which = "" if on_base else " on the platform"
            raise NotVisible(
                f"{dataset.yaml_path}: the calibration board{which} could not be used: found no "
                f"image with {MIN_CORNERS} of its corners or more, needed one; add corners to "
                f"{CORNERS_NAME}, or remove that table or the block board."
            )
        tables.append(replace(own, corner=own.corner + fixed.first))
    corners = join_corners(tables).sort()
    names = tuple(measurements.views[v].name for v in measurements.view.tolist())
    size = dataset.machine.size
    return BoardViews(dataset.boards, corners, T_board_camera, T_camera_board, names, size)


def base_of_board(dataset: Dataset, board: BoardViews, hints: Poses) -> RigidTransform | None:
    """Return a rough T_base_board: as the dataset has it, or by the rough T_base_camera of views.

    Raises
    ------
    DatasetError
        If the dataset has the board where none of these cameras sees it.
    """
    fixed, by_cameras = dataset.board_on("base"), board.pose_by_cameras(hints)
    given = None if fixed is None else fixed.T_link_board
    if given is None or by_cameras is None:
        return by_cameras if given is None else given
    # Wrong poses beside a right one are named when the images have placed their cameras.
    places = board.poses_by_view(hints).values()
    if not any(_agree(given, place, board.size) for place in places):
        far, turned = pose_distance(given, by_cameras)
        raise DatasetError(
            f"{dataset.yaml_path}: board.T_base_board and the T_base_camera of the views "
            f"could not be used together: found the board {1e3 * far:.0f} mm and "
            f"{np.degrees(turned):.1f} deg from where these cameras see it, needed "
            f"{1e3 * _MAX_DISTANCE * board.size:.0f} mm and {np.degrees(_MAX_ANGLE):.0f} deg; "
            "correct the pose of the board, those of the cameras, or the dimensions of the board."
        )
    return given


def board_notes(dataset: Dataset, solution: Solution, corners: Corners | None) -> list[str]:
    """Return notes on views that do not show the base's board, and on wrong poses of boards."""
    if corners is None:
        return []
    measurements, notes = dataset.measurements, []
    fixed = dataset.board_on("base")
    if fixed is None:
        return _misplaced(dataset, solution)
    own = corners.used & fixed.has(corners.corner)
    shown = set(measurements.view[corners.row[own]].tolist())
    without = [
        measurements.views[v].name for v in np.unique(measurements.view).tolist() if v not in shown
    ]
    if without:
        others = "the legs and the board on the platform" if len(dataset.boards) > 1 else "the legs"
        notes.append(
            f"No image of {', '.join(without)} shows the calibration board so that it places "
            f"the camera: only {others} can."
        )
    return [*notes, *_misplaced(dataset, solution)]


def _misplaced(dataset: Dataset, solution: Solution) -> list[str]:
    """Return notes on boards that are far from where the dataset has them."""
    notes = []
    for fixed in dataset.boards:
        given, found = fixed.T_link_board, solution.T_frame_board.get(fixed.link)
        if given is None or found is None:
            continue
        place = dataset.machine.T_link_frame(fixed.link) * found
        if not _agree(given, place, dataset.machine.size):
            far, turned = pose_distance(given, place)
            key, which = f"T_{fixed.link}_board", "" if fixed.link == "base" else " on the platform"
            notes.append(
                f"The calibration board{which} stands {1e3 * far:.0f} mm and "
                f"{np.degrees(turned):.1f} deg from where {key} of the dataset has it, far more "
                f"than joints can be off; the result does not depend on it; correct {key}."
            )
    return notes


def in_one_camera(
    axes: LegAxes, measurements: Measurements, T_board_camera: Poses
) -> tuple[LegAxes, Measurements, tuple[RigidTransform | None, ...], IntArray]:
    """Return axes of all views that show the board as those of one view, the first of these.

    Returns the axes and measurements, T_first_camera of each original view (None where it does not
    show the board), and which of the new views each original one is.
    """
    shown = np.array([T is not None for T in T_board_camera], dtype=np.bool_)
    first, others = int(np.argmax(shown)), np.flatnonzero(~shown).tolist()
    from_board = next(T.inv() for T in T_board_camera if T is not None)
    T_first_camera = tuple(None if T is None else from_board * T for T in T_board_camera)
    new_view = np.zeros(len(shown), dtype=np.intp)
    new_view[others] = 1 + np.arange(len(others))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    view = measurements.view[axes.row]
    for v, T in enumerate(T_first_camera):
        here = view == v
        if T is not None and here.any():
            u[here], M[here] = T.rotation.apply(u[here]), T.apply(M[here])
            basis[here] = T.rotation.apply(basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
    views = [replace(measurements.views[first], legs=None)]
    views += [measurements.views[v] for v in others]
    return (
        replace(axes, u=u, M=M, basis=basis),
        replace(measurements, views=tuple(views), view=new_view[measurements.view]),
        T_first_camera,
        new_view,
    )


def _agree(one: RigidTransform, other: RigidTransform, size: float, reach: float = 1.0) -> bool:
    """Say whether two places of the board are as near as hints are good."""
    far, turned = pose_distance(one, other)
    return far <= reach * _MAX_DISTANCE * size and turned <= reach * _MAX_ANGLE


def needs_rough_cameras(data: OrderedDataset) -> bool:
    """Say whether images can be searched only near rough camera poses."""
    hints = [view.T_base_camera for view in data.measurements.views]
    on_base = data.dataset.board_on("base")
    by_board = on_base is not None and (
        on_base.T_link_board is not None or any(T is not None for T in hints)
    )
    return not data.machine.is_determined and not by_board


def rough_placement(data: OrderedDataset) -> tuple[Placement, BoardViews | None]:
    """Return where the nominal model has the legs, with rough cameras, and what shows the board.

    Raises
    ------
    NotIdentifiable
        If readings do not give the poses of images that are to be searched, and a view of these has
        no rough camera pose or joints at A move; nothing is searched then.
    NotVisible
        If they are to be searched for legs none of which is visible.
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
    board = observe_board(data)
    if board is not None:
        T_base_board = base_of_board(data.dataset, board, placement.T_base_camera)
        if T_base_board is not None:
            cameras = board.cameras(T_base_board, placement.T_base_camera)
            placement = replace(placement, T_base_camera=cameras)
        if data.machine.is_determined:
            cameras = tuple(board.cameras_by_platform(data, placement.T_base_camera))
            placement = replace(placement, T_base_camera=cameras)
    return placement, board
