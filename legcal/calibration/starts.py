"""Where the fit of everything begins: the nominal model, and what the four steps find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.verdict import Steps
from legcal.calibration.workpiece import Workpiece
from legcal.data import (
    CORNERS_NAME,
    LEAST_CORNERS,
    Corners,
    Dataset,
    LegAxes,
    Measurements,
    Outlines,
    axes_from_outlines,
    corners_at,
    few_views,
    reorder_corners,
)
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, NotVisible
from legcal.estimation import SeenBoard, Solution, Start, start_from
from legcal.geometry import IntArray
from legcal.machine import geometries
from legcal.paper import nominal_mechanism, run_base_steps, run_platform_steps
from legcal.perception import FAR_OFF, Scene, camera_poses, detect_corners, require_board
from legcal.progress import Report
from legcal.vision import Board

_FAR, _TURNED = FAR_OFF


@dataclass(frozen=True, eq=False)
class BoardViews:
    """The board and how each camera stands to it.

    Attributes
    ----------
    board : Board
    corners : Corners
        Of all images, in the order of work.
    T_board_camera : tuple of RigidTransform or None
        The camera of each view; None where it does not show the board.
    view_of_row : tuple of str
        Name of the view of each image, in the order of work.
    """

    board: Board
    corners: Corners
    T_board_camera: tuple[RigidTransform | None, ...]
    view_of_row: tuple[str, ...]

    def seen(self, rows: IntArray) -> SeenBoard:
        """Return the board in some of the images."""
        return SeenBoard(self.board, corners_at(self.corners, rows))

    def judged(self, solution: Solution) -> Corners:
        """Return the corners of all images, those that a fit left out rejected."""
        left_out = set(solution.rejected_corners)
        if not left_out:
            return self.corners
        names = [self.view_of_row[row] for row in self.corners.row.tolist()]
        wrong = [
            used and (name, corner) in left_out
            for used, name, corner in zip(
                self.corners.used.tolist(), names, self.corners.corner.tolist(), strict=True
            )
        ]
        reason = tuple(
            "disagrees with the fit" if is_wrong else why
            for is_wrong, why in zip(wrong, self.corners.reason, strict=True)
        )
        used = self.corners.used & ~np.array(wrong, dtype=np.bool_)
        return replace(self.corners, used=used, reason=reason)

    def placed(self, cameras: Sequence[RigidTransform | None]) -> RigidTransform | None:
        """Return where most cameras have the board, T_x_board; None if none shows it.

        Those that disagree with most others are left out: one wrong pose must not turn all.

        Parameters
        ----------
        cameras : sequence of RigidTransform or None
            T_x_camera of each view; x is any frame.
        """
        found = list(self.places(cameras).values())
        if not found:
            return None
        agreeing = [
            [other for other in found if _agree(one, other, among_hints=True)] for one in found
        ]
        together = RigidTransform.concatenate(max(agreeing, key=len))
        middle = np.median(together.translation, axis=0)
        return RigidTransform.from_components(middle, together.rotation.mean())

    def places(self, cameras: Sequence[RigidTransform | None]) -> dict[int, RigidTransform]:
        """Return where each camera that shows the board has it, T_x_board by view."""
        return {
            v: T_x_camera * T_board_camera.inv()
            for v, (T_x_camera, T_board_camera) in enumerate(
                zip(cameras, self.T_board_camera, strict=True)
            )
            if T_x_camera is not None and T_board_camera is not None
        }

    def cameras(
        self, T_x_board: RigidTransform, others: Sequence[RigidTransform | None]
    ) -> tuple[RigidTransform | None, ...]:
        """Return T_x_camera of every view: by the board, and *others* where it is not shown."""
        return tuple(
            other if T is None else T_x_board * T
            for T, other in zip(self.T_board_camera, others, strict=True)
        )


def observe_board(work: Workpiece, progress: Report) -> BoardViews | None:
    """Return what the images of a session show of its board, None if it has none.

    Raises
    ------
    NotVisible
        If no image shows the board, or that of a hand-held view does not.
    DatasetError
        If what is shown cannot be the board that the dataset describes, or it has moved.
    """
    dataset, measurements = work.dataset, work.measurements
    if dataset.board is None:
        return None
    used = [measurements.views[v] for v in np.unique(measurements.view).tolist()]
    needed = {view.name for view in used if view.hand_held}
    if dataset.corners is not None:
        corners = reorder_corners(dataset.corners, work.order)
    else:
        rows = [row for row, image in enumerate(measurements.image) if image]
        load = dataset.image_reader(work.order.rows.tolist())
        corners = detect_corners(dataset.board, load, rows, work.run, progress)
        shown = needed if len(corners) else {view.name for view in used}
        require_board(dataset.board, corners, load, measurements, shown)
    poses = camera_poses(corners, dataset.board, measurements, needed)
    if all(T is None for T in poses.views):
        raise NotVisible(
            f"{dataset.yaml_path}: the calibration board could not be used: found no image with "
            f"{LEAST_CORNERS} of its corners or more, needed one; add corners to "
            f"{CORNERS_NAME}, or remove that table or the block board."
        )
    names = tuple(measurements.views[v].name for v in measurements.view.tolist())
    return BoardViews(dataset.board, poses.corners, poses.views, names)


def base_of_board(
    work: Workpiece, board: BoardViews, hints: Sequence[RigidTransform | None]
) -> RigidTransform | None:
    """Return a rough T_base_board: as the dataset has it, or by the rough poses of cameras.

    Parameters
    ----------
    work : Workpiece
    board : BoardViews
    hints : sequence of RigidTransform or None
        T_base_camera of the views that have one.

    Raises
    ------
    DatasetError
        If the dataset has the board where none of these cameras sees it.
    """
    given, by_cameras = work.dataset.T_base_board, board.placed(hints)
    if given is None or by_cameras is None:
        return given if by_cameras is None else by_cameras
    apart = given.inv() * by_cameras
    far, turned = float(np.linalg.norm(apart.translation)), float(apart.rotation.magnitude())
    # Wrong poses beside a right one are named when the images have placed their cameras.
    if not any(_agree(given, place) for place in board.places(hints).values()):
        raise DatasetError(
            f"{work.dataset.yaml_path}: board.T_base_board and the T_base_camera of the views "
            f"could not be used together: found the board {1e3 * far:.0f} mm and "
            f"{np.degrees(turned):.1f} deg from where these cameras see it, needed "
            f"{1e3 * _FAR:.0f} mm and {np.degrees(_TURNED):.0f} deg; correct the pose of the "
            "board, those of the cameras, or the dimensions of the board."
        )
    return given


def _agree(one: RigidTransform, other: RigidTransform, *, among_hints: bool = False) -> bool:
    """Say whether two places of the board are as near as hints are good, or as two of them are."""
    apart, wide = one.inv() * other, 2.0 if among_hints else 1.0
    far, turned = float(np.linalg.norm(apart.translation)), float(apart.rotation.magnitude())
    return far <= wide * _FAR and turned <= wide * _TURNED


def board_notes(dataset: Dataset, solution: Solution, corners: Corners | None) -> tuple[str, ...]:
    """Return what is odd about the board: views without it, and a place that cannot be.

    Parameters
    ----------
    dataset : Dataset
    solution : Solution
        The fit.
    corners : Corners or None
        Of all images, in the order of the dataset's rows; None without a board.
    """
    if corners is None:
        return ()
    measurements = dataset.measurements
    shown = set(measurements.view[corners.row[corners.used]].tolist())
    without = [
        measurements.views[v].name for v in np.unique(measurements.view).tolist() if v not in shown
    ]
    lost = (
        f"No image of {', '.join(without)} shows the calibration board, or too little of it: these "
        "cameras are placed by the legs alone.",
    )
    return (*(lost if without else ()), *_far_from_its_place(dataset, solution))


def _far_from_its_place(dataset: Dataset, solution: Solution) -> tuple[str, ...]:
    """Return a note if the board stands far from where the dataset has it."""
    given, found = dataset.T_base_board, solution.T_Rb_board
    if given is None or found is None:
        return ()
    apart = given.inv() * dataset.mechanism.T_base_Rb * found
    far, turned = float(np.linalg.norm(apart.translation)), float(apart.rotation.magnitude())
    if far <= _FAR and turned <= _TURNED:
        return ()
    return (
        f"The calibration board stands {1e3 * far:.0f} mm and {np.degrees(turned):.1f} deg from "
        "where T_base_board of the dataset has it, far more than base joints can be off; the "
        "result does not depend on it; correct T_base_board.",
    )


@dataclass(frozen=True, eq=False)
class InOneCamera:
    """Axes of all views that show the board, in the frame of the first of them.

    Attributes
    ----------
    axes : LegAxes
        Those of views without the board are in their own camera frames.
    measurements : Measurements
        The same rows; all views that show the board are one, which comes first.
    T_first_camera : tuple of RigidTransform or None
        The camera of each original view in the first one; None where it does not show the board.
    view : (n_views,) array of int
        Which of the new views each of the original ones is.
    """

    axes: LegAxes
    measurements: Measurements
    T_first_camera: tuple[RigidTransform | None, ...]
    view: IntArray

    def cameras(self, placed: Sequence[RigidTransform | None]) -> tuple[RigidTransform | None, ...]:
        """Return the camera of every original view.

        Parameters
        ----------
        placed : sequence of RigidTransform or None
            T_x_camera of the new views; x is any frame.
        """
        found = []
        for v, T_first_camera in zip(self.view.tolist(), self.T_first_camera, strict=True):
            T = placed[v]
            found.append(T if T is None or T_first_camera is None else T * T_first_camera)
        return tuple(found)


def in_one_camera(
    axes: LegAxes,
    measurements: Measurements,
    T_board_camera: Sequence[RigidTransform | None],
) -> InOneCamera:
    """Return the axes of all views that show a board in the frame of the first of these.

    Parameters
    ----------
    axes : LegAxes
        In the camera frames.
    measurements : Measurements
        Their views.
    T_board_camera : sequence of RigidTransform or None
        The camera of each view; None where it does not show the board. One of them shows it.
    """
    shown = np.array([T is not None for T in T_board_camera], dtype=np.bool_)
    first = int(np.argmax(shown))
    from_board = next(T.inv() for T in T_board_camera if T is not None)
    T_first_camera = tuple(None if T is None else from_board * T for T in T_board_camera)
    others = np.flatnonzero(~shown).tolist()
    place = np.zeros(len(shown), dtype=np.intp)
    place[others] = 1 + np.arange(len(others))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    view = measurements.view[axes.row]
    for v, T in enumerate(T_first_camera):
        here = view == v
        if T is not None and here.any():
            u[here], M[here] = T.rotation.apply(u[here]), T.apply(M[here])
            basis[here] = T.rotation.apply(basis[here].reshape(-1, 3)).reshape(-1, 2, 3)
    views = [replace(measurements.views[first], legs=None)]
    views += [measurements.views[v] for v in others]
    return InOneCamera(
        replace(axes, u=u, M=M, basis=basis),
        replace(measurements, views=tuple(views), view=place[measurements.view]),
        T_first_camera,
        place,
    )


def four_steps(
    work: Workpiece, outlines: Outlines, board: BoardViews | None, progress: Report
) -> Steps:
    """Return what the four steps give, or why they give nothing: the fit may do without."""
    if work.criteria is None:
        return Steps(None, None, "They were left out.")
    progress("Four steps", 0, 1)
    try:
        return _stepped(work, outlines, board)
    except (NotIdentifiable, NotVisible, DidNotConverge) as failure:
        return Steps(None, None, str(failure))
    finally:
        progress("Four steps", 1, 1)


def _stepped(work: Workpiece, outlines: Outlines, board: BoardViews | None) -> Steps:
    """Return what the steps give; cameras alone where only the later steps fail."""
    axes, measurements = work.axes, work.measurements
    if axes is None:
        radii = {part: r for leg in work.mechanism.legs for part, r in leg.radius_of_part.items()}
        axes = axes_from_outlines(outlines, measurements, radii)
    joined = None if board is None else in_one_camera(axes, measurements, board.T_board_camera)
    if joined is not None:
        axes, measurements = joined.axes, joined.measurements
    nominal, criteria = nominal_mechanism(work.mechanism), work.criteria or "default"
    legs, failure = None, ""
    diagnostics: tuple[str, ...] = ()
    base = run_base_steps(nominal, axes, measurements, criteria=criteria)
    try:
        found = run_platform_steps(
            nominal,
            axes,
            measurements,
            base,
            criteria=criteria,
            transformation=work.transformation,
            free_twists=any(name.endswith(".twist") for name in work.choices.free),
        )
        legs, diagnostics = found.legs, found.diagnostics
    except (NotIdentifiable, DidNotConverge) as error:
        failure = str(error)
    cameras = base.T_Rb_camera if joined is None else joined.cameras(base.T_Rb_camera)
    return Steps(legs, cameras, failure, diagnostics)


def starts_of_fit(
    work: Workpiece,
    outlines: Outlines,
    scene: Scene,
    steps: Steps,
    board: BoardViews | None,
) -> list[Start]:
    """Return the starts of the fit: the nominal model, and the steps where they gave a result."""
    mechanism = work.mechanism
    legs = geometries(mechanism)
    platform = work.reached.T_Rb_Re
    rough = [None if T is None else T.inv() * mechanism.T_base_Rb for T in scene.T_base_camera]
    staged = [None if T is None else T.inv() for T in steps.T_Rb_camera or [None] * len(rough)]
    starts = [(legs, _cameras(work, outlines, rough, staged, steps), "nominal")]
    if steps.legs is not None:
        starts.append((steps.legs, _cameras(work, outlines, staged, rough, steps), "staged"))
    found = [
        start_from(legs, work.measurements, work.fitted_legs, cameras, platform, label)
        for legs, cameras, label in starts
    ]
    return found if board is None else [_with_board(start, board) for start in found]


def _with_board(start: Start, board: BoardViews) -> Start:
    """Return a start with the board where its cameras see it."""
    T_Rb_board = board.placed([T.inv() for T in start.T_camera_Rb])
    return start if T_Rb_board is None else replace(start, T_Rb_board=T_Rb_board)


def _cameras(
    work: Workpiece,
    outlines: Outlines,
    first: Sequence[RigidTransform | None],
    second: Sequence[RigidTransform | None],
    steps: Steps,
) -> list[RigidTransform]:
    """Return a camera pose for every view, the first choice where there is one."""
    cameras = [a if a is not None else b for a, b in zip(first, second, strict=True)]
    shown = outlines.row[outlines.used] if work.axes is None else work.axes.row
    needed = set(work.measurements.view[shown].tolist())
    unknown = [
        view.name
        for v, view in enumerate(work.measurements.views)
        if v in needed and cameras[v] is None
    ]
    if unknown:
        raise NotIdentifiable(
            f"{few_views(unknown)}: no camera could be placed: found no "
            "T_base_camera, and the four steps do not locate it "
            f"({steps.failure or 'fewer than three base joints are seen'}); needed one of them; "
            "add a rough T_base_camera to dataset.yaml"
            + (", or T_base_board to its block board." if work.dataset.board else ".")
        )
    return [T if T is not None else RigidTransform.identity() for T in cameras]
