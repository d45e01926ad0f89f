"""What ``result.json`` says of the platform: its change, and how well its pose is known."""

from __future__ import annotations

from typing import Any

from legcal.calibration import Calibration
from legcal.observations.measurements import Measurements
from legcal.refinement.platform_accuracy import PlatformAccuracy
from legcal.refinement.platform_error import PlatformError


def platform_document(calibration: Calibration) -> dict[str, Any] | None:
    """Return the block ``platform``; None where the motors do not determine the pose."""
    platform = calibration.platform
    if platform is None:
        return None
    change, sigma = platform.change, platform.sigma
    return {
        "poses": len(sigma.displacement),
        "change_dX_m": change.mean_displacement,
        "change_dE_rad": change.mean_rotation,
        **_sigma(sigma),
        "per_pose": _per_pose(platform, calibration.dataset.measurements),
        "workspace": None
        if platform.workspace is None
        else {"poses": len(platform.workspace.displacement), **_sigma(platform.workspace)},
        "sensitivities": [
            {
                "what": found.what,
                "dX_m": found.error.mean_displacement,
                "dE_rad": found.error.mean_rotation,
                "dX_max_m": found.error.max_displacement,
                "dE_max_rad": found.error.max_rotation,
            }
            for found in platform.effects
        ],
    }


def _sigma(error: PlatformError) -> dict[str, float]:
    """Return mean and maximum of a predicted error."""
    return {
        "sigma_dX_m": error.mean_displacement,
        "sigma_dE_rad": error.mean_rotation,
        "sigma_dX_max_m": error.max_displacement,
        "sigma_dE_max_rad": error.max_rotation,
    }


def _per_pose(platform: PlatformAccuracy, measurements: Measurements) -> list[dict[str, Any]]:
    """Return change and predicted error of every pose, with the images that show it."""
    labels = measurements.pose_labels or ("",) * measurements.n_poses
    images: list[list[str]] = [[] for _ in labels]
    for pose, image in zip(measurements.pose.tolist(), measurements.image, strict=True):
        if image:
            images[pose].append(image)
    errors = (
        platform.change.displacement,
        platform.change.rotation,
        platform.sigma.displacement,
        platform.sigma.rotation,
    )
    keys = ("change_dX_m", "change_dE_rad", "sigma_dX_m", "sigma_dE_rad")
    columns = zip(*(values.tolist() for values in errors), strict=True)
    return [
        {"pose": label or None, "images": shown, **dict(zip(keys, values, strict=True))}
        for label, shown, values in zip(labels, images, columns, strict=True)
    ]
