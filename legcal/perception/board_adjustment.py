"""Bundle adjustment of a board: its poses in images, the camera and the sheet where unknown.

:func:`adjust_board` is the client of :mod:`legcal.estimation` for corners: where a camera stands
before a known board, and ``legcal camera``, which lets intrinsics free, and how the board departs
from a flat and true print (:class:`Sheet`).

A plane that is seen with little perspective has two poses that show it almost alike (IPPE).
:func:`plane_poses` refines both in the image with the whole lens model, and keeps them while both
explain it. A view has the pose that all of its images show; these must agree on it one by one, or
the board has moved (:func:`camera_poses_by_board`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from legcal.data.corners import Corners
from legcal.data.dataset import MIN_CORNERS
from legcal.data.measurements import Measurements, row_names
from legcal.data.reasons import Reason, Rejection
from legcal.errors import Cause, DatasetError, NotVisible, Problem
from legcal.estimation.clusters import Clusters, clustered
from legcal.estimation.loss import Huber
from legcal.estimation.problem import (
    NO_PRIOR,
    EstimationProblem,
    Factor,
    Frames,
    GaussianPrior,
    Residuals,
    Variables,
    all_free,
    fixed_at_start,
    linearize,
)
from legcal.estimation.solver import COST_TOLERANCE, minimise, normal_equations
from legcal.files.schema import few
from legcal.geometry.lines import cross
from legcal.geometry.tables import Table, first_apart
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.board import Board
from legcal.vision.camera import (
    DISTORTION_MODELS,
    Camera,
    intrinsic_names,
    intrinsic_values,
    project_with_derivatives,
    with_intrinsics,
)
from legcal.vision.point_pose import closed_form_poses, on_a_line

_MAX_ITERATIONS = 60
_RIM = 16  # points of a circle by which its image is known
LOSS = Huber(3.0)  # standard deviations from which a corner counts less and less
_PRIOR_PX = 10.0  # image widths: prior of focal lengths and principal point
SHEET = ("warp_x", "warp_y", "twist", "print_ratio")  # numbers of a sheet
SIGMA_WARP = 0.01  # of its longer side: paper of 200 mm is bent by some millimetres
SIGMA_PRINT_RATIO = 0.005  # printers scale both directions differently


@dataclass(frozen=True, eq=False)
class BoardImages(Table):
    """The corners of the board in some images, n of them."""

    image: IntArray  # (n,) of each corner, rising, from 0 to n_images - 1
    points: Array  # (n, 3) where it is on the board [m]
    px: Array  # (n, 2) where it is seen [px]
    sigma_px: Array  # (n,) standard deviation of either coordinate [px]
    radius: float = 0.0  # of circles whose centres in the image px are [m]; 0 for corners


@dataclass(frozen=True, eq=False)
class Sheet:
    """Deviations of a board from a flat one with square fields.

    With X and Y from -1 to 1 over its corners, a corner lies warp_x (1 - X^2) + warp_y (1 - Y^2) +
    twist X Y above the plane, and lengths along x are 1 + print_ratio times those along y.
    """

    middle: Array  # (2,) of its corners [m]
    half: Array  # (2,) of their extent [m]
    numbers: Array  # (4,) ``SHEET``: [m, m, m, without unit]

    @classmethod
    def flat(cls, points: Array) -> Sheet:
        """Return the flat sheet with these corners (n, 3)."""
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        return cls(0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-9), np.zeros(len(SHEET)))

    @property
    def prior_sigma(self) -> Array:
        """Standard deviations of its numbers before anything is seen, (4,)."""
        warp = SIGMA_WARP * 2.0 * float(self.half.max())
        return np.array([warp, warp, warp, SIGMA_PRINT_RATIO])

    def placed(self, points: Array) -> tuple[Array, Array]:
        """Return positions of corners (n, 3) of a flat board, and their derivative (n, 3, 4)."""
        from_middle = points[:, :2] - self.middle
        X, Y = (from_middle / self.half).T
        by_number = np.zeros((len(points), 3, len(SHEET)))
        by_number[:, 2, :3] = np.stack([1.0 - X**2, 1.0 - Y**2, X * Y], axis=-1)
        by_number[:, :2, 3] = from_middle * [0.5, -0.5]
        return points + by_number @ self.numbers, by_number


@dataclass(frozen=True, eq=False)
class AdjustedBoard:
    """A camera and the board in every image."""

    camera: Camera
    T_camera_board: tuple[RigidTransform, ...]  # of every image
    sheet: Sheet | None  # None where the board was taken as flat
    residual: Array  # (n, 2) corners less where they should be seen [px]
    cost: float  # half the sum of squares, in standard deviations, large ones by Huber's loss
    covariance: (
        Array  # (k, k) of the free intrinsics, then of the sheet, from the covariances of corners
    )
    clusters: Clusters  # scores of these by image
    # (n_images, 6, 6) of a rotation vector [rad] and a displacement [m] of the board, the camera
    # being known
    information: Array

    def rms_px(self, which: BoolArray | None = None) -> float:
        """Reprojection error (rms) of corners, of all (n,) or some [px]."""
        residual = self.residual if which is None else self.residual[which]
        return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


@dataclass(frozen=True, eq=False)
class _State:
    camera: Camera
    board_pose: Frames  # T_camera_board of every image
    sheet: Sheet | None


def adjust_board(
    camera: Camera,
    poses: Sequence[RigidTransform],  # T_camera_board of every image
    seen: BoardImages,
    free: Sequence[str] = (),  # intrinsics that are unknown
    sheet: Sheet | None = None,  # where that is unknown: near it
    *,
    held: bool = False,  # whether camera and sheet stay, and only poses follow
    max_iterations: int = _MAX_ITERATIONS,
    tolerance: float = COST_TOLERANCE,  # fall of the cost at which to stop, in squared sigmas
) -> AdjustedBoard | None:
    """Return the board's poses of least cost near a start, and free intrinsics of the camera.

    Priors of these are so wide that they say next to nothing; those of a sheet are what paper and
    printers do. None if no place near the start has all corners before the camera.
    """
    names = tuple(free)
    problem = _problem(camera, names, sheet, seen, len(poses))
    state = _State(camera, Frames.of(poses), sheet)
    if not np.all(np.isfinite(problem.factor("corners").rows(state).r)):
        return None
    moving = problem
    if held:
        still = (
            replace(
                block,
                unknown=fixed_at_start(*block.unknown.shape),
                labels=(),
                units=(),
                prior=NO_PRIOR,
            )
            for block in problem.variables
        )
        moving = replace(problem, variables=tuple(still))
    minimum = minimise(
        moving,
        state,
        LOSS,
        max_iterations=max_iterations,
        tolerance=tolerance,
        must_converge=False,
    )
    linear = linearize(problem, minimum.state) if held else minimum.linear
    normal = normal_equations(linear, LOSS)
    return AdjustedBoard(
        minimum.state.camera,
        minimum.state.board_pose.motions,
        minimum.state.sheet,
        -linear["corners"].r * seen.sigma_px[:, None],
        minimum.cost,
        normal.kept_covariance(),
        clustered(normal, LOSS),
        normal.V,
    )


def _problem(
    camera: Camera, names: tuple[str, ...], sheet: Sheet | None, seen: BoardImages, n_images: int
) -> EstimationProblem[_State]:
    """Return the problem of the board's poses, named intrinsics and the sheet, where it is one."""
    blocks = [_intrinsics(camera, names)]
    if sheet is not None:
        blocks.append(
            Variables(
                "sheet",
                all_free(1, len(SHEET)),
                lambda sheet, change: replace(sheet, numbers=sheet.numbers + change[0]),
                coordinates=lambda sheet: sheet.numbers,
                prior=GaussianPrior(np.arange(len(SHEET)), np.zeros(len(SHEET)), sheet.prior_sigma),
            )
        )
    one = np.zeros(len(seen.image), dtype=np.intp)
    corners: Factor[_State] = Factor(
        "corners",
        lambda state: _corners(state, seen, names),
        tuple((block.name, one, slice(None)) for block in blocks),
        len(seen.image),
        2,
        seen.image,
        1.0 / seen.sigma_px[:, None, None],
        robust=True,
    )
    return EstimationProblem[_State](
        variables=tuple(blocks),
        eliminated=Variables("board_pose", all_free(n_images, 6), Frames.moved),
        factors=(corners,),
        name="calibration of the camera" if names else "pose of the board",
    )


