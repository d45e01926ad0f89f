"""Bundle adjustment of a board: its poses in images, the camera and the sheet where unknown.

The client of :mod:`legcal.estimation` for corners: where a camera stands before a board that is
known (:mod:`legcal.perception.board_poses`), and ``legcal camera``, which lets intrinsics free,
and how the board departs from a flat and true print (:class:`Sheet`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

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
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.vision.camera import (
    DISTORTION_MODELS,
    Camera,
    intrinsic_names,
    intrinsic_values,
    project_with_derivatives,
    with_intrinsics,
)

_MAX_ITERATIONS = 60
LOSS = Huber(3.0)  # standard deviations from which a corner counts less and less
_PRIOR_PX = 10.0  # image widths: prior of focal lengths and principal point
SHEET = ("warp_x", "warp_y", "twist", "print_ratio")  # numbers of a sheet
SIGMA_WARP = 0.01  # of its longer side: paper of 200 mm is bent by some millimetres
SIGMA_PRINT_RATIO = 0.005  # printers scale both directions differently


@dataclass(frozen=True, eq=False)
class BoardImages:
    """The corners of the board in some images, n of them."""

    image: IntArray  # (n,) of each corner, rising, from 0 to n_images - 1
    points: Array  # (n, 3) where it is on the board [m]
    px: Array  # (n, 2) where it is seen [px]
    sigma_px: Array  # (n,) standard deviation of either coordinate [px]


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
        moving = replace(problem, variables=tuple(map(_held, problem.variables)))
    minimum = minimise(
        moving,
        state,
        LOSS,
        max_iterations=max_iterations,
        tolerance=tolerance,
        must_converge=False,
    )
    linear = linearize(problem, minimum.state) if held else minimum.linear
    normal = normal_equations(problem, minimum.state, linear, LOSS)
    return AdjustedBoard(
        minimum.state.camera,
        minimum.state.board_pose.motions,
        minimum.state.sheet,
        -linear["corners"].r * seen.sigma_px[:, None],
        minimum.cost,
        normal.kept_covariance(),
        clustered(problem, linear, normal, LOSS),
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


def _held(block: Variables) -> Variables:
    """Return a block that does not move."""
    unknown = fixed_at_start(*block.unknown.shape)
    return replace(block, unknown=unknown, labels=(), units=(), prior=NO_PRIOR)


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
    by_turn = cross(arm[:, None, :], by_point)  # d(pixel) = by_point . (w x arm)
    by_pose = np.concatenate([by_turn, by_point], axis=-1)
    by_kept = np.concatenate([by_intrinsics, by_point @ (R @ by_sheet)], axis=-1)
    return Residuals.of(predicted - seen.px, by_kept, by_pose)
