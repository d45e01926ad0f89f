"""Bundle adjustment of a flat board: its poses in images, and the camera where that is unknown.

The client of :mod:`legcal.estimation` for corners: where a camera stands before a board that is
known (:mod:`legcal.perception.board_poses`), and ``legcal camera``, which lets intrinsics free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.estimation import (
    Factor,
    Frames,
    GaussianPrior,
    Huber,
    Problem,
    Residuals,
    Variables,
    all_free,
    minimise,
    normal_equations,
)
from legcal.geometry import Array, IntArray, cross
from legcal.vision import (
    DISTORTION_MODELS,
    Camera,
    distort_derivatives,
    intrinsic_names,
    intrinsic_values,
    with_intrinsics,
)

_MAX_ITERATIONS = 60
_LOSS = Huber(3.0)  # standard deviations from which a corner counts less and less
_PRIOR_PX = 10.0  # image widths: prior of focal lengths and principal point


@dataclass(frozen=True, eq=False)
class BoardImages:
    """The corners of the board in some images, n of them."""

    image: IntArray  # (n,) of each corner, rising, from 0 to n_images - 1
    points: Array  # (n, 3) where it is on the board [m]
    px: Array  # (n, 2) where it is seen [px]
    sigma_px: Array  # (n,) standard deviation of either coordinate [px]


@dataclass(frozen=True, eq=False)
class AdjustedBoard:
    """A camera and the board in every image."""

    camera: Camera
    T_camera_board: tuple[RigidTransform, ...]  # of every image
    residual: Array  # (n, 2) corners less where they should be seen [px]
    cost: float  # half the sum of squares, in standard deviations, large ones by Huber's loss
    covariance: Array  # (k, k) of the free intrinsics, by the standard deviations of corners
    # (n_images, 6, 6) of a rotation vector [rad] and a displacement [m] of the board, the camera
    # being known
    information: Array


@dataclass(frozen=True, eq=False)
class _State:
    camera: Camera
    board_pose: Frames  # T_camera_board of every image


def adjust_board(
    camera: Camera,
    poses: Sequence[RigidTransform],  # T_camera_board of every image
    seen: BoardImages,
    free: Sequence[str] = (),  # intrinsics that are unknown
    *,
    max_iterations: int = _MAX_ITERATIONS,
) -> AdjustedBoard | None:
    """Return the board's poses of least cost near a start, and free intrinsics of the camera.

    Priors of these are so wide that they say next to nothing. None if no place near the start has
    all corners before the camera.
    """
    names = tuple(free)
    where = np.array([intrinsic_names(camera).index(name) for name in names], dtype=np.intp)
    pixel = np.array([name[0] in "fc" for name in names], dtype=np.bool_)
    known = GaussianPrior(
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

    n = len(seen.image)
    problem = Problem[_State](
        variables=(
            Variables(
                "camera",
                all_free(1, len(names)),
                moved,
                names,
                ("",) * len(names),
                lambda camera: intrinsic_values(camera)[where],
                prior=known,
            ),
        ),
        eliminated=Variables("board_pose", all_free(len(poses), 6), Frames.moved),
        factors=(
            Factor(
                "corners",
                lambda state: _corners(state, seen, names),
                (("camera", np.zeros(n, dtype=np.intp), slice(None)),),
                n,
                2,
                seen.image,
                1.0 / seen.sigma_px[:, None, None],
                robust=True,
            ),
        ),
        name="calibration of the camera" if names else "pose of the board",
    )
    state = _State(camera, Frames.of(poses))
    if not np.all(np.isfinite(problem.factor("corners").rows(state).r)):
        return None
    found = minimise(problem, state, _LOSS, max_iterations=max_iterations, must_converge=False)
    normal = normal_equations(problem, found.state, found.linear, _LOSS)
    return AdjustedBoard(
        found.state.camera,
        found.state.board_pose.motions,
        -found.linear["corners"].r * seen.sigma_px[:, None],
        found.cost,
        normal.kept_covariance(),
        normal.V,
    )


def _corners(state: _State, seen: BoardImages, names: Sequence[str]) -> Residuals:
    """Return predicted less measured corners [px]; not finite where one is behind the camera."""
    camera, R = state.camera, state.board_pose.R[seen.image]
    arm = (R @ seen.points[:, :, None])[:, :, 0]
    P = arm + state.board_pose.t[seen.image]
    shape = seen.px.shape
    if P[:, 2].min() <= 1e-9 or not (camera.K[0, 0] > 1.0 and camera.K[1, 1] > 1.0):
        nothing = np.full(shape, np.nan)
        return Residuals.of(nothing, np.zeros((*shape, len(names))), np.zeros((*shape, 6)))
    predicted, by_point = camera.project_with_derivative(P)
    by_turn = cross(arm[:, None, :], by_point)  # d(pixel) = by_point . (w x arm)
    by_pose = np.concatenate([by_turn, by_point], axis=-1)
    by_intrinsics = np.zeros((*shape, 0))
    if names:
        by_intrinsics = distort_derivatives(camera, P[:, :2] / P[:, 2:], names)
    return Residuals.of(predicted - seen.px, by_intrinsics, by_pose)