def _intrinsics(camera: Camera, names: tuple[str, ...]) -> Variables:
    """Return the block of named intrinsics, with priors that say next to nothing."""
    where = np.array([intrinsic_names(camera).index(name) for name in names], dtype=np.intp)
    pixel = np.array([name[0] in "fc" for name in names], dtype=np.bool_)
    prior = GaussianPrior(
        np.arange(len(names), dtype=np.intp),
        np.where(pixel, intrinsic_values(camera)[where], 0.0),
        np.where(
            pixel,
            _PRIOR_PX * max(camera.width, camera.height),
            DISTORTION_MODELS[camera.model].prior_sigma,
        ),
    )

    def moved(camera: Camera, change: Array) -> Camera:
        if not names:
            return camera
        values = intrinsic_values(camera)[where] + change[0]
        return with_intrinsics(camera, dict(zip(names, values.tolist(), strict=True)))

    return Variables(
        "camera",
        all_free(1, len(names)),
        moved,
        names,
        ("",) * len(names),
        lambda camera: intrinsic_values(camera)[where],
        prior=prior,
    )


def _corners(state: _State, seen: BoardImages, names: Sequence[str]) -> Residuals:
    """Return predicted less measured corners [px]; not finite where one is behind the camera."""
    camera, R = state.camera, state.board_pose.R[seen.image]
    points, by_sheet = seen.points, np.zeros((len(seen.points), 3, 0))
    if state.sheet is not None:
        points, by_sheet = state.sheet.placed(points)
    arm = (R @ points[:, :, None])[:, :, 0]
    P = arm + state.board_pose.t[seen.image]
    shape, n_kept = seen.px.shape, len(names) + by_sheet.shape[2]
    if P[:, 2].min() <= 1e-9 or not (camera.K[0, 0] > 1.0 and camera.K[1, 1] > 1.0):
        nothing = np.full(shape, np.nan)
        return Residuals.of(nothing, np.zeros((*shape, n_kept)), np.zeros((*shape, 6)))
    if names:
        predicted, by_point, by_intrinsics = project_with_derivatives(camera, P, names)
    else:
        predicted, by_point = camera.project_with_derivative(P)
        by_intrinsics = np.zeros((*shape, 0))
    if seen.radius:  # the derivative of this small shift is left out
        predicted = _centres(camera, P, R, seen.radius, predicted)
    by_turn = cross(arm[:, None, :], by_point)  # d(pixel) = by_point . (w x arm)
    by_pose = np.concatenate([by_turn, by_point], axis=-1)
    by_kept = np.concatenate([by_intrinsics, by_point @ (R @ by_sheet)], axis=-1)
    return Residuals.of(predicted - seen.px, by_kept, by_pose)


