"""The calibration board of a dataset: how it ties cameras to each other before any fit.

The board is fixed to the base. Each camera that shows it is placed against it, so that one rough
camera pose, or a rough pose of the board, places all of them, and the four steps may take all views
that show it for one camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit import BoardCorners, Solution
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data import (
    CORNERS_NAME,
    MIN_CORNERS,
    Corners,
    Dataset,
    LegAxes,
    Measurements,
)
from legcal.errors import DatasetError, NotVisible
from legcal.geometry import IntArray, pose_distance
from legcal.perception import FAR_OFF, camera_poses_by_board, detect_corners, require_board
from legcal.vision import Board

Poses = Sequence[RigidTransform | None]  # one a view
_MAX_DISTANCE, _MAX_ANGLE = FAR_OFF


@dataclass(frozen=True, eq=False)
class BoardViews:
    """The board and how each camera stands to it."""

    board: Board
    corners: Corners  # of all images
    T_board_camera: tuple[RigidTransform | None, ...]  # None where a view does not show it
    view_of_row: tuple[str, ...]

    def at(self, rows: IntArray) -> BoardCorners:
        """Return the board in some of the images."""
        return BoardCorners(self.board, self.corners.at(rows))

    def reject_outliers(self, solution: Solution) -> Corners:
        """Return the corners of all images, those that a fit left out rejected."""
        left_out = set(solution.rejected_corners)
        if not left_out:
            return self.corners
        corners = self.corners
        wrong = np.array(
            [
                used and (self.view_of_row[row], corner) in left_out
                for used, row, corner in zip(
                    corners.used.tolist(),
                    corners.row.tolist(),
                    corners.corner.tolist(),
                    strict=True,
                )
            ],
            dtype=np.bool_,
        )
        return corners.reject(wrong, "disagrees with the fit")

    def poses_by_view(self, T_x_camera: Poses) -> dict[int, RigidTransform]:
        """Return T_x_board by each camera that shows the board, x any frame."""
        return {
            v: camera * T.inv()
            for v, (camera, T) in enumerate(zip(T_x_camera, self.T_board_camera, strict=True))
            if camera is not None and T is not None
        }

    def pose_by_cameras(self, T_x_camera: Poses) -> RigidTransform | None:
        """Return T_x_board on which most cameras agree; None if none shows the board.

        Outliers are left out: one wrong camera pose must not turn all others.
        """
        found = list(self.poses_by_view(T_x_camera).values())
        if not found:
            return None
        agreeing = [[other for other in found if _agree(one, other, reach=2.0)] for one in found]
        together = RigidTransform.concatenate(max(agreeing, key=len))
        middle = np.median(together.translation, axis=0)
        return RigidTransform.from_components(middle, together.rotation.mean())

    def cameras(
        self, T_x_board: RigidTransform, others: Poses
    ) -> tuple[RigidTransform | None, ...]:
        """Return T_x_camera of every view: by the board, and *others* where it is not shown."""
        return tuple(
            other if T is None else T_x_board * T
            for T, other in zip(self.T_board_camera, others, strict=True)
        )


def observe_board(data: OrderedDataset) -> BoardViews | None:
    """Return what the images of a dataset show of its board, None if it has none.

    Raises
    ------
    NotVisible
        If no image shows the board, or that of a hand-held view does not.
    DatasetError
        If what is shown cannot be the board that the dataset describes, or it has moved.
    """
    dataset, measurements = data.dataset, data.measurements
    if dataset.board is None:
        return None
    used = [measurements.views[v] for v in np.unique(measurements.view).tolist()]
    needed = {view.name for view in used if view.hand_held}
    if dataset.corners is not None:
        corners = data.order.reorder(dataset.corners)
    else:
        rows = [row for row, image in enumerate(measurements.image) if image]
        load = data.photographs.load
        corners = detect_corners(dataset.board, load, rows, data.pool, data.progress)
        shown = needed if len(corners) else {view.name for view in used}
        require_board(dataset.board, corners, load, measurements, shown)
    T_board_camera, corners = camera_poses_by_board(corners, dataset.board, measurements, needed)
    if all(T is None for T in T_board_camera):
        raise NotVisible(
            f"{dataset.yaml_path}: the calibration board could not be used: found no image with "
            f"{MIN_CORNERS} of its corners or more, needed one; add corners to "
            f"{CORNERS_NAME}, or remove that table or the block board."
        )
    names = tuple(measurements.views[v].name for v in measurements.view.tolist())
    return BoardViews(dataset.board, corners, T_board_camera, names)


def base_of_board(dataset: Dataset, board: BoardViews, hints: Poses) -> RigidTransform | None:
    """Return a rough T_base_board: as the dataset has it, or by the rough T_base_camera of views.

    Raises
    ------
    DatasetError
        If the dataset has the board where none of these cameras sees it.
    """
    given, by_cameras = dataset.T_base_board, board.pose_by_cameras(hints)
    if given is None or by_cameras is None:
        return by_cameras if given is None else given
    # Wrong poses beside a right one are named when the images have placed their cameras.
    if not any(_agree(given, place) for place in board.poses_by_view(hints).values()):
        far, turned = pose_distance(given, by_cameras)
        raise DatasetError(
            f"{dataset.yaml_path}: board.T_base_board and the T_base_camera of the views "
            f"could not be used together: found the board {1e3 * far:.0f} mm and "
            f"{np.degrees(turned):.1f} deg from where these cameras see it, needed "
            f"{1e3 * _MAX_DISTANCE:.0f} mm and {np.degrees(_MAX_ANGLE):.0f} deg; correct the pose "
            "of the board, those of the cameras, or the dimensions of the board."
        )
    return given


def board_notes(dataset: Dataset, solution: Solution, corners: Corners | None) -> list[str]:
    """Return notes on views that do not show the board, and on a wrong T_base_board."""
    if corners is None:
        return []
    measurements, notes = dataset.measurements, []
    shown = set(measurements.view[corners.row[corners.used]].tolist())
    without = [
        measurements.views[v].name for v in np.unique(measurements.view).tolist() if v not in shown
    ]
    if without:
        notes.append(
            f"No image of {', '.join(without)} shows the calibration board, or too little of it: "
            "these cameras are placed by the legs alone."
        )
    given, found = dataset.T_base_board, solution.T_Rb_board
    if given is not None and found is not None:
        place = dataset.machine.T_base_Rb * found
        if not _agree(given, place):
            far, turned = pose_distance(given, place)
            notes.append(
                f"The calibration board stands {1e3 * far:.0f} mm and {np.degrees(turned):.1f} deg "
                "from where T_base_board of the dataset has it, far more than base joints can be "
                "off; the result does not depend on it; correct T_base_board."
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


def _agree(one: RigidTransform, other: RigidTransform, reach: float = 1.0) -> bool:
    """Say whether two places of the board are as near as hints are good."""
    far, turned = pose_distance(one, other)
    return far <= reach * _MAX_DISTANCE and turned <= reach * _MAX_ANGLE
