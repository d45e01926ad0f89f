"""The camera and the boards before it that explain corners best: one adjustment of everything.

Least squares in pixels over the intrinsics and one pose of the board an image, with Huber's loss;
poses are eliminated from the normal equations image by image.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, IntArray
from legcal.vision.camera import Camera, DistortionModel
from legcal.vision.intrinsics import (
    distort_derivatives,
    intrinsic_names,
    intrinsic_values,
    with_intrinsics,
)

N_STEPS = 60
STOP = 1e-9  # what a step would change of the cost, as a part of it
HUBER = 3.0  # standard deviations from which a corner counts less and less
WEAK_PIXELS = 10.0  # image widths: prior of focal lengths and principal point
# Prior of each coefficient of distortion; those of the rational model may cancel each other.
WEAK_COEFFICIENT: Mapping[DistortionModel, float] = {
    "plumb_bob": 100.0,
    "rational_polynomial": 1.0,
    "equidistant": 100.0,
}


@dataclass(frozen=True, eq=False)
class SeenCorners:
    """The corners of the board in some images.

    Attributes
    ----------
    image : (n,) array of int
        The image of each corner, rising, from 0 to n_images - 1.
    points : (n, 3) array
        Where it is on the board [m].
    px : (n, 2) array
        Where it is seen [px].
    sigma_px : (n,) array
        Standard deviation of either coordinate [px].
    """

    image: IntArray
    points: Array
    px: Array
    sigma_px: Array


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A camera and the board in every image.

    Attributes
    ----------
    camera : Camera
    T_camera_board : tuple of RigidTransform
        Of every image.
    residual : (n, 2) array
        Corners less where they should be seen [px].
    cost : float
        Half the sum of squares, in standard deviations, large ones by Huber's loss.
    covariance : (k, k) array
        Of :func:`legcal.vision.intrinsics.intrinsic_names`, by the standard deviations of corners.
    """

    camera: Camera
    T_camera_board: tuple[RigidTransform, ...]
    residual: Array
    cost: float
    covariance: Array


@dataclass(frozen=True, eq=False)
class _Normal:
    """The normal equations, poses eliminated."""

    cost: float
    residual: Array
    S: Array  # (k, k)
    g: Array  # (k,)
    blocks: list[tuple[Array, Array, Array]]  # of each image: B (k, 6), C (6, 6), gradient (6,)


def adjust(
    camera: Camera,
    poses: Sequence[RigidTransform],
    seen: SeenCorners,
    free: Sequence[str] = (),
    *,
    n_steps: int = N_STEPS,
) -> Adjusted | None:
    """Return the camera and poses of least cost near a start.

    Parameters
    ----------
    camera : Camera
        Where to begin; its focal length and centre are held by priors that tell next to nothing.
    poses : sequence of RigidTransform
        T_camera_board of every image, where to begin.
    seen : SeenCorners
        The corners.
    free : sequence of str
        The intrinsics to look for; all of them without it.
    n_steps : int
        Steps, at most.

    Returns
    -------
    Adjusted or None
        None if no place near the start has all corners before the camera.
    """
    names = tuple(free) or intrinsic_names(camera)
    prior = _Prior.at(camera, names)
    poses = list(poses)
    here = _normal(camera, poses, seen, names, prior)
    damping = 1e-4
    for _ in range(n_steps):
        if here is None:
            return None
        moved = _moved(camera, poses, here, names, damping)
        there = None if moved is None else _normal(moved[0], moved[1], seen, names, prior)
        if moved is None or there is None or not there.cost <= here.cost:
            damping *= 10.0
            if damping > 1e10:
                break
            continue
        gained = here.cost - there.cost
        (camera, poses), here = moved, there
        damping = max(0.1 * damping, 1e-10)
        if gained < STOP * max(here.cost, 1.0):
            break
    if here is None:
        return None
    scale = 1.0 / np.sqrt(np.maximum(np.diag(here.S), 1e-30))
    covariance = np.linalg.pinv(here.S * np.outer(scale, scale), hermitian=True)
    covariance = covariance * np.outer(scale, scale)
    return Adjusted(camera, tuple(poses), here.residual, here.cost, covariance)