def _centres(camera: Camera, P: Array, R: Array, radius: float, px: Array) -> Array:
    """Return the centroids of the images of circles about P (n, 3), whose own images are px (n, 2).

    They differ by perspective and distortion. R (n, 3, 3) is T_camera_board's.
    """
    turn = 2.0 * np.pi * np.arange(_RIM) / _RIM
    rim = radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(_RIM)], axis=-1)
    here = camera.project(P[:, None] + rim @ np.swapaxes(R, 1, 2)) - px[:, None]
    following = np.roll(here, -1, axis=1)
    area = here[..., 0] * following[..., 1] - here[..., 1] * following[..., 0]
    moment = np.sum((here + following) * area[..., None], axis=1)
    return np.asarray(px + moment / (3.0 * area.sum(axis=1))[:, None])


SAME_ANGLE, SIMILAR_ANGLE = 1e-3, np.deg2rad(3.0)  # between poses of one plane: of an image, a view
MAX_RESIDUAL_PX, MAX_RESIDUAL_SIGMA = 1.0, 5.0  # root mean square of corners of this board
OUTLIER_PX, OUTLIER_SIGMA = 0.3, 6.0  # a corner further off than both is rejected
MIN_CHI2_LEAD = 25.0  # of one pose over the other one, in squares
MIN_SHIFT_PX = 0.15  # by which corners must shift together where the board moved
SIGNIFICANCE = 1e-6  # of a motion, for each pair of images


