"""How well a camera projects over its image, and how far two cameras are apart.

A session leaves the pose of its camera free, so a turn of the camera is no error: the turn that
explains most of a change of the intrinsics in the middle of the image is taken out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.errors import UsageError
from legcal.files.schema import Document
from legcal.geometry.types import Array, BoolArray
from legcal.vision.camera import Camera, intrinsic_names, project_with_derivatives

GRID = 17, 13  # places along both sides of the image
_TURNS = 10  # Gauss-Newton steps of the turn between two cameras
_LEAST_REACHED = 0.5  # of the image, for a comparison of cameras


def projection_sigma(camera: Camera, covariance: Array) -> Array:
    """Return the standard deviation of the projection at the places of ``GRID``, (n,) [px].

    That of the worst direction in the image; infinite where the lens model folds back.
    """
    pixels = camera.grid(*GRID)
    reached = camera.reaches(pixels)
    rays = _rays(camera, pixels[reached])
    _, by_ray, J = project_with_derivatives(camera, rays, intrinsic_names(camera))
    by_turn = _by_turn(rays, by_ray)
    J = J - by_turn @ _turn_of(by_turn, J, _in_the_middle(camera, pixels[reached]))
    spread = J @ covariance @ np.swapaxes(J, 1, 2)
    sigma = np.full(len(pixels), np.inf)
    sigma[reached] = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, -1], 0.0))
    return sigma


def _rays(camera: Camera, pixels: Array) -> Array:
    """Return rays (n, 3) at pixels."""
    return np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])


def _in_the_middle(camera: Camera, pixels: Array) -> BoolArray:
    """Return a mask of the pixels in the middle half of the image, each way."""
    share = (pixels + 0.5) / [camera.width, camera.height]
    return np.asarray(np.all(np.abs(share - 0.5) < 0.26, axis=1))


def _turn_of(by_turn: Array, change: Array, which: BoolArray) -> Array:
    """Return the turn (3, k) that explains most of changes (n, 2, k) of some pixels."""
    rows = change[which].reshape(-1, change.shape[2])
    return np.asarray(np.linalg.lstsq(by_turn[which].reshape(-1, 3), rows, rcond=None)[0])


def _by_turn(rays: Array, by_ray: Array) -> Array:
    """Return derivatives of pixels by a turn of their rays, (n, 2, 3) [px/rad]."""
    return np.cross(rays[:, None, :], by_ray)


@dataclass(frozen=True, eq=False)
class CameraComparison:
    """The difference of two calibrations of a camera over the image."""

    pixels: Array  # (n, 2): places in the image of the first camera
    # (n, 2): pixels of the second camera less those of the first, after the best turn [px]
    off_px: Array
    off: Array  # (n,): the same as a length beside the ray, relative to the distance of a point
    # (n,): standard deviation of the difference by the covariances of both; None without these
    sigma_px: Array | None
    turn: float  # angle of the turn [rad]
    reached: float  # part of the image that is compared: of the rest the first camera has no rays

    @property
    def px(self) -> Array:
        """Lengths of the differences, (n,) [px]."""
        return np.asarray(np.linalg.norm(self.off_px, axis=1))

    def document(self) -> dict[str, Any]:
        """Return the output of ``--json``."""
        sigmas = [None] * len(self.px) if self.sigma_px is None else finite(self.sigma_px)
        return CameraComparisonDocument(
            legcal_camera_comparison=1,
            rms_px=float(np.sqrt(np.mean(self.px**2))),
            largest_px=float(self.px.max()),
            largest_mm_per_m=float(1e3 * self.off.max()),
            turn_rad=self.turn,
            reached=self.reached,
            places=[
                ComparedPlace(u=u, v=v, du=du, dv=dv, sigma_px=sigma)
                for (u, v), (du, dv), sigma in zip(
                    self.pixels.tolist(), self.off_px.tolist(), sigmas, strict=True
                )
            ],
        ).document()


def finite(numbers: Array) -> list[float | None]:
    """Return numbers (n,) with None for infinite ones, as JSON has it."""
    return [number if np.isfinite(number) else None for number in numbers.tolist()]


class ComparedPlace(Document):
    """The difference of two cameras at a pixel of the first [px]."""

    u: float
    v: float
    du: float
    dv: float
    sigma_px: float | None


class CameraComparisonDocument(Document):
    """The output of ``legcal camera --compare --json``."""

    legcal_camera_comparison: int
    rms_px: float
    largest_px: float
    largest_mm_per_m: float
    turn_rad: float
    reached: float
    places: list[ComparedPlace]


def compare_cameras(first: Camera, second: Camera) -> CameraComparison:
    """Compare two calibrations of one camera over the image.

    Raises UsageError if their images differ in size, or if the lens of the first folds back before
    half of the image.
    """
    sizes = [f"{camera.width} x {camera.height} px" for camera in (first, second)]
    if sizes[0] != sizes[1]:
        raise UsageError(
            f"The cameras could not be compared: found images of {sizes[0]} and of {sizes[1]}, "
            "needed one size; give two calibrations of one camera."
        )
    pixels = first.grid(*GRID)
    reached = first.reaches(pixels)
    share = float(np.mean(reached))
    if share < _LEAST_REACHED:
        raise UsageError(
            f"The cameras could not be compared: found {100.0 * share:.0f} % of the image that the "
            f"lens model of the first one reaches, needed {100.0 * _LEAST_REACHED:.0f} %; name the "
            "other camera first, or calibrate with corners all over the image."
        )
    pixels = pixels[reached]
    rays, sigma_px = _rays(first, pixels), None
    if first.covariance is not None and second.covariance is not None:
        sigma = projection_sigma(first, first.covariance)
        sigma_px = np.hypot(sigma, projection_sigma(second, second.covariance))[reached]
    middle = _in_the_middle(first, pixels)
    turn = Rotation.identity()
    for _ in range(_TURNS):
        turned = turn.apply(rays)
        at, by_ray = second.project_with_derivative(turned)
        step = _turn_of(_by_turn(turned, by_ray), (pixels - at)[..., None], middle)
        turn = Rotation.from_rotvec(step[:, 0]) * turn
    off_px = second.project(turn.apply(rays)) - pixels
    by_xy = first.pixels_per_unit(rays[:, :2])
    beside = np.linalg.norm(np.linalg.solve(by_xy, off_px[..., None])[..., 0], axis=1)
    off = beside / np.linalg.norm(rays, axis=1)
    return CameraComparison(pixels, off_px, off, sigma_px, turn.magnitude(), share)