@dataclass(frozen=True, eq=False)
class _Prior:
    """What is known of any camera: next to nothing, and enough to keep equations solvable."""

    mean: Array
    sigma: Array

    @classmethod
    def at(cls, camera: Camera, names: Sequence[str]) -> _Prior:
        every = intrinsic_names(camera)
        values = intrinsic_values(camera)
        pixels = WEAK_PIXELS * max(camera.width, camera.height)
        mean = [values[every.index(name)] if name[0] in "fc" else 0.0 for name in names]
        sigma = [pixels if name[0] in "fc" else WEAK_COEFFICIENT[camera.model] for name in names]
        return cls(np.array(mean), np.array(sigma))


def _normal(
    camera: Camera,
    poses: Sequence[RigidTransform],
    seen: SeenCorners,
    names: Sequence[str],
    prior: _Prior,
) -> _Normal | None:
    """Return the normal equations here; None where a corner is not before the camera."""
    if not (camera.K[0, 0] > 1.0 and camera.K[1, 1] > 1.0):
        return None
    bounds = np.searchsorted(seen.image, np.arange(len(poses) + 1))
    P = np.concatenate(
        [T.apply(seen.points[a:b]) for T, a, b in zip(poses, bounds, bounds[1:], strict=False)]
    )
    if P[:, 2].min() <= 1e-9:
        return None
    xy = P[:, :2] / P[:, 2:]
    residual = seen.px - camera.distort(xy)
    if not np.all(np.isfinite(residual)):
        return None
    t = residual / seen.sigma_px[:, None]
    size = np.linalg.norm(t, axis=1)
    far = size > HUBER
    cost = float(np.where(far, HUBER * (size - 0.5 * HUBER), 0.5 * size**2).sum())
    root = np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-12))) / seen.sigma_px
    J = distort_derivatives(camera, xy, names) * root[:, None, None]
    by_pose = _by_pose(camera, P, xy, poses, bounds) * root[:, None, None]
    t = residual * root[:, None]
    values = intrinsic_values(camera)
    every = intrinsic_names(camera)
    off = (np.array([values[every.index(name)] for name in names]) - prior.mean) / prior.sigma
    S = np.diag(prior.sigma**-2) + np.einsum("nia,nib->ab", J, J)
    g = np.einsum("nia,ni->a", J, t) - off / prior.sigma
    blocks = []
    for a, b in itertools.pairwise(bounds):
        Q = by_pose[a:b].reshape(-1, 6)
        B = J[a:b].reshape(-1, len(names)).T @ Q
        C = Q.T @ Q
        C += 1e-12 * np.diag(np.diag(C))
        gradient = Q.T @ t[a:b].ravel()
        solved = np.linalg.solve(C, np.column_stack([B.T, gradient]))
        S -= B @ solved[:, :-1]
        g -= B @ solved[:, -1]
        blocks.append((B, C, gradient))
    return _Normal(cost + 0.5 * float(off @ off), residual, 0.5 * (S + S.T), g, blocks)


def _by_pose(
    camera: Camera, P: Array, xy: Array, poses: Sequence[RigidTransform], bounds: IntArray
) -> Array:
    """Return how pixels change with a shift [m] and a turn [rad] of their boards, (n, 2, 6)."""
    by_point = np.zeros((len(P), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
    by_point[:, :, 2] = -xy
    by_point = camera.pixels_per_unit(xy) @ by_point / P[:, 2, None, None]
    origin = np.repeat([T.translation for T in poses], np.diff(bounds), axis=0)
    arm = P - origin
    by_turn = np.cross(arm[:, None, :], by_point)  # d(pixel) = by_point . (w x arm)
    return np.concatenate([by_point, by_turn], axis=-1)


def _moved(
    camera: Camera,
    poses: Sequence[RigidTransform],
    here: _Normal,
    names: Sequence[str],
    damping: float,
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return camera and poses after a damped step; None where it cannot be computed."""
    S = here.S + damping * np.diag(np.diag(here.S))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-30))
    try:
        step = scale * np.linalg.solve(S * np.outer(scale, scale), scale * here.g)
    except np.linalg.LinAlgError:
        return None
    every, values = intrinsic_names(camera), intrinsic_values(camera)
    changed = {
        name: float(values[every.index(name)] + change)
        for name, change in zip(names, step, strict=True)
    }
    moved = []
    for T, (B, C, gradient) in zip(poses, here.blocks, strict=True):
        by = np.linalg.solve(C + damping * np.diag(np.diag(C)), gradient - B.T @ step)
        turned = Rotation.from_rotvec(by[3:]) * T.rotation
        moved.append(RigidTransform.from_components(T.translation + by[:3], turned))
    return replace(with_intrinsics(camera, changed)), moved