def plane_poses(
    camera: Camera,
    points: Array,  # (n, 3) four points or more of the plane z = 0, not all on a line [m]
    px: Array,  # (n, 2) where they are seen [px]
    sigma_px: Array,  # (n,) standard deviations of either coordinate [px]
) -> list[AdjustedBoard]:
    """Return the poses of a plane that explain where its points are seen, the better one first."""
    xy = camera.undistort(px)
    starts = list(closed_form_poses(points, xy, cv2.SOLVEPNP_IPPE))
    refined = [_refine(camera, points, px, sigma_px, start) for start in starts]
    poses = _distinct([pose for pose in refined if pose is not None], SAME_ANGLE)
    return sorted(poses, key=lambda pose: pose.cost)


def _refine(
    camera: Camera, points: Array, px: Array, sigma_px: Array, start: RigidTransform
) -> AdjustedBoard | None:
    """Return the pose of least cost near a start; None if it puts points behind the camera."""
    one = BoardImages(np.zeros(len(px), dtype=np.intp), points, px, sigma_px)
    return adjust_board(camera, [start], one)


def _distinct(poses: list[AdjustedBoard], angle: float) -> list[AdjustedBoard]:
    """Return the poses that differ by more than an angle, the first ones of each kind."""
    near = np.array([[_angle(one, other) <= angle for other in poses] for one in poses], np.bool_)
    return [poses[i] for i in first_apart(near).tolist()]


def _angle(one: AdjustedBoard, other: AdjustedBoard) -> float:
    """Return the angle between two poses [rad]."""
    turn = one.T_camera_board[0].rotation * other.T_camera_board[0].rotation.inv()
    return float(turn.magnitude())


def camera_poses_by_board(
    corners: Corners,
    board: Board,
    measurements: Measurements,
    needed: Collection[str] = (),
) -> tuple[tuple[RigidTransform | None, ...], Corners]:
    """Return T_board_camera of all views by corners that are used, and corners without outliers.

    A view whose images do not show the board has None, and a single image of a camera in the hand
    that no pose of the board explains; its corners are rejected. Raises NotVisible if a needed view
    has None, or it is seen so that two poses explain it; DatasetError if corners are not those of
    this board by the camera file, or the board moved between images of a view.
    """
    T_board_camera: list[RigidTransform | None] = []
    problems: dict[type[DatasetError] | type[NotVisible], list[Problem]] = {}
    in_hand: list[Problem] = []  # of single images; the other ones may be right
    for v, view in enumerate(measurements.views):
        here = np.flatnonzero((measurements.view[corners.row] == v) & corners.used)
        pose = None
        try:
            pose = _joint_pose(view.name, corners.choose(here), board, measurements)
        except (DatasetError, NotVisible) as error:
            if isinstance(error, DatasetError) and view.hand_held:
                in_hand += error.facts
                wrong = measurements.view[corners.row] == v
                why = Rejection(Reason.NO_BOARD_POSE, error.facts[0].found)
                corners = corners.reject(wrong, [why] * len(corners))
            elif isinstance(error, DatasetError) or view.name in needed:
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
        T_board_camera.append(None if pose is None else pose.T_camera_board[0].inv())
        if pose is not None:
            corners = _without_outliers(corners, here, pose)
    if len(in_hand) > sum(T is not None for T in T_board_camera):
        problems.setdefault(DatasetError, []).extend(in_hand)
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
            T_camera_board |= dict.fromkeys(rows, pose.T_camera_board[0])
            corners = _without_outliers(corners, here, pose)
    if len(wrong) > len(T_camera_board):
        raise DatasetError(wrong)
    return T_camera_board, corners


def _without_outliers(corners: Corners, here: IntArray, pose: AdjustedBoard) -> Corners:
    """Return corners, those among *here* rejected that are far from where a pose puts them."""
    off, some = np.zeros(len(corners)), corners.choose(here)
    off[here] = np.linalg.norm(pose.residual, axis=1)
    outlier = np.zeros(len(corners), dtype=np.bool_)
    scaled = OUTLIER_SIGMA * _scale(pose, some) * some.sigma_px
    outlier[here] = off[here] > np.maximum(OUTLIER_PX, scaled)
    why = [Rejection(Reason.CORNER_OFF, f"{px:.2g}") for px in off]
    return corners.reject(outlier, why)


def _joint_pose(
    name: str, corners: Corners, board: Board, measurements: Measurements
) -> AdjustedBoard | None:
    """Return the pose that images share; None if none of them shows enough corners."""
    if not len(corners):
        return None
    camera = measurements.views[measurements.view[corners.row[0]]].camera
    of_row: dict[int, list[AdjustedBoard]] = {}
    for row in np.unique(corners.row).tolist():
        here = corners.row == row
        points = board.points[corners.corner[here]]
        if len(points) >= MIN_CORNERS and not on_a_line(points):
            of_row[row] = plane_poses(camera, points, corners.px[here], corners.sigma_px[here])
    if not of_row:
        return None
    candidates = _distinct([pose for poses in of_row.values() for pose in poses], SIMILAR_ANGLE)
    if not candidates:
        raise DatasetError(_another_board(name, board, "no pose of", "showing them there"))
    joint = candidates
    if len(np.unique(corners.row)) > 1:  # one image alone has these already
        everything = board.points[corners.corner], corners.px, corners.sigma_px
        refined = [_refine(camera, *everything, start.T_camera_board[0]) for start in candidates]
        joint = sorted((pose for pose in refined if pose is not None), key=lambda pose: pose.cost)
        joint = _distinct(joint, SIMILAR_ANGLE)
    if not joint:
        raise DatasetError(
            _another_board(name, board, "no one pose of", "one that all its images show")
        )
    best = joint[0]
    scale = _scale(best, corners)
    lead = MIN_CHI2_LEAD * scale**2

    def is_ambiguous(poses: list[AdjustedBoard]) -> bool:
        return len(poses) > 1 and 2.0 * (poses[1].cost - poses[0].cost) < lead

    single = {  # of two poses that both explain an image that near the view's
        row: min(poses, key=lambda pose: _angle(pose, best)) if is_ambiguous(poses) else poses[0]
        for row, poses in of_row.items()
        if poses
    }
    of_image = [_scale(pose, corners.choose(corners.row == row)) for row, pose in single.items()]
    _require_still(name, single, max(of_image), board, camera, row_names(measurements))
    # Corners that no pose of this board explains.
    off = np.linalg.norm(best.residual, axis=1)
    rms = float(np.median(off)) / np.sqrt(2.0 * np.log(2.0))  # as of one coordinate
    limit = max(MAX_RESIDUAL_PX, MAX_RESIDUAL_SIGMA * float(np.median(corners.sigma_px)))
    if rms > limit:
        found = Cause("{:.2g} px from the best pose of", (rms,))
        raise DatasetError(_another_board(name, board, found, f"{limit:.2g} px"))
    if is_ambiguous(joint):
        raise NotVisible(
            f"view {name}: its camera could not be placed: found two poses that explain the "
            f"{len(corners)} corners of the board alike, "
            f"{np.rad2deg(_angle(joint[0], joint[1])):.0f} degrees apart, needed a board that is "
            "larger in the image and seen at a slant; move the camera nearer."
        )
    return best


def _scale(pose: AdjustedBoard, corners: Corners) -> float:
    """Return by how much residuals exceed the standard deviations of corners, at least one."""
    t = np.linalg.norm(pose.residual, axis=1) / corners.sigma_px
    return max(1.0, float(np.median(t)) / float(np.sqrt(2.0 * np.log(2.0))))


def _require_still(
    name: str,
    single: Mapping[int, AdjustedBoard],
    scale: float,
    board: Board,
    camera: Camera,
    names: tuple[str, ...],
) -> None:
    """Refuse images of a view in which the board stands elsewhere than in most of them.

    ``single`` are the poses of single images, by row, from which residuals are up to ``scale``
    times the standard deviations of corners; ``names`` are those of the rows.
    """
    rows, remedy = list(single), "leave those images out, or give them a view of their own"
    if len(rows) < 2:
        return
    limit = float(chdtri(6, SIGNIFICANCE / len(rows))) * scale**2
    T = {row: pose.T_camera_board[0] for row, pose in single.items()}
    px = {row: camera.project(T[row].apply(board.points)) for row in rows}
    together = np.array(
        [[_agree(single[a], single[b], px[a] - px[b], limit) for b in rows] for a in rows]
    )
    most = int(np.argmax(together.sum(axis=1)))
    others = [row for row, same in zip(rows, together[most], strict=True) if not same]
    if not others:
        return
    moves = [T[rows[most]].inv() * T[row] for row in others]
    middle = board.points.mean(axis=0)
    if 2 * len(others) >= len(rows):
        remedy = f"write hand_held: true for the view if its camera was in the hand, else {remedy}"
    far = max(float(np.linalg.norm(move.apply(middle) - middle)) for move in moves)
    turn = max(float(move.rotation.magnitude()) for move in moves)
    raise DatasetError(
        f"view {name}: its camera could not be placed: found the board elsewhere in "
        f"{few([names[row] for row in others])} than in {names[rows[most]]}, by up to "
        f"{1e3 * far:.2g} mm and {np.rad2deg(turn):.2g} degrees, needed a camera and a board that "
        f"stand still in all images of a view; {remedy}."
    )


def _agree(one: AdjustedBoard, other: AdjustedBoard, shift_px: Array, limit: float) -> bool:
    """Return whether two poses of the board agree, by their covariances."""
    if float(np.sqrt(np.mean(np.sum(shift_px**2, axis=1)))) < MIN_SHIFT_PX:
        return True
    a, b = one.T_camera_board[0], other.T_camera_board[0]
    turn = (b.rotation * a.rotation.inv()).as_rotvec()
    d = np.concatenate([turn, b.translation - a.translation])
    covariance = np.linalg.inv(one.information[0]) + np.linalg.inv(other.information[0])
    return bool(d @ np.linalg.solve(covariance, d) < limit)


def _another_board(name: str, board: Board, found: str | Cause, needed: str) -> Problem:
    """Return the rejection of corners that do not fit this board with the camera file."""
    sizes = {
        "chessboard": "the numbers of squares",
        "charuco": "the numbers of squares, marker and square",
        "aprilgrid": "the numbers of tags and tag_spacing",
    }[board.kind]
    return Problem(
        f"view {name}: its camera could not be placed by the corners of the board",
        Cause("{} the {} of the dataset file", (found, board.kind)),
        needed,
        f"check {sizes} there, and that the camera file is of this camera and lens",
        name=name,
    )
